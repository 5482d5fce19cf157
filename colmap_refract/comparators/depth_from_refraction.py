"""Depth from refraction: a camera at rest sees a scene without water, and once more through water.

After Chen, Wong, Matsushita and Zhu, "Depth from refraction using a transparent medium with unknown pose and
refractive index" (IJCV 2013), with water poured over the scene in place of a glass put before it, as the 3DV 2019 paper
uses it. The dry keypoint says on which straight line the point lies, the wet one on which refracted ray, and the two
meet in the point.

What it is given that the refiner is not: a picture of the scene without water, which no pool or reef allows, and with a
known plane the interface as well. What it is not given: any image but these two.

Nothing moves for the point that is seen along the normal of the interface, however deep it is: the flow, and with it
what the keypoints say of the depth, grows from zero with the angle to the normal. Every point has its standard
deviation, and one without any depth is not a number.

All points and their deviations are in the camera's frame. With an unknown plane all lengths are relative to the
interface's distance: two images of a camera at rest do not tell it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.comparators.keypoints import directions_of, unit_normal
from colmap_refract.errors import RefractError
from colmap_refract.estimator import random_slopes
from colmap_refract.estimator.elimination import Optics
from colmap_refract.estimator.optics import Media, back_project, is_wet, project_direction
from colmap_refract.estimator.random_slopes import Deviations, KnownViews, Sights
from colmap_refract.estimator.robust import TRIVIAL
from colmap_refract.interface import Array, Layers, tangent_basis
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.refiner.refinement import refine

if TYPE_CHECKING:
    import pycolmap

    from colmap_refract.estimator.scenario import Index

_STEP = 1e-5
"""Of finite differences, over the interface's distance and in radians."""
_BLIND = 1e-12
"""Smallest over largest eigenvalue of a point's information below which the difference is rounding."""
_PARALLEL = 1e-14
"""Squared sine of the angle between two rays that do not meet."""
_START_DEPTH = 2.0
"""Of points whose rays do not meet, over the interface's distance."""
_DRY_NAME, _WET_NAME = "dry", "wet"


@dataclass(frozen=True, kw_only=True)
class DepthFromRefraction:
    """M points from two images, camera frame.

    Attributes:
        points: (M, 3), NaN where a keypoint is missing, where the depth is not determined, or where the most likely
            point does not lie behind the interface.
        std: (M,) root mean square error of the position that the keypoints' noise lets one expect, to first order;
            infinite where the point is NaN.
        normal_in_cam: (3,) of the interface, given or found.
        distance: of the interface, given.
    """

    points: Array
    std: Array
    normal_in_cam: Array
    distance: float


def intersect_known_plane(
    dry_keypoints: Array,
    wet_keypoints: Array,
    camera: pycolmap.Camera,
    *,
    normal_in_cam: Array,
    distance: float,
    layers: Layers | None = None,
    pixel_noise: float = 0.5,
) -> DepthFromRefraction:
    """The points where dry lines of sight meet the refracted rays of the wet ones, the interface known.

    Where the two do not meet exactly, the closed form takes the middle of their shortest connection; from there each
    point is brought to the smallest squared pixel error in both images, which is the most likely one.

    Args:
        dry_keypoints, wet_keypoints: (M, 2) pixels, NaN where unseen.
        camera: intrinsics in air, of both.
        normal_in_cam, distance: of the interface.
        layers: media behind it; by default water.
        pixel_noise: standard deviation of each coordinate of a keypoint, px; for `std` only.

    Raises:
        RefractError: arrays that do not belong together, no point in both images, or a plane behind the camera.
    """
    layers, normal = layers or Layers(), unit_normal(normal_in_cam)
    _check(dry_keypoints, wet_keypoints, distance, pixel_noise)
    seen, direction, metric = _both(dry_keypoints, wet_keypoints, camera)
    # The solver's unit is the distance: then its tolerances mean the same for any size.
    scaled = layers.scaled(1 / distance)
    points = _meeting(direction, normal, scaled)
    points = _most_likely(points, direction, metric, normal, scaled)
    covariance = _covariance(points, metric, normal, scaled, plane_known=True)
    return _outcome(seen, points, covariance, normal, distance, scaled, pixel_noise, len(dry_keypoints))


def find_plane_and_points(
    dry_keypoints: Array,
    wet_keypoints: Array,
    camera: pycolmap.Camera,
    *,
    distance: float = 1.0,
    layers: Layers | None = None,
    pixel_noise: float = 0.5,
) -> DepthFromRefraction:
    """The same with an unknown interface: its normal is found with the points, in a refinement of the two images.

    The refinement is that of a fixed camera, one image dry. The points then are those of the normal found, so that the
    points near the one without flow, which the refinement removes, are there with their deviations. `std` holds what
    the normal's own uncertainty adds; the scale, which is not observable, counts as known.

    Args:
        dry_keypoints, wet_keypoints: (M, 2) pixels, NaN where unseen.
        camera: intrinsics in air, of both.
        distance: of the interface, which sets the unit of all lengths.
        layers: media behind it, thicknesses in that unit; by default water.
        pixel_noise: standard deviation of each coordinate of a keypoint, px; for `std` only.

    Raises:
        RefractError: as for a known plane, or too few points for a refinement.
    """
    layers = layers or Layers()
    _check(dry_keypoints, wet_keypoints, distance, pixel_noise)
    seen, direction, metric = _both(dry_keypoints, wet_keypoints, camera)
    model = _two_images(np.asarray(dry_keypoints)[seen], np.asarray(wet_keypoints)[seen], camera)
    options = RefinerOptions(
        scenario="fixed_camera",
        refractive_index=layers.refractive_index,
        layer_thickness=layers.thickness,
        layer_refractive_index=layers.index[:-1],
        interface_distance=distance if any(layers.thickness) else None,
        reference_image=_WET_NAME,
    )
    refined = refine(model, options, notes=ImageNotes(dry_images=frozenset({_DRY_NAME})))
    found = refined.sidecar.images[_WET_NAME].normal_in_cam
    if found is None:
        raise RefractError("no interface was found: the two images do not differ as refraction makes them differ")
    normal, scaled = np.array(found), layers.scaled(1 / distance)
    points = _most_likely(_meeting(direction, normal, scaled), direction, metric, normal, scaled)
    covariance = _covariance(points, metric, normal, scaled, plane_known=False)
    return _outcome(seen, points, covariance, normal, distance, scaled, pixel_noise, len(dry_keypoints))


def _check(dry: Array, wet: Array, distance: float, pixel_noise: float) -> None:
    if np.ndim(dry) != 2 or np.shape(dry) != np.shape(wet) or np.shape(dry)[1] != 2:
        raise RefractError(
            f"dry keypoints of shape {np.shape(dry)} and wet ones of shape {np.shape(wet)}: give (M, 2) of each, "
            "with NaN where a point is not seen"
        )
    if not 0 < distance < np.inf:
        raise RefractError(f"the interface's distance {distance:g} is not in front of the camera: give a number > 0")
    if not 0 < pixel_noise < np.inf:
        raise RefractError(f"pixel_noise {pixel_noise:g} px is not positive; keypoints have about 0.5")


def _both(dry: Array, wet: Array, camera: pycolmap.Camera) -> tuple[Index, Array, Array]:
    """Indices (K,) of the points in both images, directions (K, 2, 3) and metrics (K, 2, 2, 3), dry first."""
    direction, metric = directions_of(camera, np.stack([dry, wet], axis=1))
    seen = np.flatnonzero(np.isfinite(direction).all(axis=(1, 2)))
    if not len(seen):
        raise RefractError("no point is seen both without and with water: nothing can be intersected")
    return seen, direction[seen], metric[seen]


def _meeting(direction: Array, normal: Array, layers: Layers) -> Array:
    """Middles (K, 3) of the shortest connections of dry and refracted rays, in interface distances."""
    dry = direction[:, 0]
    origin, ray = back_project(direction[:, 1], normal, 1.0, layers)
    # Least squares for the two lengths: | t dry - origin - s ray |^2.
    across = np.einsum("ki,ki->k", dry, ray)
    determinant = 1 - across**2
    along_dry, along_ray = np.einsum("ki,ki->k", dry, origin), np.einsum("ki,ki->k", ray, origin)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (along_dry - across * along_ray) / determinant
        s = (across * along_dry - along_ray) / determinant
        middle = 0.5 * (t[:, None] * dry + origin + s[:, None] * ray)
    depth = middle @ normal
    meets = (determinant > _PARALLEL) & np.isfinite(middle).all(axis=1) & (depth > 1) & (depth < 1e3)
    return np.where(meets[:, None], middle, _START_DEPTH / np.maximum(dry @ normal, 0.1)[:, None] * dry)


def _most_likely(points: Array, direction: Array, metric: Array, normal: Array, layers: Layers) -> Array:
    """Points (K, 3) of the smallest squared pixel error in both images, from points to start with."""
    count = len(points)
    sights = Sights(
        np.arange(0, 2 * count + 1, 2),
        np.tile(np.array([0, 1], dtype=np.int32), count),
        np.ascontiguousarray(direction.reshape(-1, 3)),
        np.ascontiguousarray(metric.reshape(-1, 2, 3)),
        np.tile([False, True], count),
    )
    views = KnownViews(np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.tile(normal, (2, 1)), np.ones(2))
    media = Media(layers)
    optics = Optics(media.ratio, media.ratio_by_index, media.walls)
    settled = points.copy()
    random_slopes.settle(settled, 0, count, sights, views, optics, Deviations(1.0, 0.0), TRIVIAL, 1.0)
    return settled


def _covariance(points: Array, metric: Array, normal: Array, layers: Layers, *, plane_known: bool) -> Array:
    """Covariances (K, 3, 3) for a noise of 1 px; not finite where the depth is not determined."""
    wet = np.ones(len(points), dtype=np.bool_)

    def seen(shift: Array, tilt: Array) -> Array:
        at = points + shift
        turned = normal + tangent_basis(normal) @ tilt
        straight = at / np.linalg.norm(at, axis=1, keepdims=True)
        bent = project_direction(at, turned / np.linalg.norm(turned), 1.0, layers, wet)
        return np.concatenate(
            [np.einsum("kij,kj->ki", metric[:, i], d) for i, d in enumerate((straight, bent))], axis=1
        )

    steps = _STEP * np.eye(5)
    derivative = np.stack(
        [(seen(step[:3], step[3:]) - seen(-step[:3], -step[3:])) / (2 * _STEP) for step in steps], axis=2
    )
    by_point, by_tilt = derivative[:, :, :3], derivative[:, :, 3:]
    finite = np.asarray(np.isfinite(derivative).all(axis=(1, 2)))
    information = np.where(finite[:, None, None], by_point.mT @ by_point, 0.0)
    values, vectors = np.linalg.eigh(information)
    sound = np.flatnonzero(finite & (values[:, 0] > _BLIND * values[:, 2]))
    covariance = np.full_like(information, np.inf)
    inverse = (vectors[sound] / values[sound, None]) @ vectors[sound].mT
    covariance[sound] = inverse
    if not plane_known:
        by_point, by_tilt = by_point[sound], by_tilt[sound]
        # What the tilts are known to once the points are eliminated; each point follows them.
        follow = inverse @ by_point.mT @ by_tilt
        rest = by_tilt - by_point @ follow
        of_tilt = np.linalg.pinv(np.einsum("kia,kib->ab", rest, rest))
        covariance[sound] += follow @ of_tilt @ follow.mT
    return covariance


def _outcome(
    seen: Index,
    points: Array,
    covariance: Array,
    normal: Array,
    distance: float,
    layers: Layers,
    pixel_noise: float,
    count: int,
) -> DepthFromRefraction:
    every, std = np.full((count, 3), np.nan), np.full(count, np.inf)
    variance: Array = np.einsum("kii->k", covariance)
    fine = np.isfinite(variance) & np.isfinite(points).all(axis=1) & is_wet(points, normal, 1.0, layers)
    every[seen[fine]] = distance * points[fine]
    std[seen[fine]] = distance * pixel_noise * np.sqrt(variance[fine])
    return DepthFromRefraction(points=every, std=std, normal_in_cam=normal, distance=float(distance))


def _two_images(dry: Array, wet: Array, camera: pycolmap.Camera) -> pycolmap.Reconstruction:
    """A model of one camera at the origin, points on their dry lines of sight at depth one."""
    import pycolmap

    model = pycolmap.Reconstruction()
    own = pycolmap.Camera(camera.todict())
    own.camera_id = 1
    model.add_camera_with_trivial_rig(own)
    for image_id, (name, keypoints) in enumerate([(_DRY_NAME, dry), (_WET_NAME, wet)], start=1):
        image = pycolmap.Image(name, np.ascontiguousarray(keypoints), 1, image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for idx, ray in enumerate(np.asarray(own.cam_ray_from_img(np.ascontiguousarray(dry)))):
        track = pycolmap.Track([pycolmap.TrackElement(1, idx), pycolmap.TrackElement(2, idx)])
        model.add_point3D(ray / ray[2], track)
    return model
