"""Points that are seen through a surface that is not flat: projection through its tangent plane, until that fits."""

from __future__ import annotations

import numpy as np

from colmap_refract.estimator.optics import project_direction
from colmap_refract.interface import Array, Layers
from colmap_refract.water_surface import WaterSurface

_MOST_STEPS = 200
_TOLERANCE = 1e-12
"""Of a unit direction, between one step and the next."""


def project_through_surface(
    points_in_cam: Array, normal: Array, distance: float, layers: Layers, surface: WaterSurface
) -> Array:
    """Unit directions in which a camera sees points through a surface that is not flat.

    Light is refracted by the surface's tangent plane where it crosses. So a direction gives a plane, and the plane a
    direction, again and again until it stays. It does where the surface bends little on the scale of what light is
    moved by, `curvature * (index - 1) * distance < 1` in deep water: through swell, where each point is seen once.
    Through steep ripples a point may be seen several times, and then what is found is one of the paths, or none.

    Args:
        points_in_cam: (N, 3) in the camera's frame.
        normal: (3,) unit normal of the image's plane, into the water.
        distance: of that plane, > 0, in the units of the points.
        layers: the media behind the surface; walls are taken as parallel to the tangent plane.
        surface: over that plane, in the same units.

    Returns:
        (N, 3) unit directions; not a number where the iteration does not settle. A point on the camera's side of the
        surface is seen straight.
    """
    points = np.asarray(points_in_cam, dtype=np.float64)
    walls = sum(layers.thickness)
    wet = points @ normal > distance + walls + surface.height_and_slopes(points @ surface.axes)[:, 0]
    direction = project_direction(points, normal, distance, layers, wet)
    out = np.where(wet[:, None], np.nan, direction)
    active = np.flatnonzero(wet)
    for _ in range(_MOST_STEPS):
        local, local_distance = surface.local_planes(direction[active], normal, distance)
        # Light does not come from the camera's side of the plane that it crosses.
        behind = np.einsum("ni,ni->n", local, points[active]) > local_distance + walls
        active, local, local_distance = active[behind], local[behind], local_distance[behind]
        if not active.size:
            break
        before = direction[active]
        direction[active] = project_direction(
            points[active], local, local_distance, layers, np.ones(len(active), dtype=bool)
        )
        done = np.abs(direction[active] - before).max(axis=1) <= _TOLERANCE
        out[active[done]] = direction[active[done]]
        active = active[~done]
    return out
