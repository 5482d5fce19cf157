"""Keypoints of a camera that does not move, as one array, and the directions they are seen in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array
from colmap_refract.refiner.observations import pixel_metric, read_observations

if TYPE_CHECKING:
    import pycolmap

_SAME_POSE = 1e-6
"""Of rotation matrices, and of positions over the median depth."""


@dataclass(frozen=True, kw_only=True)
class FixedCameraTracks:
    """What a camera at rest sees of M points in F images.

    Attributes:
        camera: of all images.
        cam_from_world: (3, 4), of all images.
        image_names: (F,), in the order of their ids.
        point3D_ids: (M,).
        keypoints: (M, F, 2) pixels, NaN where a point is not seen.
    """

    camera: pycolmap.Camera
    cam_from_world: Array
    image_names: list[str]
    point3D_ids: Index
    keypoints: Array

    def in_world(self, points_in_cam: Array) -> Array:
        """Points (M, 3) of the camera's frame in the world's."""
        return np.asarray((points_in_cam - self.cam_from_world[:, 3]) @ self.cam_from_world[:, :3])

    def in_cam(self, points: Array) -> Array:
        """Points (M, 3) of the world in the camera's frame."""
        return np.asarray(points @ self.cam_from_world[:, :3].T + self.cam_from_world[:, 3])


def tracks_of(model: pycolmap.Reconstruction) -> FixedCameraTracks:
    """The tracks of a model whose images were all taken from one pose with one camera.

    Raises:
        RefractError: no tracks, several cameras, or poses that differ.
    """
    observations = read_observations(model)
    if not len(observations.points):
        raise RefractError("the model has no point that two registered images see: there is nothing to compare")
    if len(observations.camera_ids) > 1:
        raise RefractError(f"the model has {len(observations.camera_ids)} cameras: a fixed camera is one")
    rotation, translation = observations.cam_from_world
    reach = np.median(np.linalg.norm(observations.points @ rotation[0].T + translation[0], axis=1))
    turned, moved = np.abs(rotation - rotation[0]).max(), np.abs(translation - translation[0]).max()
    if turned > _SAME_POSE or moved > _SAME_POSE * reach:
        raise RefractError("the images have different poses: this method takes a camera that does not move")
    keypoints = np.full((len(observations.points), len(observations.image_ids), 2), np.nan)
    keypoints[observations.point, observations.image] = observations.pixel
    return FixedCameraTracks(
        camera=observations.cameras[0],
        cam_from_world=np.column_stack([rotation[0], translation[0]]),
        image_names=observations.image_names,
        point3D_ids=observations.point3D_ids,
        keypoints=keypoints,
    )


def directions_of(camera: pycolmap.Camera, keypoints: Array) -> tuple[Array, Array]:
    """Unit directions (..., 3) of keypoints (..., 2), and pixels per change of direction (..., 2, 3).

    NaN where the keypoint is, or where the camera model cannot invert it.
    """
    flat = np.ascontiguousarray(keypoints, dtype=np.float64).reshape(-1, 2)
    direction, metric = np.full((len(flat), 3), np.nan), np.full((len(flat), 2, 3), np.nan)
    seen = np.flatnonzero(np.isfinite(flat).all(axis=1))
    if len(seen):
        direction[seen] = camera.cam_ray_from_img(flat[seen])
        seen = seen[np.isfinite(direction[seen]).all(axis=1)]
        metric[seen] = pixel_metric(camera, direction[seen])
    lost = ~np.isfinite(metric).all(axis=(1, 2))
    direction[lost] = np.nan
    shape = np.shape(keypoints)[:-1]
    return direction.reshape(*shape, 3), metric.reshape(*shape, 2, 3)


def unit_normal(normal_in_cam: Array | tuple[float, float, float]) -> Array:
    """A direction at unit length.

    Raises:
        RefractError: it is no direction into the scene.
    """
    normal = np.asarray(normal_in_cam, dtype=np.float64)
    if normal.shape != (3,) or not np.isfinite(normal).all() or not np.linalg.norm(normal) > 0:
        raise RefractError(f"the normal {normal_in_cam} is not a direction: give three numbers, e.g. 0 0 1")
    if not normal[2] > 0:
        raise RefractError(f"the normal {normal_in_cam} points away from the scene: it must point into the water")
    return np.asarray(normal / np.linalg.norm(normal))
