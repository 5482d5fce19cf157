"""What is compared: every method takes a capture to points by their ids."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.experiments.scenes import Setup
from colmap_refract.interface import Array
from colmap_refract.options import BundleAdjustmentOptions, ImageNotes, RefinerOptions
from colmap_refract.simulation import Capture, ignore_refraction

if TYPE_CHECKING:
    import pycolmap

_PRINTED_IMAGES, _PRINTED_ITERATIONS = 10, 60
"""What the soft constraint as printed gets: its time grows quickly with the images."""


_EVERY = 5
"""Of a thousand frames, where each has a plane of its own."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What a method makes of a capture: points (3,) by id, in any frame and size, and what it says of them."""

    points: dict[int, Array]
    remark: str = ""


@dataclass(frozen=True, kw_only=True)
class Method:
    """One of the methods that are compared."""

    name: str
    text: str
    """What it is."""
    given: str
    """What it is given besides keypoints, tracks and intrinsics."""
    estimate: Callable[[Setup], Estimate]
    """Raises RefractError where it has no result."""
    suits: Callable[[Setup], bool] = lambda setup: True
    """Whether it is meant for such a capture."""


def points_of(model: pycolmap.Reconstruction) -> dict[int, Array]:
    """The points of a model by id."""
    return {point3D_id: np.array(point.xyz) for point3D_id, point in model.points3D.items()}


def _refined(
    setup: Setup,
    options: RefinerOptions,
    *,
    notes: ImageNotes | None = None,
    start: pycolmap.Reconstruction | None = None,
) -> Estimate:
    from colmap_refract.refiner.refinement import refine

    # Sums of several threads differ in their last digits from run to run.
    options = replace(options, num_threads=1)
    result = refine(ignore_refraction(setup.capture) if start is None else start, options, notes=notes)
    remarks = [] if result.converged else ["not converged"]
    # Ripples that are too short for a surface are waves too.
    if options.interface_shape == "soft" and "waves" not in result.sidecar.statistics:
        remarks.append("no waves found, planes taken")
    return Estimate(points=points_of(result.reconstruction), remark=", ".join(remarks))


def _ignored(setup: Setup) -> Estimate:
    return Estimate(points=points_of(ignore_refraction(setup.capture)))


def _hard(setup: Setup) -> Estimate:
    return _refined(setup, RefinerOptions(scenario=setup.scenario))


def _soft(setup: Setup) -> Estimate:
    return _refined(setup, RefinerOptions(scenario=setup.scenario, interface_shape="soft"))


def _inclinations(setup: Setup) -> ImageNotes:
    if setup.groups is None:
        raise RefractError(f"{setup.name}: no two images share an inclination")
    return ImageNotes(interface_groups=setup.groups)


def _tied(setup: Setup) -> Estimate:
    return _refined(setup, RefinerOptions(scenario=setup.scenario), notes=_inclinations(setup))


def _averaged(setup: Setup) -> Estimate:
    return _refined(setup, RefinerOptions(scenario=setup.scenario, average_groups=True), notes=_inclinations(setup))


def _with_reference(setup: Setup) -> Estimate:
    return _refined(setup, RefinerOptions(scenario=setup.scenario, reference_rays=True))


def _start_of(setup: Setup, frames: list[int]) -> pycolmap.Reconstruction:
    """The start with some of its frames."""
    model = ignore_refraction(setup.capture)
    for frame_id in set(model.frames) - set(frames):
        model.deregister_frame(frame_id)
    return model


def _some(setup: Setup) -> Estimate:
    frames = sorted(setup.capture.reconstruction.frames)[::_EVERY]
    return _refined(setup, RefinerOptions(scenario=setup.scenario), start=_start_of(setup, frames))


def _printed(setup: Setup) -> Estimate:
    frames = sorted(setup.capture.reconstruction.frames)
    few = frames[:: max(1, -(-len(frames) // _PRINTED_IMAGES))]
    options = RefinerOptions(
        scenario=setup.scenario,
        interface_shape="soft_as_printed",
        wave_slope_deg=setup.capture.options.wave_slope_deg,
        # The start has the truth's size, but for a per cent.
        wavelength=float(np.sqrt(np.prod(setup.capture.options.wavelength))),
        pixel_noise=setup.capture.options.pixel_noise,
        BundleAdjustment=BundleAdjustmentOptions(max_num_iterations=_PRINTED_ITERATIONS, function_tolerance=1e-6),
    )
    estimate = _refined(setup, options, start=_start_of(setup, few))
    remarks = [f"{len(few)} images", *([estimate.remark] if estimate.remark else [])]
    return replace(estimate, remark=", ".join(remarks))


def _triangulated(setup: Setup) -> Estimate:
    from colmap_refract.comparators.methods import random_refractive_distortions

    capture = setup.capture
    true = capture.reconstruction
    model = ignore_refraction(capture)
    for frame_id, frame in model.frames.items():
        frame.rig_from_world = true.frames[frame_id].rig_from_world
    found = random_refractive_distortions(
        model,
        {true.image(image_id).name: plane for image_id, plane in capture.planes.items()},
        slope_deviation_deg=capture.options.wave_slope_deg,
        layers=capture.layers,
        pixel_noise=capture.options.pixel_noise,
    )
    return Estimate(points=points_of(found))


def _turbulence(setup: Setup) -> Estimate:
    from colmap_refract.comparators.methods import depth_from_turbulence

    capture = setup.capture
    mean = np.mean([normal for normal, _ in capture.planes.values()], axis=0)
    found = depth_from_turbulence(
        ignore_refraction(capture),
        capture.reconstruction,
        pixel_noise=capture.options.pixel_noise,
        refractive_index=capture.layers.refractive_index,
        normal_in_cam=mean,
    )
    return Estimate(points=points_of(found))


def _from_refraction(setup: Setup, *, plane_known: bool) -> Estimate:
    from colmap_refract.comparators.depth_from_refraction import find_plane_and_points, intersect_known_plane

    if setup.dry is None:
        raise RefractError(f"{setup.name}: there is no picture without water")
    capture = setup.capture
    first = min(capture.planes)
    dry, wet = keypoints_of(setup.dry, 1), keypoints_of(capture, first)
    ids = sorted(set(dry) & set(wet))
    images = np.array([dry[i] for i in ids]), np.array([wet[i] for i in ids])
    camera, noise = next(iter(capture.reconstruction.cameras.values())), capture.options.pixel_noise
    if plane_known:
        normal, distance = capture.planes[first]
        found = intersect_known_plane(
            *images, camera, normal_in_cam=normal, distance=distance, layers=capture.layers, pixel_noise=noise
        )
    else:
        found = find_plane_and_points(*images, camera, layers=capture.layers, pixel_noise=noise)
    return Estimate(points=dict(zip(ids, found.points, strict=True)))


def keypoints_of(capture: Capture, image_id: int) -> dict[int, Array]:
    """Keypoints (2,) of an image by the ids of their points."""
    points2D = capture.reconstruction.image(image_id).points2D
    return {point2D.point3D_id: np.array(point2D.xy) for point2D in points2D if point2D.has_point3D()}


def never_fixed(setup: Setup) -> bool:
    """COLMAP has no model of a camera that does not move."""
    return setup.scenario != "fixed_camera"


def fixed(setup: Setup) -> bool:
    return setup.scenario == "fixed_camera"


def wavy(setup: Setup) -> bool:
    return setup.is_wavy


IGNORED = Method(
    name="SfM",
    text="structure from motion that ignores refraction: COLMAP's bundle adjustment, intrinsics held",
    given="a start: the true poses and points with noise of 1 %",
    estimate=_ignored,
    suits=never_fixed,
)
TURBULENCE = Method(
    name="DfT",
    text="depth from turbulence, on refracted rays: what lies deeper wanders more",
    given="the true points, for a scale and an offset; the mean normal of the surface; the keypoints' noise",
    estimate=_turbulence,
    suits=fixed,
)
REFRACTION = Method(
    name="DfR",
    text="depth from refraction: one image without water and one with, the interface found with the points",
    given="an image without water; only one of the images with water",
    estimate=partial(_from_refraction, plane_known=False),
    suits=fixed,
)
REFRACTION_KNOWN = Method(
    name="DfR, plane known",
    text="the same with the interface known",
    given="an image without water, and the true (mean) interface; only one of the images with water",
    estimate=partial(_from_refraction, plane_known=True),
    suits=fixed,
)
TRD = Method(
    name="TRD",
    text="triangulation in random refractive distortions (`point_triangulator`)",
    given="the true poses and mean planes, the waves' slope and the keypoints' noise",
    estimate=_triangulated,
)
HARD = Method(
    name="hard",
    text="this package: flat interfaces, no reference image (`refiner`)",
    given="the result of SfM to start from; with a fixed camera, points at one depth",
    estimate=_hard,
)
REFERENCE = Method(
    name="hard, reference",
    text="this package: flat interfaces, points on the rays of a reference image (`refiner --reference_rays 1`)",
    given="as hard",
    estimate=_with_reference,
)
PRINTED = Method(
    name="soft as printed",
    text="the paper's E_soft, a normal for every observation (`refiner --interface_shape soft_as_printed`)",
    given="as hard; the waves' slope and length and the keypoints' noise, for its lambda; for its time, "
    f"{_PRINTED_IMAGES} of the images at most and {_PRINTED_ITERATIONS} iterations",
    estimate=_printed,
    suits=wavy,
)
SOFT = Method(
    name="soft",
    text="this package: a random surface of waves per image (`refiner --interface_shape soft`)",
    given="as hard",
    estimate=_soft,
    suits=wavy,
)
SOME = Method(
    name=f"hard, every {_EVERY}th frame",
    text=f"hard on one frame in {_EVERY}, a plane per frame: of all, a plane each takes many minutes",
    given="as hard",
    estimate=_some,
)
TIED = Method(
    name="hard, shared planes",
    text="hard, one plane for all frames of an inclination (`refiner --interface_group_path`)",
    given="as hard, and which frames share an inclination",
    estimate=_tied,
)
AVERAGED = Method(
    name="hard, averaged",
    text="hard, on the mean keypoints of each inclination (`refiner --average_groups 1`)",
    given="as hard, and which frames share an inclination",
    estimate=_averaged,
)
