"""Matches of many images as points: where their refracted rays meet, without the matches that do not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_refract.dense.known_images import KnownImages, Mask, Rays
from colmap_refract.estimator.triangulation import largest_angles, nearest_to_rays
from colmap_refract.interface import Array

_ROUNDS = 3  # of leaving out what does not fit; hardly anything changes after the second


@dataclass(frozen=True, kw_only=True)
class DensePoints:
    """P points and how far they are to be trusted.

    Attributes:
        points: (P, 3), world; NaN where none was found.
        num_matched: (P,) images that the point was matched in, the reference among them.
        num_views: (P,) of those, images that it fits.
        errors: (P,) median reprojection error, px.
        angles: (P,) largest angle between two rays, degrees.
    """

    points: Array
    num_matched: NDArray[np.int64]
    num_views: NDArray[np.int64]
    errors: Array
    angles: Array


def triangulate(images: KnownImages, members: Sequence[int], pixels: Array, max_reproj_error: float) -> DensePoints:
    """Points from matches.

    Points before the interface are met by straight rays.

    Args:
        images: their geometry.
        members: M images by index, the reference first.
        pixels: (M, P, 2), COLMAP's origin; NaN where a point was not found.
        max_reproj_error: pixels; matches with a larger error are left out, and the point is made anew. A point
            that its reference's pixel does not fit is no point.
    """
    count = pixels.shape[1]
    rays = [images.rays(member, pixels[m]) for m, member in enumerate(members)]
    fits = np.array([np.isfinite(one.ray).all(axis=1) & np.isfinite(one.origin).all(axis=1) for one in rays])
    matched = fits.sum(axis=0)
    focal = np.array([images.camera(member).mean_focal_length() for member in members])
    points = _meet(rays, fits, focal)
    # Where the rays meet before the water, they were never bent.
    dry = np.isfinite(points).all(axis=1) & np.isfinite(rays[0].distance) & ~images.is_wet(members[0], rays[0], points)
    if dry.any():
        straight = [
            images.straight(member, np.where(dry[:, None], pixels[m], np.nan)) for m, member in enumerate(members)
        ]
        rays = [_mixed(dry, one, other) for one, other in zip(straight, rays, strict=True)]
        fits &= np.array([np.isfinite(one.ray).all(axis=1) for one in rays])
        points = _meet(rays, fits, focal)
        # On neither side by its own rays: no point at all.
        fits[:, dry & images.is_wet(members[0], rays[0], points)] = False
    errors = np.full(fits.shape, np.inf)
    for round_ in range(_ROUNDS):
        for m, member in enumerate(members):
            off = np.linalg.norm(images.pixels_through(member, rays[m], points) - pixels[m], axis=1)
            errors[m] = np.where(fits[m] & np.isfinite(off), off, np.inf)
        poor = fits & ~(errors <= max_reproj_error)
        if not poor.any() or round_ == _ROUNDS - 1:
            break
        # The worst first: one wrong match moves the point, and right ones then fit badly, too.
        worst = np.where(fits, errors, -1.0).max(axis=0)
        fits &= ~(poor & (errors >= 0.5 * worst))
        again = np.flatnonzero(poor.any(axis=0))
        points[again] = _meet([_some(one, again) for one in rays], fits[:, again], focal)
    fits &= errors <= max_reproj_error
    fits[:, ~fits[0]] = False
    views = fits.sum(axis=0)
    few = views < 2
    points[few] = np.nan
    with np.errstate(all="ignore"):
        ranked = np.sort(np.where(fits, errors, np.nan), axis=0)
    typical = ranked[np.maximum(views - 1, 0) // 2, np.arange(count)]
    origin = np.ascontiguousarray(np.stack([one.origin for one in rays], axis=1)[fits.T])
    angles = largest_angles(_starts(fits), origin, points)
    return DensePoints(points=points, num_matched=matched, num_views=views, errors=typical, angles=angles)


def _starts(fits: Mask) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum(fits.sum(axis=0))]).astype(np.int64)


def _meet(rays: Sequence[Rays], fits: Mask, focal: Array) -> Array:
    """(P, 3) where the rays that fit meet; NaN for fewer than two."""
    origin = np.ascontiguousarray(np.stack([one.origin for one in rays], axis=1)[fits.T])
    ray = np.ascontiguousarray(np.stack([one.ray for one in rays], axis=1)[fits.T])
    lengths = np.broadcast_to(focal, fits.T.shape)[fits.T]
    points = nearest_to_rays(_starts(fits), origin, ray, np.ascontiguousarray(lengths), np.zeros((fits.shape[1], 3)))
    # The kernel keeps what it was given where rays are parallel.
    points[(fits.sum(axis=0) < 2) | ~points.any(axis=1)] = np.nan
    return points


def _mixed(choice: Mask, first: Rays, second: Rays) -> Rays:
    return replace(
        second,
        origin=np.where(choice[:, None], first.origin, second.origin),
        ray=np.where(choice[:, None], first.ray, second.ray),
    )


def _some(rays: Rays, rows: NDArray[np.int64]) -> Rays:
    return Rays(origin=rays.origin[rows], ray=rays.ray[rows], normal=rays.normal[rows], distance=rays.distance[rows])
