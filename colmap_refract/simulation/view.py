"""One image to be: what its pixels show, and where points are seen in it, through plane or wavy surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, plane_in_cam
from colmap_refract.simulation.least_path import least_path_direction
from colmap_refract.simulation.surface import Surface
from colmap_refract.simulation.terrain import Terrain
from colmap_refract.simulation.wave_path import stationary_crossings

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class View:
    """One image to be: who takes it, from where, through what."""

    camera: pycolmap.Camera
    cam_from_world: Array
    """(3, 4), metres."""
    surface: Surface

    @property
    def center(self) -> Array:
        """Projection centre (3,) in the world."""
        return np.asarray(-self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3])

    def rays(self, pixels: ArrayLike) -> Array:
        """Unit directions (n, 3), in the world, of the light that makes pixels (n, 2); not a number where none does."""
        places = np.ascontiguousarray(np.asarray(pixels, dtype=np.float64).reshape(-1, 2))
        return np.asarray(self.camera.cam_ray_from_img(places)) @ self.cam_from_world[:, :3]

    def check(self) -> None:
        """Raises RefractError where the camera is not on the dry side of its surface."""
        if not self.surface.depth_below(self.center)[0] < 0:
            raise RefractError("a camera is below the surface: raise it, or lower the surface or its waves")


def trace(view: View, terrain: Terrain, pixels: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """The points of the ground that pixels show.

    Args:
        view: camera, pose and surface.
        terrain: the ground.
        pixels: (n, 2), COLMAP's origin.

    Returns:
        points (n, 3) in the world, and whether there is one (n,): not where a ray misses the ground or is reflected
        totally; such points are not a number.

    Raises:
        RefractError: the camera is under its surface.
    """
    from colmap_refract.simulation import ray_tracing

    view.check()
    directions = np.ascontiguousarray(view.rays(pixels))
    points, became = np.empty_like(directions), np.empty(len(directions), dtype=np.int64)
    ray_tracing.trace_rays(
        view.center,
        directions,
        *optics(view.surface),
        terrain.top,
        terrain.coefficients,
        terrain.ground,
        points,
        became,
    )
    return points, became != ray_tracing.MISSED


def project(view: View, points: ArrayLike, *, near: ArrayLike | None = None) -> Array:
    """The pixels at which points are seen, by stationary optical path (Fermat).

    This knows nothing of Snell's law, so that it checks `trace`. Through waves a point may be seen more than once; it
    is then the image that Newton's method finds from `near`, or from where the mean plane would show it.

    Args:
        view: camera, pose and surface.
        points: (n, 3) in the world. Those above the surface are seen straight; what hides a point is not asked.
        near: (n, 2) pixels to begin from.

    Returns:
        (n, 2) pixels, also outside the image; not a number where no path was found or the camera model has no pixel.

    Raises:
        RefractError: the camera is under its surface.
    """
    view.check()
    xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    rotation, translation, surface = view.cam_from_world[:, :3], view.cam_from_world[:, 3], view.surface
    in_cam = xyz @ rotation.T + translation
    plane = plane_in_cam(surface.normal, surface.offset, rotation, translation)
    flat = not len(surface.waves)
    directions = least_path_direction(in_cam, *plane, surface.layers) if flat or near is None else in_cam.copy()
    if not flat:
        wet = surface.depth_below(xyz) > 0
        start = view.rays(near) if near is not None else directions @ rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (surface.offset - view.center @ surface.normal) / (start[wet] @ surface.normal)
        begin = (view.center + reach[:, None] * start[wet])[:, :2]
        crossing = stationary_crossings(surface, view.center, xyz[wet], begin)
        directions = in_cam
        directions[wet] = (crossing - view.center) @ rotation.T
    pixels = np.full((len(xyz), 2), np.nan)
    sound = np.isfinite(directions).all(axis=1)
    if sound.any():
        pixels[sound] = view.camera.img_from_cam(np.ascontiguousarray(directions[sound]))
    return pixels


def optics(surface: Surface) -> tuple[Array, Array, Array, Array]:
    """Plane, waves, media and walls as `ray_tracing` takes them."""
    media = np.array([1.0, *surface.layers.index])
    plane = np.array([*surface.normal, surface.offset])
    return plane, surface.waves, media, np.array(surface.layers.thickness, dtype=np.float64)
