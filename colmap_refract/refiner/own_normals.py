"""Normals of single observations, as the printed soft constraint finds them, on all observations of a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.soft_as_printed import PrintedAdjustment
from colmap_refract.interface import Array, tangent_basis
from colmap_refract.refiner.continuation import retriangulate


def everywhere(begin: Problem, printed: PrintedAdjustment, keypoints: Array, radius: float) -> tuple[Problem, Problem]:
    """All observations at the solution, with each image's mean plane, and with normals of their own."""
    tracks, structure = begin.tracks, begin.structure
    normal, distance = printed.state.planes_in_cam(structure)
    image = tracks.image
    known = np.isfinite(printed.normals[:, 0])
    own = np.where(known[:, None], printed.normals, normal[image])
    for i in np.unique(image[known]).tolist():
        here, wanting = np.flatnonzero(known & (image == i)), np.flatnonzero(~known & tracks.wet & (image == i))
        tree = cKDTree(keypoints[here])
        nearest = tree.query(keypoints[wanting])[1]
        for k, near, first in zip(
            wanting.tolist(), tree.query_ball_point(keypoints[wanting], radius), nearest.tolist(), strict=True
        ):
            own[k] = own[here[near or [first]]].mean(axis=0)
    # One coefficient, of value 1, whose shape on the surface is each keypoint's own slope, without any height.
    axes = np.zeros((structure.num_images, 3, 2))
    refracted = structure.image_plane >= 0
    axes[refracted] = [tangent_basis(n) for n in normal[refracted]]
    slopes = np.einsum("nia,ni->na", axes[image], own) / np.einsum("ni,ni->n", own, normal[image])[:, None]
    waves = np.zeros((len(image), 3, 1))
    waves[:, 1:, 0] = np.where(refracted[image][:, None], slopes, 0.0)
    points = np.where(np.isfinite(printed.points), printed.points, begin.points)
    at = replace(begin, state=printed.state, points=points, held=replace(begin.held, waves=True))
    wavy = replace(
        at,
        tracks=tracks._replace(waves=waves, sight=tracks.direction.copy()),
        structure=replace(structure, wave_axes=axes),
        state=replace(at.state, waves=np.ones((structure.num_images, 1))),
    )
    return _with_mean_planes(at, own, known), replace(wavy, points=retriangulate(wavy).points)


def _with_mean_planes(problem: Problem, own: Array, known: Array) -> Problem:
    """Planes of the mean of the normals `own` (N, 3) that are `known`, through the mean of where the rays meet them."""
    structure, state, image = problem.structure, problem.state, problem.tracks.image
    rotation, translation = state.cam_from_world(structure)
    cam_normal, cam_distance = state.planes_in_cam(structure)
    with np.errstate(invalid="ignore"):
        ray = problem.tracks.direction
        reach = cam_distance[image] / np.einsum("ni,ni->n", ray, cam_normal[image])
    place = reach[:, None] * ray
    normal, distance = state.normal.copy(), state.distance.copy()
    for block in range(structure.num_planes):
        mine = np.flatnonzero(known & (structure.image_plane[image] == block))
        if not len(mine):
            continue
        normals, places, anchor = own[mine], place[mine], np.zeros(3)
        if structure.plane_in_world[block]:
            turn = rotation[image[mine]]
            normals = np.einsum("nji,nj->ni", turn, normals)
            places = np.einsum("nji,nj->ni", turn, places - translation[image[mine]])
            anchor = structure.plane_anchor[block]
        mean = normals.mean(axis=0)
        normal[block] = mean / np.linalg.norm(mean)
        distance[block] = normal[block] @ (places.mean(axis=0) - anchor)
    return replace(problem, state=replace(state, normal=normal, distance=distance))


def slope_deviation(wavy: Problem, known: Array) -> float:
    """Root mean square slope of the recovered normals about the mean of their image's, degrees."""
    slopes, image = wavy.tracks.waves[known, 1:, 0], wavy.tracks.image[known]
    squares = [((slopes[image == i] - slopes[image == i].mean(axis=0)) ** 2).sum(axis=1) for i in np.unique(image)]
    return float(np.degrees(np.arctan(np.sqrt(np.concatenate(squares).mean()))))
