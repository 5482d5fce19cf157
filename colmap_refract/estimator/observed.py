"""What one observation leaves in scratch memory, and the plane of its own that waves refract it by.

Shared by the two residuals of the compiled kernel: in the image (module `elimination`) and in the scene (module
`scene_residual`).
"""

from __future__ import annotations

import math

from numba import njit

from colmap_refract.estimator.optics import FAST

# Where the values of one observation begin.
RESIDUAL = 0  # 2
BY_POINT = 2  # 2 x 3, by the point in the camera's frame
BY_NORMAL = 8  # 2 x 3, by a change of the normal orthogonal to it
BY_DISTANCE = 14  # 2
BY_INDEX = 16  # 2
IN_CAM = 18  # 3, camera's frame: what a motion of the camera turns about its centre, the point or its place on the ray
BY_HEIGHT = 21  # 2, by the surface's height over the distance
BY_SLOPE = 23  # 2 x 2, by the two parts of the local normal
VALUES = 27


@njit(cache=True, nogil=True, inline="always")
def is_wavy(tracks):
    """Whether each observation is refracted by a plane of its own."""
    return tracks.waves.shape[2] > 0 or tracks.relief.shape[0] > 0


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def local_plane(k, i, tracks, views):
    """The tangent of the surface that waves refract observation `k` of image `i` by.

    Returns:
        `(nx, ny, nz, d, height, length, t, facing)`: unit normal and distance; the relative height of the surface;
        the length of the normal before it was made one; how far the surface is along `sight`; and the cosine between
        `sight` and the image's plane.
    """
    nx, ny, nz = views.normal[i, 0], views.normal[i, 1], views.normal[i, 2]
    kx, ky, kz = tracks.sight[k, 0], tracks.sight[k, 1], tracks.sight[k, 2]
    facing = nx * kx + ny * ky + nz * kz
    height, first, second = 0.0, 0.0, 0.0
    if tracks.relief.shape[0] > 0:
        height, first, second = tracks.relief[k, 0], tracks.relief[k, 1], tracks.relief[k, 2]
    for q in range(tracks.waves.shape[2]):
        height += tracks.waves[k, 0, q] * views.waves[i, q]
        first += tracks.waves[k, 1, q] * views.waves[i, q]
        second += tracks.waves[k, 2, q] * views.waves[i, q]
    nx += first * views.axes[i, 0, 0] + second * views.axes[i, 0, 1]
    ny += first * views.axes[i, 1, 0] + second * views.axes[i, 1, 1]
    nz += first * views.axes[i, 2, 0] + second * views.axes[i, 2, 1]
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / length, ny / length, nz / length
    t = views.distance[i] * (1.0 + height) / facing
    return nx, ny, nz, t * (nx * kx + ny * ky + nz * kz), height, length, t, facing


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def from_local_plane(row, k, i, tracks, views, b0, b1, b2, bd, nx, ny, nz, d, height, length, t, facing, out):
    """The chain rule from the local plane to the image's plane and the waves on it, into `out`.

    Args:
        row, k, i: of the residual's two, the observation, and its image.
        b0, b1, b2, bd: derivatives by the local plane's normal and distance.
        nx, ..., facing: as `local_plane` returns them.
    """
    kx, ky, kz = tracks.sight[k, 0], tracks.sight[k, 1], tracks.sight[k, 2]
    ox, oy, oz = views.normal[i, 0], views.normal[i, 1], views.normal[i, 2]
    toward = nx * kx + ny * ky + nz * kz
    bn = b0 * nx + b1 * ny + b2 * nz
    b0 = (b0 - bn * nx + bd * t * (kx - toward * nx)) / length
    b1 = (b1 - bn * ny + bd * t * (ky - toward * ny)) / length
    b2 = (b2 - bn * nz + bd * t * (kz - toward * nz)) / length
    for j in range(2):
        out[BY_SLOPE + 2 * row + j] = b0 * views.axes[i, 0, j] + b1 * views.axes[i, 1, j] + b2 * views.axes[i, 2, j]
    out[BY_HEIGHT + row] = bd * d / (1.0 + height)
    out[BY_DISTANCE + row] = bd * d / views.distance[i]
    # The surface point slides along the keypoint's ray as the plane tilts.
    slide = -bd * d / facing
    b0, b1, b2 = b0 + slide * kx, b1 + slide * ky, b2 + slide * kz
    bn = b0 * ox + b1 * oy + b2 * oz
    by_normal = BY_NORMAL + 3 * row
    out[by_normal] = b0 - bn * ox
    out[by_normal + 1] = b1 - bn * oy
    out[by_normal + 2] = b2 - bn * oz
