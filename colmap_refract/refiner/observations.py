"""A COLMAP model as arrays: who sees what in which direction, and how a change of direction shows in pixels.

Intrinsics are known, so every keypoint is lifted once to a unit direction through COLMAP's own camera model,
with the 2x3 matrix that turns a small change of direction into pixels there. Nothing behind this module
knows a camera model. This and `model_io` are the only modules that read a `pycolmap.Reconstruction`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array

if TYPE_CHECKING:
    import pycolmap

_STEP = 1e-4
"""Radians, of the central differences: error and rounding both stay below 1e-7 of the derivative."""
_ROUND_TRIP = 0.01
"""Pixels that a lifted keypoint may be off when it is projected again."""


@dataclass(frozen=True, kw_only=True)
class Observations:
    """Observations sorted by point: N observations of P points in I registered images by C cameras, F frames.

    Attributes:
        image_ids, image_names: (I,) COLMAP's, ascending by id.
        image_camera: (I,) index into `camera_ids`.
        image_frame: (I,) index into `frame_ids`.
        image_rig: (I,) id of the rig.
        camera_ids, cameras: (C,).
        frame_ids: (F,).
        rig_from_world_rotation, rig_from_world_translation: (F, 3, 3), (F, 3).
        sensor_rotation, sensor_translation: (I, 3, 3), (I, 3) `sensor_from_rig`.
        point3D_ids: (P,) and points: (P, 3), world.
        start: (P + 1,) first observation of each point.
        image: (N,) index of the image, point2D_idx: (N,), pixel: (N, 2) keypoints.
        direction: (N, 3) unit, metric: (N, 2, 3) px per unit of direction, times the weight.
        weight: (N,) a typical keypoint's standard deviation over each one's own; None where all are alike.
        num_unliftable: keypoints that the camera model cannot invert; they are left out.
    """

    image_ids: Index
    image_names: list[str]
    image_camera: Index
    image_frame: Index
    image_rig: Index
    camera_ids: Index
    cameras: list[pycolmap.Camera]
    frame_ids: Index
    rig_from_world_rotation: Array
    rig_from_world_translation: Array
    sensor_rotation: Array
    sensor_translation: Array
    point3D_ids: Index
    points: Array
    start: Index
    image: Index
    point2D_idx: Index
    pixel: Array
    direction: Array
    metric: Array
    weight: Array | None = None
    num_unliftable: int = 0

    @property
    def point(self) -> Index:
        """(N,) index of the point of each observation."""
        return np.repeat(np.arange(len(self.points)), np.diff(self.start))

    @property
    def cam_from_world(self) -> tuple[Array, Array]:
        """`(rotation, translation)` of every image, (I, 3, 3) and (I, 3)."""
        rotation = self.sensor_rotation @ self.rig_from_world_rotation[self.image_frame]
        shift = np.einsum("nij,nj->ni", self.sensor_rotation, self.rig_from_world_translation[self.image_frame])
        return rotation, shift + self.sensor_translation

    def select(self, keep: NDArray[np.bool_]) -> Observations:
        """The observations that `keep` (N,) marks, without points that are left with fewer than two."""
        counts = np.bincount(self.point[keep], minlength=len(self.points))
        keep_point = counts >= 2
        keep = keep & keep_point[self.point]
        return replace(
            self,
            point3D_ids=self.point3D_ids[keep_point],
            points=self.points[keep_point],
            start=np.concatenate([[0], np.cumsum(counts[keep_point])]),
            image=self.image[keep],
            point2D_idx=self.point2D_idx[keep],
            pixel=self.pixel[keep],
            direction=self.direction[keep],
            metric=self.metric[keep],
            weight=None if self.weight is None else self.weight[keep],
        )


def read_observations(reconstruction: pycolmap.Reconstruction) -> Observations:
    """The observations of all registered images, as arrays.

    Args:
        reconstruction: a COLMAP model; it is not altered.

    Returns:
        `Observations`; points seen in fewer than two registered images are left out.
    """
    import pycolmap

    image_ids = np.array(sorted(reconstruction.reg_image_ids()), dtype=np.int64)
    images = [reconstruction.image(int(i)) for i in image_ids]
    camera_ids = np.unique([image.camera_id for image in images])
    frame_ids = np.unique([image.frame_id for image in images])
    sensors = []
    for image in images:
        rig = image.frame.rig
        sensor = image.camera.sensor_id
        sensors.append(pycolmap.Rigid3d() if rig.is_ref_sensor(sensor) else rig.sensor_from_rig(sensor))
    poses = [reconstruction.frame(int(f)).rig_from_world for f in frame_ids]

    point3D_ids = np.array(sorted(reconstruction.point3D_ids()), dtype=np.int64)
    row = {int(i): k for k, i in enumerate(image_ids)}
    point, image_row, point2D_idx, pixel = [], [], [], []
    for k, image in enumerate(images):
        idxs = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        observed = image.get_observation_points2D()
        ids = np.array([p.point3D_id for p in observed], dtype=np.int64)
        point.append(np.searchsorted(point3D_ids, ids))
        image_row.append(np.full(len(idxs), row[image.image_id] if len(idxs) else k, dtype=np.int64))
        point2D_idx.append(idxs)
        pixel.append(np.array([p.xy for p in observed]).reshape(-1, 2))
    points = np.array([reconstruction.point3D(int(i)).xyz for i in point3D_ids]).reshape(-1, 3)
    every_point = np.concatenate(point)
    order = np.argsort(every_point, kind="stable")
    image_of = np.concatenate(image_row)[order]
    image_camera = np.searchsorted(camera_ids, [image.camera_id for image in images])
    observations = Observations(
        image_ids=image_ids,
        image_names=[image.name for image in images],
        image_camera=image_camera,
        image_frame=np.searchsorted(frame_ids, [image.frame_id for image in images]),
        image_rig=np.array([image.frame.rig_id for image in images], dtype=np.int64),
        camera_ids=camera_ids,
        cameras=[pycolmap.Camera(reconstruction.camera(int(c)).todict()) for c in camera_ids],
        frame_ids=frame_ids,
        rig_from_world_rotation=np.array([pose.rotation.matrix() for pose in poses]),
        rig_from_world_translation=np.array([pose.translation for pose in poses]),
        sensor_rotation=np.array([sensor.rotation.matrix() for sensor in sensors]),
        sensor_translation=np.array([sensor.translation for sensor in sensors]),
        point3D_ids=point3D_ids,
        points=points,
        start=np.concatenate([[0], np.cumsum(np.bincount(every_point, minlength=len(point3D_ids)))]),
        image=image_of,
        point2D_idx=np.concatenate(point2D_idx)[order],
        pixel=np.concatenate(pixel)[order],
        direction=np.zeros((len(order), 3)),
        metric=np.zeros((len(order), 2, 3)),
    )
    return lift(observations)


def lift(observations: Observations) -> Observations:
    """Directions and metrics of all keypoints anew, from the cameras as they are."""
    direction = np.empty_like(observations.direction)
    metric = np.empty_like(observations.metric)
    camera_of = observations.image_camera[observations.image]
    for c, camera in enumerate(observations.cameras):
        mine = np.flatnonzero(camera_of == c)
        pixel = observations.pixel[mine]
        ray = np.asarray(camera.cam_ray_from_img(pixel))
        # Beyond what a model can invert, COLMAP returns a ray all the same, which does not lead back.
        off = np.abs(_shortest(camera, _project(camera, ray) - pixel)).max(axis=1, initial=0.0)
        direction[mine] = np.where((off < _ROUND_TRIP)[:, None], ray, np.nan)
        metric[mine] = pixel_metric(camera, direction[mine])
    if observations.weight is not None:
        metric *= observations.weight[:, None, None]
    lifted = replace(observations, direction=direction, metric=metric)
    fine = np.asarray(np.isfinite(direction).all(axis=1) & np.isfinite(metric).all(axis=(1, 2)))
    return replace(lifted.select(fine), num_unliftable=int((~fine).sum()))


def pixel_metric(camera: pycolmap.Camera, direction: Array) -> Array:
    """Pixels per change of direction, by central differences of COLMAP's own model.

    Args:
        camera: any COLMAP camera model.
        direction: (N, 3) unit directions in its frame.

    Returns:
        (N, 2, 3), orthogonal to the direction; NaN where the camera does not see.
    """
    basis = _tangent_bases(direction)
    metric = np.zeros((len(direction), 2, 3))
    for j in range(2):
        step = _STEP * basis[:, :, j]
        ahead, behind = _project(camera, direction + step), _project(camera, direction - step)
        change = _shortest(camera, ahead - behind) / (2.0 * _STEP)
        metric += change[:, :, None] * basis[:, None, :, j]
    return metric


def lens_jacobian(camera: pycolmap.Camera, direction: Array, parameters: list[int]) -> Array:
    """Pixels per change of the camera's intrinsic parameters at fixed directions: (N, 2, len(parameters))."""
    import pycolmap

    jacobian = np.empty((len(direction), 2, len(parameters)))
    for j, index in enumerate(parameters):
        step = 1e-5 * max(1.0, abs(camera.params[index]))
        images = []
        for sign in (1.0, -1.0):
            moved = pycolmap.Camera(camera.todict())
            params = np.array(moved.params)
            params[index] += sign * step
            moved.params = params.tolist()
            images.append(_project(moved, direction))
        jacobian[:, :, j] = (images[0] - images[1]) / (2.0 * step)
    return jacobian


def pixel_errors(observations: Observations, direction: Array) -> Array:
    """Exact reprojection errors (N,) in px of predicted unit directions (N, 3); infinite where not seen."""
    error = np.empty(len(direction))
    camera_of = observations.image_camera[observations.image]
    for c, camera in enumerate(observations.cameras):
        mine = np.flatnonzero(camera_of == c)
        change = _shortest(camera, _project(camera, direction[mine]) - observations.pixel[mine])
        error[mine] = np.linalg.norm(change, axis=1)
    return np.where(np.isfinite(error), error, np.inf)


def _tangent_bases(direction: Array) -> Array:
    """`tangent_basis` in a batch: (N, 3, 2)."""
    flat = np.abs(direction[:, 0]) < 0.9
    axis = np.where(flat[:, None], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    e1 = axis - np.einsum("ni,ni->n", axis, direction)[:, None] * direction
    e1 /= np.linalg.norm(e1, axis=1)[:, None]
    return np.stack([e1, np.cross(direction, e1)], axis=2)


def _project(camera: pycolmap.Camera, direction: Array) -> Array:
    """Pixels (N, 2) of directions (N, 3) in the camera's frame; NaN where it does not see."""
    return np.asarray(camera.img_from_cam(direction), dtype=np.float64)


def _shortest(camera: pycolmap.Camera, change: Array) -> Array:
    """Pixel differences the short way round: a full panorama's left and right edges are one place."""
    if not camera.is_spherical():
        return change
    wrapped = change.copy()
    wrapped[:, 0] -= camera.width * np.round(change[:, 0] / camera.width)
    return wrapped
