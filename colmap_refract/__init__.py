"""Refraction-aware refinement of COLMAP models."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from colmap_refract.errors import RefractError
from colmap_refract.interface import Layers
from colmap_refract.options import BundleAdjustmentOptions, ImageNotes, RefinerOptions, RefinerRequest

if TYPE_CHECKING:
    from colmap_refract.refiner.comparison import Comparison
    from colmap_refract.refiner.refinement import Refinement, refine
    from colmap_refract.refiner.scenario_choice import choose_scenario

__version__ = "0.1.0"
__all__ = [
    "BundleAdjustmentOptions",
    "Comparison",
    "ImageNotes",
    "Layers",
    "RefinerOptions",
    "RefinerRequest",
    "Refinement",
    "RefractError",
    "choose_scenario",
    "refine",
]


_LATE = {
    "Comparison": "comparison",
    "Refinement": "refinement",
    "choose_scenario": "scenario_choice",
    "refine": "refinement",
}


def __getattr__(name: str) -> Any:
    """`refine` and its like are imported when first used: compiled kernels and COLMAP take a second to load."""
    if name in _LATE:
        return getattr(import_module(f"colmap_refract.refiner.{_LATE[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
