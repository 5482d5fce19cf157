"""Scenarios as tyings: which images share a pose and a plane, and how an image's own parameters follow.

The kernel differentiates with respect to the nine parameters of an image (pose 6, plane 3). A scenario is
the choice of the *blocks* they come from: a pose block per frame of a rig, a plane block per image, group,
camera or world. `Structure` says who shares what, `State` holds the values, and `evaluate_views` turns a
change of the blocks into what the kernel needs, with its derivative.

| scenario           | a pose per | a plane per                | the plane is fixed in |
|--------------------|------------|----------------------------|-----------------------|
| `moving_interface` | frame      | frame, or group of images  | the camera, the world where images share it |
| `static_interface` | frame      | world, or group of images  | the world             |
| `fixed_camera`     | rig        | frame, or group of images  | the camera, the world where images share it |
| `camera_housing`   | frame      | camera, or group of images | the camera            |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator.elimination import Views
from colmap_refract.estimator.rotation import cross_matrix, exp_and_left_jacobian
from colmap_refract.interface import Array
from colmap_refract.options import Scenario

SCENARIOS: tuple[Scenario, ...] = get_args(Scenario)

Index = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Who shares what: I images, F pose blocks, B plane blocks, C cameras.

    Attributes:
        image_pose: (I,) pose block of each image.
        image_plane: (I,) plane block, -1 for an image without an interface.
        image_camera: (I,) index of the camera.
        sensor_rotation, sensor_translation: (I, 3, 3), (I, 3) `sensor_from_rig`, which is known.
        plane_in_world: (B,) whether a plane is fixed in the world or in the camera.
        plane_anchor: (B, 3) the world point that a world plane's distance is measured from (an origin far
            from the cameras would make that unknown badly scaled); unused for planes in the camera.
        wave_axes: (I, 3, 2) directions along each image's plane, camera frame, that the slopes of its waves are
            counted along. They stay as they are while the plane moves a little. Unused without waves.
    """

    image_pose: Index
    image_plane: Index
    image_camera: Index
    sensor_rotation: Array
    sensor_translation: Array
    plane_in_world: NDArray[np.bool_]
    plane_anchor: Array
    wave_axes: Array = field(default_factory=lambda: np.zeros((0, 3, 2)))

    @property
    def num_images(self) -> int:
        return len(self.image_pose)

    @property
    def num_poses(self) -> int:
        return int(self.image_pose.max()) + 1

    @property
    def num_planes(self) -> int:
        return len(self.plane_in_world)


@dataclass(frozen=True, kw_only=True)
class State:
    """Values of all unknowns on the camera side; lengths in units of the solve.

    Attributes:
        rotation, translation: (F, 3, 3), (F, 3) `rig_from_world` of each pose block.
        normal: (B, 3) unit, in the camera's frame or the world's, see `Structure.plane_in_world`.
        distance: (B,) from the projection centre, or from the plane's anchor, along the normal.
        index: refractive index of the medium the scene is in.
        lens: (C, Q) change of the refined intrinsics since the keypoints were lifted.
        waves: (I, K) coefficients of the waves on each image's surface; K = 0, whatever I, where all are flat.
    """

    rotation: Array
    translation: Array
    normal: Array
    distance: Array
    index: float
    lens: Array
    waves: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def cam_from_world(self, structure: Structure) -> tuple[Array, Array]:
        """`(rotation, translation)` of every image, (I, 3, 3) and (I, 3)."""
        sensor = structure.sensor_rotation
        rotation = sensor @ self.rotation[structure.image_pose]
        translation = np.einsum("nij,nj->ni", sensor, self.translation[structure.image_pose])
        return rotation, translation + structure.sensor_translation

    def planes_in_cam(self, structure: Structure) -> tuple[Array, Array]:
        """`(normal_in_cam, distance)` of every image, (I, 3) and (I,); NaN where there is no interface."""
        rotation, translation = self.cam_from_world(structure)
        dry = structure.image_plane < 0
        normal = np.full((structure.num_images, 3), np.nan)
        distance = np.full(structure.num_images, np.nan)
        if structure.num_planes:
            block = np.where(dry, 0, structure.image_plane)
            in_world = structure.plane_in_world[block]
            turned = np.einsum("nij,nj->ni", rotation, self.normal[block])
            offset = self.distance + np.einsum("ni,ni->n", self.normal, structure.plane_anchor)
            normal = np.where(in_world[:, None], turned, self.normal[block])
            distance = np.where(
                in_world, offset[block] + np.einsum("ni,ni->n", turned, translation), self.distance[block]
            )
            normal[dry], distance[dry] = np.nan, np.nan
        return normal, distance


@dataclass(frozen=True, kw_only=True)
class Change:
    """A change of the blocks, the vector that an adjustment works on.

    Attributes:
        pose: (F, 6) rotation vector `w` and shift `v`: `x_rig = exp(w) (R x + t) + v`, so that the rotation
            is about the projection centre.
        plane: (B, 3) tangential change of the normal (2) and change of the distance.
        index: change of the refractive index.
        lens: (C, Q) change of the refined intrinsics.
        waves: (I, K) change of the wave coefficients.
    """

    pose: Array
    plane: Array
    index: float
    lens: Array
    waves: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @staticmethod
    def zero(state: State) -> Change:
        return Change(
            pose=np.zeros((len(state.rotation), 6)),
            plane=np.zeros((len(state.normal), 3)),
            index=0.0,
            lens=np.zeros_like(state.lens),
            waves=np.zeros_like(state.waves),
        )


def tangent_bases(normals: Array) -> Array:
    """`tangent_basis` of each of (B, 3) normals, (B, 3, 2)."""
    axis = np.where(np.abs(normals[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    first = axis - np.einsum("bi,bi->b", axis, normals)[:, None] * normals
    first /= np.linalg.norm(first, axis=1)[:, None]
    x, y, z = normals.T
    a, b, c = first.T
    return np.stack([first, np.column_stack([y * c - z * b, z * a - x * c, x * b - y * a])], axis=2)


def turn_normals(normals: Array, tangential: Array) -> tuple[Array, Array]:
    """Unit normals (B, 3) after tangential changes (B, 2), and their derivative by them (B, 3, 2)."""
    if not len(normals):
        return normals, np.zeros((0, 3, 2))
    basis = tangent_bases(normals)
    moved = normals + np.einsum("bij,bj->bi", basis, tangential)
    norm = np.linalg.norm(moved, axis=1)
    normal = moved / norm[:, None]
    along = np.einsum("bi,bij->bj", normal, basis)
    return normal, (basis - normal[:, :, None] * along[:, None, :]) / norm[:, None, None]


def apply(state: State, change: Change) -> State:
    """The state after a change."""
    turn, _ = exp_and_left_jacobian(change.pose[:, :3])
    return replace(
        state,
        rotation=turn @ state.rotation,
        translation=np.einsum("fij,fj->fi", turn, state.translation) + change.pose[:, 3:],
        normal=turn_normals(state.normal, change.plane[:, :2])[0],
        distance=state.distance + change.plane[:, 2],
        index=state.index + change.index,
        lens=state.lens + change.lens,
        waves=state.waves + change.waves,
    )


def evaluate_views(structure: Structure, state: State, change: Change, columns: NDArray[np.int32]) -> Views:
    """The images after a change of the blocks, and the derivative of their own parameters by it.

    Args:
        structure, state: the tying and the values that `change` starts from.
        change: of the blocks.
        columns: (I, 5) passed on to the kernel.

    Returns:
        `Views` in the layout of `elimination`.
    """
    moved = apply(state, change)
    rotation, translation = moved.cam_from_world(structure)
    normal, distance = moved.planes_in_cam(structure)
    pose = structure.image_pose
    sensor = structure.sensor_rotation
    _, left = exp_and_left_jacobian(change.pose[:, :3])
    turn = sensor @ left[pose]
    pose_map = np.zeros((structure.num_images, 6, 6))
    pose_map[:, :3, :3] = turn
    pose_map[:, 3:, :3] = (
        sensor @ cross_matrix(change.pose[:, 3:])[pose] @ left[pose] + cross_matrix(structure.sensor_translation) @ turn
    )
    pose_map[:, 3:, 3:] = sensor
    plane_map = np.zeros((structure.num_images, 4, 3))
    in_world = np.zeros(structure.num_images, dtype=np.bool_)
    if structure.num_planes:
        block = np.maximum(structure.image_plane, 0)
        in_world = structure.plane_in_world[block]
        by_change = turn_normals(state.normal, change.plane[:, :2])[1][block]
        plane_map[:, :3, :2] = np.where(in_world[:, None, None], rotation @ by_change, by_change)
        center = -np.einsum("nji,nj->ni", rotation, translation)
        lever = np.einsum("ni,nij->nj", structure.plane_anchor[block] - center, by_change)
        plane_map[:, 3, :2] = np.where(in_world[:, None], lever, 0.0)
        plane_map[:, 3, 2] = 1.0
    dry = structure.image_plane < 0
    normal[dry], distance[dry] = (0.0, 0.0, 1.0), 1.0
    return Views(
        rotation=np.ascontiguousarray(rotation),
        translation=translation,
        normal=normal,
        distance=distance,
        in_world=in_world & ~dry,
        pose_map=pose_map,
        plane_map=plane_map,
        lens_change=np.ascontiguousarray(moved.lens[structure.image_camera]),
        waves=moved.waves,
        axes=structure.wave_axes,
        columns=columns,
    )


def share_planes(
    scenario: Scenario, frame: Sequence[int], camera: Sequence[int], group: Sequence[str | None], dry: Sequence[bool]
) -> tuple[Index, NDArray[np.bool_], list[str | None]]:
    """Which images share a plane.

    Args:
        scenario: see the module's table.
        frame: (I,) frame of each image; images of one frame are taken at one instant.
        camera: (I,) camera of each image.
        group: (I,) name of the group of images that are known to share an interface, or None.
        dry: (I,) whether an image has no interface at all.

    Returns:
        `(image_plane, plane_in_world, names)`: block of each image (-1 if dry), whether each block is fixed
        in the world, and the name of the group of each block (None for an unnamed one).
    """
    keys: dict[object, list[int]] = {}
    for i in range(len(frame)):
        if dry[i]:
            continue
        if group[i] is not None:
            key: object = ("group", group[i])
        elif scenario == "static_interface":
            key = "world"
        elif scenario == "camera_housing":
            key = ("camera", camera[i])
        else:
            key = ("frame", frame[i])
        keys.setdefault(key, []).append(i)
    image_plane = np.full(len(frame), -1, dtype=np.int64)
    in_world = np.zeros(len(keys), dtype=np.bool_)
    names: list[str | None] = []
    for block, (key, images) in enumerate(keys.items()):
        image_plane[images] = block
        in_world[block] = scenario == "static_interface" or (scenario != "camera_housing" and len(images) > 1)
        names.append(str(key[1]) if isinstance(key, tuple) and key[0] == "group" else None)
    return image_plane, in_world, names
