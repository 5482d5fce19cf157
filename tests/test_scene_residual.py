"""Distances in the scene, `D_ij`, in the compiled kernel, and what they give with a normal for every observation.

Residuals are compared with rays bent by Snell's angles, gradients and matrices with finite differences of them, and
minima with `adjust_as_printed`, which has tests of its own.

What this does not show: that such a minimum is near the truth. Distances shrink with the scene, and the paper's soft
constraint leaves an image's mean slope free: with a few images and all poses free, waves of 1.5 degrees already lead to
minima far off, and which one depends on the path of the solver. They are compared where there is one minimum.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from conftest import error_of
from dense_reference import (
    FOCAL_LENGTH,
    STEP,
    TANK,
    Key,
    assert_same_system,
    change_of,
    local_planes,
    make_problem,
    reduced,
    robust_weights,
    settled,
    some_parameters,
    steps,
    unit,
    whole,
)
from test_reference import bent, is_first, lengths_of, on_rays
from test_wave_estimator import with_waves

from colmap_refract.estimator import elimination
from colmap_refract.estimator.adjustment import SolverSettings, adjust
from colmap_refract.estimator.chunk import Held, Problem, robust_cost
from colmap_refract.estimator.own_slopes import with_own_slopes
from colmap_refract.estimator.printed_terms import pixel_weights
from colmap_refract.estimator.printed_unknowns import anchored, blocks_at_start, pair, points_in_reference
from colmap_refract.estimator.reference_rays import ReferenceRays, on_reference_rays, with_distances_in_scene
from colmap_refract.estimator.scenario import SCENARIOS, State, apply
from colmap_refract.estimator.soft_as_printed import adjust_as_printed
from colmap_refract.interface import Array, Layers, plane_in_world
from colmap_refract.options import ImageNotes, Loss, RefinerOptions, Scenario
from colmap_refract.refiner.arrangement import arrange
from colmap_refract.refiner.observations import read_observations
from colmap_refract.simulation import SceneOptions, simulate

REFERENCE = 2


def in_scene(problem: Problem, seed: int = 5) -> Problem:
    """Distances along an axis that is no camera's, weights that differ and are not orthogonal to it."""
    rng = np.random.default_rng(seed)
    scene = rng.normal(size=(len(problem.tracks.image), 3, 3))
    # Of such a size that distances are about as many as pixels.
    scene[:, :2] *= FOCAL_LENGTH / 2.5
    scene[:, 2] = unit([0.2, -0.1, 1.0])
    return replace(problem, tracks=problem.tracks._replace(scene=scene))


def distances(problem: Problem, state: State, points: Array) -> Array:
    """Weighted `D_ij` (N, 2) of points (P, 3)."""
    tracks = problem.tracks
    rotation, translation = (part[tracks.image] for part in state.cam_from_world(problem.structure))
    normal, distance = local_planes(problem, state)
    u, wet = tracks.direction, tracks.wet
    place, ray = np.zeros_like(u), u.copy()
    place[wet] = (distance[wet] / (u * normal).sum(axis=1)[wet])[:, None] * u[wet]
    ray[wet] = bent(u[wet], normal[wet], state.index)
    place = np.einsum("nji,nj->ni", rotation, place - translation)
    ray = np.einsum("nji,nj->ni", rotation, ray)
    axis = tracks.scene[:, 2]
    gap = np.repeat(points, np.diff(tracks.start), axis=0) - place
    gap -= ((gap * axis).sum(axis=1) / (ray * axis).sum(axis=1))[:, None] * ray
    return np.einsum("nij,nj->ni", tracks.scene[:, :2], gap)


def by_cameras(problem: Problem, keys: list[Key], parameters: list[Array], points: Array) -> Array:
    """(2N, m) by finite differences."""

    def at(values: list[Array]) -> Array:
        return distances(problem, apply(problem.state, change_of(problem, keys, values)), points).ravel()

    return np.stack([(at(ahead) - at(behind)) / (2 * STEP) for ahead, behind in steps(parameters)], axis=1)


def by_points(problem: Problem, state: State, points: Array, axes: Array) -> Array:
    """(N, 2, 3) by motions of the points along axes (3, P, 3)."""
    both = [[distances(problem, state, points + sign * STEP * axis) for sign in (1, -1)] for axis in axes]
    return np.stack([(ahead - behind) / (2 * STEP) for ahead, behind in both], axis=2)


CASES: dict[str, dict[str, Any]] = {
    **{scenario: {"scenario": scenario, "dry_image": True} for scenario in SCENARIOS},
    "two sensors in a tank": {"scenario": "static_interface", "sensors": 2},
    "groups": {"groups": True, "sensors": 2},
    "index": {"scenario": "static_interface", "index": True},
    "out of the water": {"layers": Layers(index=(1 / 1.333,)), "index": True},
}
cases = pytest.mark.parametrize("case", CASES)
waves = pytest.mark.parametrize("waves", [0, 3])


def some_problem(case: str, waves: int, loss: Loss = "trivial") -> Problem:
    problem = make_problem(**CASES[case], loss=loss)
    problem = with_waves(problem, waves) if waves else problem
    # Keypoints of a metric's plane are not quite unit vectors.
    return in_scene(replace(problem, tracks=problem.tracks._replace(direction=unit(problem.tracks.direction))))


@cases
@waves
@pytest.mark.parametrize("size", [0.0, 0.02])
def test_distances_and_their_derivatives_at_known_points(case: str, waves: int, size: float) -> None:
    problem = some_problem(case, waves)
    problem = replace(problem, held=replace(problem.held, points=True))
    chunk = whole(problem)
    parameters = some_parameters(chunk, size)
    cost, gradient, matrix = reduced(chunk, parameters)
    state = apply(problem.state, change_of(problem, chunk.keys, parameters))
    r = distances(problem, state, problem.points).ravel()
    evaluated = chunk.views(parameters)
    assert evaluated is not None
    out = np.empty((len(problem.tracks.image), 2))
    elimination.residuals(problem.points, chunk.tracks, *evaluated, out)
    np.testing.assert_allclose(out.ravel(), r, atol=1e-10 * np.abs(r).max())
    assert cost == pytest.approx(0.5 * r @ r, rel=1e-12) and np.linalg.norm(r) > 1
    j = by_cameras(problem, chunk.keys, parameters, problem.points)
    norms = np.linalg.norm(j, axis=0)
    assert_same_system(gradient, matrix, j.T @ r, j.T @ j, norms, float(np.linalg.norm(r)))


@cases
@waves
@pytest.mark.parametrize("bound", [False, True])
def test_what_eliminated_points_leave(case: str, waves: int, bound: bool) -> None:
    """Of free points, and of points on a reference's rays, by explicit lengths."""
    problem = some_problem(case, waves, loss="soft_l1")
    problem = on_reference_rays(problem, REFERENCE, min_num_points=3).problem if bound else problem
    chunk = whole(problem)
    parameters = some_parameters(chunk, 0.003)
    points, cost = settled(chunk, parameters)
    state = apply(problem.state, change_of(problem, chunk.keys, parameters))
    counted = np.repeat(~is_first(problem) if bound else np.ones(len(problem.tracks.image), bool), 2)
    r = distances(problem, state, points)
    squared = (r**2).sum(axis=1)[counted[::2]]
    assert squared.max() > 1
    expected = 0.5 * robust_cost(squared, problem.loss, problem.loss_scale).sum()
    assert cost == pytest.approx(expected, rel=1e-6)

    root = robust_weights(problem, r) * counted
    if bound:
        lengths = lengths_of(problem, state, points)
        axes = (on_rays(problem, state, lengths + 1) - points)[None]

        def at(values: list[Array]) -> Array:
            moved = apply(problem.state, change_of(problem, chunk.keys, values))
            return distances(problem, moved, on_rays(problem, moved, lengths)).ravel()

        both = [(at(ahead) - at(behind)) / (2 * STEP) for ahead, behind in steps(parameters)]
        cameras = np.stack(both, axis=1)
    else:
        axes = np.eye(3)[:, None].repeat(len(points), axis=1)
        cameras = by_cameras(problem, chunk.keys, parameters, points)
    own = by_points(problem, state, points, axes)
    point = np.repeat(np.arange(len(points)), np.diff(problem.tracks.start))
    every = np.zeros((len(point), 2, len(points), len(axes)))
    every[np.arange(len(point)), :, point] = own
    cameras, every, e = root[:, None] * cameras, root[:, None] * every.reshape(len(root), -1), root * r.ravel()
    solved = np.linalg.lstsq(every, np.column_stack([cameras, e]), rcond=None)[0]
    free, left = cameras - every @ solved[:, :-1], e - every @ solved[:, -1]
    _, gradient, matrix = reduced(chunk, parameters)
    norms = np.linalg.norm(cameras, axis=0)
    seen = norms > 1e-9 * norms.max()
    assert seen.sum() > 10
    block = np.ix_(seen, seen)
    assert_same_system(
        gradient[seen], matrix[block], (cameras.T @ left)[seen], (cameras.T @ free)[block], norms[seen],
        float(np.linalg.norm(e)),
    )  # fmt: skip


@pytest.mark.parametrize("waves", [0, 3])
def test_points_where_they_are_seen_have_no_distance(waves: int) -> None:
    problem = make_problem("static_interface", noise=0.0, dry_image=True)
    problem = in_scene(with_waves(problem, waves) if waves else problem)
    chunk = whole(replace(problem, held=replace(problem.held, points=True)))
    zero = some_parameters(chunk, 0.0)
    assert settled(chunk, zero)[1] < 1e-15
    off = [value.copy() for value in zero]
    off[0] += 1e-3
    assert settled(chunk, off)[1] > 0.1


def test_a_ray_that_does_not_exist_is_refused() -> None:
    """Total reflection where a camera under water looks out, and a ray across the axis: Ceres then steps less far."""
    problem = in_scene(make_problem("moving_interface", layers=Layers(index=(1 / 1.333,))))
    fine = whole(problem)
    zero = some_parameters(fine, 0.0)
    assert fine.settle(zero, None) is not None
    direction, scene = problem.tracks.direction.copy(), problem.tracks.scene.copy()
    k = int(np.flatnonzero(problem.tracks.wet)[3])
    direction[k] = unit([1.0, 0.0, 0.3])
    reflected = whole(replace(problem, tracks=problem.tracks._replace(direction=direction)))
    assert reflected.settle(zero, None) is None and reflected.reduce(zero, None) is None
    dry = problem.tracks.wet.copy()
    dry[k] = False
    rotation, _ = problem.state.cam_from_world(problem.structure)
    ray = rotation[problem.tracks.image[k]].T @ problem.tracks.direction[k]
    scene[k, 2] = unit(np.cross(ray, [0.3, 0.2, 0.9]))
    across = whole(replace(problem, tracks=problem.tracks._replace(scene=scene, wet=dry)))
    assert across.settle(zero, None) is None


def bound(problem: Problem) -> ReferenceRays:
    return on_reference_rays(problem, REFERENCE, min_num_points=3)


def test_what_holds_the_size_is_held() -> None:
    problem = make_problem("static_interface", sensors=2, num_points=30)
    rays = bound(problem)
    scene = with_distances_in_scene(rays)
    axes = problem.state.cam_from_world(problem.structure)[0][REFERENCE]
    assert (scene.tracks.scene == axes).all()
    result = adjust(scene, SolverSettings(max_num_iterations=20))
    assert result.cost < 0.95 * result.initial_cost
    before, after = scene.state, result.state
    pose = problem.structure.image_pose[REFERENCE]
    moved = np.abs(after.rotation - before.rotation).max(axis=(1, 2))
    assert moved[pose] == 0 and (np.delete(moved, pose) > 1e-9).all()
    # The plane is the world's, and turns, but not nearer to the reference; its anchor may be another.
    old, new = (s.planes_in_cam(t) for s, t in ((problem.state, problem.structure), (after, scene.structure)))
    assert new[1][REFERENCE] == pytest.approx(old[1][REFERENCE], rel=1e-12)
    assert np.abs(new[0] - old[0]).max() > 1e-6 and np.abs(new[1] - old[1]).max() > 1e-6
    # Twice the weight, four times the cost.
    twice = with_distances_in_scene(rays, np.tile(2 * np.eye(2), (len(rays.rows), 1, 1)))
    costs = [settled(whole(p), some_parameters(whole(p), 0.0))[1] for p in (scene, twice)]
    assert costs[1] == pytest.approx(4 * costs[0], rel=1e-6)


def test_what_cannot_be_is_told() -> None:
    walls = bound(make_problem("static_interface", layers=TANK))
    assert "walls" in error_of(lambda: with_distances_in_scene(walls))
    assert "walls" in error_of(lambda: own(walls.problem))
    lens = bound(make_problem("static_interface", lens=1))
    assert "intrinsics" in error_of(lambda: with_distances_in_scene(lens))
    dry = on_reference_rays(make_problem("moving_interface", dry_image=True), 3, min_num_points=3)
    assert "no interface" in error_of(lambda: with_distances_in_scene(dry))
    for smoothness in (-1.0, np.nan, np.inf):
        assert "smoothness" in error_of(lambda smoothness=smoothness: own(dry.problem, smoothness))


def own(problem: Problem, smoothness: float = 1.0, radius: float = 300.0) -> Problem:
    keypoints = FOCAL_LENGTH * problem.tracks.direction[:, :2] / problem.tracks.direction[:, 2:]
    return with_own_slopes(problem, keypoints, smoothness=smoothness, radius=radius)


def test_own_slopes_are_the_normals_of_the_double_sum() -> None:
    """The prior is the paper's regulariser, up to the third order in the slopes; surfaces have no height."""
    problem = make_problem("moving_interface", num_points=30, dry_image=True)
    smoothness, radius = 3.0, 150.0
    slopes = own(problem, smoothness, radius)
    tracks = slopes.tracks
    rng = np.random.default_rng(0)
    level = local_planes(slopes, slopes.state)[0]
    ratios = []
    for size in (1e-2, 1e-3):
        state = replace(slopes.state, waves=size * rng.normal(size=slopes.state.waves.shape))
        normal, distance = local_planes(slopes, state)
        assert np.degrees(np.arccos((normal * level).sum(axis=1)[tracks.wet])).min() > 0
        reach = distance / (normal * tracks.direction).sum(axis=1)
        plane = problem.state.planes_in_cam(problem.structure)
        flat = plane[1][tracks.image] / (plane[0][tracks.image] * tracks.direction).sum(axis=1)
        np.testing.assert_allclose(reach[tracks.wet], flat[tracks.wet], rtol=1e-12)
        total = 0.0
        keypoints = FOCAL_LENGTH * tracks.direction[:, :2] / tracks.direction[:, 2:]
        for i in range(problem.structure.num_images):
            mine = np.flatnonzero((tracks.image == i) & tracks.wet)
            for k in mine:
                near = mine[np.linalg.norm(keypoints[mine] - keypoints[k], axis=1) <= radius]
                assert 1 <= len(near) < len(mine)
                total += ((normal[near] - normal[near].mean(axis=0)) ** 2).sum()
        assert slopes.wave_prior is not None
        prior = np.einsum("nij,nj->ni", slopes.wave_prior, state.waves)
        ratios.append(abs((prior**2).sum() / (smoothness * total) - 1))
    assert ratios[0] < 1e-3 and ratios[1] < 1e-5


def through_waves(scenario: Scenario, slope_deg: float) -> tuple[Problem, Array]:
    """Six images of a wavy surface, started at their true poses, mean planes and points; keypoints (N, 2) px."""
    capture = simulate(
        SceneOptions(
            scenario=scenario, num_images=6, num_points=40, pixel_noise=0.3, wave_slope_deg=slope_deg,
            wavelength=(0.8, 1.5),
        )
    )  # fmt: skip
    read = read_observations(capture.reconstruction)
    arrangement = arrange(read, RefinerOptions(scenario=scenario), ImageNotes())
    observations, structure = arrangement.observations, arrangement.structure
    problem = arrangement.start(0.4, observations)
    rotation, translation = problem.state.cam_from_world(structure)
    normal, distance = problem.state.normal.copy(), problem.state.distance.copy()
    for i, image_id in enumerate(observations.image_ids.tolist()):
        block, plane = structure.image_plane[i], capture.planes[image_id]
        plane = plane[0], plane[1] / arrangement.unit
        if structure.plane_in_world[block]:
            n, offset = plane_in_world(*plane, rotation[i], translation[i])
            plane = n, offset - n @ structure.plane_anchor[block]
        normal[block], distance[block] = plane
    state = replace(problem.state, normal=normal, distance=distance)
    points = (read.points - arrangement.origin) / arrangement.unit
    return replace(problem, state=state, points=points, held=Held.nothing(state)), observations.pixel


def weights_of(problem: Problem, rays: ReferenceRays) -> Array:
    """Pixels by distance, as `adjust_as_printed` takes them at its start, for the rows of the rays."""
    problem = anchored(problem, REFERENCE)
    pairing = pair(problem, REFERENCE)
    points = points_in_reference(problem, problem.state, pairing, blocks_at_start(problem, pairing))
    weights = np.zeros((len(problem.tracks.image), 2, 2))
    weights[pairing.others] = pixel_weights(problem, pairing, points)
    return weights[rays.rows]


@pytest.mark.parametrize(
    ("scenario", "slope_deg", "held", "residual", "smoothness"),
    [
        ("moving_interface", 1.5, True, "scene", 0.01),
        ("static_interface", 1.5, True, "pixels", 1e5),
        ("moving_interface", 0.2, False, "scene", 0.01),
        ("static_interface", 0.2, False, "scene", 0.1),
    ],
)
def test_the_minimum_is_that_of_the_soft_constraint_as_printed(
    scenario: Scenario, slope_deg: float, held: bool, residual: Literal["scene", "pixels"], smoothness: float
) -> None:
    """Poses and planes held where waves are such that free ones run away (see the module's docstring)."""
    problem, keypoints = through_waves(scenario, slope_deg)
    if held:
        everything = Held(
            **{name: np.ones_like(getattr(problem.held, name)) for name in ("poses", "normals", "distances")}
        )
        problem = replace(problem, held=everything)
    settings = SolverSettings(max_num_iterations=400, function_tolerance=1e-12, parameter_tolerance=1e-12)
    printed = adjust_as_printed(
        problem, keypoints, reference=REFERENCE, smoothness=smoothness, radius=300.0, residual=residual,
        settings=settings,
    )  # fmt: skip
    rays = bound(problem)
    scene = with_distances_in_scene(rays, weights_of(problem, rays) if residual == "pixels" else None)
    slopes = with_own_slopes(scene, keypoints[rays.rows], smoothness=smoothness, radius=300.0)
    result = adjust(slopes, settings)
    assert printed.termination == result.termination == "convergence"
    assert np.flatnonzero(np.isfinite(printed.points[:, 0])).tolist() == rays.points.tolist()
    assert len(rays.points) > 30
    # The two differ by the third order in the slopes, which reach a tenth.
    assert result.cost == pytest.approx(printed.cost, rel=1e-2)
    flat = adjust(scene, settings)
    assert flat.cost > 1.5 * result.cost or not held
    prior = np.einsum("nij,nj->ni", slopes.wave_prior, result.state.waves)
    assert 0.5 * (prior**2).sum() == pytest.approx(printed.smoothness_cost, rel=0.15)
    assert printed.smoothness_cost > 0.02 * printed.cost

    def size(difference: Array) -> float:
        return float(np.sqrt((difference**2).sum(axis=1).mean()))

    points = printed.points[rays.points]
    assert size(result.points - points) < 0.08 * size(points - problem.points[rays.points])
    normal, _ = local_planes(slopes, result.state)
    level, _ = problem.state.planes_in_cam(problem.structure)
    tilt = size(printed.normals[rays.rows] - level[slopes.tracks.image])
    assert size(normal - printed.normals[rays.rows]) < 0.08 * tilt and tilt > 0.003
