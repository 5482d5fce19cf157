"""Waves whose effects stand still: the surface that the other keypoints show, and states between two solutions.

What this does not show: whether the solutions are near the truth, see `test_soft`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from colmap_refract.estimator.chunk import Problem
from colmap_refract.interface import Array
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.refiner.arrangement import arrange
from colmap_refract.refiner.continuation import residuals
from colmap_refract.refiner.observations import read_observations
from colmap_refract.refiner.soft import level_start
from colmap_refract.refiner.waves import WaveStatistics, between, frozen, relief_of, surface_effects, with_waves
from colmap_refract.simulation import SceneOptions, ignore_refraction, simulate

NOISE = 0.5
SCALE = 8.0


@pytest.fixture(scope="module")
def wavy() -> Problem:
    """Few waves with some coefficients, at a rough start."""
    capture = simulate(
        SceneOptions(
            scenario="moving_interface", num_images=4, num_points=60, pixel_noise=0.3, wave_slope_deg=1.0,
            wavelength=(1.0, 2.5),
        )
    )  # fmt: skip
    arrangement = arrange(
        read_observations(ignore_refraction(capture)),
        RefinerOptions(scenario="moving_interface", interface_shape="soft"),
        ImageNotes(),
    )
    statistics = WaveStatistics(slope_deviation=0.02, wavelength=2.0, noise=NOISE)
    problem = with_waves(level_start(arrangement), statistics, 5).problem
    waves = np.random.default_rng(0).normal(0.0, 0.5, problem.state.waves.shape)
    return replace(problem, state=replace(problem.state, waves=waves), loss="cauchy", loss_scale=SCALE)


def test_residuals_stay(wavy: Problem) -> None:
    for bent in (False, True):
        np.testing.assert_allclose(residuals(frozen(wavy, bent=bent)), residuals(wavy), atol=1e-9)


def test_the_relief_is_what_the_others_say(wavy: Problem) -> None:
    """Against the image's ridge regression, made anew without each of some observations."""
    tracks = wavy.tracks
    relief = frozen(wavy, bent=True).tracks.relief
    effects, error = surface_effects(wavy) @ tracks.waves, residuals(wavy)
    weight = 1.0 / (1.0 + (error**2).sum(axis=1) / SCALE**2)
    as_solved = relief_of(wavy, wavy.structure.wave_axes)
    moved = 0.0
    for image in range(4):
        mine = np.flatnonzero(tracks.image == image)
        coefficients = wavy.state.waves[image]
        # At the minimum of all: what closed form assumes. The right side moves the data there.
        pull = np.einsum("n,nak,na->k", weight[mine], effects[mine], error[mine])
        for left in mine[:: len(mine) // 7].tolist():
            rest = mine[mine != left]
            matrix = np.einsum("n,nak,nal->kl", weight[rest], effects[rest], effects[rest]) + NOISE**2 * np.eye(5)
            change = np.linalg.solve(matrix, pull - np.einsum("n,nak,na->k", weight[rest], effects[rest], error[rest]))
            expected = tracks.waves[left] @ (coefficients + change)
            np.testing.assert_allclose(relief[left], expected, rtol=1e-7, atol=1e-12)
            moved = max(moved, float(np.abs(expected - as_solved[left]).max()))
    assert moved > 1e-5


def test_flat_water_has_no_relief(wavy: Problem) -> None:
    calm = replace(wavy, state=replace(wavy.state, waves=np.zeros_like(wavy.state.waves)))
    error = residuals(calm)
    for bent in (False, True):
        still = frozen(calm, bent=bent)
        np.testing.assert_allclose(residuals(still), error, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_between(wavy: Problem, share: float) -> None:
    """Small steps are linear, the ends are the ends, and rotations stay rotations."""
    rng = np.random.default_rng(1)
    state = wavy.state
    turn = np.array([[0.0, -2e-3, 1e-3], [2e-3, 0.0, -1e-3], [-1e-3, 1e-3, 0.0]])
    rotation, _ = np.linalg.qr(state.rotation @ (np.eye(3) + turn))
    rotation *= np.sign(np.einsum("nij,nij->nj", rotation, state.rotation))[:, None, :]
    other = replace(
        wavy,
        points=wavy.points + rng.normal(0.0, 1e-3, wavy.points.shape),
        state=replace(
            state, rotation=rotation, translation=state.translation + 1e-3, distance=state.distance * 1.01,
            waves=state.waves + 0.1,
        ),
    )  # fmt: skip
    mixed = between(wavy, other, share)
    axes = wavy.structure.wave_axes

    def mix(a: Array, b: Array) -> Array:
        return (1.0 - share) * a + share * b

    np.testing.assert_allclose(mixed.points, mix(wavy.points, other.points), atol=1e-12)
    np.testing.assert_allclose(relief_of(mixed, axes), mix(relief_of(wavy, axes), relief_of(other, axes)), atol=1e-12)
    np.testing.assert_allclose(mixed.state.rotation, mix(state.rotation, rotation), atol=1e-5)
    np.testing.assert_allclose(
        mixed.state.rotation @ mixed.state.rotation.transpose(0, 2, 1), np.tile(np.eye(3), (len(rotation), 1, 1)),
        atol=1e-12,
    )  # fmt: skip
    np.testing.assert_allclose(np.linalg.norm(mixed.state.normal, axis=1), 1.0, atol=1e-12)
