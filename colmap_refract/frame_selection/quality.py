"""How good a frame is by itself: features and sharpness, measured in small copies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.interface import Array
from colmap_refract.photographs.images import Gray, shrink

SMALL_SIDE = 640
"""Longest side of the copy that features and flow are found in, pixels: enough for which frame to choose."""
_SHARP_SIDE = 1600  # a blur that this copy does not show costs keypoints little
_NOISE_SIGMA = 1.5  # of the smoothing, pixels, that keeps noise from passing for sharpness

# Fractions of what good frames have: of the upper quartile, so that many bad frames do not lower it.
_MIN_SHARPNESS = 0.65
_MIN_FEATURES = 0.35
_QUARTILE = 75

Rejection = Literal["blurred", "few features"]


@dataclass(frozen=True, kw_only=True)
class Quality:
    """What was measured of one frame."""

    num_features: int
    """SIFT features in the small copy."""
    sharpness: float
    """Standard deviation of the smoothed image's Laplacian over that of the image: brightness and contrast cancel."""


@dataclass(frozen=True, kw_only=True)
class Grades:
    """Frames beside each other; arrays (K,)."""

    features: Array
    """Features as a fraction of what good frames have, at most 1."""
    sharpness: Array
    """Sharpness as a fraction of what good frames have, at most 1."""
    rejections: list[tuple[Rejection, str] | None]
    """Why a frame cannot be used, in a word and in numbers; None if it can."""


def measure(gray: Gray, small: Gray) -> Quality:
    """Features and sharpness of a frame.

    Args:
        gray: the frame.
        small: its copy, shrunk to `SMALL_SIDE`.
    """
    smoothed = cv2.GaussianBlur(shrink(gray, _SHARP_SIDE).astype(np.float32), (0, 0), _NOISE_SIGMA)
    contrast = float(smoothed.std())
    return Quality(
        num_features=len(cv2.SIFT.create().detect(small)),
        # Below one grey value there is only noise.
        sharpness=float(cv2.Laplacian(smoothed, cv2.CV_32F).std()) / contrast if contrast > 1 else 0.0,
    )


def grade(qualities: list[Quality], *, min_num_features: int, window: int | None) -> Grades:
    """Compare frames, and say which cannot be used.

    Args:
        qualities: of K frames in their order.
        min_num_features: a frame with fewer cannot be used.
        window: number of neighbours on either side that a frame is compared with, where what is in view changes
            along the frames; None compares all.

    Returns:
        Grades, and why frames that are blurred or empty cannot be used.
    """
    features = np.array([quality.num_features for quality in qualities], float)
    sharpness = np.array([quality.sharpness for quality in qualities], float)
    # Frames that show nothing say nothing of what good ones have.
    shown = features >= min_num_features
    of_features = _fraction_of_good(features, shown, window)
    of_sharpness = _fraction_of_good(sharpness, shown, window)
    rejections: list[tuple[Rejection, str] | None] = []
    for count, part, sharp in zip(features, of_features, of_sharpness, strict=True):
        # Blur takes the features as well; a frame of one colour has no sharpness at all.
        if 0 < sharp < _MIN_SHARPNESS:
            rejections.append(("blurred", f"{100 * sharp:.0f} % of the sharpness of good frames"))
        elif count < min_num_features:
            rejections.append(("few features", f"{count:.0f} features, fewer than {min_num_features}"))
        elif part < _MIN_FEATURES:
            rejections.append(("few features", f"{count:.0f} features, {100 * part:.0f} % of what good frames have"))
        else:
            rejections.append(None)
    return Grades(features=np.minimum(of_features, 1), sharpness=np.minimum(of_sharpness, 1), rejections=rejections)


def _fraction_of_good(values: Array, shown: NDArray[np.bool_], window: int | None) -> Array:
    fractions = np.zeros(len(values))
    for k, value in enumerate(values):
        near = slice(None) if window is None else slice(max(0, k - window), k + window + 1)
        good = values[near][shown[near]]
        level = np.percentile(good, _QUARTILE) if len(good) else 0.0
        fractions[k] = value / level if level > 0 else 0.0
    return fractions
