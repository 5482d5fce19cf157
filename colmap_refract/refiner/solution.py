"""What each way of solving hands over to be written out, and what the ways have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import Adjustment, SolverSettings
from colmap_refract.estimator.chunk import Problem
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.interface import Array
from colmap_refract.options import RefinerOptions
from colmap_refract.refiner.arrangement import Arrangement
from colmap_refract.refiner.continuation import MIN_DISTANCE, Watch, find_start, spread_out
from colmap_refract.refiner.selection import Selection
from colmap_refract.refiner.uncertainty import Uncertainty

LOSS_SCALE_IN_NOISE = 4.0
"""Of the default loss: wide enough to lose nothing on Gaussian noise, narrow enough to stop a wrong match."""
NEGLIGIBLE_CHANGE = 1e-3
"""Part of the observations whose removal or relabelling is not worth another solve."""
_LEAST_LOSS_SCALE = 1.0


@dataclass(frozen=True, kw_only=True)
class Solution:
    """What was found, of the observations that stay.

    Attributes:
        selection: which observations stay.
        problem: of those n, with the solution as its state and points.
        adjustment: the last.
        uncertainty: of the planes, for keypoints of unit noise.
        noise: of a keypoint coordinate, px.
        residuals: (n, 2) px, as the surfaces take them.
        errors: (n,) exact reprojection errors, px.
        remarks: what the user should hear of how it was solved, one sentence each.
        describe: puts what is particular to it into the sidecar; takes the output's units per unit of the solve.
    """

    selection: Selection
    problem: Problem
    adjustment: Adjustment
    uncertainty: Uncertainty
    noise: float
    residuals: Array
    errors: Array
    remarks: tuple[str, ...] = ()
    describe: Callable[[Sidecar, float], None] | None = None


Way = Callable[[Arrangement, SolverSettings, Sidecar | None, Watch | None], Solution]
"""How an arrangement is solved, from scratch or from the sidecar of an earlier refinement, and watched."""


def from_scratch(arrangement: Arrangement, settings: SolverSettings, watch: Watch | None) -> Problem:
    """All observations, from a start that is sought."""
    start = find_start(arrangement, settings, watch)
    if not start.sound:
        raise_unsound(start.problem, arrangement.options)
    return spread_out(arrangement, start, settings)


def with_loss(arrangement: Arrangement, problem: Problem, noise: float) -> Problem:
    """The problem under the user's robust loss."""
    adjustment = arrangement.options.BundleAdjustment
    scale = adjustment.loss_function_scale
    if scale is None:
        scale = max(LOSS_SCALE_IN_NOISE * noise, _LEAST_LOSS_SCALE)
    return replace(problem, loss=adjustment.loss_function_type, loss_scale=scale)


def raise_unsound(problem: Problem, options: RefinerOptions) -> None:
    """Say in which way the interface ran away."""
    _, distance = problem.state.planes_in_cam(problem.structure)
    near = bool(np.nanmin(distance) <= MIN_DISTANCE)
    if options.scenario == "fixed_camera":
        # Only tilts that differ tell the water's depth: equal planes show the same whatever their distance.
        raise RefractError(
            f"the interface ran {'into the camera' if near else 'beyond the points, where nothing is refracted'}: its "
            "distance cannot be told from these images; it takes larger tilts or more images, or hold a known "
            "interface_distance (refine_interface_distance 0); else check the intrinsics (camera_path) and the scenario"
        )
    if near:
        raise RefractError(
            "the interface ran into the camera: the data do not show it at a distance; check the scenario, use "
            "intrinsics from air (camera_path), or hold interface_distance (refine_interface_distance 0)"
        )
    raise RefractError(
        "the interface ran beyond the points, where nothing is refracted: either the scene is dry, or the intrinsics "
        "have absorbed the refraction (give those calibrated in air, camera_path), or the scenario is another one"
    )
