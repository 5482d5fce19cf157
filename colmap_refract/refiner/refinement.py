"""The sequence a user sees: read, solve in the way that is asked for, judge, put back into the model's frame."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import SolverSettings
from colmap_refract.files.cameras_file import fit_to_size, known_camera
from colmap_refract.files.model_io import copy_model
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.machine import threads
from colmap_refract.options import ImageNotes, InterfaceShape, RefinerOptions
from colmap_refract.refiner.advice import Facts, advise, advise_on_input, has_converged
from colmap_refract.refiner.arrangement import arrange
from colmap_refract.refiner.averaging import average_groups
from colmap_refract.refiner.continuation import Watch
from colmap_refract.refiner.diagnosis import spatial_correlation
from colmap_refract.refiner.filtering import pinhole_errors
from colmap_refract.refiner.observations import read_observations
from colmap_refract.refiner.outcome import make_sidecar, output_frame, statistics, write_back
from colmap_refract.refiner.plane_solution import solve_planes
from colmap_refract.refiner.printed_solution import solve_as_printed
from colmap_refract.refiner.reference_solution import solve_on_reference_rays
from colmap_refract.refiner.soft_solution import solve_waves
from colmap_refract.refiner.solution import Way

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger(__name__)


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
    _check_registered(model, options.reference_image)
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
    try:
        solution = _way(options)(arrangement, settings, earlier, watch)
    except FloatingPointError as error:
        raise RefractError(
            f"the adjustment could not be evaluated ({error}): check the model and the scenario"
        ) from None
    solve_seconds = perf_counter() - solve_started
    selection, problem, errors, noise = solution.selection, solution.problem, solution.errors, solution.noise
    arrangement, _ = selection.active()
    active = arrangement.observations
    correlation = spatial_correlation(active.image, active.pixel, solution.residuals)
    facts = Facts(
        arrangement=arrangement,
        problem=problem,
        adjustment=solution.adjustment,
        uncertainty=solution.uncertainty,
        noise=noise,
        pinhole_errors=before,
        calibrated=bool(cameras),
        errors=errors,
        correlation=correlation,
    )
    # A model that comes from a refinement says nothing of its input any more.
    about_input = [*remarks, *advise_on_input(facts)] if earlier is None else earlier.solver.get("input_warnings", [])
    warnings = [*about_input, *solution.remarks, *advise(facts)]
    to_output = output_frame(arrangement, problem.state, problem.points)
    stays = arrangement.observations if averaged is None else observations.select(averaged.members(selection.keep))
    write_back(model, arrangement, problem, errors, to_output, stays)
    sidecar = make_sidecar(
        arrangement, notes, problem, solution.adjustment, solution.uncertainty, noise, to_output, warnings
    )
    sidecar.solver["input_warnings"] = about_input
    if correlation is not None:
        sidecar.statistics["spatial_correlation"] = correlation.value
        sidecar.statistics["spatial_correlation_std"] = correlation.deviation
    if np.isfinite(solution.uncertainty.points):
        sidecar.statistics["median_point_std"] = solution.uncertainty.points * noise * to_output.scale
    if solution.describe is not None:
        solution.describe(sidecar, to_output.scale)
    seconds = (solve_seconds, perf_counter() - started)
    sidecar.statistics.update(
        statistics(reconstruction, model, before, errors, selection, num_unusable, problem, noise, seconds)
    )
    return Refinement(
        reconstruction=model,
        sidecar=sidecar,
        warnings=tuple(warnings),
        converged=has_converged(solution.adjustment, solution.uncertainty),
    )


def _way(options: RefinerOptions) -> Way:
    """How the options want a model to be solved."""
    if options.reference_rays:
        return solve_on_reference_rays
    ways: dict[InterfaceShape, Way] = {
        "plane": solve_planes,
        "soft": solve_waves,
        "soft_as_printed": solve_as_printed,
    }
    return ways[options.interface_shape]


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


def _check_registered(model: pycolmap.Reconstruction, name: str) -> None:
    """Raises RefractError if an image is in the model without a pose."""
    if any(image.name == name and not image.has_pose for image in model.images.values()):
        raise RefractError(
            f"reference_image: '{name}' is not registered in the model, so nothing is known of where it was: name an "
            "image that is"
        )


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
