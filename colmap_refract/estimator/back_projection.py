"""The soft constraint's data term: `BP` through a surface that waves, the distance `D_ij`, and its derivatives.

Everything is expressed in the frame of the reference camera, the paper's world. With `u` the unit direction of
a keypoint, `c = u . n`, the plane's unit normal `n` and distance `d`, and the surface's own normal `m`:

    IP = d / c u                            where the line of sight meets the plane
    RV = u / mu + b m                       the refracted unit direction, Snell with the surface's normal
    b  = sqrt(1 - (1 - a^2) / mu^2) - a / mu,   a = u . m
    BP = IP + depth * RV

The paper's `P_j` is `BP` of the reference's observation; `P_ij` is the point of another observation's ray, brought
into the same frame, at the same depth along the reference camera's optical axis: `D_ij = P_j - P_ij` has no third
component.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from colmap_refract.estimator.optics import FAST
from colmap_refract.interface import Array

_LEAST_SLOPE = 1e-9
"""Of a ray towards the depth axis: one across it has no point at the depth."""


class View(NamedTuple):
    """An image in the frame of the reference camera, and how it depends on the image's blocks.

    Attributes:
        rotation, center: (3, 3), (3,) with `x_reference = rotation @ x_cam + center`.
        normal: (3,) `normal_in_cam`, distance: scalar.
        pose_map: (6, 6), plane_map: (4, 3), in_world: as in `elimination.Views`.
    """

    rotation: Array
    center: Array
    normal: Array
    distance: float
    pose_map: Array
    plane_map: Array
    in_world: bool


class Jacobians(NamedTuple):
    """Where derivatives of the two residuals go: flat arrays, row by row.

    By the depth (2 x 1), the reference's surface normal (2 x 3) and plane block (2 x 3), and the observation's
    pose block (2 x 6), plane block (2 x 3) and surface normal (2 x 3).
    """

    depth: Array
    reference_normal: Array
    reference_plane: Array
    pose: Array
    plane: Array
    normal: Array


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _bend(direction, normal, index):
    """`b` of the module's docstring and its derivative by `a`; NaN where no ray is refracted."""
    a = _dot(direction, normal)
    squared = 1.0 - (1.0 - a * a) / (index * index)
    if not (a > 0.0 and squared > 0.0):
        return np.nan, 0.0
    root = math.sqrt(squared)
    return root - a / index, a / (index * index * root) - 1.0 / index


@njit(cache=True, fastmath=FAST, error_model="numpy")
def distance_to_ray(
    depth, reference_direction, reference_normal, reference, direction, normal, view, wet, index, weight,
    residual, with_jacobians, shared_plane, jacobians,
):  # fmt: skip
    """Weighted `D_ij` and its derivatives.

    Args:
        depth: (1,) `d_j`, the length along the reference's refracted ray behind the interface.
        reference_direction, reference_normal: (3,) unit, of the reference's observation, in its frame.
        reference: `View` of the reference image.
        direction, normal: (3,) unit, of the observation, in its image's frame.
        view: `View` of its image.
        wet: whether the observation looks through the interface; if not, its ray is straight.
        index: of the water.
        weight: (2, 2) of the two components of `D_ij`.
        residual: (2,) out.
        with_jacobians: whether to fill `jacobians`.
        shared_plane: whether the plane block is the reference's: the derivative by it goes there.
        jacobians: out; by surface normals in all three coordinates, for a manifold to project.

    Returns:
        Whether both rays exist: no total reflection, planes before the cameras, and no ray across the depth axis.
    """
    reference_cosine = _dot(reference_direction, reference.normal)
    reference_bend, reference_bend_by = _bend(reference_direction, reference_normal, index)
    if not (reference_cosine > 0.0 and reference.distance > 0.0 and math.isfinite(reference_bend)):
        return False
    cosine, bend, bend_by = 1.0, 0.0, 0.0
    if wet:
        cosine = _dot(direction, view.normal)
        bend, bend_by = _bend(direction, normal, index)
        if not (cosine > 0.0 and view.distance > 0.0 and math.isfinite(bend)):
            return False
    point, origin, ray = np.empty(3), np.empty(3), np.empty(3)
    reference_ray = np.empty(3)
    for i in range(3):
        reference_ray[i] = reference_direction[i] / index + reference_bend * reference_normal[i]
        point[i] = reference.distance / reference_cosine * reference_direction[i] + depth[0] * reference_ray[i]
        origin[i] = view.distance / cosine * direction[i] if wet else 0.0
        ray[i] = direction[i] / index + bend * normal[i] if wet else direction[i]
    turn = view.rotation
    slope = _dot(turn[2], ray)
    if not abs(slope) > _LEAST_SLOPE:
        return False
    t = (point[2] - _dot(turn[2], origin) - view.center[2]) / slope
    seen = np.empty(3)
    for i in range(3):
        seen[i] = origin[i] + t * ray[i]
    d0 = point[0] - _dot(turn[0], seen) - view.center[0]
    d1 = point[1] - _dot(turn[1], seen) - view.center[1]
    for row in range(2):
        residual[row] = weight[row, 0] * d0 + weight[row, 1] * d1
    if not with_jacobians:
        return True

    by_point = np.empty(3)
    by_seen = np.empty(3)
    local = np.empty(6)
    slope0, slope1 = _dot(turn[0], ray) / slope, _dot(turn[1], ray) / slope
    for row in range(2):
        # Moving the point or the ray also moves the depth at which the two are compared.
        by_point[0], by_point[1] = weight[row, 0], weight[row, 1]
        by_point[2] = -(by_point[0] * slope0 + by_point[1] * slope1)
        for i in range(3):
            by_seen[i] = -(by_point[0] * turn[0, i] + by_point[1] * turn[1, i] + by_point[2] * turn[2, i])
        jacobians.depth[row] = _dot(by_point, reference_ray)
        along = _dot(by_point, reference_normal) * reference_bend_by
        for j in range(3):
            jacobians.reference_normal[3 * row + j] = depth[0] * (
                reference_bend * by_point[j] + along * reference_direction[j]
            )
        # The intersection moves along the line of sight only.
        along = _dot(by_point, reference_direction) / reference_cosine
        reach = reference.distance / reference_cosine
        for j in range(3):
            tilt = 0.0
            for i in range(3):
                tilt += reference_direction[i] * reference.plane_map[i, j]
            jacobians.reference_plane[3 * row + j] = along * (reference.plane_map[3, j] - reach * tilt)

        # A turn `w` and shift `v` of the camera move what it sees by -(w x seen + v), in its own frame.
        local[0] = -(seen[1] * by_seen[2] - seen[2] * by_seen[1])
        local[1] = -(seen[2] * by_seen[0] - seen[0] * by_seen[2])
        local[2] = -(seen[0] * by_seen[1] - seen[1] * by_seen[0])
        local[3], local[4], local[5] = -by_seen[0], -by_seen[1], -by_seen[2]
        if wet:
            along = _dot(by_seen, normal) * bend_by
            for j in range(3):
                jacobians.normal[3 * row + j] = t * (bend * by_seen[j] + along * direction[j])
            along = _dot(by_seen, direction) / cosine
            reach = view.distance / cosine
            n, u = view.normal, direction
            if view.in_world:
                # The plane stays, so it turns and shifts in the camera: dn = w x n, dd = n . v.
                local[0] -= along * reach * (n[1] * u[2] - n[2] * u[1])
                local[1] -= along * reach * (n[2] * u[0] - n[0] * u[2])
                local[2] -= along * reach * (n[0] * u[1] - n[1] * u[0])
                for j in range(3):
                    local[3 + j] += along * n[j]
            for j in range(3):
                tilt = 0.0
                for i in range(3):
                    tilt += u[i] * view.plane_map[i, j]
                change = along * (view.plane_map[3, j] - reach * tilt)
                if shared_plane:
                    jacobians.reference_plane[3 * row + j] += change
                else:
                    jacobians.plane[3 * row + j] = change
        for j in range(6):
            value = 0.0
            for i in range(6):
                value += local[i] * view.pose_map[i, j]
            jacobians.pose[6 * row + j] = value
    return True
