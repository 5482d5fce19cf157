"""Do the residuals of neighbouring keypoints agree? Noise does not, a surface that is not flat makes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array

_NUM_NEIGHBOURS = 4
_CLIP = 4.0
"""Robust deviations at which a residual is cut: a wrong match agrees with nobody."""


@dataclass(frozen=True, kw_only=True)
class SpatialCorrelation:
    """How much residuals agree with those of the nearest keypoints in the same image.

    Attributes:
        value: correlation of the residual vectors of neighbours, -1 to 1; 0 for noise.
        deviation: its standard deviation where there is nothing but noise.
        deviation_px: root mean square of one coordinate, px, wrong matches cut.
        uncorrelated_px: what would be left of that without the part that neighbours share.
    """

    value: float
    deviation: float
    deviation_px: float
    uncorrelated_px: float

    @property
    def significant(self) -> bool:
        """Whether noise alone does not explain it."""
        return self.value > 4.0 * self.deviation


def spatial_correlation(image: Index, pixels: Array, residuals: Array) -> SpatialCorrelation | None:
    """Correlation of residuals with those of their nearest neighbours in the image.

    Args:
        image: (N,) image of each observation.
        pixels: (N, 2) keypoints.
        residuals: (N, 2) px.

    Returns:
        None where no image has more than a few keypoints.
    """
    from scipy.spatial import cKDTree

    spread = 1.4826 * float(np.median(np.abs(residuals)))
    if not spread > 0:
        return None
    cut = np.clip(residuals, -_CLIP * spread, _CLIP * spread)
    product, count = 0.0, 0
    for i in np.unique(image).tolist():
        mine = np.flatnonzero(image == i)
        if len(mine) <= 2 * _NUM_NEIGHBOURS:
            continue
        # The mean belongs to the pose, whose noise is none of the surface's.
        error = cut[mine] - cut[mine].mean(axis=0)
        _, near = cKDTree(pixels[mine]).query(pixels[mine], k=_NUM_NEIGHBOURS + 1)
        neighbours = error[near[:, 1:]].mean(axis=1)
        product += float((error * neighbours).sum())
        count += 2 * len(mine)
    if not count:
        return None
    variance = float((cut**2).mean())
    value = float(np.clip(product / count / variance, -1.0, 1.0))
    # Each pair counts about twice, and the two coordinates are independent.
    deviation = float(np.sqrt(2.0 / (_NUM_NEIGHBOURS * count)))
    total = float(np.sqrt(variance))
    return SpatialCorrelation(
        value=value,
        deviation=deviation,
        deviation_px=total,
        uncorrelated_px=total * float(np.sqrt(max(1.0 - max(value, 0.0), 0.0))),
    )
