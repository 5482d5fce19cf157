"""Depth maps as people look at them: each reference image beside its depths, on one page with one scale."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.dense.reconstruction import DenseView
from colmap_refract.interface import Array

Picture = NDArray[np.uint8]

_WIDTH = 800  # of a tile, at most
_GAP, _TOP, _BAR = 12, 40, 130
_NOWHERE = (60, 60, 60)
_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.5
_EXTREMES = (0.005, 0.995)  # of the depths, where the scale ends


def depth_page(views: Sequence[DenseView], unit: str) -> bytes:
    """A page with a row per reference, as PNG.

    Args:
        views: at least one of them with points.
        unit: of the depths, for people.
    """
    depths = np.concatenate([view.depth[np.isfinite(view.depth)] for view in views])
    near, far = (float(limit) for limit in np.quantile(depths, _EXTREMES))
    far = max(far, near * (1 + 1e-9) + 1e-300)
    rows = [_row(view, near, far) for view in views]
    width = max(row.shape[1] for row in rows)
    page = np.full((_TOP + sum(len(row) + _GAP for row in rows), width + _BAR, 3), 255, np.uint8)
    _text(page, f"Reference image, and depth along the camera's axis [{unit}]", (_GAP, 26))
    top = _TOP
    for row in rows:
        page[top : top + len(row), : row.shape[1]] = row
        top += len(row) + _GAP
    _scale(page, width, near, far)
    return cv2.imencode(".png", cv2.cvtColor(page, cv2.COLOR_RGB2BGR))[1].tobytes()


def colour_of(depth: Array, near: float, far: float) -> Picture:
    """RGB (..., 3) of depths: red near, blue far, dark grey where there is none."""
    place = np.clip((far - np.nan_to_num(depth, nan=near)) / (far - near), 0, 1)
    bgr = cv2.applyColorMap(np.rint(255 * place).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO)
    rgb = bgr[:, 0, ::-1].reshape(*depth.shape, 3)
    return np.where(np.isfinite(depth)[..., None], rgb, np.uint8(_NOWHERE[0])).astype(np.uint8)


def _row(view: DenseView, near: float, far: float) -> Picture:
    """The image and its depths at one scale, with the margin of the grid about the depths."""
    height, width = view.picture.shape[:2]
    scale = min(1.0, _WIDTH / width)
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    grid = colour_of(view.depth, near, far)
    depths: Picture = np.full(view.picture.shape, _NOWHERE, np.uint8)
    # A node stands for the square of a step about it.
    big = np.repeat(np.repeat(grid, view.step, axis=0), view.step, axis=1)
    corner = view.margin - view.step // 2
    part = depths[corner : corner + len(big), corner : corner + big.shape[1]]
    part[:] = big[: len(part), : part.shape[1]]
    shown = [
        cv2.resize(np.ascontiguousarray(one), size, interpolation=how)
        for one, how in ((view.picture, cv2.INTER_AREA), (depths, cv2.INTER_NEAREST))
    ]
    gap = np.full((size[1], _GAP, 3), 255, np.uint8)
    row: Picture = np.concatenate([gap, shown[0], gap, shown[1], gap], axis=1)
    label = np.full((24, row.shape[1], 3), 255, np.uint8)
    _text(label, view.name.encode("ascii", "replace").decode(), (_GAP, 17))
    return np.concatenate([row, label])


def _scale(page: Picture, left: int, near: float, far: float) -> None:
    top, height, width = _TOP + 12, max(60, min(300, len(page) - _TOP - 60)), 24
    page[top : top + height, left : left + width] = colour_of(np.linspace(near, far, height), near, far)[:, None]
    for part in np.linspace(0, 1, 5):
        _text(page, f"{near + part * (far - near):.4g}", (left + width + 6, top + round(part * (height - 1)) + 5))


def _text(page: Picture, words: str, place: tuple[int, int]) -> None:
    cv2.putText(page, words, place, _FONT, _SIZE, (0, 0, 0), 1, cv2.LINE_AA)
