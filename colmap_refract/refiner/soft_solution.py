"""Waves: a surface for each image, or planes where the data do not determine waves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import SolverSettings
from colmap_refract.estimator.chunk import Problem
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.refiner.arrangement import Arrangement
from colmap_refract.refiner.continuation import Watch, counted, is_sound, residuals
from colmap_refract.refiner.filtering import reprojection_errors
from colmap_refract.refiner.plane_solution import solve_planes
from colmap_refract.refiner.selection import Selection
from colmap_refract.refiner.soft import (
    SoftSolution,
    Unsupported,
    filter_waves,
    go_on,
    level_start,
    solve_soft,
    wave_options,
)
from colmap_refract.refiner.solution import Solution, from_scratch
from colmap_refract.refiner.uncertainty import estimate_uncertainty
from colmap_refract.refiner.wave_output import add_waves

_LEAST_KEPT = 0.5
"""Part of the observations without which a solution with waves is none."""


def solve_waves(
    arrangement: Arrangement, settings: SolverSettings, earlier: Sidecar | None, watch: Watch | None
) -> Solution:
    """Solve with a surface for each image; see `solution.Way`.

    Raises:
        RefractError: what is refracted cannot wave; or as `solve_planes`, which is what is left without waves.
        FloatingPointError: nothing can be evaluated.
    """
    check_waves(arrangement)
    try:
        selection, soft = _solve_soft(arrangement, settings, earlier, watch)
    except Unsupported as unsupported:
        remark = f"{unsupported}; the interfaces are taken to be flat."
        return replace(solve_planes(arrangement, settings, earlier, watch), remarks=(remark,))
    active, _ = selection.active()
    counted(watch, "Uncertainties")(0, 1)
    return Solution(
        selection=selection,
        problem=soft.wavy.problem,
        adjustment=soft.adjustment,
        uncertainty=estimate_uncertainty(soft.solved, settings.num_threads),
        noise=soft.statistics.noise,
        residuals=residuals(soft.solved),
        errors=reprojection_errors(soft.wavy.problem, active.observations),
        describe=lambda sidecar, scale: add_waves(sidecar, active, soft, scale, counted(watch, "Surfaces")),
    )


def check_waves(arrangement: Arrangement) -> None:
    """Raises RefractError where no open water is between cameras and points."""
    options = arrangement.options
    if options.scenario == "camera_housing":
        raise RefractError("a housing's port does not wave: use interface_shape plane, or the scenario of open water")
    if any(options.layer_thickness):
        raise RefractError("a wall does not wave: use interface_shape plane, or leave out layer_thickness")


def wavy_start(
    arrangement: Arrangement, settings: SolverSettings, earlier: Sidecar | None, watch: Watch | None
) -> Problem:
    """All observations, before there are waves: planes that were solved for lean against them, level ones do not."""
    if earlier is not None:
        return arrangement.resume(earlier)
    if arrangement.options.scenario == "fixed_camera":
        return from_scratch(arrangement, settings, watch)
    return level_start(arrangement)


def _solve_soft(
    arrangement: Arrangement, settings: SolverSettings, earlier: Sidecar | None, watch: Watch | None
) -> tuple[Selection, SoftSolution]:
    """Start on level water, solve with waves, filter and solve again."""
    begin = wavy_start(arrangement, settings, earlier, watch)
    keep = np.ones(len(begin.tracks.image), dtype=np.bool_)
    options = wave_options(arrangement)
    soft = solve_soft(arrangement, begin, keep, options, settings, watch)
    marks = filter_waves(arrangement, soft.wavy.problem, soft.statistics.noise)
    counts = np.add.reduceat(marks.keep.astype(np.int64), begin.tracks.start[:-1])
    keep = marks.keep & np.repeat(counts >= 2, np.diff(begin.tracks.start))
    if keep.mean() < _LEAST_KEPT:
        raise Unsupported("Waves are not determined: with them most observations are far off")
    if not keep.all():
        soft = go_on(begin, keep, soft, options, settings, watch)
    problem = soft.wavy.problem
    if not is_sound(problem):
        raise Unsupported("Waves are not determined: with them the interface runs away from between cameras and points")
    return Selection(arrangement=arrangement, problem=begin, keep=keep, marks=marks), soft
