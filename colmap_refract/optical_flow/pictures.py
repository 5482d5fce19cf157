"""Pictures made comparable: the same brightness, the same contrast, the same sharpness; and how well they then agree.

Points are in OpenCV's pixels in this folder: the centre of the top-left pixel is at (0, 0).
"""

from __future__ import annotations

import cv2
import numpy as np

from colmap_refract.interface import Array
from colmap_refract.photographs.images import Gray

_CONTRAST = 42.0  # grey values of a standard deviation: three fit into 8 bits
_NOISE = 4.0  # grey values; contrast below is not raised to the full
_BLURS = (0.7, 1.0, 1.4, 2.0, 2.8)
"""Pixels, what is tried to make a sharp picture like a blurred one."""
_MIN_GAIN = 1e-3  # of the correlation, for which a picture is blurred
_PATCHES_AT_ONCE = 4096
_SAMPLE = 300  # points at which sharpness is compared


def level(gray: Gray, scale: float) -> Gray:
    """A picture (H, W) whose brightness and contrast are the same everywhere.

    Light that changes from frame to frame (clouds, caustics, reflections) would otherwise pull Lucas and Kanade's
    method, which takes brightness for constant, aside.

    Args:
        gray: (H, W).
        scale: standard deviation of the Gaussian neighbourhood, pixels.
    """
    values = gray.astype(np.float32)
    values -= cv2.GaussianBlur(values, (0, 0), scale)
    contrast = np.sqrt(cv2.GaussianBlur(values * values, (0, 0), scale))
    values *= _CONTRAST / (contrast + _NOISE)
    return np.asarray(np.clip(np.rint(values + 128), 0, 255), np.uint8)


def correlation(first: Gray, second: Gray, first_points: Array, second_points: Array, half_window: int) -> Array:
    """Normalised correlation (P,) of the squares around points (P, 2) of two pictures; 0 where one has no contrast."""
    side = np.arange(-half_window, half_window + 1)
    offsets = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    result = np.zeros(len(first_points))
    # OpenCV's remap takes no more than 32767 rows.
    for begin in range(0, len(first_points), _PATCHES_AT_ONCE):
        rows = slice(begin, begin + _PATCHES_AT_ONCE)
        a, b = (
            _centred(picture, points[rows, None] + offsets)
            for picture, points in ((first, first_points), (second, second_points))
        )
        norm = np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1))
        np.divide((a * b).sum(axis=1), norm, out=result[rows], where=norm > 0)
    return result


def _centred(picture: Gray, places: Array) -> Array:
    x, y = (np.ascontiguousarray(places[..., k], np.float32) for k in (0, 1))
    values = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101).astype(np.float64)
    return np.asarray(values - values.mean(axis=1, keepdims=True))


def match_sharpness(first: Gray, second: Gray, points: Array, half_window: int) -> tuple[Gray, Gray]:
    """Two pictures of the same, the sharper one blurred to be most like the other.

    Waves blur frames differently. A corner that is blurred in one picture only moves by a tenth of a pixel and more.

    Args:
        first, second: (H, W), aligned to about a pixel.
        points: (P, 2), where they are compared.
        half_window: of the squares that are compared, pixels.
    """
    if not len(points):
        return first, second
    few = points[:: -(-len(points) // _SAMPLE)]

    def agreement(a: Gray, b: Gray) -> float:
        return float(np.median(correlation(a, b, few, few, half_window)))

    best, agreed = (first, second), agreement(first, second) + _MIN_GAIN
    for blurs_first in (True, False):
        for blur in _BLURS:
            a = _blurred(first, blur) if blurs_first else first
            b = second if blurs_first else _blurred(second, blur)
            now = agreement(a, b)
            if now <= agreed:
                break  # more makes it worse still
            best, agreed = (a, b), now
    return best


def _blurred(picture: Gray, sigma: float) -> Gray:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma), np.uint8)
