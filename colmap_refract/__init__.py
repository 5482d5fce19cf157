"""Refraction-aware refinement of COLMAP models."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from colmap_refract.errors import RefractError
from colmap_refract.interface import Layers
from colmap_refract.options import BundleAdjustmentOptions, ImageNotes, RefinerOptions

if TYPE_CHECKING:
    from colmap_refract.refiner.refinement import Refinement, refine

__version__ = "0.1.0"
__all__ = [
    "BundleAdjustmentOptions",
    "ImageNotes",
    "Layers",
    "RefinerOptions",
    "Refinement",
    "RefractError",
    "refine",
]


def __getattr__(name: str) -> Any:
    """`refine` is imported when it is first used: compiled kernels and COLMAP take a second to load."""
    if name in ("refine", "Refinement"):
        from colmap_refract.refiner import refinement

        return getattr(refinement, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
