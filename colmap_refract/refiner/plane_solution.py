"""Flat interfaces: start, solve, filter and solve again, until nothing more comes or goes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from colmap_refract.estimator.adjustment import Adjustment, Progress, SolverSettings, adjust, settle_points
from colmap_refract.estimator.chunk import Problem
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.refiner.arrangement import Arrangement
from colmap_refract.refiner.continuation import (
    NARROW_VIEW_DEG,
    Watch,
    estimate_noise,
    is_sound,
    label_by_fit,
    named,
    residuals,
    view_deg,
)
from colmap_refract.refiner.filtering import label_wet, reprojection_errors
from colmap_refract.refiner.selection import Selection
from colmap_refract.refiner.solution import NEGLIGIBLE_CHANGE, Solution, from_scratch, raise_unsound, with_loss
from colmap_refract.refiner.uncertainty import Uncertainty, estimate_uncertainty

_NUM_FILTER_ROUNDS = 15
_NUM_RELABEL_ROUNDS = 20
"""Solves for points that change sides, besides those for the filter."""
_FIRST_FILTER = 2.0
"""Times the user's limit, before the first solve of all tracks."""
_TRUSTED = 0.8
"""Part of the observations that must fit the start for its planes to tell which points are dry."""
_NUM_FINISHES = 3
"""Solves that go on where a solver stopped early."""
_FINISHED = 5e-5
"""Part of the cost that a Newton step would still gain: small steps along a valley look like an end."""
_FINE = 1e-6
_FINER = 1e-2
"""Tolerance of each further solve over that of the last, where more than that is left."""


@dataclass(frozen=True, kw_only=True)
class Criterion:
    """What makes a solution the best.

    Attributes:
        adjust: the best cameras and planes, from a problem's start; with the points where their keypoints put them.
        uncertainty: of what that has found.
    """

    adjust: Callable[[Problem, SolverSettings, Callable[[Progress], None] | None], Adjustment]
    uncertainty: Callable[[Problem], Uncertainty]


def _adjust_freely(
    problem: Problem, settings: SolverSettings, on_progress: Callable[[Progress], None] | None
) -> Adjustment:
    return adjust(problem, settings, on_progress=on_progress)


NO_REFERENCE = Criterion(adjust=_adjust_freely, uncertainty=estimate_uncertainty)
"""The paper's `E_noref`: the errors of all images alike."""


def solve_planes(
    arrangement: Arrangement,
    settings: SolverSettings,
    earlier: Sidecar | None,
    watch: Watch | None,
    criterion: Criterion = NO_REFERENCE,
) -> Solution:
    """Solve with flat interfaces; see `solution.Way`.

    Raises:
        RefractError: the interface runs away, or nothing is left after the filter.
        FloatingPointError: nothing can be evaluated.
    """
    options = arrangement.options
    begin = from_scratch(arrangement, settings, watch) if earlier is None else arrangement.resume(earlier)
    noise = estimate_noise(begin)
    everything = np.ones(len(begin.tracks.image), dtype=np.bool_)
    selection, _ = Selection(arrangement=arrangement, problem=begin, keep=everything).relifted()
    # The start comes from a few tracks, or from others: what it finds wrong by little may be right.
    limit = _FIRST_FILTER * options.filter_max_reproj_error
    narrow = view_deg(selection.problem) < NARROW_VIEW_DEG
    geometric = not narrow and options.scenario != "fixed_camera"
    begun = selection
    if geometric:
        selection, _ = begun.filtered(label_wet(begun.problem), settings, limit)
        geometric = bool(selection.keep.mean() > _TRUSTED)
    if not geometric:
        # Planes hardly known do not tell a point's side, nor does a depth that a camera at rest has of a wrong match:
        # what is clearly better seen straight is dry.
        errors = reprojection_errors(begun.problem, begun.arrangement.observations)
        doubtful = limit == 0 or (errors > limit).mean() > NEGLIGIBLE_CHANGE
        selection, _ = begun.filtered(label_by_fit(begun.problem, doubtful=bool(doubtful)), settings, limit)
    num_filtered = num_relabelled = 0
    while True:
        stage = "Refractive bundle adjustment" + (f", filtered {num_filtered + 1} times" if num_filtered else "")
        _, problem = selection.active()
        problem = with_loss(arrangement, problem, noise)
        adjustment = criterion.adjust(problem, settings, named(watch, stage))
        noise = estimate_noise(replace(problem, state=adjustment.state, points=adjustment.points))
        selection = selection.solved(replace(problem, state=adjustment.state, points=adjustment.points))
        selection, moved = selection.relifted()
        wet = label_by_fit(selection.problem) if narrow else label_wet(selection.problem)
        relabels = geometric and adjustment.termination != "failure" and num_relabelled < _NUM_RELABEL_ROUNDS
        if relabels and selection.changes_sides(wet):
            # Planes that were found with points on the wrong side are off, and what is right looks wrong.
            selection = selection.relabelled(wet)
            num_relabelled += 1
            continue
        selection, changed = selection.filtered(wet, settings, options.filter_max_reproj_error)
        if (not moved and changed <= NEGLIGIBLE_CHANGE) or num_filtered == _NUM_FILTER_ROUNDS:
            break
        num_filtered += 1
    _, problem = selection.active()
    if changed > 0:
        # The last few outliers say too little to solve everything again for: points alone are settled anew.
        problem = replace(problem, points=settle_points(problem, settings))
    uncertainty = criterion.uncertainty(problem)
    # Whoever asks for less than a fine tolerance gets that.
    for _ in range(_NUM_FINISHES if settings.function_tolerance <= _FINE else 0):
        if uncertainty.decrement <= _FINISHED or adjustment.termination != "convergence":
            break
        settings = replace(settings, function_tolerance=_FINER * settings.function_tolerance)
        adjustment = criterion.adjust(problem, settings, named(watch, "Last steps"))
        problem = replace(problem, state=adjustment.state, points=adjustment.points)
        uncertainty = criterion.uncertainty(problem)
    if not is_sound(problem):
        raise_unsound(problem, options)
    active, _ = selection.active()
    return Solution(
        selection=selection,
        problem=problem,
        adjustment=adjustment,
        uncertainty=uncertainty,
        noise=estimate_noise(problem),
        residuals=residuals(problem),
        errors=reprojection_errors(problem, active.observations),
    )
