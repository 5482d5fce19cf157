"""What keypoints of a given noise can tell of a scene: the Cramer-Rao bound of its points and its interfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers, tangent_basis
from colmap_refract.options import Scenario
from colmap_refract.simulation.least_path import least_path_direction
from colmap_refract.simulation.point_elimination import CorrelatedNoise, Index, eliminate_jointly, eliminate_singly

if TYPE_CHECKING:
    import pycolmap

# Of the finite differences, in radians and in camera heights: truncation and rounding leave about ten digits.
STEP = 1e-5
# The gauge has singular values of about 1e-11, the weakest combination that means something about 1e-6.
SMALLEST_SINGULAR = 1e-9
# Unknown waves hide most of what the pixels tell, but not the errors of the gauge.
SMALLEST_SINGULAR_CORRELATED = 1e-8


@dataclass(frozen=True, kw_only=True)
class Configuration:
    """The truth behind N observations of P points in I images, with F frames and B planes, lengths in metres.

    Attributes:
        scenario: of the capture: whether planes are fixed in the camera, and whether the pose is known.
        layers: media behind the first interface.
        size: a length of the scene, such as the camera's height, that finite differences are relative to.
        point, image: (N,) of each observation.
        frame, plane, camera: (I,) of each image.
        points: (P, 3), world frame; each with two observations or more.
        rig_from_world: (F, 3, 4).
        sensor_from_rig: (I, 3, 4).
        normal: (B, 3) unit, in the camera's frame if in a housing, otherwise in the world's.
        offset: (B,) from the origin of that frame to the plane, along the normal.
        cameras: what `camera` counts.
    """

    scenario: Scenario
    layers: Layers
    size: float
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

    def views(self, change: Array) -> tuple[Array, Array, Array]:
        """Poses (I, 3, 4) and planes in the camera, normals (I, 3) and distances (I,), after a change.

        The change (12,) is one of every point (3), every frame (6) and every plane (3). A rig is turned by a
        rotation vector `w` and shifted, `x_rig -> exp(w) x_rig + v`; a normal is moved along its two tangents,
        and its plane along the normal.
        """
        import pycolmap

        _, w, v, tilt, lift = np.split(change, [3, 6, 9, 11])
        rig = pycolmap.Rotation3d(w).matrix() @ self.rig_from_world
        rig[:, :, 3] += v
        pose = self.sensor_from_rig[:, :, :3] @ rig[self.frame]
        pose[:, :, 3] += self.sensor_from_rig[:, :, 3]

        normal = self.normal + np.stack([tangent_basis(n) for n in self.normal]) @ tilt
        normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True))[self.plane]
        distance = (self.offset + lift)[self.plane]
        if self.scenario != "camera_housing":
            normal = np.einsum("iab,ib->ia", pose[:, :, :3], normal)
            distance = distance + np.einsum("ia,ia->i", normal, pose[:, :, 3])
        return pose, normal, distance

    def pixels(self, change: Array) -> Array:
        """Exact pixels (N, 2) after a change as `views` takes it."""
        pose, normal, distance = self.views(change)
        view = pose[self.image]
        in_cam = np.einsum("nab,nb->na", view[:, :, :3], self.points[self.point] + change[:3]) + view[:, :, 3]
        direction = least_path_direction(in_cam, normal[self.image], distance[self.image], self.layers)
        return self.pixels_of(direction)

    def pixels_of(self, directions: Array) -> Array:
        """Pixels (N, 2) of the observations' directions (N, 3)."""
        pixels = np.empty((len(directions), 2))
        for k, camera in enumerate(self.cameras):
            mine = self.camera[self.image] == k
            pixels[mine] = camera.img_from_cam(directions[mine])
        return pixels

    @property
    def steps(self) -> Array:
        """(12,) of the finite differences."""
        length = STEP * self.size
        return np.array([length] * 3 + [STEP] * 3 + [length] * 3 + [STEP] * 2 + [length])

    def spread_blocks(self, local: Array, row_image: Index) -> Array:
        """Derivatives by a frame's and a plane's nine (..., 9) as those by all frames, then planes (..., C).

        With a fixed camera, whose pose makes the world's frame, there are none by frames.
        """
        row = np.arange(len(local))
        by_frame = np.zeros((len(local), local.shape[1], len(self.rig_from_world), 6))
        by_plane = np.zeros((len(local), local.shape[1], len(self.normal), 3))
        by_frame[row, :, self.frame[row_image]] = local[:, :, :6]
        by_plane[row, :, self.plane[row_image]] = local[:, :, 6:]
        blocks = [by_plane] if self.scenario == "fixed_camera" else [by_frame, by_plane]
        return np.concatenate([block.reshape(*local.shape[:2], -1) for block in blocks], axis=2)


@dataclass(frozen=True, kw_only=True)
class Precision:
    """Bounds for a noise of 1 px in each coordinate of every keypoint, after the points' similarity alignment.

    Attributes:
        covariance: (P, 3, 3) of the points, world frame, m^2.
        normal_std_deg: (I,) of the planes' normals in their cameras, root mean square of the two tangents.
        distance_std: (I,) of the planes' distances, metres.
    """

    covariance: Array
    normal_std_deg: Array
    distance_std: Array

    @property
    def rmse(self) -> float:
        """Root mean square distance of all points to the truth, metres."""
        return float(np.sqrt(np.einsum("pii->", self.covariance) / len(self.covariance)))

    def std_along(self, axes: Array) -> Array:
        """Standard deviation (P,) along unit vectors (P, 3), or one (3,), metres."""
        every = np.broadcast_to(axes, self.covariance.shape[:2])
        return np.asarray(np.sqrt(np.maximum(np.einsum("pi,pij,pj->p", every, self.covariance, every), 0)))


def precision(
    configuration: Configuration, *, noise: CorrelatedNoise | None = None, prior: Array | None = None
) -> Precision:
    """The Cramer-Rao bound, for a noise of 1 px: what the pixel noise leaves, however a model is solved.

    Unknown are the points, a pose per frame (none with a fixed camera, whose one pose makes the world's frame) and
    the planes. Intrinsics, rigs and media are known; no distance is, so that only a rig or a wall says
    anything of the scale. The covariances are taken after the similarity alignment of the points.

    What the pixels say nothing of counts as known: the gauge, which the alignment takes away, but also the
    depth of a point that a fixed camera sees through one and the same interface only.

    Args:
        configuration: the truth.
        noise: of the pixels; independent and of 1 px by default. Correlated, it takes a dense matrix of
            all observations by all points: 16,000 x 1,200 numbers take seconds.
        prior: rows (R, C + E), each a combination of frames, planes (as `Configuration.spread_blocks` lays them
            out) and E further unknowns that is known to a standard deviation of 1.

    Raises:
        RefractError: fewer than three points.
    """
    num_points = len(configuration.points)
    if num_points < 3:
        raise RefractError(f"{num_points} points with two observations; an alignment takes three")
    by_point, by_block = _jacobian(configuration)
    if prior is not None:
        by_block = np.pad(by_block, ((0, 0), (0, 0), (0, prior.shape[1] - by_block.shape[2])))
    directions = _similarity_directions(configuration.points)
    similarity, triangle = np.linalg.qr(directions)
    if noise is None:
        own, beside, follow, reduced = eliminate_singly(configuration.point, by_point, by_block, similarity)
    else:
        own, beside, follow, reduced = eliminate_jointly(configuration.point, by_point, by_block, similarity, noise)
    if prior is not None:
        reduced = np.concatenate([reduced, prior])

    # Radians and metres: with columns of one length a small singular value means the gauge. A column that is
    # nothing but rounding stays out.
    length = np.linalg.norm(reduced, axis=0)
    scale = np.divide(1, length, out=np.zeros_like(length), where=length > SMALLEST_SINGULAR * length.max())
    _, singular, vt = np.linalg.svd(np.linalg.qr(reduced * scale, mode="r"), full_matrices=False)
    smallest = SMALLEST_SINGULAR if noise is None else SMALLEST_SINGULAR_CORRELATED
    kept = singular > smallest * singular.max()
    of_blocks = scale[:, None] * vt[kept].T / singular[kept]
    spread = follow @ of_blocks

    # The covariance is own + spread spread^T; this is its diagonal across the similarities.
    per_point = similarity.reshape(num_points, 3, 7)
    shared = np.einsum("pik,pil->kl", per_point, beside)
    along = similarity.T @ spread
    across = (spread - similarity @ along).reshape(num_points, 3, -1)
    mixed = beside @ per_point.mT
    covariance = own - mixed - mixed.mT + per_point @ shared @ per_point.mT + across @ across.mT

    # The alignment also scales the planes' distances: by minus what the points have grown.
    growth = np.linalg.inv(triangle)[-1]
    by_view, distance = _plane_jacobian(configuration)
    of_views = of_blocks[: by_view.shape[2]]
    of_normal = by_view[:, :3] @ of_views
    of_distance = by_view[:, 3] @ of_views + distance[:, None] * (growth @ along)
    variance = np.sum(of_distance**2, axis=1) + distance**2 * (growth @ shared @ growth)
    return Precision(
        covariance=covariance,
        normal_std_deg=np.degrees(np.sqrt(0.5 * np.sum(of_normal**2, axis=(1, 2)))),
        distance_std=np.sqrt(variance),
    )


def _similarity_directions(points: Array) -> Array:
    """Velocities (3P, 7) of points (P, 3) that shift along, turn about or grow from their mean."""
    arms = points - points.mean(axis=0)
    shifts = np.broadcast_to(np.eye(3)[:, None], (3, *arms.shape))
    turns = [np.cross(axis, arms) for axis in np.eye(3)]
    return np.stack([*shifts, *turns, arms], axis=-1).reshape(-1, 7)


def _jacobian(configuration: Configuration) -> tuple[Array, Array]:
    """Derivatives of the pixels by their own point (N, 2, 3) and by the blocks, frames then planes (N, 2, C)."""
    # A pixel depends on one point, one frame and one plane, so all of a kind can move at once.
    steps = np.diag(configuration.steps)
    central = [(configuration.pixels(step) - configuration.pixels(-step)) / (2 * step.sum()) for step in steps]
    local = np.stack(central, axis=-1)
    return local[:, :, :3], configuration.spread_blocks(local[:, :, 3:], configuration.image)


def _plane_jacobian(configuration: Configuration) -> tuple[Array, Array]:
    """Derivatives of normal and distance in the camera (I, 4, C) by the blocks, and the distances (I,)."""

    def planes(change: Array) -> Array:
        _, normal, distance = configuration.views(change)
        return np.column_stack([normal, distance])

    central = [(planes(step) - planes(-step)) / (2 * step.sum()) for step in np.diag(configuration.steps)[3:]]
    every_image = np.arange(len(configuration.frame))
    return configuration.spread_blocks(np.stack(central, axis=-1), every_image), planes(np.zeros(12))[:, 3]
