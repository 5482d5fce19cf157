"""Points of a reference frame, tracked to every other frame of a camera that stands still.

Neighbouring frames through waves differ little, but blur: what a feature descriptor no longer matches can still be
tracked. Each frame is tracked from the reference by itself, so that errors do not add up:

1. an affine map by correlation of coarse tiles (`estimate`), for a tilted surface shifts the whole picture;
2. optical flow from there, forth and back, which gives a smooth field of displacements (`field`);
3. the frame pulled straight by that field and made as bright and sharp as the reference (`pictures`), in which Lucas
   and Kanade's method then finds what is left (`frame`): without the deformation, its error is that of noise
   alone;
4. the checks: forth and back again, and correlation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array
from colmap_refract.optical_flow.frame import MIN_TRACKS, FrameFlow, Index, track_frame
from colmap_refract.optical_flow.options import FlowOptions
from colmap_refract.optical_flow.reference import Read, Watch, check_names, find_corners
from colmap_refract.photographs.images import common_size


@dataclass(frozen=True, kw_only=True)
class FlowTracks:
    """Points of the reference frame and where they were found."""

    reference: str
    """Name of the reference frame."""
    keypoints: dict[str, Array]
    """Per frame with tracks (n, 2), pixels, COLMAP's origin. Every one has a match."""
    matches: dict[tuple[str, str], Index]
    """Per pair of the reference and another frame (m, 2), rows of their keypoints."""
    frames: dict[str, FrameFlow]
    """Of every frame but the reference."""

    @property
    def lost(self) -> list[str]:
        """Frames in which fewer than MIN_TRACKS points were found; they have no keypoints."""
        return [name for name, flow in self.frames.items() if not flow.num_tracks]


def track_against_reference(
    read: Read, names: Sequence[str], reference: str, options: FlowOptions, *, watch: Watch = lambda _: None
) -> FlowTracks:
    """Track points of the reference frame to every other frame.

    Two frames are held in memory at a time.

    Args:
        read: the grey values (H, W) of a frame by its name.
        names: of the frames, the reference among them.
        reference: name of the reference frame.
        options: how.
        watch: told how far it is.

    Returns:
        The tracks, and how well each frame was tracked.

    Raises:
        RefractError: fewer than two frames, an unknown reference or one without corners, frames of different sizes,
            or none in which anything was found; and what `read` raises.
    """
    check_names(names, reference)
    first = read(reference)
    points = find_corners(first, options)
    if len(points) < MIN_TRACKS:
        raise RefractError(
            f"the reference '{reference}' has {len(points)} corners that could be tracked, {MIN_TRACKS} are needed; "
            "give a sharper one, or one with more texture, as reference_image"
        )
    found: dict[str, tuple[Index, Array]] = {}
    frames: dict[str, FrameFlow] = {}
    others = [name for name in dict.fromkeys(names) if name != reference]
    for done, name in enumerate(others):
        watch(f"Tracking: frame {done + 1} of {len(others)}")
        frame = read(name)
        sizes = {(first.shape[1], first.shape[0]): [reference]}
        sizes.setdefault((frame.shape[1], frame.shape[0]), [name])
        common_size(sizes)
        rows, there, frames[name] = track_frame(first, frame, points, options)
        if len(rows):
            found[name] = rows, there
    if not found:
        raise RefractError(
            f"nothing could be tracked from '{reference}' to any of the other {len(others)} frames; "
            "is the camera fixed, and do the frames show the same? Try another reference_image"
        )
    kept = np.unique(np.concatenate([rows for rows, _ in found.values()]))
    return FlowTracks(
        reference=reference,
        # OpenCV's pixels are half a pixel from COLMAP's.
        keypoints={reference: points[kept] + 0.5, **{name: there + 0.5 for name, (_, there) in found.items()}},
        matches={
            (reference, name): np.column_stack([np.searchsorted(kept, rows), np.arange(len(rows))])
            for name, (rows, _) in found.items()
        },
        frames=frames,
    )
