"""The compiled kernel and what Ceres is told, against plain numpy and finite differences.

The reference below says in a few lines what a residual is: points through `State` and `project_direction`,
which have tests of their own, times the metric. Everything else here (gradients, matrices, eliminated
points, robust losses, chunks) is compared with it.

What this does not show: that the minimum is the truth. That is for the tests of whole refinements.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pyceres
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_refract.estimator import adjustment, elimination
from colmap_refract.estimator import chunk as chunks
from colmap_refract.estimator.adjustment import SolverSettings, adjust, square_root
from colmap_refract.estimator.chunk import Chunk, Held, Problem, robust_cost
from colmap_refract.estimator.elimination import LENS, MEDIUM, PLANE, POSE, Anchors, Tracks
from colmap_refract.estimator.optics import project_direction
from colmap_refract.estimator.rotation import exp_and_left_jacobian
from colmap_refract.estimator.scenario import SCENARIOS, Change, State, Structure, apply, share_planes
from colmap_refract.interface import Array, Layers, tangent_basis
from colmap_refract.options import Loss, Scenario

FOCAL_LENGTH = 1200.0
WATER = Layers()
TANK = Layers(thickness=(0.02, 0.1), index=(1.49, 1.0, 1.333))
# A camera under water that looks out through a porthole: the last medium has the lowest index.
PORTHOLE = Layers(thickness=(0.02,), index=(1.52 / 1.333, 1 / 1.333))

STEP = 1e-5
TOLERANCE = 1e-6
"""Of derivatives, relative to the norms of the columns involved: central differences of this step are good to
about 1e-8 of them. A sign flip is 2, a missing term 1e-3 or more."""

Key = tuple[int, int]


def unit(vector: Any) -> Array:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector, axis=-1, keepdims=True)


def make_problem(
    scenario: Scenario = "moving_interface",
    *,
    sensors: int = 1,
    groups: bool = False,
    dry_image: bool = False,
    odd_points: bool = False,
    layers: Layers = WATER,
    index: bool = False,
    lens: int = 0,
    loss: Loss = "trivial",
    noise: float = 1.0,
    num_points: int = 12,
    seed: int = 0,
) -> Problem:
    """Frames of `sensors` images that look down on points at 2 to 3, through an interface at about 1.

    Args:
        sensors: images to a frame; rigs need not have their reference sensor among them.
        groups: the middle frames share an interface.
        dry_image: the last image has no interface.
        odd_points: also points next to the plane on either side marked wet, and one behind the cameras.
        index, lens: the refractive index is free, and so many intrinsics of each camera.
        noise: of the keypoints, px.
    """
    rng = np.random.default_rng(seed)
    frames = 4
    frame = np.repeat(np.arange(frames), sensors)
    images = len(frame)
    camera = np.tile(np.arange(sensors), frames)
    dry = [dry_image and i == images - 1 for i in range(images)]
    group = ["tank" if groups and 1 <= f <= 2 else None for f in frame]
    plane, in_world, _ = share_planes(scenario, frame.tolist(), camera.tolist(), group, dry)
    planes = len(in_world)
    anchor = rng.normal(size=(planes, 3))
    normal = unit(np.column_stack([0.1 * rng.normal(size=(planes, 2)), np.ones(planes)]))
    structure = Structure(
        image_pose=np.zeros(images, np.int64) if scenario == "fixed_camera" else frame,
        image_plane=plane,
        image_camera=camera,
        sensor_rotation=exp_and_left_jacobian(0.1 * rng.normal(size=(sensors, 3)))[0][camera],
        sensor_translation=0.2 * rng.normal(size=(sensors, 3))[camera] if sensors > 1 else np.zeros((images, 3)),
        plane_in_world=in_world,
        plane_anchor=anchor,
    )
    poses = structure.num_poses
    rotation = exp_and_left_jacobian(0.1 * rng.normal(size=(poses, 3)))[0]
    centers = np.column_stack([rng.uniform(-0.5, 0.5, (poses, 2)), 0.1 * rng.normal(size=poses)])
    state = State(
        rotation=rotation,
        translation=-np.einsum("nij,nj->ni", rotation, centers),
        normal=normal,
        distance=rng.uniform(0.9, 1.1, planes) - in_world * np.einsum("bi,bi->b", normal, anchor),
        index=layers.refractive_index,
        lens=0.1 * rng.normal(size=(sensors, lens)),
    )
    points = rng.uniform([-0.6, -0.6, 2], [0.6, 0.6, 3], (num_points, 3))
    seen = rng.random((num_points, images)) < 0.8
    seen[:, :2] = True
    point, image = np.nonzero(seen)
    wet = ~np.array(dry)[image]
    if scenario != "fixed_camera":  # which sees a dry point without any parallax
        points[:2, 2] = 0.5
        wet &= point >= 2
    if odd_points:
        points[2:4, 2] = 1.3  # a little behind all planes, or a little before: marked wet all the same
        points[4:6, 2] = 0.9
        points[6, 2] = -2.0
    tracks = Tracks(
        start=np.concatenate([[0], np.cumsum(seen.sum(axis=1))]),
        image=image.astype(np.int32),
        direction=np.zeros((len(image), 3)),
        metric=np.zeros((len(image), 2, 3)),
        lens=FOCAL_LENGTH * rng.normal(size=(len(image), 2, lens)),
        wet=wet,
    )
    problem = Problem(
        tracks=tracks,
        structure=structure,
        layers=layers,
        state=state,
        points=points,
        held=replace(Held.nothing(state), index=not index, lens=lens == 0),
        loss=loss,
        loss_scale=4 * noise,
    )
    direction = predict(problem, state, points)
    direction = unit(direction + noise / FOCAL_LENGTH * rng.normal(size=direction.shape))
    metric = FOCAL_LENGTH * np.array([tangent_basis(d).T for d in direction])
    lens_at_start = np.einsum("nij,nj->ni", tracks.lens, state.lens[structure.image_camera[image]])
    # The keypoints were lifted with the intrinsics as they are: cancel what the change of them does.
    shift = np.einsum("nij,ni->nj", metric, lens_at_start) / FOCAL_LENGTH**2
    return replace(problem, tracks=tracks._replace(direction=direction + shift, metric=metric))


def predict(problem: Problem, state: State, points: Array) -> Array:
    tracks, structure = problem.tracks, problem.structure
    rotation, translation = state.cam_from_world(structure)
    normal, distance = state.planes_in_cam(structure)
    of = np.repeat(points, np.diff(tracks.start), axis=0)
    image = tracks.image
    in_cam = np.einsum("nij,nj->ni", rotation[image], of) + translation[image]
    layers = problem.layers.with_index(state.index)
    return project_direction(in_cam, normal[image], distance[image], layers, tracks.wet)


def residuals(problem: Problem, change: Change, points: Array) -> Array:
    """(N, 2), px."""
    state, tracks = apply(problem.state, change), problem.tracks
    camera = problem.structure.image_camera[tracks.image]
    error = np.einsum("nij,nj->ni", tracks.metric, predict(problem, state, points) - tracks.direction)
    return np.asarray(error + np.einsum("nij,nj->ni", tracks.lens, state.lens[camera]))


def change_of(problem: Problem, keys: list[Key], parameters: list[Array]) -> Change:
    change, index = Change.zero(problem.state), 0.0
    for (slot, block), value in zip(keys, parameters, strict=True):
        if slot == POSE:
            change.pose[block] = value
        elif slot == PLANE:
            change.plane[block] = value
        elif slot == LENS:
            change.lens[block] = value
        else:
            index = float(value[0])
    return replace(change, index=index)


def steps(parameters: list[Array]) -> Iterator[tuple[list[Array], list[Array]]]:
    """The parameters with one entry increased and decreased by STEP, for each entry."""
    for k, block in enumerate(parameters):
        for j in range(len(block)):
            both = []
            for sign in (1, -1):
                moved = [value.copy() for value in parameters]
                moved[k][j] += sign * STEP
                both.append(moved)
            yield both[0], both[1]


def jacobians(problem: Problem, keys: list[Key], parameters: list[Array], points: Array) -> tuple[Array, Array]:
    """Dense derivatives of all residuals by the camera side (2N, n) and by the points (2N, 3P)."""

    def at(values: list[Array]) -> Array:
        return residuals(problem, change_of(problem, keys, values), points).ravel()

    by_cameras = np.stack([(at(ahead) - at(behind)) / (2 * STEP) for ahead, behind in steps(parameters)], axis=1)
    change = change_of(problem, keys, parameters)
    point = np.repeat(np.arange(len(points)), np.diff(problem.tracks.start))
    by_points = np.zeros((len(point), 2, len(points), 3))
    for j, axis in enumerate(np.eye(3)):
        # Every point at once: an observation depends on its own only.
        ahead, behind = (residuals(problem, change, points + sign * STEP * axis) for sign in (1, -1))
        by_points[np.arange(len(point)), :, point, j] = (ahead - behind) / (2 * STEP)
    return by_cameras, by_points.reshape(2 * len(point), -1)


def some_parameters(chunk: Chunk, size: float, seed: int = 3) -> list[Array]:
    """A change of everything that is free: radians, units, hundredths of an index."""
    rng = np.random.default_rng(seed)
    return [size * (0.2 if slot == MEDIUM else 1.0) * rng.normal(size=width)
            for (slot, _), width in zip(chunk.keys, chunk.widths, strict=True)]  # fmt: skip


def whole(problem: Problem, num_slices: int = 1) -> Chunk:
    return Chunk(problem, np.arange(len(problem.points)), num_slices)


def settled(chunk: Chunk, parameters: list[Array]) -> tuple[Array, float]:
    result = chunk.settle(parameters, None)
    assert result is not None
    return result


def reduced(chunk: Chunk, parameters: list[Array]) -> tuple[float, Array, Array]:
    result = chunk.reduce(parameters, None)
    assert result is not None
    return result


def assert_same_system(
    gradient: Array, matrix: Array, expected_gradient: Array, expected_matrix: Array, norms: Array, size: float
) -> None:
    """`norms`: of the Jacobian's columns; `size`: norm of the residuals."""
    assert (norms > 0).all()
    np.testing.assert_allclose(gradient / norms, expected_gradient / norms, atol=TOLERANCE * size)
    scale = np.outer(norms, norms)
    np.testing.assert_allclose(np.triu(matrix / scale), np.triu(expected_matrix / scale), atol=TOLERANCE)


CASES: dict[str, dict[str, Any]] = {
    **{scenario: {"scenario": scenario} for scenario in SCENARIOS},
    **{f"{scenario}, two sensors": {"scenario": scenario, "sensors": 2} for scenario in SCENARIOS},
    "groups": {"groups": True, "dry_image": True},
    "groups, two sensors": {"groups": True, "sensors": 2, "dry_image": True},
    "groups of a fixed camera": {"scenario": "fixed_camera", "groups": True},
    "index": {"scenario": "static_interface", "index": True},
    "index behind walls": {"index": True, "layers": TANK},
    "index out of the water": {"scenario": "static_interface", "index": True, "layers": PORTHOLE},
    "lens": {"lens": 3, "sensors": 2},
    "lens of many parameters": {"lens": 9},
    "walls": {"scenario": "static_interface", "layers": TANK},
    "everything": {"sensors": 2, "groups": True, "dry_image": True, "index": True, "lens": 2, "layers": TANK},
}
cases = pytest.mark.parametrize("case", CASES)


@cases
@pytest.mark.parametrize("size", [0.0, 0.02])
def test_derivatives_at_known_points(case: str, size: float) -> None:
    problem = make_problem(**CASES[case], odd_points=True)
    problem = replace(problem, held=replace(problem.held, points=True))
    chunk = whole(problem)
    parameters = some_parameters(chunk, size)
    cost, gradient, matrix = reduced(chunk, parameters)
    r = residuals(problem, change_of(problem, chunk.keys, parameters), problem.points).ravel()
    assert cost == pytest.approx(0.5 * r @ r, rel=1e-12)
    j, _ = jacobians(problem, chunk.keys, parameters, problem.points)
    norms = np.linalg.norm(j, axis=0)
    assert_same_system(gradient, matrix, j.T @ r, j.T @ j, norms, float(np.linalg.norm(r)))
    assert chunk.num_columns == j.shape[1] > 0


LOSSES: list[Loss] = ["trivial", "huber", "soft_l1", "cauchy"]


def ceres_loss(loss: Loss, scale: float) -> Callable[[float], Array]:
    kinds = {"huber": pyceres.HuberLoss, "soft_l1": pyceres.SoftLOneLoss, "cauchy": pyceres.CauchyLoss}
    instance = pyceres.TrivialLoss() if loss == "trivial" else kinds[loss](scale)
    return lambda s: np.asarray(instance.evaluate(s))


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_are_those_of_ceres(loss: Loss) -> None:
    """Costs, gradients and weights, over residuals from none to very large ones."""
    problem = replace(make_problem("static_interface", loss=loss), loss_scale=0.7)
    # Each keypoint is off by its own amount, from far below to far above the scale of the loss.
    rng = np.random.default_rng(1)
    exact = predict(problem, problem.state, problem.points)
    spread = 10.0 ** rng.uniform(-3, 2, (len(exact), 1))
    direction = unit(exact + spread / FOCAL_LENGTH * rng.normal(size=exact.shape))
    problem = replace(
        problem, tracks=problem.tracks._replace(direction=direction), held=replace(problem.held, points=True)
    )
    chunk = whole(problem)
    parameters = some_parameters(chunk, 0.0)
    r = residuals(problem, Change.zero(problem.state), problem.points)
    squared = np.sum(r**2, axis=1)
    rho, weight, _ = np.array([ceres_loss(loss, problem.loss_scale)(s) for s in squared]).T
    assert squared.min() < 0.01 * problem.loss_scale**2 and squared.max() > 100 * problem.loss_scale**2

    # pyceres takes its argument in single precision.
    np.testing.assert_allclose(robust_cost(squared, loss, problem.loss_scale), rho, rtol=1e-6)
    assert settled(chunk, parameters)[1] == pytest.approx(0.5 * rho.sum(), rel=1e-6)
    cost, gradient, matrix = reduced(chunk, parameters)
    assert cost == pytest.approx(settled(chunk, parameters)[1], rel=1e-12)
    j, _ = jacobians(problem, chunk.keys, parameters, problem.points)
    root = np.sqrt(np.repeat(weight, 2))
    weighted, error = root[:, None] * j, root * r.ravel()
    norms = np.linalg.norm(weighted, axis=0)
    expected = weighted.T @ error, weighted.T @ weighted
    assert_same_system(gradient, matrix, *expected, norms, float(np.linalg.norm(error)))


def robust_weights(problem: Problem, r: Array) -> Array:
    """(2N,) square roots of the weights of the residuals (N, 2)."""
    loss = ceres_loss(problem.loss, problem.loss_scale)
    return np.sqrt(np.repeat([loss(s)[1] for s in np.sum(r**2, axis=1)], 2))


def schur_complement(
    problem: Problem, keys: list[Key], parameters: list[Array], points: Array, anchors: Anchors
) -> tuple[Array, Array, Array]:
    """Dense `(gradient, matrix, column norms)` of the camera side after eliminating the points."""
    r = residuals(problem, change_of(problem, keys, parameters), points)
    root = robust_weights(problem, r)
    by_cameras, by_points = (root[:, None] * j for j in jacobians(problem, keys, parameters, points))
    error = root * r.ravel()
    anchor = np.repeat(anchors.weight, 3)
    point_matrix = by_points.T @ by_points + np.diag(anchor)
    point_gradient = by_points.T @ error + anchor * (points - anchors.position).ravel()
    coupling = by_cameras.T @ by_points
    eliminated = coupling @ np.linalg.inv(point_matrix)
    gradient = by_cameras.T @ error - eliminated @ point_gradient
    matrix = by_cameras.T @ by_cameras - eliminated @ coupling.T
    return gradient, matrix, np.linalg.norm(by_cameras, axis=0)


@cases
@pytest.mark.parametrize("size", [0.0, 2e-3])
def test_eliminated_points_leave_the_schur_complement(case: str, size: float) -> None:
    problem = make_problem(**CASES[case])
    chunk = whole(problem)
    parameters = some_parameters(chunk, size)
    points, cost = settled(chunk, parameters)
    assert np.abs(points - problem.points).max() > 1e-4
    reduced_cost, gradient, matrix = reduced(chunk, parameters)
    assert reduced_cost == pytest.approx(cost, rel=1e-9)
    expected = schur_complement(problem, chunk.keys, parameters, points, chunk.anchors)
    assert_same_system(gradient, matrix, *expected, np.sqrt(2 * cost))


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("anchored", [False, True])
def test_eliminated_points_with_losses_and_anchors(loss: Loss, anchored: bool) -> None:
    problem = make_problem("static_interface", loss=loss, index=True)
    chunk = whole(problem)
    if anchored:
        weight = np.where(np.arange(12) % 2, 0.0, 1e6)
        chunk.anchors = Anchors(weight=weight, position=problem.points + 0.03)
    parameters = some_parameters(chunk, 1e-3)
    points, cost = settled(chunk, parameters)
    r = residuals(problem, change_of(problem, chunk.keys, parameters), points)
    pull = 0.5 * np.sum(chunk.anchors.weight[:, None] * (points - chunk.anchors.position) ** 2)
    expected_cost = 0.5 * robust_cost(np.sum(r**2, axis=1), loss, problem.loss_scale).sum() + pull
    assert cost == pytest.approx(expected_cost, rel=1e-6) and (pull > 1e-3 * cost) == anchored
    _, gradient, matrix = reduced(chunk, parameters)
    expected = schur_complement(problem, chunk.keys, parameters, points, chunk.anchors)
    assert_same_system(gradient, matrix, *expected, np.sqrt(2 * cost))


@cases
@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_gradient_is_the_derivative_of_the_settled_cost(case: str, loss: Loss) -> None:
    """Of the cost as a trial step sees it: if the two disagreed, Ceres would reject good steps."""
    problem = make_problem(**CASES[case], loss=loss)
    chunk = whole(problem)
    parameters = some_parameters(chunk, 1e-3)
    cost, gradient, matrix = reduced(chunk, parameters)
    difference = [
        (settled(chunk, ahead)[1] - settled(chunk, behind)[1]) / (2 * STEP) for ahead, behind in steps(parameters)
    ]
    # In standard deviations of one parameter, so that no unit matters. The gauge has no curvature.
    curvature = np.sqrt(np.diag(matrix))
    curvature = np.maximum(curvature, 1e-3 * curvature.max())
    np.testing.assert_allclose(gradient / curvature, difference / curvature, atol=1e-4 if loss == "trivial" else 1e-2)
    assert np.abs(gradient / curvature).max() > 0.1


def point_costs(problem: Problem, change: Change, points: Array) -> Array:
    """(P,) by the reference."""
    rho = robust_cost(np.sum(residuals(problem, change, points) ** 2, axis=1), problem.loss, problem.loss_scale)
    return np.asarray(0.5 * np.add.reduceat(rho, problem.tracks.start[:-1]))


def settle_each(chunk: Chunk, parameters: list[Array], points: Array) -> tuple[Array, Array]:
    """Points and costs (P,), one point at a time."""
    evaluated = chunk.views(parameters)
    assert evaluated is not None
    moved = points.copy()
    loss = (LOSSES.index(chunk._problem.loss), chunk._problem.loss_scale)
    costs = [
        elimination.settle(moved, chunk.anchors, p, p + 1, chunk.tracks, *evaluated, *loss) for p in range(len(moved))
    ]
    return moved, np.array(costs)


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 2**16),
    loss=st.sampled_from(LOSSES),
    scenario=st.sampled_from(SCENARIOS),
    scatter=st.sampled_from([1e-3, 0.1, 1.0, 10.0, 1e6]),
)
def test_settling_never_goes_uphill(seed: int, loss: Loss, scenario: Scenario, scatter: float) -> None:
    """From anywhere: next to the minimum, on the wrong side of the plane, behind cameras, far away."""
    problem = make_problem(scenario, loss=loss, seed=seed)
    chunk = whole(problem)
    parameters = some_parameters(chunk, 0.01, seed)
    change = change_of(problem, chunk.keys, parameters)
    points = problem.points + scatter * np.random.default_rng(seed).normal(size=problem.points.shape)
    moved, costs = settle_each(chunk, parameters, points)
    before, after = point_costs(problem, change, points), point_costs(problem, change, moved)
    assert np.isfinite(moved).all() and np.isfinite(costs).all()
    rounding = 1e-9 * before + 1e-12
    assert (after <= before + rounding).all()
    # The cost that is returned is less what one more step would gain, which is little at a minimum.
    assert (costs <= after + rounding).all()
    if scatter < 0.01:
        np.testing.assert_allclose(costs, after, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("loss", LOSSES)
def test_points_without_a_minimum_stay_finite(loss: Loss) -> None:
    """Parallel rays, rays that part, points behind their cameras: they come along in every real model."""
    problem = make_problem("moving_interface", loss=loss, num_points=40)
    same = problem.state.rotation[:1].repeat(4, axis=0), problem.state.translation[:1].repeat(4, axis=0)
    state = replace(
        problem.state, rotation=same[0], translation=same[1],
        normal=problem.state.normal[:1].repeat(4, axis=0), distance=problem.state.distance[:1].repeat(4),
    )  # fmt: skip
    rng = np.random.default_rng(5)
    # Every image of a point sees it in one direction, but for a pixel of noise, of which half of the points have none.
    tracks = problem.tracks
    point = np.repeat(np.arange(40), np.diff(tracks.start))
    noise = rng.normal(size=tracks.direction.shape) * (point % 2)[:, None] / FOCAL_LENGTH
    direction = unit(unit(problem.points)[point] + noise)
    parallel = replace(problem, state=state, tracks=tracks._replace(direction=direction))
    behind = replace(problem, points=problem.points * [1, 1, -1])
    far = replace(problem, points=problem.points * 1e6)
    apart = replace(problem, tracks=tracks._replace(direction=-tracks.direction))
    for odd in (parallel, behind, far, apart):
        chunk = whole(odd)
        parameters = some_parameters(chunk, 0.0)
        before = point_costs(odd, Change.zero(odd.state), odd.points)
        moved, cost = settled(chunk, parameters)
        assert np.isfinite(moved).all() and 0 <= cost <= before.sum() * (1 + 1e-12)
        _, gradient, matrix = reduced(chunk, parameters)
        assert np.isfinite(gradient).all() and np.isfinite(matrix).all()
        # What is left of the matrix has no negative curvature that rounding does not explain.
        full = np.triu(matrix) + np.triu(matrix, 1).T
        assert np.linalg.eigvalsh(full).min() > -1e-6 * np.abs(full).max()


def test_a_plane_behind_its_camera_is_refused() -> None:
    """Ceres then takes a shorter step: no exception, and nothing remembered of the attempt."""
    problem = make_problem("moving_interface")
    chunk = whole(problem)
    fine = some_parameters(chunk, 0.0)
    expected = settled(chunk, fine)[1]
    for bad in (-2.0, np.nan, np.inf):
        broken = [value.copy() for value in fine]
        broken[chunk.keys.index((PLANE, 0))][2] = bad
        assert chunk.settle(broken, None) is None
        assert chunk.reduce(broken, None) is None
    assert settled(chunk, fine)[1] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("rank", [30, 23, 5])
def test_square_root(rank: int) -> None:
    """Also of a singular matrix (seven directions are the gauge's), in units that differ by ten decades."""
    rng = np.random.default_rng(rank)
    units = 10.0 ** rng.uniform(-5, 5, 30)
    j = rng.normal(size=(200, rank)) @ rng.normal(size=(rank, 30)) * units
    matrix = j.T @ j
    factor = square_root(np.triu(matrix))
    norms = np.sqrt(np.diag(matrix))
    np.testing.assert_allclose((factor.T @ factor) / np.outer(norms, norms), matrix / np.outer(norms, norms), atol=1e-9)
    np.testing.assert_array_equal(factor, np.triu(factor))
    assert (np.diag(factor) > 0).all()


def test_square_root_of_a_parameter_without_curvature() -> None:
    """A pose that no observation depends on: its row is its own and the others do not feel it."""
    rng = np.random.default_rng(0)
    j = rng.normal(size=(50, 8))
    j[:, 3] = 0.0
    matrix = j.T @ j
    factor = square_root(np.triu(matrix))
    assert np.isfinite(factor).all() and factor[3, 3] > 0
    np.testing.assert_allclose(factor.T @ factor, matrix, atol=1e-9)
    np.testing.assert_array_equal(factor[[0, 1, 2, 4, 5, 6, 7], 3], 0.0)
    assert np.isfinite(square_root(np.zeros((4, 4)))).all()
    assert square_root(np.zeros((0, 0))).shape == (0, 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_square_root_of_what_is_not_finite(bad: float) -> None:
    matrix = np.eye(4)
    matrix[1, 2] = bad
    with pytest.raises(FloatingPointError, match="not finite"):
        square_root(matrix)


@cases
@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_what_ceres_is_told_is_the_reduced_system(case: str, loss: Loss) -> None:
    problem = make_problem(**CASES[case], loss=loss)
    chunk = whole(problem)
    parameters = some_parameters(chunk, 1e-3)
    cost, gradient, matrix = reduced(chunk, parameters)

    block = adjustment._ReducedCost(chunk, None, adjustment._Watch(None, len(problem.tracks.image)))
    n = chunk.num_columns
    residual = np.full(n + 1, np.nan)
    told = [np.full((n + 1) * width, np.nan) for width in chunk.widths]
    assert block.Evaluate(parameters, residual, told)
    j = np.concatenate([part.reshape(n + 1, -1) for part in told], axis=1)
    assert residual @ residual == pytest.approx(2 * cost, rel=1e-12)
    norms = np.sqrt(np.diag(matrix))
    norms = np.maximum(norms, 1e-6 * norms.max())
    assert_same_system(j.T @ residual, j.T @ j, gradient, matrix, norms, float(np.linalg.norm(residual)))
    # A trial step at the same place: the same cost, to what a settled point has left.
    assert block.Evaluate(parameters, residual, None)
    assert residual @ residual == pytest.approx(2 * cost, rel=1e-6)
    # Blocks that Ceres holds constant come without memory for their derivatives.
    some: list[Array | None] = [None if k % 2 else part for k, part in enumerate(told)]
    assert block.Evaluate(parameters, residual, some)
    assert block.watch.exception is None


def strip(loss: Loss = "trivial", scenario: Scenario = "static_interface") -> Problem:
    """A flight line of 16 images, with about 5 of them to a point: what is cut into several chunks."""
    problem = make_problem(scenario, num_points=2)
    rng = np.random.default_rng(7)
    images = 16
    along = 0.4 * np.arange(images)
    centers = np.column_stack([along, 0.1 * rng.normal(size=(images, 2))])
    points = rng.uniform([0, -0.6, 2], [along[-1], 0.6, 3], (900, 3))
    seen = np.abs(points[:, None, 0] - along) < 1.0
    point, image = np.nonzero(seen)
    static = scenario == "static_interface"
    planes = 1 if static else images
    structure = Structure(
        image_pose=np.arange(images),
        image_plane=np.zeros(images, np.int64) if static else np.arange(images),
        image_camera=np.zeros(images, np.int64),
        sensor_rotation=np.array([np.eye(3)] * images),
        sensor_translation=np.zeros((images, 3)),
        plane_in_world=np.full(planes, static),
        plane_anchor=np.zeros((planes, 3)),
    )
    rotation = exp_and_left_jacobian(0.05 * rng.normal(size=(images, 3)))[0]
    state = State(
        rotation=rotation,
        translation=-np.einsum("nij,nj->ni", rotation, centers),
        normal=unit(np.column_stack([0.05 * rng.normal(size=(planes, 2)), np.ones(planes)])),
        distance=np.full(planes, 1.0),
        index=1.333,
        lens=np.zeros((1, 0)),
    )
    tracks = Tracks(
        start=np.concatenate([[0], np.cumsum(seen.sum(axis=1))]),
        image=image.astype(np.int32),
        direction=np.zeros((len(image), 3)),
        metric=np.zeros((len(image), 2, 3)),
        lens=np.zeros((len(image), 2, 0)),
        wet=np.ones(len(image), bool),
    )
    problem = replace(
        problem, tracks=tracks, structure=structure, state=state, points=points, held=Held.nothing(state),
        loss=loss, loss_scale=2.0,
    )  # fmt: skip
    direction = unit(predict(problem, state, points) + 0.5 / FOCAL_LENGTH * rng.normal(size=(len(image), 3)))
    metric = FOCAL_LENGTH * np.array([tangent_basis(d).T for d in direction])
    bent = replace(state, translation=state.translation + 0.01 * rng.normal(size=(images, 3)))
    return replace(
        problem,
        tracks=tracks._replace(direction=direction, metric=metric),
        state=bent,
        points=points + 0.01 * rng.normal(size=points.shape),
    )


@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_chunks_add_up(monkeypatch: pytest.MonkeyPatch, loss: Loss) -> None:
    problem = strip(loss)
    (one,) = chunks.split(problem, 1)
    monkeypatch.setattr(chunks, "MAX_CHUNK_COLUMNS", 60)
    parts = chunks.split(problem, 1)
    assert len(parts) > 2
    assert sorted(np.concatenate([part.point_indices for part in parts])) == list(range(len(problem.points)))
    # Each touches its own stretch of the line.
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
    assert total == pytest.approx(cost, rel=1e-12)
    norms = np.sqrt(np.diag(matrix))
    scale = np.outer(norms, norms)
    np.testing.assert_allclose(total_gradient / norms, gradient / norms, atol=1e-9 * np.sqrt(2 * cost))
    np.testing.assert_allclose(total_matrix / scale, np.triu(matrix) / scale, atol=1e-9)


def test_slices_add_up() -> None:
    """What threads within a chunk work on."""
    problem = make_problem("static_interface", num_points=50, loss="cauchy")
    one, many = whole(problem), whole(problem, num_slices=3)
    assert len(many.slices) == 3
    for a, b in zip(reduced(one, some_parameters(one, 1e-3)), reduced(many, some_parameters(many, 1e-3)), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9 * np.abs(a).max())


@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface"])
def test_the_minimum_does_not_depend_on_chunks_or_threads(monkeypatch: pytest.MonkeyPatch, scenario: Scenario) -> None:
    problem = strip("cauchy", scenario)
    reference = adjust(problem, SolverSettings())
    assert reference.termination == "convergence" and reference.cost < 0.5 * reference.initial_cost
    # Two residuals of half a pixel each; the 3 unknowns of a point take up a third of them, and the loss a little.
    assert 0.55 < 2 * reference.cost / (0.25 * 2 * len(problem.tracks.image)) < 0.68
    again = adjust(problem, SolverSettings(num_threads=2))
    assert again.cost == pytest.approx(reference.cost, rel=1e-8)
    np.testing.assert_allclose(again.points, reference.points, atol=1e-5)
    monkeypatch.setattr(chunks, "MAX_CHUNK_COLUMNS", 60)
    for num_threads in (1, 2):
        cut = adjust(problem, SolverSettings(num_threads=num_threads))
        assert cut.termination == "convergence"
        assert cut.initial_cost == pytest.approx(reference.initial_cost, rel=1e-9)
        assert cut.cost == pytest.approx(reference.cost, rel=1e-7)


def test_what_is_held_stays() -> None:
    problem = strip()
    state = problem.state
    held = Held(
        poses=np.arange(16) < 3,
        normals=np.array([True]),
        distances=np.array([False]),
        index=True,
    )
    result = adjust(replace(problem, held=held), SolverSettings(max_num_iterations=5))
    np.testing.assert_array_equal(result.state.rotation[:3], state.rotation[:3])
    np.testing.assert_array_equal(result.state.translation[:3], state.translation[:3])
    np.testing.assert_allclose(result.state.normal, state.normal, atol=1e-15)
    assert result.state.distance[0] != state.distance[0] and result.state.index == state.index
    assert (result.state.translation[3:] != state.translation[3:]).any(axis=1).all()

    held = replace(held, normals=np.array([False]), distances=np.array([True]), points=True)
    result = adjust(replace(problem, held=held), SolverSettings(max_num_iterations=5))
    np.testing.assert_allclose(result.state.distance, state.distance, rtol=1e-15)
    assert (result.state.normal != state.normal).any()
    np.testing.assert_array_equal(result.points, problem.points)
    assert result.cost < result.initial_cost


def test_points_alone() -> None:
    """Nothing is free on the camera side: one evaluation settles the points."""
    problem = strip()
    everything = Held(poses=np.ones(16, bool), normals=np.ones(1, bool), distances=np.ones(1, bool))
    result = adjust(replace(problem, held=everything), SolverSettings())
    expected, cost = settled(whole(replace(problem, held=everything)), [])
    np.testing.assert_allclose(result.points, expected, atol=1e-6)
    assert result.cost == pytest.approx(cost, rel=1e-9)
    np.testing.assert_array_equal(result.state.translation, problem.state.translation)


def test_progress_is_reported_and_exceptions_come_through() -> None:
    problem = strip()
    seen: list[adjustment.Progress] = []
    result = adjust(problem, SolverSettings(), on_progress=seen.append)
    assert [progress.iteration for progress in seen] == list(range(len(seen)))
    assert seen[0].cost == pytest.approx(result.initial_cost, rel=1e-9)
    assert seen[-1].cost == pytest.approx(result.cost, rel=1e-9)
    assert seen[-1].rms == pytest.approx(np.sqrt(2 * result.cost / len(problem.tracks.image)), rel=1e-9)

    def stop(progress: adjustment.Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        adjust(problem, SolverSettings(), on_progress=stop)
