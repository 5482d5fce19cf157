"""How near a model's points are to the truth, and how near the pixel noise lets them be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, plane_in_world, tangent_basis
from colmap_refract.simulation.capture import Capture
from colmap_refract.simulation.least_path import least_path_direction
from colmap_refract.simulation.scene import SceneOptions, sensors_from_rig

if TYPE_CHECKING:
    import pycolmap

Index = NDArray[np.int64]

# Of the finite differences, in radians and in camera heights: truncation and rounding leave about ten digits.
STEP = 1e-5
# The gauge has singular values of about 1e-11, the weakest combination that means something about 1e-6.
SMALLEST_SINGULAR = 1e-9


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
    if not robust:
        return float(np.sqrt(np.mean(np.sum((align(source, target, source) - target) ** 2, axis=1))))
    # Runaway points would spoil a first alignment, and they are far from the others.
    error = np.linalg.norm(source - np.median(source, axis=0), axis=1)
    for _ in range(20):
        best = np.argsort(error)[: max(3, int(0.9 * len(error)))]
        error = np.linalg.norm(align(source[best], target[best], source) - target, axis=1)
    return float(np.median(error))


def align(source: Array, target: Array, points: Array) -> Array:
    """`points` moved by the similarity that brings `source` to `target` (Umeyama 1991)."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    u, singular, vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    scale = singular @ sign / np.sum((source - source_mean) ** 2)
    return np.asarray(scale * (points - source_mean) @ (u * sign @ vt).T + target_mean)


def noise_bound(capture: Capture) -> float:
    """The Cramer-Rao bound of `point_rmse`, metres: what the pixel noise leaves, however a model is solved.

    Unknown are the points that have two observations or more which are no outliers, a pose per frame (none
    with a fixed camera, whose one pose makes the world's frame) and the planes, shared as the scenario says.
    Intrinsics, rigs and media are known; no distance is, so that only a rig or a wall says anything of the
    scale. The points' covariance is taken after the similarity alignment.

    What the pixels say nothing of counts as known: the gauge, which the alignment takes away, but also the
    depth of a point that a fixed camera sees through one and the same interface only.

    Raises:
        RefractError: fewer than three such points.
    """
    unknowns = _unknowns(capture)
    point, num_points = unknowns.point, len(unknowns.points)
    if num_points < 3:
        raise RefractError(f"{num_points} points with two observations; an alignment takes three")
    by_point, by_block = _jacobian(unknowns)

    # Each point is eliminated from its own rows, and follows a change of the blocks by -follow.
    normal_matrix = np.zeros((num_points, 3, 3))
    np.add.at(normal_matrix, point, by_point.mT @ by_point)
    own = np.linalg.pinv(normal_matrix, rcond=1e-12, hermitian=True)
    coupling = np.zeros((num_points, 3, by_block.shape[2]))
    np.add.at(coupling, point, by_point.mT @ by_block)
    follow = own @ coupling
    reduced = (by_block - by_point @ follow[point]).reshape(-1, by_block.shape[2])

    # Radians and metres: with columns of one length a small singular value means the gauge. A column that is
    # nothing but rounding stays out.
    length = np.linalg.norm(reduced, axis=0)
    scale = np.divide(1, length, out=np.zeros_like(length), where=length > SMALLEST_SINGULAR * length.max())
    _, singular, vt = np.linalg.svd(np.linalg.qr(reduced * scale, mode="r"), full_matrices=False)
    kept = singular > SMALLEST_SINGULAR * singular.max()
    spread = follow.reshape(3 * num_points, -1) @ (scale[:, None] * vt[kept].T / singular[kept])

    # The covariance is own + spread spread^T; this is its trace across the similarities.
    similarity = np.linalg.qr(_similarity_directions(unknowns.points))[0]
    spread -= similarity @ (similarity.T @ spread)
    per_point = similarity.reshape(num_points, 3, 7)
    within = np.einsum("pii->", own) - np.einsum("pik,pij,pjk->", per_point, own, per_point)
    return capture.options.pixel_noise * float(np.sqrt((within + np.sum(spread**2)) / num_points))


def _similarity_directions(points: Array) -> Array:
    """Velocities (3P, 7) of points (P, 3) that shift along, turn about or grow from their mean."""
    arms = points - points.mean(axis=0)
    shifts = np.broadcast_to(np.eye(3)[:, None], (3, *arms.shape))
    turns = [np.cross(axis, arms) for axis in np.eye(3)]
    return np.stack([*shifts, *turns, arms], axis=-1).reshape(-1, 7)


@dataclass(frozen=True, kw_only=True)
class _Unknowns:
    """The truth behind N observations of P points in I images, with F frames and B planes.

    Attributes:
        point, image: (N,) of each observation.
        frame, plane, camera: (I,) of each image.
        points: (P, 3), world frame.
        rig_from_world: (F, 3, 4).
        sensor_from_rig: (I, 3, 4).
        normal: (B, 3) unit, in the camera's frame if in a housing, otherwise in the world's.
        offset: (B,) from the origin of that frame to the plane, along the normal.
        cameras: what `camera` counts.
    """

    options: SceneOptions
    point: Index
    image: Index
    frame: Index
    plane: Index
    camera: Index
    points: Array
    rig_from_world: Array
    sensor_from_rig: Array
    normal: Array
    offset: Array
    cameras: list[pycolmap.Camera]

    def pixels(self, change: Array) -> Array:
        """Exact pixels (N, 2) after one change (12,) of every point (3), every frame (6) and every plane (3).

        A rig is turned by a rotation vector `w` and shifted, `x_rig -> exp(w) x_rig + v`; a normal is moved
        along its two tangents, and its plane along the normal.
        """
        import pycolmap

        shift, w, v, tilt, lift = np.split(change, [3, 6, 9, 11])
        rig = pycolmap.Rotation3d(w).matrix() @ self.rig_from_world
        rig[:, :, 3] += v
        pose = self.sensor_from_rig[:, :, :3] @ rig[self.frame]
        pose[:, :, 3] += self.sensor_from_rig[:, :, 3]

        normal = self.normal + np.stack([tangent_basis(n) for n in self.normal]) @ tilt
        normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True))[self.plane]
        distance = (self.offset + lift)[self.plane]
        if self.options.scenario != "camera_housing":
            normal = np.einsum("iab,ib->ia", pose[:, :, :3], normal)
            distance = distance + np.einsum("ia,ia->i", normal, pose[:, :, 3])

        view = pose[self.image]
        in_cam = np.einsum("nab,nb->na", view[:, :, :3], self.points[self.point] + shift) + view[:, :, 3]
        direction = least_path_direction(in_cam, normal[self.image], distance[self.image], self.options.layers)
        pixels = np.empty((len(direction), 2))
        for k, camera in enumerate(self.cameras):
            mine = self.camera[self.image] == k
            pixels[mine] = camera.img_from_cam(direction[mine])
        return pixels


def _unknowns(capture: Capture) -> _Unknowns:
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
    return _Unknowns(
        options=options,
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


def _jacobian(unknowns: _Unknowns) -> tuple[Array, Array]:
    """Derivatives of the pixels by their own point (N, 2, 3) and by the blocks, frames then planes (N, 2, C)."""
    length = STEP * unknowns.options.camera_height
    steps = np.array([length] * 3 + [STEP] * 3 + [length] * 3 + [STEP] * 2 + [length])
    # A pixel depends on one point, one frame and one plane, so all of a kind can move at once.
    central = [(unknowns.pixels(step) - unknowns.pixels(-step)) / (2 * step.sum()) for step in np.diag(steps)]
    local = np.stack(central, axis=-1)
    row = np.arange(len(local))
    by_frame = np.zeros((len(local), 2, len(unknowns.rig_from_world), 6))
    by_plane = np.zeros((len(local), 2, len(unknowns.normal), 3))
    by_frame[row, :, unknowns.frame[unknowns.image]] = local[:, :, 3:9]
    by_plane[row, :, unknowns.plane[unknowns.image]] = local[:, :, 9:]
    blocks = [by_plane] if unknowns.options.scenario == "fixed_camera" else [by_frame, by_plane]
    return local[:, :, :3], np.concatenate([block.reshape(*local.shape[:2], -1) for block in blocks], axis=2)
