"""One frame: where points of the reference are in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_refract.interface import Array
from colmap_refract.optical_flow.estimate import affine_start, estimate, lucas_kanade
from colmap_refract.optical_flow.field import fit_field
from colmap_refract.optical_flow.options import FlowOptions
from colmap_refract.optical_flow.pictures import correlation, level, match_sharpness
from colmap_refract.photographs.images import Gray

Index = NDArray[np.int64]

MIN_TRACKS = 15
"""A frame with fewer has lost the track: COLMAP's `min_num_matches`."""
_FIRST_ERROR = 1.0  # pixels that the first flow may lead back off, in pictures up to _COMMON_SIDE wide
_COMMON_SIDE = 1000
_FIELD_SPACING = 0.6  # of the window
_REFINED_LEVELS = 1
_MOST_ROUNDS = 4
_COMPLETE = 0.9  # of the points in sight; then the field needs no more tracks
_GAIN = 1.02  # in tracks, for which the field is made once more


@dataclass(frozen=True, kw_only=True)
class FrameFlow:
    """How well the reference's points were found in one frame. Lengths in pixels, NaN where nothing was."""

    num_points: int
    """That were sought."""
    num_tracks: int
    """That were found and kept; 0 where the track is lost."""
    length: float
    """Median length of the flow."""
    error: float
    """Median distance between a point and where the first flow, forth and back, leads. That of the refined tracks is
    next to nothing, whether they are right or not; their error is some hundredths of a pixel where `correlation` is
    near 1."""
    correlation: float
    """Median."""


@dataclass(frozen=True, kw_only=True)
class _Refined:
    """Which points were found with a field, and where."""

    rows: Index
    places: Array
    """(n, 2), of these points in the frame."""
    alike: Array
    """(n,) correlations."""
    in_sight: int
    """Number of points that the field puts inside the frame."""


def track_frame(reference: Gray, frame: Gray, points: Array, options: FlowOptions) -> tuple[Index, Array, FrameFlow]:
    """Find points of the reference in a frame.

    Args:
        reference, frame: (H, W), of one size.
        points: (P, 2) in the reference, OpenCV's pixels, farther from its edge than half of the window.
        options: how.

    Returns:
        Rows of `points` that were found (n,), where (n, 2), OpenCV's pixels, and how well. None where fewer than
        MIN_TRACKS were.
    """
    flat_reference, flat_frame = (level(picture, options.half_window) for picture in (reference, frame))
    rough, off = estimate(
        flat_reference,
        flat_frame,
        points,
        affine_start(reference, frame),
        method=options.method,
        window_size=options.window_size,
    )
    good = np.flatnonzero(off <= _FIRST_ERROR * max(1.0, max(frame.shape) / _COMMON_SIDE))
    if len(good) < MIN_TRACKS:
        return _lost(points)
    refined = _refine(reference, frame, points, good, rough[good], options)
    # Where waves are steep, the first flow fails in places, which a field through the refined tracks reaches.
    for _ in range(_MOST_ROUNDS - 1):
        if not MIN_TRACKS <= len(refined.rows) < _COMPLETE * refined.in_sight:
            break
        again = _refine(reference, frame, points, refined.rows, refined.places, options)
        if len(again.rows) <= len(refined.rows):
            break
        enough = len(again.rows) < _GAIN * len(refined.rows)
        refined = again
        if enough:
            break
    if len(refined.rows) < MIN_TRACKS:
        return _lost(points)
    errors = off[np.intersect1d(refined.rows, good)]
    flow = FrameFlow(
        num_points=len(points),
        num_tracks=len(refined.rows),
        length=float(np.median(np.linalg.norm(refined.places - points[refined.rows], axis=1))),
        error=float(np.median(errors)) if len(errors) else float("nan"),
        correlation=float(np.median(refined.alike)),
    )
    return refined.rows, refined.places, flow


def _refine(reference: Gray, frame: Gray, points: Array, known: Index, places: Array, options: FlowOptions) -> _Refined:
    """Find all points in the frame, pulled straight by the field through `places` (n, 2) of the `known` ones."""
    window, half = options.window_size, options.half_window
    field = fit_field(points[known], places - points[known], frame.shape, spacing=_FIELD_SPACING * window)
    sharp, straight = match_sharpness(reference, field.straighten(frame), points[known], half)
    flat, flat_straight = level(sharp, half), level(straight, half)
    there, forth = lucas_kanade(flat, flat_straight, points, points, window, _REFINED_LEVELS)
    back, returned = lucas_kanade(flat_straight, flat, there, there, window, _REFINED_LEVELS)
    alike = correlation(sharp, straight, points, there, half)
    result = there + field.at(there)
    keep = forth & returned & (np.linalg.norm(back - points, axis=1) <= options.max_error)
    keep &= alike >= options.min_correlation
    # Farther, and it is another corner; nearer to the edge, and the square is not in the frame.
    keep &= np.linalg.norm(there - points, axis=1) <= half / 2
    keep &= _inside(result, frame, half)
    rows = np.flatnonzero(keep)
    in_sight = int(_inside(points + field.at(points), frame, half).sum())
    return _Refined(rows=rows, places=result[rows], alike=alike[rows], in_sight=in_sight)


def _inside(points: Array, frame: Gray, margin: int) -> NDArray[np.bool_]:
    """Which points (P, 2) are at least so far from the frame's edge."""
    size = np.array(frame.shape[::-1])
    return np.asarray(((points >= margin) & (points <= size - 1 - margin)).all(axis=1))


def _lost(points: Array) -> tuple[Index, Array, FrameFlow]:
    nan = float("nan")
    flow = FrameFlow(num_points=len(points), num_tracks=0, length=nan, error=nan, correlation=nan)
    return np.zeros(0, np.int64), np.zeros((0, 2)), flow
