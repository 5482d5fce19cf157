"""Reduced systems of many tracks, added up in a banded matrix by compiled code: a few points at a time.

A few points that the same images see leave a small dense system; the kernel of module `elimination` makes it in the
columns of those images, and it is added where these stand in the whole (module `banded`).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from colmap_refract.estimator.elimination import NUM_SLOTS, reduce


@njit(cache=True, nogil=True)
def add_groups(
    points, hold_points, anchors, members, bounds, tracks, views, optics, loss, scale, columns, band, border, corner,
    gradient,
):  # fmt: skip
    """Add the reduced systems of groups of settled points.

    Args:
        points, hold_points, anchors, tracks, optics, loss, scale: as for `elimination.reduce`.
        members: indices of points, group after group; bounds: (G + 1,) where each group begins.
        views: its `columns` (I, 5) are scratch memory, overwritten.
        columns: (I, 5) first column of each slot in the whole system, -1 where it is held.
        band: (n, w + 1) `band[j, i - j]` is the entry (i, j) of the matrix of the first n columns, i >= j.
        border: (n, m) the entries between these and the last m columns; corner: (m, m), upper triangle.
        gradient: (n + m,).

    Returns:
        The summed cost.
    """
    num_waves = max(tracks.waves.shape[2], tracks.effects.shape[2])
    widths = (6, 3, 1, tracks.lens.shape[2], num_waves)
    n = band.shape[0]
    local = np.full(n + border.shape[1], -1, dtype=np.int64)
    seen = np.zeros(columns.shape[0], dtype=np.bool_)
    images = np.empty(columns.shape[0], dtype=np.int64)
    firsts = np.empty(n + border.shape[1], dtype=np.int64)
    width_at = np.zeros(n + border.shape[1], dtype=np.int64)
    place = np.empty(n + border.shape[1], dtype=np.int64)
    total = 0.0
    for group in range(len(bounds) - 1):
        num_images, num_firsts = 0, 0
        for m in range(bounds[group], bounds[group + 1]):
            p = members[m]
            for k in range(tracks.start[p], tracks.start[p + 1]):
                i = tracks.image[k]
                if seen[i]:
                    continue
                seen[i] = True
                images[num_images] = i
                num_images += 1
                for slot in range(NUM_SLOTS):
                    column = columns[i, slot]
                    if column >= 0 and local[column] < 0:
                        local[column] = 0
                        firsts[num_firsts] = column
                        width_at[column] = widths[slot]
                        num_firsts += 1
        # By rising column of the whole: then the upper triangle of the one is in that of the other.
        order = np.sort(firsts[:num_firsts])
        size = 0
        for column in order:
            local[column] = size
            for j in range(width_at[column]):
                place[size + j] = column + j
            size += width_at[column]
        for a in range(num_images):
            i = images[a]
            seen[i] = False
            for slot in range(NUM_SLOTS):
                views.columns[i, slot] = local[columns[i, slot]] if columns[i, slot] >= 0 else -1
        matrix, slope = np.zeros((size, size)), np.zeros(size)
        first = bounds[group]
        rows = np.zeros((3 * (bounds[group + 1] - first), size))
        for m in range(first, bounds[group + 1]):
            p, at = members[m], 3 * (m - first)
            total += reduce(
                points, hold_points, anchors, p, p + 1, tracks, views, optics, loss, scale, matrix, slope,
                rows[at : at + 3], False,
            )  # fmt: skip
        # Nearly every point is seen by most of the group's images: one product of full matrices is the faster.
        matrix -= np.dot(rows.T, rows)
        for column in order:
            local[column] = -1
        for a in range(size):
            row = place[a]
            gradient[row] += slope[a]
            for b in range(a, size):
                column = place[b]
                if column < n:
                    band[row, column - row] += matrix[a, b]
                elif row < n:
                    border[row, column - n] += matrix[a, b]
                else:
                    corner[row - n, column - n] += matrix[a, b]
    return total
