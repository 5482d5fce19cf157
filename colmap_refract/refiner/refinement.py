"""The sequence a user sees: read, start, solve, filter and solve again, judge, put back into the model's frame."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import Adjustment, SolverSettings, adjust, settle_points
from colmap_refract.estimator.chunk import Problem
from colmap_refract.files.cameras_file import fit_to_size, known_camera
from colmap_refract.files.model_io import copy_model
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.machine import threads
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.refiner.advice import Facts, advise, advise_on_input, has_converged
from colmap_refract.refiner.arrangement import Arrangement, arrange
from colmap_refract.refiner.averaging import average_groups
from colmap_refract.refiner.continuation import (
    MIN_DISTANCE,
    NARROW_VIEW_DEG,
    Watch,
    counted,
    estimate_noise,
    find_start,
    is_sound,
    label_by_fit,
    named,
    residuals,
    spread_out,
    view_deg,
)
from colmap_refract.refiner.diagnosis import spatial_correlation
from colmap_refract.refiner.filtering import label_wet, pinhole_errors, reprojection_errors
from colmap_refract.refiner.observations import read_observations
from colmap_refract.refiner.outcome import make_sidecar, output_frame, statistics, write_back
from colmap_refract.refiner.selection import Selection
from colmap_refract.refiner.soft import (
    SoftSolution,
    Unsupported,
    filter_waves,
    go_on,
    level_start,
    settle_everywhere,
    solve_soft,
    wave_options,
)
from colmap_refract.refiner.uncertainty import Uncertainty, estimate_uncertainty
from colmap_refract.refiner.wave_output import add_waves

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger(__name__)

LOSS_SCALE_IN_NOISE = 4.0
"""Of the default loss: wide enough to lose nothing on Gaussian noise, narrow enough to stop a wrong match."""
_LEAST_LOSS_SCALE = 1.0
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
_NUM_WAVE_FILTERS = 3
_LEAST_KEPT = 0.5
"""Part of the observations without which a solution with waves is none."""
_NEGLIGIBLE_CHANGE = 1e-3
"""Part of the observations whose removal or relabelling is not worth another solve."""


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """What `refine` returns.

    Attributes:
        reconstruction: the refined model, a new object; ids, names, keypoints, colours and tracks are the
            input's but for what was filtered, and `point3D.error` is the refractive error in px.
        sidecar: the planes, their standard deviations, the solver's word and the counts: `refraction.json`.
        warnings: what is badly determined or looks wrong, and what to do about it, one sentence each.
        converged: whether the solver came to a minimum.
    """

    reconstruction: pycolmap.Reconstruction
    sidecar: Sidecar
    warnings: tuple[str, ...]
    converged: bool


def refine(
    reconstruction: pycolmap.Reconstruction,
    options: RefinerOptions,
    *,
    notes: ImageNotes | None = None,
    cameras: Mapping[int, pycolmap.Camera] | None = None,
    earlier: Sidecar | None = None,
    watch: Watch | None = None,
) -> Refinement:
    """Refine a model whose images were taken through plane interfaces.

    Args:
        reconstruction: a COLMAP model that ignored refraction; not altered.
        options: the scenario, what is known and what is held.
        notes: which images share an interface, and which have none.
        cameras: intrinsics calibrated in air by camera id, in place of the model's. A single camera
            stands for all of the model's, whatever its id.
        earlier: of the refinement that the model comes from, if it does: its interfaces are the start, and none
            is sought.
        watch: called with the stage's name and the solver's progress after every iteration.

    Returns:
        `Refinement`, in the input's world frame and size (in metres if `interface_distance` is given).

    Raises:
        RefractError: the model or the options cannot be used; one line says what to do.
        KeyboardInterrupt: Ctrl-C during a solve; nothing has been changed.
    """
    started = perf_counter()
    if not isinstance(options, RefinerOptions) or options.interface_shape == "auto":
        raise RefractError("the scenario or the interface_shape is auto: have choose_scenario find it")
    notes = notes or ImageNotes()
    model = copy_model(reconstruction)
    _check_model(model)
    observations = read_observations(model)
    before = pinhole_errors(observations)
    remarks: list[str] = []
    if cameras:
        remarks = _replace_cameras(model, cameras)
        observations = read_observations(model)
    if not len(observations.points):
        raise RefractError("the model has no point that two registered images see: there is nothing to refine")
    averaged = average_groups(observations, options, notes.interface_groups) if options.average_groups else None
    arrangement = arrange(
        observations if averaged is None else averaged.observations, options, notes, refined=earlier is not None
    )
    num_unusable = model.compute_num_observations() - len(observations.image)
    settings = SolverSettings(
        num_threads=threads(options.num_threads),
        max_num_iterations=options.BundleAdjustment.max_num_iterations,
        function_tolerance=options.BundleAdjustment.function_tolerance,
    )
    solve_started = perf_counter()
    remarks_on_waves: list[str] = []
    soft: SoftSolution | None = None
    try:
        if options.interface_shape == "soft":
            _check_waves(arrangement)
            try:
                selection, soft = _solve_soft(arrangement, settings, earlier, watch)
            except Unsupported as unsupported:
                remarks_on_waves = [f"{unsupported}; the interfaces are taken to be flat."]
        if soft is None:
            selection, problem, adjustment, uncertainty = _solve(arrangement, settings, earlier, watch)
        else:
            problem, adjustment = soft.wavy.problem, soft.adjustment
            counted(watch, "Uncertainties")(0, 1)
            uncertainty = estimate_uncertainty(soft.solved, settings.num_threads)
    except FloatingPointError as error:
        raise RefractError(
            f"the adjustment could not be evaluated ({error}): check the model and the scenario"
        ) from None
    solve_seconds = perf_counter() - solve_started
    arrangement, _ = selection.active()
    errors = reprojection_errors(problem, arrangement.observations)
    noise = estimate_noise(problem) if soft is None else soft.statistics.noise
    active = arrangement.observations
    correlation = spatial_correlation(active.image, active.pixel, residuals(problem if soft is None else soft.solved))
    facts = Facts(
        arrangement=arrangement,
        problem=problem,
        adjustment=adjustment,
        uncertainty=uncertainty,
        noise=noise,
        pinhole_errors=before,
        calibrated=bool(cameras),
        errors=errors,
        correlation=correlation,
    )
    # A model that comes from a refinement says nothing of its input any more.
    about_input = [*remarks, *advise_on_input(facts)] if earlier is None else earlier.solver.get("input_warnings", [])
    warnings = [*about_input, *remarks_on_waves, *advise(facts)]
    to_output = output_frame(arrangement, problem.state, problem.points)
    stays = arrangement.observations if averaged is None else observations.select(averaged.members(selection.keep))
    write_back(model, arrangement, problem, errors, to_output, stays)
    sidecar = make_sidecar(arrangement, notes, problem, adjustment, uncertainty, noise, to_output, warnings)
    sidecar.solver["input_warnings"] = about_input
    if correlation is not None:
        sidecar.statistics["spatial_correlation"] = correlation.value
        sidecar.statistics["spatial_correlation_std"] = correlation.deviation
    if soft is not None:
        add_waves(sidecar, arrangement, soft, to_output.scale, counted(watch, "Surfaces"))
    seconds = (solve_seconds, perf_counter() - started)
    sidecar.statistics.update(
        statistics(reconstruction, model, before, errors, selection, num_unusable, problem, noise, seconds)
    )
    return Refinement(
        reconstruction=model,
        sidecar=sidecar,
        warnings=tuple(warnings),
        converged=has_converged(adjustment, uncertainty),
    )


def _check_model(model: pycolmap.Reconstruction) -> None:
    """What `read_model` also checks, for models that come from a script."""
    if model.num_reg_images() == 0:
        raise RefractError("the model has no registered image: there is nothing to refine")
    if model.num_points3D() == 0:
        raise RefractError("the model has no points: there is nothing to refine")
    for point3D_id, point in model.points3D.items():
        if not np.isfinite(point.xyz).all():
            raise RefractError(f"point {point3D_id} has a position that is not finite: remove it from the model")
    for frame_id in model.reg_frame_ids():
        pose = model.frame(frame_id).rig_from_world
        if not (np.isfinite(pose.rotation.quat).all() and np.isfinite(pose.translation).all()):
            raise RefractError(f"frame {frame_id} has a pose that is not finite: deregister it")


def _replace_cameras(model: pycolmap.Reconstruction, cameras: Mapping[int, pycolmap.Camera]) -> list[str]:
    """In-air intrinsics in place of the model's: keypoints are raw pixels, so that is sound. What was rescaled."""
    remarks = []
    for camera_id, camera in model.cameras.items():
        known = known_camera(camera, cameras, "the model")
        if (known.width, known.height) != (camera.width, camera.height):
            remarks.append(
                f"The intrinsics given for camera {camera_id} are for {known.width} x {known.height} pixels and were "
                f"rescaled to {camera.width} x {camera.height}: right if the images were only made smaller or larger."
            )
        known = fit_to_size(known, camera.width, camera.height)
        camera.model = known.model
        camera.params = known.params
        camera.has_prior_focal_length = True
    return remarks


def _solve(
    arrangement: Arrangement, settings: SolverSettings, earlier: Sidecar | None, watch: Watch | None
) -> tuple[Selection, Problem, Adjustment, Uncertainty]:
    """Start, solve, filter and solve again, until nothing more comes or goes."""
    options = arrangement.options
    begin = _from_scratch(arrangement, settings, watch) if earlier is None else arrangement.resume(earlier)
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
        doubtful = limit == 0 or (errors > limit).mean() > _NEGLIGIBLE_CHANGE
        selection, _ = begun.filtered(label_by_fit(begun.problem, doubtful=bool(doubtful)), settings, limit)
    num_filtered = num_relabelled = 0
    while True:
        stage = "Refractive bundle adjustment" + (f", filtered {num_filtered + 1} times" if num_filtered else "")
        _, problem = selection.active()
        problem = _with_loss(arrangement, problem, noise)
        adjustment = adjust(problem, settings, on_progress=named(watch, stage))
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
        if (not moved and changed <= _NEGLIGIBLE_CHANGE) or num_filtered == _NUM_FILTER_ROUNDS:
            break
        num_filtered += 1
    _, problem = selection.active()
    if changed > 0:
        # The last few outliers say too little to solve everything again for: points alone are settled anew.
        problem = replace(problem, points=settle_points(problem, settings))
    uncertainty = estimate_uncertainty(problem)
    # Whoever asks for less than a fine tolerance gets that.
    for _ in range(_NUM_FINISHES if settings.function_tolerance <= _FINE else 0):
        if uncertainty.decrement <= _FINISHED or adjustment.termination != "convergence":
            break
        settings = replace(settings, function_tolerance=_FINER * settings.function_tolerance)
        adjustment = adjust(problem, settings, on_progress=named(watch, "Last steps"))
        problem = replace(problem, state=adjustment.state, points=adjustment.points)
        uncertainty = estimate_uncertainty(problem)
    if not is_sound(problem):
        _raise_unsound(problem, options)
    return selection, problem, adjustment, uncertainty


def _check_waves(arrangement: Arrangement) -> None:
    options = arrangement.options
    if options.scenario == "camera_housing":
        raise RefractError("a housing's port does not wave: use interface_shape plane, or the scenario of open water")
    if any(options.layer_thickness):
        raise RefractError("a wall does not wave: use interface_shape plane, or leave out layer_thickness")


def _solve_soft(
    arrangement: Arrangement, settings: SolverSettings, earlier: Sidecar | None, watch: Watch | None
) -> tuple[Selection, SoftSolution]:
    """Start on level water, solve with waves, filter and go on until nothing more comes or goes."""
    options = arrangement.options
    if earlier is not None:
        begin = arrangement.resume(earlier)
    elif options.scenario == "fixed_camera":
        begin = _from_scratch(arrangement, settings, watch)
    else:
        begin = level_start(arrangement)
    everything = np.ones(len(begin.tracks.image), dtype=np.bool_)
    soft = solve_soft(arrangement, begin, everything, wave_options(arrangement), settings, watch)
    everywhere, keep = soft.wavy.problem, everything
    marks = None
    for _ in range(_NUM_WAVE_FILTERS):
        marks = filter_waves(arrangement, everywhere, soft.statistics.noise)
        counts = np.add.reduceat(marks.keep.astype(np.int64), begin.tracks.start[:-1])
        remaining = marks.keep & np.repeat(counts >= 2, np.diff(begin.tracks.start))
        changed = float((remaining != keep).mean())
        keep = remaining
        if keep.mean() < _LEAST_KEPT:
            raise Unsupported("Waves are not determined: with them most observations are far off")
        if changed <= _NEGLIGIBLE_CHANGE:
            break
        soft = go_on(begin, everywhere, keep, soft, settings, watch)
        everywhere = settle_everywhere(begin, soft, watch)
    if not keep.all() and len(soft.wavy.problem.tracks.image) != int(keep.sum()):
        soft = go_on(begin, everywhere, keep, soft, settings, watch)
    problem = soft.wavy.problem
    if not is_sound(problem):
        raise Unsupported("Waves are not determined: with them the interface runs away from between cameras and points")
    return Selection(arrangement=arrangement, problem=begin, keep=keep, marks=marks), soft


def _from_scratch(arrangement: Arrangement, settings: SolverSettings, watch: Watch | None) -> Problem:
    """All observations, from a start that is sought."""
    start = find_start(arrangement, settings, watch)
    if not start.sound:
        _raise_unsound(start.problem, arrangement.options)
    return spread_out(arrangement, start, settings)


def _with_loss(arrangement: Arrangement, problem: Problem, noise: float) -> Problem:
    adjustment = arrangement.options.BundleAdjustment
    scale = adjustment.loss_function_scale
    if scale is None:
        scale = max(LOSS_SCALE_IN_NOISE * noise, _LEAST_LOSS_SCALE)
    return replace(problem, loss=adjustment.loss_function_type, loss_scale=scale)


def _raise_unsound(problem: Problem, options: RefinerOptions) -> None:
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
