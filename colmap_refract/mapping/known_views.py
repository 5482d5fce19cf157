"""Images whose poses and interfaces are known: where refracted rays meet, and how far off a point they pass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from colmap_refract.estimator.adjustment import SolverSettings, settle_points
from colmap_refract.estimator.chunk import Held, Problem
from colmap_refract.estimator.elimination import Tracks
from colmap_refract.estimator.scenario import Index, State, Structure
from colmap_refract.estimator.triangulation import refracted_rays, triangulate, triangulation_angles
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.interface import Array, Layers
from colmap_refract.refiner.filtering import label_wet, reprojection_errors
from colmap_refract.refiner.observations import Observations

_LOSS_SCALE = 1.0
"""Pixels, of the Cauchy loss that new points are settled with."""


class Views:
    """The K keypoints of all images, with poses and interfaces that are known and held.

    Args:
        keypoints: observations of one pseudo-point: every keypoint that takes part, in the model's units.
        earlier: the interfaces, of the same model.
        unit: model units per unit of the points here; about their depth, which the points' solver expects to be one.
        wavy: whether a keypoint is refracted by the tangent plane of its image's surface, where there is one and its
            ray meets it. Else by the image's plane.
    """

    def __init__(self, keypoints: Observations, earlier: Sidecar, unit: float, *, wavy: bool = False) -> None:
        count = len(keypoints.image_ids)
        rotation, translation = keypoints.cam_from_world
        normal, distance = np.tile([0.0, 0.0, 1.0], (count, 1)), np.ones(count)
        plane = np.full(count, -1)
        for i, name in enumerate(keypoints.image_names):
            image = earlier.images.get(name)
            if image is not None and image.normal_in_cam is not None and image.distance is not None:
                normal[i], distance[i], plane[i] = image.normal_in_cam, image.distance / unit, i
        axes, self._relief = np.zeros((count, 3, 2)), np.zeros((0, 3))
        if wavy and any(image.surface is not None for image in earlier.images.values()):
            axes, self._relief = _relief(keypoints, earlier)
        self.keypoints = keypoints
        self.structure = Structure(
            image_pose=np.arange(count),
            image_plane=plane,
            image_camera=keypoints.image_camera,
            sensor_rotation=np.tile(np.eye(3), (count, 1, 1)),
            sensor_translation=np.zeros((count, 3)),
            plane_in_world=np.zeros(count, dtype=np.bool_),
            plane_anchor=np.zeros((count, 3)),
            wave_axes=axes,
        )
        self.state = State(
            rotation=rotation,
            translation=translation / unit,
            normal=normal,
            distance=distance,
            index=earlier.layers.refractive_index,
            lens=np.zeros((len(keypoints.cameras), 0)),
        )
        self.layers: Layers = earlier.layers.scaled(1.0 / unit)
        self.settings = SolverSettings()

    @property
    def image(self) -> Index:
        """(K,) index of each keypoint's image."""
        return self.keypoints.image

    def problem(self, start: Index, keypoint: Index, points: Array) -> Problem:
        """Points whose tracks are runs of `keypoint` between entries of `start`; all seen through the water."""
        chosen, relief = self.keypoints, self._relief
        image = chosen.image[keypoint]
        return Problem(
            tracks=Tracks(
                start=start,
                image=image.astype(np.int32),
                direction=chosen.direction[keypoint],
                metric=chosen.metric[keypoint],
                lens=np.zeros((len(keypoint), 2, 0)),
                wet=self.structure.image_plane[image] >= 0,
                sight=chosen.direction[keypoint] if len(relief) else np.zeros((0, 3)),
                relief=relief[keypoint] if len(relief) else relief,
            ),
            structure=self.structure,
            layers=self.layers,
            state=self.state,
            points=points,
            held=Held.nothing(self.state),
            loss="cauchy",
            loss_scale=_LOSS_SCALE,
        )

    def errors(self, problem: Problem, keypoint: Index) -> Array:
        """Exact reprojection errors (N,), px; infinite where a point is not seen."""
        chosen = replace(
            self.keypoints,
            start=problem.tracks.start,
            image=self.keypoints.image[keypoint],
            pixel=self.keypoints.pixel[keypoint],
            direction=self.keypoints.direction[keypoint],
        )
        problem = _on_the_right_side(problem)
        errors = reprojection_errors(problem, chosen)
        return np.where(np.isfinite(errors), errors, np.inf)

    def triangulated(self, start: Index, keypoint: Index, *, settle: bool) -> tuple[Array, Array]:
        """Where the rays of each run meet (P, 3), and the reprojection errors (N,) there.

        Points that come out before the interface are triangulated once more with straight rays.
        """
        problem = self.problem(start, keypoint, np.zeros((len(start) - 1, 3)))
        origin, ray = refracted_rays(problem.tracks, self.structure, self.state, self.layers)
        # Where rays are parallel: somewhere on the first.
        fallback = np.nan_to_num((origin + ray)[start[:-1]])
        points = triangulate(problem.tracks, self.structure, self.state, self.layers, fallback)
        problem = replace(problem, points=points)
        side = _on_the_right_side(problem)
        point = np.repeat(np.arange(len(start) - 1), np.diff(start))
        dry = np.isin(point, point[side.tracks.wet != problem.tracks.wet])
        if dry.any():
            straight = replace(problem, tracks=problem.tracks._replace(wet=problem.tracks.wet & ~dry))
            again = triangulate(straight.tracks, self.structure, self.state, self.layers, problem.points)
            of_dry = np.zeros(len(points), dtype=np.bool_)
            of_dry[point[dry]] = True
            problem = replace(straight, points=np.where(of_dry[:, None], again, problem.points))
        if settle:
            problem = replace(problem, points=settle_points(problem, self.settings))
        return problem.points, self.errors(problem, keypoint)

    def angles(self, start: Index, keypoint: Index, points: Array) -> Array:
        """Largest angle (P,), degrees, between the rays of each point."""
        problem = _on_the_right_side(self.problem(start, keypoint, points))
        return triangulation_angles(problem.tracks, self.structure, self.state, self.layers, points)


def _relief(keypoints: Observations, earlier: Sidecar) -> tuple[Array, Array]:
    """Axes (I, 3, 2) of the images' surfaces, and `Tracks.relief` (K, 3) where the keypoints' rays meet them."""
    axes, relief = np.zeros((len(keypoints.image_ids), 3, 2)), np.zeros((len(keypoints.image), 3))
    for i, name in enumerate(keypoints.image_names):
        image = earlier.images.get(name)
        if image is None or image.surface is None or image.normal_in_cam is None or image.distance is None:
            continue
        mine = np.flatnonzero(keypoints.image == i)
        ray, normal = keypoints.direction[mine], np.array(image.normal_in_cam)
        local, distance = image.surface.local_planes(ray, normal, image.distance)
        axes[i] = image.surface.axes
        along = np.einsum("ni,ni->n", local, ray)
        height = distance / along * (ray @ normal) / image.distance - 1.0
        found = np.column_stack([height, local @ axes[i] / (local @ normal)[:, None]])
        relief[mine] = np.where(np.isfinite(found).all(axis=1)[:, None], found, 0.0)
    return axes, relief


def _on_the_right_side(problem: Problem) -> Problem:
    return replace(problem, tracks=problem.tracks._replace(wet=label_wet(problem)))
