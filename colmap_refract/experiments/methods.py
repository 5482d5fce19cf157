"""What is compared: every method takes a capture to points by their ids."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.experiments.scenes import Setup
from colmap_refract.files.sidecar import ImageInterface, Sidecar
from colmap_refract.interface import Array
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.simulation import ignore_refraction

if TYPE_CHECKING:
    import pycolmap

_PRINTED_IMAGES, _PRINTED_ITERATIONS = 10, 60
"""What the soft constraint as printed gets: its time grows quickly with the images."""


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


def _refined(setup: Setup, options: RefinerOptions, notes: ImageNotes | None = None) -> Estimate:
    from colmap_refract.refiner.refinement import refine

    result = refine(ignore_refraction(setup.capture), options, notes=notes)
    remarks = [] if result.converged else ["not converged"]
    if options.interface_shape == "soft" and all(image.surface is None for image in result.sidecar.images.values()):
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
    return _refined(setup, RefinerOptions(scenario=setup.scenario), _inclinations(setup))


def _averaged(setup: Setup) -> Estimate:
    return _refined(setup, RefinerOptions(scenario=setup.scenario, average_groups=True), _inclinations(setup))


def _triangulated(setup: Setup) -> Estimate:
    """Points alone, from the true poses and mean planes."""
    from colmap_refract.triangulator.options import TriangulatorOptions
    from colmap_refract.triangulator.triangulation import triangulate_points

    capture = setup.capture
    model = ignore_refraction(capture)
    for frame_id, frame in model.frames.items():
        frame.rig_from_world = capture.reconstruction.frames[frame_id].rig_from_world
    images = {
        capture.reconstruction.image(image_id).name: ImageInterface(
            image_id=image_id, normal_in_cam=(normal[0], normal[1], normal[2]), distance=distance
        )
        for image_id, (normal, distance) in capture.planes.items()
    }
    options = TriangulatorOptions(
        slope_deviation_deg=capture.options.wave_slope_deg, pixel_noise=capture.options.pixel_noise
    )
    sidecar = Sidecar(scenario=capture.scenario, layers=capture.layers, images=images)
    return Estimate(points=points_of(triangulate_points(model, sidecar, options).reconstruction))


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
    given="a start: true poses and points, with noise of 1 %",
    estimate=_ignored,
    suits=never_fixed,
)
HARD = Method(
    name="hard",
    text="this package, flat interfaces, no reference image (`refiner`)",
    given="the scenario, the index of water, and the result of SfM (fixed camera: points at one depth) to start from",
    estimate=_hard,
)
SOFT = Method(
    name="soft",
    text="this package, a surface of waves per image (`refiner --interface_shape soft`)",
    given="as hard",
    estimate=_soft,
    suits=wavy,
)
TRD = Method(
    name="TRD",
    text="triangulation in random refractive distortions, known poses (`point_triangulator`)",
    given="the true poses and mean planes, the slope of the waves and the noise of the keypoints",
    estimate=_triangulated,
)
TIED = Method(
    name="hard, shared planes",
    text="hard, with one plane for all frames of an inclination",
    given="as hard, and which frames share an inclination",
    estimate=_tied,
)
AVERAGED = Method(
    name="hard, averaged",
    text="hard on the means of the keypoints of each inclination (`--average_groups 1`)",
    given="as hard, and which frames share an inclination",
    estimate=_averaged,
)
