"""How well a solution is determined: covariances of the camera side, from the reduced system.

Seven directions (a similarity of the world) change no observation and have no variance of their own; the
covariance is the one in which the poses as a whole stay in place (inner constraints), or, where the poses are
held, as with a fixed camera, the points' mean distance: the planes' own would hide how badly all distances are
known. A rig with a baseline fixes the scale: then there are six. (So does a wall of known thickness, in principle,
but so badly that an adjustment holds the size; it counts as unseen here.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.sparse.linalg import splu

from colmap_refract.estimator import elimination
from colmap_refract.estimator.adjustment import SolverSettings, settle_points
from colmap_refract.estimator.banded import factorize
from colmap_refract.estimator.chunk import Problem, change_of, slot_width
from colmap_refract.estimator.elimination import LEVEL, MEDIUM, PLANE, POSE
from colmap_refract.estimator.priors import mean_plane
from colmap_refract.estimator.scenario import apply
from colmap_refract.estimator.whole import evaluated
from colmap_refract.interface import Array, tangent_basis
from colmap_refract.refiner.normal_equations import Key, normal_equations

_STEP = 1e-4
"""Radians, or of the median depth: small against what moves a point by much, large against how well it is settled."""
_POINT_STEP = 1e-6
"""Of the scene's radius: residuals are nearly linear in a point."""
_GAUGE_JITTER = 1e-10
"""Of the scaled diagonal."""
_FOLLOWED_POINTS = 200
_MOST_FOLLOWED = 600
"""Unknowns of a held camera's planes, each of which costs a solve of the followed points."""


@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """Standard deviations for observations of unit noise; multiply by the noise in px.

    Attributes:
        normal: (B,) of each plane's normal, radians (the larger axis of its ellipse).
        distance: (B,) of each plane's distance, units of the solve; NaN if there are too many planes to say so.
        index: of the refractive index, NaN where it was held.
        index_correlation: largest correlation of the index with the planes.
        decrement: what Newton's method would still gain, over the cost: a measure of convergence without units.
        determined: whether the system has full rank but for the gauge.
        points: median over the points of the deviation along the axis that is known the least, units of the solve,
            with all other unknowns held: what keypoints, and slopes that no surface takes, do to single points.
    """

    normal: Array
    distance: Array
    index: float
    index_correlation: float
    decrement: float
    determined: bool
    points: float = np.nan


def gauge(problem: Problem, keys: list[Key], columns: dict[Key, int], num_columns: int) -> Array:
    """The changes of the free blocks (num_columns, 0 to 7) that no observation can see."""
    structure, state = problem.structure, problem.state
    full: dict[Key, Array] = {}
    for f, (rotation, translation) in enumerate(zip(state.rotation, state.translation, strict=True)):
        by = np.zeros((6, 7))
        for j, axis in enumerate(np.eye(3)):
            by[3:, j] = -rotation @ axis
            by[:3, 3 + j] = -rotation @ axis
            by[3:, 3 + j] = np.cross(rotation @ axis, translation)
        by[3:, 6] = translation
        full[POSE, f] = by
    for b, normal in enumerate(state.normal):
        by = np.zeros((3, 7))
        by[2, 6] = state.distance[b]
        if structure.plane_in_world[b]:
            by = _similarity_of_plane(normal, float(state.distance[b]), structure.plane_anchor[b])
        full[PLANE, b] = by
    if (LEVEL, 0) in columns:
        level = mean_plane(structure, state)
        full[LEVEL, 0] = _similarity_of_plane(level.normal, level.distance, level.anchor)
    scale_fixed = np.abs(structure.sensor_translation).max() > 1e-12
    directions = np.eye(7)[:, : 6 if scale_fixed or problem.held.points else 7]
    # Only combinations that leave all that is held where it is are free.
    held = [by for key, by in full.items() if key not in columns]
    held += [by[:2] for (slot, b), by in full.items() if slot == PLANE and problem.held.normals[b]]
    held += [by[2:] for (slot, b), by in full.items() if slot == PLANE and problem.held.distances[b]]
    if problem.held.points:
        directions = directions[:, :0]
    if held and directions.shape[1]:
        blocked = np.concatenate(held) @ directions
        if np.abs(blocked).max() > 1e-12:
            directions = directions @ null_space(blocked, rcond=1e-9)
    result = np.zeros((num_columns, directions.shape[1]))
    for key in keys:
        if key in full:
            by = full[key] @ directions
            result[columns[key] : columns[key] + len(by)] = by
    return result


def _similarity_of_plane(normal: Array, distance: float, anchor: Array) -> Array:
    """How a world plane's block (3,) follows shifts, turns and growth of the world (3, 7)."""
    by = np.zeros((3, 7))
    by[2, :3] = normal
    for j, axis in enumerate(np.eye(3)):
        turned = np.cross(axis, normal)
        by[:2, 3 + j] = tangent_basis(normal).T @ turned
        by[2, 3 + j] = -turned @ anchor
    by[2, 6] = distance + normal @ anchor
    return by


def _fixed_columns(problem: Problem, columns: dict[Key, int]) -> NDArray[np.int64]:
    """Columns of blocks that are only partly free."""
    fixed = []
    for (slot, b), first in columns.items():
        if slot == PLANE:
            fixed += [first, first + 1] if problem.held.normals[b] else []
            fixed += [first + 2] if problem.held.distances[b] else []
    return np.array(fixed, dtype=np.int64)


def _growth_of_points(problem: Problem, keys: list[Key], columns: dict[Key, int], num_columns: int) -> Array:
    """How the mean log distance of the points from a held camera follows each free change (num_columns,).

    By forward differences, on some of the points.
    """
    tracks, state = problem.tracks, problem.state
    chosen = np.unique(np.linspace(0, len(problem.points) - 1, min(_FOLLOWED_POINTS, len(problem.points))).astype(int))
    lengths = np.diff(tracks.start)[chosen]
    start = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    take = np.arange(start[-1]) + np.repeat(tracks.start[chosen] - start[:-1], lengths)
    few = replace(
        problem,
        tracks=tracks.take(start, take),
        points=problem.points[chosen],
    )
    settings = SolverSettings(num_threads=1)
    center = -state.rotation[0].T @ state.translation[0]

    def size(points: Array) -> float:
        return float(np.log(np.linalg.norm(points - center, axis=1)).mean())

    settled = settle_points(few, settings)
    growth = np.zeros(num_columns)
    for key in keys:
        for j in range(slot_width(key[0], state)):
            step = np.zeros(slot_width(key[0], state))
            step[j] = _STEP
            moved = replace(few, state=apply(state, change_of(state, [(key, step)])), points=settled)
            growth[columns[key] + j] = (size(settle_points(moved, settings)) - size(settled)) / _STEP
    return growth


def estimate_uncertainty(problem: Problem, num_threads: int = 1) -> Uncertainty:
    """Covariances of planes and index at a solution.

    Args:
        problem: with `state` and `points` at the solution.
        num_threads: to evaluate it with.

    Returns:
        `Uncertainty`, per pixel of noise; NaN for planes that are held or undetermined.
    """
    num_planes = len(problem.state.normal)
    nan = np.full(num_planes, np.nan)
    unknown = Uncertainty(
        normal=nan, distance=nan.copy(), index=np.nan, index_correlation=np.nan, decrement=0.0, determined=False,
        points=_of_points(problem),
    )  # fmt: skip
    if problem.num_waves:
        return _with_waves(problem, unknown, num_threads)
    system = normal_equations(problem)
    if system is None or not system.keys:
        return unknown
    keys, columns, widths, n = system.keys, system.columns, system.widths, len(system.gradient)
    hessian, gradient, cost = system.hessian, system.gradient, system.cost
    free = np.setdiff1d(np.arange(n), _fixed_columns(problem, columns))
    hessian = hessian[free][:, free]
    diagonal = hessian.diagonal()
    if not (diagonal > 0).all():
        return unknown
    scale = 1.0 / np.sqrt(diagonal)
    scaled = sp.csc_array(sp.diags_array(scale) @ hessian @ sp.diags_array(scale))
    directions = gauge(problem, keys, columns, n)[free]
    # Inner constraints on the poses; where no pose is free, on the points.
    on_poses = np.concatenate([np.full(widths[key], key[0] == POSE) for key in keys])[free]
    size_known = True
    if on_poses.any() or not directions.shape[1]:
        constraint = directions * on_poses[:, None] * scale[:, None]
    elif len(free) <= _MOST_FOLLOWED:
        constraint = (_growth_of_points(problem, keys, columns, n)[free] * scale)[:, None]
    else:
        constraint, size_known = directions * scale[:, None], False
    norms = np.linalg.norm(constraint, axis=0)
    constraint = constraint[:, norms > 0] / norms[norms > 0]
    m = constraint.shape[1]
    bordered = sp.block_array([[scaled, constraint], [constraint.T, None]], format="csc") if m else scaled
    try:
        solver = splu(sp.csc_array(bordered))
    except RuntimeError:
        return unknown
    step = solver.solve(np.concatenate([gradient[free] * scale, np.zeros(m)]))[: len(free)]
    decrement = float(0.5 * (gradient[free] * scale) @ step / max(cost, 1e-300))
    position = np.full(n, -1)
    position[free] = np.arange(len(free))

    def covariance(indices: NDArray[np.int64]) -> tuple[Array, Array]:
        """Columns of the covariance (free, k) and the block at `indices` (k, k)."""
        right = np.zeros((len(free) + m, len(indices)))
        right[indices, np.arange(len(indices))] = scale[indices]
        solved = solver.solve(right)[: len(free)] * scale[:, None]
        return solved, solved[indices]

    normal, distance = nan.copy(), nan.copy()
    determined = True
    plane_variances = np.full(n, np.nan)
    for b in range(num_planes):
        if (PLANE, b) not in columns:
            continue
        at = position[columns[PLANE, b] + np.arange(3)]
        here = at[at >= 0]
        _, block = covariance(here)
        variance = np.diag(block)
        plane_variances[here] = variance
        if not (np.isfinite(block).all() and (variance > 0).all()):
            determined = False
            continue
        if at[0] >= 0:
            normal[b] = np.sqrt(np.linalg.eigvalsh(block[:2, :2])[-1])
        if at[2] >= 0 and size_known:
            distance[b] = np.sqrt(variance[-1])
    index, correlation = np.nan, np.nan
    if (MEDIUM, 0) in columns:
        at = position[columns[MEDIUM, 0] + np.arange(1)]
        column, block = covariance(at)
        if block[0, 0] > 0:
            index = float(np.sqrt(block[0, 0]))
            with np.errstate(invalid="ignore"):
                related = np.abs(column[:, 0]) / (index * np.sqrt(plane_variances[: len(free)]))
            correlation = float(np.nanmax(related)) if np.isfinite(related).any() else np.nan
    return replace(
        unknown, normal=normal, distance=distance, index=index, index_correlation=correlation,
        decrement=abs(decrement), determined=determined,
    )  # fmt: skip


def _of_points(problem: Problem) -> float:
    """`Uncertainty.points`, by central differences of the residuals."""
    count, of_point = len(problem.tracks.image), problem.tracks.start[:-1]
    views, optics = problem.views, problem.optics
    by_axis = np.empty((count, 2, 3))
    size = _POINT_STEP * float(np.median(np.linalg.norm(problem.points - problem.points.mean(axis=0), axis=1)))
    for axis in range(3):
        moved = np.empty((2, count, 2))
        for side, step in enumerate((size, -size)):
            points = problem.points.copy()
            points[:, axis] += step
            elimination.residuals(points, problem.tracks, views, optics, moved[side])
        by_axis[:, :, axis] = (moved[0] - moved[1]) / (2.0 * size)
    information = np.add.reduceat(np.einsum("nai,naj->nij", by_axis, by_axis), of_point)
    information = information[np.isfinite(information).all(axis=(1, 2))]
    if not len(information):
        return float("nan")
    least = np.linalg.eigvalsh(information)[:, 0]
    with np.errstate(divide="ignore"):
        return float(np.median(1.0 / np.sqrt(np.maximum(least, 0.0))))


def _with_waves(problem: Problem, unknown: Uncertainty, num_threads: int) -> Uncertainty:
    """`estimate_uncertainty` on the banded system: the free index, which waves would take up, is held with them."""
    found = evaluated(problem, num_threads)
    if found is None:
        return unknown
    system, cost, gradient, matrix = found
    n, held = system.num_columns, system.held_columns
    if not (matrix.diagonal > 0).all():
        return unknown
    scale = 1.0 / np.sqrt(matrix.diagonal)
    matrix.scale(scale)
    matrix.add_diagonal(_GAUGE_JITTER)
    factor = factorize(matrix)
    if factor is None:
        return unknown
    directions = gauge(problem, system.keys, system.columns, n)
    on_poses = np.zeros(n, dtype=np.bool_)
    for key, first in system.columns.items():
        on_poses[first : first + system.widths[key]] = key[0] == POSE
    size_known = True
    if on_poses.any() or not directions.shape[1]:
        constraint = directions * on_poses[:, None] * scale[:, None]
    elif n - len(held) <= _MOST_FOLLOWED:
        constraint = (_growth_of_points(problem, system.keys, system.columns, n) * scale)[:, None]
    else:
        constraint, size_known = directions * scale[:, None], False
    constraint[held] = 0.0
    norms = np.linalg.norm(constraint, axis=0)
    constraint = constraint[:, norms > 0] / norms[norms > 0]
    # What the gauge leaves free is large, by the jitter; under the constraint it is not.
    answer = factor.solve(constraint)
    within = np.linalg.inv(constraint.T @ answer)
    slope = gradient * scale
    step = factor.solve(slope)
    step = step - answer @ (within @ (constraint.T @ step))
    decrement = float(0.5 * slope @ step / max(cost, 1e-300))
    inverse = factor.inverse()
    free = np.ones(n, dtype=np.bool_)
    free[held] = False
    normal, distance, determined = unknown.normal.copy(), unknown.distance.copy(), True
    for (slot, b), first in system.columns.items():
        if slot != PLANE:
            continue
        here = np.arange(first, first + 3)
        here = here[free[here]]
        block = inverse.block(here) - answer[here] @ within @ answer[here].T
        block = block * scale[here] * scale[here][:, None]
        variance = np.diag(block)
        if not (np.isfinite(block).all() and (variance > 0).all()):
            determined = False
            continue
        if free[first]:
            normal[b] = np.sqrt(np.linalg.eigvalsh(block[:2, :2])[-1])
        if free[first + 2] and size_known:
            distance[b] = np.sqrt(variance[-1])
    return replace(unknown, normal=normal, distance=distance, decrement=abs(decrement), determined=determined)
