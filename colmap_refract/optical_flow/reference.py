"""The frame that the others are tracked against: which one, and which points of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from difflib import get_close_matches

import cv2
import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.frame_selection.fixed_camera import choose
from colmap_refract.frame_selection.quality import SMALL_SIDE, grade, measure
from colmap_refract.interface import Array
from colmap_refract.optical_flow.options import FlowOptions
from colmap_refract.optical_flow.pictures import level
from colmap_refract.photographs.images import Gray, common_size, shrink

Read = Callable[[str], Gray]
"""The grey values (H, W) of a frame by its name."""
Watch = Callable[[str], None]
"""Told how far it is."""

_CORNER_QUALITY = 1e-3  # of the best; the picture is levelled, so that reflections do not set the measure
_POINTS_PER_CELL = 4


def check_names(names: Sequence[str], reference: str | None = None) -> None:
    """Raise RefractError unless there are two frames at least, and the reference, if one is given, among them."""
    if len(set(names)) < 2:
        raise RefractError("there is one frame only; give the reference frame and others to track it to")
    if reference is not None and reference not in names:
        near = get_close_matches(reference, names, n=3, cutoff=0.5) or list(names[:3])
        raise RefractError(
            f"there is no image '{reference}'; give the reference as it is named, such as "
            + ", ".join(f"'{name}'" for name in near)
        )


def choose_reference(read: Read, names: Sequence[str], *, watch: Watch = lambda _: None) -> str:
    """The frame that differs least from the others, as frames are chosen for a fixed camera.

    Small copies of all frames are kept in memory, 0.3 MB each.

    Raises:
        RefractError: fewer than two frames, frames of different sizes, and what `read` raises.
    """
    check_names(names)
    smalls, qualities = [], []
    by_size: dict[tuple[int, int], list[str]] = {}
    for done, name in enumerate(names):
        watch(f"Seeking a reference: frame {done + 1} of {len(names)}")
        gray = read(name)
        by_size.setdefault((gray.shape[1], gray.shape[0]), [name])
        common_size(by_size)
        smalls.append(shrink(gray, SMALL_SIDE))
        qualities.append(measure(gray, smalls[-1]))
    grades = grade(qualities, min_num_features=1, window=None)
    usable = [k for k, rejection in enumerate(grades.rejections) if rejection is None] or list(range(len(names)))
    worth = (grades.features * grades.sharpness)[usable]
    choice = choose([smalls[k] for k in usable], worth, num_images=1, reference=None, watch=watch)
    return names[usable[choice.reference]]


def find_corners(gray: Gray, options: FlowOptions) -> Array:
    """Corners (P, 2) by Shi and Tomasi's measure, the best of every part of the picture, far enough from its edge.

    To whole pixels: it is the square around a point that is tracked, so that a finer place would be no better a one.
    """
    height, width = gray.shape
    margin = options.half_window + 1
    mask = np.zeros(gray.shape, np.uint8)
    mask[margin : height - margin, margin : width - margin] = 1
    if not mask.any():
        return np.zeros((0, 2))
    # So many cells that each gives a few points; half the distance between evenly spread ones keeps them apart.
    cell = np.sqrt(mask.sum() * _POINTS_PER_CELL / options.max_num_points)
    apart = max(3.0, 0.5 * cell / np.sqrt(_POINTS_PER_CELL))
    found = cv2.goodFeaturesToTrack(level(gray, options.half_window), 0, _CORNER_QUALITY, apart, mask=mask)
    if found is None:
        return np.zeros((0, 2))
    corners = found.reshape(-1, 2).astype(float)
    column, row = (corners // cell).astype(np.int64).T
    # They come best first: the best of each cell before the second best of any.
    order = np.lexsort([np.arange(len(corners)), row * (column.max() + 1) + column])
    cells = (row * (column.max() + 1) + column)[order]
    begins = np.flatnonzero(np.r_[True, np.diff(cells) > 0])
    rank = np.arange(len(cells)) - np.repeat(begins, np.diff(np.r_[begins, len(cells)]))
    chosen = order[np.argsort(rank, kind="stable")][: options.max_num_points]
    return corners[np.sort(chosen)]
