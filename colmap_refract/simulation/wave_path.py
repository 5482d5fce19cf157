"""Light through a wavy surface, by Fermat's principle: the places where paths of stationary optical length cross it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_refract.interface import Array
from colmap_refract.simulation.least_path import least_path_direction
from colmap_refract.simulation.surface import Surface

# Places that a least path is looked for at, along each side of the square, at most.
MOST_PLACES = 81
# Points at a time, for the memory of those places.
MOST_POINTS = 500
# Basins that are followed to their bottom.
NUM_BASINS = 6


def optical_length(surface: Surface, center: Array, points: Array, xy: Array) -> Array:
    """Optical length (n,) of the broken lines from a centre (3,) through the surface at xy (n, 2) to points (n, 3)."""
    crossing = np.column_stack([xy, surface.height(xy)])
    inside = np.linalg.norm(points - crossing, axis=1)
    return np.asarray(np.linalg.norm(crossing - center, axis=1) + surface.layers.refractive_index * inside)


def optical_derivatives(surface: Surface, center: Array, points: Array, xy: Array) -> tuple[Array, Array]:
    """Gradient (n, 2) and Hessian (n, 2, 2) of `optical_length` by xy. Fermat: light makes the gradient zero."""
    slope, bend = surface.gradient(xy), surface.curvature(xy)
    crossing = np.column_stack([xy, surface.height(xy)])
    tangents = np.zeros((len(xy), 2, 3))
    tangents[:, :, :2] = np.eye(2)
    tangents[:, :, 2] = slope
    gradient, hessian = np.zeros((len(xy), 2)), np.zeros((len(xy), 2, 2))
    for end, index in ((center, 1.0), (points, surface.layers.refractive_index)):
        arm = crossing - end
        length = np.linalg.norm(arm, axis=1)[:, None]
        along = np.einsum("nka,na->nk", tangents, arm / length)
        gradient += index * along
        flat = np.einsum("nka,nla->nkl", tangents, tangents) - along[:, :, None] * along[:, None, :]
        hessian += index * (flat + arm[:, 2, None, None] * bend) / length[:, :, None]
    return gradient, hessian


def stationary_crossings(surface: Surface, center: Array, points: Array, start: Array) -> Array:
    """Where paths of stationary length, of any kind, cross the surface: those that Newton's method finds from a start.

    Args:
        surface: with waves.
        center: (3,), above it.
        points: (n, 3), below it.
        start: (n, 2), places on the surface.

    Returns:
        (n, 3) in the world; not a number where none was found.
    """
    place = start.copy()
    active = np.flatnonzero(np.isfinite(place).all(axis=1))
    found = np.zeros(len(points), dtype=bool)
    for _ in range(60):
        if not active.size:
            break
        gradient, hessian = optical_derivatives(surface, center, points[active], place[active])
        size = np.linalg.norm(gradient, axis=1)
        step = -np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
        factor = np.ones(len(active))
        for _ in range(30):
            trial = optical_derivatives(surface, center, points[active], place[active] + factor[:, None] * step)[0]
            worse = ~(np.linalg.norm(trial, axis=1) < size) & (size > 1e-14)
            if not worse.any():
                break
            factor[worse] *= 0.5
        place[active] += factor[:, None] * step
        length = np.linalg.norm(points[active] - center, axis=1)
        done = np.linalg.norm(step, axis=1) < 1e-13 * length
        # A path that cannot be made better any more, but for rounding.
        done |= (factor < 1e-8) & (size < 1e-12)
        found[active[done]] = True
        active = active[~done & (factor > 1e-8)]
    out = np.column_stack([place, surface.height(place)])
    out[~found] = np.nan
    return out


def least_crossings(surface: Surface, center: Array, points: Array) -> Array:
    """Where the paths of least optical length cross the surface.

    Short waves over deep water show a point several times, along several stationary paths. The length is looked at
    on a grid as wide as waves can move the crossing and six times as fine as the shortest wave; its lowest basins
    are followed to their bottoms, and the lowest of these is taken.

    Args:
        surface: seen from above.
        center: (3,), above it.
        points: (n, 3). Those above the surface have no crossing.

    Returns:
        (n, 3) in the world, where the gradient of the length is less than 1e-10; not a number where there is no
        such place, and for points above the surface.
    """
    out = np.full((len(points), 3), np.nan)
    wet = np.flatnonzero(surface.depth_below(points) > 0)
    for start in range(0, len(wet), MOST_POINTS):
        rows = wet[start : start + MOST_POINTS]
        out[rows] = _least_crossings(surface, center, points[rows])
    return out


def _least_crossings(surface: Surface, center: Array, ends: Array) -> Array:
    """What `least_crossings` says, for points (n, 3) below the surface."""
    distance = float(surface.offset - surface.normal @ center)
    direction = least_path_direction(ends - center, surface.normal, distance, surface.layers)
    with np.errstate(divide="ignore", invalid="ignore"):
        start = (center + (distance / (direction @ surface.normal))[:, None] * direction)[:, :2]
    # In a crest, above the mean plane, the path does not cross that plane: the crossing is near the point.
    dry = ~np.isfinite(start).all(axis=1) | (ends @ surface.normal <= surface.offset)
    start[dry] = ends[dry, :2]

    basins = _basins(surface, center, ends, start)
    out, best = np.full(ends.shape, np.nan), np.full(len(ends), np.inf)
    for k in range(basins.shape[1]):
        rows = np.flatnonzero(np.isfinite(basins[:, k, 0]))
        place, sound = _descend(surface, center, ends[rows], basins[rows, k])
        rows, place = rows[sound], place[sound]
        length = optical_length(surface, center, ends[rows], place)
        lower = length < best[rows]
        best[rows[lower]] = length[lower]
        out[rows[lower]] = np.column_stack([place, surface.height(place)])[lower]
    return out


def _basins(surface: Surface, center: Array, points: Array, start: Array) -> Array:
    """Places (n, B, 2) on the surface to begin the descent from, the lowest length first; the others not a number."""
    if not len(surface.waves):
        return start[:, None]
    flat = Surface(normal=surface.normal, offset=surface.offset, layers=surface.layers, waves=np.empty((0, 4)))
    shortest = 2 * np.pi / np.linalg.norm(surface.waves[:, :2], axis=1).max()
    # A surface that is moved by a height changes the length by `pull` times that, so that a slope pushes
    # the crossing until the flat path's stiffness holds it.
    crossing = np.column_stack([start, flat.height(start)])
    above, below = crossing - center, points - crossing
    cosines = [arm[:, 2] / np.linalg.norm(arm, axis=1) for arm in (above, below)]
    pull = abs(cosines[0] - surface.layers.refractive_index * cosines[1])
    hessian = optical_derivatives(flat, center, points, start)[1]
    stiffness = np.linalg.eigvalsh(hessian)[:, 0]
    steepest = 3 * np.sqrt(0.5 * np.sum(surface.waves[:, 2] ** 2 * np.sum(surface.waves[:, :2] ** 2, axis=1)))
    radius = np.max(pull * steepest / stiffness)
    reach = int(np.clip(np.ceil(6 * radius / shortest), 1, MOST_PLACES // 2))
    side = 2 * reach + 1

    offset = min(radius, reach * shortest / 6) * np.linspace(-1, 1, side)
    grid = np.stack(np.meshgrid(offset, offset, indexing="ij"), axis=-1).reshape(-1, 2)
    x, y = (start[:, a, None] + grid[:, a] for a in range(2))
    tilt = surface.normal[:2] / surface.normal[2]
    z = surface.offset / surface.normal[2] - tilt[0] * x - tilt[1] * y + _waves_around(surface, start, grid)
    length = np.sqrt((x - center[0]) ** 2 + (y - center[1]) ** 2 + (z - center[2]) ** 2)
    inside = (x - points[:, :1]) ** 2 + (y - points[:, 1:2]) ** 2 + (z - points[:, 2:]) ** 2
    length += surface.layers.refractive_index * np.sqrt(inside)

    bottom = _lowest_of_neighbours(length.reshape(-1, side, side)).reshape(len(points), -1)
    order = np.argsort(np.where(bottom, length, np.inf), axis=1)[:, :NUM_BASINS]
    found = bottom[np.arange(len(points))[:, None], order]
    return np.where(found[:, :, None], start[:, None] + grid[order], np.nan)


def _lowest_of_neighbours(square: Array) -> NDArray[np.bool_]:
    """Whether a value (n, side, side) is no larger than the eight around it."""
    lowest = square.copy()
    for axis in (1, 2):
        line = np.moveaxis(lowest, axis, 1)
        before, after = line[:, :-1].copy(), line[:, 1:].copy()
        line[:, 1:] = np.minimum(line[:, 1:], before)
        line[:, :-1] = np.minimum(line[:, :-1], after)
    return np.asarray(square <= lowest)


def _waves_around(surface: Surface, places: Array, offsets: Array) -> Array:
    """The waves' z (n, m) at places (n, 2) moved by offsets (m, 2): the sine of a sum is two products."""
    number, amplitude, phase = surface.waves[:, :2], surface.waves[:, 2], surface.waves[:, 3]
    angle, turn = places @ number.T + phase, offsets @ number.T
    return np.asarray((amplitude * np.sin(angle)) @ np.cos(turn).T + (amplitude * np.cos(angle)) @ np.sin(turn).T)


def _descend(surface: Surface, center: Array, points: Array, start: Array) -> tuple[Array, Array]:
    """The bottoms (n, 2) of the basins that the starts are in, and whether each was found (n,).

    Newton's method on the length, its Hessian made positive, with steps halved until the length falls.
    """
    place, active = start.copy(), np.arange(len(points))
    for _ in range(100):
        if not active.size:
            break
        ends, xy = points[active], place[active]
        length = optical_length(surface, center, ends, xy)
        gradient, hessian = optical_derivatives(surface, center, ends, xy)
        value, vector = np.linalg.eigh(hessian)
        value = np.maximum(abs(value), 1e-3 * abs(value).max(axis=1, keepdims=True))
        step = -np.einsum("nij,nj->ni", vector, np.einsum("nij,ni->nj", vector, gradient) / value)
        descent = np.einsum("ni,ni->n", gradient, step)
        factor = np.ones(len(active))
        for _ in range(60):
            trial = optical_length(surface, center, ends, xy + factor[:, None] * step)
            # The last term is the rounding of the length: near the bottom it cannot judge a step.
            worse = trial > length + 1e-4 * factor * descent + 1e-15 * length
            if not worse.any():
                break
            factor[worse] *= 0.5
        place[active] = xy + factor[:, None] * step
        active = active[-descent > 1e-24 * length]
    gradient, _ = optical_derivatives(surface, center, points, place)
    return place, np.linalg.norm(gradient, axis=1) < 1e-10
