"""`E_soft` as the paper prints it: a normal for every observation, kept alike by a local regulariser.

    E_soft = sum_ij |D_ij|^2 + smoothness * sum_ij sum_{n_k in N_ij} |n_k - mean(N_ij)|^2

The reference camera's frame is the paper's world. A point is the reference's ray and one length `d_j` along it,
behind the interface; `D_ij` compares it with the ray of every other observation (module `back_projection`), and
`N_ij` are the observations of the same image within a radius (module `neighbours`), whose normals are compared
in the camera's frame. Unknown are the lengths, a unit normal per observation, the reference's included, and the
pose and plane blocks of the problem's tying. Held are the reference's pose and its plane's distance (the paper's
`d_r = 1`), so that the size is the start's, and whatever the problem holds.

As printed, nothing ties an image's plane to the normals on it: the plane only says where the rays meet the surface,
which is a weak direction even under strong smoothness, and convergence is slow for it.

Exact and plain, for tens of images and up to a few thousand points: the reference for any faster form.

Ceres minimises half the sum of squares: every cost here is half of what the paper writes, and `smoothness` is the
paper's `lambda` itself. Lengths are in units of the solve, not of `d_r`: for residuals in the scene, the paper's
`lambda` for its `d_r = 1` is `smoothness / d_r^2`.

An iteration costs the factorisation of a matrix in which all normals of an image are coupled, and those of a point:
the images' normals fall away, a dense block of about three unknowns per point stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pyceres
from threadpoolctl import threadpool_limits

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import (
    Progress,
    SolverCallback,
    SolverSettings,
    SolverWatch,
    Termination,
    solver_options,
    termination_of,
)
from colmap_refract.estimator.chunk import Problem, robust_cost
from colmap_refract.estimator.neighbours import neighbour_weights
from colmap_refract.estimator.printed_terms import DistanceToRay, ImageViews, pixel_weights
from colmap_refract.estimator.printed_unknowns import (
    Pairing,
    anchored,
    blocks_at_start,
    check_count,
    fixed_of_plane,
    images_of,
    pair,
    points_in_reference,
    state_after,
    with_anchors,
)
from colmap_refract.estimator.scenario import State
from colmap_refract.interface import Array
from colmap_refract.options import Loss

_MAX_TRUST_REGION_RADIUS = 1e10
"""Along the weak directions steps are good for long, and Ceres' radius grows until the factorisation fails."""


@dataclass(frozen=True, kw_only=True)
class PrintedAdjustment:
    """Outcome of `adjust_as_printed`.

    Attributes:
        state: poses and planes.
        points: (P, 3) world; NaN for those that take no part.
        normals: (N, 3) `n_ij` of each observation, in its camera's frame; NaN for those that take no part.
        cost: `data_cost + smoothness_cost`.
        data_cost: half the (robust) sum of squared distances, in squared units of the residual.
        smoothness_cost: half of `smoothness` times the regulariser.
        num_iterations: of Ceres, rejected steps included.
        termination: Ceres' word for why it stopped; after a `failure` the rest is the start.
        message: Ceres' reason.
        gradient_max_norm: largest entry of the gradient at the solution, in squared units of the residual per unit of
            the parameters.
    """

    state: State
    points: Array
    normals: Array
    cost: float
    data_cost: float
    smoothness_cost: float
    num_iterations: int
    termination: Termination
    message: str
    gradient_max_norm: float


def adjust_as_printed(
    problem: Problem,
    keypoints: Array,
    *,
    reference: int,
    smoothness: float,
    radius: float,
    residual: Literal["scene", "pixels"] = "scene",
    loss: Loss = "trivial",
    loss_scale: float = 1.0,
    settings: SolverSettings,
    on_progress: Callable[[Progress], None] | None = None,
) -> PrintedAdjustment:
    """Minimise `E_soft` from the problem's start, all normals from their planes'.

    Points that the reference does not see through its interface, or that no other image sees, take no part, nor does
    any second observation of a point by one image. An image without a point in common with the reference stays as
    it is. The index and the intrinsics are held. The problem's own robust loss is not used: its scale is in px.

    Args:
        problem: data, tying and start.
        keypoints: (N, 2) px, of the problem's observations.
        reference: index of the reference image.
        smoothness: the paper's `lambda`, in squared units of the residual (see the module's docstring).
        radius: px, of the neighbourhoods.
        residual: `scene`: `D_ij` as printed, in units of the terms. `pixels`: times the projection's Jacobian at the
            start, a fixed matrix per observation, which makes it pixels to first order.
        loss, loss_scale: robust loss of `|D_ij|` and its scale in units of the residual.
        settings: of Ceres.
        on_progress: called after every iteration, on the calling thread.

    Returns:
        The solution; check `termination`.

    Raises:
        RefractError: a `smoothness` or `radius` that has no meaning, walls, refined intrinsics, known points, or a
            reference that sees too few points.
        KeyboardInterrupt: Ctrl-C during the solve, once Ceres has stopped.
    """
    _check(problem, reference, smoothness)
    problem, anchors = anchored(problem, reference), problem.structure.plane_anchor
    pairing = pair(problem, reference)
    pairs = _pairs_of_normals(problem, pairing, keypoints, radius)
    blocks = blocks_at_start(problem, pairing)
    check_count(problem, pairing, blocks)
    weight = np.broadcast_to(np.eye(2), (len(pairing.others), 2, 2))
    if residual == "pixels":
        weight = pixel_weights(problem, pairing, points_in_reference(problem, problem.state, pairing, blocks))
    watch = SolverWatch(on_progress, len(pairing.others))
    views = {i: ImageViews(problem.structure, problem.state, i, reference) for i in images_of(problem, pairing)}
    costs = [
        DistanceToRay(problem, pairing, row, blocks, views, weight[row], watch.errors)
        for row in range(len(pairing.others))
    ]
    ceres = pyceres.Problem()
    robust = _robust_loss(loss, loss_scale)
    for cost in costs:
        ceres.add_residual_block(cost, robust, cost.blocks)
    for k, m, share in pairs if smoothness > 0 else []:
        alike = pyceres.factors.NormalError(np.eye(3) / (smoothness * share))
        ceres.add_residual_block(alike, None, [blocks.normal[k], blocks.normal[m]])
    for normal in blocks.normal.values():
        ceres.set_manifold(normal, pyceres.SphereManifold(3))
    for block, plane in blocks.plane.items():
        fixed = fixed_of_plane(problem, reference, block)
        if fixed:
            ceres.set_manifold(plane, pyceres.SubsetManifold(3, fixed))
    summary = _solve(ceres, settings, watch)

    state = state_after(problem, blocks)
    points = np.full_like(problem.points, np.nan)
    rotation, translation = (pose[reference] for pose in state.cam_from_world(problem.structure))
    points[pairing.point] = (points_in_reference(problem, state, pairing, blocks) - translation) @ rotation
    normals = np.full((len(problem.tracks.image), 3), np.nan)
    normals[list(blocks.normal)] = list(blocks.normal.values())
    data_cost = 0.5 * float(robust_cost(_squared_distances(costs), loss, loss_scale).sum())
    spread = sum(share * float(((normals[k] - normals[m]) ** 2).sum()) for k, m, share in pairs)
    return PrintedAdjustment(
        state=with_anchors(state, problem.structure, anchors),
        points=points,
        normals=normals,
        cost=data_cost + 0.5 * smoothness * spread,
        data_cost=data_cost,
        smoothness_cost=0.5 * smoothness * spread,
        num_iterations=int(summary.num_successful_steps + summary.num_unsuccessful_steps),
        termination=termination_of(summary),
        message=str(summary.message),
        gradient_max_norm=watch.gradient_max_norm,
    )


def _check(problem: Problem, reference: int, smoothness: float) -> None:
    if not (np.isfinite(smoothness) and smoothness >= 0):
        raise RefractError(f"a smoothness of {smoothness:g} cannot weigh anything: give 0 or more")
    if any(problem.layers.thickness):
        raise RefractError("the soft constraint is for a surface that waves, which a wall does not: leave walls out")
    if problem.held.points:
        raise RefractError("the soft constraint seeks the points' depths: it cannot hold the points")
    if problem.state.lens.any():
        raise RefractError(
            "the soft constraint takes intrinsics as known: lift the keypoints with the refined ones first"
        )
    if problem.structure.image_plane[reference] < 0:
        raise RefractError("the reference image has no interface: choose one that has")


def _pairs_of_normals(
    problem: Problem, pairing: Pairing, keypoints: Array, radius: float
) -> list[tuple[int, int, float]]:
    """Pairs of observations whose normals the regulariser compares, each with its weight `w_kl`."""
    tracks = problem.tracks
    taking_part = np.sort(np.concatenate([pairing.of_reference, pairing.others]))
    taking_part = taking_part[tracks.wet[taking_part]]
    pairs: list[tuple[int, int, float]] = []
    for i in images_of(problem, pairing):
        mine = taking_part[tracks.image[taking_part] == i]
        weights = neighbour_weights(keypoints[mine], radius).tocoo()
        pairs += zip(mine[weights.row].tolist(), mine[weights.col].tolist(), weights.data.tolist(), strict=True)
    return pairs


def _squared_distances(costs: list[DistanceToRay]) -> Array:
    """(m,) squared norms of the residuals; NaN where a ray does not exist."""
    residual = np.full((len(costs), 2), np.nan)
    for cost, row in zip(costs, residual, strict=True):
        cost.Evaluate(cost.blocks, row, None)
    return np.asarray((residual**2).sum(axis=1))


def _robust_loss(loss: Loss, scale: float) -> Any:
    kinds = {"huber": pyceres.HuberLoss, "soft_l1": pyceres.SoftLOneLoss, "cauchy": pyceres.CauchyLoss}
    return None if loss == "trivial" else kinds[loss](scale)


def _solve(ceres: Any, settings: SolverSettings, watch: SolverWatch) -> Any:
    """Run Ceres on the blocks in place; its summary."""
    options = solver_options(settings)
    options.max_trust_region_radius = _MAX_TRUST_REGION_RADIUS
    callback = SolverCallback(watch)
    options.callbacks = [callback]
    summary = pyceres.SolverSummary()
    with threadpool_limits(limits=1, user_api="blas"):
        pyceres.solve(options, ceres, summary)
    watch.raise_error()
    return summary
