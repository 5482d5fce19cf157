"""What was chosen of a folder or video, from what, and why."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from colmap_refract.frame_selection.options import SelectionOptions

Verdict = Literal["reference", "chosen", "blurred", "few features", "lost track", "too similar", "not needed"]


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """One frame, what was measured of it, and what was decided. Lengths in pixels of the original."""

    index: int
    """From 0, in the folder or video."""
    name: str
    time: float | None
    """Seconds since the video's beginning."""
    num_features: int
    """SIFT features in a copy of at most 640 pixels."""
    sharpness: float
    """Fraction, at most 1, of the sharpness of good frames."""
    verdict: Verdict = "too similar"
    reason: str = ""
    """Of the verdict, in numbers."""
    flow_length: float | None = None
    """Median length of the flow: from the reference (fixed camera); along all frames since the first (moving)."""
    difference: float | None = None
    """Of the flow from that of the nearest chosen frame; of frames that are too similar, or not needed."""
    flow: tuple[float, float] | None = None
    """Mean flow (right, down) from the reference. Fixed camera only, as the following."""
    flow_residual: float | None = None
    """Median distance of the flow from an affine one."""
    tracked_fraction: float | None = None
    """Of the reference's points that were found."""

    @property
    def is_chosen(self) -> bool:
        """The reference is among the chosen."""
        return self.verdict in ("reference", "chosen")


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What was chosen, and from what."""

    options: SelectionOptions
    source: str
    """Path of the folder or video."""
    image_size: tuple[int, int]
    """Width and height of the frames, pixels."""
    frame_step: int
    """Every n-th frame was looked at."""
    frames: list[FrameRecord]
    """All that were looked at, in their order."""
    warnings: list[str] = field(default_factory=list)
    """What the user should know, a sentence each."""

    @property
    def chosen(self) -> list[FrameRecord]:
        """The chosen frames with the reference, in their order."""
        return [frame for frame in self.frames if frame.is_chosen]

    @property
    def reference(self) -> FrameRecord:
        """The reference frame."""
        return next(frame for frame in self.frames if frame.verdict == "reference")
