"""Covariances of a random surface between many places and nodes, looked up in a table by compiled code."""

from __future__ import annotations

import math

from numba import njit

TABLE_STEP = 0.002
"""Wavelengths. A coarser table has errors of its own that are no covariance: 0.01 leaves variances of -2e-9 of the
largest."""


@njit(cache=True, nogil=True)
def correlate(places, nodes, table, farthest, out):
    """Covariances of (height, slope, slope) at places with the heights at nodes, for a unit wavelength and slope.

    Args:
        places, nodes: (n, 2), (m, 2) in wavelengths.
        table: (t, 8) cubics of the heights' covariance and of its derivative by the distance, highest power first,
            `TABLE_STEP` apart.
        farthest: distance from which on there is none; within the table.
        out: (n, 3, m).
    """
    for a in range(places.shape[0]):
        for b in range(nodes.shape[0]):
            x, y = nodes[b, 0] - places[a, 0], nodes[b, 1] - places[a, 1]
            distance = math.sqrt(x * x + y * y)
            # Not "beyond": a distance that is not a number must not be looked up.
            if not distance < farthest:
                out[a, 0, b] = out[a, 1, b] = out[a, 2, b] = 0.0
                continue
            k = int(distance / TABLE_STEP)
            t = distance - k * TABLE_STEP
            c = table[k]
            out[a, 0, b] = ((c[0] * t + c[1]) * t + c[2]) * t + c[3]
            slope = -(((c[4] * t + c[5]) * t + c[6]) * t + c[7]) / max(distance, 1e-12)
            out[a, 1, b] = slope * x
            out[a, 2, b] = slope * y
