"""Start values of the interfaces, from the poses and points of a model that ignored refraction.

A plane starts at a fraction of the depth. The minimum does not depend on it within wide bounds; `continuation` tries
several where it might.
"""

from __future__ import annotations

import numpy as np

from colmap_refract.estimator.scenario import Structure
from colmap_refract.interface import Array
from colmap_refract.refiner.observations import Observations

_LEVEL_PRIOR = 0.1
"""Weight of the mean viewing direction against the cameras' own spread, in squared depths: what decides the
normal of a world plane where the cameras stand in a line or at one place."""


def image_depths(observations: Observations) -> Array:
    """Median depth (I,) of the points in front of each image, along its optical axis, in model units.

    The overall median where an image sees nothing in front of it.
    """
    rotation, translation = observations.cam_from_world
    image = observations.image
    axis = rotation[image, 2]
    depth = np.einsum("ni,ni->n", axis, observations.points[observations.point]) + translation[image, 2]
    depths = np.full(len(observations.image_ids), np.nan)
    for i in range(len(depths)):
        mine = depth[(image == i) & (depth > 0)]
        if len(mine):
            depths[i] = np.median(mine)
    overall = np.nanmedian(depths) if np.isfinite(depths).any() else np.nan
    return np.where(np.isfinite(depths), depths, overall)


def viewing_directions(observations: Observations) -> Array:
    """Mean direction (I, 3), unit, in which each image sees its points, in the camera's frame."""
    total = np.zeros((len(observations.image_ids), 3))
    np.add.at(total, observations.image, observations.direction)
    total[np.linalg.norm(total, axis=1) < 1e-6] = (0.0, 0.0, 1.0)
    return np.asarray(total / np.linalg.norm(total, axis=1)[:, None])


def world_plane(centers: Array, viewing: Array, depths: Array, ratio: float) -> tuple[Array, float]:
    """A plane at a fraction of the depth before all images that share it.

    Args:
        centers: (n, 3) projection centres, viewing: (n, 3) unit viewing directions, both in the world.
        depths: (n,) of the images.
        ratio: where the plane stands between camera (0) and scene (1).

    Returns:
        `(normal_in_world, offset)`: the plane nearest to the points at `ratio` along the viewing
        directions, drawn to their mean direction where the cameras do not span a plane.
    """
    crossing = centers + (ratio * depths)[:, None] * viewing
    mean = viewing.mean(axis=0)
    mean /= max(np.linalg.norm(mean), 1e-12)
    spread = crossing - np.median(crossing, axis=0)
    prior = _LEVEL_PRIOR * np.median(depths) ** 2
    normal = np.linalg.solve(spread.T @ spread / len(spread) + prior * np.eye(3), prior * mean)
    normal /= np.linalg.norm(normal)
    return normal, float(np.median(crossing @ normal))


def start_planes(
    observations: Observations, structure: Structure, ratio: float, normal_in_cam: Array | None, reference: int
) -> tuple[Array, Array]:
    """Normals (B, 3) and distances (B,) to start from, as `scenario.State` holds them.

    Args:
        observations: in the units of the solve.
        structure: the tying; a world plane's distance is measured from its anchor.
        ratio: distance over the median depth.
        normal_in_cam: what the user knows of the normal, in the camera's frame (of the reference image for
            one in the world); by default the optical axis, or for a world plane what the cameras suggest.
        reference: index of the reference image.
    """
    rotation, translation = observations.cam_from_world
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    depths = image_depths(observations)
    viewing = np.einsum("nji,nj->ni", rotation, viewing_directions(observations))
    normals = np.tile([0.0, 0.0, 1.0], (structure.num_planes, 1))
    distances = np.empty(structure.num_planes)
    for block in range(structure.num_planes):
        images = np.flatnonzero(structure.image_plane == block)
        if structure.plane_in_world[block]:
            normal, offset = world_plane(centers[images], viewing[images], depths[images], ratio)
            if normal_in_cam is not None:
                normal = rotation[reference].T @ normal_in_cam
                offset = float(
                    np.median((centers[images] + (ratio * depths[images])[:, None] * viewing[images]) @ normal)
                )
            distance = offset - normal @ structure.plane_anchor[block]
        else:
            normal = np.array([0.0, 0.0, 1.0]) if normal_in_cam is None else normal_in_cam
            distance = ratio * float(np.median(depths[images]))
        normals[block], distances[block] = normal, distance
    return normals, distances
