"""Depth from turbulence: what lies deeper under a moving surface is shaken more.

After Tian, Narasimhan and Vannevel, "Depth from optical turbulence" (CVPR 2012), which reads depths through heat haze
from how far each point of a still scene wanders, in underwater geometry as the 3DV 2019 paper uses it.

What it is given that the refiner is not: the true points. The spread tells depths but for a scale and an offset, which
are fitted to the truth; the paper does so, and calls it impractical for real cases. `refracted_depths` also takes the
direction of the mean surface's normal as known.

`spread_depths` is the method in its plain form: root mean square wandering over both axes, less the noise's, and a
depth on the mean line of sight that is linear in it. `refracted_depths` is the better one, and the one to compare with:
first-order optics of the wandering that hold over the whole field of view, the common motion of all points told from
each one's own (see `turbulence`), and the points on refracted rays; the two unknowns there are the strength of the
slopes and the interface's distance. Planes that also rise and sink shake what is far from the axis at any depth, and
the plain form takes that for depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_refract.comparators.keypoints import directions_of, unit_normal
from colmap_refract.comparators.level_water import radii
from colmap_refract.comparators.turbulence import Motion, Shaken, most_likely, start_motion
from colmap_refract.errors import RefractError
from colmap_refract.estimator.optics import back_project
from colmap_refract.interface import Array, Layers, tangent_basis

if TYPE_CHECKING:
    import pycolmap

_MIN_FIT = 3
"""Points that a scale and an offset are fitted to: with two there is nothing to judge."""
_STEEPEST = 50.0
"""Tangent of the angle to the normal beyond which a point is not looked at."""
_TYPICAL = np.geomspace(0.03, 30.0, 13)
"""Depths of the water over the distance that the strength of the slopes is first tried for."""
_FIRST_ROUNDS, _ROUNDS, _LAST_ROUNDS = 6, 15, 60
_TOLERANCE = 1e-5
"""Of the logarithm of the slope."""


@dataclass(frozen=True, kw_only=True)
class DepthFromTurbulence:
    """M points, camera frame, in the truth's unit.

    Attributes:
        points: (M, 3), NaN where fewer than two frames see the point.
        spread: (M,) root mean square wandering per axis that was read, as tangents; with `refracted_depths` depths of
            the water over the interface's distance.
        offset, scale: fitted to the truth. `spread_depths`: depth along the optical axis at no spread, and per
            spread. `refracted_depths`: distance of the mean interface, and root mean square slope per axis.
        rmse: of the fit, over the points that have a truth.
    """

    points: Array
    spread: Array
    offset: float
    scale: float
    rmse: float


def spread_depths(
    keypoints: Array, camera: pycolmap.Camera, truth: Array, *, pixel_noise: float = 0.0
) -> DepthFromTurbulence:
    """Depths linear in the spread of each point's keypoints: the method in its plain form.

    Args:
        keypoints: (M, F, 2) pixels, NaN where unseen.
        camera: intrinsics in air.
        truth: (M, 3) true points, camera frame, for scale and offset; NaN where unknown.
        pixel_noise: standard deviation of each coordinate of a keypoint, px, that is no wandering.

    Returns:
        Points on the mean lines of sight; offset and scale by linear least squares of the points' distances.

    Raises:
        RefractError: arrays that do not belong together, fewer than two frames, or fewer than three points with truth.
    """
    place, seen, metric = _places(keypoints, camera, truth, pixel_noise, np.array([0.0, 0.0, 1.0]))
    count = np.maximum(seen.sum(axis=1), 1)
    center = np.where(seen[:, :, None], place, 0).sum(axis=1) / count[:, None]
    squared = (np.where(seen[:, :, None], place - center[:, None], 0) ** 2).sum(axis=1)
    usable = seen.sum(axis=1) >= 2
    variance = squared.mean(axis=1) / np.maximum(count - 1, 1) - _noise(metric, pixel_noise).trace(axis1=1, axis2=2) / 2
    spread = np.where(usable, np.sqrt(np.maximum(variance, 0)), np.nan)
    ray = np.where(usable[:, None], np.column_stack([center, np.ones(len(center))]), np.nan)

    fit = _fittable(ray, truth)
    design = np.stack([ray[fit], spread[fit, None] * ray[fit]], axis=2).reshape(-1, 2)
    offset, scale = np.linalg.lstsq(design, truth[fit].ravel(), rcond=None)[0].tolist()
    points = (offset + scale * spread)[:, None] * ray
    return DepthFromTurbulence(
        points=points, spread=spread, offset=offset, scale=scale, rmse=_rmse(points[fit], truth[fit])
    )


def refracted_depths(
    keypoints: Array,
    camera: pycolmap.Camera,
    truth: Array,
    *,
    pixel_noise: float = 0.0,
    refractive_index: float = 1.333,
    normal_in_cam: Array | tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> DepthFromTurbulence:
    """The most likely depths under the mean surface, points on refracted rays: the method at its best.

    Args:
        keypoints: (M, F, 2) pixels, NaN where unseen.
        camera: intrinsics in air.
        truth: (M, 3) true points, camera frame, for the two unknowns; NaN where unknown.
        pixel_noise: standard deviation of each coordinate of a keypoint, px, that is no wandering.
        refractive_index: of the water, > 1; walls are neglected.
        normal_in_cam: of the mean surface, into the water; by default the optical axis.

    Returns:
        Points on the refracted rays of the mean lines of sight; distance and slope by least squares of their distances.

    Raises:
        RefractError: as `spread_depths`, or a medium that is no denser than the camera's.
    """
    from scipy.optimize import minimize_scalar

    if not 1 < refractive_index < np.inf:
        raise RefractError(f"refractive_index {refractive_index:g}: depth from turbulence takes water, e.g. 1.333")
    normal = unit_normal(normal_in_cam)
    place, seen, metric = _places(keypoints, camera, truth, pixel_noise, normal)
    usable = np.flatnonzero(seen.sum(axis=1) >= 2)
    shaken, center = _shaken(place[usable], seen[usable], _noise(metric[usable], pixel_noise), refractive_index)
    aim = truth[usable]
    toward = np.column_stack([tangent_basis(normal), normal])
    layers = Layers(index=(refractive_index,))

    def shape(motion: Motion) -> Array:
        """Points for a distance of one."""
        across = np.stack([-shaken.radial[:, 1], shaken.radial[:, 0]], axis=1)
        still = center + motion.center[:, :1] * shaken.radial + motion.center[:, 1:] * across
        ray = np.column_stack([still, np.ones(len(still))]) @ toward.T
        origin, water = back_project(ray / np.linalg.norm(ray, axis=1, keepdims=True), normal, 1.0, layers)
        return np.asarray(origin + (motion.eta / (water @ normal))[:, None] * water)

    fit = _fittable(place[usable].mean(axis=(1, 2), where=seen[usable][:, :, None])[:, None], aim)

    def judged(motion: Motion) -> tuple[float, float]:
        """Distance of the interface, and the error that it leaves."""
        points = shape(motion)[fit]
        distance = max(float((points * aim[fit]).sum() / (points**2).sum()), 1e-12)
        return distance, _rmse(distance * points, aim[fit])

    wander = float(np.sqrt(np.median((shaken.offset**2).sum(axis=(1, 2)) / (2 * (shaken.seen.sum(axis=1) - 1)))))
    bend = 1 - 1 / refractive_index
    tries = []
    for eta in _TYPICAL:
        slope = max(wander, 1e-12) * (1 + eta / refractive_index) / (eta * bend)
        motion = most_likely(shaken, start_motion(shaken, slope, float(eta)), slope, _FIRST_ROUNDS)
        tries.append((judged(motion)[1], slope, motion))
    best = min(range(len(tries)), key=lambda k: tries[k][0])
    known = {"motion": tries[best][2]}

    def error(log_slope: float) -> float:
        known["motion"] = most_likely(shaken, known["motion"], float(np.exp(log_slope)), _ROUNDS)
        return judged(known["motion"])[1]

    bounds = sorted(np.log(tries[k][1]) for k in (max(best - 1, 0), min(best + 1, len(tries) - 1)))
    found = minimize_scalar(error, bounds=bounds, method="bounded", options={"xatol": _TOLERANCE})
    slope = float(np.exp(found.x))
    motion = most_likely(shaken, known["motion"], slope, _LAST_ROUNDS)
    distance, rmse = judged(motion)
    points, depth = np.full((len(seen), 3), np.nan), np.full(len(seen), np.nan)
    points[usable], depth[usable] = distance * shape(motion), motion.eta
    return DepthFromTurbulence(points=points, spread=depth, offset=distance, scale=slope, rmse=rmse)


def _places(
    keypoints: Array, camera: pycolmap.Camera, truth: Array, pixel_noise: float, normal: Array
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Keypoints as tangents (M, F, 2) of the angle to a direction, which are there (M, F), and the pixels per change
    of a point's mean tangents (M, 2, 2)."""
    if np.ndim(keypoints) != 3 or np.shape(keypoints)[2] != 2 or np.shape(truth) != (len(keypoints), 3):
        raise RefractError(
            f"keypoints of shape {np.shape(keypoints)} and true points of shape {np.shape(truth)}: give (M, F, 2), "
            "with NaN where a point is not seen, and (M, 3)"
        )
    if np.shape(keypoints)[1] < 2:
        raise RefractError(f"{np.shape(keypoints)[1]} frame: depth from turbulence takes two or more, better 15")
    if not 0 <= pixel_noise < np.inf:
        raise RefractError(f"pixel_noise {pixel_noise:g} px is negative: give 0 or more")
    direction, metric = directions_of(camera, keypoints)
    toward = np.column_stack([tangent_basis(normal), normal])
    turned = direction @ toward
    seen = np.isfinite(turned).all(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        place = turned[:, :, :2] / turned[:, :, 2:]
        seen &= (turned[:, :, 2] > 0) & (np.abs(place) < _STEEPEST).all(axis=2)
        # d pixel / d tangents, through the normalisation of (x, y, 1); the metric does not see the ray's own length.
        by_tangents = np.einsum("mfai,ik->mfak", metric, toward[:, :2]) * turned[:, :, 2, None, None]
    if not (seen.sum(axis=1) >= 2).any():
        raise RefractError("no point is seen in two frames: nothing wanders")
    middle = np.zeros((len(seen), 2, 2))
    has = seen.any(axis=1)
    middle[has] = by_tangents[has].mean(axis=1, where=seen[has][:, :, None, None])
    return place, seen, middle


def _noise(metric: Array, pixel_noise: float) -> Array:
    """Covariances (M, 2, 2) of tangents that a pixel noise makes."""
    inverse = np.linalg.pinv(metric)
    return np.asarray(pixel_noise**2 * inverse @ inverse.mT)


def _shaken(place: Array, seen: NDArray[np.bool_], noise: Array, refractive_index: float) -> tuple[Shaken, Array]:
    """The points' wandering along their radii and across, and their mean places (M, 2)."""
    # A first centre that no wrong match can spoil; the likelihood then finds its own.
    center = np.nanmedian(np.where(seen[:, :, None], place, np.nan), axis=1)
    radius = np.linalg.norm(center, axis=1)
    radial = np.where(radius[:, None] > 1e-9, center / np.maximum(radius, 1e-9)[:, None], [1.0, 0.0])
    axes = np.stack([radial, np.stack([-radial[:, 1], radial[:, 0]], axis=1)], axis=1)
    offset = np.where(seen[:, :, None], np.einsum("mai,mfi->mfa", axes, place - center[:, None]), 0.0)
    variance = np.einsum("mai,mij,maj->ma", axes, noise, axes)
    shaken = Shaken(
        offset=offset,
        seen=seen.astype(np.float64),
        variance=variance,
        radial=radial,
        points=radii(radius, refractive_index),
    )
    return shaken, center


def _fittable(rays: Array, truth: Array) -> NDArray[np.bool_]:
    fit = np.isfinite(rays).all(axis=1) & np.isfinite(truth).all(axis=1)
    if fit.sum() < _MIN_FIT:
        raise RefractError(
            f"{fit.sum()} points with keypoints and truth: scale and offset are fitted to {_MIN_FIT} or more"
        )
    return np.asarray(fit)


def _rmse(points: Array, truth: Array) -> float:
    return float(np.sqrt(np.mean(np.sum((points - truth) ** 2, axis=1))))
