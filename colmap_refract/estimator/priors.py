"""What is known before any image is looked at: how high waves run, and that water is level on average.

Both are Gaussian and enter the adjustment as further residual blocks, in px: a deviation of one standard
deviation costs as much as a keypoint that is off by one standard deviation of its noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.elimination import LEVEL, PLANE, POSE, WAVES
from colmap_refract.estimator.rotation import cross_matrix, exp_and_left_jacobian
from colmap_refract.estimator.scenario import State, Structure, turn_normals
from colmap_refract.interface import Array


@dataclass(frozen=True, kw_only=True)
class LevelPlane:
    """The common plane: unit `normal` (3,) in the world, and the distance from `anchor` (3,) to it along the normal."""

    normal: Array
    distance: float
    anchor: Array

    def moved(self, change: Array) -> tuple[LevelPlane, Array]:
        """After a tangential change of the normal (2) and one of the distance; and the normal's derivative (3, 2)."""
        normal, by_change = turn_normals(self.normal[None], change[None, :2])
        plane = LevelPlane(normal=normal[0], distance=self.distance + float(change[2]), anchor=self.anchor)
        return plane, by_change[0]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How a plane block stands in the world, with derivatives by what moves it.

    Attributes:
        normal: (3,) in the world; by_pose: (3, 6), by_plane: (3, 3).
        distance: from the camera; by_pose: (6,), by_plane: (3,).
        center: (3,) of that camera; by_pose: (3, 6).
    """

    normal: Array
    normal_by_pose: Array
    normal_by_plane: Array
    distance: float
    distance_by_pose: Array
    distance_by_plane: Array
    center: Array
    center_by_pose: Array


def first_images(structure: Structure) -> NDArray[np.int64]:
    """(B,) an image of each plane block."""
    return np.array(
        [np.flatnonzero(structure.image_plane == b)[0] for b in range(structure.num_planes)], dtype=np.int64
    )


def plane_stands(structure: Structure, state: State, block: int, image: int, pose: Array, plane: Array) -> Standing:
    """A plane block after changes of its image's pose (6,) and of the plane itself (3,), see `scenario.Change`."""
    f = int(structure.image_pose[image])
    turn, left = exp_and_left_jacobian(pose[None, :3])
    rotation = turn[0] @ state.rotation[f]
    translation = turn[0] @ state.translation[f] + pose[3:]
    sensor, shift = structure.sensor_rotation[image], structure.sensor_translation[image]
    arm = -sensor.T @ shift
    center = rotation.T @ (arm - translation)
    center_by_pose = np.hstack([rotation.T @ cross_matrix((arm - pose[3:])[None])[0] @ left[0], -rotation.T])
    (normal,), (turned,) = turn_normals(state.normal[block][None], plane[None, :2])
    by_change = np.column_stack([turned, np.zeros(3)])
    distance = float(state.distance[block] + plane[2])
    if structure.plane_in_world[block]:
        lever = structure.plane_anchor[block] - center
        return Standing(
            normal=normal, normal_by_pose=np.zeros((3, 6)), normal_by_plane=by_change,
            distance=distance + float(normal @ lever),
            distance_by_pose=-normal @ center_by_pose,
            distance_by_plane=by_change.T @ lever + np.array([0.0, 0.0, 1.0]),
            center=center, center_by_pose=center_by_pose,
        )  # fmt: skip
    in_rig = sensor.T @ normal
    normal_by_pose = np.zeros((3, 6))
    normal_by_pose[:, :3] = rotation.T @ cross_matrix(in_rig[None])[0] @ left[0]
    return Standing(
        normal=rotation.T @ in_rig, normal_by_pose=normal_by_pose, normal_by_plane=rotation.T @ sensor.T @ by_change,
        distance=distance, distance_by_pose=np.zeros(6), distance_by_plane=np.array([0.0, 0.0, 1.0]),
        center=center, center_by_pose=center_by_pose,
    )  # fmt: skip


def compare_to_level(standing: Standing, level: LevelPlane, change: Array) -> tuple[Array, Array, Array, Array]:
    """How a plane's normal differs from the level plane's (3), and the log (1) of their distances' ratio.

    The difference of the normals is as long as the slope between them, in any frame: of its projection on fixed axes a
    solver could rid itself by turning the world, which no keypoint minds.

    Returns:
        `(deviation, by_pose, by_plane, by_level)`, (4,), (4, 6), (4, 3), (4, 3); the last deviation is not a number
        where the camera is behind a plane.
    """
    plane, turned = level.moved(change)
    lever = level.anchor - standing.center
    # A prior on a length would draw the whole model to a smaller size.
    expected = plane.distance + float(plane.normal @ lever)
    ratio = np.log(standing.distance / expected) if min(standing.distance, expected) > 0 else np.nan
    deviation = np.append(standing.normal - plane.normal, ratio)
    distance_by_pose = standing.distance_by_pose / standing.distance + plane.normal @ standing.center_by_pose / expected
    by_pose = np.vstack([standing.normal_by_pose, distance_by_pose])
    by_plane = np.vstack([standing.normal_by_plane, standing.distance_by_plane / standing.distance])
    by_level = np.zeros((4, 3))
    by_level[:3, :2] = -turned
    by_level[3, :2] = -lever @ turned / expected
    by_level[3, 2] = -1.0 / expected
    return deviation, by_pose, by_plane, by_level


def mean_plane(structure: Structure, state: State) -> LevelPlane:
    """The plane that all others scatter about, as it follows from them."""
    images = first_images(structure)
    standing = [
        plane_stands(structure, state, b, int(image), np.zeros(6), np.zeros(3)) for b, image in enumerate(images)
    ]
    normal = np.sum([s.normal for s in standing], axis=0)
    normal /= np.linalg.norm(normal)
    anchor = np.mean([s.center for s in standing], axis=0)
    distance = float(np.median([s.distance + normal @ (s.center - anchor) for s in standing]))
    return LevelPlane(normal=normal, distance=distance, anchor=anchor)


def deviations(structure: Structure, state: State, level: LevelPlane) -> Array:
    """Normal and height (B, 4) of every plane over the level plane, see `compare_to_level`."""
    images = first_images(structure)
    zero = np.zeros(6), np.zeros(3)
    return np.array(
        [
            compare_to_level(plane_stands(structure, state, b, int(image), *zero), level, np.zeros(3))[0]
            for b, image in enumerate(images)
        ]
    )


def all_to_level(
    structure: Structure, state: State, images: NDArray[np.int64], pose: Array, plane: Array, level: LevelPlane,
    change: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """`compare_to_level` of all plane blocks at once.

    Args:
        structure, state: of B blocks.
        images: (B,) one of each block.
        pose: (B, 6) changes of these images' poses; plane: (B, 3) of the planes; change: (3,) of the level plane.

    Returns:
        `(deviation, by_pose, by_plane, by_level)`, (B, 4), (B, 4, 6), (B, 4, 3), (B, 4, 3).
    """
    count, frame = len(images), structure.image_pose[images]
    turn, left = exp_and_left_jacobian(pose[:, :3])
    rotation = turn @ state.rotation[frame]
    back = rotation.transpose(0, 2, 1)
    translation = np.einsum("nij,nj->ni", turn, state.translation[frame]) + pose[:, 3:]
    sensor, shift = structure.sensor_rotation[images], structure.sensor_translation[images]
    arm = -np.einsum("nji,nj->ni", sensor, shift)
    center = np.einsum("nij,nj->ni", back, arm - translation)
    center_by_pose = np.concatenate([back @ cross_matrix(arm - pose[:, 3:]) @ left, -back], axis=2)
    normal, turned = turn_normals(state.normal, plane[:, :2])
    by_change = np.concatenate([turned, np.zeros((count, 3, 1))], axis=2)
    distance = state.distance + plane[:, 2]
    in_world = structure.plane_in_world
    # Planes of the world have a distance from their anchor; others turn with their camera.
    lever = structure.plane_anchor - center
    in_rig = np.einsum("nji,nj->ni", sensor, normal)
    normal_by_pose = np.zeros((count, 3, 6))
    normal_by_pose[:, :, :3] = np.where(in_world[:, None, None], 0.0, back @ cross_matrix(in_rig) @ left)
    normal_by_plane = np.where(in_world[:, None, None], by_change, back @ sensor.transpose(0, 2, 1) @ by_change)
    standing = np.where(in_world[:, None], normal, np.einsum("nij,nj->ni", back, in_rig))
    distance_by_plane = np.where(in_world[:, None], np.einsum("nij,ni->nj", by_change, lever), 0.0)
    distance_by_plane[:, 2] += 1.0
    distance_by_pose = np.where(in_world[:, None], -np.einsum("ni,nij->nj", normal, center_by_pose), 0.0)
    distance = distance + np.where(in_world, np.einsum("ni,ni->n", normal, lever), 0.0)
    common, leaned = level.moved(change)
    reach = level.anchor - center
    expected = common.distance + reach @ common.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(np.minimum(distance, expected) > 0, np.log(distance / expected), np.nan)
    deviation = np.column_stack([standing - common.normal, ratio])
    ratio_by_pose = distance_by_pose / distance[:, None] + common.normal @ center_by_pose / expected[:, None]
    by_pose = np.concatenate([normal_by_pose, ratio_by_pose[:, None]], axis=1)
    by_plane = np.concatenate([normal_by_plane, (distance_by_plane / distance[:, None])[:, None]], axis=1)
    by_level = np.zeros((count, 4, 3))
    by_level[:, :3, :2] = -leaned
    by_level[:, 3, :2] = -reach @ leaned / expected[:, None]
    by_level[:, 3, 2] = -1.0 / expected
    return deviation, by_pose, by_plane, by_level


@dataclass(frozen=True, kw_only=True)
class PriorBlock:
    """One further residual block: the parameter blocks that it looks at, and what it says of their values.

    Attributes:
        keys: (slot, block) of each parameter block.
        num_residuals: M.
        evaluate: the blocks' values to residuals (M,) and a derivative (M, width) by each block, in px.
    """

    keys: list[tuple[int, int]]
    num_residuals: int
    evaluate: Callable[[Sequence[Array]], tuple[Array, list[Array]]]


def images_with_waves(problem: Problem) -> NDArray[np.int64]:
    """Images that have an interface and see points."""
    seen = np.unique(problem.tracks.image)
    return np.asarray(seen[problem.structure.image_plane[seen] >= 0], dtype=np.int64)


def prior_blocks(problem: Problem) -> list[PriorBlock]:
    """The residual blocks that a problem's priors make."""
    blocks: list[PriorBlock] = []
    if problem.wave_prior is not None and not problem.held.waves:
        for image in images_with_waves(problem).tolist():
            blocks.append(_about_waves(image, problem.wave_prior[image], problem.state.waves[image]))
    if problem.level_prior is not None:
        level = mean_plane(problem.structure, problem.state)
        blocks += [
            _about_plane(problem, problem.level_prior.weights, level, b, int(image))
            for b, image in enumerate(first_images(problem.structure))
            if not (problem.held.normals[b] and problem.held.distances[b])
        ]
    return blocks


def _about_waves(image: int, factor: Array, start: Array) -> PriorBlock:
    def evaluate(values: Sequence[Array]) -> tuple[Array, list[Array]]:
        return factor @ (start + values[0]), [factor]

    return PriorBlock(keys=[(WAVES, image)], num_residuals=len(factor), evaluate=evaluate)


def _about_plane(problem: Problem, weights: Array, level: LevelPlane, block: int, image: int) -> PriorBlock:
    structure, state = problem.structure, problem.state
    pose = int(structure.image_pose[image])
    own_pose = not problem.held.poses[pose]

    def evaluate(values: Sequence[Array]) -> tuple[Array, list[Array]]:
        change = values[0] if own_pose else np.zeros(6)
        standing = plane_stands(structure, state, block, image, change, values[-2])
        deviation, *by = compare_to_level(standing, level, values[-1])
        by = [weights[:, None] * each for each in by]
        return weights * deviation, by if own_pose else by[1:]

    keys = [(PLANE, block), (LEVEL, 0)]
    return PriorBlock(keys=[(POSE, pose), *keys] if own_pose else keys, num_residuals=4, evaluate=evaluate)
