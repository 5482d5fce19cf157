"""A water surface as a random field: what its height and slopes at one place say of those at another.

Waves are a sum of sinusoids that run in all directions, each with a phase of its own. Then heights are jointly normal,
with a covariance that depends on the distance `r` along the plane only: the mean over the sinusoids' wave numbers `k`
of `(a^2 / 2) J0(k r)` (Longuet-Higgins 1957). Slopes are the derivatives of the height and follow from it, so that
the field is a surface that can be. Water has no waves of endless length, and so no constant tilt or lift: those
belong to the plane. Two numbers say all: the slope deviation, and the dominant wavelength, about which the lengths
of the sinusoids scatter.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from colmap_refract.estimator.correlation import TABLE_STEP, correlate
from colmap_refract.interface import Array

_SPREAD = 0.35
"""Standard deviation of the logarithm of the wavelengths: most lie within a factor of two of the dominant one."""
_NUM_LENGTHS = 41
_FARTHEST = 40.0
"""Dominant wavelengths at which nothing is left of the correlation."""
_MOST_NODES = 400
_NODE_SPACING = 0.1
"""Dominant wavelengths between nodes."""
_MARGIN = 0.1
"""Dominant wavelengths that the nodes reach beyond what is seen."""


@cache
def _profiles() -> Array:
    """Covariance of heights by distance, for a unit wavelength and a unit slope deviation, and its derivative.

    (n, 8): cubics of both, highest power first, between distances `TABLE_STEP` apart.
    """
    from scipy.interpolate import CubicSpline
    from scipy.special import j0, j1

    deviate = np.linspace(-3.0, 3.0, _NUM_LENGTHS)
    share = np.exp(-0.5 * deviate**2)
    k = 2.0 * np.pi * np.exp(-_SPREAD * deviate)
    # Each sinusoid's (a k)^2 / 2 is its part of the mean square slope.
    variance = share / share.sum() / k**2
    distance = np.arange(0.0, _FARTHEST, TABLE_STEP)
    heights = CubicSpline(distance, j0(np.outer(distance, k)) @ variance)
    derivative = CubicSpline(distance, -j1(np.outer(distance, k)) @ (variance * k))
    return np.ascontiguousarray(np.concatenate([heights.c, derivative.c]).T)


@dataclass(frozen=True, kw_only=True)
class RandomSurface:
    """Statistics of a surface's waves.

    Attributes:
        slope_deviation: root mean square slope over both axes, a tangent.
        wavelength: the dominant one, in the units of the places that are asked for.
    """

    slope_deviation: float
    wavelength: float

    def covariance(self, places: Array, nodes: Array) -> Array:
        """(n, 3, m) covariances of (height, slope, slope) at places (n, 2) with the heights at nodes (m, 2)."""
        covariance = np.empty((len(places), 3, len(nodes)))
        correlate(
            np.ascontiguousarray(places / self.wavelength), np.ascontiguousarray(nodes / self.wavelength), _profiles(),
            _FARTHEST - 1.0, covariance,
        )  # fmt: skip
        covariance *= self.slope_deviation**2 * self.wavelength
        covariance[:, 0] *= self.wavelength
        return covariance


def node_grid(places: Array, wavelength: float) -> Array:
    """Nodes (m, 2) of a regular grid over places (n, 2) and a little beyond, a small part of a wavelength apart.

    Where that would be too many nodes they are farther apart.
    """
    margin = _MARGIN * wavelength
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    width, height = high - low
    # Of (width / spacing + 2) (height / spacing + 2) nodes there are no more than so many.
    spare = _MOST_NODES - 4
    least = (width + height + np.sqrt((width + height) ** 2 + spare * width * height)) / spare
    spacing = max(_NODE_SPACING * wavelength, least)
    x, y = (np.linspace(a, b, int(np.ceil((b - a) / spacing)) + 1) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, kw_only=True)
class Modes:
    """The leading modes of a random surface's heights at nodes: its most probable shapes, uncorrelated.

    With coefficients of unit variance, `heights_at_nodes = shapes @ coefficients`; between the nodes the surface is
    the most probable one through them (kriging).

    Attributes:
        surface: whose modes they are.
        nodes: (m, 2).
        shapes: (m, K), by falling variance.
        weights: (m, K), `shapes` divided by the variances: covariances with the nodes times this are the modes.
    """

    surface: RandomSurface
    nodes: Array
    shapes: Array
    weights: Array

    def at(self, places: Array) -> Array:
        """(n, 3, K) height and slopes of each mode at places (n, 2)."""
        return self.surface.covariance(places, self.nodes) @ self.weights


def modes(surface: RandomSurface, nodes: Array, most: int) -> Modes:
    """The leading modes, as many as there are above rounding but no more than `most`."""
    covariance = surface.covariance(nodes, nodes)[:, 0]
    variance, vectors = np.linalg.eigh(covariance)
    kept = np.argsort(variance)[::-1][:most]
    kept = kept[variance[kept] > 1e-10 * variance[-1]]
    deviation = np.sqrt(variance[kept])
    return Modes(
        surface=surface, nodes=nodes, shapes=vectors[:, kept] * deviation, weights=vectors[:, kept] / deviation
    )
