"""A water surface as a random field: what its height and slopes at one place say of those at another.

Waves are a sum of sinusoids that run in all directions, each with a phase of its own. Then heights are jointly normal,
with a covariance that depends on the distance `r` along the plane only: the mean over the sinusoids' wave numbers `k`
of `(a^2 / 2) J0(k r)` (Longuet-Higgins 1957). Slopes are the derivatives of the height and follow from it, so that
the field is a surface that can be. Water has no waves of endless length, and so no constant tilt or lift: those
belong to the plane. Two numbers say all: the slope deviation, and the dominant wavelength, about which the lengths
of the sinusoids scatter.

Beside it are slopes that belong to no surface (`RandomSlopes`), the freedom that the paper's normals have.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol

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
_LOOSENESS = 0.01
"""Of the slope deviation: how closely a surface follows slopes that none may have."""
_MARGIN = 0.1
"""Dominant wavelengths that the nodes reach beyond what is seen."""


def _spectrum() -> tuple[Array, Array]:
    """Parts of the mean square slope that sinusoids of some wave numbers have, for a unit wavelength."""
    deviate = np.linspace(-3.0, 3.0, _NUM_LENGTHS)
    share = np.exp(-0.5 * deviate**2)
    return share / share.sum(), 2.0 * np.pi * np.exp(-_SPREAD * deviate)


@cache
def _profiles() -> Array:
    """Covariance of heights by distance, for a unit wavelength and a unit slope deviation, and its derivative.

    (n, 8): cubics of both, highest power first, between distances `TABLE_STEP` apart.
    """
    from scipy.interpolate import CubicSpline
    from scipy.special import j0, j1

    share, k = _spectrum()
    # Each sinusoid's (a k)^2 / 2 is its part of the mean square slope.
    variance = share / k**2
    distance = np.arange(0.0, _FARTHEST, TABLE_STEP)
    heights = CubicSpline(distance, j0(np.outer(distance, k)) @ variance)
    derivative = CubicSpline(distance, -j1(np.outer(distance, k)) @ (variance * k))
    return np.ascontiguousarray(np.concatenate([heights.c, derivative.c]).T)


@cache
def _slope_profile() -> Array:
    """As `_profiles`, of one slope alone; the columns of a derivative are of no use."""
    from scipy.interpolate import CubicSpline
    from scipy.special import j0

    share, k = _spectrum()
    distance = np.arange(0.0, _FARTHEST, TABLE_STEP)
    slope = CubicSpline(distance, 0.5 * (j0(np.outer(distance, k)) @ share))
    return np.ascontiguousarray(np.concatenate([slope.c, np.zeros_like(slope.c)]).T)


def _tabulated(places: Array, nodes: Array, wavelength: float, table: Array) -> Array:
    """(n, 3, m) covariances from a table, for a unit wavelength and slope deviation."""
    covariance = np.empty((len(places), 3, len(nodes)))
    places, nodes = (np.ascontiguousarray(at / wavelength) for at in (places, nodes))
    correlate(places, nodes, table, _FARTHEST - 1.0, covariance)
    return covariance


class RandomField(Protocol):
    """A random height and random slopes at each place, and what nodes say of them."""

    @property
    def slope_deviation(self) -> float:
        """Root mean square slope over both axes, a tangent."""

    @property
    def wavelength(self) -> float:
        """The dominant one."""

    def covariance(self, places: Array, nodes: Array) -> Array:
        """(n, 3, M) of (height, slope, slope) at places (n, 2) with what the nodes (m, 2) hold, M numbers."""

    def between_nodes(self, nodes: Array) -> Array:
        """(M, M) covariance of what the nodes hold."""


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
        covariance = _tabulated(places, nodes, self.wavelength, _profiles())
        covariance *= self.slope_deviation**2 * self.wavelength
        covariance[:, 0] *= self.wavelength
        return covariance

    def between_nodes(self, nodes: Array) -> Array:
        """(m, m) covariance of the heights at nodes (m, 2)."""
        return self.covariance(nodes, nodes)[:, 0]


@dataclass(frozen=True, kw_only=True)
class RandomSlopes:
    """Statistics of slopes that need not be those of any surface; there are no heights.

    Each of the two slopes is a field of its own, with the variance and the spectrum that the slopes of a
    `RandomSurface` have on average over directions. The normals of the paper's soft constraint are as free.

    Attributes:
        slope_deviation, wavelength: as of a `RandomSurface`.
    """

    slope_deviation: float
    wavelength: float

    def covariance(self, places: Array, nodes: Array) -> Array:
        """(n, 3, 2 m) covariances of (height, slope, slope) at places (n, 2) with all first, then all second slopes
        at nodes (m, 2)."""
        slope = self.slope_deviation**2 * _tabulated(places, nodes, self.wavelength, _slope_profile())[:, 0]
        covariance = np.zeros((len(places), 3, 2 * len(nodes)))
        covariance[:, 1, : len(nodes)] = covariance[:, 2, len(nodes) :] = slope
        return covariance

    def between_nodes(self, nodes: Array) -> Array:
        """(2 m, 2 m) covariance of the slopes at nodes (m, 2)."""
        return self.covariance(nodes, nodes)[:, 1:].transpose(1, 0, 2).reshape(2 * len(nodes), -1)


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
    """The leading modes of what a random field has at nodes: its most probable shapes, uncorrelated.

    With coefficients of unit variance, `heights_at_nodes = shapes @ coefficients`, or the slopes at the nodes for
    `RandomSlopes`; between the nodes the field is the most probable one through them (kriging).

    Attributes:
        surface: whose modes they are.
        nodes: (m, 2).
        shapes: (M, K), by falling variance.
        weights: (M, K), `shapes` divided by the variances: covariances with the nodes times this are the modes.
    """

    surface: RandomField
    nodes: Array
    shapes: Array
    weights: Array

    def at(self, places: Array) -> Array:
        """(n, 3, K) height and slopes of each mode at places (n, 2)."""
        return self.surface.covariance(places, self.nodes) @ self.weights


def modes(surface: RandomField, nodes: Array, most: int) -> Modes:
    """The leading modes, as many as there are above rounding but no more than `most`."""
    variance, vectors = np.linalg.eigh(surface.between_nodes(nodes))
    kept = np.argsort(variance)[::-1][:most]
    kept = kept[variance[kept] > 1e-10 * variance[-1]]
    deviation = np.sqrt(variance[kept])
    return Modes(
        surface=surface, nodes=nodes, shapes=vectors[:, kept] * deviation, weights=vectors[:, kept] / deviation
    )


def closest_surface(slopes: Modes, coefficients: Array) -> tuple[Modes, Array]:
    """The most probable surface that has the slopes of a field of free slopes at its nodes, as nearly as one can.

    Args:
        slopes: modes of `RandomSlopes`.
        coefficients: (K,) of them.

    Returns:
        Modes of a `RandomSurface` of the same statistics at the same nodes, all of them, and their coefficients.
    """
    field = slopes.surface
    surface = RandomSurface(slope_deviation=field.slope_deviation, wavelength=field.wavelength)
    found = modes(surface, slopes.nodes, len(slopes.nodes))
    design = found.at(slopes.nodes)[:, 1:].reshape(-1, found.shapes.shape[1])
    wanted = (slopes.at(slopes.nodes)[:, 1:] @ coefficients).ravel()
    weight = 1.0 / (_LOOSENESS * field.slope_deviation) ** 2
    system = weight * design.T @ design + np.eye(design.shape[1])
    return found, np.asarray(np.linalg.solve(system, weight * design.T @ wanted))
