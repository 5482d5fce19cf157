"""Frames of a moving camera: at even distances along the flow, so that neighbours have a baseline and overlap."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_refract.frame_selection.sparse_flow import (
    Points,
    corners,
    flatten,
    match,
    median_length,
    track,
    tracked_fraction,
)
from colmap_refract.interface import Array
from colmap_refract.photographs.images import Gray

MAX_STEP = 0.25
"""Of the longest side; beyond, neighbours overlap too little to be matched well."""
MIN_STEP = 0.02
"""Of the longest side; below, neighbours have no baseline worth an image."""
_MIN_TRACKED = 0.3  # of the points that were started from
_FRESH_TRACKED = 0.6  # with fewer left, new points are sought
_FRESH_STEP = 0.02  # of the longest side; movements to and fro within it do not add up
_LOOK_AHEAD = 3  # frames that may be covered or otherwise useless in a row
_WINDOW = 0.3  # of a step, on either side, in which a better frame may be found


@dataclass(frozen=True, kw_only=True)
class FlowPath:
    """How far the picture has moved since the first of K frames, pixels of the small copies."""

    positions: Array
    """(K,); NaN where a frame has nothing in common with its neighbours, which have with each other."""
    breaks: list[int]
    """Frames that have nothing in common with those before; a step of `MAX_STEP` is put there."""

    @property
    def length(self) -> float:
        """Of the whole path."""
        return float(np.nanmax(self.positions) - np.nanmin(self.positions))

    def filled(self, k: int) -> FlowPath:
        """With a position for frame k between those of the frames around it."""
        known = np.flatnonzero(np.isfinite(self.positions))
        positions = self.positions.copy()
        positions[k] = np.interp(k, known, positions[known])
        return replace(self, positions=positions)


@dataclass
class _Chain:
    """Points that are followed from an anchor frame on."""

    anchor: Points
    points: Points
    position: float

    @classmethod
    def at(cls, small: Gray, position: float) -> _Chain:
        points = corners(flatten(small))
        return cls(points, points, position)


def flow_path(smalls: Sequence[Gray], watch: Callable[[str], None]) -> FlowPath:
    """Measure the flow along frames: points are followed from frame to frame, or matched where that fails.

    Args:
        smalls: K small copies in their order, at least one, all of one size.
        watch: told how far it is.
    """
    side = max(smalls[0].shape)
    positions, breaks = np.full(len(smalls), np.nan), []
    positions[0] = 0.0
    last, chain = 0, _Chain.at(smalls[0], 0.0)
    while last + 1 < len(smalls):
        watch(f"Optical flow: frame {last + 2} of {len(smalls)}")
        for following in range(last + 1, min(last + 2 + _LOOK_AHEAD, len(smalls))):
            position, tracked = _follow(smalls[last], smalls[following], chain, positions[last])
            if position is not None:
                break
        else:
            following = last + 1
            position, tracked = positions[last] + MAX_STEP * side, None
            breaks.append(following)
        positions[following] = position
        if (
            tracked is None
            or position - chain.position > _FRESH_STEP * side
            or tracked_fraction(tracked) < _FRESH_TRACKED
        ):
            chain = _Chain.at(smalls[following], position)
        else:
            chain.points = tracked
        last = following
    return FlowPath(positions=positions, breaks=breaks)


def _follow(last: Gray, small: Gray, chain: _Chain, position: float) -> tuple[float | None, Points | None]:
    """Position of a frame, and the chain's points in it if they were tracked; None for what is not known."""
    tracked = track(flatten(last), flatten(small), chain.points)
    if tracked_fraction(tracked) >= _MIN_TRACKED:
        return chain.position + median_length(chain.anchor, tracked), tracked
    here, there = match(last, small)
    return (position + median_length(here, there), None) if len(here) else (None, None)


def choose(path: FlowPath, grades: Array, side: int, *, num_images: int, reference: int | None) -> list[int]:
    """Choose frames at even distances along a path, around each place a good one.

    Args:
        path: of K frames.
        grades: (K,), how good each frame is by itself, 0 to 1.
        side: the longest of the small copies, pixels.
        num_images: to choose, at most; fewer if the path is too short for steps of `MIN_STEP`.
        reference: a frame that must be among them, or None; its position must be known.

    Returns:
        Frames in the order of the path.
    """
    positions = path.positions
    usable = np.isfinite(positions)
    count = min(num_images, 1 + int(path.length / (MIN_STEP * side)))
    if count < 2 and reference is None:
        return [int(np.where(usable, grades, -1.0).argmax())]
    if usable.sum() <= count:
        return _unlike(positions, MIN_STEP / 2 * side, reference)
    places = np.nanmin(positions) + np.linspace(0, path.length, count)
    step = path.length / max(count - 1, 1)
    chosen: list[int] = []
    if reference is not None:
        chosen.append(reference)
        places = np.delete(places, np.abs(places - positions[reference]).argmin())
    for place in places:
        distance = np.abs(positions - place)
        distance[~usable] = np.inf
        distance[chosen] = np.inf
        near = distance <= _WINDOW * step
        if near.any():
            # A frame that is a tenth of a step off its place has to be better by a tenth.
            chosen.append(int(np.where(near, grades * (1 - np.minimum(distance / step, 1)), -1.0).argmax()))
        elif distance.min() <= step / 2:
            chosen.append(int(distance.argmin()))
    return sorted(chosen, key=lambda k: (positions[k], k))


def _unlike(positions: Array, least: float, reference: int | None) -> list[int]:
    """All frames but those that are nearer than `least` to the one before."""
    chosen: list[int] = []
    for k in np.argsort(positions, kind="stable")[: int(np.isfinite(positions).sum())]:
        if not chosen or positions[k] - positions[chosen[-1]] >= least:
            chosen.append(int(k))
        elif k == reference:
            chosen[-1] = int(k)
    return chosen
