"""A picture of how the views cover the image: how many there are where, each corner with its error, what is bare."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.calibration.calibration import Calibration
from colmap_refract.calibration.coverage import Coverage

Picture = NDArray[np.uint8]

_WIDTH, _HEIGHT = 1200, 900  # px, of the image inside the picture, at most
_FONT = cv2.FONT_HERSHEY_DUPLEX
_MARGIN, _TOP, _BOTTOM = 40, 92, 118
# Blue, green, red.
_INK, _FAINT, _PAPER, _BARE, _STRIPE = (60, 50, 45), (140, 132, 126), (255, 255, 255), (238, 238, 246), (196, 196, 232)
_FEW, _MANY = np.array([250.0, 240.0, 226.0]), np.array([190.0, 146.0, 98.0])


def draw_coverage(calibration: Calibration, coverage: Coverage) -> Picture:
    """Draw the coverage of an image.

    Args:
        calibration: whose corners are drawn, those of dropped views as crosses.
        coverage: of its kept views.

    Returns:
        (H, W, 3), blue, green, red.
    """
    camera = calibration.camera
    scale = min(_WIDTH / camera.width, _HEIGHT / camera.height)
    width, height = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    total = max(width, 760) + 2 * _MARGIN
    canvas = np.full((_TOP + height + _BOTTOM, total, 3), 255, np.uint8)
    left = (total - width) // 2
    canvas[_TOP : _TOP + height, left : left + width] = _shade(coverage.counts, width, height)
    cv2.rectangle(canvas, (left - 1, _TOP - 1), (left + width, _TOP + height), _FAINT, 1, cv2.LINE_AA)

    # Of COLMAP's pixels the edge of the image is 0, of OpenCV's -0.5.
    origin = np.array([left, _TOP]) - 0.5
    kept = calibration.kept
    largest = float(np.quantile(np.concatenate([fit.errors for fit in kept]), 0.98))
    for fit in calibration.views:
        if fit.dropped:
            for xy in origin + scale * fit.view.xy:
                cv2.drawMarker(canvas, _whole(xy), _FAINT, cv2.MARKER_TILTED_CROSS, 7, 1, cv2.LINE_AA)
    # The largest errors last, on top.
    dots = np.concatenate([origin + scale * fit.view.xy for fit in kept])
    errors = np.concatenate([fit.errors for fit in kept])
    order = np.argsort(errors)
    for xy, color in zip(dots[order], _error_colors(errors[order] / max(largest, 1e-12)), strict=True):
        cv2.circle(canvas, _whole(xy), 4, _PAPER, -1, cv2.LINE_AA)
        cv2.circle(canvas, _whole(xy), 3, color, -1, cv2.LINE_AA)

    share = f"{100 * coverage.area:.0f} % of the image covered by {len(kept)} views"
    detail = f"{camera.model.name}, {camera.width} x {camera.height} px, {len(errors)} corners, {_precision(coverage)}"
    _write(canvas, share, (_MARGIN, 40), 0.95, _INK, 2)
    _write(canvas, detail, (_MARGIN, 72), 0.55, _FAINT)
    _legend(canvas, _TOP + height + 34, coverage, largest, any(fit.dropped for fit in calibration.views))
    return canvas


def _precision(coverage: Coverage) -> str:
    worst = float(coverage.image_std.max())
    typical = f"directions good to {np.median(coverage.image_std):.2g} px"
    return typical + (f", at worst {worst:.2g} px" if np.isfinite(worst) else ", in parts to nothing")


def _shade(counts: NDArray[np.int64], width: int, height: int) -> Picture:
    """Blue where the board was, the more the more often; stripes where it never was."""
    size = (width, height)
    many = cv2.resize(counts.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    share = np.clip((many - 1) / max(int(counts.max()) - 1, 1), 0, 1)[..., None]
    shaded = _FEW + share * (_MANY - _FEW)
    seen = cv2.resize((counts > 0).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)[..., None]
    rows, columns = np.mgrid[:height, :width]
    striped = np.where(((rows + columns) % 14 < 3)[..., None], np.array(_STRIPE), np.array(_BARE))
    return np.asarray(np.where(seen > 0.5, shaded, striped), np.uint8)


def _error_colors(shares: NDArray[np.float64]) -> list[tuple[int, int, int]]:
    """Dark for a corner that fits, through purple to yellow for one with the largest error."""
    levels = np.clip(255 * shares, 0, 235).astype(np.uint8)[:, None]
    return [(int(b), int(g), int(r)) for b, g, r in cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[:, 0]]


def _legend(canvas: Picture, top: int, coverage: Coverage, largest: float, dropped: bool) -> None:
    """Two bars, and what the other signs mean."""
    steps = np.linspace(0, 1, 200)
    views = np.tile((_FEW + steps[:, None] * (_MANY - _FEW)).astype(np.uint8), (14, 1, 1))
    errors = np.tile(np.array(_error_colors(steps), np.uint8), (14, 1, 1))
    most = int(coverage.counts.max())
    bars = [
        (views, "views of the board", "1", f"{most}"),
        (errors, "error of a corner", "0", f"{largest:.2g} px"),
    ]
    for column, (bar, title, low, high) in enumerate(bars):
        x = _MARGIN + 260 * column
        _write(canvas, title, (x, top), 0.5, _INK)
        canvas[top + 12 : top + 26, x : x + 200] = bar
        _write(canvas, low, (x, top + 46), 0.45, _FAINT)
        (length, _), _ = cv2.getTextSize(high, _FONT, 0.45, 1)
        _write(canvas, high, (x + 200 - length, top + 46), 0.45, _FAINT)
    x = _MARGIN + 520
    stripes = _shade(np.zeros((1, 1), np.int64), 28, 14)
    canvas[top + 12 : top + 26, x : x + 28] = stripes
    _write(canvas, "the board was never here", (x + 40, top + 24), 0.5, _INK)
    if dropped:
        cv2.drawMarker(canvas, (x + 14, top + 46), _FAINT, cv2.MARKER_TILTED_CROSS, 9, 1, cv2.LINE_AA)
        _write(canvas, "corner of a dropped view", (x + 40, top + 51), 0.5, _INK)


def _whole(xy: NDArray[np.float64]) -> tuple[int, int]:
    return round(float(xy[0])), round(float(xy[1]))


def _write(
    canvas: Picture, text: str, place: tuple[int, int], size: float, color: tuple[int, int, int], weight: int = 1
) -> None:
    cv2.putText(canvas, text, place, _FONT, size, color, weight, cv2.LINE_AA)
