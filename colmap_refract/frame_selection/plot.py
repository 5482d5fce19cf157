"""A picture of the choice: where the flow of every frame leads, and which frames were taken."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.frame_selection.selection import FrameRecord, Selection
from colmap_refract.interface import Array

_WIDTH, _HEIGHT = 1000, 800
_LEFT, _RIGHT, _TOP, _BOTTOM = 90, 30, 50, 80
_BLACK, _GREY, _LIGHT = (0, 0, 0), (150, 150, 150), (225, 225, 225)
_CHOSEN, _REFERENCE, _REJECTED = (180, 100, 20), (30, 30, 220), (80, 160, 230)  # blue, red, orange, as BGR
_TICKS = 5
_SHIFT = 4  # bits of a pixel's fraction, as cv2 draws


class _Axes:
    """A frame with ticks, to draw in by data coordinates."""

    def __init__(self, x: Array, y: Array, *, equal: bool, labels: tuple[str, str, str], y_down: bool) -> None:
        self.image: NDArray[np.uint8] = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
        self._origin = np.array([_LEFT, _TOP if y_down else _HEIGHT - _BOTTOM], float)
        size = np.array([_WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM], float)
        low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
        span = np.maximum(high - low, 1e-6) * 1.1
        per_pixel = span / size
        if equal:
            per_pixel[:] = per_pixel.max()
        self._first = (low + high) / 2 - per_pixel * size / 2
        self._scale = np.array([1, 1 if y_down else -1]) / per_pixel
        corner = (_WIDTH - _RIGHT, _HEIGHT - _BOTTOM)
        for axis in range(2):
            for tick in _round_ticks(self._first[axis], self._first[axis] + per_pixel[axis] * size[axis]):
                self._tick(axis, tick)
        cv2.rectangle(self.image, (_LEFT, _TOP), corner, _BLACK, 1, cv2.LINE_AA)
        title, x_label, y_label = labels
        self.text(title, (_LEFT, _TOP - 20), 0.6)
        self.text(x_label, (_LEFT, _HEIGHT - _BOTTOM + 50), 0.5)
        self.text(y_label, (10, _TOP - 20), 0.5)

    def text(self, words: str, place: tuple[int, int], size: float) -> None:
        cv2.putText(self.image, words, place, cv2.FONT_HERSHEY_SIMPLEX, size, _BLACK, 1, cv2.LINE_AA)

    def at(self, x: float, y: float) -> tuple[int, int]:
        place = self._origin + (np.array([x, y]) - self._first) * self._scale
        return int(round(place[0] * 2**_SHIFT)), int(round(place[1] * 2**_SHIFT))

    def dot(self, x: float, y: float, color: Sequence[float], radius: float, *, filled: bool = True) -> None:
        thickness = cv2.FILLED if filled else 2
        cv2.circle(self.image, self.at(x, y), int(radius * 2**_SHIFT), color, thickness, cv2.LINE_AA, _SHIFT)

    def line(self, start: tuple[float, float], end: tuple[float, float], color: Sequence[float]) -> None:
        cv2.line(self.image, self.at(*start), self.at(*end), color, 1, cv2.LINE_AA, _SHIFT)

    def _tick(self, axis: int, value: float) -> None:
        x, y = (round(p / 2**_SHIFT) for p in self.at(*(value if k == axis else self._first[k] for k in range(2))))
        words = f"{value:g}"
        if axis == 0:
            cv2.line(self.image, (x, _TOP), (x, _HEIGHT - _BOTTOM), _LIGHT, 1)
            self.text(words, (x - 5 * len(words), _HEIGHT - _BOTTOM + 22), 0.5)
        else:
            cv2.line(self.image, (_LEFT, y), (_WIDTH - _RIGHT, y), _LIGHT, 1)
            self.text(words, (_LEFT - 10 - 10 * len(words), y + 5), 0.5)


def plot(selection: Selection) -> NDArray[np.uint8]:
    """Draw a choice: mean flows from the reference for a fixed camera, otherwise the flow along the frames.

    Returns:
        (H, W, 3), BGR.
    """
    return _flows(selection) if selection.options.scenario == "fixed_camera" else _path(selection)


def _flows(selection: Selection) -> NDArray[np.uint8]:
    shown = [frame for frame in selection.frames if frame.flow is not None]
    flows = np.array([frame.flow for frame in shown], float).reshape(-1, 2)
    title = (
        f"Mean flow from {_ascii(selection.reference.name)}, {len(selection.chosen)} of {len(selection.frames)} chosen"
    )
    axes = _Axes(flows[:, 0], flows[:, 1], equal=True, labels=(title, "to the right [px]", "down [px]"), y_down=True)
    for frame, (x, y) in zip(shown, flows, strict=True):
        if frame.is_chosen:
            axes.line((0.0, 0.0), (x, y), _CHOSEN)
    for frame, (x, y) in sorted(zip(shown, flows, strict=True), key=lambda shown: shown[0].is_chosen):
        _mark(axes, frame, x, y)
    _legend(axes, [("not chosen", _GREY), ("chosen", _CHOSEN), ("reference", _REFERENCE)])
    return axes.image


def _path(selection: Selection) -> NDArray[np.uint8]:
    shown = [frame for frame in selection.frames if frame.flow_length is not None]
    index = np.array([frame.index for frame in shown], float)
    path = np.array([frame.flow_length for frame in shown], float)
    title = f"Flow along the frames, {len(selection.chosen)} of {len(selection.frames)} chosen"
    axes = _Axes(index, path, equal=False, labels=(title, "frame", "flow [px]"), y_down=False)
    for frame in selection.frames:
        if frame.flow_length is None:  # on the line between the frames around it
            axes.dot(frame.index, float(np.interp(frame.index, index, path)), _REJECTED, 5, filled=False)
    for frame, x, y in sorted(zip(shown, index, path, strict=True), key=lambda shown: shown[0].is_chosen):
        _mark(axes, frame, x, y)
    _legend(
        axes,
        [("not chosen", _GREY), ("chosen", _CHOSEN), ("reference", _REFERENCE), ("blurred, empty, lost", _REJECTED)],
    )
    return axes.image


def _mark(axes: _Axes, frame: FrameRecord, x: float, y: float) -> None:
    if frame.verdict == "reference":
        axes.dot(x, y, _REFERENCE, 9)
    elif frame.verdict == "chosen":
        axes.dot(x, y, _CHOSEN, 6)
    else:
        axes.dot(x, y, _GREY, 3)


def _legend(axes: _Axes, entries: list[tuple[str, tuple[int, int, int]]]) -> None:
    x = _LEFT
    for words, color in entries:
        cv2.circle(axes.image, (x + 6, _HEIGHT - 12), 5, color, cv2.FILLED, cv2.LINE_AA)
        axes.text(words, (x + 18, _HEIGHT - 7), 0.5)
        x += 40 + 10 * len(words)


def _round_ticks(low: float, high: float) -> Array:
    raw = (high - low) / _TICKS
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min((1, 2, 5, 10), key=lambda factor: abs(factor * power - raw))
    # 0.0 instead of -0.0
    return np.asarray(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step + 0.0, float)


def _ascii(name: str) -> str:
    """cv2 draws no other letters."""
    return name.encode("ascii", "replace").decode()
