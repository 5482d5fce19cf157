"""Every method that is compared with in one form: a model in, and what it is given; a model out, ids and tracks kept.

Each function says what its method is given that the refiner is not. Points that a method does not determine are removed
from its model, so whoever compares must say how many there are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np

from colmap_refract.comparators import depth_from_refraction as by_refraction
from colmap_refract.comparators import depth_from_turbulence as by_turbulence
from colmap_refract.comparators.keypoints import FixedCameraTracks, tracks_of
from colmap_refract.errors import RefractError
from colmap_refract.files.model_io import copy_model
from colmap_refract.files.sidecar import ImageInterface, Sidecar
from colmap_refract.interface import Array, Layers
from colmap_refract.triangulator.options import TriangulatorOptions
from colmap_refract.triangulator.triangulation import triangulate_points

if TYPE_CHECKING:
    import pycolmap

Plane = tuple[Array, float]
TurbulenceForm = Literal["refracted", "spread"]


def ignoring_refraction(
    model: pycolmap.Reconstruction, *, loss_scale: float | None = None, num_threads: int = 1
) -> pycolmap.Reconstruction:
    """Simple SfM: COLMAP's bundle adjustment, intrinsics held, as if there were no water.

    It is given nothing that the refiner is not. The camera must move: without refraction a fixed one has no baseline.

    Args:
        model: with poses, points and tracks to start from; it is not altered.
        loss_scale: of a Cauchy loss, px; None: plain least squares.
        num_threads: of the adjustment; -1 for all.

    Raises:
        RefractError: fewer than two images with a pose, or all of one pose.
    """
    import pycolmap

    model = copy_model(model)
    centers = np.array([model.image(i).projection_center() for i in model.reg_image_ids()]).reshape(-1, 3)
    if len(centers) < 2 or not np.ptp(centers, axis=0).max() > 0:
        raise RefractError(
            "the images were all taken from one place: without refraction there is nothing to triangulate"
        )
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.ceres.solver_options.num_threads = num_threads
    options.ceres.solver_options.function_tolerance = 1e-9
    options.ceres.solver_options.max_num_iterations = 300
    if loss_scale is not None:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = loss_scale
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    return model


def depth_from_turbulence(
    model: pycolmap.Reconstruction,
    truth: pycolmap.Reconstruction,
    *,
    form: TurbulenceForm = "refracted",
    pixel_noise: float = 0.0,
    refractive_index: float = 1.333,
    normal_in_cam: Array | tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> pycolmap.Reconstruction:
    """The depths of a fixed camera's points from how they wander; see `depth_from_turbulence`.

    It is given the true points, for a scale and an offset, and the direction of the mean surface's normal.

    Args:
        model: of one camera at one pose; not altered.
        truth: a model with the true points by id, in the frame of `model`.
        form: `refracted`, the better one, or `spread`, the plain one, which takes neither index nor normal.
        pixel_noise, refractive_index, normal_in_cam: as of `refracted_depths`.

    Raises:
        RefractError: as the method; no points in common.
    """
    if form not in ("refracted", "spread"):
        raise RefractError(f"'{form}' is no form of depth from turbulence: give refracted or spread")
    tracks = tracks_of(model)
    known = truth.points3D
    ids = tracks.point3D_ids.tolist()
    true = np.array([known[i].xyz if i in known else np.full(3, np.nan) for i in ids])
    if not np.isfinite(true).all(axis=1).any():
        raise RefractError("the truth has none of the model's points: give a model with the same point ids")
    in_cam = tracks.in_cam(true)
    if form == "spread":
        found = by_turbulence.spread_depths(tracks.keypoints, tracks.camera, in_cam, pixel_noise=pixel_noise)
    else:
        found = by_turbulence.refracted_depths(
            tracks.keypoints, tracks.camera, in_cam, pixel_noise=pixel_noise, refractive_index=refractive_index,
            normal_in_cam=normal_in_cam,
        )  # fmt: skip
    return _with_points(model, tracks, found.points)


def depth_from_refraction(
    model: pycolmap.Reconstruction,
    dry_image: str,
    wet_image: str,
    *,
    plane: Plane | None = None,
    layers: Layers | None = None,
    pixel_noise: float = 0.5,
    max_std: float = np.inf,
) -> pycolmap.Reconstruction:
    """The points of a fixed camera from one image without water and one with; see `depth_from_refraction`.

    It is given the dry image and, with `plane`, the interface; it is not given the other images of the model.

    Args:
        model: of one camera at one pose; not altered.
        dry_image, wet_image: names.
        plane: `(normal_in_cam, distance)` of the wet image; None: unknown, and the distance is taken to be one.
        layers: media behind the interface; by default water.
        pixel_noise: standard deviation of each coordinate of a keypoint, px.
        max_std: points with a larger standard deviation are removed, too; in the unit of the distance.

    Raises:
        RefractError: as the method; an image that is not there, or no point that is determined so well.
    """
    tracks = tracks_of(model)
    for name in (dry_image, wet_image):
        if name not in tracks.image_names:
            raise RefractError(
                f"the model has no registered image '{name}' with points: name one with and one without water"
            )
    dry, wet = (tracks.keypoints[:, tracks.image_names.index(name)] for name in (dry_image, wet_image))
    if plane is None:
        found = by_refraction.find_plane_and_points(dry, wet, tracks.camera, layers=layers, pixel_noise=pixel_noise)
    else:
        found = by_refraction.intersect_known_plane(
            dry, wet, tracks.camera, normal_in_cam=plane[0], distance=plane[1], layers=layers, pixel_noise=pixel_noise
        )
    points = np.where((found.std <= max_std)[:, None], found.points, np.nan)
    return _with_points(model, tracks, points)


def random_refractive_distortions(
    model: pycolmap.Reconstruction,
    planes: Mapping[str, Plane | None],
    *,
    slope_deviation_deg: float,
    layers: Layers | None = None,
    pixel_noise: float = 0.5,
    min_tri_angle: float = 0.0,
    max_error_std: float = 0.0,
) -> pycolmap.Reconstruction:
    """Triangulation in random refractive distortions (Alterman, Schechner and Swirski, TPAMI 2017).

    It is given the poses of the cameras, the mean plane of every image and the strength of the waves.

    Args:
        model: with the known poses, at their true size, and tracks; its points are a start. It is not altered.
        planes: per image name `(normal_in_cam, distance)` of the mean surface, or None where there is no water.
        slope_deviation_deg: root mean square slope of the waves, both directions together.
        layers: media behind the planes; by default water.
        pixel_noise: standard deviation of each coordinate of a keypoint, px.
        min_tri_angle, max_error_std: filters, in degrees and in standard deviations; off by default, so that it is
            compared on all points.

    Raises:
        RefractError: an image without an entry, or what `triangulate_points` cannot use.
    """
    interfaces = {}
    for image_id in model.reg_image_ids():
        name = model.image(image_id).name
        if name not in planes:
            raise RefractError(f"no plane is given for image '{name}': give one, or None if it was taken without water")
        plane = planes[name]
        interfaces[name] = ImageInterface(
            image_id=image_id,
            normal_in_cam=None if plane is None else (float(plane[0][0]), float(plane[0][1]), float(plane[0][2])),
            distance=None if plane is None else float(plane[1]),
        )
    sidecar = Sidecar(scenario="moving_interface", layers=layers or Layers(), images=interfaces)
    options = TriangulatorOptions(
        slope_deviation_deg=slope_deviation_deg,
        pixel_noise=pixel_noise,
        filter_min_tri_angle=min_tri_angle,
        filter_max_error_std=max_error_std,
    )
    return triangulate_points(model, sidecar, options).reconstruction


def _with_points(
    model: pycolmap.Reconstruction, tracks: FixedCameraTracks, points_in_cam: Array
) -> pycolmap.Reconstruction:
    """A copy of the model with the points that there are, and no others."""
    model = copy_model(model)
    fine = np.isfinite(points_in_cam).all(axis=1)
    if not fine.any():
        raise RefractError("no point is determined: nothing is left of the model")
    found = dict(zip(tracks.point3D_ids[fine].tolist(), tracks.in_world(points_in_cam[fine]), strict=True))
    for point3D_id in list(model.point3D_ids()):
        if point3D_id in found:
            model.point3D(point3D_id).xyz = found[point3D_id]
        else:
            model.delete_point3D(point3D_id)
    return model
