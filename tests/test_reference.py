"""A reference image's hard constraint, against the paper's formulas with one explicit length `d_j` per point.

The reference below bends rays by Snell's angles layer by layer, sees points along the least optical path, and
differentiates by finite differences. It shares `State` and `Structure` with the code, which have tests of their own.

What this does not show: that a reference is better or worse than none. That is for experiments.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import error_of
from dense_reference import (
    STEP,
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
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from test_elimination import CASES
from test_wave_estimator import with_waves

from colmap_refract.estimator.adjustment import SolverSettings, adjust, settle_points
from colmap_refract.estimator.chunk import Held, Problem, robust_cost
from colmap_refract.estimator.elimination import Anchors
from colmap_refract.estimator.reference_rays import (
    ReferenceRays,
    num_points_seen,
    on_reference_rays,
    with_other_points,
)
from colmap_refract.estimator.scenario import SCENARIOS, Change, State, apply
from colmap_refract.interface import Array, Layers
from colmap_refract.options import Loss, Scenario
from colmap_refract.simulation import least_path_direction

REFERENCE = 1
FINE = SolverSettings(max_num_iterations=200, function_tolerance=1e-15, parameter_tolerance=1e-13)


def bound(problem: Problem, reference: int = REFERENCE) -> ReferenceRays:
    return on_reference_rays(problem, reference, min_num_points=3)


def is_first(problem: Problem) -> Array:
    """(N,) whether an observation is the first of its point."""
    first = np.zeros(len(problem.tracks.image), dtype=bool)
    first[problem.tracks.start[:-1]] = True
    return first


def bent(u: Array, normal: Array, ratio: float) -> Array:
    """Snell's law by angles, (n, 3)."""
    across = u - (u * normal).sum(axis=1, keepdims=True) * normal
    sine = np.linalg.norm(across, axis=1, keepdims=True)
    behind = np.arcsin(sine / ratio)
    return np.asarray(np.cos(behind) * normal + np.sin(behind) * across / sine)


def on_rays(problem: Problem, state: State, lengths: Array) -> Array:
    """`P_j` (P, 3) in the world: lengths behind the interface along the rays of the first observations."""
    tracks, k = problem.tracks, np.flatnonzero(is_first(problem))
    image = tracks.image[k]
    # The unit direction that is without error, given what intrinsics and waves move.
    wanted = np.einsum("nij,nj->ni", tracks.metric, tracks.direction)[k] - shifts(problem, state)[k]
    seen = np.stack([np.linalg.pinv(m) @ e for m, e in zip(tracks.metric[k], wanted, strict=True)])
    unseen = np.linalg.svd(tracks.metric[k])[2][:, 2]
    unseen *= np.sign((unseen * tracks.direction[k]).sum(axis=1, keepdims=True))
    u = seen + np.sqrt(1 - (seen**2).sum(axis=1, keepdims=True)) * unseen
    normal, distance = (plane[k] for plane in local_planes(problem, state))
    layers, wet = problem.layers.with_index(state.index), tracks.wet[k]
    thickness = [distance, *layers.thickness]
    index = [1.0, *layers.index]
    place, ray = np.zeros_like(u), u.copy()
    for step, before, behind in zip(thickness, index, index[1:], strict=False):
        reach = np.broadcast_to(step, len(u))[wet] / (ray * normal).sum(axis=1)[wet]
        place[wet] += reach[:, None] * ray[wet]
        ray[wet] = bent(ray[wet], normal[wet], behind / before)
    rotation, translation = state.cam_from_world(problem.structure)
    in_cam = place + lengths[:, None] * ray
    return np.einsum("nji,nj->ni", rotation[image], in_cam - translation[image])


def shifts(problem: Problem, state: State) -> Array:
    """What refined intrinsics and linearised waves add to the errors, (N, 2) px."""
    tracks = problem.tracks
    lens = state.lens[problem.structure.image_camera[tracks.image]]
    moved = np.einsum("nij,nj->ni", tracks.lens, lens)
    if tracks.effects.shape[2]:
        moved += tracks.offset + np.einsum("nij,nj->ni", tracks.effects, state.waves[tracks.image])
    return np.asarray(moved)


def errors(problem: Problem, state: State, points: Array) -> Array:
    """`e_ij` (N, 2) in pixels, the first observations' included."""
    tracks, structure = problem.tracks, problem.structure
    rotation, translation = state.cam_from_world(structure)
    normal, distance = local_planes(problem, state)
    i = tracks.image
    x = np.einsum("nij,nj->ni", rotation[i], np.repeat(points, np.diff(tracks.start), axis=0)) + translation[i]
    seen = unit(x)
    wet, layers = tracks.wet, problem.layers.with_index(state.index)
    seen[wet] = least_path_direction(x[wet], normal[wet], distance[wet], layers)
    return np.asarray(np.einsum("nij,nj->ni", tracks.metric, seen - tracks.direction) + shifts(problem, state))


def lengths_of(problem: Problem, state: State, points: Array) -> Array:
    """The `d_j` (P,) of points on rays."""
    origin = on_rays(problem, state, np.zeros(len(points)))
    lengths = np.linalg.norm(points - origin, axis=1)
    np.testing.assert_allclose(on_rays(problem, state, lengths), points, atol=1e-11)
    return lengths


def jacobians(problem: Problem, keys: list[Key], parameters: list[Array], lengths: Array) -> tuple[Array, Array]:
    """Derivatives of the other images' errors by the camera side (2n, m) and by the lengths (2n, P)."""
    others = ~is_first(problem)

    def at(values: list[Array], d: Array) -> Array:
        state = apply(problem.state, change_of(problem, keys, values))
        return errors(problem, state, on_rays(problem, state, d))[others]

    by_cameras = [
        (at(ahead, lengths) - at(behind, lengths)).ravel() / (2 * STEP) for ahead, behind in steps(parameters)
    ]
    by_length = (at(parameters, lengths + STEP) - at(parameters, lengths - STEP)) / (2 * STEP)
    point = np.repeat(np.arange(len(lengths)), np.diff(problem.tracks.start))[others]
    by_lengths = np.zeros((*by_length.shape, len(lengths)))
    by_lengths[np.arange(len(point)), :, point] = by_length
    return np.stack(by_cameras, axis=1), by_lengths.reshape(-1, len(lengths))


WAVES = {"waves": False, "linear waves": True}


@pytest.mark.parametrize("case", [*CASES, *WAVES, "two images"])
@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_the_reduced_system_is_that_of_explicit_lengths(case: str, loss: Loss) -> None:
    problem = make_problem(**CASES.get(case, {"scenario": "static_interface", "sensors": 2}), loss=loss)
    if case == "two images":
        # One other observation of a point cannot tell it, but on the ray.
        few = problem.tracks.image < 2
        start = np.concatenate([[0], np.cumsum(np.add.reduceat(few, problem.tracks.start[:-1], dtype=int))])
        problem = replace(problem, tracks=problem.tracks.take(start, few))
    problem = bound(problem).problem
    if case in WAVES:
        problem = with_waves(problem, 3, linear=WAVES[case])
    chunk = whole(problem)
    parameters = some_parameters(chunk, 0.003)
    points, cost = settled(chunk, parameters)
    state = apply(problem.state, change_of(problem, chunk.keys, parameters))
    lengths = lengths_of(problem, state, points)
    every = errors(problem, state, points)
    assert np.abs(every[is_first(problem)]).max() < 1e-8
    r = every[~is_first(problem)]
    squared = (r**2).sum(axis=1)
    assert squared.max() > 1 and (len(np.unique(problem.tracks.image)) > 3 or case == "two images")
    assert cost == pytest.approx(0.5 * robust_cost(squared, loss, problem.loss_scale).sum(), rel=1e-6)

    root = robust_weights(problem, r)
    by_cameras, by_lengths = (
        root[:, None] * j for j in jacobians(problem, chunk.keys, parameters, lengths)
    )  # fmt: skip
    e = root * r.ravel()
    # The lengths are at their minima, up to what the next step would gain: 1e-7 of a point's cost.
    per_length = np.linalg.norm(by_lengths, axis=0)
    assert np.abs(by_lengths.T @ e / per_length).max() < 1e-3 * np.linalg.norm(e)
    solved = np.linalg.lstsq(by_lengths, np.column_stack([by_cameras, e]), rcond=None)[0]
    free, left = by_cameras - by_lengths @ solved[:, :-1], e - by_lengths @ solved[:, -1]
    _, gradient, matrix = reduced(chunk, parameters)
    norms = np.linalg.norm(by_cameras, axis=0)
    # A dry reference observation does not know of the index, nor a straight one of its plane.
    seen = norms > 1e-9 * norms.max()
    assert seen.sum() >= 9
    block = np.ix_(seen, seen)
    assert_same_system(
        gradient[seen], matrix[block], (by_cameras.T @ left)[seen], (by_cameras.T @ free)[block], norms[seen],
        float(np.linalg.norm(e)),
    )  # fmt: skip


def test_proximal_terms_act_along_the_rays() -> None:
    problem = bound(make_problem("moving_interface")).problem
    chunk = whole(problem)
    # So heavy that the points come as near to their places as their rays let them.
    chunk.anchors = Anchors(np.full(len(problem.points), 1e12), problem.points.copy())
    parameters = some_parameters(chunk, 0.003)
    points, cost = settled(chunk, parameters)
    state = apply(problem.state, change_of(problem, chunk.keys, parameters))
    origin, one = (on_rays(problem, state, np.full(len(points), d)) for d in (0.0, 1.0))
    nearest = ((problem.points - origin) * (one - origin)).sum(axis=1)
    np.testing.assert_allclose(points, origin + nearest[:, None] * (one - origin), atol=1e-7)
    assert np.linalg.norm(points - problem.points, axis=1).min() > 1e-4
    # The gradient is that of the cost.
    chunk = whole(problem)
    chunk.anchors = Anchors(np.full(len(problem.points), 1e4), problem.points.copy())
    _, gradient, matrix = reduced(chunk, parameters)
    difference = [
        (settled(chunk, ahead)[1] - settled(chunk, behind)[1]) / (2 * STEP) for ahead, behind in steps(parameters)
    ]
    curvature = np.sqrt(np.diag(matrix))
    np.testing.assert_allclose(gradient / curvature, difference / curvature, atol=1e-3)
    assert np.abs(gradient / curvature).max() > 1


@pytest.mark.parametrize(("scenario", "loss"), [("moving_interface", "trivial"), ("static_interface", "cauchy")])
def test_the_minimum_is_that_of_another_solver(scenario: Scenario, loss: Loss) -> None:
    problem = bound(make_problem(scenario, num_points=24, loss=loss, noise=0.5)).problem
    structure, state = problem.structure, problem.state
    # A gauge, for the other solver.
    held = Held.nothing(state)
    held.poses[structure.image_pose[REFERENCE]] = held.distances[structure.image_plane[REFERENCE]] = True
    problem = replace(problem, held=held)
    result = adjust(problem, FINE)
    assert result.termination == "convergence"
    others = np.flatnonzero(~held.poses)
    planes, num_points = structure.num_planes, len(problem.points)
    free_distances = np.flatnonzero(~held.distances)

    def state_of(x: Array) -> State:
        normals, distances, poses, _ = np.split(
            x, np.cumsum([2 * planes, len(free_distances), 6 * len(others)])
        )  # fmt: skip
        rotation, translation, distance = state.rotation.copy(), state.translation.copy(), state.distance.copy()
        for pose, value in zip(others, poses.reshape(-1, 6), strict=True):
            rotation[pose] = Rotation.from_rotvec(value[:3]).as_matrix() @ state.rotation[pose]
            translation[pose] = value[3:]
        distance[free_distances] = distances
        normal = unit(np.column_stack([normals.reshape(-1, 2), np.ones(planes)]))
        return replace(state, rotation=rotation, translation=translation, normal=normal, distance=distance)

    def residuals(x: Array) -> Array:
        at = state_of(x)
        r = errors(problem, at, on_rays(problem, at, x[-num_points:]))[~is_first(problem)]
        squared = (r**2).sum(axis=1)
        # Residuals whose squares are the robust cost.
        scale = np.sqrt(robust_cost(squared, loss, problem.loss_scale) / squared)
        return np.asarray(scale[:, None] * r).ravel()

    solved = result.state
    turn = [Rotation.from_matrix(solved.rotation[p] @ state.rotation[p].T).as_rotvec() for p in others]
    x = np.concatenate([
        (solved.normal[:, :2] / solved.normal[:, 2:]).ravel(),
        solved.distance[free_distances],
        *(np.concatenate([w, solved.translation[p]]) for w, p in zip(turn, others, strict=True)),
        lengths_of(problem, solved, result.points),
    ])  # fmt: skip
    r = residuals(x)
    assert 0.5 * r @ r == pytest.approx(result.cost, rel=1e-7) and result.cost > 1
    settings: dict[str, Any] = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "x_scale": "jac", "max_nfev": 3}
    again = least_squares(residuals, x, jac="3-point", **settings)
    # In units of a parameter's own standard deviation and of the residuals' norm.
    norms = np.linalg.norm(again.jac, axis=0)
    assert np.abs(again.grad / norms).max() < 1e-5 * np.sqrt(2 * again.cost)
    assert again.cost == pytest.approx(result.cost, rel=1e-8)
    moved = on_rays(problem, state_of(again.x), again.x[-num_points:])
    assert np.abs(moved - result.points).max() < 2e-5
    # From elsewhere: not a minimum that only one who starts there finds.
    rng = np.random.default_rng(2)
    elsewhere = least_squares(residuals, x + 1e-3 * rng.normal(size=x.shape), **{**settings, "max_nfev": 25})
    assert elsewhere.cost == pytest.approx(result.cost, rel=1e-5)
    # And not the minimum without a reference, whose errors are spread over all images.
    freely = adjust(replace(problem, on_rays=False), FINE)
    assert freely.cost < 0.95 * result.cost
    assert np.abs(errors(problem, result.state, result.points)[is_first(problem)]).max() < 1e-7
    assert np.abs(errors(problem, freely.state, freely.points)[is_first(problem)]).max() > 0.1


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_without_noise_the_truth_is_found(scenario: Scenario) -> None:
    truth = bound(make_problem(scenario, num_points=30, noise=0.0)).problem
    zero = Change.zero(truth.state)
    rng = np.random.default_rng(4)
    off = replace(
        zero, pose=2e-3 * rng.normal(size=zero.pose.shape), plane=2e-3 * rng.normal(size=zero.plane.shape)
    )  # fmt: skip
    start = replace(truth, state=apply(truth.state, off), points=truth.points + 0.01)
    result = adjust(start, FINE)
    assert result.cost < 1e-10 * result.initial_cost and result.initial_cost > 10
    # Up to a similarity, which says nothing of two planes' cosines in the camera.
    cosines = [
        (s.planes_in_cam(truth.structure)[0] * truth.state.planes_in_cam(truth.structure)[0]).sum(axis=1)
        for s in (start.state, result.state)
    ]
    assert 1 - cosines[1].min() < 1e-4 * (1 - cosines[0].min())


def test_points_that_take_part_and_those_that_do_not() -> None:
    problem = make_problem("moving_interface", sensors=2, num_points=30)
    tracks = problem.tracks
    point = np.repeat(np.arange(30), np.diff(tracks.start))
    # The reference sees points 0 to 19, and point 5 twice; nobody else sees point 7.
    keep = (tracks.image != REFERENCE) | (point < 20)
    keep &= (tracks.image == REFERENCE) | (point != 7)
    rows = np.flatnonzero(keep)
    twice = np.flatnonzero(keep & (point == 5) & (tracks.image == REFERENCE))
    rows = np.sort(np.concatenate([rows, twice]))
    rows = rows[np.argsort(point[rows], kind="stable")]
    start = np.searchsorted(point[rows], np.arange(31)).astype(np.int64)
    problem = replace(problem, tracks=tracks.take(start, rows))
    seen = num_points_seen(problem)
    assert seen[REFERENCE] == 19 and seen[0] == 29

    rays = bound(problem)
    assert rays.points.tolist() == [p for p in range(20) if p != 7]
    mine = rays.problem.tracks
    assert (mine.image[is_first(rays.problem)] == REFERENCE).all()
    assert (mine.image[~is_first(rays.problem)] != REFERENCE).all()
    np.testing.assert_array_equal(mine.direction, problem.tracks.direction[rays.rows])
    np.testing.assert_array_equal(rays.problem.points, problem.points[rays.points])
    for j, p in enumerate(rays.points):
        old = problem.tracks.image[problem.tracks.start[p] : problem.tracks.start[p + 1]]
        new = mine.image[mine.start[j] : mine.start[j + 1]]
        assert sorted(set(old.tolist())) == sorted(new.tolist())
    assert rays.num_points_shared[REFERENCE] == 19
    others = [len(np.intersect1d(rays.points, point[tracks.image == i])) for i in range(len(seen))]
    assert rays.num_points_shared.tolist() == others

    result = adjust(rays.problem, FINE)
    solved = replace(rays.problem, state=result.state, points=result.points)
    points = with_other_points(problem, rays, solved, FINE)
    np.testing.assert_array_equal(points[rays.points], result.points)
    # The others are at their minima: settling all without the constraint does not move them.
    free = settle_points(replace(problem, state=result.state, points=points), FINE)
    out = np.setdiff1d(np.arange(30), rays.points)
    out = out[np.diff(problem.tracks.start)[out] > 1]
    assert len(out) > 5
    np.testing.assert_allclose(points[out], free[out], atol=1e-5)
    assert np.abs(points[out] - problem.points[out]).max() > 1e-3
    assert np.abs(points[rays.points] - free[rays.points]).max() > 1e-4


def test_all_points_seen_leaves_nothing_to_settle() -> None:
    problem = make_problem("static_interface")
    rays = bound(problem)
    assert len(rays.points) == len(problem.points)
    solved = replace(rays.problem, points=rays.problem.points + 1)
    np.testing.assert_array_equal(with_other_points(problem, rays, solved, FINE), solved.points)


@pytest.mark.parametrize("layers", [Layers(), Layers(thickness=(0.02,), index=(1.52 / 1.333, 1 / 1.333))])
def test_a_keypoint_without_a_ray_takes_no_part(layers: Layers) -> None:
    """One that looks past the interface, or is totally reflected where a camera under water looks out."""
    problem = make_problem("moving_interface", layers=layers)
    direction = problem.tracks.direction.copy()
    k = np.flatnonzero((problem.tracks.image == REFERENCE) & problem.tracks.wet)[2]
    direction[k] = unit([1.0, 0.0, -1.0] if layers == Layers() else [1.0, 0.0, 0.3])
    rays = bound(replace(problem, tracks=problem.tracks._replace(direction=direction)))
    point = np.searchsorted(problem.tracks.start, k, side="right") - 1
    assert rays.points.tolist() == [p for p in range(len(problem.points)) if p != point]


def test_what_cannot_be_is_told() -> None:
    problem = make_problem("moving_interface")
    message = error_of(lambda: on_reference_rays(problem, REFERENCE, min_num_points=13))
    assert "12 points" in message and "13" in message
    known = replace(problem, held=replace(problem.held, points=True))
    assert "known points" in error_of(lambda: bound(known))
    alone = replace(problem, tracks=problem.tracks._replace(image=np.zeros_like(problem.tracks.image)))
    assert "0 points" in error_of(lambda: on_reference_rays(alone, 0, min_num_points=0))
    assert num_points_seen(alone).tolist() == [0] * 4
