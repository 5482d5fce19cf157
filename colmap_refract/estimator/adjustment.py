"""Refractive bundle adjustment: chunks of eliminated tracks as Ceres residual blocks.

A chunk's reduced cost `f`, gradient `g` and Gauss-Newton matrix `H = U^T U` (Cholesky) reach Ceres as one
residual block with residual `[U^-T g; sqrt(2 f - |U^-T g|^2)]` and Jacobian `[U; 0]`: the same cost, the same
gradient, the same Gauss-Newton matrix. A trial step needs the cost only, `[0; sqrt(2 f)]`. Ceres keeps the
trust region, the bounds, the manifolds, further residual blocks (priors) and the report.

With waves the blocks are too wide for that, and modules `whole` and `levenberg` do Ceres' part.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import pyceres
from scipy.linalg import lapack
from threadpoolctl import threadpool_limits

from colmap_refract.estimator.chunk import Chunk, Problem, change_of, slot_width, split
from colmap_refract.estimator.elimination import PLANE, POSE, Anchors
from colmap_refract.estimator.levenberg import Tolerances, descend
from colmap_refract.estimator.priors import PriorBlock, prior_blocks
from colmap_refract.estimator.scenario import State, apply
from colmap_refract.estimator.whole import Whole
from colmap_refract.interface import Array

logger = logging.getLogger(__name__)

Termination = Literal["convergence", "no_convergence", "failure"]

_JITTER = 1e-12
"""Of the scaled matrix's unit diagonal: the gauge leaves seven directions without any curvature."""

_FREE_VARIANCE, _PINNED_VARIANCE = 1e6, 1e-6
"""Squared units of the solve for residuals of one px; keypoints tell a pose to 1e-6 or so."""


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """How Ceres is run. Tolerances are relative."""

    max_num_iterations: int = 300
    function_tolerance: float = 1e-9
    gradient_tolerance: float = 1e-12
    parameter_tolerance: float = 1e-10
    initial_trust_region_radius: float = 1e4
    num_threads: int = 1


@dataclass(frozen=True, kw_only=True)
class Progress:
    """One iteration of the solver, for whoever watches; or how far another stage is, see `part_done`.

    `total` is None for the solver; else `iteration` of so many parts are done, and nothing else is known.
    """

    iteration: int
    cost: float
    rms: float
    gradient_max_norm: float
    step_norm: float
    successful: bool
    total: int | None = None


def part_done(done: int, total: int) -> Progress:
    """How far a stage is that solves nothing."""
    nan = float("nan")
    return Progress(
        iteration=done, cost=nan, rms=nan, gradient_max_norm=nan, step_norm=nan, successful=True, total=total
    )


@dataclass(frozen=True, kw_only=True)
class Adjustment:
    """Outcome of `adjust`.

    Attributes:
        state, points: the solution.
        cost: sum of the robust losses over 2, in px^2.
        initial_cost: at the start.
        num_iterations: of Ceres, rejected steps included.
        termination: Ceres' word for why it stopped.
        message: Ceres' reason.
        gradient_max_norm: largest entry of the gradient at the solution, px^2 per unit of the parameters.
        seconds: spent in the solver.
    """

    state: State
    points: Array
    cost: float
    initial_cost: float
    num_iterations: int
    termination: Termination
    message: str
    gradient_max_norm: float
    seconds: float


@dataclass
class _Blocks:
    """The parameter blocks given to Ceres: a key (slot, block) and the array Ceres works in."""

    keys: list[tuple[int, int]]
    values: dict[tuple[int, int], Array]


def square_root(matrix: Array) -> Array:
    """Upper Cholesky factor of a positive semi-definite matrix given by its upper triangle.

    The matrix is scaled by its diagonal first, and a jitter relative to that makes the gauge's null
    space harmless. A parameter without any curvature gets a row of its own.
    """
    if not np.isfinite(matrix).all():
        raise FloatingPointError("the reduced system is not finite")
    diagonal = np.diag(matrix).copy()
    top = diagonal.max(initial=0.0)
    diagonal[diagonal <= 1e-300 + 1e-30 * top] = 1.0
    scale = 1.0 / np.sqrt(diagonal)
    scaled = matrix * scale * scale[:, None]
    jitter = _JITTER
    while True:
        trial = scaled.copy()
        trial[np.diag_indices_from(trial)] = np.maximum(np.diag(scaled), 0.0) + jitter
        # A C-ordered upper triangle is LAPACK's lower one, which spares it a transposing copy.
        factor, info = lapack.dpotrf(trial.T, lower=1, clean=1, overwrite_a=1)
        if info == 0:
            break
        jitter *= 100.0
        if jitter > 1.0:
            raise FloatingPointError("the reduced system is not finite")
    return np.asarray(factor.T / scale)


class _ReducedCost(pyceres.CostFunction):  # type: ignore[misc]
    """One chunk as Ceres sees it."""

    def __init__(self, chunk: Chunk, pool: ThreadPoolExecutor | None, watch: SolverWatch) -> None:
        super().__init__()
        self.chunk = chunk
        self.pool = pool
        self.watch = watch
        self.set_num_residuals(chunk.num_columns + 1)
        self.set_parameter_block_sizes(chunk.widths)

    def Evaluate(self, parameters: list[Array], residuals: Array, jacobians: list[Array | None] | None) -> bool:
        # An exception must not travel through Ceres' threads: keep it, fail, and raise it afterwards.
        if self.watch.errors:
            return False
        try:
            return self._evaluate(parameters, residuals, jacobians)
        except BaseException as exception:
            self.watch.errors.append(exception)
            return False

    def _evaluate(self, parameters: list[Array], residuals: Array, jacobians: list[Array | None] | None) -> bool:
        if jacobians is None:
            settled = self.chunk.settle(parameters, self.pool)
            if settled is None:
                return False
            residuals[:-1] = 0.0
            residuals[-1] = np.sqrt(2.0 * max(settled[1], 0.0))
            return True
        reduced = self.chunk.reduce(parameters, self.pool)
        if reduced is None or not (np.isfinite(reduced[0]) and np.isfinite(reduced[1]).all()):
            return False
        cost, gradient, matrix = reduced
        factor = square_root(matrix)
        head, _ = lapack.dtrtrs(factor.T, gradient, lower=1)
        residuals[:-1] = head
        residuals[-1] = np.sqrt(max(2.0 * cost - head @ head, 0.0))
        n = self.chunk.num_columns
        for key, width, jacobian in zip(self.chunk.keys, self.chunk.widths, jacobians, strict=True):
            if jacobian is None:
                continue
            first = self.chunk.first_column[key]
            block = jacobian.reshape(n + 1, width)
            block[:n] = factor[:, first : first + width]
            block[n] = 0.0
        return True


class _PriorCost(pyceres.CostFunction):  # type: ignore[misc]
    """A prior as Ceres sees it."""

    def __init__(self, block: PriorBlock, state: State, watch: SolverWatch) -> None:
        super().__init__()
        self.block = block
        self.watch = watch
        self.set_num_residuals(block.num_residuals)
        self.set_parameter_block_sizes([slot_width(slot, state) for slot, _ in block.keys])

    def Evaluate(self, parameters: list[Array], residuals: Array, jacobians: list[Array | None] | None) -> bool:
        if self.watch.errors:
            return False
        try:
            values, by_blocks = self.block.evaluate(parameters)
        except BaseException as exception:
            self.watch.errors.append(exception)
            return False
        residuals[:] = values
        for jacobian, by_block in zip(jacobians or [], by_blocks, strict=False):
            if jacobian is not None:
                jacobian[:] = by_block.ravel()
        return bool(np.isfinite(values).all())


@dataclass
class SolverWatch:
    """What happens during a solve: the exception to raise afterwards, if any, and the last gradient."""

    on_progress: Callable[[Progress], None] | None
    num_observations: int
    errors: list[BaseException] = field(default_factory=list)
    gradient_max_norm: float = float("nan")

    def raise_error(self) -> None:
        """Raise what stopped the solve, if anything did."""
        if self.errors:
            raise self.errors[0]


class SolverCallback(pyceres.IterationCallback):  # type: ignore[misc]
    """Reports every iteration to a watch, and stops Ceres once something was raised."""

    def __init__(self, watch: SolverWatch) -> None:
        super().__init__()
        self.watch = watch

    def __call__(self, summary: Any) -> Any:
        watch = self.watch
        if watch.errors:
            return pyceres.CallbackReturnType.SOLVER_ABORT
        try:
            watch.gradient_max_norm = float(summary.gradient_max_norm)
            if watch.on_progress is not None:
                watch.on_progress(
                    Progress(
                        iteration=int(summary.iteration),
                        cost=float(summary.cost),
                        rms=float(np.sqrt(2.0 * summary.cost / max(watch.num_observations, 1))),
                        gradient_max_norm=float(summary.gradient_max_norm),
                        step_norm=float(summary.step_norm),
                        successful=bool(summary.step_is_successful),
                    )
                )
        except BaseException as exception:
            watch.errors.append(exception)
            return pyceres.CallbackReturnType.SOLVER_ABORT
        return pyceres.CallbackReturnType.SOLVER_CONTINUE


def adjust(
    problem: Problem,
    settings: SolverSettings,
    *,
    anchor_weights: Array | None = None,
    plane_deviations: tuple[float, float] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Adjustment:
    """Minimise the refractive reprojection error from the problem's start.

    Args:
        problem: what to solve.
        settings: of Ceres.
        anchor_weights: (P,) weights of the proximal terms that keep each point near its start.
        plane_deviations: standard deviations (tilt in radians, distance in units of the solve) of normal priors
            that keep the planes near their start, for residuals of one px.
        on_progress: called after every iteration, on the calling thread.

    Returns:
        The solution; check `termination`.

    Raises:
        KeyboardInterrupt: Ctrl-C during the solve, once Ceres has stopped.
        FloatingPointError: the reduced system is not finite.
    """
    if problem.num_waves and not (
        problem.on_rays or problem.pinned_pose is not None or anchor_weights is not None or plane_deviations is not None
    ):
        return _adjust_whole(problem, settings, on_progress)
    chunks = split(problem, settings.num_threads)
    if anchor_weights is not None:
        for chunk in chunks:
            chunk.anchors = Anchors(anchor_weights[chunk.point_indices], chunk.points.copy())
    priors = prior_blocks(problem)
    keys = sorted({key for chunk in chunks for key in chunk.keys} | {key for prior in priors for key in prior.keys})
    blocks = _Blocks(keys, {key: np.zeros(slot_width(key[0], problem.state)) for key in keys})
    watch = SolverWatch(on_progress, len(problem.tracks.image))
    num_slices = max((len(chunk.slices) for chunk in chunks), default=1)
    pool = ThreadPoolExecutor(num_slices) if num_slices > 1 else None
    try:
        return _solve(problem, settings, chunks, priors, blocks, watch, pool, plane_deviations)
    finally:
        if pool is not None:
            pool.shutdown()


def _adjust_whole(
    problem: Problem, settings: SolverSettings, on_progress: Callable[[Progress], None] | None
) -> Adjustment:
    """`adjust` without Ceres, for the wide blocks of waves."""
    system = Whole(problem, settings.num_threads)
    tolerances = Tolerances(
        max_num_iterations=settings.max_num_iterations,
        function=settings.function_tolerance,
        gradient=settings.gradient_tolerance,
        parameter=settings.parameter_tolerance,
        initial_radius=settings.initial_trust_region_radius,
    )

    def on_step(iteration: int, cost: float, steepest: float, length: float, accepted: bool) -> None:
        if on_progress is not None:
            rms = float(np.sqrt(2.0 * cost / max(len(problem.tracks.image), 1)))
            on_progress(
                Progress(
                    iteration=iteration, cost=cost, rms=rms, gradient_max_norm=steepest, step_norm=length,
                    successful=accepted,
                )
            )  # fmt: skip

    pool = ThreadPoolExecutor(settings.num_threads) if settings.num_threads > 1 else None
    try:
        found = descend(system, tolerances, pool, on_step)
    finally:
        if pool is not None:
            pool.shutdown()
    termination: Termination = "convergence" if found.converged else "no_convergence"
    return Adjustment(
        state=apply(problem.state, system.change(found.x)),
        points=found.points,
        cost=found.cost,
        initial_cost=found.initial_cost,
        num_iterations=found.num_iterations,
        termination="failure" if found.converged is None else termination,
        message=found.message,
        gradient_max_norm=found.gradient_max_norm,
        seconds=found.seconds,
    )


def _solve(
    problem: Problem,
    settings: SolverSettings,
    chunks: list[Chunk],
    priors: list[PriorBlock],
    blocks: _Blocks,
    watch: SolverWatch,
    pool: ThreadPoolExecutor | None,
    plane_deviations: tuple[float, float] | None,
) -> Adjustment:
    ceres = pyceres.Problem()
    costs = [_ReducedCost(chunk, pool, watch) for chunk in chunks]
    if not blocks.keys:
        # Nothing on the camera side is free: the points alone are settled.
        settled = [chunk.settle([], pool) for chunk in chunks]
        cost = sum(s[1] if s else np.nan for s in settled)
        return Adjustment(
            state=problem.state, points=_settled(problem, chunks, blocks, pool), cost=cost, initial_cost=cost,
            num_iterations=0, termination="convergence" if np.isfinite(cost) else "failure",
            message="Only points are free.", gradient_max_norm=0.0, seconds=0.0,
        )  # fmt: skip
    for cost in costs:
        ceres.add_residual_block(cost, None, [blocks.values[key] for key in cost.chunk.keys])
    if problem.pinned_pose is not None and (POSE, problem.pinned_pose) in blocks.values:
        ceres.add_residual_block(
            _size_prior(problem.state.translation[problem.pinned_pose]),
            None,
            [blocks.values[POSE, problem.pinned_pose]],
        )
    for prior in priors:
        ceres.add_residual_block(
            _PriorCost(prior, problem.state, watch), None, [blocks.values[key] for key in prior.keys]
        )
    for key in blocks.keys:
        if key[0] != PLANE:
            continue
        if plane_deviations is not None:
            tilt, distance = plane_deviations
            prior = pyceres.factors.NormalPrior(np.zeros(3), np.diag([tilt**2, tilt**2, distance**2]))
            ceres.add_residual_block(prior, None, [blocks.values[key]])
        fixed = ([0, 1] if problem.held.normals[key[1]] else []) + ([2] if problem.held.distances[key[1]] else [])
        if fixed:
            ceres.set_manifold(blocks.values[key], pyceres.SubsetManifold(3, fixed))
    options = solver_options(settings)
    if len(chunks) == 1:
        options.linear_solver_type = pyceres.LinearSolverType.DENSE_NORMAL_CHOLESKY
    callback = SolverCallback(watch)
    options.callbacks = [callback]
    summary = pyceres.SolverSummary()
    # BLAS threads that wait for one another beside Ceres' own made a Cholesky of 600 unknowns take 1 s, not 5 ms.
    with threadpool_limits(limits=1, user_api="blas"):
        pyceres.solve(options, ceres, summary)
    watch.raise_error()
    return Adjustment(
        state=apply(problem.state, change_of(problem.state, blocks.values.items())),
        points=_settled(problem, chunks, blocks, pool),
        cost=float(summary.final_cost),
        initial_cost=float(summary.initial_cost),
        num_iterations=int(summary.num_successful_steps + summary.num_unsuccessful_steps),
        termination=termination_of(summary),
        message=str(summary.message),
        gradient_max_norm=watch.gradient_max_norm,
        seconds=float(summary.total_time_in_seconds),
    )


def solver_options(settings: SolverSettings) -> Any:
    """Ceres' options for the settings, with a sparse solver."""
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
    options.max_num_iterations = settings.max_num_iterations
    options.function_tolerance = settings.function_tolerance
    options.gradient_tolerance = settings.gradient_tolerance
    options.parameter_tolerance = settings.parameter_tolerance
    options.initial_trust_region_radius = settings.initial_trust_region_radius
    options.max_num_consecutive_invalid_steps = 20
    options.num_threads = settings.num_threads
    options.logging_type = pyceres.LoggingType.SILENT
    return options


def termination_of(summary: Any) -> Termination:
    """Why Ceres stopped."""
    kind = pyceres.TerminationType
    if summary.termination_type in (kind.CONVERGENCE, kind.USER_SUCCESS):
        return "convergence"
    return "no_convergence" if summary.termination_type == kind.NO_CONVERGENCE else "failure"


def _size_prior(translation: Array) -> Any:
    """A prior on a pose's change: its shift along its own translation is none, the rest is as good as free."""
    direction = np.concatenate([np.zeros(3), translation / np.linalg.norm(translation)])
    covariance = _FREE_VARIANCE * (np.eye(6) - np.outer(direction, direction))
    covariance += _PINNED_VARIANCE * np.outer(direction, direction)
    return pyceres.factors.NormalPrior(np.zeros(6), covariance)


def _settled(problem: Problem, chunks: list[Chunk], blocks: _Blocks, pool: ThreadPoolExecutor | None) -> Array:
    """All points (P, 3) at their minima for the final parameters."""
    points = problem.points.copy()
    for chunk in chunks:
        settled = chunk.settle([blocks.values[key] for key in chunk.keys], pool)
        if settled is not None:
            points[chunk.point_indices] = settled[0]
    return points


def settle_points(problem: Problem, settings: SolverSettings) -> Array:
    """Points (P, 3) at their minima, with everything on the camera side as it is."""
    held = replace(
        problem.held,
        poses=np.ones_like(problem.held.poses),
        normals=np.ones_like(problem.held.normals),
        distances=np.ones_like(problem.held.distances),
        index=True,
        lens=True,
        waves=True,
    )
    free_of_priors = replace(problem, held=held, wave_prior=None, level_prior=None)
    return adjust(free_of_priors, settings).points
