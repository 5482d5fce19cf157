"""Interfaces: planes in a camera's frame or in the world, and the media that lie behind them.

Conventions, used by every other module:

- `normal_in_cam` is a unit vector that points from the camera into the water.
- `distance` is measured from the projection centre to the plane along that normal.
- In the world the same plane is `normal_in_world . x = offset`.
- A refractive index is relative to the medium that the camera is in (air, in the usual case).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Layers:
    """The media behind the first interface: walls of known thickness, then the water without end.

    `thickness` has one entry per wall, in model units (nearest the camera first); `index`
    has one entry per wall and a last one for the medium that the scene is in.
    """

    thickness: tuple[float, ...] = ()
    index: tuple[float, ...] = (1.333,)

    def __post_init__(self) -> None:
        if len(self.index) != len(self.thickness) + 1:
            raise RefractError(
                f"{len(self.thickness)} wall thicknesses need {len(self.thickness) + 1} refractive indices "
                f"(one per wall, then the water); got {len(self.index)}"
            )
        for mu in self.index:
            if not (np.isfinite(mu) and mu > 0):
                raise RefractError(f"refractive index {mu:g} is not positive; water is 1.333, glass about 1.52")
        for h in self.thickness:
            if not (np.isfinite(h) and h >= 0):
                raise RefractError(f"wall thickness {h:g} is negative; give it in the units of the model")

    @property
    def refractive_index(self) -> float:
        """Index of the medium the scene is in."""
        return self.index[-1]

    def scaled(self, factor: float) -> Layers:
        """The same media in units `factor` times smaller, so that lengths become `factor` times larger."""
        return Layers(thickness=tuple(factor * h for h in self.thickness), index=self.index)

    def with_index(self, refractive_index: float) -> Layers:
        """The same walls before another medium."""
        return Layers(thickness=self.thickness, index=(*self.index[:-1], refractive_index))


def tangent_basis(normal: Array) -> Array:
    """Two unit vectors orthogonal to `normal` and to each other, a smooth function of it.

    The camera's x axis is projected on the tangent plane (the y axis where the normal is within
    about 25 degrees of x), so that neighbouring normals have neighbouring bases.

    Args:
        normal: (3,) unit vector.

    Returns:
        (3, 2), columns `e1`, `e2` with `e1 x e2 = normal`.
    """
    axis = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    e1 = axis - (axis @ normal) * normal
    e1 /= np.linalg.norm(e1)
    return np.stack([e1, np.cross(normal, e1)], axis=1)


def plane_in_cam(normal_in_world: Array, offset: float, rotation: Array, translation: Array) -> tuple[Array, float]:
    """A world plane as `(normal_in_cam, distance)` of a camera with pose `x_cam = rotation @ x + translation`."""
    normal_in_cam = rotation @ normal_in_world
    return normal_in_cam, float(offset + normal_in_cam @ translation)


def plane_in_world(normal_in_cam: Array, distance: float, rotation: Array, translation: Array) -> tuple[Array, float]:
    """A camera's plane as `(normal_in_world, offset)`; the inverse of `plane_in_cam`."""
    return rotation.T @ normal_in_cam, float(distance - normal_in_cam @ translation)
