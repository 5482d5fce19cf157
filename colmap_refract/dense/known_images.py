"""Images whose poses and interfaces are known, flat or with waves: rays of pixels, and pixels of points.

A pixel's ray is refracted by the plane of its image; where the water has waves, by the tangent plane of the surface
where the ray crosses it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError, listed
from colmap_refract.estimator.optics import back_project, project_direction
from colmap_refract.estimator.wavy_projection import project_through_surface
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.interface import Array
from colmap_refract.refiner.observations import Observations, read_observations

if TYPE_CHECKING:
    import pycolmap

Mask = NDArray[np.bool_]

_ROUND_TRIP = 0.01
"""Pixels that a ray may be off when it is projected again: beyond, the camera model has no ray there."""


@dataclass(frozen=True, kw_only=True)
class Rays:
    """The rays of n pixels of one image; NaN where there is none.

    Attributes:
        origin, ray: (n, 3) in the world, where each enters the medium of the scene, and its unit direction there.
        normal, distance: (n, 3), (n,) of the plane that refracts it, in the camera; NaN without an interface.
    """

    origin: Array
    ray: Array
    normal: Array
    distance: Array


class KnownImages:
    """The registered images of a refined model.

    Args:
        model: of the refiner; it is not altered.
        sidecar: its interfaces.

    Raises:
        RefractError: the sidecar does not speak of all images.
    """

    def __init__(self, model: pycolmap.Reconstruction, sidecar: Sidecar) -> None:
        self.sparse: Observations = read_observations(model)
        """The model's own observations."""
        self.names: list[str] = self.sparse.image_names
        missing = [name for name in self.names if name not in sidecar.images]
        if missing:
            raise RefractError(
                f"refraction.json has no entry for image {listed(missing)}: give the one that belongs to this model"
            )
        self.rotation, self.translation = self.sparse.cam_from_world
        self.layers = sidecar.layers
        self._interfaces = [sidecar.images[name] for name in self.names]
        self._walls = sum(self.layers.thickness)

    def camera(self, image: int) -> pycolmap.Camera:
        """That of an image, by index into `names`."""
        return self.sparse.cameras[int(self.sparse.image_camera[image])]

    def center(self, image: int) -> Array:
        """Projection centre (3,), world."""
        return np.asarray(-self.rotation[image].T @ self.translation[image])

    def in_cam(self, image: int, points: Array) -> Array:
        """Points (n, 3) of the world in an image's camera frame."""
        return np.asarray(points @ self.rotation[image].T + self.translation[image])

    def rays(self, image: int, pixels: Array) -> Rays:
        """The rays of pixels (n, 2) of an image behind its interface."""
        direction = self._directions(image, pixels)
        interface = self._interfaces[image]
        if interface.normal_in_cam is None or interface.distance is None:
            nowhere = np.full(len(pixels), np.nan)
            return Rays(
                origin=np.where(np.isfinite(direction), self.center(image), np.nan),
                ray=direction @ self.rotation[image],
                normal=np.full((len(pixels), 3), np.nan),
                distance=nowhere,
            )
        normal = np.array(interface.normal_in_cam)
        normals, distances = np.tile(normal, (len(pixels), 1)), np.full(len(pixels), interface.distance)
        if interface.surface is not None:
            with np.errstate(invalid="ignore"):
                normals, distances = interface.surface.local_planes(direction, normal, interface.distance)
        origin, ray = back_project(direction, normals, distances, self.layers)
        turn = self.rotation[image]
        return Rays(
            origin=(origin - self.translation[image]) @ turn, ray=ray @ turn, normal=normals, distance=distances
        )

    def straight(self, image: int, pixels: Array) -> Rays:
        """The rays of pixels (n, 2) as they are before the interface."""
        rays = self.rays(image, pixels)
        direction = self._directions(image, pixels)
        return replace(
            rays,
            origin=np.where(np.isfinite(direction), self.center(image), np.nan),
            ray=direction @ self.rotation[image],
        )

    def is_wet(self, image: int, rays: Rays, points: Array) -> Mask:
        """Which points (n, 3) lie behind the planes that `rays` cross; none without an interface."""
        with np.errstate(invalid="ignore"):
            depth = np.einsum("ni,ni->n", self.in_cam(image, points), rays.normal)
            return np.asarray(depth > rays.distance + self._walls)

    def pixels_through(self, image: int, rays: Rays, points: Array) -> Array:
        """Pixels (n, 2) at which points (n, 3) are seen through the planes that `rays` cross; NaN where not seen.

        With waves right only for points that the rays pass by closely.
        """
        with np.errstate(invalid="ignore"):
            direction = project_direction(
                self.in_cam(image, points),
                np.nan_to_num(rays.normal, nan=1.0),
                np.nan_to_num(rays.distance, nan=1.0),
                self.layers,
                self.is_wet(image, rays, points),
            )
        return self._pixels(image, direction)

    def project(self, image: int, points: Array) -> Array:
        """Pixels (n, 2) at which points (n, 3) are seen, also outside the picture; NaN where they are not."""
        in_cam, interface = self.in_cam(image, points), self._interfaces[image]
        if interface.normal_in_cam is None or interface.distance is None:
            return self._pixels(image, in_cam)
        normal = np.array(interface.normal_in_cam)
        if interface.surface is None:
            return self._pixels(image, project_direction(in_cam, normal, interface.distance, self.layers))
        return self._pixels(
            image, project_through_surface(in_cam, normal, interface.distance, self.layers, interface.surface)
        )

    def _directions(self, image: int, pixels: Array) -> Array:
        camera = self.camera(image)
        direction = np.full((len(pixels), 3), np.nan)
        there = np.flatnonzero(np.isfinite(pixels).all(axis=1))
        if len(there):
            ray = np.asarray(camera.cam_ray_from_img(np.ascontiguousarray(pixels[there], dtype=np.float64)))
            off = np.abs(np.asarray(camera.img_from_cam(ray)) - pixels[there]).max(axis=1)
            direction[there] = np.where((off < _ROUND_TRIP)[:, None], ray, np.nan)
        return direction

    def _pixels(self, image: int, in_cam: Array) -> Array:
        pixels = np.full((len(in_cam), 2), np.nan)
        sound = np.flatnonzero(np.isfinite(in_cam).all(axis=1))
        if len(sound):
            pixels[sound] = self.camera(image).img_from_cam(np.ascontiguousarray(in_cam[sound]))
        return pixels
