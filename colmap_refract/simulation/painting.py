"""The light that rays bring back from the ground. Compiled by numba."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from colmap_refract.simulation.ray_tracing import MISSED, WET, follow, relief


@njit(cache=True, nogil=True, error_model="numpy")
def texel(x, y, level, pyramid, levels, decode, red_green_blue):
    """Linear light of a texture at one level of its pyramid, bilinear, the point in texels of the finest level."""
    at, height, width = levels[level]
    size = 2.0**level
    u = min(max(x / size - 0.5, 0.0), width - 1.0)
    v = min(max(y / size - 0.5, 0.0), height - 1.0)
    i, j = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
    s, t = u - i, v - j
    right, below = 3 * min(1, width - 1), 3 * width * min(1, height - 1)
    first = at + 3 * (j * width + i)
    for c in range(3):
        k = first + c
        upper = (1 - s) * decode[pyramid[k]] + s * decode[pyramid[k + right]]
        lower = (1 - s) * decode[pyramid[k + below]] + s * decode[pyramid[k + below + right]]
        red_green_blue[c] = (1 - t) * upper + t * lower


@njit(cache=True, nogil=True, error_model="numpy")
def paint(
    origin,
    directions,
    angle,
    axis,
    plane,
    waves,
    media,
    walls,
    top,
    coefficients,
    ground,
    pyramid,
    levels,
    decode,
    sheet,
    sun,
    ambient,
    attenuation,
    veil,
    sky,
    vignetting,
    out,
):
    """Linear light of pixels, each the mean of its rays.

    Args:
        directions: (pixels, rays per pixel, 3), unit, in the world.
        angle: between neighbouring rays, radians, where a pixel has but one.
        axis: (3,) of the view, for the vignetting.
        pyramid, levels, decode: the texture's, see `Texture`.
        sheet: (3,) x and y of the texture's corner, and the size of a texel.
        sun: (3,) unit vector towards the light; `ambient`: the light that comes from everywhere.
        attenuation, veil, sky: (3,) each, see `Look`.
        out: (pixels, 3), filled.
    """
    near, far = np.empty(3), np.empty(3)
    rays = directions.shape[1]
    side = int(round(math.sqrt(rays)))
    for p in range(len(directions)):
        out[p, 0] = out[p, 1] = out[p, 2] = 0.0
        for r in range(rays):
            dx, dy, dz = directions[p, r, 0], directions[p, r, 1], directions[p, r, 2]
            became, x, y, _, water, apparent, reflected = follow(
                origin[0],
                origin[1],
                origin[2],
                dx,
                dy,
                dz,
                plane,
                waves,
                media,
                walls,
                top,
                coefficients,
                ground,
            )
            if became == MISSED:
                for c in range(3):
                    near[c] = veil[c]
            else:
                spread = angle
                if side > 1:
                    q = r + 1 if r % side == 0 else r - 1
                    spread = math.sqrt(
                        (directions[p, q, 0] - dx) ** 2
                        + (directions[p, q, 1] - dy) ** 2
                        + (directions[p, q, 2] - dz) ** 2
                    )
                level = min(max(math.log2(apparent * spread / sheet[2]), 0.0), len(levels) - 1.0)
                lower = min(int(level), max(len(levels) - 2, 0))
                u, v = (x - sheet[0]) / sheet[2], (y - sheet[1]) / sheet[2]
                texel(u, v, lower, pyramid, levels, decode, near)
                if level > lower:
                    texel(u, v, lower + 1, pyramid, levels, decode, far)
                    for c in range(3):
                        near[c] += (level - lower) * (far[c] - near[c])
                _, zx, zy = relief(x, y, coefficients, ground)
                # The normal of the ground towards the light is (zx, zy, -1), as z points down.
                lit = (zx * sun[0] + zy * sun[1] - sun[2]) / math.sqrt(1 + zx * zx + zy * zy)
                light = ambient + (1 - ambient) * max(lit, 0.0)
                for c in range(3):
                    near[c] *= light
                    if became == WET:
                        passed = math.exp(-attenuation[c] * water)
                        near[c] = passed * near[c] + (1 - passed) * veil[c]
                        if reflected > 0 and sky[c] > 0:
                            near[c] += reflected * (sky[c] - near[c])
            cosine = axis[0] * dx + axis[1] * dy + axis[2] * dz
            shaded = 1 - vignetting * (1 - cosine**4) if math.isfinite(cosine) else 0.0
            for c in range(3):
                out[p, c] += near[c] * shaded / rays
