"""Points from refracted rays: the closed-form start that no earlier, bent position can lead astray."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from colmap_refract.estimator.elimination import Tracks
from colmap_refract.estimator.optics import FAST, back_project
from colmap_refract.estimator.scenario import State, Structure
from colmap_refract.estimator.surface import local_planes
from colmap_refract.interface import Array, Layers

_ROUNDS = 6
_MIN_DETERMINANT = 1e-9
_LEAST_SCALE = 1e-3
_COST_SCALE = 4.0
"""Pixels: the scale of the Cauchy cost that judges the outcomes."""


def refracted_rays(tracks: Tracks, structure: Structure, state: State, layers: Layers) -> tuple[Array, Array]:
    """The rays of all observations in the medium the scene is in.

    Returns:
        `(origin, direction)`, (N, 3) each, in the world; NaN for a ray that misses its interface. An
        image without an interface, and an observation marked dry, has its ray start at the camera.
    """
    rotation, translation = state.cam_from_world(structure)
    normal, distance = local_planes(tracks, structure, state)
    image = tracks.image
    wet = tracks.wet & (structure.image_plane[image] >= 0)
    origin, ray = np.zeros_like(tracks.direction), tracks.direction.copy()
    origin[wet], ray[wet] = back_project(tracks.direction[wet], normal[wet], distance[wet], layers)
    origin = np.einsum("nji,nj->ni", rotation[image], origin - translation[image])
    return origin, np.einsum("nji,nj->ni", rotation[image], ray)


def triangulate(tracks: Tracks, structure: Structure, state: State, layers: Layers, fallback: Array) -> Array:
    """Points nearest to their refracted rays, reweighted so that a wrong ray loses its say.

    Args:
        tracks, structure, state, layers: of the problem.
        fallback: (P, 3) for points whose rays are parallel or miss the interface.

    Returns:
        (P, 3) in the world.
    """
    origin, ray = refracted_rays(tracks, structure, state, layers)
    focal = np.linalg.norm(tracks.metric, axis=(1, 2)) / np.sqrt(2.0)
    return nearest_to_rays(tracks.start, origin, ray, focal, fallback)


def nearest_to_rays(start: NDArray[np.int64], origin: Array, ray: Array, focal: Array, fallback: Array) -> Array:
    """Points (P, 3) nearest to their rays, robustly.

    Args:
        start: (P + 1,) first ray of each point.
        origin, ray: (N, 3) in the world, the second unit; NaN for a ray that is not there.
        focal: (N,) pixels per radian.
        fallback: (P, 3) for points whose rays are parallel.
    """
    points = fallback.copy()
    _nearest_to_rays(start, origin, ray, focal, points)
    return points


@njit(cache=True, nogil=True, error_model="numpy")
def _ray_errors(point, first, n, origin, ray, focal, error, reach):
    """Distances of a point from n rays in pixels (over the range, times the focal length), and the ranges."""
    for k in range(n):
        r0, r1, r2 = ray[first + k]
        d0, d1, d2 = point[0] - origin[first + k, 0], point[1] - origin[first + k, 1], point[2] - origin[first + k, 2]
        along = r0 * d0 + r1 * d1 + r2 * d2
        reach[k] = max(along, 1e-3)
        error[k] = focal[first + k] * math.sqrt(max(d0 * d0 + d1 * d1 + d2 * d2 - along * along, 0.0)) / reach[k]
        if not math.isfinite(error[k]):
            error[k] = np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(n, error, reach, weight):
    """Cauchy weights at the track's own median error; a nearer camera counts for more. The summed robust cost."""
    scale = max(np.median(error[:n]), _LEAST_SCALE)
    cost = 0.0
    for k in range(n):
        weight[k] = 0.0
        cost += math.log1p(min(error[k], 1e9) ** 2 / _COST_SCALE**2)
        if math.isfinite(error[k]):
            weight[k] = 1.0 / ((1.0 + (error[k] / scale) ** 2) * reach[k] * reach[k])
    return cost


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(first, n, origin, ray, weight, point):
    """The point with the least weighted sum of squared distances from n rays; False where they are parallel."""
    a00, a01, a02, a11, a12, a22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    b0, b1, b2 = 0.0, 0.0, 0.0
    for k in range(n):
        w = weight[k]
        if w == 0.0:
            continue
        r0, r1, r2 = ray[first + k]
        o0, o1, o2 = origin[first + k]
        along = r0 * o0 + r1 * o1 + r2 * o2
        a00 += w * (1.0 - r0 * r0)
        a01 -= w * r0 * r1
        a02 -= w * r0 * r2
        a11 += w * (1.0 - r1 * r1)
        a12 -= w * r1 * r2
        a22 += w * (1.0 - r2 * r2)
        b0 += w * (o0 - along * r0)
        b1 += w * (o1 - along * r1)
        b2 += w * (o2 - along * r2)
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    determinant = a00 * c00 + a01 * c01 + a02 * c02
    trace = a00 + a11 + a22
    if not determinant > _MIN_DETERMINANT * trace * trace * trace:
        return False
    c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
    point[0] = (c00 * b0 + c01 * b1 + c02 * b2) / determinant
    point[1] = (c01 * b0 + c11 * b1 + c12 * b2) / determinant
    point[2] = (c02 * b0 + c12 * b1 + c22 * b2) / determinant
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest_to_rays(start, origin, ray, focal, points):
    longest = 1
    for p in range(points.shape[0]):
        longest = max(longest, start[p + 1] - start[p])
    weight, error, reach = np.empty(longest), np.empty(longest), np.empty(longest)
    point, best = np.empty(3), np.empty(3)
    for p in range(points.shape[0]):
        first = start[p]
        n = start[p + 1] - first
        best[:] = points[p]
        least = np.inf
        # From all rays alike, and from those that agree with the point as it is: the one survives a wrong
        # point, the other wrong rays.
        for known in range(2):
            _ray_errors(points[p], first, n, origin, ray, focal, error, reach)
            _weigh(n, error, reach, weight)
            if known == 0:
                for k in range(n):
                    weight[k] = 1.0 if math.isfinite(error[k]) else 0.0
            for _ in range(_ROUNDS):
                if not _nearest(first, n, origin, ray, weight, point):
                    break
                _ray_errors(point, first, n, origin, ray, focal, error, reach)
                cost = _weigh(n, error, reach, weight)
                if cost < least:
                    least = cost
                    best[:] = point
        points[p] = best


def triangulation_angles(tracks: Tracks, structure: Structure, state: State, layers: Layers, points: Array) -> Array:
    """Largest angle (P,), degrees, between any two refracted rays of each point.

    A ray runs from where it leaves the interface to the point itself, so that the noise of the keypoints
    does not widen the angle.
    """
    origin, _ = refracted_rays(tracks, structure, state, layers)
    return largest_angles(tracks.start, origin, points)


def largest_angles(start: NDArray[np.int64], origin: Array, points: Array) -> Array:
    """Largest angle (P,), degrees, between any two lines from origins (N, 3) to their point (P, 3).

    Args:
        start: (P + 1,) first origin of each point.
        origin: NaN for a line that is not there.
        points: of the origins.
    """
    angles = np.empty(len(points))
    _largest_angles(start, origin, points, angles)
    return np.degrees(angles)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _largest_angles(start: NDArray[np.int64], origin: Array, points: Array, angles: Array) -> None:
    longest = 1
    for p in range(points.shape[0]):
        longest = max(longest, start[p + 1] - start[p])
    ray = np.empty((longest, 3))
    for p in range(points.shape[0]):
        n = 0
        for k in range(start[p], start[p + 1]):
            d0, d1, d2 = points[p, 0] - origin[k, 0], points[p, 1] - origin[k, 1], points[p, 2] - origin[k, 2]
            norm = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            if math.isfinite(norm) and norm > 0.0:
                ray[n, 0], ray[n, 1], ray[n, 2] = d0 / norm, d1 / norm, d2 / norm
                n += 1
        longest_chord = 0.0
        for i in range(n):
            for j in range(i):
                d0, d1, d2 = ray[i, 0] - ray[j, 0], ray[i, 1] - ray[j, 1], ray[i, 2] - ray[j, 2]
                longest_chord = max(longest_chord, d0 * d0 + d1 * d1 + d2 * d2)
        # From the chord, which keeps its digits for small angles.
        angles[p] = 2.0 * math.asin(min(0.5 * math.sqrt(longest_chord), 1.0))
