"""How near a model's points are to the truth, and how near the pixel noise lets them be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, plane_in_world
from colmap_refract.simulation.capture import Capture
from colmap_refract.simulation.precision import Configuration, precision
from colmap_refract.simulation.scene import sensors_from_rig

if TYPE_CHECKING:
    import pycolmap


def point_rmse(reconstruction: pycolmap.Reconstruction, capture: Capture, robust: bool = False) -> float:
    """Distance of the points to the truth after a similarity alignment, in metres.

    Args:
        reconstruction: a model with the capture's point ids; those it lacks are left out.
        robust: the median distance, aligned to the best 90 % of the points, in place of the root mean square.

    Raises:
        RefractError: fewer than three points in common.
    """
    truth = capture.reconstruction
    common = sorted(set(reconstruction.point3D_ids()) & set(truth.point3D_ids()))
    if len(common) < 3:
        raise RefractError(f"{len(common)} points in common with the truth; three are needed")
    source = np.array([reconstruction.points3D[i].xyz for i in common])
    target = np.array([truth.points3D[i].xyz for i in common])
    if robust:
        aligned, _ = align_to_best(source, target)
        return float(np.median(np.linalg.norm(aligned - target, axis=1)))
    return float(np.sqrt(np.mean(np.sum((align(source, target, source) - target) ** 2, axis=1))))


def align(source: Array, target: Array, points: Array) -> Array:
    """`points` moved by the similarity that brings `source` to `target` (Umeyama 1991)."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    u, singular, vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    scale = singular @ sign / np.sum((source - source_mean) ** 2)
    return np.asarray(scale * (points - source_mean) @ (u * sign @ vt).T + target_mean)


def align_to_best(found: Array, true: Array) -> tuple[Array, NDArray[np.int64]]:
    """Points (P, 3), brought to the truth by the similarity of the best 90 %, and which those are.

    Runaway points would spoil a first alignment, and they are far from the others: it begins without them.
    """
    error = np.linalg.norm(found - np.median(found, axis=0), axis=1)
    best = np.arange(len(found))
    for _ in range(20):
        best = np.argsort(error)[: max(3, int(0.9 * len(error)))]
        aligned = align(found[best], true[best], found)
        error = np.linalg.norm(aligned - true, axis=1)
    return aligned, best


def slope_error(normals_in_cam: Mapping[int, Array], capture: Capture) -> float:
    """Root mean square angle between recovered normals of the surface and the true ones, degrees.

    Args:
        normals_in_cam: per image id, (n, 3) for each keypoint, of any length, from the camera into the water, camera
            frame. Images that are not there are left out, and so are rows that are not a number.

    Raises:
        RefractError: an image without a true surface, another number of keypoints, or no normal at all.
    """
    squares = []
    for image_id, found in normals_in_cam.items():
        if image_id not in capture.surfaces:
            raise RefractError(f"image {image_id} has no true surface")
        true = capture.normals_in_cam(image_id)
        if np.shape(found) != true.shape:
            raise RefractError(f"image {image_id} has {len(true)} keypoints, but normals of shape {np.shape(found)}")
        # Small angles have no digits left in their cosine.
        angle = np.arctan2(np.linalg.norm(np.cross(found, true), axis=1), np.einsum("ij,ij->i", found, true))
        squares.append(angle[np.isfinite(angle)] ** 2)
    every = np.concatenate([np.empty(0), *squares])
    if not every.size:
        raise RefractError("no normal was recovered: there is nothing to compare with the truth")
    return float(np.degrees(np.sqrt(np.mean(every))))


def noise_bound(capture: Capture) -> float:
    """The Cramer-Rao bound of `point_rmse`, metres: what the pixel noise leaves, however a model is solved.

    Known and unknown are what `precision` says; the points are those that have two observations or more which are
    no outliers, and planes are shared as the scenario says. Waves count as known: with unknown waves, see
    `bayesian_bound`.

    Raises:
        RefractError: fewer than three such points.
    """
    return capture.options.pixel_noise * precision(configuration_of(capture)).rmse


def configuration_of(capture: Capture) -> Configuration:
    """A capture's truth, for the bounds."""
    model, options = capture.reconstruction, capture.options
    tracks = []
    for _, point in sorted(model.points3D.items()):
        seen = [e.image_id for e in point.track.elements if (e.image_id, e.point2D_idx) not in capture.outliers]
        if len(seen) >= 2:
            tracks.append((point.xyz, seen))
    images = [image for _, image in sorted(model.images.items())]
    poses = np.array([image.cam_from_world().matrix() for image in images])
    camera = np.array([image.camera_id for image in images]) - 1
    sensors = np.array([np.column_stack(sensor) for sensor in sensors_from_rig(options)])
    frame, sensor = np.divmod(np.arange(len(images)), len(sensors))

    housed = options.scenario == "camera_housing"
    if options.scenario == "static_interface":
        plane = np.zeros_like(frame)
    else:
        plane = camera if housed else frame // options.frames_per_interface
    planes = []
    for i in np.unique(plane, return_index=True)[1].tolist():
        in_cam = capture.planes[i + 1]
        planes.append(in_cam if housed else plane_in_world(*in_cam, poses[i, :, :3], poses[i, :, 3]))
    return Configuration(
        scenario=options.scenario,
        layers=options.layers,
        size=options.camera_height,
        point=np.repeat(np.arange(len(tracks)), [len(seen) for _, seen in tracks]),
        image=np.array([image_id - 1 for _, seen in tracks for image_id in seen], dtype=np.int64),
        frame=frame,
        plane=plane,
        camera=camera,
        points=np.array([xyz for xyz, _ in tracks]),
        # The first sensor is the rig's reference.
        rig_from_world=poses[sensor == 0],
        sensor_from_rig=sensors[sensor],
        normal=np.array([normal for normal, _ in planes]),
        offset=np.array([offset for _, offset in planes]),
        cameras=[camera for _, camera in sorted(model.cameras.items())],
    )
