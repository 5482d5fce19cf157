"""The most likely water depths behind keypoints that a moving surface shakes, for a given strength of its slopes.

Keypoint (j, f) lies off its mean by what the frame's plane does to it (two slopes and a lift, common to all points),
by what the surface does there alone (two slopes of a normal distribution, the same for all), and by noise:

    y_jf = G(eta_j) (s_f + w_jf) + L(eta_j) e_f + noise,   w ~ N(0, tau^2), noise ~ N(0, sigma^2)

`G` and `L` are those of `level_water`. A plane that tilts as a whole has `tau = 0`, and a depth then is read from how
far its point goes with the others; waves have `s_f = 0`, and it is read from its spread. Anything between is weighed as
it is likely. Depths, frames and `tau` take turns until they rest. The slopes' size is not observable: they are kept at
a given root mean square. Observations are weighed as those of Student's t with ten degrees of freedom, so that wrong
matches have little say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_refract.comparators.level_water import Gains, Radii, gains
from colmap_refract.interface import Array

_LEAST, _MOST = 0.02, 50.0
"""Depths of the water over the interface's distance that are looked for."""
_GRID = 40
_ZOOM, _ZOOM_POINTS = 7, 15
_FREEDOM = 10.0
_LEAST_OWN = 1e-3
"""Least `tau` over all slopes: second-order effects at least are there."""
_TINY = 1e-300


@dataclass(frozen=True, kw_only=True)
class Shaken:
    """M points in F frames.

    Attributes:
        offset: (M, F, 2) tangents along the radius and across it, less the point's centre; 0 where not seen.
        seen: (M, F) 1 or 0.
        variance: (M, 2) of the noise, along and across.
        radial: (M, 2) unit vectors along the radius.
        points: coefficients of the points.
    """

    offset: Array
    seen: Array
    variance: Array
    radial: Array
    points: Radii


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What is found, for a root mean square `slope` per axis: lengths over the interface's distance.

    Attributes:
        eta: (M,) depths of the water.
        slopes: (F, 2) of the frames, lifts: (F,), own: `tau`, of each point in each frame.
        center: (M, 2) where the still point is, from the centre that `Shaken.offset` counts from.
        weight: (M, F) of the observations.
    """

    eta: Array
    slopes: Array
    lifts: Array
    own: float
    center: Array
    weight: Array


def start_motion(shaken: Shaken, slope: float, eta: float = 1.0) -> Motion:
    """All points at one depth, and the frames' slopes the mean of what such points show."""
    count = len(shaken.seen)
    flat = np.full(count, eta)
    motion = Motion(
        eta=flat,
        slopes=np.zeros((shaken.seen.shape[1], 2)),
        lifts=np.zeros(shaken.seen.shape[1]),
        own=slope,
        center=np.zeros((count, 2)),
        weight=shaken.seen.copy(),
    )
    return _with_slope(_frames(shaken, motion), slope)


def most_likely(shaken: Shaken, motion: Motion, slope: float, rounds: int, tolerance: float = 1e-7) -> Motion:
    """Depths, frames and deviations in turns, from a start, at a root mean square slope per axis."""
    motion = _with_slope(motion, slope)
    for _ in range(rounds):
        before = motion.eta
        motion = replace(motion, eta=_depths(shaken, motion))
        motion = _with_slope(_weigh(shaken, _frames(shaken, motion)), slope)
        if np.abs(np.log(motion.eta / before)).max() < tolerance:
            break
    return motion


def _with_slope(motion: Motion, slope: float) -> Motion:
    size = np.sqrt(0.5 * np.mean(np.sum(motion.slopes**2, axis=1)) + motion.own**2)
    factor = slope / max(size, _TINY)
    own = max(factor * motion.own, _LEAST_OWN * slope)
    return replace(motion, slopes=factor * motion.slopes, own=own)


def _along_and_across(shaken: Shaken, slopes: Array) -> tuple[Array, Array]:
    """Slopes (F, 2) as the points see them, (M, F) along their radius and across it."""
    rx, ry = shaken.radial.T
    return np.asarray(shaken.radial @ slopes.T), np.asarray(np.stack([-ry, rx], axis=1) @ slopes.T)


def _variances(gain: Gains, own: float, noise: Array) -> tuple[Array, Array]:
    shape = (-1, *[1] * (gain.radial.ndim - 1))
    along, across = noise[:, 0].reshape(shape), noise[:, 1].reshape(shape)
    return (own * gain.radial) ** 2 + along + _TINY, (own * gain.across) ** 2 + across + _TINY


def _errors(shaken: Shaken, motion: Motion) -> Array:
    """What the common motion leaves of the offsets, (M, F, 2)."""
    gain = gains(shaken.points, motion.eta)
    along, across = _along_and_across(shaken, motion.slopes)
    common = np.stack(
        [
            gain.radial_plane[:, None] * along + gain.lift[:, None] * motion.lifts,
            gain.across[:, None] * across,
        ],
        axis=2,
    )
    return np.asarray(shaken.offset - motion.center[:, None] - common)


def _depths(shaken: Shaken, motion: Motion) -> Array:
    """The most likely depth of each point, (M,): a grid, then finer ones about the best."""
    along, across = _along_and_across(shaken, motion.slopes)
    weight = motion.weight
    total = np.maximum(weight.sum(axis=1), _TINY)

    def product(a: Array, b: Array) -> Array:
        """Weighted sums of products of what is left without the weighted means: the still point is unknown."""
        return np.asarray((weight * a * b).sum(axis=1) - (weight * a).sum(axis=1) * (weight * b).sum(axis=1) / total)

    radial, tangential = shaken.offset[:, :, 0], shaken.offset[:, :, 1]
    lifts = np.broadcast_to(motion.lifts, weight.shape)
    sums = [
        product(a, b)[:, None]
        for a, b in [
            (radial, radial), (radial, along), (radial, lifts), (along, along), (along, lifts), (lifts, lifts),
            (tangential, tangential), (tangential, across), (across, across),
        ]
    ]  # fmt: skip
    rr, ra, rl, aa, al, ll, tt, tc, cc = sums
    free = np.maximum(shaken.seen.sum(axis=1) - 1, 0)[:, None]

    def cost(eta: Array) -> Array:
        gain = gains(shaken.points, eta)
        g, lift, c = gain.radial_plane, gain.lift, gain.across
        v_r, v_t = _variances(gain, motion.own, shaken.variance)
        left_r = rr - 2 * g * ra - 2 * lift * rl + g * g * aa + 2 * g * lift * al + lift * lift * ll
        left_t = tt - 2 * c * tc + c * c * cc
        return np.asarray(left_r / v_r + left_t / v_t + free * (np.log(v_r) + np.log(v_t)))

    step = np.log(_MOST / _LEAST) / (_GRID - 1)
    grid = np.broadcast_to(np.log(_LEAST) + step * np.arange(_GRID), (len(weight), _GRID))
    row = np.arange(len(weight))
    best = grid[row, np.argmin(cost(np.exp(grid)), axis=1)]
    for _ in range(_ZOOM):
        fine = best[:, None] + step * np.linspace(-1, 1, _ZOOM_POINTS)
        best = fine[row, np.argmin(cost(np.exp(fine)), axis=1)]
        step *= 2 / (_ZOOM_POINTS - 1)
    return np.asarray(np.exp(np.clip(best, np.log(_LEAST), np.log(_MOST))))


def _frames(shaken: Shaken, motion: Motion) -> Motion:
    """Slopes and lifts of the frames by weighted least squares, still points, and `tau` from what is left."""
    gain = gains(shaken.points, motion.eta)
    v_r, v_t = _variances(gain, motion.own, shaken.variance)
    rx, ry = shaken.radial.T
    zero = np.zeros_like(rx)
    radial_row = np.stack([gain.radial_plane * rx, gain.radial_plane * ry, gain.lift], axis=1)
    across_row = np.stack([-gain.across * ry, gain.across * rx, zero], axis=1)
    rows = np.stack([radial_row / np.sqrt(v_r)[:, None], across_row / np.sqrt(v_t)[:, None]], axis=1)
    whitened = (shaken.offset - motion.center[:, None]) / np.sqrt(np.stack([v_r, v_t], axis=1))[:, None]
    matrix = np.einsum("mf,mai,maj->fij", motion.weight, rows, rows)
    target = np.einsum("mf,mai,mfa->fi", motion.weight, rows, whitened)
    found = np.einsum("fij,fj->fi", np.linalg.pinv(matrix, hermitian=True), target)
    # The mean of the frames is the mean surface, by definition.
    found -= found.mean(axis=0)
    motion = replace(motion, slopes=found[:, :2], lifts=found[:, 2])
    errors = _errors(shaken, replace(motion, center=np.zeros_like(motion.center)))
    total = np.maximum(motion.weight.sum(axis=1), _TINY)[:, None]
    center = np.einsum("mf,mfa->ma", motion.weight, errors) / total
    left = np.einsum("mf,mfa->ma", motion.weight, (errors - center[:, None]) ** 2)
    free = np.maximum(shaken.seen.sum(axis=1) - 1, 0)[:, None]
    gain_squared = np.stack([gain.radial, gain.across], axis=1) ** 2
    share = free * gain_squared / np.stack([v_r, v_t], axis=1) ** 2
    excess = (left - free * shaken.variance) * gain_squared / np.stack([v_r, v_t], axis=1) ** 2
    own = np.sqrt(max(float(excess.sum() / max((share * gain_squared).sum(), _TINY)), 0.0))
    return replace(motion, center=center, own=own)


def _weigh(shaken: Shaken, motion: Motion) -> Motion:
    """Weights (M, F) of Student's t."""
    v_r, v_t = _variances(gains(shaken.points, motion.eta), motion.own, shaken.variance)
    errors = _errors(shaken, motion)
    squared = errors[:, :, 0] ** 2 / v_r[:, None] + errors[:, :, 1] ** 2 / v_t[:, None]
    return replace(motion, weight=shaken.seen * (_FREEDOM + 2) / (_FREEDOM + squared))
