"""Frames of a camera that stands still before a surface that moves: the flow is that of refraction alone.

Each position of the surface is a new view. Views are wanted that differ, in all directions; they are compared by the
affine part of the flow, which is what a plane that tilts and rises brings about, and not what waves do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from colmap_refract.frame_selection.sparse_flow import (
    AffineField,
    affine_field,
    corners,
    flatten,
    median_length,
    track,
    tracked_fraction,
)
from colmap_refract.interface import Array
from colmap_refract.photographs.images import Gray

MIN_TRACKED = 0.4
"""Of the reference's points; a frame in which fewer are found has lost the track."""
SIMILAR = 5e-4
"""Of the longest side; flows that differ by less are the same within their error."""
_REFERENCE_GRADE = 0.8  # of the median: the reference is not to be among the worse frames
_THUMBNAIL = (80, 60)


@dataclass(frozen=True, kw_only=True)
class Flow:
    """From the reference to a frame, in pixels of the small copies."""

    length: float
    """Median length; NaN if nothing was tracked."""
    tracked: float
    """Fraction of the reference's points that were found."""
    field: AffineField
    """What of it is affine."""

    @property
    def is_lost(self) -> bool:
        """Too few points were found."""
        return self.tracked < MIN_TRACKED


@dataclass(frozen=True, kw_only=True)
class FixedCameraChoice:
    """Which of K frames were chosen; lengths in pixels of the small copies."""

    reference: int
    chosen: list[int]
    """The reference first, then in the order of choice."""
    gains: list[float]
    """Of each of `chosen`: how far its flow was from the nearest of those chosen before it; zero for the reference."""
    flows: list[Flow]
    """(K,), from the reference."""
    mean_distance: Array
    """(K,), how much a frame's flow differs from the others' in the mean; NaN where the track is lost."""
    nearest: Array
    """(K,), how much a frame's flow differs from that of the nearest chosen one; NaN where the track is lost."""


def choose(
    smalls: Sequence[Gray], grades: Array, *, num_images: int, reference: int | None, watch: Callable[[str], None]
) -> FixedCameraChoice:
    """Choose a reference and frames around it.

    The reference is the frame that differs least from all others in the mean, for a surface at rest is in the middle of
    its movements. The others are added one by one, each the one that is farthest from those that were chosen, its
    distance weighed by its grade, by the fraction tracked, and by how much of its flow is affine.

    Args:
        smalls: K small copies, at least one, all of one size.
        grades: (K,), how good each frame is by itself, 0 to 1.
        num_images: to choose, at most.
        reference: given, or None.
        watch: told how far it is.

    Returns:
        The choice. Fewer than `num_images` where all other frames are lost or the same as a chosen one.
    """
    base = _nearest_to_mean(smalls) if reference is None else reference
    flows = _flows(smalls, base, watch)
    if reference is None:
        reference = _least_different(flows, grades)
        if reference != base:
            flows = _flows(smalls, reference, watch)
    fields = np.array([flow.field.coefficients for flow in flows])
    lost = np.array([flow.is_lost for flow in flows])
    lost[reference] = False
    fields[lost] = np.nan
    weights = grades * [flow.tracked * _affine_part(flow) for flow in flows]

    chosen, gains = [reference], [0.0]
    nearest = np.linalg.norm(fields - fields[reference], axis=1)
    similar = SIMILAR * max(smalls[0].shape)
    while len(chosen) < num_images:
        worth = np.where(nearest >= similar, weights * nearest, 0.0)
        best = int(worth.argmax())
        if not worth[best] > 0:
            break
        chosen.append(best)
        gains.append(float(nearest[best]))
        nearest = np.minimum(nearest, np.linalg.norm(fields - fields[best], axis=1))
    return FixedCameraChoice(
        reference=reference,
        chosen=chosen,
        gains=gains,
        flows=flows,
        mean_distance=_mean_distance(fields),
        nearest=nearest,
    )


def _nearest_to_mean(smalls: Sequence[Gray]) -> int:
    """The frame nearest to the mean picture, brightness and contrast aside: a first reference, to track from."""
    thumbnails = np.array([cv2.resize(small, _THUMBNAIL, interpolation=cv2.INTER_AREA) for small in smalls], np.float32)
    thumbnails -= thumbnails.mean(axis=(1, 2), keepdims=True)
    thumbnails /= np.maximum(thumbnails.std(axis=(1, 2), keepdims=True), 1.0)
    return int(((thumbnails - thumbnails.mean(axis=0)) ** 2).sum(axis=(1, 2)).argmin())


def _flows(smalls: Sequence[Gray], reference: int, watch: Callable[[str], None]) -> list[Flow]:
    first = flatten(smalls[reference])
    points = corners(first)
    flows = []
    for k, small in enumerate(smalls):
        watch(f"Optical flow: frame {k + 1} of {len(smalls)}")
        tracked = points if k == reference else track(first, flatten(small), points)
        field = affine_field(points, tracked, small.shape)
        flows.append(Flow(length=median_length(points, tracked), tracked=tracked_fraction(tracked), field=field))
    return flows


def _mean_distance(fields: Array) -> Array:
    kept = np.isfinite(fields).all(axis=1)
    distances = np.full(len(fields), np.nan)
    # Frame by frame: all pairs at once would be large.
    distances[kept] = [np.linalg.norm(fields[kept] - field, axis=1).mean() for field in fields[kept]]
    return distances


def _least_different(flows: list[Flow], grades: Array) -> int:
    tracked = np.array([flow.tracked for flow in flows])
    found = tracked >= MIN_TRACKED
    if not found.any():  # there was nothing to track
        return int(grades.argmax())
    good = found & (grades >= _REFERENCE_GRADE * np.median(grades[found]))
    good &= tracked >= _REFERENCE_GRADE * np.median(tracked[found])
    fields = np.array([flow.field.coefficients for flow in flows])
    fields[~found] = np.nan
    return int(np.nanargmin(np.where(good, _mean_distance(fields), np.nan)))


def _affine_part(flow: Flow) -> float:
    total = flow.field.rms + flow.field.residual
    return flow.field.rms / total if total > 0 else 0.0
