"""Snell's law through plane layers: forward to a camera ray, with derivatives, and backward along a ray.

Forward projection. Split a point `X` (camera frame) as `X = z n + p` with `p` orthogonal to the unit
normal `n`. The media are layers of thickness `h_k` and index `mu_k`: the camera's own (`h_0` is the
distance of the interface, `mu_0 = 1`), any walls, and the water, whose thickness is what remains of `z`.
Let `t` be the tangent of the ray's angle to `n` in the layer of lowest index. With
`r_k = min(mu) / mu_k` and `c_k = 1 - r_k^2`, Snell gives the tangent in layer k as
`r_k t / sqrt(1 + c_k t^2)`, and the ray meets `X` when the layers' offsets sum to `|p|`. Written in
`g = t / |p|` and `s = |p|^2`, that is

    F(g, s) = sum_k h_k r_k g / sqrt(1 + c_k s g^2) - 1 = 0,

which never divides by `|p|`, so that the axis is no special case. `F` increases with `g` and is concave
where no thickness is negative: Newton from the paraxial root `1 / sum_k h_k r_k` rises monotonically to
the only root, so there is no root to select, unlike in the quartic of Agrawal et al. (CVPR 2012).
The ray in the camera's medium is then `v = n + G p` with `G = r_0 g / sqrt(1 + c_0 s g^2)`.

A water layer that is slightly negative (the plane lies behind the point) continues the same formulas
analytically, which keeps cost and gradient of an adjustment smooth there; whether a point is wet is
decided by the caller, outside the solve.

The scalar functions are compiled by numba and meant to be called from compiled loops; the batched ones
at the end are for everybody.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from colmap_refract.interface import Array, Layers

# Contraction and reassociation only: NaN and infinity keep their meaning.
FAST = {"contract", "reassoc", "nsz", "arcp"}
_MAX_NEWTON_STEPS = 40
_NEWTON_TOLERANCE = 1e-7
"""Newton converges quadratically: after a step as small as this the error is of rounding size."""
_HALLEY_TOLERANCE = 1e-5
"""Halley converges cubically."""
_HALLEY_RANGE = 0.1
"""Relative step below which Halley's method is safe where Newton's is monotonic."""


class Media:
    """Layers as the arrays that the compiled functions take.

    Attributes:
        ratio: (K,) `r_k`, lowest index over the layer's index, the camera's medium first.
        ratio_by_index: (K,) derivative of `ratio` with respect to the index of the last layer.
        walls: (K - 2,) thickness of the walls.
    """

    def __init__(self, layers: Layers) -> None:
        # A wall without thickness bends nothing, but could be the medium of lowest index.
        walls = [(h, mu) for h, mu in zip(layers.thickness, layers.index, strict=False) if h > 0]
        index = np.array([1.0, *(mu for _, mu in walls), layers.refractive_index])
        lowest = int(np.argmin(index))
        self.ratio: Array = index[lowest] / index
        self.ratio_by_index: Array = np.zeros_like(index)
        if lowest == len(index) - 1:
            # The scene's medium is the thinnest (a camera under water that looks out): every ratio follows it.
            self.ratio_by_index[:-1] = 1.0 / index[:-1]
        else:
            self.ratio_by_index[-1] = -self.ratio[-1] / index[-1]
        self.walls: Array = np.array([h for h, _ in walls], dtype=np.float64)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def snell_root(z, s, distance, ratio, walls):
    """Solve `F(g, s) = 0` for `g`, the tangent over the offset (see the module's docstring).

    Args:
        z: depth of the point along the normal, > 0.
        s: squared offset of the point from the normal through the projection centre.
        distance: of the first interface.
        ratio, walls: of `Media`.

    Returns:
        `(g, h)` with `h` the thickness of the last layer, negative where the point lies before it.
        `g` is NaN where the continuation has no ray: behind a denser camera medium, or inside a thick wall.
    """
    last = ratio.shape[0] - 1
    h = z - distance
    paraxial = distance * ratio[0]
    for k in range(1, last):
        h -= walls[k - 1]
        paraxial += walls[k - 1] * ratio[k]
    paraxial += h * ratio[last]
    if not paraxial > 0.0:
        return np.nan, h
    g = 1.0 / paraxial
    for _ in range(_MAX_NEWTON_STEPS):
        sg2 = s * g * g
        value = -1.0
        slope = 0.0
        for k in range(last + 1):
            thickness = distance if k == 0 else (h if k == last else walls[k - 1])
            r = ratio[k]
            q = 1.0 / (1.0 + (1.0 - r) * (1.0 + r) * sg2)
            term = thickness * r * math.sqrt(q)
            value += term * g
            slope += term * q
        step = value / slope
        if not slope > 0.0:
            return np.nan, h
        g -= step
        if abs(step) <= _NEWTON_TOLERANCE * g:
            break
    return g, h


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def one_interface(z, s, distance, r, r_by_index):
    """`snell_root` and `slope_derivatives` in one for a single interface before a denser medium, the usual case.

    Args:
        z, s, distance: as for `snell_root`.
        r, r_by_index: ratio of the water, < 1, and its derivative by the index.

    Returns:
        `(G, G_s, G_z, G_d, G_index)`, the first NaN where no ray exists.
    """
    h = z - distance
    behind = h * r
    paraxial = distance + behind
    if not paraxial > 0.0:
        return np.nan, 0.0, 0.0, 0.0, 0.0
    g = 1.0 / paraxial
    c = (1.0 - r) * (1.0 + r)
    cs = c * s
    for _ in range(_MAX_NEWTON_STEPS):
        q = 1.0 / (1.0 + cs * g * g)
        term = behind * math.sqrt(q)
        value = (distance + term) * g - 1.0
        slope = distance + term * q
        step = value / slope
        near = abs(step) <= _HALLEY_RANGE * g
        if near:
            # Halley's method near the root: the second derivative is at hand, and a step fewer is a root fewer.
            step /= 1.0 + 1.5 * step * cs * g * term * q * q / slope
        g -= step
        if near and abs(step) <= _HALLEY_TOLERANCE * g:
            break
    q = 1.0 / (1.0 + cs * g * g)
    root = math.sqrt(q)
    cube = h * root * q
    inverse = 1.0 / (distance + r * cube)
    by_last = r * g * root
    return (
        g,
        0.5 * r * c * g * g * g * cube * inverse,
        -by_last * inverse,
        (by_last - g) * inverse,
        -r_by_index * g * (1.0 + s * g * g) * cube * inverse,
    )


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def slope_derivatives(g, h, s, distance, ratio, ratio_by_index, walls):
    """`G` of `v = n + G p` and its derivatives with respect to `s`, `z`, the distance and the last index.

    Returns:
        `(G, G_s, G_z, G_d, G_index)`; all finite on the axis.
    """
    last = ratio.shape[0] - 1
    sg2 = s * g * g
    by_g = 0.0
    by_s = 0.0
    by_index = 0.0
    by_first = 0.0
    by_last = 0.0
    q_first = 1.0
    for k in range(last + 1):
        thickness = distance if k == 0 else (h if k == last else walls[k - 1])
        r = ratio[k]
        c = (1.0 - r) * (1.0 + r)
        q = 1.0 / (1.0 + c * sg2)
        root = math.sqrt(q)
        if k == 0:
            by_first = r * g * root
            q_first = q
        if k == last:
            by_last = r * g * root
        cube = thickness * root * q
        by_g += r * cube
        by_s -= 0.5 * r * c * g * g * g * cube
        by_index += ratio_by_index[k] * g * (1.0 + sg2) * cube
    inverse = 1.0 / by_g
    g_s = -by_s * inverse
    g_z = -by_last * inverse
    g_d = (by_last - by_first) * inverse
    g_index = -by_index * inverse
    # From g to G = r_0 g sqrt(q_0); they are the same where the camera's medium is the thinnest.
    r = ratio[0]
    if r == 1.0 and ratio_by_index[0] == 0.0:
        return g, g_s, g_z, g_d, g_index
    c = (1.0 - r) * (1.0 + r)
    root = math.sqrt(q_first)
    by_g = r * root * q_first
    big = r * g * root
    return (
        big,
        by_g * g_s - 0.5 * r * c * g * g * g * root * q_first,
        by_g * g_z,
        by_g * g_d,
        by_g * g_index + ratio_by_index[0] * g * root * q_first * (1.0 + sg2),
    )


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _project_directions(points, normals, distances, wet, ratio, walls, out):
    for i in range(points.shape[0]):
        x, y, w = points[i]
        if wet[i]:
            nx, ny, nz = normals[i]
            z = nx * x + ny * y + nz * w
            px, py, pz = x - z * nx, y - z * ny, w - z * nz
            s = px * px + py * py + pz * pz
            if z > 0.0:
                g, _ = snell_root(z, s, distances[i], ratio, walls)
                if math.isfinite(g):
                    r = ratio[0]
                    big = r * g / math.sqrt(1.0 + (1.0 - r) * (1.0 + r) * s * g * g)
                    x, y, w = nx + big * px, ny + big * py, nz + big * pz
        norm = math.sqrt(x * x + y * y + w * w)
        out[i, 0], out[i, 1], out[i, 2] = x / norm, y / norm, w / norm


def project_direction(
    points_in_cam: Array,
    normal_in_cam: Array,
    distance: Array | float,
    layers: Layers,
    wet: NDArray[np.bool_] | None = None,
) -> Array:
    """Unit directions in which a camera sees points through its interface: `FP` of the paper without the lens.

    Args:
        points_in_cam: (N, 3) in the camera's frame.
        normal_in_cam: (3,) or (N, 3) unit normals into the water.
        distance: scalar or (N,), > 0, in the units of the points.
        layers: the media behind the first interface.
        wet: (N,) which points lie beyond the interface. By default those that do so by their depth;
            a point that is not wet is seen straight. A point marked wet before the interface is
            projected with the analytic continuation of the water layer.

    Returns:
        (N, 3) unit directions. A point behind the camera (`normal . X <= 0`) is seen straight, too.
    """
    points = np.ascontiguousarray(points_in_cam, dtype=np.float64)
    normals = np.ascontiguousarray(np.broadcast_to(normal_in_cam, points.shape), dtype=np.float64)
    distances = np.ascontiguousarray(np.broadcast_to(distance, points.shape[:1]), dtype=np.float64)
    if wet is None:
        wet = is_wet(points, normals, distances, layers)
    media = Media(layers)
    out = np.empty_like(points)
    _project_directions(points, normals, distances, np.ascontiguousarray(wet), media.ratio, media.walls, out)
    return out


def is_wet(points_in_cam: Array, normal_in_cam: Array, distance: Array | float, layers: Layers) -> NDArray[np.bool_]:
    """Which points lie beyond the last wall; shapes as in `project_direction`."""
    depth = np.einsum("...i,...i->...", points_in_cam, normal_in_cam)
    return np.asarray(depth > np.asarray(distance) + sum(layers.thickness))


def refract(direction: Array, normal: Array, index_ratio: float) -> Array:
    """Refract unit directions at a surface: `RV` of the paper for one interface.

    Args:
        direction: (..., 3) unit, travelling along the normal (`normal . direction > 0`).
        normal: (..., 3) unit normals of the surface, one per direction where it waves.
        index_ratio: index of the medium behind over the one before.

    Returns:
        (..., 3) unit directions behind the surface; NaN beyond total internal reflection.
    """
    direction, normal = np.broadcast_arrays(direction, normal)
    cosine = np.einsum("...i,...i->...", direction, normal)[..., None]
    along = (direction - cosine * normal) / index_ratio
    squared = 1.0 - np.einsum("...i,...i->...", along, along)[..., None]
    with np.errstate(invalid="ignore"):
        return np.asarray(along + np.sqrt(squared) * normal)


def back_project(
    direction: Array,
    normal_in_cam: Array,
    distance: Array | float,
    layers: Layers,
    normal_at_point: Array | None = None,
) -> tuple[Array, Array]:
    """The ray in the water of a camera direction: `IP` and `RV` of the paper, whose `BP` is `origin + d * direction`.

    Args:
        direction: (N, 3) unit directions in the camera's frame.
        normal_in_cam: (3,) or (N, 3) unit normals of the plane.
        distance: scalar or (N,) of the plane.
        layers: the media behind it.
        normal_at_point: (N, 3) unit normals of the surface where each ray crosses it (the paper's
            `n_ij`), where they differ from the plane's. Walls stay parallel to the plane.

    Returns:
        `(origin, direction)`, both (N, 3) in the camera's frame: the point where the ray enters the
        last medium and its unit direction there. NaN for a ray that does not reach the plane.
    """
    normals = np.broadcast_to(normal_in_cam, direction.shape)
    cosine = np.einsum("ij,ij->i", direction, normals)[:, None]
    distances = np.broadcast_to(distance, direction.shape[:1])[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        origin = np.where(cosine > 0.0, distances / cosine, np.nan) * direction
    surface = normals if normal_at_point is None else normal_at_point
    ray = refract(direction, surface, layers.index[0])
    for k, thickness in enumerate(layers.thickness):
        cosine = np.einsum("ij,ij->i", ray, normals)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            origin = origin + thickness / cosine * ray
        ray = refract(ray, normals, layers.index[k + 1] / layers.index[k])
    return origin, ray
