"""What is badly determined here, what looks wrong, and what the user could do about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator.adjustment import Adjustment
from colmap_refract.estimator.chunk import Problem
from colmap_refract.interface import Array
from colmap_refract.refiner.arrangement import Arrangement
from colmap_refract.refiner.diagnosis import SpatialCorrelation
from colmap_refract.refiner.filtering import in_cameras, label_wet
from colmap_refract.refiner.uncertainty import Uncertainty

_NORMAL_LIMIT_DEG = 2.0
_DISTANCE_LIMIT = 0.1
_POINT_LIMIT = 0.02
"""Of the median depth: shapes are hardly seen through so much."""
_CORRELATION_LIMIT = 0.95
_DECREMENT_LIMIT = 1e-4
_STUCK = 1e-2
"""Of the cost: with as much still to be gained, a solver that takes no more steps is stuck."""
_NARROW_VIEW_DEG = 20.0
_OBLIQUE_DEG = 8.0
_CORRELATED = 0.1
"""Of neighbouring errors: a hundredth of the variance is not worth a word."""
_WORSE, _AS_WELL = 1.02, 1 / 1.02
"""Times the median error without refraction: noise and another loss make less of a difference."""


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What is known after a solve: errors and noise of one coordinate in px, whether the intrinsics are from air."""

    arrangement: Arrangement
    problem: Problem
    adjustment: Adjustment
    uncertainty: Uncertainty
    noise: float
    pinhole_errors: Array
    calibrated: bool
    errors: Array
    correlation: SpatialCorrelation | None = None


def has_converged(adjustment: Adjustment, uncertainty: Uncertainty) -> bool:
    """Whether the solver stopped where there is a minimum, as far as is known, and not only as its steps were small."""
    return adjustment.termination == "convergence" and not uncertainty.decrement > _STUCK


def advise(facts: Facts) -> list[str]:
    """Sentences for the user, the gravest first; none where all is well."""
    return [
        *_solver(facts),
        *_images(facts),
        *_points(facts),
        *_planes(facts),
        *_index(facts),
        *_water(facts),
        *_waves(facts),
    ]


def _waves(facts: Facts) -> list[str]:
    """If neighbouring residuals agree, something with a shape is not in the model: in open water, waves."""
    found = facts.correlation
    if found is None or not found.significant or found.value < _CORRELATED:
        return []
    shape = (
        f"The errors of neighbouring keypoints agree (correlation {found.value:.2f}, "
        f"{found.deviation_px:.2g} px; noise alone gives 0): "
    )
    if facts.problem.num_waves or facts.problem.tracks.effects.shape[2]:
        return [shape + "the surface has shapes that its modes cannot take; try more --num_wave_modes."]
    options = facts.arrangement.options
    if options.interface_shape == "soft_as_printed":
        # Normals that have taken most of the noise leave smooth rests of it.
        if found.deviation_px < options.pixel_noise:
            return []
        return [shape + "the normals are too stiff for the waves; give a smaller --wave_smoothness or --wave_radius."]
    if options.scenario == "camera_housing" or any(options.layer_thickness):
        return [shape + "the intrinsics, the glass or the scenario do not fit the images."]
    return [
        f"{shape}the surface is not flat, or the scenario is another one. With --interface_shape soft about "
        f"{found.uncorrelated_px:.2g} px would be left."
    ]


def advise_on_input(facts: Facts) -> list[str]:
    """Sentences about what was given: whether there is an interface at all, and whether the intrinsics are from air."""
    return [*_straight_rays(facts), *_intrinsics(facts)]


def _straight_rays(facts: Facts) -> list[str]:
    """If straight rays explain the images as well as refracted ones, there may be no such interface."""
    seen = facts.pinhole_errors[np.isfinite(facts.pinhole_errors)]
    if not len(seen) or facts.arrangement.options.scenario == "fixed_camera":
        return []
    before, after = float(np.median(seen)), float(np.median(facts.errors))
    if after > _WORSE * before:
        return [
            f"Straight rays explain the images better (median {before:.3g} px) than refracted ones ({after:.3g} px): "
            "do not use the result. Either there was no interface, or the scenario, the index or the intrinsics (which "
            "must be from air, --camera_path) are others."
        ]
    if facts.calibrated or after <= _AS_WELL * before:
        return []
    return [
        f"Without refraction the model fits as well (median {before:.3g} px against {after:.3g} px): either nothing "
        "is refracted here, or the intrinsics have absorbed it; give intrinsics calibrated in air (--camera_path) and "
        "check --scenario."
    ]


def _solver(facts: Facts) -> list[str]:
    adjustment = facts.adjustment
    if adjustment.termination != "convergence":
        return [
            f"The solver did not converge ({adjustment.message.strip()}): do not trust the result; allow more "
            "--BundleAdjustment.max_num_iterations."
        ]
    if facts.uncertainty.decrement > _STUCK:
        return [
            f"The solver is stuck: {100 * facts.uncertainty.decrement:.2g} % of the cost could still be gained, so do "
            "not trust the result; try another --initial_distance_ratio, or hold what is known of the interface."
        ]
    if facts.uncertainty.decrement > _DECREMENT_LIMIT:
        return [
            f"The solver stopped although {100 * facts.uncertainty.decrement:.2g} % of the cost could still be gained: "
            "lower --BundleAdjustment.function_tolerance."
        ]
    return []


def _images(facts: Facts) -> list[str]:
    """Images that the filter left without anything."""
    observations = facts.arrangement.observations
    structure = facts.problem.structure
    # A frame that was averaged with others lives on in the one that stands for them. No interface is plane -1.
    both = structure.image_pose * (structure.num_planes + 1) + structure.image_plane + 1
    counts = np.bincount(both[observations.image], minlength=both.max() + 1)[both]
    lost = [observations.image_names[i] for i in np.flatnonzero(counts == 0)]
    if not lost:
        return []
    return [
        f"{len(lost)} images have lost all their observations (such as '{lost[0]}'): their poses and interfaces mean "
        "nothing; leave them out of the model, or check --scenario."
    ]


def _intrinsics(facts: Facts) -> list[str]:
    if facts.calibrated or not facts.problem.held.lens:
        return []
    sentences = []
    suspicious = []
    for camera_id, camera in zip(
        facts.arrangement.observations.camera_ids, facts.arrangement.observations.cameras, strict=True
    ):
        if not len(camera.focal_length_idxs()):
            continue
        center = np.array([camera.principal_point_x, camera.principal_point_y])
        centered = np.abs(center - [camera.width / 2, camera.height / 2]).max() < 1e-6
        extra = [camera.params[i] for i in camera.extra_params_idxs()]
        focal = camera.mean_focal_length()
        # COLMAP refines focal length and distortion and leaves the principal point in the middle.
        refined = not extra or any(abs(p) > 1e-9 for p in extra)
        if centered and refined and abs(focal - round(focal)) > 1e-6:
            suspicious.append(str(camera_id))
    if suspicious:
        sentences.append(
            f"The intrinsics of camera {', '.join(suspicious)} look as if COLMAP had refined them on these images. If "
            "so they have absorbed part of the refraction, and the result is wrong: give intrinsics calibrated in "
            "air (--camera_path)."
        )
    return sentences


def _planes(facts: Facts) -> list[str]:
    problem, uncertainty = facts.problem, facts.uncertainty
    if not uncertainty.determined and not (problem.held.normals.all() and problem.held.distances.all()):
        return [
            "The data do not determine all unknowns (the reduced system is singular): hold --interface_normal and "
            "--interface_distance, or tie images by --interface_group_path."
        ]
    normal_deg = np.degrees(uncertainty.normal) * facts.noise
    relative = uncertainty.distance * facts.noise / np.maximum(np.abs(problem.state.distance), 1e-12)
    loose_normal = np.flatnonzero(normal_deg > _NORMAL_LIMIT_DEG)
    loose_distance = np.flatnonzero(relative > _DISTANCE_LIMIT)
    sentences = []
    if len(loose_normal):
        sentences.append(
            f"The normal of {_how_many(loose_normal, problem)} is uncertain by up to {np.nanmax(normal_deg):.2g} deg: "
            f"{_remedy(facts)}."
        )
    if len(loose_distance):
        sentences.append(
            f"The distance of {_how_many(loose_distance, problem)} is uncertain by up to "
            f"{100 * np.nanmax(relative):.2g} %: {_remedy(facts)}; a known distance helps (--interface_distance, "
            "--refine_interface_distance 0)."
        )
    return sentences


def _points(facts: Facts) -> list[str]:
    """If the points themselves are mostly noise: through ripples above a fixed camera, for one."""
    points, *_ = in_cameras(facts.problem)
    deviation = facts.uncertainty.points * facts.noise / float(np.median(points[:, 2]))
    if not deviation > _POINT_LIMIT:
        return []
    return [
        f"Half of the points are uncertain by {100 * deviation:.2g} % of their depth or more along one axis, even if "
        f"cameras and interfaces are right: do not trust shapes that are no larger; {_remedy(facts)}."
    ]


def _how_many(loose: NDArray[np.int64], problem: Problem) -> str:
    total = problem.structure.num_planes
    return "the interface" if total == 1 else f"{len(loose)} of {total} interfaces"


def _remedy(facts: Facts) -> str:
    """What would help most, from how the scene was photographed."""
    observations = facts.arrangement.observations
    axis = observations.direction[:, 2]
    view = 2.0 * np.degrees(np.arccos(np.clip(np.quantile(axis, 0.05), -1.0, 1.0)))
    normal, _ = facts.problem.state.planes_in_cam(facts.problem.structure)
    tilt = np.degrees(np.arccos(np.clip(normal[:, 2], -1.0, 1.0)))
    per_image = np.bincount(observations.image, minlength=len(observations.image_ids))
    if view < _NARROW_VIEW_DEG:
        return f"the view is narrow ({view:.0f} deg), and refraction shows at its edges; use a shorter lens or obliques"
    if np.median(per_image) < 50:
        return f"the images have few points (median {np.median(per_image):.0f}); more keypoints would help"
    if facts.arrangement.options.scenario != "camera_housing" and np.nanmedian(tilt) < _OBLIQUE_DEG:
        return "all views are nearly along the normal; add oblique ones"
    return "more images, with other poses, would help"


def _index(facts: Facts) -> list[str]:
    if facts.problem.held.index:
        return []
    sigma, correlation = facts.uncertainty.index * facts.noise, facts.uncertainty.index_correlation
    if not np.isfinite(sigma) or sigma > 0.005 or correlation > _CORRELATION_LIMIT:
        return [
            f"The refractive index {facts.problem.state.index:.4f} (standard deviation {sigma:.2g}, correlation with "
            f"the interface {correlation:.3f}) cannot be told from the rest: hold it (--refine_refractive_index 0)."
        ]
    return []


def _water(facts: Facts) -> list[str]:
    problem = facts.problem
    block = problem.structure.image_plane[problem.tracks.image]
    before = problem.tracks.wet & ~label_wet(problem)
    behind = [b for b in np.unique(block[block >= 0]) if before[block == b].mean() > 0.5]
    if behind:
        return [
            f"{len(behind)} of {problem.structure.num_planes} interfaces ended behind most of the points seen through "
            "them, which cannot be: do not trust the result; try another --initial_distance_ratio, or hold what is "
            "known of the interface."
        ]
    refracted = problem.structure.image_plane[problem.tracks.image] >= 0
    dry = float((~problem.tracks.wet)[refracted].mean()) if refracted.any() else 0.0
    if dry > 0.5:
        return [f"{100 * dry:.0f} % of the observations are of points on the dry side of the interface: is that so?"]
    return []
