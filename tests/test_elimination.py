"""The compiled kernel and what Ceres is told, against plain numpy and finite differences.

`dense_reference` says in a few lines what a residual is. Everything else here (gradients, matrices, eliminated
points, robust losses, chunks) is compared with it.

What this does not show: that the minimum is the truth. That is for the tests of whole refinements.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from dense_reference import (
    FOCAL_LENGTH,
    LOSSES,
    PORTHOLE,
    STEP,
    TANK,
    assert_same_system,
    ceres_loss,
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
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_refract.estimator import adjustment, elimination
from colmap_refract.estimator import chunk as chunks
from colmap_refract.estimator.adjustment import SolverSettings, adjust, square_root
from colmap_refract.estimator.chunk import Chunk, Held, Problem, robust_cost
from colmap_refract.estimator.elimination import PLANE, Anchors
from colmap_refract.estimator.scenario import SCENARIOS, Change
from colmap_refract.interface import Array
from colmap_refract.options import Loss, Scenario

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

    block = adjustment._ReducedCost(chunk, None, adjustment.SolverWatch(None, len(problem.tracks.image)))
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
    assert not block.watch.errors


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
