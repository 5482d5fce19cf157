"""The banded system that waves are solved with, against dense matrices and against the chunks that Ceres is given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_refract.estimator.banded import Banded, factorize
from colmap_refract.estimator.chunk import LevelPrior, Problem
from colmap_refract.estimator.priors import LevelPlane, all_to_level, compare_to_level, first_images, plane_stands
from colmap_refract.estimator.scenario import tangent_bases
from colmap_refract.estimator.whole import evaluated
from colmap_refract.interface import Array, tangent_basis
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.refiner.arrangement import arrange
from colmap_refract.refiner.normal_equations import normal_equations
from colmap_refract.refiner.observations import read_observations
from colmap_refract.refiner.soft import level_start
from colmap_refract.refiner.uncertainty import estimate_uncertainty
from colmap_refract.refiner.waves import WaveStatistics, frozen, with_waves
from colmap_refract.simulation import SceneOptions, ignore_refraction, simulate

SHAPES = [(300, 40, 5), (500, 499, 0), (257, 0, 3), (130, 129, 1), (0, 0, 4)]
"""Columns of the band, how far it reaches, and columns of the border; 128 are worked on at once."""


def random_matrix(n: int, reach: int, m: int) -> tuple[Array, Banded]:
    """Positive definite by its diagonal; dense and banded."""
    rng = np.random.default_rng(n + m)
    dense = rng.standard_normal((n + m, n + m))
    i, j = np.indices(dense.shape)
    dense[(np.abs(i - j) > reach) & (i < n) & (j < n)] = 0.0
    dense = dense + dense.T + (4.0 * np.sqrt(n + m) + 10.0) * np.eye(n + m)
    band = np.zeros((n, reach + 1))
    for column in range(n):
        height = min(reach + 1, n - column)
        band[column, :height] = dense[column : column + height, column]
    return dense, Banded(band=band, border=dense[:n, n:].copy(), corner=np.triu(dense[n:, n:]))


@pytest.mark.parametrize(("n", "reach", "m"), SHAPES)
def test_solutions_determinants_and_the_inverse_within_the_band(n: int, reach: int, m: int) -> None:
    dense, banded = random_matrix(n, reach, m)
    inverse = np.linalg.inv(dense)
    factor = factorize(banded.copy())
    assert factor is not None
    right = np.random.default_rng(0).standard_normal((n + m, 2))
    np.testing.assert_allclose(factor.solve(right), inverse @ right, atol=1e-13)
    np.testing.assert_allclose(factor.solve(right[:, 0]), inverse @ right[:, 0], atol=1e-13)
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)
    found = factor.inverse()
    np.testing.assert_allclose(found.diagonal, np.diag(inverse), atol=1e-14)
    near = np.arange(max(0, n // 2 - reach // 2), n // 2)
    columns = np.concatenate([near, np.arange(n, n + m)]).astype(int)
    np.testing.assert_allclose(found.block(columns), inverse[np.ix_(columns, columns)], atol=1e-14)


def test_what_lies_beyond_the_band_is_not_asked_for() -> None:
    _, banded = random_matrix(300, 40, 5)
    factor = factorize(banded)
    assert factor is not None
    with pytest.raises(ValueError, match="within the band"):
        factor.inverse().block(np.array([0, 41]))


@pytest.mark.parametrize(("n", "reach", "m"), SHAPES[:4])
def test_scaled_held_and_partial_matrices(n: int, reach: int, m: int) -> None:
    dense, banded = random_matrix(n, reach, m)
    right = np.random.default_rng(0).standard_normal(n + m)
    scale = 0.5 + np.random.default_rng(1).random(n + m)
    scaled = banded.copy()
    scaled.scale(scale)
    factor = factorize(scaled)
    assert factor is not None
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(dense * scale * scale[:, None], right), atol=1e-12)
    chosen = np.sort(np.random.default_rng(2).choice(n, n // 3, replace=False))
    part = factorize(banded.part(chosen))
    assert part is not None
    assert part.log_determinant == pytest.approx(np.linalg.slogdet(dense[np.ix_(chosen, chosen)])[1], rel=1e-12)
    held = np.unique([0, n // 2, n + m - 1])
    banded.hold(held)
    dense[held], dense[:, held] = 0.0, 0.0
    dense[held, held] = 1.0
    factor = factorize(banded)
    assert factor is not None
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(dense, right), atol=1e-13)


def test_a_matrix_that_is_not_positive_definite_has_no_factor() -> None:
    for at in (100, 302):
        _, banded = random_matrix(300, 40, 5)
        shift = np.zeros(305)
        shift[at] = -1000.0
        banded.add_diagonal(shift)
        assert factorize(banded) is None


def wavy_problem(scenario: str, layout: str, num_images: int, num_points: int) -> Problem:
    """Frozen waves at a rough start, with all priors."""
    capture = simulate(
        SceneOptions(
            scenario=scenario,  # type: ignore[arg-type]
            layout=layout,  # type: ignore[arg-type]
            num_images=num_images,
            num_points=num_points,
            pixel_noise=0.3,
            wave_slope_deg=1.0,
            wavelength=(1.0, 2.5),
        )
    )
    arrangement = arrange(
        read_observations(ignore_refraction(capture)),
        RefinerOptions(scenario=scenario, interface_shape="soft"),  # type: ignore[arg-type]
        ImageNotes(),
    )
    flat = level_start(arrangement)
    wavy = with_waves(flat, WaveStatistics(slope_deviation=0.02, wavelength=2.0, noise=0.3), 8).problem
    level = LevelPrior(tilt=0.03, lift=0.05, noise=0.3) if scenario == "moving_interface" else None
    return frozen(replace(wavy, level_prior=level, loss="cauchy", loss_scale=3.0), bent=False)


def dense_of(banded: Banded) -> Array:
    n, m = banded.border.shape
    dense = np.zeros((n + m, n + m))
    for column, below in enumerate(banded.band):
        height = min(len(below), n - column)
        dense[column : column + height, column] = below[:height]
    dense[n:, :n] = banded.border.T
    dense[n:, n:] = np.triu(banded.corner).T
    return np.asarray(dense + np.tril(dense, -1).T)


@pytest.mark.parametrize(
    ("scenario", "layout", "num_images"),
    [("moving_interface", "survey", 40), ("static_interface", "orbit", 20), ("moving_interface", "orbit", 6)],
)
@pytest.mark.parametrize("num_threads", [1, 3])
def test_the_whole_system_is_that_of_the_chunks(scenario: str, layout: str, num_images: int, num_threads: int) -> None:
    problem = wavy_problem(scenario, layout, num_images, 60 * num_images)
    expected = normal_equations(problem)
    found = evaluated(problem, num_threads)
    assert expected is not None
    assert found is not None
    system, cost, gradient, matrix = found
    place: NDArray[np.int64] = np.concatenate(
        [system.columns[key] + np.arange(expected.widths[key]) for key in expected.keys]
    )
    assert sorted(place.tolist()) == list(range(len(expected.gradient)))
    dense, hessian = dense_of(matrix)[np.ix_(place, place)], expected.hessian.toarray()
    # At a rough start a few points stop before their minimum; what they would still gain is in one sum only.
    assert cost == pytest.approx(expected.cost, rel=1e-5)
    size = np.sqrt(np.diag(hessian))
    assert np.abs((dense - hessian) / size / size[:, None]).max() < 1e-9
    assert np.abs((gradient[place] - expected.gradient) / size).max() < 1e-6 * np.sqrt(cost)
    if layout == "survey":
        assert matrix.band.shape[1] < matrix.band.shape[0]
    if scenario == "static_interface":
        assert system.num_shared > 0


def test_planes_are_compared_with_the_level_at_once_as_one_by_one() -> None:
    problem = wavy_problem("moving_interface", "orbit", 6, 200)
    structure, state = problem.structure, problem.state
    structure = replace(
        structure,
        plane_in_world=np.arange(structure.num_planes) % 2 == 1,
        plane_anchor=np.random.default_rng(1).standard_normal((structure.num_planes, 3)),
    )
    rng = np.random.default_rng(0)
    pose, plane = 0.1 * rng.standard_normal((6, 6)), 0.1 * rng.standard_normal((6, 3))
    level = LevelPlane(normal=np.array([0.0, 0.6, 0.8]), distance=1.5, anchor=np.array([0.1, 0.2, 0.3]))
    change, images = 0.1 * rng.standard_normal(3), first_images(structure)
    together = all_to_level(structure, state, images, pose, plane, level, change)
    for b, image in enumerate(images.tolist()):
        standing = plane_stands(structure, state, b, image, pose[b], plane[b])
        for part, alone in zip(together, compare_to_level(standing, level, change), strict=True):
            np.testing.assert_allclose(part[b], alone, atol=1e-12)
    normals = rng.standard_normal((20, 3))
    normals[0] = (1.0, 0.1, 0.0)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    np.testing.assert_allclose(tangent_bases(normals), [tangent_basis(n) for n in normals], atol=1e-15)


def test_uncertainties_with_waves_are_those_of_all_unknowns_under_the_constraint() -> None:
    """By the dense matrix of constraints and unknowns, which no factor of a band has touched."""
    problem = wavy_problem("moving_interface", "orbit", 8, 300)
    system = normal_equations(problem)
    assert system is not None
    from colmap_refract.refiner.uncertainty import gauge

    constraint = gauge(problem, system.keys, system.columns, len(system.gradient))
    for key in system.keys:
        if key[0] != 0:
            constraint[system.columns[key] : system.columns[key] + system.widths[key]] = 0.0
    scale = 1.0 / np.sqrt(system.hessian.diagonal())
    m = constraint.shape[1]
    constraint = constraint * scale[:, None]
    bordered = np.zeros((len(scale) + m, len(scale) + m))
    bordered[: len(scale), : len(scale)] = system.hessian.toarray() * scale * scale[:, None]
    bordered[: len(scale), len(scale) :] = constraint
    bordered[len(scale) :, : len(scale)] = constraint.T
    covariance = np.linalg.inv(bordered)[: len(scale), : len(scale)] * scale * scale[:, None]
    found = estimate_uncertainty(problem)
    assert found.determined
    for block in range(problem.structure.num_planes):
        first = system.columns[1, block]
        mine = covariance[first : first + 3, first : first + 3]
        assert found.distance[block] == pytest.approx(np.sqrt(mine[2, 2]), rel=1e-3)
        assert found.normal[block] == pytest.approx(np.sqrt(np.linalg.eigvalsh(mine[:2, :2])[-1]), rel=1e-3)
