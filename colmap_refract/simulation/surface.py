"""The water's surface: a plane, level or tilted, with waves that travel over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers

GRAVITY = 9.81
# A wave breaks at a height of a seventh of its length (Michell 1893): a slope of pi / 7 = 0.45 at most.
BREAKING_SLOPE = np.pi / 7


@dataclass(frozen=True, kw_only=True)
class Wave:
    """One travelling sinusoid."""

    amplitude: float
    """Half of the height from trough to crest, metres."""
    wavelength: float
    """Metres, from crest to crest."""
    direction_deg: float = 0.0
    """Where it travels to, in the world's xy plane, degrees from x to y."""
    phase_deg: float = 0.0
    """At the world's origin at time 0, degrees."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.wavelength) and self.wavelength > 0):
            raise RefractError(f"wavelength {self.wavelength:g} is not positive; give metres from crest to crest")
        if not (np.isfinite(self.amplitude) and self.amplitude >= 0):
            raise RefractError(f"wave amplitude {self.amplitude:g} is negative; give metres from the mean to the crest")
        if self.amplitude * self.wave_number > BREAKING_SLOPE:
            raise RefractError(
                f"a wave of amplitude {self.amplitude:g} m and wavelength {self.wavelength:g} m would break; "
                f"the amplitude can be {BREAKING_SLOPE / self.wave_number:.2g} m at most"
            )

    @property
    def wave_number(self) -> float:
        """Radians per metre."""
        return 2 * np.pi / self.wavelength

    def period(self, water_depth: float = np.inf) -> float:
        """Seconds from crest to crest at a fixed place, by the dispersion of small gravity waves (Airy).

        `omega^2 = g k tanh(k h)`, with `k` the wave number and `h` the depth of the water in metres. Surface
        tension, which matters below 0.05 m of wavelength, is left out.
        """
        return float(2 * np.pi / np.sqrt(GRAVITY * self.wave_number * np.tanh(self.wave_number * water_depth)))


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A surface at one moment: the plane `normal . x = offset`, its z moved by the sum of sinusoids.

    World frame, z down into the water. `waves` (W, 4) holds kx, ky, amplitude and phase of
    `amplitude * sin(kx x + ky y + phase)`; without waves the plane may stand anyhow and have walls behind it.
    """

    normal: Array
    """(3,) unit, from the camera into the water."""
    offset: float
    """From the world's origin along the normal, metres."""
    layers: Layers = Layers()
    """Media behind the plane. Walls need a plane without waves."""
    waves: Array

    def __post_init__(self) -> None:
        if len(self.waves) and self.layers.thickness:
            raise RefractError("a wall does not make waves: leave out the waves or the layer_thickness")
        if len(self.waves) and not self.normal[2] > 0:
            raise RefractError("waves need a surface that is seen from above; its normal must have z > 0")

    def height(self, xy: ArrayLike) -> Array:
        """z (n,) of the surface at (n, 2) places, metres; infinite for an upright plane."""
        x, y = np.asarray(xy, dtype=np.float64).reshape(-1, 2).T
        with np.errstate(divide="ignore"):
            level = (self.offset - self.normal[0] * x - self.normal[1] * y) / self.normal[2]
        return np.asarray(level + np.sum(self.waves[:, 2] * np.sin(self._angles(x, y)), axis=1))

    def gradient(self, xy: ArrayLike) -> Array:
        """dz/dx and dz/dy (n, 2) of the surface at (n, 2) places."""
        x, y = np.asarray(xy, dtype=np.float64).reshape(-1, 2).T
        slope = self.waves[:, 2] * np.cos(self._angles(x, y))
        return np.asarray(slope @ self.waves[:, :2] - self.normal[:2] / self.normal[2])

    def curvature(self, xy: ArrayLike) -> Array:
        """Second derivatives (n, 2, 2) of z at (n, 2) places, per metre."""
        x, y = np.asarray(xy, dtype=np.float64).reshape(-1, 2).T
        bend = -self.waves[:, 2] * np.sin(self._angles(x, y))
        return np.asarray(np.einsum("nw,wa,wb->nab", bend, self.waves[:, :2], self.waves[:, :2]))

    def depth_below(self, points: ArrayLike) -> Array:
        """How far points (n, 3) are below the surface, along the plane's normal, metres: negative above it."""
        xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        wave = np.sum(self.waves[:, 2] * np.sin(self._angles(xyz[:, 0], xyz[:, 1])), axis=1)
        return np.asarray(xyz @ self.normal - self.offset - self.normal[2] * wave)

    @property
    def rms_slope(self) -> float:
        """Root mean square slope of the waves, over all places: `sqrt(sum (a k)^2 / 2)`."""
        return float(np.sqrt(0.5 * np.sum(self.waves[:, 2:3] ** 2 * self.waves[:, :2] ** 2)))

    def _angles(self, x: Array, y: Array) -> Array:
        return np.asarray(np.outer(x, self.waves[:, 0]) + np.outer(y, self.waves[:, 1]) + self.waves[:, 3])


def surface_at(
    normal: ArrayLike,
    offset: float,
    *,
    layers: Layers | None = None,
    waves: tuple[Wave, ...] = (),
    time: float = 0.0,
    water_depth: float = np.inf,
) -> Surface:
    """The surface at a moment.

    Args:
        normal: (3,) of the mean plane in the world, of any length, from the camera into the water.
        offset: of the mean plane along the unit normal, metres.
        layers: the media behind it; water by default.
        waves: sinusoids on it.
        time: seconds; the waves travel with the speed of gravity waves.
        water_depth: metres, for that speed. Infinite: deep water.

    Raises:
        RefractError: waves on a wall, waves on a plane that is not seen from above, or a time that is not finite.
    """
    unit = np.asarray(normal, dtype=np.float64)
    if not (unit.shape == (3,) and np.isfinite(unit).all() and np.linalg.norm(unit) > 0):
        raise RefractError(f"{unit.tolist()} is not the normal of a surface; give three numbers")
    if not (np.isfinite(time) and water_depth > 0):
        raise RefractError(f"waves at {time:g} s on {water_depth:g} m of water: the time must be finite, the depth > 0")
    rows = []
    for wave in waves:
        direction, phase = np.radians([wave.direction_deg, wave.phase_deg])
        k = wave.wave_number
        turned = np.remainder(phase - 2 * np.pi * time / wave.period(water_depth), 2 * np.pi)
        rows.append([k * np.cos(direction), k * np.sin(direction), wave.amplitude, turned])
    return Surface(
        normal=unit / np.linalg.norm(unit),
        offset=float(offset),
        layers=layers if layers is not None else Layers(),
        waves=np.array(rows, dtype=np.float64).reshape(-1, 4),
    )
