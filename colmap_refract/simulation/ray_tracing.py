"""Light, ray by ray: through the surface by Snell's law, and to the terrain.

Compiled by numba. Both the surface and the terrain are met by stepping along the ray no farther than the bound on
their slope allows, which cannot jump over the first meeting, and then by Newton's method.

Arrays that describe a scene, lengths in metres, in the world's frame (z down):

- `plane` (4,): unit normal, from the camera into the water, and the offset along it.
- `waves` (W, 4): wave numbers kx, ky, amplitude and phase of `amplitude * sin(kx x + ky y + phase)`, added to z.
- `media` (K + 2,) and `walls` (K,): refractive indices from the camera's medium to the water, and the thicknesses
  of the walls between them.
- `coefficients` (ny + 4, nx + 4): of a cubic B-spline over a grid, two more nodes on each side.
- `ground` (11,): x, y of the grid's first node, spacing; z at the world's origin, slope by x and by y of a plane that
  is added to the spline; bound of the slope; least and largest x, then y, of the terrain.
"""

from __future__ import annotations

import math

from numba import njit

MISSED, DRY, WET = 0, 1, 2
# Newton's method converges quadratically: after a step as small as this the error is of rounding size.
_LAST_STEP = 1e-8
_MAX_STEPS = 4000


@njit(cache=True, nogil=True, error_model="numpy")
def ripple(x, y, waves):
    """The waves' part of z at (x, y), and its slopes by x and y."""
    z = zx = zy = 0.0
    for k in range(len(waves)):
        angle = waves[k, 0] * x + waves[k, 1] * y + waves[k, 3]
        z += waves[k, 2] * math.sin(angle)
        slope = waves[k, 2] * math.cos(angle)
        zx += waves[k, 0] * slope
        zy += waves[k, 1] * slope
    return z, zx, zy


@njit(cache=True, nogil=True, error_model="numpy")
def ripple_height(x, y, waves):
    """The waves' part of z at (x, y)."""
    z = 0.0
    for k in range(len(waves)):
        z += waves[k, 2] * math.sin(waves[k, 0] * x + waves[k, 1] * y + waves[k, 3])
    return z


@njit(cache=True, nogil=True, error_model="numpy")
def relief(x, y, coefficients, ground):
    """z of the terrain at (x, y) and its slopes; beyond the terrain's edge that of the edge."""
    x = min(max(x, ground[7]), ground[8])
    y = min(max(y, ground[9]), ground[10])
    u, v = (x - ground[0]) / ground[2], (y - ground[1]) / ground[2]
    i = min(max(int(math.floor(u)), 0), coefficients.shape[1] - 6)
    j = min(max(int(math.floor(v)), 0), coefficients.shape[0] - 6)
    s, t = u - i, v - j
    s1, t1 = 1 - s, 1 - t
    a = (s1 * s1 * s1 / 6, 2 / 3 - s * s * (1 - s / 2), 2 / 3 - s1 * s1 * (1 - s1 / 2), s * s * s / 6)
    da = (-s1 * s1 / 2, -2 * s + 1.5 * s * s, 2 * s1 - 1.5 * s1 * s1, s * s / 2)
    b = (t1 * t1 * t1 / 6, 2 / 3 - t * t * (1 - t / 2), 2 / 3 - t1 * t1 * (1 - t1 / 2), t * t * t / 6)
    db = (-t1 * t1 / 2, -2 * t + 1.5 * t * t, 2 * t1 - 1.5 * t1 * t1, t * t / 2)
    z, zx, zy = ground[3] + ground[4] * x + ground[5] * y, 0.0, 0.0
    for k in range(4):
        row = coefficients[j + k + 1]
        along = a[0] * row[i + 1] + a[1] * row[i + 2] + a[2] * row[i + 3] + a[3] * row[i + 4]
        change = da[0] * row[i + 1] + da[1] * row[i + 2] + da[2] * row[i + 3] + da[3] * row[i + 4]
        z += b[k] * along
        zx += b[k] * change
        zy += db[k] * along
    return z, ground[4] + zx / ground[2], ground[5] + zy / ground[2]


@njit(cache=True, nogil=True, error_model="numpy")
def relief_of(places, coefficients, ground, out):
    """`relief` at many places (n, 2): fills `out` (n, 3)."""
    for k in range(len(places)):
        out[k, 0], out[k, 1], out[k, 2] = relief(places[k, 0], places[k, 1], coefficients, ground)


@njit(cache=True, nogil=True, error_model="numpy")
def relief_height(x, y, coefficients, ground):
    """z alone of `relief`: what the march along a ray asks for."""
    x = min(max(x, ground[7]), ground[8])
    y = min(max(y, ground[9]), ground[10])
    u, v = (x - ground[0]) / ground[2], (y - ground[1]) / ground[2]
    i = min(max(int(math.floor(u)), 0), coefficients.shape[1] - 6)
    j = min(max(int(math.floor(v)), 0), coefficients.shape[0] - 6)
    s, t = u - i, v - j
    s1, t1 = 1 - s, 1 - t
    a = (s1 * s1 * s1 / 6, 2 / 3 - s * s * (1 - s / 2), 2 / 3 - s1 * s1 * (1 - s1 / 2), s * s * s / 6)
    b = (t1 * t1 * t1 / 6, 2 / 3 - t * t * (1 - t / 2), 2 / 3 - t1 * t1 * (1 - t1 / 2), t * t * t / 6)
    z = ground[3] + ground[4] * x + ground[5] * y
    for k in range(4):
        row = coefficients[j + k + 1]
        z += b[k] * (a[0] * row[i + 1] + a[1] * row[i + 2] + a[2] * row[i + 3] + a[3] * row[i + 4])
    return z


@njit(cache=True, nogil=True, error_model="numpy")
def to_surface(ox, oy, oz, dx, dy, dz, plane, waves):
    """Length of a ray from a point above the surface to it; not a number if it does not lead down through it."""
    along = plane[0] * dx + plane[1] * dy + plane[2] * dz
    above = plane[3] - (plane[0] * ox + plane[1] * oy + plane[2] * oz)
    if not along > 0:
        return math.nan
    if len(waves) == 0:
        return above / along
    crest = slope = 0.0
    for k in range(len(waves)):
        crest += abs(waves[k, 2])
        slope += abs(waves[k, 2]) * math.hypot(waves[k, 0], waves[k, 1])
    crest *= plane[2]
    rate = along + plane[2] * slope * math.hypot(dx, dy)
    s = max(0.0, (above - crest) / along)
    near = 1e-2 * crest
    for _ in range(_MAX_STEPS):
        gap = above - s * along + plane[2] * ripple_height(ox + s * dx, oy + s * dy, waves)
        if gap < near:
            break
        s += gap / rate
    start = s
    for _ in range(30):
        z, zx, zy = ripple(ox + s * dx, oy + s * dy, waves)
        step = (above - s * along + plane[2] * z) / (along - plane[2] * (zx * dx + zy * dy))
        if not abs(step) < 10 * near:
            break
        s += step
        if abs(step) < _LAST_STEP * s:
            return s
    # Where the ray all but touches a crest, the steps that cannot overshoot end it, slowly.
    s = start
    for _ in range(_MAX_STEPS):
        gap = above - s * along + plane[2] * ripple_height(ox + s * dx, oy + s * dy, waves)
        s += gap / rate
        if gap < 1e-9 * crest:
            return s
    return math.nan


@njit(cache=True, nogil=True, error_model="numpy")
def refract(dx, dy, dz, nx, ny, nz, ratio):
    """A unit direction behind an interface: Snell's law as vectors; not a number at total reflection.

    `ratio` is the index before the interface over that behind it; the unit normal points behind it.
    """
    cosine = nx * dx + ny * dy + nz * dz
    squared = 1 - ratio * ratio * (1 - cosine * cosine)
    if not squared > 0:
        return math.nan, math.nan, math.nan
    turn = math.sqrt(squared) - ratio * cosine
    return ratio * dx + turn * nx, ratio * dy + turn * ny, ratio * dz + turn * nz


@njit(cache=True, nogil=True, error_model="numpy")
def to_terrain(ox, oy, oz, dx, dy, dz, limit, top, coefficients, ground):
    """Length of a ray to the terrain, at most `limit`; not a number if it does not meet it by then.

    `top` is the least z of the terrain.
    """
    s = 0.0
    if oz < top:
        if not dz > 0:
            return math.nan
        s = (top - oz) / dz
    rate = dz + ground[6] * math.hypot(dx, dy)
    if not rate > 0:
        return math.nan
    near = 0.1 * ground[2]
    start = s
    for _ in range(_MAX_STEPS):
        gap = relief_height(ox + s * dx, oy + s * dy, coefficients, ground) - oz - s * dz
        if gap < near:
            break
        s += gap / rate
        start = s
        if s > limit:
            return math.nan
    for _ in range(30):
        z, zx, zy = relief(ox + s * dx, oy + s * dy, coefficients, ground)
        step = (z - oz - s * dz) / (dz - zx * dx - zy * dy)
        if not abs(step) < 10 * near:
            break
        s += step
        if abs(step) < _LAST_STEP * (1 + abs(s)):
            return s if s <= limit else math.nan
    s = start
    for _ in range(_MAX_STEPS):
        gap = relief_height(ox + s * dx, oy + s * dy, coefficients, ground) - oz - s * dz
        s += gap / rate
        if s > limit:
            return math.nan
        if gap < 1e-9 * ground[2]:
            return s
    return math.nan


@njit(cache=True, nogil=True, error_model="numpy")
def follow(ox, oy, oz, dx, dy, dz, plane, waves, media, walls, top, coefficients, ground):
    """Follow a ray from the camera to the terrain.

    Returns:
        what became of it (MISSED, DRY, WET), the point (x, y, z) it shows, its length in water, its length seen
        from the camera (the apparent depth: lengths over their indices), and the part of the light that the first
        interface reflects.
    """
    nothing = (MISSED, math.nan, math.nan, math.nan, math.nan, math.nan, 0.0)
    if not math.isfinite(dx + dy + dz):
        return nothing
    s = to_surface(ox, oy, oz, dx, dy, dz, plane, waves)
    # A shore: the terrain may be met before the water is. Most rays end above its highest point.
    if not (s >= 0 and oz + s * dz < top):
        limit = s if s >= 0 else math.inf
        air = to_terrain(ox, oy, oz, dx, dy, dz, limit, top, coefficients, ground)
        if air >= 0:
            x, y = ox + air * dx, oy + air * dy
            if ground[7] <= x <= ground[8] and ground[9] <= y <= ground[10]:
                return DRY, x, y, oz + air * dz, 0.0, air, 0.0
            return nothing
    if not s >= 0:
        return nothing
    x, y, z = ox + s * dx, oy + s * dy, oz + s * dz
    zx, zy = ripple(x, y, waves)[1:]
    nx, ny, nz = plane[0] - plane[2] * zx, plane[1] - plane[2] * zy, plane[2]
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / norm, ny / norm, nz / norm
    apparent, reflected = s, 0.0
    for k in range(len(media) - 1):
        before = nx * dx + ny * dy + nz * dz
        dx, dy, dz = refract(dx, dy, dz, nx, ny, nz, media[k] / media[k + 1])
        behind = nx * dx + ny * dy + nz * dz
        if not behind > 0:
            return nothing
        if k == 0:
            across = (media[0] * before - media[1] * behind) / (media[0] * before + media[1] * behind)
            parallel = (media[1] * before - media[0] * behind) / (media[1] * before + media[0] * behind)
            reflected = 0.5 * (across * across + parallel * parallel)
        if k < len(walls):
            length = walls[k] / behind
            x, y, z = x + length * dx, y + length * dy, z + length * dz
            apparent += length / media[k + 1]
    water = to_terrain(x, y, z, dx, dy, dz, math.inf, top, coefficients, ground)
    if not water >= 0:
        return nothing
    x, y, z = x + water * dx, y + water * dy, z + water * dz
    if not (ground[7] <= x <= ground[8] and ground[9] <= y <= ground[10]):
        return nothing
    return WET, x, y, z, water, apparent + water / media[-1], reflected


@njit(cache=True, nogil=True, error_model="numpy")
def trace_rays(origin, directions, plane, waves, media, walls, top, coefficients, ground, points, became):
    """`follow` for many rays of one camera: fills `points` (n, 3) and `became` (n,)."""
    for k in range(len(directions)):
        became[k], points[k, 0], points[k, 1], points[k, 2], _, _, _ = follow(
            origin[0],
            origin[1],
            origin[2],
            directions[k, 0],
            directions[k, 1],
            directions[k, 2],
            plane,
            waves,
            media,
            walls,
            top,
            coefficients,
            ground,
        )
