"""A first estimate of where points of the reference frame are in another, up to a quarter of the picture away."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.interface import Array
from colmap_refract.optical_flow.field import Field
from colmap_refract.optical_flow.options import FlowMethod
from colmap_refract.photographs.images import Gray, shrink

_COARSE_SIDE = 192  # pixels of the copies that the affine start is sought in, where waves and blur are small
_TILES = (7, 5)  # along the longer and the shorter side
_TILE = 0.2  # of the longest side
_REACH = 0.25  # of the longest side, how far a tile is sought
_FAR = 0.1  # what a tile at the end of its reach must correlate more: of tiles in a pattern the nearest is right
_MIN_CORRELATION = 0.4  # of a tile
_TOLERANCE = 4.0  # pixels of the copies, that a tile may be off the affine map
_MIN_TILES = 5  # that agree; three always do
_LEVELS = 4
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.005)
_DENSE_SIDE = 1000  # pixels of the copies that dense flow is found in; the refinement does the rest


def affine_start(reference: Gray, frame: Gray) -> Array:
    """The affine map (2, 3) from the reference's to the frame's pixels that most tiles of a small copy agree on.

    A surface that tilts by some degrees shifts the picture by up to a fifth of its width. Found by normalised
    correlation of tiles and RANSAC; the identity where too few tiles agree.
    """
    scale = min(1.0, _COARSE_SIDE / max(reference.shape))
    a, b = shrink(reference, _COARSE_SIDE), shrink(frame, _COARSE_SIDE)
    height, width = a.shape
    tile = max(8, round(_TILE * max(a.shape)))
    reach = round(_REACH * max(a.shape))
    identity = np.eye(2, 3)
    if min(height, width) < tile:
        return identity
    # A map may lead out of the frame: what is not there correlates with nothing.
    padded = cv2.copyMakeBorder(b, reach, reach, reach, reach, cv2.BORDER_REFLECT_101)
    steps = np.arange(-reach, reach + 1)
    penalty = _FAR * np.hypot(*np.meshgrid(steps, steps)) / reach
    across, down = _TILES if width >= height else _TILES[::-1]
    here, there = [], []
    for y in np.linspace(0, height - tile, down).round().astype(int):
        for x in np.linspace(0, width - tile, across).round().astype(int):
            around = padded[y : y + tile + 2 * reach, x : x + tile + 2 * reach]
            scores = cv2.matchTemplate(around, a[y : y + tile, x : x + tile], cv2.TM_CCOEFF_NORMED)
            row, column = np.unravel_index(int((scores - penalty).argmax()), scores.shape)
            if scores[row, column] >= _MIN_CORRELATION:
                here.append((x, y))
                there.append((x + column - reach, y + row - reach))
    if len(here) < _MIN_TILES:
        return identity
    # Pixel centres of the copies are at whole numbers plus a half, in units that scale.
    centre = (tile - 1) / 2
    source, target = ((np.array(corners, float) + centre + 0.5) / scale - 0.5 for corners in (here, there))
    cv2.setRNGSeed(0)
    affine, agree = cv2.estimateAffine2D(source, target, ransacReprojThreshold=_TOLERANCE / scale, maxIters=2000)
    if affine is None or agree.sum() < _MIN_TILES or np.linalg.det(affine[:, :2]) <= 0:
        return identity
    return np.asarray(affine, float)


def estimate(
    reference: Gray, frame: Gray, points: Array, affine: Array, *, method: FlowMethod, window_size: int
) -> tuple[Array, Array]:
    """Positions (P, 2) in the frame of points (P, 2) of the reference, to about a pixel.

    Args:
        reference, frame: pictures of one size, levelled.
        points: (P, 2) in the reference.
        affine: map (2, 3) to begin from.
        method: dense flow, or Lucas and Kanade's pyramids at the points.
        window_size: of the latter, pixels.

    Returns:
        The positions, and how far off the points the flow back from there leads (P,), pixels: infinite where nothing
        was found or it is outside the frame.
    """
    inverse = np.asarray(cv2.invertAffineTransform(affine), float)
    there: Array
    if method == "dense":
        there = points + dense_flow(reference, frame, affine).at(points)
        back = there + dense_flow(frame, reference, inverse).at(there)
        found = np.ones(len(points), dtype=bool)
    else:
        there, forth = lucas_kanade(reference, frame, points, _mapped(affine, points), window_size, _LEVELS)
        back, returned = lucas_kanade(frame, reference, there, _mapped(inverse, there), window_size, _LEVELS)
        found = forth & returned
    size = np.array(frame.shape[::-1])
    found &= ((there >= 0) & (there <= size - 1)).all(axis=1)
    return there, np.where(found, np.linalg.norm(back - points, axis=1), np.inf)


def lucas_kanade(
    first: Gray, second: Gray, points: Array, start: Array, window_size: int, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Positions (P, 2) of points (P, 2) by Lucas and Kanade's method, and which were found (P,).

    Args:
        first, second: pictures of one size.
        points: (P, 2), in the first.
        start: (P, 2), in the second, to begin from.
        window_size: pixels.
        levels: halvings of the pictures before.
    """
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        points.astype(np.float32),
        start.astype(np.float32),
        winSize=(window_size, window_size),
        maxLevel=levels,
        criteria=_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(there, float), np.asarray(found).ravel() == 1


def dense_flow(first: Gray, second: Gray, affine: Array) -> Field:
    """Flow of the whole picture, to about a pixel.

    Args:
        first, second: pictures of one size, levelled.
        affine: map (2, 3) to begin from.
    """
    height, width = first.shape
    first, second = shrink(first, _DENSE_SIDE), shrink(second, _DENSE_SIDE)
    y, x = np.mgrid[0 : first.shape[0], 0 : first.shape[1]]
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    ratio = np.array([width, height]) / first.shape[::-1]
    start = (_mapped(affine, (pixels + 0.5) * ratio - 0.5) + 0.5) / ratio - 0.5 - pixels
    flow = start.reshape(*first.shape, 2).astype(np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(first, second, flow)
    if first.shape != (height, width):
        flow = cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR) * ratio.astype(np.float32)
    return Field(np.asarray(flow))


def _mapped(affine: Array, points: Array) -> Array:
    return points @ affine[:, :2].T + affine[:, 2]
