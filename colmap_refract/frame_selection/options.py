"""What a user can ask for when frames are chosen."""

from __future__ import annotations

from dataclasses import dataclass

from colmap_refract.errors import RefractError
from colmap_refract.options import Scenario


@dataclass(frozen=True, kw_only=True)
class SelectionOptions:
    """How frames are chosen."""

    scenario: Scenario
    """What moves. fixed_camera: the surface only, and frames are chosen whose flow to a reference differs.
    Any other: the camera, and frames are chosen at even distances along the flow."""
    num_images: int = 26
    """How many to choose, the reference included."""
    reference_image: str = ""
    """Name of the reference.
    By default the frame that the others differ least from (fixed camera), or the chosen one with most features."""
    min_num_features: int = 50
    """Frames with fewer SIFT features, in a copy of at most 640 pixels, are left out."""
    frame_step: int | None = None
    """Look at every n-th frame only. By default such that at most 600 are looked at."""

    def __post_init__(self) -> None:
        if self.num_images < 2:
            raise RefractError(f"num_images {self.num_images} is too few: two at least, one of them the reference")
        if self.min_num_features < 1:
            raise RefractError(f"min_num_features {self.min_num_features} is too few: give 1 or more")
        if self.frame_step is not None and self.frame_step < 1:
            raise RefractError(f"frame_step {self.frame_step} is not positive: 1 looks at every frame")
