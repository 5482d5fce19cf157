"""Stones, painted one over the other. Compiled by numba."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def lay_stones(light, shapes, colours, speckle, veins):
    """Paint stones on a picture in place, the later over the earlier.

    Args:
        light: (H, W, 3) reflectance, float32.
        shapes: (n, 10) centre x and y, radius, all in texels; turn, lobe, squeeze, depth of the lobes; strength of
            the grain; width of the cracks; where its grain begins in `speckle`, which is a number from 0 to 1.
        colours: (n, 3) reflectance.
        speckle, veins: (S, S) noise, float32: the grain of all stones, and where they are cracked.
    """
    height, width = light.shape[0], light.shape[1]
    side = speckle.shape[0]
    for n in range(len(shapes)):
        cx, cy, radius, turn, lobe, squeeze, depth, strength, crack, begin = shapes[n]
        reach = 1.25 * radius + 1
        row, column = int(begin * side), int(begin * side * 97) % side
        cos, sin = math.cos(turn), math.sin(turn)
        for i in range(max(0, int(cy - reach)), min(height, int(cy + reach) + 1)):
            for j in range(max(0, int(cx - reach)), min(width, int(cx + reach) + 1)):
                x, y = j + 0.5 - cx, i + 0.5 - cy
                u, v = (cos * x + sin * y) / radius, (cos * y - sin * x) / (radius * squeeze)
                away = math.sqrt(u * u + v * v)
                if away > 1.3:
                    continue
                if radius > 6:
                    away /= 1 + depth * math.cos(3 * math.atan2(v, u) + lobe)
                # A dark rim about it, where stones meet, and one texel of smooth edge.
                shadow = 0.55 * min(max(1 - (away - 1) * 8, 0.0), 1.0)
                inside = min(max((1 - away) * radius * squeeze + 0.5, 0.0), 1.0)
                if shadow <= 0 and inside <= 0:
                    continue
                shade = 0.72 + 0.4 * math.sqrt(max(1 - away * away, 0.0)) - 0.085 * (x + y) / radius
                k, m = (i + row) % side, (j + column) % side
                grain = shade * math.exp(strength * speckle[k, m])
                if radius > 12 and veins[k, m] < crack:
                    grain *= 0.45
                for c in range(3):
                    under = light[i, j, c] * (1 - shadow)
                    light[i, j, c] = np.float32(under + inside * (grain * colours[n, c] - under))
