"""Levenberg-Marquardt on the whole system (module `whole`), with the rules and tolerances of Ceres' own."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from colmap_refract.estimator.banded import Banded, factorize
from colmap_refract.estimator.whole import Whole
from colmap_refract.interface import Array

_MOST_INVALID = 20
_LEAST_DECREASE = 1e-3
_LEAST_DIAGONAL, _MOST_DIAGONAL = 1e-6, 1e32
_MOST_RADIUS, _LEAST_RADIUS = 1e16, 1e-32


@dataclass(frozen=True, kw_only=True)
class Tolerances:
    """As Ceres names them."""

    max_num_iterations: int
    function: float
    gradient: float
    parameter: float
    initial_radius: float


@dataclass(frozen=True, kw_only=True)
class Descent:
    """Where it ended.

    Attributes:
        x: values of the system's columns.
        points: (P, 3).
        cost, initial_cost: px^2.
        num_iterations: rejected steps included.
        converged: whether a tolerance was met; None: it failed.
        message: why it ended.
        gradient_max_norm: of the last accepted step.
        seconds: taken.
    """

    x: Array
    points: Array
    cost: float
    initial_cost: float
    num_iterations: int
    converged: bool | None
    message: str
    gradient_max_norm: float
    seconds: float


def descend(
    system: Whole,
    tolerances: Tolerances,
    pool: ThreadPoolExecutor | None,
    on_step: Callable[[int, float, float, float, bool], None] | None = None,
) -> Descent:
    """Minimise a system's cost from its state.

    Args:
        system: of the problem.
        tolerances: relative.
        pool: for threads.
        on_step: called with `(iteration, cost, gradient's largest entry, length of the step, accepted)`.

    Raises:
        FloatingPointError: the reduced system is not finite.
    """
    began = perf_counter()
    x = np.zeros(system.num_columns)
    settled = system.settle(x, system.points, pool)
    reduced = None if settled is None or not system.keys else system.reduce(x, settled[0], pool)
    if settled is None or (system.keys and reduced is None):
        return Descent(
            x=x, points=system.points, cost=np.nan, initial_cost=np.nan, num_iterations=0, converged=None,
            message="The start cannot be evaluated.", gradient_max_norm=np.nan, seconds=perf_counter() - began,
        )  # fmt: skip
    points, cost = settled
    initial = cost
    if not system.keys:
        return Descent(
            x=x, points=points, cost=cost, initial_cost=cost, num_iterations=0, converged=True,
            message="Only points are free.", gradient_max_norm=0.0, seconds=perf_counter() - began,
        )  # fmt: skip
    assert reduced is not None
    gradient, matrix = _finite(reduced)
    del reduced
    # Once, so that the trust region keeps its shape.
    scale = 1.0 / (1.0 + np.sqrt(np.maximum(matrix.diagonal, 0.0)))
    radius, slower = tolerances.initial_radius, 2.0
    steepest = float(np.abs(gradient).max(initial=0.0))
    iteration = invalid = 0
    slope = gradient * scale
    matrix.scale(scale)
    if on_step is not None:
        on_step(0, cost, steepest, 0.0, True)

    def end(converged: bool | None, message: str) -> Descent:
        return Descent(
            x=x, points=points, cost=cost, initial_cost=initial, num_iterations=iteration, converged=converged,
            message=message, gradient_max_norm=steepest, seconds=perf_counter() - began,
        )  # fmt: skip

    while True:
        if steepest <= tolerances.gradient:
            return end(True, f"Gradient tolerance reached. Gradient max norm: {steepest:.6e}")
        if iteration >= tolerances.max_num_iterations:
            return end(False, f"Maximum number of iterations reached. Number of iterations: {iteration}.")
        if radius < _LEAST_RADIUS:
            return end(True, f"Minimum trust region radius reached: {radius:.6e}")
        iteration += 1
        damping = np.clip(matrix.diagonal, _LEAST_DIAGONAL, _MOST_DIAGONAL) / radius
        damped = matrix.copy()
        damped.add_diagonal(damping)
        factor = factorize(damped)
        trial = None
        step, promised = np.zeros_like(x), 0.0
        if factor is not None:
            by = -factor.solve(slope)
            # No second matrix while the next is made.
            del factor, damped
            promised = float(-0.5 * slope @ by + 0.5 * by @ (damping * by))
            step = by * scale
            length, reach = float(np.linalg.norm(step)), float(np.linalg.norm(x))
            if length <= tolerances.parameter * (reach + tolerances.parameter):
                return end(True, f"Parameter tolerance reached. Step: {length:.6e}")
            trial = system.settle(x + step, points, pool) if promised > 0.0 else None
        invalid = 0 if trial is not None else invalid + 1
        if invalid > _MOST_INVALID:
            return end(None, "Number of consecutive invalid steps more than the solver takes.")
        gained = cost - trial[1] if trial is not None else -np.inf
        accepted = trial is not None and gained > _LEAST_DECREASE * promised
        small = trial is not None and abs(gained) <= tolerances.function * cost
        before = cost
        if accepted and trial is not None:
            x, (points, cost) = x + step, trial
            quality = gained / promised
            radius = min(radius / max(1.0 / 3.0, 1.0 - (2.0 * quality - 1.0) ** 3), _MOST_RADIUS)
            slower = 2.0
        else:
            radius /= slower
            slower *= 2.0
        if small:
            return end(True, f"Function tolerance reached. |cost_change|/cost: {abs(gained) / before:.6e}")
        if accepted:
            del matrix
            again = system.reduce(x, points, pool)
            if again is None:
                return end(None, "The solution cannot be evaluated.")
            gradient, matrix = _finite(again)
            del again
            steepest = float(np.abs(gradient).max(initial=0.0))
            slope = gradient * scale
            matrix.scale(scale)
        if on_step is not None:
            on_step(iteration, cost, steepest, float(np.linalg.norm(step)), accepted)


def _finite(reduced: tuple[Array, Banded]) -> tuple[Array, Banded]:
    gradient, matrix = reduced
    if not (np.isfinite(gradient).all() and np.isfinite(matrix.diagonal).all()):
        raise FloatingPointError("the reduced system is not finite")
    return reduced
