"""Flat interfaces with a reference image: points on its refracted rays, the paper's `E_hard`.

Everything but the criterion is as without a reference: start, sides and outliers. Those are judged with the points
where all keypoints put them, as a wrong keypoint of the reference would otherwise make all others of its point look
wrong. In the end the points are put on the rays, and those that the reference does not see where their rays meet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from colmap_refract.errors import RefractError, listed
from colmap_refract.estimator.adjustment import Adjustment, Progress, SolverSettings, adjust, settle_points
from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.printed_unknowns import with_anchors
from colmap_refract.estimator.reference_rays import (
    ReferenceRays,
    num_points_seen,
    on_reference_rays,
    with_distances_in_scene,
    with_other_points,
)
from colmap_refract.estimator.scenario import Index
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.interface import Array
from colmap_refract.refiner.arrangement import Arrangement, min_num_points
from colmap_refract.refiner.continuation import Watch, estimate_noise, is_sound, named, residuals
from colmap_refract.refiner.filtering import reprojection_errors
from colmap_refract.refiner.plane_solution import Criterion, solve_planes
from colmap_refract.refiner.solution import Solution
from colmap_refract.refiner.uncertainty import Uncertainty, estimate_uncertainty

_LEAST_SHARED = 5
"""Points in common with the reference that tell an image's pose and plane, nine unknowns."""

SHRUNK = (
    "distances in the scene are less in a smaller scene, and with this noise they are least where nothing is "
    "refracted: use residual pixels, or hold poses that are known (BundleAdjustment.refine_rig_from_world 0)"
)


def solve_on_reference_rays(
    arrangement: Arrangement, settings: SolverSettings, earlier: Sidecar | None, watch: Watch | None
) -> Solution:
    """Solve with the points on the rays of the reference image; see `solution.Way`.

    Standard deviations are those without a reference. They are too small, as the noise of the reference counts more
    here than it needs to.

    Raises:
        RefractError: the reference sees too few points, or as `solve_planes`.
        FloatingPointError: nothing can be evaluated.
    """
    check_reference(arrangement, arrangement.start(0.5, arrangement.observations))
    criterion = _OnRays(arrangement)
    solution = solve_planes(
        arrangement, settings, earlier, watch, Criterion(adjust=criterion.adjust, uncertainty=criterion.uncertainty)
    )
    in_scene = arrangement.options.residual == "scene"
    if in_scene:
        solution = _in_scene(criterion, solution, settings, watch)
    active, _ = solution.selection.active()
    rays = criterion.rays(solution.problem)
    on_rays = replace(rays.problem, points=settle_points(rays.problem, settings))
    points = with_other_points(solution.problem, rays, on_rays, settings)
    problem = replace(solution.problem, points=points)

    def describe(sidecar: Sidecar, scale: float) -> None:
        sidecar.statistics["reference"] = {
            "image": active.observations.image_names[active.reference],
            "residual": arrangement.options.residual,
            "num_points_adjusted": len(rays.points),
            "num_points_placed": len(points) - len(rays.points),
        }
        if in_scene:
            for key in ("cost", "gradient_max_norm"):
                sidecar.solver[key] *= scale**2

    return replace(
        solution,
        problem=problem,
        residuals=residuals(problem),
        errors=reprojection_errors(problem, active.observations),
        remarks=(*solution.remarks, *poorly_tied(active, rays.num_points_shared)),
        describe=describe,
    )


def _in_scene(criterion: _OnRays, solution: Solution, settings: SolverSettings, watch: Watch | None) -> Solution:
    """From a solution with errors in the images to one with distances in the scene, of the same observations."""
    problem = solution.problem
    rays = criterion.rays(problem)
    posed = with_distances_in_scene(rays)
    # The loss says what an outlier is in pixels; in the scene it is the same part of the spread.
    spread = [float(np.median(np.abs(_of_others(rays, residuals(p))))) for p in (rays.problem, posed)]
    posed = replace(posed, loss_scale=problem.loss_scale * spread[1] / max(spread[0], 1e-300))
    adjustment = adjust(posed, settings, on_progress=named(watch, "Distances in the scene"))
    problem = criterion.freely(problem, rays, posed, adjustment, settings)
    if adjustment.termination == "failure" or not is_sound(problem):
        raise RefractError(SHRUNK)
    found = replace(posed, state=adjustment.state, points=adjustment.points)
    decrement = estimate_uncertainty(found).decrement
    return replace(
        solution,
        problem=problem,
        adjustment=adjustment,
        uncertainty=replace(estimate_uncertainty(problem), decrement=decrement),
        noise=estimate_noise(problem),
    )


def check_reference(arrangement: Arrangement, problem: Problem) -> None:
    """Raises RefractError where the reference sees too few of a problem's points, and names an image that sees more."""
    seen = num_points_seen(problem)
    reference, names = arrangement.reference, arrangement.observations.image_names
    needed = min_num_points(arrangement.options.scenario, len(names))
    if seen[reference] >= needed:
        return
    others = np.where(arrangement.structure.image_plane >= 0, seen, -1)
    best = int(others.argmax())
    more = f"name one that sees more, such as '{names[best]}' ({seen[best]})"
    raise RefractError(
        f"the reference image '{names[reference]}' sees {seen[reference]} of {len(problem.points)} points together "
        f"with other images, and its rays need {needed}: "
        + (more if others[best] >= needed else "no other sees enough")
    )


def poorly_tied(arrangement: Arrangement, shared: Index) -> tuple[str, ...]:
    """A sentence about images that see too few of the reference's points (I,) to be adjusted, if there are any."""
    names = arrangement.observations.image_names
    poor = [names[i] for i in np.flatnonzero(shared < _LEAST_SHARED)]
    if not poor:
        return ()
    return (
        f"{len(poor)} images see fewer than {_LEAST_SHARED} points of the reference image's, and stayed as the start "
        f"had them ({listed(poor)}): leave them out, or name another --reference_image.",
    )


@dataclass(frozen=True)
class _OnRays:
    """The criterion: errors of all images but the reference, of the points on its rays."""

    arrangement: Arrangement

    def rays(self, problem: Problem) -> ReferenceRays:
        """The points of a problem that the reference sees, without images that share hardly any."""
        check_reference(self.arrangement, problem)
        reference = self.arrangement.reference
        rays = on_reference_rays(problem, reference, min_num_points=1)
        poor = rays.num_points_shared < _LEAST_SHARED
        stays = ~poor[problem.tracks.image]
        if stays.all():
            return rays
        counts = np.add.reduceat(stays.astype(np.int64), problem.tracks.start[:-1])
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        return on_reference_rays(
            replace(problem, tracks=problem.tracks.take(start, stays)), reference, min_num_points=1
        )

    def adjust(
        self, problem: Problem, settings: SolverSettings, on_progress: Callable[[Progress], None] | None
    ) -> Adjustment:
        rays = self.rays(problem)
        adjustment = adjust(rays.problem, settings, on_progress=on_progress)
        free = self.freely(problem, rays, rays.problem, adjustment, settings)
        return replace(adjustment, points=free.points)

    def freely(
        self, problem: Problem, rays: ReferenceRays, posed: Problem, adjustment: Adjustment, settings: SolverSettings
    ) -> Problem:
        """All observations at a solution of `posed`, with the points where all keypoints put them."""
        state = with_anchors(adjustment.state, posed.structure, problem.structure.plane_anchor)
        solved = replace(rays.problem, state=state, points=adjustment.points)
        problem = replace(problem, state=state)
        problem = replace(problem, points=with_other_points(problem, rays, solved, settings))
        return replace(problem, points=settle_points(problem, settings))

    def uncertainty(self, problem: Problem) -> Uncertainty:
        # The noise of the reference is not in what its rays leave.
        on_rays = estimate_uncertainty(self.rays(problem).problem)
        return replace(estimate_uncertainty(problem), decrement=on_rays.decrement)


def _of_others(rays: ReferenceRays, values: Array) -> Array:
    """Without those of the reference's own observations."""
    return np.asarray(values[rays.problem.tracks.image != rays.reference])
