"""Where the nodes of the reference image are in another image: optical flow about what the geometry predicts.

1. The sparse points, projected into both images through their interfaces, predict the flow: a smooth field. So the
   camera may have moved, turned and come closer.
2. The other image, pulled straight by that field, differs from the reference by little: dense flow finds it.
3. Pulled straight by both, it differs by a fraction of a pixel, which Lucas and Kanade's method finds at each node.
4. The checks: forth and back again, and correlation.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.dense.grid import Grid
from colmap_refract.dense.options import DenseOptions
from colmap_refract.interface import Array
from colmap_refract.optical_flow.estimate import dense_flow, lucas_kanade
from colmap_refract.optical_flow.field import Field, fit_field
from colmap_refract.optical_flow.frame import MIN_TRACKS
from colmap_refract.optical_flow.pictures import level, match_sharpness
from colmap_refract.photographs.images import Gray

_LEAST_WINDOW = 21  # pixels, that pictures are levelled over and compared for their sharpness
_PREDICTION_SPACING = 12.0  # pixels between nodes of the predicted field, in pictures up to _COMMON_SIDE wide
_COMMON_SIDE = 1000
_LEVELS = 1
_SAMPLE = 4000  # nodes that sharpness is compared at, at most
_AT_ONCE = 100_000  # nodes
_LEAST_CONTRAST = 1.0  # grey values; what is smoother is equal to anything


def predict(places: Array, others: Array, width: int, height: int) -> Field | None:
    """The flow of the whole reference that points predict.

    Args:
        places, others: (n, 2) pixels of points in the reference and in the other image, of one origin; NaN where a
            point is not seen.
        width, height: of the reference.

    Returns:
        None where too few points are seen in both.
    """
    sound = np.isfinite(places).all(axis=1) & np.isfinite(others).all(axis=1)
    if sound.sum() < MIN_TRACKS:
        return None
    spacing = _PREDICTION_SPACING * max(1.0, max(width, height) / _COMMON_SIDE)
    at, moved = places[sound], (others - places)[sound]
    # What a turn of the camera does is no bend of the field, which is taken to be stiff where points are lacking.
    trend = np.linalg.lstsq(np.column_stack([at, np.ones(len(at))]), moved, rcond=None)[0]
    rest = fit_field(at, moved - at @ trend[:2] - trend[2], (height, width), spacing=spacing).displacements
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    return Field(np.stack([rest[..., k] + trend[0, k] * x + trend[1, k] * y + trend[2, k] for k in (0, 1)], axis=-1))


def match(reference: Gray, frame: Gray, grid: Grid, predicted: Field, options: DenseOptions) -> Array:
    """Where the nodes are in another image.

    Args:
        reference: (H, W).
        frame: the other image, of any size.
        grid: of the reference.
        predicted: flow of the reference's pixels to about where they are in the frame.
        options: how.

    Returns:
        (rows * columns, 2), OpenCV's pixels; NaN where a node was not found.
    """
    half = max(options.half_window, _LEAST_WINDOW // 2)
    nodes = grid.nodes
    rough = dense_flow(level(reference, half), level(predicted.straighten(frame), half), np.eye(2, 3))
    field = predicted.after(rough)
    few = nodes[:: -(-len(nodes) // _SAMPLE)]
    sharp, straight = match_sharpness(reference, field.straighten(frame), few, half)
    flat, flat_straight = level(sharp, half), level(straight, half)
    found = np.full(nodes.shape, np.nan)
    for first in range(0, len(nodes), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        found[rows] = _refined(flat, flat_straight, nodes[rows], options)
    lost = ~np.isfinite(found).all(axis=1)
    fine = grid.field(np.where(lost[:, None], 0.0, found - nodes))
    alike = local_correlation(sharp, fine.straighten(straight), options.half_window)
    column, row = nodes.astype(np.int64).T
    lost |= ~(alike[row, column] >= options.min_correlation)
    found[lost] = np.nan
    good = np.flatnonzero(~lost)
    found[good] += field.at(found[good])
    inside = (found >= options.half_window) & (found <= np.array(frame.shape[::-1]) - 1 - options.half_window)
    found[~inside.all(axis=1)] = np.nan
    return found


def _refined(flat: Gray, straight: Gray, nodes: Array, options: DenseOptions) -> Array:
    """Nodes (n, 2) in the picture pulled straight; NaN where they lead elsewhere or not back."""
    there, forth = lucas_kanade(flat, straight, nodes, nodes, options.window_size, _LEVELS)
    back, returned = lucas_kanade(straight, flat, there, there, options.window_size, _LEVELS)
    keep = forth & returned & (np.linalg.norm(back - nodes, axis=1) <= options.max_error)
    # Farther, and it is something else.
    keep &= np.linalg.norm(there - nodes, axis=1) <= options.half_window / 2
    return np.where(keep[:, None], there, np.nan)


def local_correlation(first: Gray, second: Gray, half_window: int) -> Array:
    """Normalised correlation (H, W) of the squares around each pixel of two pictures; 0 where one has no contrast."""
    size = (2 * half_window + 1, 2 * half_window + 1)

    def mean(values: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(cv2.boxFilter(values, cv2.CV_32F, size, borderType=cv2.BORDER_REFLECT_101))

    # About the middle of the scale, for the digits of single precision.
    a, b = (picture.astype(np.float32) - np.float32(128) for picture in (first, second))
    mean_a, mean_b = mean(a), mean(b)
    norm = np.sqrt(np.maximum(mean(a * a) - mean_a**2, 0) * np.maximum(mean(b * b) - mean_b**2, 0))
    result = mean(a * b) - mean_a * mean_b
    return np.where(norm > _LEAST_CONTRAST, result / np.maximum(norm, _LEAST_CONTRAST), 0.0)
