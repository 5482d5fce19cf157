"""Points eliminated in compiled code: a chunk of tracks in, a small system in the camera-side parameters out.

For given cameras and planes each point is brought to its own minimum and removed by its 3x3 Schur complement
(variable projection, Golub & Pereyra 1973; in bundle adjustment Jeong et al. 2012, Hong et al. 2016). What
is left is the cost `f`, gradient `g` and Gauss-Newton matrix `H` in the camera-side parameters only.

The kernel knows no scenario and no camera model. An observation is a direction with a pixel metric, and
depends on the point and on up to five *slots* of its image: the pose (6), the plane (3), the index of the
medium (1), the lens and the waves on the surface (any number each). `Views.columns` says where each slot's
parameters stand in the chunk's vector (-1: held), so a scenario is only a choice of who shares which columns
(module `scenario`).

Waves: an observation is refracted by a plane of its own, the tangent of the surface where the keypoint's ray
meets it (the paper's `n_ij`). Height and slopes there are linear in the image's coefficients, so the same
derivatives by a plane serve, and the keypoint decides where the ray crosses: many paths to one point do no harm.

A reference image: each point can be bound to the refracted ray of its first observation (the paper's `d_j`, `on_rays`),
and residuals can be distances in the scene rather than in the image (the paper's `D_ij`, `Tracks.scene`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from colmap_refract.estimator.observed import (
    BY_DISTANCE,
    BY_HEIGHT,
    BY_INDEX,
    BY_NORMAL,
    BY_POINT,
    BY_SLOPE,
    IN_CAM,
    RESIDUAL,
    VALUES,
    from_local_plane,
    is_wavy,
    local_plane,
)
from colmap_refract.estimator.on_ray import eliminate_length, refracted_ray
from colmap_refract.estimator.optics import FAST, one_interface, slope_derivatives, snell_root
from colmap_refract.estimator.robust import robust
from colmap_refract.estimator.scene_residual import observe_in_scene
from colmap_refract.interface import Array

NUM_SLOTS = 5
POSE, PLANE, MEDIUM, LENS, WAVES = range(NUM_SLOTS)
"""The slots of an image."""

LEVEL = 5
"""The plane that all planes of a moving interface scatter about: no observation looks at it, but a prior does."""

MAX_POINT_STEPS = 40
"""Half-solved points make the cost no function of the cameras. Most need one or two steps, a residual near the
scale of a robust loss many."""

POINT_TOLERANCE = 1e-7
"""A point is at its minimum when one more step would lower its cost by less than this fraction.
What such a step would gain is subtracted from the cost, so the error left is of the next order."""

_LENGTH_TOLERANCE = 1e-12
"""Relative, of a length along a ray; for residuals so small that no tolerance in pixels serves."""

_SQUARED_PIXEL_FLOOR = 1e-14
_GUARD = 1e-11


class Tracks(NamedTuple):
    """Observations sorted by point. N observations of P points in images indexed from 0.

    Attributes:
        start: (P + 1,) first observation of each point.
        image: (N,) index of the image.
        direction: (N, 3) unit direction of the keypoint in the camera's frame.
        metric: (N, 2, 3) pixels per change of direction, at the keypoint.
        lens: (N, 2, Q) pixels per change of the camera's refined intrinsics; Q may be 0.
        wet: (N,) whether the point lies in the water as seen from this image.
        waves: (N, 3, K) what the K wave coefficients of the image do where the keypoint's ray meets the surface: its
            height over the plane's distance, towards the water, and the two parts of the normal along `Views.axes`.
            K = 0, whatever N, where all surfaces are flat.
        scene: (N, 3, 3) world frame. With two rows of weights, residuals are these times the difference between the
            point and the observation's ray at the same depth along the third row, a unit vector; see
            `scene_residual`. (0, 3, 3): residuals are in the image.
        relief: (N, 3) height and parts of the normal as in `waves`, as they are: nothing that is solved for moves
            them. They take `sight`, too. (0, 3): none.
    """

    start: NDArray[np.int64]
    image: NDArray[np.int32]
    direction: Array
    metric: Array
    lens: Array
    wet: NDArray[np.bool_]
    waves: Array = np.zeros((0, 3, 0))
    sight: Array = np.zeros((0, 3))
    effects: Array = np.zeros((0, 2, 0))
    offset: Array = np.zeros((0, 2))
    scene: Array = np.zeros((0, 3, 3))
    relief: Array = np.zeros((0, 3))

    def take(self, start: NDArray[np.int64], rows: NDArray[Any]) -> Tracks:
        """Some of the observations: `rows`, indices or a mask (N,), of points that begin at `start`."""
        # What nobody needs is empty, whatever the number of observations.
        return Tracks(start, *(part[rows] if part.shape[0] else part for part in self[1:]))  # type: ignore[arg-type]


class Views(NamedTuple):
    """The state of I images and how their local parameters follow from the blocks of the problem.

    Attributes:
        rotation: (I, 3, 3), translation: (I, 3): `cam_from_world`.
        normal: (I, 3) `normal_in_cam`, distance: (I,).
        in_world: (I,) whether the plane is fixed in the world, so that it moves in the camera with the pose.
        pose_map: (I, 6, 6) local (rotation, translation) by the pose block: `x_cam` changes by
            `rotation x x_cam + translation`.
        plane_map: (I, 4, 3) change of (`normal_in_cam`, `distance`) by the plane block at a fixed pose.
        lens_change: (I, Q) change of the refined intrinsics since the keypoints were lifted.
        waves: (I, K) wave coefficients.
        axes: (I, 3, 2) two directions along the plane, camera frame, that slopes are counted along.
        columns: (I, 5) first column of each slot in the chunk's parameter vector, -1 where it is held.
    """

    rotation: Array
    translation: Array
    normal: Array
    distance: Array
    in_world: NDArray[np.bool_]
    pose_map: Array
    plane_map: Array
    lens_change: Array
    waves: Array
    axes: Array
    columns: NDArray[np.int32]


class Optics(NamedTuple):
    """`optics.Media` as a tuple that compiled code takes."""

    ratio: Array
    ratio_by_index: Array
    walls: Array


class Anchors(NamedTuple):
    """Proximal term `weight / 2 |P - position|^2` of each point: (P,) and (P, 3)."""

    weight: Array
    position: Array


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def _observe(k, point, tracks, views, optics, with_interface, out):
    """Residual of observation `k` in pixels and its derivatives, into `out` (layout of `observed`).

    The derivatives by the interface are left out unless `with_interface`.
    """
    i = tracks.image[k]
    x, y, w = point[0], point[1], point[2]
    rotation = views.rotation
    cx = rotation[i, 0, 0] * x + rotation[i, 0, 1] * y + rotation[i, 0, 2] * w + views.translation[i, 0]
    cy = rotation[i, 1, 0] * x + rotation[i, 1, 1] * y + rotation[i, 1, 2] * w + views.translation[i, 1]
    cz = rotation[i, 2, 0] * x + rotation[i, 2, 1] * y + rotation[i, 2, 2] * w + views.translation[i, 2]
    vx, vy, vz = cx, cy, cz
    nx, ny, nz = views.normal[i, 0], views.normal[i, 1], views.normal[i, 2]
    px, py, pz = 0.0, 0.0, 0.0
    d = views.distance[i]
    waves = is_wavy(tracks)
    height, length, t, facing = 0.0, 1.0, 0.0, 1.0
    if waves and tracks.wet[k]:
        nx, ny, nz, d, height, length, t, facing = local_plane(k, i, tracks, views)
    z = nx * cx + ny * cy + nz * cz
    big, big_s, big_z, big_d, big_index = 1.0, 0.0, 0.0, 0.0, 0.0
    refracted = False
    if tracks.wet[k] and z > 0.0 and d > 0.0:
        px, py, pz = cx - z * nx, cy - z * ny, cz - z * nz
        s = px * px + py * py + pz * pz
        if optics.ratio.shape[0] == 2 and optics.ratio[1] < 1.0:
            big, big_s, big_z, big_d, big_index = one_interface(z, s, d, optics.ratio[1], optics.ratio_by_index[1])
        else:
            g, h = snell_root(z, s, d, optics.ratio, optics.walls)
            big, big_s, big_z, big_d, big_index = slope_derivatives(
                g, h, s, d, optics.ratio, optics.ratio_by_index, optics.walls
            )
        if math.isfinite(big):
            refracted = True
            vx, vy, vz = nx + big * px, ny + big * py, nz + big * pz
    inverse = 1.0 / math.sqrt(vx * vx + vy * vy + vz * vz)
    ux, uy, uz = vx * inverse, vy * inverse, vz * inverse
    dx = ux - tracks.direction[k, 0]
    dy = uy - tracks.direction[k, 1]
    dz = uz - tracks.direction[k, 2]
    for row in range(2):
        m0, m1, m2 = tracks.metric[k, row, 0], tracks.metric[k, row, 1], tracks.metric[k, row, 2]
        e = m0 * dx + m1 * dy + m2 * dz
        for q in range(tracks.lens.shape[2]):
            e += tracks.lens[k, row, q] * views.lens_change[i, q]
        if tracks.effects.shape[2] > 0:
            e += tracks.offset[k, row]
            for q in range(tracks.effects.shape[2]):
                e += tracks.effects[k, row, q] * views.waves[i, q]
        out[RESIDUAL + row] = e
        # a = d residual / d v, through the normalisation of v.
        along = m0 * ux + m1 * uy + m2 * uz
        a0, a1, a2 = (m0 - along * ux) * inverse, (m1 - along * uy) * inverse, (m2 - along * uz) * inverse
        by_point = BY_POINT + 3 * row
        if refracted:
            ap = a0 * px + a1 * py + a2 * pz
            an = a0 * nx + a1 * ny + a2 * nz
            # v = n + G p by X: a G + (a . p) (2 G_s p + G_z n) - G (a . n) n
            fp = 2.0 * big_s * ap
            fn = big_z * ap - big * an
            out[by_point] = big * a0 + fp * px + fn * nx
            out[by_point + 1] = big * a1 + fp * py + fn * ny
            out[by_point + 2] = big * a2 + fp * pz + fn * nz
            if with_interface:
                # by n: a (1 - G z) + ((a . p) (G_z - 2 z G_s) - G (a . n)) p
                fa = 1.0 - big * z
                fp = ap * (big_z - 2.0 * z * big_s) - big * an
                by_normal = BY_NORMAL + 3 * row
                out[by_normal] = fa * a0 + fp * px
                out[by_normal + 1] = fa * a1 + fp * py
                out[by_normal + 2] = fa * a2 + fp * pz
                out[BY_DISTANCE + row] = ap * big_d
                out[BY_INDEX + row] = ap * big_index
                if waves:
                    b0, b1, b2, bd = out[by_normal], out[by_normal + 1], out[by_normal + 2], ap * big_d
                    from_local_plane(
                        row, k, i, tracks, views, b0, b1, b2, bd, nx, ny, nz, d, height, length, t, facing, out
                    )  # fmt: skip
        else:
            out[by_point] = a0
            out[by_point + 1] = a1
            out[by_point + 2] = a2
            if with_interface:
                for j in range(3):
                    out[BY_NORMAL + 3 * row + j] = 0.0
                out[BY_DISTANCE + row] = 0.0
                out[BY_INDEX + row] = 0.0
                out[BY_HEIGHT + row] = 0.0
                out[BY_SLOPE + 2 * row] = 0.0
                out[BY_SLOPE + 2 * row + 1] = 0.0
    out[IN_CAM], out[IN_CAM + 1], out[IN_CAM + 2] = cx, cy, cz


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def _by_world_point(row, rotation, i, values):
    """A row of the derivative by the point in the world, for image `i`."""
    a0, a1, a2 = values[BY_POINT + 3 * row], values[BY_POINT + 3 * row + 1], values[BY_POINT + 3 * row + 2]
    return (
        a0 * rotation[i, 0, 0] + a1 * rotation[i, 1, 0] + a2 * rotation[i, 2, 0],
        a0 * rotation[i, 0, 1] + a1 * rotation[i, 1, 1] + a2 * rotation[i, 2, 1],
        a0 * rotation[i, 0, 2] + a1 * rotation[i, 1, 2] + a2 * rotation[i, 2, 2],
    )


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _point_system(point, anchor_weight, anchor, first, stop, tracks, views, optics, loss, scale, values, v, gradient):
    """Cost of one point, its gradient (3,) and its Gauss-Newton matrix `v` (xx, xy, xz, yy, yz, zz)."""
    cost = 0.0
    in_scene = tracks.scene.shape[0] > 0
    for j in range(6):
        v[j] = 0.0
    for j in range(3):
        gradient[j] = 0.0
    for k in range(first, stop):
        if in_scene:
            observe_in_scene(k, point, tracks, views, optics, False, values)
        else:
            _observe(k, point, tracks, views, optics, False, values)
        e0, e1 = values[RESIDUAL], values[RESIDUAL + 1]
        rho, weight = robust(e0 * e0 + e1 * e1, loss, scale)
        cost += 0.5 * rho
        i = tracks.image[k]
        for row in range(2):
            b0, b1, b2 = _by_world_point(row, views.rotation, i, values)
            e = weight * values[RESIDUAL + row]
            gradient[0] += e * b0
            gradient[1] += e * b1
            gradient[2] += e * b2
            w0, w1, w2 = weight * b0, weight * b1, weight * b2
            v[0] += w0 * b0
            v[1] += w0 * b1
            v[2] += w0 * b2
            v[3] += w1 * b1
            v[4] += w1 * b2
            v[5] += w2 * b2
    if anchor_weight > 0.0:
        for j in range(3):
            change = point[j] - anchor[j]
            cost += 0.5 * anchor_weight * change * change
            gradient[j] += anchor_weight * change
        v[0] += anchor_weight
        v[3] += anchor_weight
        v[5] += anchor_weight
    return cost


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def _factor(v, damping, lower):
    """Cholesky factor (00, 10, 11, 20, 21, 22) of `v` with its diagonal damped, guarded where it is singular."""
    guard = _GUARD * (v[0] + v[3] + v[5]) + 1e-300
    a = math.sqrt(v[0] * (1.0 + damping) + guard)
    lower[0] = a
    lower[1] = v[1] / a
    lower[3] = v[2] / a
    lower[2] = math.sqrt(max(v[3] * (1.0 + damping) + guard - lower[1] * lower[1], guard))
    lower[4] = (v[4] - lower[3] * lower[1]) / lower[2]
    lower[5] = math.sqrt(max(v[5] * (1.0 + damping) + guard - lower[3] * lower[3] - lower[4] * lower[4], guard))


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def _forward(lower, b0, b1, b2):
    """Solve `L y = b`."""
    y0 = b0 / lower[0]
    y1 = (b1 - lower[1] * y0) / lower[2]
    return y0, y1, (b2 - lower[3] * y0 - lower[4] * y1) / lower[5]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _settle_point(point, anchor_weight, anchor, first, stop, tracks, views, optics, loss, scale, scratch):
    """Bring one point to its minimum for the given views, in place; Levenberg-Marquardt, never uphill.

    Returns:
        Its cost there, less what one more Newton step would gain.
    """
    values, v, gradient, lower = scratch[0], scratch[1], scratch[2], scratch[3]
    trial, trial_v, trial_gradient = scratch[4], scratch[5], scratch[6]
    cost = _point_system(
        point, anchor_weight, anchor, first, stop, tracks, views, optics, loss, scale, values, v, gradient
    )
    floor = _SQUARED_PIXEL_FLOOR * (stop - first)
    damping = 0.0
    gain = 0.0
    for _ in range(MAX_POINT_STEPS):
        _factor(v, damping, lower)
        y0, y1, y2 = _forward(lower, gradient[0], gradient[1], gradient[2])
        gain = y0 * y0 + y1 * y1 + y2 * y2
        if not gain > POINT_TOLERANCE * cost + floor:
            break
        s2 = y2 / lower[5]
        s1 = (y1 - lower[4] * s2) / lower[2]
        s0 = (y0 - lower[1] * s1 - lower[3] * s2) / lower[0]
        trial[0], trial[1], trial[2] = point[0] - s0, point[1] - s1, point[2] - s2
        trial_cost = _point_system(
            trial,
            anchor_weight,
            anchor,
            first,
            stop,
            tracks,
            views,
            optics,
            loss,
            scale,
            values,
            trial_v,
            trial_gradient,
        )
        if trial_cost < cost:
            cost = trial_cost
            damping *= 0.1 if damping > 1e-6 else 0.0
            for j in range(3):
                point[j] = trial[j]
                gradient[j] = trial_gradient[j]
            for j in range(6):
                v[j] = trial_v[j]
            gain = 0.0
        else:
            damping = max(1e-3, 10.0 * damping)
    return cost - 0.5 * gain if damping == 0.0 else cost


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _settle_length(point, anchor_weight, anchor, first, stop, tracks, views, optics, loss, scale, scratch):
    """`_settle_point` for a point on the ray of its first observation: first onto the ray, then along it."""
    values, v, gradient = scratch[0], scratch[1], scratch[2]
    origin, ray, trial = scratch[3], scratch[4], scratch[5]
    refracted_ray(first, tracks, views, optics, origin, ray)
    d = 0.0
    for j in range(3):
        d += (point[j] - origin[j]) * ray[j]
    floor = _SQUARED_PIXEL_FLOOR * (stop - first)
    cost, slope, curvature, damping, gain, step = 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    for attempt in range(MAX_POINT_STEPS + 1):
        for j in range(3):
            trial[j] = origin[j] + (d - step) * ray[j]
        trial_cost = _point_system(
            trial, anchor_weight, anchor, first + 1, stop, tracks, views, optics, loss, scale, values, v, gradient
        )  # fmt: skip
        if attempt == 0 or trial_cost < cost:
            d -= step
            cost = trial_cost
            damping *= 0.1 if damping > 1e-6 else 0.0
            a0, a1, a2 = ray[0], ray[1], ray[2]
            slope = a0 * gradient[0] + a1 * gradient[1] + a2 * gradient[2]
            curvature = (
                (a0 * (v[0] * a0 + 2.0 * (v[1] * a1 + v[2] * a2)) + a1 * (v[3] * a1 + 2.0 * v[4] * a2) + a2 * v[5] * a2)
                + _GUARD * (v[0] + v[3] + v[5])
                + 1e-300
            )
            gain = slope * slope / curvature
        else:
            damping = max(1e-3, 10.0 * damping)
        step = slope / (curvature * (1.0 + damping))
        if not (gain > POINT_TOLERANCE * cost + floor and abs(step) > _LENGTH_TOLERANCE * abs(d)):
            break
    for j in range(3):
        point[j] = origin[j] + d * ray[j]
    return cost - 0.5 * gain


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def settle(points, anchors, first_track, stop_track, tracks, views, optics, loss, scale, on_rays=False):
    """Bring points to their minima for the given views.

    Args:
        points: (P, 3) world positions, changed in place.
        anchors: the proximal terms.
        first_track, stop_track: the range of points to work on.
        tracks, views, optics: see the tuples.
        loss, scale: robust loss and its scale in pixels.
        on_rays: whether each point lies on the refracted ray of its first observation, which then has no residual.

    Returns:
        The summed cost at the minima.
    """
    scratch = np.empty((7, VALUES))
    total = 0.0
    for p in range(first_track, stop_track):
        if on_rays:
            total += _settle_length(
                points[p], anchors.weight[p], anchors.position[p], tracks.start[p], tracks.start[p + 1],
                tracks, views, optics, loss, scale, scratch,
            )  # fmt: skip
        else:
            total += _settle_point(
                points[p], anchors.weight[p], anchors.position[p], tracks.start[p], tracks.start[p + 1],
                tracks, views, optics, loss, scale, scratch,
            )  # fmt: skip
    return total


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def _by_blocks(k, values, tracks, views, widths, out):
    """The derivative of observation `k` by the blocks of its image, into `out` (5, 2, width)."""
    i = tracks.image[k]
    pose_map, plane_map, columns = views.pose_map, views.plane_map, views.columns
    for row in range(2):
        j0, j1, j2 = values[BY_POINT + 3 * row], values[BY_POINT + 3 * row + 1], values[BY_POINT + 3 * row + 2]
        n0, n1, n2 = values[BY_NORMAL + 3 * row], values[BY_NORMAL + 3 * row + 1], values[BY_NORMAL + 3 * row + 2]
        by_distance = values[BY_DISTANCE + row]
        if columns[i, POSE] >= 0:
            x, y, z = values[IN_CAM], values[IN_CAM + 1], values[IN_CAM + 2]
            # Local rotation: x_cam changes by omega x x_cam; a plane fixed in the world moves along.
            r0, r1, r2 = y * j2 - z * j1, z * j0 - x * j2, x * j1 - y * j0
            t0, t1, t2 = j0, j1, j2
            if views.in_world[i]:
                nx, ny, nz = views.normal[i, 0], views.normal[i, 1], views.normal[i, 2]
                r0 += ny * n2 - nz * n1
                r1 += nz * n0 - nx * n2
                r2 += nx * n1 - ny * n0
                t0 += by_distance * nx
                t1 += by_distance * ny
                t2 += by_distance * nz
            for j in range(6):
                out[POSE, row, j] = (
                    r0 * pose_map[i, 0, j] + r1 * pose_map[i, 1, j] + r2 * pose_map[i, 2, j]
                    + t0 * pose_map[i, 3, j] + t1 * pose_map[i, 4, j] + t2 * pose_map[i, 5, j]
                )  # fmt: skip
        if columns[i, PLANE] >= 0:
            for j in range(3):
                out[PLANE, row, j] = (
                    n0 * plane_map[i, 0, j]
                    + n1 * plane_map[i, 1, j]
                    + n2 * plane_map[i, 2, j]
                    + by_distance * plane_map[i, 3, j]
                )
        if columns[i, MEDIUM] >= 0:
            out[MEDIUM, row, 0] = values[BY_INDEX + row]
        if columns[i, LENS] >= 0:
            for j in range(widths[LENS]):
                out[LENS, row, j] = tracks.lens[k, row, j]
        if columns[i, WAVES] >= 0:
            b0 = values[BY_HEIGHT + row]
            b1, b2 = values[BY_SLOPE + 2 * row], values[BY_SLOPE + 2 * row + 1]
            for j in range(tracks.effects.shape[2]):
                out[WAVES, row, j] = tracks.effects[k, row, j]
            for j in range(tracks.waves.shape[2]):
                out[WAVES, row, j] = (
                    b0 * tracks.waves[k, 0, j] + b1 * tracks.waves[k, 1, j] + b2 * tracks.waves[k, 2, j]
                )


# Not inlined: a second copy of `_observe` would slow `reduce` down and take long to compile.
@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _constraint(k, point, tracks, views, optics, widths, values, by_point, by_blocks):
    """Derivatives of observation `k`, that its point is bound to, by the point (2, 3) and by blocks (5, 2, width)."""
    _observe(k, point, tracks, views, optics, True, values)
    for row in range(2):
        b0, b1, b2 = _by_world_point(row, views.rotation, tracks.image[k], values)
        by_point[row, 0], by_point[row, 1], by_point[row, 2] = b0, b1, b2
    _by_blocks(k, values, tracks, views, widths, by_blocks)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def _subtract_outer(matrix, row, column, factors, a, b, height, width):
    """`matrix[row:, column:] -= A^T B` for the factors A (3, height) and B (3, width) of blocks a and b.

    Six columns are written out, read before they are written: the compiler cannot know that the arrays do not
    overlap, and would otherwise go one number at a time.
    """
    if width == 6:
        b00, b01, b02, b03, b04, b05 = (
            factors[b, 0, 0],
            factors[b, 0, 1],
            factors[b, 0, 2],
            factors[b, 0, 3],
            factors[b, 0, 4],
            factors[b, 0, 5],
        )
        b10, b11, b12, b13, b14, b15 = (
            factors[b, 1, 0],
            factors[b, 1, 1],
            factors[b, 1, 2],
            factors[b, 1, 3],
            factors[b, 1, 4],
            factors[b, 1, 5],
        )
        b20, b21, b22, b23, b24, b25 = (
            factors[b, 2, 0],
            factors[b, 2, 1],
            factors[b, 2, 2],
            factors[b, 2, 3],
            factors[b, 2, 4],
            factors[b, 2, 5],
        )
        for i in range(height):
            a0, a1, a2 = factors[a, 0, i], factors[a, 1, i], factors[a, 2, i]
            r = row + i
            m0 = matrix[r, column + 0] - (a0 * b00 + a1 * b10 + a2 * b20)
            m1 = matrix[r, column + 1] - (a0 * b01 + a1 * b11 + a2 * b21)
            m2 = matrix[r, column + 2] - (a0 * b02 + a1 * b12 + a2 * b22)
            m3 = matrix[r, column + 3] - (a0 * b03 + a1 * b13 + a2 * b23)
            m4 = matrix[r, column + 4] - (a0 * b04 + a1 * b14 + a2 * b24)
            m5 = matrix[r, column + 5] - (a0 * b05 + a1 * b15 + a2 * b25)
            matrix[r, column + 0] = m0
            matrix[r, column + 1] = m1
            matrix[r, column + 2] = m2
            matrix[r, column + 3] = m3
            matrix[r, column + 4] = m4
            matrix[r, column + 5] = m5
    elif width == 3:
        for i in range(height):
            a0, a1, a2 = factors[a, 0, i], factors[a, 1, i], factors[a, 2, i]
            for j in range(3):
                matrix[row + i, column + j] -= a0 * factors[b, 0, j] + a1 * factors[b, 1, j] + a2 * factors[b, 2, j]
    else:
        # Four rows at a time: what a column of B takes to load serves them all.
        whole = height - height % 4
        for i in range(0, whole, 4):
            a0, a1, a2 = factors[a, 0, i], factors[a, 1, i], factors[a, 2, i]
            b0, b1, b2 = factors[a, 0, i + 1], factors[a, 1, i + 1], factors[a, 2, i + 1]
            c0, c1, c2 = factors[a, 0, i + 2], factors[a, 1, i + 2], factors[a, 2, i + 2]
            d0, d1, d2 = factors[a, 0, i + 3], factors[a, 1, i + 3], factors[a, 2, i + 3]
            r = row + i
            for j in range(width):
                x, y, z = factors[b, 0, j], factors[b, 1, j], factors[b, 2, j]
                m0 = matrix[r, column + j] - (a0 * x + a1 * y + a2 * z)
                m1 = matrix[r + 1, column + j] - (b0 * x + b1 * y + b2 * z)
                m2 = matrix[r + 2, column + j] - (c0 * x + c1 * y + c2 * z)
                m3 = matrix[r + 3, column + j] - (d0 * x + d1 * y + d2 * z)
                matrix[r, column + j], matrix[r + 1, column + j] = m0, m1
                matrix[r + 2, column + j], matrix[r + 3, column + j] = m2, m3
        for i in range(whole, height):
            a0, a1, a2 = factors[a, 0, i], factors[a, 1, i], factors[a, 2, i]
            for j in range(width):
                matrix[row + i, column + j] -= a0 * factors[b, 0, j] + a1 * factors[b, 1, j] + a2 * factors[b, 2, j]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def _add_outer(matrix, row, column, weight, by_blocks, a, b, height, width):
    """`matrix[row:, column:] += weight A^T B` for the derivatives A (2, height) and B (2, width) by slots a and b."""
    if height == 6 and width == 6:
        for i in range(6):
            a0, a1 = weight * by_blocks[a, 0, i], weight * by_blocks[a, 1, i]
            for j in range(6):
                matrix[row + i, column + j] += a0 * by_blocks[b, 0, j] + a1 * by_blocks[b, 1, j]
    elif width == 3:
        for i in range(height):
            a0, a1 = weight * by_blocks[a, 0, i], weight * by_blocks[a, 1, i]
            for j in range(3):
                matrix[row + i, column + j] += a0 * by_blocks[b, 0, j] + a1 * by_blocks[b, 1, j]
    else:
        for i in range(height):
            a0, a1 = weight * by_blocks[a, 0, i], weight * by_blocks[a, 1, i]
            for j in range(width):
                matrix[row + i, column + j] += a0 * by_blocks[b, 0, j] + a1 * by_blocks[b, 1, j]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def reduce(
    points, hold_points, anchors, first_track, stop_track, tracks, views, optics, loss, scale, matrix, gradient, rows,
    on_rays=False,
):  # fmt: skip
    """Add the reduced system of settled points to `matrix` and `gradient`.

    Args:
        points: (P, 3) world positions at their minima (see `settle`).
        hold_points: whether the points are known, so that none is eliminated.
        anchors: the proximal terms.
        first_track, stop_track: the range of points to work on.
        tracks, views, optics: see the tuples.
        loss, scale: robust loss and its scale in pixels.
        matrix: (n, n), the upper triangle is added to (blocks on the diagonal are filled).
        gradient: (n,).
        rows: (3 m, n) of the m points of the range, zero: what is left here, times itself, remains to be subtracted
            from the matrix, for whoever multiplies that of many points at once. (0, 0): subtracted here.
        on_rays: as for `settle`; not for points that are known, nor with rows.

    Returns:
        The summed cost.
    """
    num_lens, num_waves = tracks.lens.shape[2], max(tracks.waves.shape[2], tracks.effects.shape[2])
    widths = (6, 3, 1, num_lens, num_waves)
    most = max(6, num_lens, num_waves)
    longest = 1
    for p in range(first_track, stop_track):
        longest = max(longest, tracks.start[p + 1] - tracks.start[p])
    values = np.empty(VALUES)
    by_blocks = np.empty((NUM_SLOTS, 2, most))
    v = np.empty(6)
    point_gradient = np.empty(3)
    lower = np.empty(6)
    # The blocks that the current point touches, and where a column's block stands among them.
    touched_column = np.empty(NUM_SLOTS * longest, dtype=np.int64)
    touched_width = np.empty(NUM_SLOTS * longest, dtype=np.int64)
    coupling = np.empty((NUM_SLOTS * longest, 3, most))
    place = np.full(gradient.shape[0], -1, dtype=np.int64)
    in_scene = tracks.scene.shape[0] > 0
    origin, ray, by_point = np.empty(3), np.empty(3), np.empty((2, 3))
    place_of_slot, shift = np.empty(5, dtype=np.int64), np.empty((5, 3, most))
    total = 0.0
    for p in range(first_track, stop_track):
        first, stop = tracks.start[p], tracks.start[p + 1]
        for j in range(6):
            v[j] = 0.0
        for j in range(3):
            point_gradient[j] = 0.0
        num_touched = 0
        for k in range(first, stop):
            i = tracks.image[k]
            # The observation that a point is bound to is a constraint, not an error: seen to after the others.
            if on_rays and k == first:
                continue
            if in_scene:
                observe_in_scene(k, points[p], tracks, views, optics, True, values)
            else:
                _observe(k, points[p], tracks, views, optics, True, values)
            e0, e1 = values[RESIDUAL], values[RESIDUAL + 1]
            rho, weight = robust(e0 * e0 + e1 * e1, loss, scale)
            total += 0.5 * rho
            b00, b01, b02 = _by_world_point(0, views.rotation, i, values)
            b10, b11, b12 = _by_world_point(1, views.rotation, i, values)
            v[0] += weight * (b00 * b00 + b10 * b10)
            v[1] += weight * (b00 * b01 + b10 * b11)
            v[2] += weight * (b00 * b02 + b10 * b12)
            v[3] += weight * (b01 * b01 + b11 * b11)
            v[4] += weight * (b01 * b02 + b11 * b12)
            v[5] += weight * (b02 * b02 + b12 * b12)
            point_gradient[0] += weight * (e0 * b00 + e1 * b10)
            point_gradient[1] += weight * (e0 * b01 + e1 * b11)
            point_gradient[2] += weight * (e0 * b02 + e1 * b12)
            _by_blocks(k, values, tracks, views, widths, by_blocks)
            for slot in range(NUM_SLOTS):
                column = views.columns[i, slot]
                if column < 0:
                    continue
                width = widths[slot]
                at = place[column]
                if at < 0:
                    at = num_touched
                    place[column] = at
                    touched_column[at] = column
                    touched_width[at] = width
                    num_touched += 1
                    for j in range(width):
                        coupling[at, 0, j] = 0.0
                        coupling[at, 1, j] = 0.0
                        coupling[at, 2, j] = 0.0
                for j in range(width):
                    a0 = weight * by_blocks[slot, 0, j]
                    a1 = weight * by_blocks[slot, 1, j]
                    coupling[at, 0, j] += a0 * b00 + a1 * b10
                    coupling[at, 1, j] += a0 * b01 + a1 * b11
                    coupling[at, 2, j] += a0 * b02 + a1 * b12
                    gradient[column + j] += a0 * e0 + a1 * e1
                for other in range(NUM_SLOTS):
                    other_column = views.columns[i, other]
                    if other_column < column:
                        continue
                    _add_outer(matrix, column, other_column, weight, by_blocks, slot, other, width, widths[other])
        if not hold_points:
            weight = anchors.weight[p]
            if weight > 0.0:
                v[0] += weight
                v[3] += weight
                v[5] += weight
                for j in range(3):
                    change = points[p, j] - anchors.position[p, j]
                    total += 0.5 * weight * change * change
                    point_gradient[j] += weight * change
        if on_rays and not hold_points:
            _constraint(first, points[p], tracks, views, optics, widths, values, by_point, by_blocks)
            refracted_ray(first, tracks, views, optics, origin, ray)
            for slot in range(NUM_SLOTS):
                column = views.columns[tracks.image[first], slot]
                place_of_slot[slot] = -1
                if column < 0:
                    continue
                at = place[column]
                if at < 0:
                    at = num_touched
                    place[column] = at
                    touched_column[at] = column
                    touched_width[at] = widths[slot]
                    num_touched += 1
                    coupling[at] = 0.0
                place_of_slot[slot] = at
            total -= eliminate_length(
                ray, by_point, by_blocks, place_of_slot, widths, v, point_gradient, coupling, touched_column,
                touched_width, num_touched, shift, matrix, gradient,
            )  # fmt: skip
        elif not hold_points:
            _factor(v, 0.0, lower)
            y0, y1, y2 = _forward(lower, point_gradient[0], point_gradient[1], point_gradient[2])
            total -= 0.5 * (y0 * y0 + y1 * y1 + y2 * y2)
            for a in range(num_touched):
                column = touched_column[a]
                for j in range(touched_width[a]):
                    w0, w1, w2 = _forward(lower, coupling[a, 0, j], coupling[a, 1, j], coupling[a, 2, j])
                    coupling[a, 0, j], coupling[a, 1, j], coupling[a, 2, j] = w0, w1, w2
                    gradient[column + j] -= w0 * y0 + w1 * y1 + w2 * y2
            if rows.shape[0] > 0:
                for a in range(num_touched):
                    column = touched_column[a]
                    for row in range(3):
                        for j in range(touched_width[a]):
                            rows[3 * (p - first_track) + row, column + j] = coupling[a, row, j]
                left = 0
            else:
                left = num_touched
            for a in range(left):
                column = touched_column[a]
                width = touched_width[a]
                for b in range(num_touched):
                    if touched_column[b] >= column:
                        _subtract_outer(matrix, column, touched_column[b], coupling, a, b, width, touched_width[b])
        for a in range(num_touched):
            place[touched_column[a]] = -1
    return total


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def residuals(points, tracks, views, optics, out):
    """Residuals (N, 2) of all observations at the given points, into `out`; no loss, no change."""
    values = np.empty(VALUES)
    for p in range(points.shape[0]):
        for k in range(tracks.start[p], tracks.start[p + 1]):
            if tracks.scene.shape[0] > 0:
                observe_in_scene(k, points[p], tracks, views, optics, False, values)
            else:
                _observe(k, points[p], tracks, views, optics, False, values)
            out[k, 0], out[k, 1] = values[RESIDUAL], values[RESIDUAL + 1]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def surface_effects(points, tracks, views, optics, out):
    """Pixels (N, 2, 3) by relative height and by slopes of the surface under each keypoint; with waves only."""
    values = np.empty(VALUES)
    for p in range(points.shape[0]):
        for k in range(tracks.start[p], tracks.start[p + 1]):
            _observe(k, points[p], tracks, views, optics, True, values)
            for row in range(2):
                out[k, row, 0] = values[BY_HEIGHT + row]
                out[k, row, 1], out[k, row, 2] = values[BY_SLOPE + 2 * row], values[BY_SLOPE + 2 * row + 1]
