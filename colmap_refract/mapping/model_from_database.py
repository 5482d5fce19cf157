"""The model that a COLMAP database stands for before anything is posed: cameras, rigs, frames, images, keypoints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.files.cameras_file import fit_to_size, known_camera
from colmap_refract.mapping.database import Correspondences, read_database
from colmap_refract.mapping.tracks import Tracks
from colmap_refract.refiner.observations import Observations, lift

if TYPE_CHECKING:
    import pycolmap

Mask = NDArray[np.bool_]

_BULK = ("descriptors", "keypoints", "matches", "two_view_geometries")


@dataclass(frozen=True, kw_only=True)
class Posed:
    """Observations with poses and points: F frames, N observations.

    Attributes:
        observations: with poses per frame and points.
        posed: (F,) the frames that have a pose.
        keep: (N,) observations that become part of a track: none, or at least two of each point.
    """

    observations: Observations
    posed: Mask
    keep: Mask

    @property
    def posed_images(self) -> Mask:
        """(I,) the images that have a pose."""
        return self.posed[self.observations.image_frame]


def read_unposed_model(
    path: str | Path,
    correspondences: Correspondences,
    *,
    cameras: Mapping[int, pycolmap.Camera] | None = None,
) -> pycolmap.Reconstruction:
    """A model with all images of a database, none of them posed, and no points.

    Every id is the database's. What a database of COLMAP 3 lacks is made as COLMAP 4 does: a rig per camera, a
    frame per image.

    Args:
        path: the database.
        correspondences: what was read from it.
        cameras: intrinsics calibrated in air by camera id, in place of the database's. A single camera stands for
            all, whatever its id.

    Raises:
        RefractError: no such database, a rig whose sensors' places are not known, or intrinsics that do not fit.
    """
    import pycolmap

    with read_database(path, without=_BULK) as database:
        rigs, frames = database.read_all_rigs(), database.read_all_frames()
    used = {int(correspondences.camera_ids[c]) for c in correspondences.image_camera}
    model = pycolmap.Reconstruction()
    for camera_id, camera in zip(correspondences.camera_ids.tolist(), correspondences.cameras, strict=True):
        model.add_camera(_calibrated(camera, cameras) if cameras and camera_id in used else camera)
    frame_of: dict[int, int] = {}
    for rig in rigs:
        _check_rig(rig)
        model.add_rig(rig)
    known = set(correspondences.image_ids.tolist())
    for frame in frames:
        held = [data.id for data in frame.data_ids if data.id in known]
        frame_of |= {image_id: frame.frame_id for image_id in held}
        if held:
            frame.reset_pose()
            model.add_frame(frame)
    for image_id, name, c, keypoints in zip(
        correspondences.image_ids.tolist(),
        correspondences.image_names,
        correspondences.image_camera,
        correspondences.keypoints,
        strict=True,
    ):
        camera_id = int(correspondences.camera_ids[c])
        image = pycolmap.Image(name, keypoints, camera_id, image_id)
        if image_id not in frame_of:
            frame_of[image_id] = _add_trivial_frame(model, camera_id, image_id)
        image.frame_id = frame_of[image_id]
        model.add_image(image)
    return model


def observations_of_tracks(
    model: pycolmap.Reconstruction, correspondences: Correspondences, tracks: Tracks
) -> Observations:
    """Tracks as observations with directions; all poses are the identity and all points the origin.

    Keypoints that the camera model cannot invert are left out, and points that fewer than two are left of.
    """
    import pycolmap

    images = [model.image(int(i)) for i in correspondences.image_ids]
    frame_ids, image_frame = np.unique([image.frame_id for image in images], return_inverse=True)
    sensors = []
    for image in images:
        rig = model.rig(model.frame(image.frame_id).rig_id)
        sensor = model.camera(image.camera_id).sensor_id
        place = None if rig.is_ref_sensor(sensor) else rig.sensor_from_rig(sensor)
        sensors.append(place or pycolmap.Rigid3d())
    count, num_points = len(tracks.image), len(tracks.start) - 1
    first = correspondences.first_keypoint
    every = np.concatenate([*correspondences.keypoints, np.zeros((0, 2))])
    observations = Observations(
        image_ids=correspondences.image_ids,
        image_names=correspondences.image_names,
        image_camera=correspondences.image_camera,
        image_frame=image_frame.astype(np.int64),
        image_rig=np.array([model.frame(image.frame_id).rig_id for image in images], dtype=np.int64),
        camera_ids=correspondences.camera_ids,
        cameras=[model.camera(int(c)) for c in correspondences.camera_ids],
        frame_ids=frame_ids.astype(np.int64),
        rig_from_world_rotation=np.tile(np.eye(3), (len(frame_ids), 1, 1)),
        rig_from_world_translation=np.zeros((len(frame_ids), 3)),
        sensor_rotation=np.array([sensor.rotation.matrix() for sensor in sensors]),
        sensor_translation=np.array([sensor.translation for sensor in sensors]),
        point3D_ids=np.arange(1, num_points + 1, dtype=np.int64),
        points=np.zeros((num_points, 3)),
        start=tracks.start,
        image=tracks.image,
        point2D_idx=tracks.point2D_idx,
        pixel=every[first[tracks.image] + tracks.point2D_idx],
        direction=np.zeros((count, 3)),
        metric=np.zeros((count, 2, 3)),
    )
    return lift(observations)


def put_into_model(model: pycolmap.Reconstruction, start: Posed) -> pycolmap.Reconstruction:
    """A copy of an unposed model, as `read_unposed_model` makes it, with poses and points."""
    import pycolmap

    model = pycolmap.Reconstruction(model)
    observations = start.observations
    for f in np.flatnonzero(start.posed).tolist():
        frame = model.frame(int(observations.frame_ids[f]))
        rotation = pycolmap.Rotation3d(observations.rig_from_world_rotation[f])
        frame.rig_from_world = pycolmap.Rigid3d(rotation, observations.rig_from_world_translation[f])
        model.register_frame(frame.frame_id)
    kept = observations.select(start.keep)
    image_ids = kept.image_ids[kept.image].tolist()
    point2D_idx = kept.point2D_idx.tolist()
    for p, (begin, end) in enumerate(zip(kept.start[:-1].tolist(), kept.start[1:].tolist(), strict=True)):
        elements = [pycolmap.TrackElement(image_ids[k], point2D_idx[k]) for k in range(begin, end)]
        model.add_point3D(kept.points[p], pycolmap.Track(elements))
    model.update_point_3d_errors()
    return model


def _calibrated(camera: pycolmap.Camera, cameras: Mapping[int, pycolmap.Camera]) -> pycolmap.Camera:
    calibrated = fit_to_size(known_camera(camera, cameras, "the database"), camera.width, camera.height)
    calibrated.camera_id = camera.camera_id
    return calibrated


def _check_rig(rig: pycolmap.Rig) -> None:
    for sensor in rig.non_ref_sensors:
        if not rig.has_sensor_from_rig(sensor):
            raise RefractError(
                f"rig {rig.rig_id} does not say where its camera {sensor.id} sits (sensor_from_rig): calibrate the rig "
                "(colmap rig_configurator), or import the images without a rig"
            )


def _add_trivial_frame(model: pycolmap.Reconstruction, camera_id: int, image_id: int) -> int:
    """A frame of its own for an image, with its camera's own rig; the frame's id."""
    import pycolmap

    sensor = model.camera(camera_id).sensor_id
    rig_id = next((i for i, rig in model.rigs.items() if rig.is_ref_sensor(sensor) and rig.num_sensors() == 1), None)
    if rig_id is None:
        rig_id = camera_id if not model.exists_rig(camera_id) else max(model.rigs) + 1
        rig = pycolmap.Rig(rig_id=rig_id)
        rig.add_ref_sensor(sensor)
        model.add_rig(rig)
    frame_id = image_id if not model.exists_frame(image_id) else max(model.frames) + 1
    frame = pycolmap.Frame(frame_id=frame_id, rig_id=rig_id)
    frame.add_data_id(pycolmap.data_t(sensor, image_id))
    model.add_frame(frame)
    return frame_id
