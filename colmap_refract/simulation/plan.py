"""A plan of a capture: what its images will show, and how accurate the points can become."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array
from colmap_refract.simulation.accuracy import configuration_of, point_rmse
from colmap_refract.simulation.capture import Capture, ignore_refraction, simulate
from colmap_refract.simulation.precision import precision
from colmap_refract.simulation.scene import SceneOptions
from colmap_refract.simulation.session import SessionOptions, ground_sample_distance, photograph
from colmap_refract.simulation.surface import surface_at
from colmap_refract.simulation.truth import Truth

FEWEST_POINTS = 10  # that a bound is computed from


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """What keypoints of the plan's noise allow (Cramer and Rao), after a similarity alignment; metres, 1 sigma."""

    rmse: float
    """Of the points, in space."""
    horizontal: float
    """Median over the points, per horizontal axis."""
    vertical: float
    """Median over the points."""
    worst_vertical: float
    """That a tenth of the points exceed."""
    distance: float
    """Of the interfaces' distances from their cameras, median."""
    tilt_deg: float
    """Of the interfaces' normals, per tangent, degrees, median."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to expect of a capture. The accuracy is that of a flat interface, also where there are waves."""

    options: SessionOptions
    view_deg: tuple[float, float]
    """Width and height of the view, in air, through the middle."""
    footprint: Array
    """(2,) width and height of what a view from the mean height shows, looking straight down, metres."""
    sample_distance: float
    """Metres on the ground from pixel to pixel, in the middle of the images, median."""
    num_points: int
    """That two images see or more."""
    part_seen: float
    """Part of the points that two images see or more."""
    observations_per_point: float
    """Median of those points."""
    accuracy: Accuracy
    ignored: float
    """RMSE of the points if refraction is ignored, metres, by doing so; of all points at one depth with a fixed
    camera."""
    wave_slope: float
    """Root mean square slope of the waves."""
    wave_shift: float
    """Root mean square shift of a keypoint by the waves, px."""


def plan(options: SessionOptions) -> Plan:
    """Lay out a capture, and look what can come of it.

    Raises:
        RefractError: options that contradict each other, a camera under water, no overlap.
    """
    if options.scene.num_points < FEWEST_POINTS:
        raise RefractError(f"num_points {options.scene.num_points} is too few to plan with: give 100 or more")
    capture = simulate(options.scene)
    model = capture.reconstruction
    if model.num_points3D() < FEWEST_POINTS:
        raise RefractError(
            f"{model.num_points3D()} of {options.scene.num_points} points are in two images or more: take more images, "
            "nearer to each other, or from farther away"
        )
    truth = photograph(options).truth
    camera = truth.views[0].camera
    size = np.array([camera.width, camera.height])
    edges = np.array([[0, 0.5], [1, 0.5], [0.5, 0], [0.5, 1]]) * size
    rays = np.asarray(camera.cam_ray_from_img(edges))
    angles = np.degrees(np.arccos(np.clip([rays[0] @ rays[1], rays[2] @ rays[3]], -1, 1)))
    samples = [ground_sample_distance(view, truth.terrain) for view in truth.views]
    return Plan(
        options=options,
        view_deg=(float(angles[0]), float(angles[1])),
        footprint=options.scene.footprint,
        sample_distance=float(np.median(samples)),
        num_points=model.num_points3D(),
        part_seen=model.num_points3D() / options.scene.num_points,
        observations_per_point=float(np.median([len(p.track.elements) for p in model.points3D.values()])),
        accuracy=accuracy_of(capture),
        ignored=point_rmse(ignore_refraction(capture), capture),
        wave_slope=truth.views[0].surface.rms_slope,
        wave_shift=_wave_shift(truth) if options.waves else 0.0,
    )


def accuracy_of(capture: Capture) -> Accuracy:
    """The bounds of a capture, by its noise."""
    noise, unit = capture.options.pixel_noise, precision(configuration_of(capture))
    x, y, z = (noise * unit.std_along(axis) for axis in np.eye(3))
    return Accuracy(
        rmse=noise * unit.rmse,
        horizontal=float(np.median(np.hypot(x, y)) / np.sqrt(2)),
        vertical=float(np.median(z)),
        worst_vertical=float(np.quantile(z, 0.9)),
        distance=noise * float(np.median(unit.distance_std)),
        tilt_deg=noise * float(np.median(unit.normal_std_deg)),
    )


def alternatives(options: SceneOptions) -> dict[str, Accuracy]:
    """The same capture but for one thing each, and what accuracy that would bring; those that are possible."""
    changed = {f"{2 * options.num_images} images": replace(options, num_images=2 * options.num_images)}
    if options.scenario == "fixed_camera":
        tilt = min(2 * options.tilt_deg, 15.0)
        changed[f"surfaces tilted by {tilt:g} deg (rms)"] = replace(options, tilt_deg=tilt)
    elif options.oblique_deg < 25:
        oblique = options.oblique_deg + 10
        changed[f"views inclined by {oblique:g} deg"] = replace(options, oblique_deg=oblique)
    if options.scenario != "camera_housing":
        nearer = 0.5 * options.interface_height
        depth = options.camera_height - nearer
        lower = replace(options, depth=depth, distance_ratio=nearer / depth, relief=options.floor_relief)
        changed[f"cameras {nearer:.3g} m above the water"] = lower
    out = {}
    for name, other in changed.items():
        try:
            out[name] = accuracy_of(simulate(other))
        except RefractError:
            # An interface that would reach behind a camera, or views that no longer overlap.
            continue
    return out


def _wave_shift(truth: Truth) -> float:
    """Root mean square distance, px, of where points are seen through the waves from where the mean plane shows them.

    Over a grid of pixels of all images; per axis. Places that the waves hide from one of the two do not count.
    """
    shifts = []
    for name, view in zip(truth.names, truth.views, strict=True):
        part = np.linspace(0.05, 0.95, 12)
        pixels = np.stack(np.meshgrid(part * view.camera.width, part * view.camera.height), axis=-1).reshape(-1, 2)
        still = replace(view, surface=surface_at(view.surface.normal, view.surface.offset, layers=view.surface.layers))
        quiet = replace(truth, views=(still,), names=(name,))
        shifts.append(quiet.project(name, truth.trace(name, pixels)) - pixels)
    return float(np.sqrt(np.nanmean(np.concatenate(shifts) ** 2)))
