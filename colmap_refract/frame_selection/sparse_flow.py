"""Sparse optical flow between small copies of frames, and the smooth field that it follows."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.interface import Array
from colmap_refract.photographs.images import Gray

Points = NDArray[np.float32]
"""Shape (P, 2), pixels of the small copies; only differences matter, so that the origin does not."""

_MAX_POINTS = 300
_SPACING = 1 / 32  # of the longest side, between points: all parts of the picture count
_POINT_QUALITY = 1e-3  # of the best corner's: a reflection must not drive out everything else
_WINDOW = (21, 21)
_LIGHT = (31, 31)  # pixels; light changes little within
_LEAST_CONTRAST = 5.0  # grey values
_LEVELS = 4
_MAX_RETURN = 1.0  # pixels between a point and where tracking forth and back leads
_MAX_MATCHED = 500  # features
_MATCH_RATIO = 0.8  # Lowe's
_EPIPOLAR_DISTANCE = 2.0  # pixels
_MIN_MATCHES = 20  # that agree; chance brings about a dozen to agree
_FIT_ROUNDS = 5


@dataclass(frozen=True, kw_only=True)
class AffineField:
    """The affine flow nearest to a sparse one, robustly."""

    coefficients: Array
    """(6,), pixels: the mean flow (u, v), then its change from the centre to 1/sqrt(3) of the way to the right edge,
    (u, v), and to the lower edge, (u, v). The norm of a difference is the root mean square over the picture of that
    of two fields."""
    residual: float
    """Median distance of the flow from the field, pixels: depth, waves, errors."""

    @property
    def rms(self) -> float:
        """Root mean square of the field over the picture, pixels."""
        return float(np.linalg.norm(self.coefficients))


def flatten(small: Gray) -> Gray:
    """The picture without its light: local mean and contrast made the same everywhere.

    Tracking compares grey values, and waves and clouds change the light. Where there is hardly any contrast, noise is
    not raised to the level of texture.
    """
    values = small.astype(np.float32)
    mean = cv2.blur(values, _LIGHT)
    variance = np.maximum(cv2.blur(values * values, _LIGHT) - mean * mean, 0)
    contrast = (values - mean) / np.sqrt(variance + _LEAST_CONTRAST**2)
    return np.asarray(np.clip(128 + 40 * contrast, 0, 255), np.uint8)


def corners(small: Gray) -> Points:
    """Points that can be tracked, (P, 2), spread over a picture by `flatten`; P is zero without any."""
    spacing = max(3.0, _SPACING * max(small.shape))
    found = cv2.goodFeaturesToTrack(small, _MAX_POINTS, _POINT_QUALITY, spacing)
    return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2).astype(np.float32)


def track(first: Gray, second: Gray, points: Points) -> Points:
    """Where points of one picture are in another, by Lucas and Kanade's method on pyramids, forth and back.

    Args:
        first: picture of `points`, by `flatten`.
        second: picture of the same size, by `flatten`.
        points: (P, 2).

    Returns:
        (P, 2); NaN where a point was not found, does not lead back to where it came from, or is NaN in `points`.
    """
    result = np.full_like(points, np.nan)
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(known) == 0:
        return result
    start, nothing = np.ascontiguousarray(points[known]), np.empty(0, np.float32)
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, nothing, winSize=_WINDOW, maxLevel=_LEVELS)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, there, nothing, winSize=_WINDOW, maxLevel=_LEVELS)
    size = np.array(second.shape[::-1])
    good = (found.ravel() == 1) & (returned.ravel() == 1) & (np.linalg.norm(back - start, axis=1) <= _MAX_RETURN)
    good &= ((there >= 0) & (there <= size - 1)).all(axis=1)
    result[known[good]] = there[good]
    return result


def match(first: Gray, second: Gray) -> tuple[Points, Points]:
    """Corresponding points (M, 2) in two pictures by SIFT, for motions that are too long to be tracked.

    Those are left that agree on epipolar lines, which refraction bends by little.
    """
    sift = cv2.SIFT.create(nfeatures=_MAX_MATCHED)
    (keypoints1, descriptors1), (keypoints2, descriptors2) = (sift.detectAndCompute(g, None) for g in (first, second))
    if descriptors1 is None or descriptors2 is None or len(keypoints2) < 2:
        return np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32)
    pairs = cv2.BFMatcher().knnMatch(descriptors1, descriptors2, 2)
    good = [near for near, next_best in pairs if near.distance < _MATCH_RATIO * next_best.distance]
    here = np.array([keypoints1[m.queryIdx].pt for m in good], np.float32).reshape(-1, 2)
    there = np.array([keypoints2[m.trainIdx].pt for m in good], np.float32).reshape(-1, 2)
    if len(good) < _MIN_MATCHES:
        return here[:0], there[:0]
    _, agrees = cv2.findFundamentalMat(here, there, cv2.FM_RANSAC, _EPIPOLAR_DISTANCE, 0.999)
    kept = np.zeros(len(good), bool) if agrees is None else agrees.ravel() == 1
    return (here[kept], there[kept]) if kept.sum() >= _MIN_MATCHES else (here[:0], there[:0])


def tracked_fraction(tracked: Points) -> float:
    """How many of the points were found, 0 to 1."""
    return float(np.isfinite(tracked).all(axis=1).mean()) if len(tracked) else 0.0


def median_length(points: Points, tracked: Points) -> float:
    """Median length of the flow, pixels; NaN if nothing was tracked."""
    lengths = np.linalg.norm(tracked - points, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return float(np.median(lengths)) if len(lengths) else float("nan")


def affine_field(points: Points, tracked: Points, shape: tuple[int, ...]) -> AffineField:
    """Fit an affine field to a flow, by least squares that are weighted anew to the least absolute deviation.

    Args:
        points: (P, 2).
        tracked: (P, 2), of which at least three must not be NaN; otherwise the field is zero and its residual infinite.
        shape: (H, W) of the pictures.
    """
    known = np.isfinite(tracked).all(axis=1)
    if known.sum() < 3:
        return AffineField(coefficients=np.zeros(6), residual=float("inf"))
    half = np.array(shape[::-1]) / 2
    # Over the picture, these two have a mean square of one.
    basis = np.column_stack([np.ones(known.sum()), np.sqrt(3) * (points[known] - half) / half])
    flow = (tracked - points)[known].astype(float)
    weights = np.ones(len(flow))
    for _ in range(_FIT_ROUNDS):
        root = np.sqrt(weights)[:, None]
        coefficients = np.linalg.lstsq(root * basis, root * flow, rcond=None)[0]
        errors = np.linalg.norm(flow - basis @ coefficients, axis=1)
        weights = 1 / np.maximum(errors, 0.1)  # a tenth of a pixel is noise
    return AffineField(coefficients=coefficients.ravel(), residual=float(np.median(errors)))
