"""Height maps as pictures: 32-bit TIFF, colours, and a page with all of them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.interface import Array

Picture = NDArray[np.uint8]

_SCALE = np.array([[160, 20, 30], [230, 130, 90], [245, 245, 245], [110, 160, 230], [20, 60, 160]], float)
"""From crests, towards the camera, by the plane to troughs; RGB."""
_OUTSIDE = (150, 150, 150)
_PAGE_WIDTH = 1600
_MOST_TILE, _LEAST_TILE = 300, 60
_GAP, _TOP, _LINE = 12, 60, 22
_BAR = 220  # width of the colour bar and its words
_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.45


def color_of(heights: Array, limit: float) -> Picture:
    """RGB (..., 3) of heights: red towards the camera, white on the plane, blue towards the water; grey for NaN.

    Args:
        heights: of any shape.
        limit: > 0, where the scale ends on both sides; heights beyond it have its last colours.
    """
    place = np.linspace(-limit, limit, len(_SCALE))
    color = np.stack([np.interp(np.nan_to_num(heights), place, channel) for channel in _SCALE.T], axis=-1)
    return np.where(np.isfinite(heights)[..., None], color.round(), _OUTSIDE).astype(np.uint8)


def tiff(heights: NDArray[np.float32]) -> bytes:
    """A height map (rows, columns) as TIFF: one channel of 32-bit floats, not compressed, which all programs read."""
    _, data = cv2.imencode(".tif", heights, [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE])
    return data.tobytes()


def overview(maps: Sequence[tuple[str, Array]], limit: float, unit: str) -> bytes:
    """A page of height maps with one colour bar, as PNG.

    Args:
        maps: name and heights (rows, columns) of each image.
        limit: of the colours, see `color_of`.
        unit: of the heights.
    """
    tall = max(heights.shape[0] / heights.shape[1] for _, heights in maps)
    columns = max(1, round(np.sqrt(len(maps) * 4 / 3 * tall)))
    width = int(np.clip(_PAGE_WIDTH // columns - _GAP, _LEAST_TILE, _MOST_TILE))
    height = max(1, round(width * tall))
    rows = -(-len(maps) // columns)
    words = f"Height of the water surface over its mean plane [{unit}]"
    page_width = max(columns * (width + _GAP), cv2.getTextSize(words, _FONT, 0.6, 1)[0][0]) + _BAR
    page: Picture = np.full((max(_TOP + rows * (height + _LINE + _GAP), 400), page_width + _GAP, 3), 255, np.uint8)
    cv2.putText(page, words, (_GAP, 32), _FONT, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    for k, (name, heights) in enumerate(maps):
        x, y = _GAP + k % columns * (width + _GAP), _TOP + k // columns * (height + _LINE + _GAP)
        scale = min(width / heights.shape[1], height / heights.shape[0])
        size = (max(1, round(scale * heights.shape[1])), max(1, round(scale * heights.shape[0])))
        tile = cv2.resize(color_of(heights, limit), size, interpolation=cv2.INTER_AREA)
        page[y : y + size[1], x : x + size[0]] = tile
        _text(page, _fitting(name, width), (x, y + size[1] + 16))
    _bar(page, page.shape[1] - _BAR, limit)
    return cv2.imencode(".png", cv2.cvtColor(page, cv2.COLOR_RGB2BGR))[1].tobytes()


def _bar(page: Picture, left: int, limit: float) -> None:
    """The scale, crests on top."""
    top, height, width = _TOP + 20, 240, 24
    page[top : top + height, left : left + width] = color_of(np.linspace(-limit, limit, height), limit)[:, None]
    cv2.rectangle(page, (left, top), (left + width, top + height), (0, 0, 0), 1)
    _text(page, "towards the camera", (left, top - 8))
    _text(page, "into the water", (left, top + height + 20))
    for part in (-1.0, -0.5, 0.0, 0.5, 1.0):
        _text(
            page, f"{part * limit:+.2g}" if part else "0", (left + width + 8, top + round((part + 1) / 2 * height) + 4)
        )


def _text(page: Picture, words: str, place: tuple[int, int]) -> None:
    cv2.putText(page, words, place, _FONT, _SIZE, (0, 0, 0), 1, cv2.LINE_AA)


def _fitting(name: str, width: int) -> str:
    """As much of a name's end as there is room for; cv2 draws no letters but ASCII's."""
    words = name.encode("ascii", "replace").decode()
    kept = words
    while len(kept) > 1 and cv2.getTextSize(kept if kept == words else f"..{kept}", _FONT, _SIZE, 1)[0][0] > width:
        kept = kept[1:]
    return kept if kept == words else f"..{kept}"
