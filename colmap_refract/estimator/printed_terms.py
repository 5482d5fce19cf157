"""The data terms of `E_soft`: images as their blocks change, and one residual block per distance `D_ij`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyceres

from colmap_refract.estimator.back_projection import Jacobians, View, distance_to_ray
from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.optics import project_direction
from colmap_refract.estimator.printed_unknowns import Blocks, Pairing
from colmap_refract.estimator.scenario import Change, State, Structure, evaluate_views
from colmap_refract.interface import Array

_STEP = 1e-5
"""Of the central differences for the pixel weights, over the depth: good to 1e-9 of them."""

_NONE = np.zeros(0)


class ImageViews:
    """The view of one image for the values that Ceres tries, the last one kept."""

    def __init__(self, structure: Structure, state: State, image: int, reference: int) -> None:
        rotation, translation = state.cam_from_world(structure)
        self._reference = rotation[reference], translation[reference]
        block, pose = int(structure.image_plane[image]), int(structure.image_pose[image])
        dry = block < 0
        planes = slice(0, 0) if dry else slice(block, block + 1)
        self._structure = Structure(
            image_pose=np.zeros(1, np.int64),
            image_plane=np.full(1, -1 if dry else 0),
            image_camera=np.zeros(1, np.int64),
            sensor_rotation=structure.sensor_rotation[[image]],
            sensor_translation=structure.sensor_translation[[image]],
            plane_in_world=structure.plane_in_world[planes],
            plane_anchor=structure.plane_anchor[planes],
        )
        self._state = replace(
            state,
            rotation=state.rotation[[pose]],
            translation=state.translation[[pose]],
            normal=state.normal[planes],
            distance=state.distance[planes],
            lens=np.zeros((1, 0)),
        )
        self._last: tuple[bytes, View] | None = None

    def at(self, pose: Array, plane: Array) -> View:
        """The view after a change of its pose (6,) and plane (3,) block; an empty array stands for none."""
        key = pose.tobytes() + b"|" + plane.tobytes()
        last = self._last
        if last is not None and last[0] == key:
            return last[1]
        change = Change.zero(self._state)
        change.pose[: bool(len(pose))] = pose.reshape(-1, 6)
        change.plane[: bool(len(plane))] = plane.reshape(-1, 3)
        views = evaluate_views(self._structure, self._state, change, np.full((1, 4), -1, np.int32))
        rotation = self._reference[0] @ views.rotation[0].T
        view = View(
            rotation=rotation,
            center=self._reference[1] - rotation @ views.translation[0],
            normal=views.normal[0],
            distance=float(views.distance[0]),
            pose_map=views.pose_map[0],
            plane_map=views.plane_map[0],
            in_world=bool(views.in_world[0]),
        )
        self._last = key, view
        return view


class DistanceToRay(pyceres.CostFunction):  # type: ignore[misc]
    """`D_ij` of one observation as Ceres sees it."""

    def __init__(
        self,
        problem: Problem,
        pairing: Pairing,
        row: int,
        blocks: Blocks,
        views: dict[int, ImageViews],
        weight: Array,
        error: list[BaseException],
    ) -> None:
        """`row` counts the pairing's other observations, (2, 2) `weight` is its own; see `Evaluate` for `error`."""
        super().__init__()
        depth = int(pairing.point_of[row])
        k, of_reference = int(pairing.others[row]), int(pairing.of_reference[depth])
        image = int(problem.tracks.image[k])
        pose, plane = int(problem.structure.image_pose[image]), int(problem.structure.image_plane[image])
        reference_plane = int(problem.structure.image_plane[pairing.reference])
        self._wet = bool(problem.tracks.wet[k])
        self._direction, self._reference_direction = problem.tracks.direction[[k, of_reference]]
        self._weight = weight
        self._index = float(problem.state.index)
        self._reference, self._views = views[pairing.reference], views[image]
        self._shared_plane = plane == reference_plane
        self._error = error
        # Of blocks in the order of `Jacobians`, those that are free; an image without one takes an empty array.
        wanted = [
            blocks.depth[depth],
            blocks.normal[of_reference],
            blocks.plane.get(reference_plane),
            blocks.pose.get(pose),
            None if not self._wet or self._shared_plane else blocks.plane.get(plane),
            blocks.normal[k] if self._wet else None,
        ]
        self.blocks = [block for block in wanted if block is not None]
        free = iter(range(len(self.blocks)))
        self._at = [len(self.blocks) if block is None else next(free) for block in wanted]
        self._spare = [np.zeros(2 * width) for width in (1, 3, 3, 6, 3, 3)]
        self.set_num_residuals(2)
        self.set_parameter_block_sizes([len(block) for block in self.blocks])

    def Evaluate(self, parameters: list[Array], residuals: Array, jacobians: list[Array] | None) -> bool:
        # An exception must not travel through Ceres' threads: keep it, fail, and raise it afterwards.
        if self._error:
            return False
        try:
            values = [*parameters, _NONE]
            depth, reference_normal, reference_plane, pose, plane, normal = [values[a] for a in self._at]
            reference = self._reference.at(_NONE, reference_plane)
            view = self._views.at(pose, reference_plane if self._shared_plane else plane)
            out = self._spare
            if jacobians is not None:
                out = [spare if a == len(jacobians) else jacobians[a] for a, spare in zip(self._at, out, strict=True)]
            return bool(
                distance_to_ray(
                    depth, self._reference_direction, reference_normal, reference, self._direction, normal, view,
                    self._wet, self._index, self._weight, residuals, jacobians is not None, self._shared_plane,
                    Jacobians(*out),
                )
            )  # fmt: skip
        except BaseException as exception:
            self._error.append(exception)
            return False


def pixel_weights(problem: Problem, pairing: Pairing, points: Array) -> Array:
    """Pixels per component of `D_ij` at the problem's state.

    Args:
        problem, pairing: m distances of p points.
        points: (p, 3) of the pairing, in the reference camera's frame.

    Returns:
        (m, 2, 2): the projection's Jacobian by the two coordinates across the reference's optical axis.
    """
    tracks, structure, k = problem.tracks, problem.structure, pairing.others
    rotation, translation = problem.state.cam_from_world(structure)
    normal, distance = problem.state.planes_in_cam(structure)
    image, r = tracks.image[k], pairing.reference
    turn = rotation[image] @ rotation[r].T
    in_cam = np.einsum("nij,nj->ni", turn, points[pairing.point_of] - translation[r]) + translation[image]
    layers = problem.layers.with_index(problem.state.index)
    weight = np.empty((len(k), 2, 2))
    step = _STEP * np.linalg.norm(in_cam, axis=1, keepdims=True)
    for j in range(2):
        ahead, behind = (
            project_direction(
                in_cam + sign * step * turn[:, :, j], normal[image], distance[image], layers, tracks.wet[k]
            )
            for sign in (1, -1)
        )
        weight[:, :, j] = np.einsum("nij,nj->ni", tracks.metric[k], (ahead - behind) / (2 * step))
    return weight
