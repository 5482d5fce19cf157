"""The residual in the scene, the paper's `D_ij`: how far a point is from the refracted ray of an observation.

The two are compared at the same depth along an axis that is fixed in the world, the reference camera's optical axis.
With `u` the unit direction of the keypoint, the local plane `(m, d)`, `a = u . m` and the index `mu`, the ray is

    o + t r,   o = d / a u,   r = u / mu + b m,   b = sqrt(1 - (1 - a^2) / mu^2) - a / mu,

and `t` makes `axis . (P - o - t r) = 0`. The residual is `S (P - o - t r)` with two rows S of weights. Unlike an error
in the image it needs no root of Snell's law, and it shrinks as the scene does: whoever uses it must fix the size.

One refracting surface, no wall. The observations' own directions are taken: refined intrinsics have no part in it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from colmap_refract.estimator.observed import (
    BY_DISTANCE,
    BY_HEIGHT,
    BY_INDEX,
    BY_NORMAL,
    BY_POINT,
    BY_SLOPE,
    IN_CAM,
    RESIDUAL,
    from_local_plane,
    is_wavy,
    local_plane,
)
from colmap_refract.estimator.optics import FAST

_LEAST_SLOPE = 1e-9
"""Of a ray towards the depth axis: one across it has no point at the depth."""


# Not inlined: compiled once, it costs the usual residual nothing.
@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def observe_in_scene(k, point, tracks, views, optics, with_interface, out):
    """Residual of observation `k` and its derivatives, into `out` (layout of `observed`).

    The residual is not a number where the ray is totally reflected, does not reach its plane, or runs across the axis.
    The derivatives by the interface are left out unless `with_interface`.
    """
    i = tracks.image[k]
    x, y, w = point[0], point[1], point[2]
    rotation = views.rotation
    cx = rotation[i, 0, 0] * x + rotation[i, 0, 1] * y + rotation[i, 0, 2] * w + views.translation[i, 0]
    cy = rotation[i, 1, 0] * x + rotation[i, 1, 1] * y + rotation[i, 1, 2] * w + views.translation[i, 1]
    cz = rotation[i, 2, 0] * x + rotation[i, 2, 1] * y + rotation[i, 2, 2] * w + views.translation[i, 2]
    x, y, w = tracks.scene[k, 2, 0], tracks.scene[k, 2, 1], tracks.scene[k, 2, 2]
    wx = rotation[i, 0, 0] * x + rotation[i, 0, 1] * y + rotation[i, 0, 2] * w
    wy = rotation[i, 1, 0] * x + rotation[i, 1, 1] * y + rotation[i, 1, 2] * w
    wz = rotation[i, 2, 0] * x + rotation[i, 2, 1] * y + rotation[i, 2, 2] * w
    ux, uy, uz = tracks.direction[k, 0], tracks.direction[k, 1], tracks.direction[k, 2]
    wet = tracks.wet[k]
    waves = is_wavy(tracks)

    nx, ny, nz, d = views.normal[i, 0], views.normal[i, 1], views.normal[i, 2], views.distance[i]
    height, length, t, facing = 0.0, 1.0, 0.0, 1.0
    a, mu, root, bend, bend_by, reach = 1.0, 1.0, 1.0, 0.0, 0.0, 0.0
    rx, ry, rz = ux, uy, uz
    if wet:
        if waves:
            nx, ny, nz, d, height, length, t, facing = local_plane(k, i, tracks, views)
        mu = optics.ratio[0] / optics.ratio[1]
        a = ux * nx + uy * ny + uz * nz
        squared = 1.0 - (1.0 - a * a) / (mu * mu)
        root = math.sqrt(squared) if a > 0.0 and d > 0.0 and squared > 0.0 else np.nan
        bend = root - a / mu
        bend_by = a / (mu * mu * root) - 1.0 / mu
        reach = d / a
        rx, ry, rz = ux / mu + bend * nx, uy / mu + bend * ny, uz / mu + bend * nz
    slope = wx * rx + wy * ry + wz * rz
    if not abs(slope) > _LEAST_SLOPE:
        slope = np.nan
    gap_x, gap_y, gap_z = cx - reach * ux, cy - reach * uy, cz - reach * uz
    along = (wx * gap_x + wy * gap_y + wz * gap_z) / slope
    gap_x, gap_y, gap_z = gap_x - along * rx, gap_y - along * ry, gap_z - along * rz
    for row in range(2):
        x, y, w = tracks.scene[k, row, 0], tracks.scene[k, row, 1], tracks.scene[k, row, 2]
        sx = rotation[i, 0, 0] * x + rotation[i, 0, 1] * y + rotation[i, 0, 2] * w
        sy = rotation[i, 1, 0] * x + rotation[i, 1, 1] * y + rotation[i, 1, 2] * w
        sz = rotation[i, 2, 0] * x + rotation[i, 2, 1] * y + rotation[i, 2, 2] * w
        out[RESIDUAL + row] = sx * gap_x + sy * gap_y + sz * gap_z
        # Moving the point also moves the depth at which the two are compared.
        share = (sx * rx + sy * ry + sz * rz) / slope
        gx, gy, gz = sx - share * wx, sy - share * wy, sz - share * wz
        by_point = BY_POINT + 3 * row
        out[by_point], out[by_point + 1], out[by_point + 2] = gx, gy, gz
        if not with_interface:
            continue
        by_normal = BY_NORMAL + 3 * row
        if not wet:
            for j in range(3):
                out[by_normal + j] = 0.0
            out[BY_DISTANCE + row] = 0.0
            out[BY_INDEX + row] = 0.0
            out[BY_HEIGHT + row] = 0.0
            out[BY_SLOPE + 2 * row] = 0.0
            out[BY_SLOPE + 2 * row + 1] = 0.0
            continue
        # The ray's place moves the residual by -g, its direction by -along g.
        gu = gx * ux + gy * uy + gz * uz
        gn = gx * nx + gy * ny + gz * nz
        fu = gu * reach / a - along * gn * bend_by
        fg = -along * bend
        b0, b1, b2 = fu * ux + fg * gx, fu * uy + fg * gy, fu * uz + fg * gz
        bd = -gu / a
        bend_by_index = (1.0 - a * a) / (mu * mu * mu * root) + a / (mu * mu)
        out[BY_INDEX + row] = along * (gu / (mu * mu) - bend_by_index * gn)
        if waves:
            from_local_plane(
                row, k, i, tracks, views, b0, b1, b2, bd, nx, ny, nz, d, height, length, t, facing, out
            )  # fmt: skip
        else:
            out[by_normal], out[by_normal + 1], out[by_normal + 2] = b0, b1, b2
            out[BY_DISTANCE + row] = bd
    # A moving camera carries its ray along, so that the place on the ray turns about it, not the point.
    out[IN_CAM], out[IN_CAM + 1], out[IN_CAM + 2] = cx - gap_x, cy - gap_y, cz - gap_z
