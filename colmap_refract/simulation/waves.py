"""Waves without end or direction: drawn at random, and how their heights and slopes go together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array
from colmap_refract.simulation.surface import BREAKING_SLOPE

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

# Enough for heights and slopes that are nearly normally distributed.
NUM_SINUSOIDS = 24


@dataclass(frozen=True, kw_only=True)
class WaveStatistics:
    """A random surface: sinusoids of random directions and phases, each with the same share of the slopes' variance.

    It is stationary and isotropic, with zero mean. Wavelengths are log-uniform in their band.
    """

    rms_slope: float
    """Root mean square of the gradient's length over all surfaces and places, a tangent; 0: flat."""
    wavelength: tuple[float, float]
    """Shortest and longest, metres."""

    def __post_init__(self) -> None:
        low, high = self.wavelength
        if not 0 < low <= high < np.inf:
            raise RefractError(
                f"wavelengths from {low:g} to {high:g} m are no band: give the shortest, > 0, then the longest"
            )
        if not self.rms_slope >= 0:
            raise RefractError("a wave slope cannot be negative: give 0, no waves, or more")
        # Of a sinusoid: its steepest place has sqrt(2) of its root mean square slope.
        steepest = BREAKING_SLOPE / np.sqrt(2)
        if self.rms_slope > steepest:
            raise RefractError(
                f"waves of {np.degrees(np.arctan(self.rms_slope)):g} degrees root mean square would break; "
                f"give {np.degrees(np.arctan(steepest)):.3g} degrees at most"
            )

    @property
    def rms_height(self) -> float:
        """Root mean square height over the mean level, metres."""
        low, high = self.wavelength
        mean_square = low**2 if low == high else (high**2 - low**2) / (2 * np.log(high / low))
        return float(self.rms_slope * np.sqrt(mean_square) / (2 * np.pi))

    def draw(self, rng: np.random.Generator, count: int = NUM_SINUSOIDS) -> Array:
        """One surface, as `Surface.waves` (count, 4): kx, ky, amplitude and phase of each sinusoid.

        One wavelength is from each of `count` equal parts of the band, so that every surface has long and short waves.
        """
        low, high = self.wavelength
        length = low * (high / low) ** ((np.arange(count) + rng.random(count)) / count)
        number = 2 * np.pi / length
        direction, phase = rng.uniform(0, 2 * np.pi, (2, count))
        amplitude = np.sqrt(2 / count) * self.rms_slope / number
        return np.stack([number * np.cos(direction), number * np.sin(direction), amplitude, phase], axis=1)

    def covariance(self, places: ArrayLike, others: ArrayLike | None = None) -> Array:
        """Covariance of z, dz/dx and dz/dy at places (n, 2) with those at others (m, 2), or at the same places.

        With the height's covariance `k(r)`, the mean over wave numbers of `s^2 / q^2 J0(q r)`, and the lag
        `d = y - x`: `cov(z(x), z_j(y)) = k_j(d)` and `cov(z_i(x), z_j(y)) = -k_ij(d)`.

        Returns:
            (n, 3, m, 3), metres and tangents; exact to about 1e-6 of the variances.
        """
        first = np.asarray(places, dtype=np.float64).reshape(-1, 2)
        second = first if others is None else np.asarray(others, dtype=np.float64).reshape(-1, 2)
        lag = second - first[:, None]
        distance = np.linalg.norm(lag, axis=2)
        # The table's reach in steps of octaves, so that one serves many calls.
        longest = self.wavelength[1]
        reach = longest * 2 ** np.ceil(np.log2(max(1.0, distance.max(initial=0.0) / longest)))
        height, slope, bend = np.moveaxis(_profiles(self.wavelength, float(reach))(distance), -1, 0)
        unit = lag / np.maximum(distance, 1e-300)[:, :, None]

        covariance = np.empty((len(first), 3, len(second), 3))
        covariance[:, 0, :, 0] = height
        for i in range(2):
            covariance[:, 0, :, 1 + i] = -slope * lag[:, :, i]
            covariance[:, 1 + i, :, 0] = slope * lag[:, :, i]
            for j in range(2):
                covariance[:, 1 + i, :, 1 + j] = slope * (i == j) - bend * unit[:, :, i] * unit[:, :, j]
        return self.rms_slope**2 * covariance


@lru_cache(maxsize=4)
def _profiles(wavelength: tuple[float, float], reach: float) -> CubicSpline:
    """`k`, `-k' / r` and `k'' - k' / r` by the distance, up to a reach, for a root mean square slope of 1.

    Interpolated in steps of a fiftieth of the shortest wave, which leaves 1e-6 of the value at 0.
    """
    from scipy.interpolate import CubicSpline
    from scipy.special import jv

    low, high = wavelength
    fastest, slowest = 2 * np.pi / low, 2 * np.pi / high
    # Gauss's rule takes half a node per radian that the longest and the shortest wave are apart.
    node, weight = np.polynomial.legendre.leggauss(32 + int(0.6 * reach * (fastest - slowest)))
    number = slowest * (fastest / slowest) ** (0.5 * (1 + node))
    distance = np.linspace(0, reach, 2 + int(50 * reach / low))
    values = np.empty((len(distance), 3))
    for rows in np.array_split(np.arange(len(distance)), 1 + len(distance) * len(number) // 1_000_000):
        angle = np.outer(distance[rows], number)
        j0, j2 = jv(0, angle), jv(2, angle)
        # J1(x) / x = (J0 + J2) / 2 has no hole at 0.
        values[rows] = np.stack([(j0 / number**2) @ weight, 0.5 * (j0 + j2) @ weight, j2 @ weight], axis=1)
    return CubicSpline(distance, 0.5 * values)
