"""Waves in the estimator: refraction by local planes, the random surface that ties them together, and the priors.

Residuals are compared with paths of least optical length, gradients and matrices with `dense_reference`, statistics
with surfaces that are drawn.

What this does not show: that waves are found from keypoints, and that it pays. That is for tests of whole refinements.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from dense_reference import (
    FOCAL_LENGTH,
    PORTHOLE,
    STEP,
    TANK,
    TOLERANCE,
    assert_same_system,
    change_of,
    jacobians,
    make_problem,
    predict,
    reduced,
    residuals,
    schur_complement,
    settled,
    some_parameters,
    steps,
    strip,
    unit,
    whole,
)
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from colmap_refract.estimator import chunk as chunks
from colmap_refract.estimator import elimination
from colmap_refract.estimator.adjustment import SolverSettings, adjust, settle_points
from colmap_refract.estimator.chunk import Held, LevelPrior, Problem
from colmap_refract.estimator.elimination import LEVEL, PLANE, POSE, WAVES, Tracks
from colmap_refract.estimator.priors import (
    LevelPlane,
    PriorBlock,
    compare_to_level,
    deviations,
    mean_plane,
    plane_stands,
    prior_blocks,
)
from colmap_refract.estimator.random_surface import RandomSlopes, RandomSurface, closest_surface, modes, node_grid
from colmap_refract.estimator.rotation import exp_and_left_jacobian
from colmap_refract.estimator.scenario import SCENARIOS, Change, State, Structure, apply, evaluate_views
from colmap_refract.estimator.surface import local_planes
from colmap_refract.estimator.triangulation import refracted_rays
from colmap_refract.interface import Array, Layers, plane_in_cam, tangent_basis
from colmap_refract.options import Loss, Scenario
from colmap_refract.refiner.observations import read_observations
from colmap_refract.simulation import Capture, SceneOptions, least_path_direction, simulate


def with_waves(flat: Problem, num_waves: int, *, linear: bool = False, slope: float = 0.05, seed: int = 11) -> Problem:
    """The problem with random waves over each image, through which its keypoints are seen.

    Args:
        num_waves: to an image.
        linear: they shift the keypoints, which are refracted by the images' planes.
        slope: that one wave adds to each axis.
    """
    rng = np.random.default_rng(seed)
    tracks, structure, count = flat.tracks, flat.structure, len(flat.tracks.image)
    normal, _ = flat.state.planes_in_cam(structure)
    axes = np.array([np.zeros((3, 2)) if np.isnan(n).any() else tangent_basis(n) for n in normal])
    exact = predict(flat, flat.state, flat.points)
    state = replace(flat.state, waves=rng.normal(size=(structure.num_images, num_waves)))
    structure = replace(structure, wave_axes=axes)
    if linear:
        effects, offset = 4 * rng.normal(size=(count, 2, num_waves)), 2 * rng.normal(size=(count, 2))
        shift = offset + np.einsum("nij,nj->ni", effects, state.waves[tracks.image])
        direction = tracks.direction + np.einsum("nij,ni->nj", tracks.metric, shift) / FOCAL_LENGTH**2
        tracks = tracks._replace(effects=effects, offset=offset, direction=direction)
        return replace(flat, state=state, structure=structure, tracks=tracks)
    # A ray that is a little beside the keypoint's: the two must not be mistaken for one another.
    sight = unit(exact + 0.01 * rng.normal(size=exact.shape))
    waves = slope * rng.normal(size=(count, 3, num_waves)) * [[0.4], [1], [1]]
    wavy = replace(flat, state=state, structure=structure, tracks=tracks._replace(waves=waves, sight=sight))
    direction = tracks.direction - exact + predict(wavy, state, flat.points)
    metric = FOCAL_LENGTH * np.array([tangent_basis(d).T for d in unit(direction)])
    return replace(wavy, tracks=wavy.tracks._replace(direction=direction, metric=metric))


def kernel_residuals(problem: Problem) -> Array:
    """(N, 2) as compiled."""
    chunk = whole(problem)
    evaluated = chunk.views(some_parameters(chunk, 0.0))
    assert evaluated is not None
    out = np.empty((len(chunk.tracks.image), 2))
    elimination.residuals(problem.points, chunk.tracks, *evaluated, out)
    return out


@pytest.mark.parametrize("layers", [Layers(), TANK, PORTHOLE], ids=["water", "tank", "porthole"])
@pytest.mark.parametrize("sensors", [1, 2])
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_light_takes_the_least_path_through_the_tilted_plane(scenario: Scenario, sensors: int, layers: Layers) -> None:
    problem = with_waves(make_problem(scenario, sensors=sensors, layers=layers, dry_image=True), 3)
    tracks, structure, state = problem.tracks, problem.structure, problem.state
    rotation, translation = state.cam_from_world(structure)
    point = np.repeat(problem.points, np.diff(tracks.start), axis=0)
    expected, flat = np.empty((2, len(point), 2))
    for k, i in enumerate(tracks.image):
        in_cam = rotation[i] @ point[k] + translation[i]
        seen = unit(in_cam)[None]
        straight = seen
        if tracks.wet[k]:
            normal, distance = (part[i] for part in state.planes_in_cam(structure))
            height, first, second = tracks.waves[k] @ state.waves[i]
            # Where the ray is as far down as the surface. Two tangents there rise against the normal by the slopes.
            touching = tracks.sight[k] * distance * (1 + height) / (normal @ tracks.sight[k])
            e1, e2 = structure.wave_axes[i].T
            local = unit(np.cross(e1 - first * normal, e2 - second * normal))
            assert local @ normal > 0
            seen = least_path_direction(in_cam, local, local @ touching, layers)
            straight = least_path_direction(in_cam, normal, distance, layers)
        expected[k], flat[k] = (tracks.metric[k] @ (d[0] - tracks.direction[k]) for d in (seen, straight))
    # Pixels: paths are found to 1e-12 or so, and the focal length is 1200.
    found = kernel_residuals(problem)
    np.testing.assert_allclose(found, expected, atol=1e-8)
    assert np.median(np.abs(expected - flat)[tracks.wet]) > 5
    np.testing.assert_array_equal(
        found[~tracks.wet], kernel_residuals(replace(problem, state=waveless(state)))[~tracks.wet]
    )


def waveless(state: State) -> State:
    return replace(state, waves=np.zeros_like(state.waves))


SWELL: dict[str, Any] = {"wave_slope_deg": 2.0, "wavelength": (1.0, 2.5)}
RIPPLES: dict[str, Any] = {"wave_slope_deg": 4.0, "wavelength": (0.02, 0.1)}


def of_capture(capture: Capture) -> tuple[Problem, Array]:
    """A capture with its true poses, points, mean planes and waves (one to an image); and its true normals (N, 3)."""
    seen = read_observations(capture.reconstruction)
    images = len(seen.image_ids)
    planes = [capture.planes[int(i)] for i in seen.image_ids]
    normal, distance = np.array([p[0] for p in planes]), np.array([p[1] for p in planes])
    structure = Structure(
        image_pose=seen.image_frame, image_plane=np.arange(images), image_camera=seen.image_camera,
        sensor_rotation=seen.sensor_rotation, sensor_translation=seen.sensor_translation,
        plane_in_world=np.zeros(images, bool), plane_anchor=np.zeros((images, 3)),
        wave_axes=np.array([tangent_basis(n) for n in normal]),
    )  # fmt: skip
    state = State(
        rotation=seen.rig_from_world_rotation, translation=seen.rig_from_world_translation,
        normal=normal, distance=distance, index=capture.layers.refractive_index,
        lens=np.zeros((len(seen.camera_ids), 0)), waves=np.ones((images, 1)),
    )  # fmt: skip
    ids, idxs = seen.image_ids[seen.image].tolist(), seen.point2D_idx.tolist()
    crossing = np.array([capture.crossings[i][j] for i, j in zip(ids, idxs, strict=True)])
    true_normal = np.array([capture.normals_in_cam(i)[j] for i, j in zip(ids, idxs, strict=True)])
    height = np.array([capture.heights(i)[j] for i, j in zip(ids, idxs, strict=True)])
    wet = np.isfinite(crossing).all(axis=1)
    rotation, translation = seen.cam_from_world
    in_cam = np.einsum("nij,nj->ni", rotation[seen.image], crossing) + translation[seen.image]
    mean = normal[seen.image]
    # By how much the true normal, laid out to the length of one along the mean normal, is tilted.
    slopes = np.einsum(
        "nia,ni->na", structure.wave_axes[seen.image], true_normal / np.sum(true_normal * mean, axis=1, keepdims=True)
    )
    tracks = Tracks(
        start=seen.start, image=seen.image.astype(np.int32), direction=seen.direction, metric=seen.metric,
        lens=np.zeros((len(wet), 2, 0)), wet=wet,
        waves=np.nan_to_num(np.column_stack([-height / distance[seen.image], slopes]))[:, :, None],
        sight=np.where(wet[:, None], unit(in_cam), seen.direction),
    )  # fmt: skip
    problem = Problem(
        tracks=tracks, structure=structure, layers=capture.layers, state=state, points=seen.points,
        held=Held.nothing(state),
    )  # fmt: skip
    return problem, true_normal


@pytest.mark.parametrize("waves", [SWELL, RIPPLES], ids=["swell", "ripples"])
@pytest.mark.parametrize("sensors", [1, 2])
def test_a_capture_through_waves_has_no_residuals(waves: dict[str, Any], sensors: int) -> None:
    """Light that was traced through the whole surface, by its tangents alone."""
    capture = simulate(
        SceneOptions(
            scenario="moving_interface", **waves, num_images=4, num_points=60, depth=2.0, distance_ratio=0.3,
            tilt_deg=3.0, pixel_noise=1e-10, sensors_per_frame=sensors, dry_point_ratio=0.2,
        )
    )  # fmt: skip
    problem, true_normal = of_capture(capture)
    tracks, wet = problem.tracks, problem.tracks.wet
    assert wet.sum() > 80 and (~wet).sum() > 2
    # Crossings are found to 1e-10 of the optical length's gradient, of which a pixel is about 1e-3.
    assert np.abs(kernel_residuals(problem)).max() < 1e-8
    flat = np.abs(kernel_residuals(replace(problem, state=waveless(problem.state))))
    assert np.median(flat[wet]) > 1 and flat[~wet].max() < 1e-8

    normal, _ = local_planes(tracks, problem.structure, problem.state)
    np.testing.assert_allclose(normal[wet], true_normal[wet], atol=1e-12)
    # Backwards: the refracted rays meet the points.
    origin, ray = refracted_rays(tracks, problem.structure, problem.state, problem.layers)
    apart = np.repeat(problem.points, np.diff(tracks.start), axis=0) - origin
    assert np.linalg.norm(np.cross(unit(ray), apart), axis=1).max() < 1e-10
    # The keypoint's own direction says where the ray meets the surface as well as the truth does.
    own = replace(problem, tracks=tracks._replace(sight=tracks.direction))
    np.testing.assert_allclose(kernel_residuals(own), 0, atol=1e-8)


CASES: dict[str, tuple[int, dict[str, Any]]] = {
    **{scenario: (2, {"scenario": scenario}) for scenario in SCENARIOS},
    **{f"{scenario}, two sensors": (2, {"scenario": scenario, "sensors": 2}) for scenario in SCENARIOS},
    "one wave": (1, {"scenario": "static_interface"}),
    "as many as slopes and height": (3, {"groups": True, "dry_image": True}),
    "as many as a pose has": (6, {"scenario": "static_interface"}),
    "many": (10, {"scenario": "moving_interface"}),
    "groups, two sensors": (4, {"groups": True, "sensors": 2, "dry_image": True}),
    "index": (3, {"scenario": "static_interface", "index": True}),
    "lens": (3, {"lens": 3, "sensors": 2}),
    "more of a lens than waves": (2, {"lens": 9}),
    "everything": (5, {"sensors": 2, "groups": True, "dry_image": True, "index": True, "lens": 2, "layers": TANK}),
}
cases = pytest.mark.parametrize("case", CASES)
linear_or_not = pytest.mark.parametrize("linear", [False, True], ids=["refracted", "linear"])


def wavy_case(case: str, linear: bool, **options: Any) -> Problem:
    num_waves, usual = CASES[case]
    return with_waves(make_problem(**usual, **options), num_waves, linear=linear)


@cases
@linear_or_not
@pytest.mark.parametrize("size", [0.0, 0.02])
def test_derivatives_at_known_points(case: str, linear: bool, size: float) -> None:
    problem = wavy_case(case, linear, odd_points=True)
    problem = replace(problem, held=replace(problem.held, points=True))
    chunk = whole(problem)
    parameters = some_parameters(chunk, size)
    cost, gradient, matrix = reduced(chunk, parameters)
    r = residuals(problem, change_of(problem, chunk.keys, parameters), problem.points).ravel()
    assert cost == pytest.approx(0.5 * r @ r, rel=1e-12)
    j, _ = jacobians(problem, chunk.keys, parameters, problem.points)
    norms = np.linalg.norm(j, axis=0)
    assert_same_system(gradient, matrix, j.T @ r, j.T @ j, norms, float(np.linalg.norm(r)))
    wet = np.flatnonzero(problem.structure.image_plane >= 0)
    assert [key for key in chunk.keys if key[0] == WAVES] == [(WAVES, i) for i in wet]


@cases
@linear_or_not
@pytest.mark.parametrize("size", [0.0, 2e-3])
def test_eliminated_points_leave_the_schur_complement(case: str, linear: bool, size: float) -> None:
    problem = wavy_case(case, linear)
    chunk = whole(problem)
    parameters = some_parameters(chunk, size)
    points, cost = settled(chunk, parameters)
    assert np.abs(points - problem.points).max() > 1e-4
    reduced_cost, gradient, matrix = reduced(chunk, parameters)
    assert reduced_cost == pytest.approx(cost, rel=1e-9)
    expected = schur_complement(problem, chunk.keys, parameters, points, chunk.anchors)
    assert_same_system(gradient, matrix, *expected, np.sqrt(2 * cost))


@cases
@linear_or_not
@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_gradient_is_the_derivative_of_the_settled_cost(case: str, linear: bool, loss: Loss) -> None:
    problem = wavy_case(case, linear, loss=loss)
    chunk = whole(problem)
    parameters = some_parameters(chunk, 1e-3)
    _, gradient, matrix = reduced(chunk, parameters)
    difference = [
        (settled(chunk, ahead)[1] - settled(chunk, behind)[1]) / (2 * STEP) for ahead, behind in steps(parameters)
    ]
    # In standard deviations of one parameter, so that no unit matters. The gauge has no curvature.
    curvature = np.sqrt(np.diag(matrix))
    curvature = np.maximum(curvature, 1e-3 * curvature.max())
    found, expected = gradient / curvature, np.array(difference) / curvature
    # What settled points have left is in proportion to the residuals, and so is the gradient.
    np.testing.assert_allclose(
        found, expected, atol=(1e-4 if loss == "trivial" else 1e-2) * max(1, np.abs(found).max())
    )
    slot = np.repeat([key[0] for key in chunk.keys], chunk.widths)
    assert all(np.abs(found[slot == each]).max() > 0.1 for each in (PLANE, WAVES))


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_effects_of_the_surface_are_derivatives(scenario: Scenario) -> None:
    """By height and slopes under each keypoint, as if the surface were free there."""
    problem = with_waves(make_problem(scenario, layers=TANK, dry_image=True), 3)
    tracks, count = problem.tracks, len(problem.tracks.image)
    chunk = whole(problem)
    evaluated = chunk.views(some_parameters(chunk, 0.0))
    assert evaluated is not None
    found = np.full((count, 2, 3), np.nan)
    elimination.surface_effects(problem.points, chunk.tracks, *evaluated, found)
    for a in range(3):
        own = np.zeros((count, 3, 1))
        own[:, a] = 1.0
        bumped = replace(problem, tracks=tracks._replace(waves=np.concatenate([tracks.waves, own], axis=2)))
        both = []
        for step in (STEP, -STEP):
            waves = np.column_stack([problem.state.waves, np.full(problem.structure.num_images, step)])
            state = replace(problem.state, waves=waves)
            both.append(residuals(replace(bumped, state=state), Change.zero(state), problem.points))
        difference = (both[0] - both[1]) / (2 * STEP)
        np.testing.assert_allclose(found[:, :, a], difference, atol=TOLERANCE * FOCAL_LENGTH)
        # Tilts show more than height does.
        assert np.median(np.abs(difference[tracks.wet])) > (20 if a else 2)
    assert not found[~tracks.wet].any()


@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface"])
def test_linear_effects_are_the_waves_where_they_are_frozen(scenario: Scenario) -> None:
    """Waves that are frozen at where they stand: the same residuals, gradient and matrix there, for the waves."""
    problem = with_waves(make_problem(scenario), 3, slope=0.02)
    problem = replace(problem, points=settled(whole(problem), some_parameters(whole(problem), 0.0))[0])
    chunk = whole(problem)
    evaluated = chunk.views(some_parameters(chunk, 0.0))
    assert evaluated is not None
    by_surface = np.zeros((len(problem.tracks.image), 2, 3))
    elimination.surface_effects(problem.points, chunk.tracks, *evaluated, by_surface)
    tracks = problem.tracks
    effects = by_surface @ tracks.waves
    flat = replace(problem, tracks=tracks._replace(waves=np.zeros((0, 3, 0))))
    now = np.einsum("nij,nj->ni", effects, problem.state.waves[tracks.image])
    offset = kernel_residuals(problem) - kernel_residuals(flat) - now
    frozen = replace(flat, tracks=flat.tracks._replace(effects=effects, offset=offset))
    np.testing.assert_allclose(kernel_residuals(frozen), kernel_residuals(problem), atol=1e-10)

    hold = replace(problem.held, points=True)
    systems = []
    for each in (problem, frozen):
        one = whole(replace(each, held=hold))
        _, gradient, matrix = reduced(one, some_parameters(one, 0.0))
        mine = np.repeat([key[0] == WAVES for key in one.keys], one.widths)
        systems.append((gradient[mine], np.triu(matrix[np.ix_(mine, mine)])))
    for a, b in zip(*systems, strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9 * np.abs(a).max())
        assert np.abs(a).max() > 1


@linear_or_not
@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface"])
def test_chunks_add_up(monkeypatch: pytest.MonkeyPatch, scenario: Scenario, linear: bool) -> None:
    problem = with_waves(strip("cauchy", scenario), 3, linear=linear)
    monkeypatch.setattr(chunks, "MAX_CHUNK_COLUMNS", 10_000)
    (one,) = chunks.split(problem, 1)
    (sliced,) = chunks.split(problem, 2)
    monkeypatch.setattr(chunks, "MAX_CHUNK_COLUMNS", 90)
    parts = chunks.split(problem, 1)
    assert len(parts) > 2 and len(sliced.slices) == 2
    assert all(len(part.keys) < len(one.keys) for part in parts)
    parameters = some_parameters(one, 1e-4)
    cost, gradient, matrix = reduced(one, parameters)
    total, total_gradient, total_matrix = 0.0, np.zeros_like(gradient), np.zeros_like(matrix)
    for part in parts:
        own_cost, own_gradient, own_matrix = reduced(part, [parameters[one.keys.index(key)] for key in part.keys])
        columns = np.concatenate(
            [one.first_column[key] + np.arange(width) for key, width in zip(part.keys, part.widths, strict=True)]
        )
        total += own_cost
        total_gradient[columns] += own_gradient
        total_matrix[np.ix_(columns, columns)] += np.triu(own_matrix)
    norms = np.sqrt(np.diag(matrix))
    scale = np.outer(norms, norms)
    again = reduced(sliced, parameters)
    for f, g, h in ((total, total_gradient, total_matrix), (again[0], again[1], np.triu(again[2]))):
        assert f == pytest.approx(cost, rel=1e-12)
        np.testing.assert_allclose(g / norms, gradient / norms, atol=1e-9 * np.sqrt(2 * cost))
        np.testing.assert_allclose(h / scale, np.triu(matrix) / scale, atol=1e-9)
    assert {key[0] for key in one.keys} == {POSE, PLANE, WAVES}


@linear_or_not
def test_held_waves_stay(linear: bool) -> None:
    problem = with_waves(strip(), 3, linear=linear, slope=0.01)
    settings = SolverSettings(max_num_iterations=5)
    held = adjust(replace(problem, held=replace(problem.held, waves=True)), settings)
    np.testing.assert_array_equal(held.state.waves, problem.state.waves)
    assert (held.state.translation != problem.state.translation).any(axis=1).all()
    # They are there all the same.
    rather = adjust(replace(problem, state=waveless(problem.state), held=replace(problem.held, waves=True)), settings)
    assert held.initial_cost != pytest.approx(rather.initial_cost, rel=0.1)
    free = adjust(problem, settings)
    assert free.initial_cost == pytest.approx(held.initial_cost, rel=1e-12)
    assert (free.state.waves != problem.state.waves).all() and free.cost < held.cost
    # Points alone: nothing on the camera side moves, whatever is known of it.
    prior = np.ones((16, 1, 3))
    points = settle_points(replace(problem, wave_prior=prior, level_prior=LEVEL_PRIOR), SolverSettings())
    chunk = whole(problem)
    np.testing.assert_allclose(points, settled(chunk, some_parameters(chunk, 0.0))[0], atol=1e-9)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_no_waves_are_as_before(scenario: Scenario) -> None:
    """None at all, bit for bit; and those of no height and slope, to rounding."""
    flat = make_problem(scenario, sensors=2, dry_image=True, index=True, lens=2)
    chunk = whole(flat)
    parameters = some_parameters(chunk, 1e-3)
    expected = reduced(chunk, parameters)
    images, count = flat.structure.num_images, len(flat.tracks.image)
    none = replace(
        flat,
        tracks=flat.tracks._replace(waves=np.zeros((count, 3, 0)), effects=np.zeros((count, 2, 0))),
        state=replace(flat.state, waves=np.zeros((images, 0))),
    )
    other = whole(none)
    assert other.keys == chunk.keys
    for a, b in zip(reduced(other, parameters), expected, strict=True):
        np.testing.assert_array_equal(a, b)

    wavy = with_waves(flat, 4)
    level = replace(
        wavy, state=waveless(wavy.state), held=replace(flat.held, waves=True),
        tracks=wavy.tracks._replace(direction=flat.tracks.direction, metric=flat.tracks.metric),
    )  # fmt: skip
    assert np.abs(wavy.tracks.direction - flat.tracks.direction).max() > 0.01
    np.testing.assert_allclose(kernel_residuals(level), kernel_residuals(flat), atol=1e-9)
    found = reduced(whole(level), parameters)
    norms = np.sqrt(np.diag(expected[2]))
    assert found[0] == pytest.approx(expected[0], rel=1e-9)
    np.testing.assert_allclose(found[1] / norms, expected[1] / norms, atol=1e-8 * np.sqrt(2 * expected[0]))
    np.testing.assert_allclose(found[2] / np.outer(norms, norms), expected[2] / np.outer(norms, norms), atol=1e-8)
    # Waves over dry images and dry points do nothing.
    dry = replace(wavy, tracks=wavy.tracks._replace(wet=np.zeros(count, bool)))
    np.testing.assert_array_equal(kernel_residuals(dry), kernel_residuals(replace(dry, state=waveless(dry.state))))


def test_a_change_of_waves_is_that_of_their_coefficients() -> None:
    problem = with_waves(make_problem("static_interface"), 3)
    change = Change.zero(problem.state)
    change.waves[:] = np.random.default_rng(2).normal(size=change.waves.shape)
    moved = apply(problem.state, change)
    np.testing.assert_array_equal(moved.waves, problem.state.waves + change.waves)
    columns = np.full((4, 5), -1, np.int32)
    views = evaluate_views(problem.structure, problem.state, change, columns)
    np.testing.assert_array_equal(views.waves, moved.waves)
    assert views.axes is problem.structure.wave_axes
    chunk = whole(problem)
    broken = [np.full(3, np.nan) if slot == WAVES else value
              for (slot, _), value in zip(chunk.keys, some_parameters(chunk, 0.0), strict=True)]  # fmt: skip
    assert chunk.settle(broken, None) is None and chunk.reduce(broken, None) is None


SURFACE = RandomSurface(slope_deviation=0.05, wavelength=0.8)
HEIGHT_VARIANCE = float(SURFACE.covariance(np.zeros((1, 2)), np.zeros((1, 2)))[0, 0, 0])
SLOPE_VARIANCE = SURFACE.slope_deviation**2 / 2
"""Of one axis."""


def joint_covariance(surface: RandomSurface, places: Array) -> Array:
    """(3n, 3n) of heights and slopes at places (n, 2), heights first; slopes by finite differences of the nodes."""
    step = 1e-3 * surface.wavelength
    shifts = step * np.eye(2)
    parts = [surface.covariance(places, places)]
    parts += [
        (surface.covariance(places, places + e) - surface.covariance(places, places - e)) / (2 * step) for e in shifts
    ]
    return np.concatenate([np.concatenate(list(np.moveaxis(part, 1, 0))) for part in parts], axis=1)


def test_slopes_are_the_derivatives_of_heights() -> None:
    rng, step = np.random.default_rng(0), 1e-4
    for spread in (1.0, 30.0):
        places, nodes = rng.uniform(-spread, spread, (2, 60, 2))
        covariance = SURFACE.covariance(places, nodes)
        for a, e in enumerate(step * np.eye(2)):
            ahead, behind = SURFACE.covariance(places + e, nodes), SURFACE.covariance(places - e, nodes)
            # A millionth of the largest: differences of this step are as good as that.
            np.testing.assert_allclose(covariance[:, 1 + a], (ahead - behind)[:, 0] / (2 * step), atol=1e-10)
        assert np.abs(covariance[:, 1:]).max() > (1e-4 if spread == 1 else 1e-6)


def test_the_covariance_is_one() -> None:
    """Of heights and slopes together: symmetric, of no negative variance, with the slope deviation asked for."""
    for count, spread in [(60, 3.0), (60, 0.3), (10, 100.0), (2, 1e-2)]:
        places = np.random.default_rng(1).uniform(-spread, spread, (count, 2))
        joint = joint_covariance(SURFACE, places)
        scale = np.sqrt(joint.diagonal())
        joint /= np.outer(scale, scale)
        # Second derivatives, by differences of a table.
        np.testing.assert_allclose(joint, joint.T, atol=1e-4)
        assert np.linalg.eigvalsh(joint).min() > -1e-4
        assert scale[:count] == pytest.approx(np.sqrt(HEIGHT_VARIANCE), rel=1e-12)
        assert np.hypot(scale[count : 2 * count], scale[2 * count :]) == pytest.approx(0.05, rel=1e-3)
    # Neighbours belong together, or half of this would be a test of zeros.
    assert abs(joint[0, 1]) > 0.9


@pytest.mark.parametrize("wavelength", [0.3, 2.0])
def test_the_covariance_is_that_of_sinusoids(wavelength: float) -> None:
    """Drawn one by one: of any direction and phase, of lengths that scatter about the dominant one."""
    surface, rng, count = (
        RandomSurface(slope_deviation=0.05, wavelength=wavelength),
        np.random.default_rng(4),
        1_000_000,
    )
    deviate = rng.normal(size=count)
    deviate = deviate[np.abs(deviate) < 3]
    azimuth, phase = rng.uniform(0, 2 * np.pi, (2, len(deviate)))
    number = 2 * np.pi / (wavelength * np.exp(0.35 * deviate))
    amplitude = 0.05 * np.sqrt(2) / number
    for apart in wavelength * np.array([0.0, 0.2, 0.4, 0.6, 1.0, 1.5]):
        along = number * apart * np.cos(azimuth)
        here = amplitude * np.sin(phase)
        height = amplitude * np.sin(phase + along)
        slope = amplitude * number * np.cos(azimuth) * np.cos(phase + along)
        found = surface.covariance(np.array([[apart, 0.0]]), np.zeros((1, 2)))[0, :, 0]
        for each, value in ((here * height, found[0]), (here * slope, found[1])):
            # Within five standard deviations of the mean, of which a million draws leave 0.1 % of the variance.
            assert np.mean(each) == pytest.approx(value, abs=5 * np.std(each) / np.sqrt(len(each)))
        assert found[2] == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("apart", [[0.0, 0.0], [0.3, 0.1], [0.0, 0.7], [2.0, -1.0]])
def test_free_slopes_are_those_of_a_surface_but_for_direction(apart: list[float]) -> None:
    """The covariance of one slope is half the trace of a surface's, here by finite differences of its heights."""
    surface, free = (kind(slope_deviation=0.05, wavelength=0.8) for kind in (RandomSurface, RandomSlopes))
    places = np.array([[0.1, 0.2], np.add([0.1, 0.2], apart)])
    slopes = joint_covariance(surface, places).reshape(3, 2, 3, 2)[1:, 0, 1:, 1]
    found = free.covariance(places[:1], places[1:])[0]
    assert not found[0].any() and found[1, 1] == found[2, 0] == 0.0
    for axis in range(2):
        assert found[1 + axis, axis] == pytest.approx(0.5 * np.trace(slopes), rel=1e-4, abs=1e-8)
    between = free.between_nodes(places)
    np.testing.assert_allclose(between, between.T, atol=1e-18)
    assert between[0, 1] == pytest.approx(found[1, 0]) and between[0, 0] == pytest.approx(SLOPE_VARIANCE, rel=1e-4)


def test_the_closest_surface_is_the_one_that_slopes_belong_to() -> None:
    """Slopes of a drawn surface come back, with its heights but for a constant; of slopes of no surface not all do."""
    field = RandomSlopes(slope_deviation=0.05, wavelength=0.8)
    nodes = node_grid(places_of("wide"), 0.8)
    free, rng = modes(field, nodes, 2 * len(nodes)), np.random.default_rng(8)
    drawn = modes(SURFACE, nodes, 12)
    true = rng.normal(size=12)
    slopes = (drawn.at(nodes)[:, 1:] @ true).T.ravel()
    at, by = closest_surface(free, free.weights.T @ slopes)
    error = at.at(nodes) @ by - drawn.at(nodes) @ true
    assert np.sqrt(np.mean(error[:, 1:] ** 2)) < 0.02 * np.sqrt(np.mean(slopes**2))
    assert np.std(error[:, 0]) < 0.02 * np.std(drawn.at(nodes)[:, 0] @ true)
    none = rng.normal(size=free.shapes.shape[1])
    at, by = closest_surface(free, none)
    left = (at.at(nodes) @ by - free.at(nodes) @ none)[:, 1:]
    assert np.sqrt(np.mean(left**2)) > 0.3 * np.sqrt(np.mean((free.at(nodes) @ none) ** 2))


def test_modes_of_free_slopes_have_no_height_and_no_more_than_there_is() -> None:
    field = RandomSlopes(slope_deviation=0.05, wavelength=0.8)
    design = modes(field, node_grid(places_of("wide"), 0.8), 10_000).at(places_of("wide"))
    explained = np.sum(design**2, axis=2) / SLOPE_VARIANCE
    assert not explained[:, 0].any()
    assert (explained[:, 1:] <= 1 + 1e-3).all() and (explained[:, 1:] >= 1 - 5e-3).all()


def test_drawn_surfaces_are_as_steep_as_asked() -> None:
    spacing = 0.05 * SURFACE.wavelength
    x = spacing * np.arange(30)
    grid = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    covariance = SURFACE.covariance(grid, grid)[:, 0]
    factor = np.linalg.cholesky(covariance + 1e-8 * HEIGHT_VARIANCE * np.eye(len(grid)))
    heights = (factor @ np.random.default_rng(3).normal(size=(len(grid), 400))).T.reshape(-1, 30, 30)
    slopes = [np.diff(heights, axis=axis)[:, :29, :29] / spacing for axis in (1, 2)]
    rms = np.sqrt(np.mean(np.sum(np.square(slopes), axis=0)))
    # Samples a twentieth of a wavelength apart lose 0.5 %, and 400 surfaces of 1.5 lengths across say it to 2 %.
    assert rms == pytest.approx(0.05, rel=0.05)
    assert np.mean(heights**2) == pytest.approx(HEIGHT_VARIANCE, rel=0.1)


def places_of(shape: str) -> Array:
    rng = np.random.default_rng(5)
    return {
        "wide": rng.uniform([-0.6, -0.4], [0.6, 0.4], (200, 2)),
        "narrow": rng.uniform([-1, -0.01], [1, 0.01], (100, 2)),
        "small": rng.uniform(-0.02, 0.02, (50, 2)) + [0.3, 0.2],
        "tiny": rng.uniform(-1e-7, 1e-7, (50, 2)) + [0.3, 0.2],
        "line": np.column_stack([np.linspace(-0.5, 0.5, 30), np.full(30, 0.4)]),
        "point": np.array([[0.3, -0.5]]),
        "same point": np.full((20, 2), 7.0),
        "huge": rng.uniform(-1e4, 1e4, (50, 2)),
        "long line": np.column_stack([np.linspace(-1e4, 1e4, 30), np.zeros(30)]),
    }[shape]


SHAPES = ["wide", "narrow", "small", "tiny", "line", "point", "same point"]


@pytest.mark.parametrize("shape", [*SHAPES, "huge", "long line"])
def test_nodes_cover_the_places(shape: str) -> None:
    places, wavelength = places_of(shape), SURFACE.wavelength
    nodes = node_grid(places, wavelength)
    assert np.isfinite(nodes).all() and nodes.shape[1] == 2
    assert (nodes.min(axis=0) < places.min(axis=0)).all() and (nodes.max(axis=0) > places.max(axis=0)).all()
    assert 4 <= len(nodes) <= 900
    # No two in one place, and not much beyond what is seen.
    assert len(np.unique(nodes, axis=0)) == len(nodes)
    assert (np.ptp(nodes, axis=0) <= np.ptp(places, axis=0) + 0.2 * wavelength * (1 + 1e-9)).all()
    steps_between = [np.diff(np.unique(nodes[:, a])).max() for a in range(2)]
    assert max(steps_between) <= 0.1 * wavelength * (1 + 1e-9) or shape in ("huge", "long line")


@pytest.mark.parametrize("shape", SHAPES)
def test_all_modes_explain_the_surface(shape: str) -> None:
    places = places_of(shape)
    found = modes(SURFACE, node_grid(places, SURFACE.wavelength), 10_000)
    design = found.at(places)
    explained = np.sum(design**2, axis=2) / [HEIGHT_VARIANCE, SLOPE_VARIANCE, SLOPE_VARIANCE]
    # Never more than there is, and hardly anything is missing: most beside a line, with two nodes on either side.
    assert (explained <= 1 + 1e-6).all()
    assert (explained >= 1 - 5e-3).all()


def test_modes_are_those_of_the_covariance() -> None:
    nodes = node_grid(places_of("wide"), SURFACE.wavelength)
    covariance = SURFACE.covariance(nodes, nodes)[:, 0]
    variance = np.linalg.eigvalsh(covariance)[::-1]
    inside = np.random.default_rng(6).uniform([-0.6, -0.4], [0.6, 0.4], (50, 2))
    explained = []
    for most in (1, 5, 20, 60, 10_000):
        found = modes(SURFACE, nodes, most)
        count = found.shapes.shape[1]
        assert found.shapes.shape == found.weights.shape and 1 <= count <= most
        # The best that so many can do (Eckart and Young): what is left is the next variance.
        left = np.linalg.norm(covariance - found.shapes @ found.shapes.T, 2)
        assert left == pytest.approx(np.abs(variance[count:]).max(initial=0), rel=1e-6, abs=1e-12 * variance[0])
        explained.append(np.mean(np.sum(found.at(inside)[:, 1:] ** 2, axis=2)) / SLOPE_VARIANCE)
        # Uncorrelated, by falling variance; and at the nodes the modes are themselves.
        gram = found.shapes.T @ found.shapes
        np.testing.assert_allclose(gram, np.diag(gram.diagonal()), atol=1e-10 * gram[0, 0])
        assert (np.diff(gram.diagonal()) <= 0).all()
        np.testing.assert_allclose(found.at(nodes)[:, 0], found.shapes, atol=1e-4 * np.abs(found.shapes).max())
    assert left < 1e-9 * variance[0], explained
    assert explained[1] < 0.4 and explained[-1] > 0.99
    assert (np.diff(explained) > 0).all()


def test_slopes_of_modes_are_derivatives() -> None:
    found = modes(SURFACE, node_grid(places_of("wide"), SURFACE.wavelength), 80)
    places, step = np.random.default_rng(7).uniform([-0.6, -0.4], [0.6, 0.4], (50, 2)), 1e-3
    design = found.at(places)
    for a, e in enumerate(step * np.eye(2)):
        difference = (found.at(places + e) - found.at(places - e))[:, 0] / (2 * step)
        np.testing.assert_allclose(design[:, 1 + a], difference, atol=1e-3 * np.abs(design).max())
        assert np.abs(design[:, 1 + a]).max() > 0.005


LEVEL_PRIOR = LevelPrior(tilt=0.02, lift=0.05, noise=0.5)
# Planes in the camera, in the world, of a fixed camera, and in the camera of a sensor that is not the rig's reference.
LEVEL_CASES: dict[str, dict[str, Any]] = {
    "moving": {},
    "groups": {"groups": True},
    "two sensors": {"sensors": 2, "groups": True},
    "sensor of a rig": {"sensors": 2, "dry_image": True},
    "fixed camera": {"scenario": "fixed_camera"},
    "groups of a fixed camera": {"scenario": "fixed_camera", "groups": True},
}
level_cases = pytest.mark.parametrize("case", LEVEL_CASES)


def level_problem(case: str, **options: Any) -> Problem:
    problem = replace(make_problem(**{**LEVEL_CASES[case], **options}), level_prior=LEVEL_PRIOR)
    assert case != "sensor of a rig" or 0 < problem.structure.plane_in_world.sum() < problem.structure.num_planes
    return problem


def on_one_plane(problem: Problem, normal: Array, offset: float) -> Problem:
    """All planes are `normal . x = offset` of the world."""
    structure, state = problem.structure, problem.state
    rotation, translation = state.cam_from_world(structure)
    normals, distances = state.normal.copy(), state.distance.copy()
    for b, in_world in enumerate(structure.plane_in_world):
        i = int(np.flatnonzero(structure.image_plane == b)[0])
        if in_world:
            normals[b], distances[b] = normal, offset - normal @ structure.plane_anchor[b]
        else:
            normals[b], distances[b] = plane_in_cam(normal, offset, rotation[i], translation[i])
    return replace(problem, state=replace(state, normal=normals, distance=distances))


def at_start(problem: Problem, block: PriorBlock) -> Array:
    widths = {POSE: 6, PLANE: 3, LEVEL: 3}
    return block.evaluate([np.zeros(widths.get(slot, problem.num_waves)) for slot, _ in block.keys])[0]


@level_cases
def test_one_plane_is_level_in_itself(case: str) -> None:
    normal = unit([0.1, -0.05, 1.0])
    problem = on_one_plane(level_problem(case), normal, 1.1)
    blocks = prior_blocks(problem)
    assert len(blocks) == problem.structure.num_planes
    for block in blocks:
        np.testing.assert_allclose(at_start(problem, block), 0, atol=1e-12)
    level = mean_plane(problem.structure, problem.state)
    np.testing.assert_allclose(level.normal, normal, atol=1e-14)
    assert level.distance + normal @ level.anchor == pytest.approx(1.1, abs=1e-13)
    # The planes as they were are not.
    assert all(np.linalg.norm(at_start(p, b)) > 0.1 for p in [level_problem(case)] for b in prior_blocks(p))


@level_cases
def test_deviations_are_slopes_and_relative_heights(case: str) -> None:
    """Over a level plane that is known: a plane tilted by so many radians, another that is so much lower."""
    normal, tilt, lift = unit([0.1, -0.05, 1.0]), 0.03, 0.2
    problem = on_one_plane(level_problem(case), normal, 1.1)
    structure, state = problem.structure, problem.state
    level = LevelPlane(normal=normal, distance=1.1 - normal @ np.ones(3), anchor=np.ones(3))
    np.testing.assert_allclose(deviations(structure, state, level), 0, atol=1e-12)
    turn = exp_and_left_jacobian(tilt * tangent_basis(normal)[:, 0])[0]
    tilted = deviations(structure, on_one_plane(problem, turn @ normal, 1.1).state, level)
    # Chord, sine and tangent of the angle are alike to first order, which is what a prior needs.
    assert np.linalg.norm(tilted[:, :-1], axis=1) == pytest.approx(tilt, rel=1e-3)
    lowered = deviations(structure, on_one_plane(problem, normal, 1.1 + lift).state, level)
    np.testing.assert_allclose(lowered[:, :-1], 0, atol=1e-12)
    rotation, translation = state.cam_from_world(structure)
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    for b, found in enumerate(lowered[:, -1]):
        depth = 1.1 - centers[structure.image_plane == b] @ normal
        assert np.isclose(found, np.log((depth + lift) / depth), atol=1e-12).any()


def in_another_world(problem: Problem, turn: Array, shift: Array, size: float) -> Problem:
    """Turned, scaled and shifted: poses, planes, anchors and baselines."""
    structure, state = problem.structure, problem.state
    rotation = state.rotation @ turn.T
    return replace(
        problem,
        structure=replace(
            structure,
            sensor_translation=size * structure.sensor_translation,
            plane_anchor=size * structure.plane_anchor @ turn.T + shift,
        ),
        state=replace(
            state, rotation=rotation, translation=size * state.translation - np.einsum("nij,j->ni", rotation, shift),
            normal=np.where(structure.plane_in_world[:, None], state.normal @ turn.T, state.normal),
            distance=size * state.distance,
        ),
    )  # fmt: skip


def slope_and_lift(residual: Array) -> tuple[float, float]:
    return float(np.linalg.norm(residual[:-1])), float(np.abs(residual[-1]))


@level_cases
def test_the_level_prior_does_not_care_where_the_world_is(case: str) -> None:
    problem = level_problem(case)
    expected = np.array([slope_and_lift(at_start(problem, block)) for block in prior_blocks(problem)])
    assert expected[:, 0].min() > 0.1 and expected[:, 1].max() > 0.1
    turn = exp_and_left_jacobian(np.array([0.5, -1.0, 0.7]))[0]
    for size in (1e-3, 1.0, 50.0):
        moved = in_another_world(problem, turn, np.array([30.0, -2.0, 7.0]), size)
        found = [slope_and_lift(at_start(moved, block)) for block in prior_blocks(moved)]
        # Centres 30 away from the origin are known to 1e-14 of it, which is 1e-11 of a scene of 1e-3.
        np.testing.assert_allclose(found, expected, rtol=1e-8)


@level_cases
@pytest.mark.parametrize("size", [1.0, 1.3])
def test_the_level_prior_does_not_hold_the_world(case: str, size: float) -> None:
    """Nor where a solver takes it: no keypoint minds a turn, a shift and another size of all, nor may a prior gain."""
    problem = level_problem(case)
    if problem.structure.sensor_translation.any():
        size = 1.0  # a rig's baseline tells it
    structure, state = problem.structure, problem.state
    turn, shift = exp_and_left_jacobian(np.array([0.3, -0.5, 0.2]))[0], np.array([0.4, -0.2, 0.3])
    moved = in_another_world(problem, turn, shift, size).state
    level = mean_plane(structure, state)

    def world_plane(normal: Array, distance: float, anchor: Array) -> Array:
        """The change (3,) that takes a plane to where the world goes, at an anchor that stays."""
        turned = turn @ normal
        offset = size * (distance + normal @ anchor) + turned @ shift
        return np.append(tangent_basis(normal).T @ turned / (normal @ turned), offset - turned @ anchor - distance)

    def value(slot: int, b: int) -> Array:
        if slot == LEVEL:
            return world_plane(level.normal, level.distance, level.anchor)
        if slot == PLANE:
            if structure.plane_in_world[b]:
                return world_plane(state.normal[b], state.distance[b], structure.plane_anchor[b])
            return np.array([0.0, 0.0, (size - 1) * state.distance[b]])
        own = moved.rotation[b] @ state.rotation[b].T
        return np.append(Rotation.from_matrix(own).as_rotvec(), moved.translation[b] - own @ state.translation[b])

    for block in prior_blocks(problem):
        found = block.evaluate([value(*key) for key in block.keys])[0]
        np.testing.assert_allclose(
            slope_and_lift(found), slope_and_lift(at_start(problem, block)), rtol=1e-9, atol=1e-12
        )


@level_cases
@pytest.mark.parametrize("hold_poses", [False, True])
@pytest.mark.parametrize("size", [0.0, 0.1])
def test_derivatives_of_the_level_prior(case: str, hold_poses: bool, size: float) -> None:
    problem = level_problem(case)
    if hold_poses:
        problem = replace(problem, held=replace(problem.held, poses=np.ones_like(problem.held.poses)))
    rng = np.random.default_rng(8)
    blocks = prior_blocks(problem)
    planes = range(problem.structure.num_planes)
    assert [block.keys[-2:] for block in blocks] == [[(PLANE, b), (LEVEL, 0)] for b in planes]
    for block in blocks:
        assert (block.keys[0][0] == POSE) == (not hold_poses)
        values = [size * rng.normal(size=6 if slot == POSE else 3) for slot, _ in block.keys]
        residual, by_blocks = block.evaluate(values)
        assert residual.shape == (block.num_residuals,)
        found = np.hstack(by_blocks)
        difference = [
            (block.evaluate(ahead)[0] - block.evaluate(behind)[0]) / (2 * STEP) for ahead, behind in steps(values)
        ]
        np.testing.assert_allclose(found, np.stack(difference, axis=1), atol=TOLERANCE * np.abs(found).max())
        # A plane of the world does not turn with its camera, which only says where heights are compared.
        assert all(
            np.abs(part).max() > (1e-3 if slot == POSE else 1)
            for (slot, _), part in zip(block.keys, by_blocks, strict=True)
        )


def test_the_level_prior_weighs_by_its_deviations() -> None:
    problem = level_problem("moving")
    (first, *_), level = prior_blocks(problem), mean_plane(problem.structure, problem.state)
    raw = deviations(problem.structure, problem.state, level)[0]
    slope, lift = slope_and_lift(raw)
    assert slope_and_lift(at_start(problem, first)) == pytest.approx((0.5 * slope / 0.02, 0.5 * lift / 0.05), rel=1e-12)
    # What is held has nothing to be told.
    held = replace(problem.held, normals=np.ones(4, bool), distances=np.array([True, True, False, False]))
    assert [b.keys[-2] for b in prior_blocks(replace(problem, held=held))] == [(PLANE, 2), (PLANE, 3)]
    assert prior_blocks(replace(problem, level_prior=None)) == []


def test_a_camera_under_the_level_plane_is_refused() -> None:
    problem = level_problem("moving")
    pose, plane = np.zeros(6), np.zeros(3)
    standing = plane_stands(problem.structure, problem.state, 0, 0, pose, plane)
    above = LevelPlane(normal=np.array([0.0, 0.0, 1.0]), distance=0.1, anchor=standing.center - [0, 0, 1.0])
    with np.errstate(invalid="ignore", divide="ignore"):
        assert np.isnan(compare_to_level(standing, above, np.zeros(3))[0][-1])


def two_scenarios() -> tuple[Problem, Problem]:
    """The same keypoints through one plane of the world, and through a plane of each image's own."""
    static = make_problem("static_interface", num_points=60, noise=0.3)
    structure, state = static.structure, static.state
    normal, distance = state.planes_in_cam(structure)
    moving = replace(
        static,
        structure=replace(
            structure, image_plane=np.arange(4), plane_in_world=np.zeros(4, bool), plane_anchor=np.zeros((4, 3))
        ),
        state=replace(state, normal=normal, distance=distance),
    )
    return static, replace(moving, held=Held.nothing(moving.state))


def shape_of(points: Array) -> Array:
    """Distances between points, in units of their mean."""
    return pdist(points) / pdist(points).mean()


def test_the_level_prior_is_between_one_plane_and_free_ones() -> None:
    one, free = two_scenarios()
    settings = SolverSettings(function_tolerance=1e-11)
    static, moving = adjust(one, settings), adjust(free, settings)
    assert static.termination == moving.termination == "convergence"
    gain = static.cost - moving.cost
    # Nine unknowns more, each of which takes half a squared standard deviation away on average.
    assert gain > 0.1 * 9 / 2 * 0.3**2
    between, points = [], []
    for spread in (1e-5, 3e-3, 1e-1, 1e4):
        found = adjust(replace(free, level_prior=LevelPrior(tilt=spread, lift=spread, noise=0.3)), settings)
        # In a few steps: a prior that is not indifferent to where the world is would have it drift.
        assert found.termination == "convergence" and found.num_iterations < 50
        between.append((static.cost - found.cost) / gain)
        points.append(found.points)
    # From all that one plane costs to nothing. The prior's own cost is in it.
    assert between[0] == pytest.approx(0, abs=1e-3) and between[-1] == pytest.approx(1, abs=1e-3)
    assert (np.diff(between) > 0.01).all()
    differ = np.abs(shape_of(static.points) - shape_of(moving.points)).max()
    assert np.abs(shape_of(points[0]) - shape_of(static.points)).max() < 0.01 * differ
    assert np.abs(shape_of(points[-1]) - shape_of(moving.points)).max() < 0.01 * differ


@level_cases
@pytest.mark.parametrize("spread", [0.01, 0.1])
def test_the_level_prior_is_solved(case: str, spread: float) -> None:
    problem = level_problem(case, num_points=60, noise=0.3)
    prior = LevelPrior(tilt=spread, lift=spread, noise=0.3)
    settings = SolverSettings(max_num_iterations=60, function_tolerance=1e-10)
    free, found = (adjust(replace(problem, level_prior=each), settings) for each in (None, prior))
    assert found.termination == "convergence"
    # A minimum of the sum: more than the keypoints alone want, less than that with the prior on top.
    solved = replace(problem, level_prior=prior, state=free.state)
    on_top = sum(0.5 * np.sum(at_start(solved, block) ** 2) for block in prior_blocks(solved))
    assert free.cost < found.cost < free.cost + on_top
    # Nothing runs away: cameras stand where they stood, but for what a few pixels are worth.
    centers = [-np.einsum("nji,nj->ni", s.rotation, s.translation) for s in (problem.state, found.state)]
    assert np.abs(centers[1] - centers[0]).max() < 0.2


def wave_prior_problem(strength: float) -> Problem:
    """Known poses and one plane, and waves that are known to be of unit size but for two that are tied together."""
    problem = with_waves(make_problem("static_interface", num_points=60, noise=0.3), 3, slope=0.01)
    factor = np.tile(0.3 * np.array([[1.0, 0, 0], [0, 1, 1], [0, 0, 2], [1, 1, 0]]), (4, 1, 1))
    factor *= np.array([1, 2, 1, 0.5])[:, None, None]
    held = replace(problem.held, poses=np.ones(4, bool))
    return replace(problem, wave_prior=strength * factor, held=held)


def penalty(problem: Problem, state: State) -> float:
    assert problem.wave_prior is not None
    return float(np.sum(np.einsum("imk,ik->im", problem.wave_prior, state.waves) ** 2))


def test_the_wave_prior_adds_its_squares_to_the_cost() -> None:
    problem = wave_prior_problem(1.0)
    found = adjust(problem, SolverSettings(function_tolerance=1e-13))
    assert found.termination == "convergence"
    solved = replace(problem, state=found.state)
    e = residuals(solved, Change.zero(found.state), found.points)
    keypoints, prior = 0.5 * np.sum(e**2), 0.5 * penalty(problem, found.state)
    # But for what one more step of each point would gain.
    assert found.cost == pytest.approx(keypoints + prior, rel=1e-7)
    assert min(keypoints, prior) > 0.01 * found.cost
    without = adjust(replace(problem, wave_prior=None), SolverSettings(max_num_iterations=1))
    assert found.initial_cost == pytest.approx(without.initial_cost + 0.5 * penalty(problem, problem.state), rel=1e-9)
    # It is the minimum: no step along any coefficient lowers the sum.
    chunk = whole(solved)
    _, gradient, matrix = reduced(chunk, some_parameters(chunk, 0.0))
    for i in range(4):
        columns = chunk.first_column[WAVES, i] + np.arange(3)
        assert problem.wave_prior is not None
        factor = problem.wave_prior[i]
        total = gradient[columns] + factor.T @ factor @ found.state.waves[i]
        size = np.sqrt(matrix.diagonal()[columns] + np.sum(factor**2, axis=0))
        assert np.abs(total / size).max() < 1e-3 < np.abs(gradient[columns] / size).max()


def test_a_stronger_prior_leaves_smaller_waves() -> None:
    found = [adjust(wave_prior_problem(s), SolverSettings(function_tolerance=1e-12)) for s in (0.1, 1.0, 10.0, 1e3)]
    sizes = [penalty(wave_prior_problem(1.0), each.state) for each in found]
    assert (np.diff(sizes) < 0).all() and sizes[-1] < 1e-3 * sizes[0]
    flat = wave_prior_problem(1.0)
    flat = replace(flat, state=waveless(flat.state), held=replace(flat.held, waves=True))
    assert found[-1].cost == pytest.approx(adjust(flat, SolverSettings()).cost, rel=1e-2)


def test_waves_have_a_prior_where_they_are_free_and_seen() -> None:
    problem = with_waves(make_problem("static_interface", dry_image=True), 3)
    prior = np.random.default_rng(9).normal(size=(4, 2, 3))
    blocks = prior_blocks(replace(problem, wave_prior=prior))
    assert [block.keys for block in blocks] == [[(WAVES, i)] for i in range(3)]
    for i, block in enumerate(blocks):
        value = np.array([0.1, -0.2, 0.3])
        residual, (derivative,) = block.evaluate([value])
        np.testing.assert_allclose(residual, prior[i] @ (problem.state.waves[i] + value))
        np.testing.assert_array_equal(derivative, prior[i])
        assert block.num_residuals == 2
    held = replace(problem, wave_prior=prior, held=replace(problem.held, waves=True))
    assert prior_blocks(held) == []


@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface"])
def test_a_relief_is_waves_that_are_held(scenario: Scenario) -> None:
    """The same residuals, and the same system for all that is left, whichever way the surface is given."""
    problem = with_waves(make_problem(scenario), 3, slope=0.02)
    problem = replace(problem, held=replace(problem.held, waves=True))
    tracks = problem.tracks
    relief = np.einsum("nak,nk->na", tracks.waves, problem.state.waves[tracks.image])
    assert np.abs(relief[:, 1:]).max() > 0.005
    bent = replace(problem, tracks=tracks._replace(waves=np.zeros((0, 3, 0)), relief=relief))
    np.testing.assert_allclose(kernel_residuals(bent), kernel_residuals(problem), atol=1e-10)
    for ours, theirs in zip(
        local_planes(bent.tracks, bent.structure, bent.state),
        local_planes(tracks, problem.structure, problem.state),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-14)
    ours, theirs = (reduced(whole(each), some_parameters(whole(each), 0.0)) for each in (bent, problem))
    for a, b in zip(ours, theirs, strict=True):
        a, b = (np.triu(each) if np.ndim(each) == 2 else each for each in (a, b))
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
