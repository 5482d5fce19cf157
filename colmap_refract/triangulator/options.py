"""What a user can ask of the triangulation through waves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.options import Loss

_STEEPEST_DEG = 45.0


@dataclass(frozen=True, kw_only=True)
class TriangulatorOptions:
    """How points are triangulated through a surface with waves."""

    slope_deviation_deg: float
    """Root mean square slope of the waves, degrees, both directions together.
    0: a flat surface, and all observations count alike."""
    pixel_noise: float = 0.5
    """Standard deviation of each coordinate of a keypoint, px, without waves."""
    loss_function_type: Loss = "cauchy"
    """Robust loss on the reprojection errors, each in units of its own standard deviation."""
    loss_function_scale: float = 4.0
    """Scale of the loss, standard deviations."""
    filter_max_error_std: float = 4.0
    """Observations with a larger reprojection error, in units of its own standard deviation, are removed.
    0: keep all."""
    filter_min_tri_angle: float | None = None
    """Points whose refracted rays meet at a smaller angle, degrees, are removed.
    By default 0.5, and 0.05 with a fixed camera. 0: keep all; the standard deviations tell what they are worth."""

    def __post_init__(self) -> None:
        slope = self.slope_deviation_deg
        if not 0 <= slope < _STEEPEST_DEG:
            raise RefractError(
                f"slope_deviation_deg {slope:g} is no slope of water waves: give degrees from 0 to {_STEEPEST_DEG:g}, "
                "usually 1 to 10"
            )
        if not 0 < self.pixel_noise < np.inf:
            raise RefractError(f"pixel_noise {self.pixel_noise:g} px is not positive; keypoints have about 0.5")
        if not 0 < self.loss_function_scale < np.inf:
            raise RefractError(f"loss_function_scale {self.loss_function_scale:g} is not positive")
        for name in ("filter_max_error_std", "filter_min_tri_angle"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < np.inf:
                raise RefractError(f"{name} {value:g}: give a number from 0 on; 0 keeps all")

    @property
    def slope_deviation(self) -> float:
        """Standard deviation of each of the two slopes, a tangent."""
        return float(np.tan(np.radians(self.slope_deviation_deg)) / np.sqrt(2.0))

    def min_tri_angle(self, scenario: str) -> float:
        """`filter_min_tri_angle` with its default, which is the refiner's."""
        if self.filter_min_tri_angle is not None:
            return self.filter_min_tri_angle
        return 0.05 if scenario == "fixed_camera" else 0.5
