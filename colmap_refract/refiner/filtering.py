"""What does not belong: observations with a large refractive error, points whose refracted rays hardly part.

Also which observations look through the interface at all: that is decided between solves, never inside one,
where a label that flips would put a step into the cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.optics import is_wet, project_direction
from colmap_refract.estimator.surface import local_planes
from colmap_refract.estimator.triangulation import triangulation_angles
from colmap_refract.interface import Array
from colmap_refract.refiner.observations import Observations, pixel_errors


@dataclass(frozen=True, kw_only=True)
class Filtered:
    """Observations that stay, and why the others go.

    Attributes:
        keep: (N,) the observations that stay.
        num_large_error: observations with a reprojection error over the limit.
        num_small_angle: points whose refracted rays meet at too small an angle.
    """

    keep: NDArray[np.bool_]
    num_large_error: int
    num_small_angle: int


def in_cameras(problem: Problem) -> tuple[Array, Array, Array]:
    """Points (N, 3), normals (N, 3) and distances (N,) of all observations in their cameras' frames.

    The planes are those that the observations are refracted by: with waves, each has its own.
    """
    rotation, translation = problem.state.cam_from_world(problem.structure)
    normal, distance = local_planes(problem.tracks, problem.structure, problem.state)
    image = problem.tracks.image
    point = np.repeat(problem.points, np.diff(problem.tracks.start), axis=0)
    return (
        np.einsum("nij,nj->ni", rotation[image], point) + translation[image],
        normal,
        distance,
    )


def label_wet(problem: Problem) -> NDArray[np.bool_]:
    """Which observations (N,) look into the water at the problem's state; none of an image without an interface."""
    points, normals, distances = in_cameras(problem)
    with np.errstate(invalid="ignore"):
        return is_wet(points, normals, distances, problem.layers)


def reprojection_errors(problem: Problem, observations: Observations) -> Array:
    """Exact refractive reprojection errors (N,) in px, through the cameras' own models."""
    return pixel_errors(observations, predicted_directions(problem))


def predicted_directions(problem: Problem) -> Array:
    """Unit directions (N, 3), in the cameras' frames, in which the problem's points are seen."""
    points, normals, distances = in_cameras(problem)
    wet = problem.tracks.wet & np.isfinite(distances)
    normals, distances = np.where(wet[:, None], normals, (0.0, 0.0, 1.0)), np.where(wet, distances, 1.0)
    layers = problem.layers.with_index(problem.state.index)
    return project_direction(points, normals, distances, layers, wet)


def pinhole_errors(observations: Observations) -> Array:
    """Exact reprojection errors (N,) in px of the observations' own points and poses, without refraction."""
    rotation, translation = observations.cam_from_world
    image = observations.image
    points = np.einsum("nij,nj->ni", rotation[image], observations.points[observations.point]) + translation[image]
    return pixel_errors(observations, points / np.linalg.norm(points, axis=1)[:, None])


def filter_observations(
    problem: Problem, observations: Observations, *, max_reproj_error: float, min_tri_angle: float
) -> Filtered:
    """Mark what to remove at the problem's state.

    Args:
        problem, observations: the same N observations of P points.
        max_reproj_error: px; 0 keeps all.
        min_tri_angle: degrees; 0 keeps all.
    """
    counts = np.diff(problem.tracks.start)
    small = np.zeros(len(counts), dtype=np.bool_)
    large = np.zeros(len(problem.tracks.image), dtype=np.bool_)
    if max_reproj_error > 0:
        large = reprojection_errors(problem, observations) > max_reproj_error
    if min_tri_angle > 0:
        angle = triangulation_angles(
            problem.tracks,
            problem.structure,
            problem.state,
            problem.layers.with_index(problem.state.index),
            problem.points,
        )
        small = angle < min_tri_angle
    return Filtered(
        keep=~large & ~np.repeat(small, counts),
        num_large_error=int(large.sum()),
        num_small_angle=int(small.sum()),
    )


def noise(residuals: Array, num_unknowns: float) -> float:
    """Standard deviation, px, of one coordinate of a keypoint, from residuals (N, 2) after a fit; robust."""
    spread = 1.4826 * float(np.median(np.abs(residuals)))
    freedom = max(residuals.size - num_unknowns, 0.05 * residuals.size)
    return spread * float(np.sqrt(residuals.size / freedom))
