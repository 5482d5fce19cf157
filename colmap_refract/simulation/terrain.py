"""The ground under the water: a smooth height field over a grid, or a flat board."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array


@dataclass(frozen=True, kw_only=True)
class Terrain:
    """z over x and y in the world, metres, z down: a plane and a cubic B-spline through heights on a grid.

    The spline interpolates, has continuous curvature and a slope that is known to be bounded, so that rays meet it
    safely; normal to the edges its slope is zero. The plane is added to it. Nothing is beyond `low` and `high`.
    """

    heights: Array
    """(ny, nx) z at the nodes, at least (2, 2)."""
    origin: tuple[float, float]
    """x and y of the node [0, 0], which is a corner."""
    spacing: float
    """Between neighbouring nodes."""
    slope: tuple[float, float] = (0.0, 0.0)
    """dz/dx and dz/dy of the plane."""

    def __post_init__(self) -> None:
        if self.heights.ndim != 2 or min(self.heights.shape) < 2 or not np.isfinite(self.heights).all():
            raise RefractError("a terrain needs finite heights on a grid of at least 2 x 2 nodes")
        if not self.spacing > 0:
            raise RefractError(f"a terrain's spacing of {self.spacing:g} m is not positive")

    @property
    def low(self) -> Array:
        """Least x and y, (2,)."""
        return np.array(self.origin)

    @property
    def high(self) -> Array:
        """Largest x and y, (2,)."""
        return self.low + self.spacing * (np.array(self.heights.shape[::-1]) - 1)

    @cached_property
    def coefficients(self) -> Array:
        """(ny + 4, nx + 4), mirrored at the edges by two nodes; for `ray_tracing`."""
        from scipy.ndimage import spline_filter

        exact = np.asarray(self.heights, dtype=np.float64)
        filtered = exact if np.ptp(exact) == 0 else spline_filter(exact, order=3, mode="mirror")
        # A grid of two nodes has but one to mirror; np.pad then reflects to and fro, as the filter does.
        return np.ascontiguousarray(np.pad(filtered, 2, mode="reflect"))

    @cached_property
    def ground(self) -> Array:
        """(11,) for `ray_tracing`."""
        change = [np.abs(np.diff(self.coefficients, axis=axis)).max() / self.spacing for axis in (1, 0)]
        bound = float(np.hypot(change[0] + abs(self.slope[0]), change[1] + abs(self.slope[1])))
        (x0, y0), (x1, y1) = self.low, self.high
        return np.array([x0, y0, self.spacing, 0.0, *self.slope, bound, x0, x1, y0, y1])

    @cached_property
    def top(self) -> float:
        """A z that all of the terrain lies below."""
        corners = np.outer([0, 1], self.high - self.low) + self.low
        plane = min(x * self.slope[0] + y * self.slope[1] for x in corners[:, 0] for y in corners[:, 1])
        return float(self.coefficients.min() + plane) - 1e-9

    def height(self, xy: ArrayLike) -> Array:
        """z (n,) at (n, 2) places; beyond the edge that of the edge."""
        return self._relief(xy)[:, 0]

    def gradient(self, xy: ArrayLike) -> Array:
        """dz/dx and dz/dy (n, 2) at (n, 2) places."""
        return self._relief(xy)[:, 1:]

    def _relief(self, xy: ArrayLike) -> Array:
        from colmap_refract.simulation.ray_tracing import relief_of

        places = np.ascontiguousarray(np.asarray(xy, dtype=np.float64).reshape(-1, 2))
        out = np.empty((len(places), 3))
        relief_of(places, self.coefficients, self.ground, out)
        return out


def flat_board(low: ArrayLike, high: ArrayLike, z: float, *, slope: tuple[float, float] = (0.0, 0.0)) -> Terrain:
    """A flat board over the square that starts at `low` (x, y) and reaches `high` at least; `z` at its middle."""
    first, last = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    spacing = float((last - first).max()) / 3
    nodes = np.maximum(np.ceil((last - first) / spacing - 1e-9).astype(int) + 1, 2)
    middle = 0.5 * (first + last)
    heights = np.full((nodes[1], nodes[0]), z - middle @ slope)
    return Terrain(heights=heights, origin=(float(first[0]), float(first[1])), spacing=spacing, slope=slope)


def hilly_ground(
    low: ArrayLike,
    high: ArrayLike,
    z: float,
    *,
    relief: float,
    hill_size: float,
    roughness: float = 0.25,
    seed: int = 0,
) -> Terrain:
    """A ground of smooth hills with boulders on them.

    Args:
        low, high: (2,) the x and y that it reaches over at least, metres.
        z: its mean height.
        relief: from its deepest to its highest place, metres.
        hill_size: metres from hill to hill, about.
        roughness: part of the relief that is boulders and hollows, a fifth of the hills' size and less.
        seed: determines it.

    Raises:
        RefractError: a relief below 0, a hill_size or an area that is not positive.
    """
    first, last = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if not (relief >= 0 and hill_size > 0 and (last > first).all() and 0 <= roughness <= 1):
        raise RefractError("hilly ground needs a relief >= 0, a hill_size > 0, a roughness of 0 to 1, and an area")
    rng = np.random.default_rng(seed)
    spacing = hill_size / 32
    nx, ny = (np.ceil((last - first) / spacing).astype(int) + 1).tolist()
    x, y = np.meshgrid(first[0] + spacing * np.arange(nx), first[1] + spacing * np.arange(ny))
    hills = np.zeros((ny, nx))
    for _ in range(12):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        k = 2 * np.pi / (hill_size * rng.uniform(0.8, 1.6))
        hills += np.sin(k * (x * np.cos(angle) + y * np.sin(angle)) + phase) / np.sqrt(k)
    rough = np.zeros((ny, nx))
    for _ in range(int(12 * np.prod((last - first) / hill_size)) + 8):
        cx, cy = rng.uniform(first, last)
        # Half of the width where it is half as high; not less than two nodes, for the spline to follow.
        size = hill_size * rng.uniform(0.07, 0.16)
        height = size * rng.choice([-1.0, -1.0, -1.0, 0.6])
        reach = int(np.ceil(2.2 * size / spacing))
        i, j = int((cx - first[0]) / spacing), int((cy - first[1]) / spacing)
        here = np.s_[max(0, j - reach) : j + reach + 1, max(0, i - reach) : i + reach + 1]
        far = ((x[here] - cx) ** 2 + (y[here] - cy) ** 2) / size**2
        rough[here] += height * np.exp(-np.log(2) * far * np.sqrt(far))
    shape = (1 - roughness) * _unit(hills) + roughness * _unit(rough)
    # Single precision, so that heights that were stored are these.
    heights = (z + relief * (_unit(shape) - _unit(shape).mean())).astype(np.float32)
    return Terrain(heights=heights.astype(np.float64), origin=(float(first[0]), float(first[1])), spacing=spacing)


def _unit(values: Array) -> Array:
    """Brought to 0 ... 1."""
    return np.asarray((values - values.min()) / max(np.ptp(values), 1e-12))
