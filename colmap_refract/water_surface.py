"""A water surface that is not flat: heights at nodes over an image's plane, and the smoothest field through them.

Let the image's plane be `n . x = d` in its camera's frame and `e1`, `e2` the surface's axes along it. A point `S` of
the surface has the place `(e1 . S, e2 . S)` and obeys `n . S = d + h(place)`: a height is counted along the normal,
positive towards the water, so that crests of a surface that is seen from above are negative. The surface's own
normal is `n - e1 dh/dx - e2 dh/dy`, made a unit vector.

Between the nodes the surface is the most probable one of a random field with the covariance
`exp(-r^2 / (2 L^2))` of the distance `r` along the plane, `L` the correlation length (kriging). Beyond the nodes that
field knows less and less and returns to the plane within two or three `L`. A sinusoid of wavelength `w` looks like it
near its crests with `L = w / (sqrt(2) pi)`. Where nodes are closer than that `L`, hardly anything is left to chance
between them, so that fields of other statistics come out the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array

_LEAST_VARIANCE = 5e-11
"""Of the largest. Nodes closer than `L` say nearly the same, and what they could say besides is lost in rounding."""
_MOST_NEWTON_STEPS = 50
_NEWTON_TOLERANCE = 1e-8
"""Of the ray's length. Newton converges quadratically: after a step as small as this the error is of rounding size."""
_NODE_SPACING = 0.4
"""Correlation lengths between nodes: closer ones say nothing new, farther ones leave gaps."""
_MARGIN = 1.2
"""Correlation lengths that nodes reach beyond what is asked for, whose edges would otherwise sag to the plane."""
_MOST_NODES = 10_000


@dataclass(frozen=True, kw_only=True, eq=False)
class WaterSurface:
    """The water's surface over the plane of one image; all lengths in one unit.

    Attributes:
        axes: (3, 2) orthonormal columns `e1`, `e2` along the plane, camera frame.
        x: (nx,) places of the nodes along `e1`, increasing.
        y: (ny,) places of the nodes along `e2`, increasing.
        heights: (ny, nx) at the nodes, along the plane's normal, positive towards the water. The surface goes through
            them as far as a field of this correlation length can: parts of them that have less than 5e-11 of the
            largest variance in such a field are left out.
        correlation_length: `L`, > 0.
        slope_deviation: root mean square slope over both axes that the field was expected to have, a tangent; for
            information.

    Raises:
        RefractError: arrays of other shapes, numbers that are not finite, nodes in disorder, axes that are not
            orthonormal, a length that is not positive.
    """

    axes: Array
    x: Array
    y: Array
    heights: Array
    correlation_length: float
    slope_deviation: float | None = None

    def __post_init__(self) -> None:
        if np.shape(self.axes) != (3, 2) or not np.allclose(self.axes.T @ self.axes, np.eye(2), rtol=0, atol=1e-6):
            raise RefractError("the axes of a surface are not two orthonormal vectors; normalise them")
        for name, nodes in (("x", self.x), ("y", self.y)):
            if np.ndim(nodes) != 1 or not len(nodes) or not (np.isfinite(nodes).all() and (np.diff(nodes) > 0).all()):
                raise RefractError(f"{name} of a surface's nodes is not a list of increasing numbers; sort the nodes")
        if np.shape(self.heights) != (len(self.y), len(self.x)):
            raise RefractError(
                f"heights of a surface have the shape {np.shape(self.heights)}, its nodes "
                f"{(len(self.y), len(self.x))}; give a row per y and a column per x"
            )
        if not np.isfinite(self.heights).all():
            raise RefractError("heights of a surface are not all finite numbers; leave such a surface out")
        if not (np.isfinite(self.correlation_length) and self.correlation_length > 0):
            raise RefractError(f"correlation_length {self.correlation_length:g} of a surface is not positive")
        deviation = self.slope_deviation
        if deviation is not None and not (np.isfinite(deviation) and deviation >= 0):
            raise RefractError(f"slope_deviation {deviation:g} of a surface is negative; it is a root mean square")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, WaterSurface):
            return NotImplemented
        scalars = (self.correlation_length, self.slope_deviation)
        return scalars == (other.correlation_length, other.slope_deviation) and all(
            np.array_equal(mine, its)
            for mine, its in (
                (self.axes, other.axes), (self.x, other.x), (self.y, other.y), (self.heights, other.heights),
            )
        )  # fmt: skip

    __hash__ = None  # type: ignore[assignment]  # arrays may be altered

    def scaled(self, factor: float) -> WaterSurface:
        """The same surface in units `factor` times smaller, so that lengths become `factor` times larger."""
        return WaterSurface(
            axes=self.axes,
            x=factor * self.x,
            y=factor * self.y,
            heights=factor * self.heights,
            correlation_length=factor * self.correlation_length,
            slope_deviation=self.slope_deviation,
        )

    def covers(self, places: Array) -> NDArray[np.bool_]:
        """Which places (n, 2) are within the rectangle of the nodes, (n,); not those that are not a number."""
        low, high = np.array([self.x[0], self.y[0]]), np.array([self.x[-1], self.y[-1]])
        return np.asarray(((places >= low) & (places <= high)).all(axis=1))

    def height_and_slopes(self, places: Array) -> Array:
        """(n, 3) height, `dh/dx` and `dh/dy` at places (n, 2) on the plane; zero far from the nodes."""
        length = self.correlation_length
        apart_x, apart_y = places[:, :1] - self.x, places[:, 1:] - self.y
        along_x, along_y = self._correlation(apart_x), self._correlation(apart_y)
        lines = along_y @ self._weights
        return np.column_stack(
            [
                np.einsum("nx,nx->n", lines, along_x),
                np.einsum("nx,nx->n", lines, along_x * -apart_x / length**2),
                np.einsum("nx,nx->n", (along_y * -apart_y / length**2) @ self._weights, along_x),
            ]
        )

    def local_planes(self, directions: Array, normal: Array, distance: float) -> tuple[Array, Array]:
        """The tangent planes of the surface where rays from the projection centre meet it.

        Args:
            directions: (n, 3) unit directions, camera frame.
            normal: (3,) unit normal of the image's plane, into the water.
            distance: of that plane, > 0.

        Returns:
            `(normals, distances)`, (n, 3) and (n,), as of a plane. Not a number for a ray that runs along the plane or
            away from it, that meets the surface from the water's side, or that none is found for. A ray meets the
            surface once where the slope towards it is below the cotangent of its angle to the normal; where it is
            steeper, the crossing may be another than the first.
        """
        along = directions @ self.axes
        facing = directions @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(facing > 0, distance / facing, np.nan)
        normals = np.full(directions.shape, np.nan)
        active = np.flatnonzero(np.isfinite(reach))
        for _ in range(_MOST_NEWTON_STEPS):
            if not active.size:
                break
            at = self.height_and_slopes(reach[active, None] * along[active])
            closing = facing[active] - np.einsum("na,na->n", at[:, 1:], along[active])
            with np.errstate(divide="ignore", invalid="ignore"):
                step = (reach[active] * facing[active] - distance - at[:, 0]) / closing
            reach[active] -= step
            done = (np.abs(step) <= _NEWTON_TOLERANCE * reach[active]) & (closing > 0)
            normals[active[done]] = normal
            # Far outside it will not come back.
            active = active[~done & (np.abs(reach[active]) < 1e6 * distance)]
        found = np.flatnonzero(np.isfinite(normals[:, 0]))
        slopes = self.height_and_slopes(reach[found, None] * along[found])[:, 1:]
        normals[found] -= slopes @ self.axes.T
        normals[found] /= np.linalg.norm(normals[found], axis=1, keepdims=True)
        facing_local = np.einsum("ni,ni->n", normals, directions)
        return normals, np.asarray(reach * facing_local)

    def _correlation(self, apart: Array) -> Array:
        return np.asarray(np.exp(-0.5 * (apart / self.correlation_length) ** 2))

    @cached_property
    def _weights(self) -> Array:
        """(ny, nx): correlations with the nodes times this are the height.

        The covariance of nodes on a grid is the Kronecker product of one along each axis, and so are its
        eigenvectors.
        """
        value_x, vector_x = np.linalg.eigh(self._correlation(self.x[:, None] - self.x))
        value_y, vector_y = np.linalg.eigh(self._correlation(self.y[:, None] - self.y))
        variance = value_y[:, None] * value_x
        kept = variance > _LEAST_VARIANCE * variance.max()
        coefficients = vector_y.T @ self.heights @ vector_x
        coefficients = np.divide(coefficients, variance, out=np.zeros_like(coefficients), where=kept)
        return np.asarray(vector_y @ coefficients @ vector_x.T)


def sampled(
    heights: Callable[[Array], Array],
    places: Array,
    *,
    axes: Array,
    correlation_length: float,
    slope_deviation: float | None = None,
) -> WaterSurface:
    """The surface through heights that are known as a function, with nodes over given places and a little beyond.

    Args:
        heights: of places (m, 2) on the plane, (m,), positive towards the water.
        places: (n, 2), at least one, that the surface is wanted at.
        axes: (3, 2) of the plane, camera frame.
        correlation_length: of the heights, in the units of the places. Nodes are 0.4 of it apart; where those would
            be more than about 10 000 they are farther apart, and the surface's correlation length is larger as well.
        slope_deviation: to be noted with the surface.

    Returns:
        `WaterSurface`. For a random field of a dominant wavelength `w` and `correlation_length = w / (sqrt(2) pi)`, its
        slopes at the places are the field's own to about a five-hundredth.
    """
    low, high = places.min(axis=0), places.max(axis=0)
    low, high = low - _MARGIN * correlation_length, high + _MARGIN * correlation_length
    spacing = max(_NODE_SPACING * correlation_length, float(np.sqrt(np.prod(high - low) / _MOST_NODES)))
    x, y = (np.linspace(a, b, int(np.ceil((b - a) / spacing)) + 1) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    return WaterSurface(
        axes=axes,
        x=x,
        y=y,
        # Row by row, for the memory of what is evaluated.
        heights=np.array([heights(row) for row in grid]),
        correlation_length=max(correlation_length, spacing / _NODE_SPACING),
        slope_deviation=slope_deviation,
    )
