"""What the neighbours on the reference's grid say of a point: its normal, and whether its depth is far off."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.interface import Array

Mask = NDArray[np.bool_]

_NORMAL_REACH = 3  # nodes to each side, that a plane is laid through
_LEAST_NEIGHBOURS = 8  # of 49
_MEDIAN_REACH = 2
_LEAST_DEPTHS = 5  # of 25
_STRIP = 64  # rows


def near_median(depth: Array, max_depth_error: float) -> Mask:
    """Which nodes (rows, columns) have a depth near the median of the 5 x 5 nodes about them.

    Args:
        depth: (rows, columns), NaN where there is no point.
        max_depth_error: part of the depth that it may differ by.

    Returns:
        False also where there are fewer than five neighbours with a depth: a speck.
    """
    rows, columns = depth.shape
    reach = _MEDIAN_REACH
    padded = np.pad(depth, reach, constant_values=np.nan)
    result = np.zeros(depth.shape, dtype=np.bool_)
    for top in range(0, rows, _STRIP):
        bottom = min(top + _STRIP, rows)
        around = np.sort(  # NaN at the end
            np.stack([
                padded[top + j : bottom + j, i : i + columns]
                for j in range(2 * reach + 1) for i in range(2 * reach + 1)
            ]),
            axis=0,
        )  # fmt: skip
        count = np.isfinite(around).sum(axis=0)
        middle = np.take_along_axis(around, (np.maximum(count, 1)[None] - 1) // 2, axis=0)[0]
        with np.errstate(invalid="ignore"):
            near = np.abs(depth[top:bottom] - middle) <= max_depth_error * middle
        result[top:bottom] = near & (count > _LEAST_DEPTHS)
    return result


def normals(points: Array, toward: Array) -> Array:
    """Unit normals of the surface that points on a grid lie on, turned to face the camera.

    Each is that of the plane nearest to the points of the 7 x 7 nodes about it.

    Args:
        points: (rows, columns, 3), NaN where there is none.
        toward: (rows, columns, 3) directions of the rays from the camera to the points.

    Returns:
        (rows, columns, 3); NaN where there is no point, or fewer than eight about it.
    """
    shape = points.shape[:2]
    there: Mask = np.asarray(np.isfinite(points).all(axis=2))
    result = np.full(points.shape, np.nan)
    if not there.any():
        return result
    middle = points[there].mean(axis=0)
    # About the middle, and filled with nothing, for sums over windows to keep their digits.
    local = np.where(there[..., None], points - middle, 0.0)

    def total(values: NDArray[Any]) -> Array:
        side = 2 * _NORMAL_REACH + 1
        return np.asarray(
            cv2.boxFilter(
                np.ascontiguousarray(values), cv2.CV_64F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
            )
        )

    count = total(there.astype(np.float64))
    usable = there & (count >= _LEAST_NEIGHBOURS)
    number = count[usable]
    mean = np.stack([total(local[..., a])[usable] for a in range(3)], axis=1) / number[:, None]
    spread = np.empty((len(number), 3, 3))
    for a in range(3):
        for b in range(a, 3):
            moment = total(local[..., a] * local[..., b])[usable] / number - mean[:, a] * mean[:, b]
            spread[:, a, b] = spread[:, b, a] = moment
    normal = np.linalg.eigh(spread)[1][:, :, 0]
    away = np.einsum("ni,ni->n", normal, toward.reshape(*shape, 3)[usable]) > 0
    normal[away] *= -1
    result[usable] = normal
    return result
