"""The refracted projection by Fermat's principle: light takes the path of least optical length."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers


def least_path_direction(
    points_in_cam: ArrayLike, normal_in_cam: ArrayLike, distance: ArrayLike, layers: Layers
) -> Array:
    """Directions in which a camera sees points through plane layers, by least optical path.

    Args:
        points_in_cam: (n, 3), camera frame. A point on the camera's side of the plane is seen straight,
            and one inside a wall through the media in front of it.
        normal_in_cam: (3,) or (n, 3), unit, from the camera into the water.
        distance: scalar or (n,), of the first interface, > 0, in the units of the points.
        layers: the media, any indices > 0, thicknesses in the units of the points.

    Returns:
        (n, 3) unit vectors, camera frame; not a number for a point at the projection centre.

    Raises:
        RefractError: a distance is not positive.
    """
    points = np.asarray(points_in_cam, dtype=np.float64).reshape(-1, 3)
    normal = np.broadcast_to(np.asarray(normal_in_cam, dtype=np.float64), points.shape)
    dist = np.broadcast_to(np.asarray(distance, dtype=np.float64), points.shape[:1])
    if not (dist > 0).all():
        raise RefractError("interface distance must be positive: it is measured from the camera towards the water")
    # A wall without thickness bends nothing, but its path length has a kink that Newton cannot take.
    walls = [(h, mu) for h, mu in zip(layers.thickness, layers.index, strict=False) if h > 0]
    thickness = np.array([h for h, _ in walls])
    index = np.array([1.0, *(mu for _, mu in walls), layers.refractive_index])

    depth = np.einsum("ij,ij->i", points, normal)
    radial = points - depth[:, None] * normal
    starts = dist[:, None] + np.concatenate([[0.0], np.cumsum(thickness)])
    crossed = (depth[:, None] > starts).sum(axis=1)
    out = points.copy()
    for count in range(1, len(index)):
        rows = np.flatnonzero(crossed == count)
        walls_here = np.broadcast_to(thickness[: count - 1], (len(rows), count - 1))
        heights = np.column_stack([dist[rows], walls_here, depth[rows] - starts[rows, count - 1]])
        share = _first_crossing(heights, index[: count + 1], np.linalg.norm(radial[rows], axis=1))
        out[rows] = dist[rows, None] * normal[rows] + share[:, None] * radial[rows]
    with np.errstate(invalid="ignore"):
        return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def _first_crossing(heights: Array, index: Array, radius: Array) -> Array:
    """Where the least path from (0, 0) to (radius, sum of heights) meets the first interface, over the radius.

    Damped Newton on the convex `sum_k mu_k sqrt(h_k^2 + (radius ds_k)^2)`. The unknowns are the crossings
    divided by the radius, and so are the derivatives: nothing is singular on the axis.
    """
    squared = radius[:, None] ** 2
    paraxial = np.cumsum(heights / index, axis=1)
    share = np.concatenate([np.zeros((len(radius), 1)), paraxial / paraxial[:, -1:]], axis=1)
    share[:, -1] = 1.0
    active = np.arange(len(radius))
    for _ in range(200):
        if active.size == 0:
            break
        s, h, r2 = share[active], heights[active], squared[active]
        legs = np.diff(s, axis=1)
        length = np.sqrt(h**2 + r2 * legs**2)
        cost, sine = length @ index, index * legs / length
        stiffness = index * (h / length) ** 2 / length
        gradient = sine[:, :-1] - sine[:, 1:]
        hessian = np.einsum("ni,ij->nij", stiffness[:, :-1] + stiffness[:, 1:], np.eye(len(index) - 1))
        for k in range(len(index) - 2):
            hessian[:, k, k + 1] = hessian[:, k + 1, k] = -stiffness[:, k + 1]
        step = -np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
        descent = r2[:, 0] * np.einsum("ij,ij->i", gradient, step)
        factor = np.ones(len(active))
        for _ in range(60):
            legs = np.diff(np.pad(factor[:, None] * step, ((0, 0), (1, 1))), axis=1) + np.diff(s, axis=1)
            trial = np.sqrt(h**2 + r2 * legs**2) @ index
            # The last term is the rounding of the cost: near the minimum it cannot judge a step.
            worse = trial > cost + 1e-4 * factor * descent + 1e-15 * cost
            if not worse.any():
                break
            factor[worse] *= 0.5
        share[active, 1:-1] += factor[:, None] * step
        active = active[-descent > 1e-24 * cost]
    return np.asarray(share[:, 1])
