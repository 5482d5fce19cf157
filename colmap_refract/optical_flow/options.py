"""What a user can ask for when frames are tracked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from colmap_refract.errors import RefractError

FlowMethod = Literal["dense", "features"]


@dataclass(frozen=True, kw_only=True)
class FlowOptions:
    """How points of the reference frame are found in the others. Lengths in pixels."""

    method: FlowMethod = "dense"
    """How the first estimate is made, which is then refined the same way.
    dense: DIS optical flow of the whole picture. features: Lucas and Kanade's pyramids at the points alone: faster."""
    max_num_points: int = 2000
    """Points of the reference frame that are tracked, at most."""
    window_size: int = 21
    """Width of the square around a point that is compared.
    Larger for blurred or noisy pictures, smaller for short waves."""
    max_error: float = 0.3
    """A track is kept if it leads forth to a frame and back to within this distance of where it began."""
    min_correlation: float = 0.8
    """A track is kept if the squares around its ends, once their deformation is undone, correlate as much (at most 1).
    What glitters or is covered in one frame does not."""

    def __post_init__(self) -> None:
        if self.max_num_points < 1:
            raise RefractError(f"max_num_points {self.max_num_points} is too few: give 1 or more")
        if not 5 <= self.window_size <= 101:
            raise RefractError(f"window_size {self.window_size} is not from 5 to 101 pixels")
        if not 0 < self.max_error <= 10:
            raise RefractError(f"max_error {self.max_error:g} is not above 0 and at most 10 pixels")
        if not -1 <= self.min_correlation < 1:
            raise RefractError(f"min_correlation {self.min_correlation:g} is not from -1 to below 1")

    @property
    def half_window(self) -> int:
        """Pixels from a point to the edge of its square."""
        return self.window_size // 2
