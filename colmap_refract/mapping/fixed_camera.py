"""Depths for a camera that stood still behind a surface that moved, from the clouds of pairs of its images.

A tilt of the surface shifts the image of a point the more, the more water is above it; a step to the side shifts
what is near the most. An essential matrix takes the one for the other: where only the surface moved, a pair's
cloud has its relief turned inside out, on a bowl that stands for the growth of refraction towards the edges of
the image. So of every cloud the smooth part is taken away and the rest is turned so that what moves more lies
deeper. Halves of the images that share nothing say how far the average of such reliefs is to be believed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array
from colmap_refract.mapping.clouds import Cloud, pair_cloud, weighted_medians
from colmap_refract.mapping.model_from_database import Posed
from colmap_refract.mapping.pairs import MIN_COMMON, rank_pairs
from colmap_refract.refiner.arrangement import segment_median
from colmap_refract.refiner.observations import Observations

_PAIRS_PER_HALF = 15
_MOST_RELIEF = 0.4
"""Of the depth, either way: what is more comes from a wrong match or a pair without parallax."""
_LEAST_AXIAL = 0.2
"""Cosine to the optical axis: rays beyond are taken as if they were there, where a plane is never met."""
_SIGNIFICANT = 3.0
"""Standard deviations of a correlation by chance."""
_ROUNDS = 8
"""Of reweighting."""


@dataclass(frozen=True, kw_only=True)
class Relief:
    """Inverse depths of P points about one.

    Attributes:
        inverse_depth: (P,) along the optical axis, about one; exactly one where nothing is known.
        reliability: part of the relief's variance that is not noise; 0 if the halves of the images agree no
            better than by chance, and then all depths are one.
        clouds: of the pairs that were used.
    """

    inverse_depth: Array
    reliability: float
    clouds: list[Cloud]


def start_fixed_camera(
    observations: Observations, common: Index, group: Index, anchor: int, random_seed: int
) -> tuple[Posed, Relief]:
    """One pose for all images, and points along the reference image's rays, or else along their median ray.

    Args:
        observations: of all images; their poses do not count.
        common: as `pairs.common_points` counts them.
        group: indices of the images that get a pose.
        anchor: index of the reference image.
        random_seed: of the samples.

    Raises:
        RefractError: a rig of several cameras.
    """
    if np.abs(observations.sensor_translation).max() > 0 or np.abs(observations.sensor_rotation - np.eye(3)).max() > 0:
        raise RefractError(
            "start values for a fixed camera are found for one camera, and the database has a rig of several: use its "
            "images one camera at a time"
        )
    relief = find_relief(observations, common, group, random_seed)
    ray = np.stack([segment_median(observations.direction[:, k], observations.start) for k in range(3)], axis=1)
    mine = observations.image == anchor
    ray[observations.point[mine]] = observations.direction[mine]
    axial = np.maximum(ray[:, 2], _LEAST_AXIAL * np.linalg.norm(ray, axis=1))
    points = ray / (relief.inverse_depth * axial)[:, None]
    posed = np.zeros(len(observations.frame_ids), dtype=np.bool_)
    posed[observations.image_frame[group]] = True
    seen = posed[observations.image_frame[observations.image]]
    keep = seen & (np.bincount(observations.point[seen], minlength=len(points)) >= 2)[observations.point]
    return Posed(observations=replace(observations, points=points), posed=posed, keep=keep), relief


def find_relief(observations: Observations, common: Index, images: Index, random_seed: int) -> Relief:
    """Depths of the points that a camera sees which does not move.

    Args:
        common: as `pairs.common_points` counts them.
        images: indices of the images to use; with fewer than four there are no independent halves.
        random_seed: of the five-point algorithm's samples.
    """
    num_points = len(observations.points)
    halves: list[list[tuple[Cloud, Array]]] = []
    for half in (images[::2], images[1::2]):
        found = []
        for pair in rank_pairs(observations, common, half)[:_PAIRS_PER_HALF]:
            cloud = pair_cloud(observations, pair, random_seed)
            relief = None if cloud is None else _relief(observations, cloud)
            if cloud is not None and relief is not None:
                found.append((cloud, relief))
        halves.append(found)
    both = halves[0] + halves[1]
    clouds = [cloud for cloud, _ in both]
    reliability = _reliability(*(_average(half, num_points) for half in halves))
    relief = np.nan_to_num(_average(both, num_points))
    # Noise in it would lead further from the truth than no relief at all: the best guess is drawn to none.
    inverse_depth = 1.0 + reliability * np.clip(relief, -_MOST_RELIEF, _MOST_RELIEF)
    return Relief(inverse_depth=inverse_depth, reliability=reliability, clouds=clouds)


def _relief(observations: Observations, cloud: Cloud) -> Array | None:
    """Inverse depths (m,) of a cloud about zero, deeper where more moves; None if they say nothing of that."""
    from scipy.stats import spearmanr

    place, other = (_on_plane(observations.direction[rows]) for rows in (cloud.first_row, cloud.second_row))
    axial = np.maximum(observations.direction[cloud.first_row, 2], _LEAST_AXIAL)
    inverse = 1.0 / (cloud.away * axial)
    relief = _without_trend(inverse / np.median(inverse), place)
    gain = _without_trend(_gain(place, other), place)
    agreement = float(spearmanr(relief, gain).statistic)
    if not abs(agreement) * np.sqrt(len(relief)) > _SIGNIFICANT:
        return None
    return np.asarray(-np.sign(agreement) * relief)


def _gain(place: Array, other: Array) -> Array:
    """How much (m,) each point moved between two images, in parts of what it would if all were at one depth.

    A tilt of the interface moves a point at infinity as a turn of the camera does, and its distance scales
    the image: two slopes and a scale are fitted, reweighted for wrong matches.

    Args:
        place, other: (m, 2) the points on the plane at distance one in both images.
    """
    turn = np.eye(2) + place[:, :, None] * place[:, None, :]
    model = np.concatenate([turn, place[:, :, None]], axis=2)
    moved = other - place
    weight = np.ones(len(place))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, None]
        fit = np.linalg.lstsq((model * root[:, None]).reshape(-1, 3), (moved * root).ravel(), rcond=None)[0]
        weight = _weights(np.linalg.norm(moved - model @ fit, axis=1))
    tilting = turn @ fit[:2]
    squared = np.maximum((tilting**2).sum(axis=1), 1e-18)
    return np.asarray(((moved - fit[2] * place) * tilting).sum(axis=1) / squared)


def _without_trend(values: Array, place: Array) -> Array:
    """Values (m,) without their quadratic polynomial in the place (m, 2) in the image, robustly fitted."""
    x, y = place.T
    basis = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)
    rest, weight = values, np.ones(len(values))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        fit = np.linalg.lstsq(basis * root[:, None], values * root, rcond=None)[0]
        rest = values - basis @ fit
        weight = _weights(np.abs(rest))
    return np.asarray(rest)


def _weights(error: Array) -> Array:
    """Cauchy weights at twice the median error."""
    return 1.0 / (1.0 + (error / max(2.0 * float(np.median(error)), 1e-12)) ** 2)


def _on_plane(direction: Array) -> Array:
    return direction[:, :2] / np.maximum(direction[:, 2:], _LEAST_AXIAL)


def _average(reliefs: list[tuple[Cloud, Array]], num_points: int) -> Array:
    """Weighted medians (P,) of reliefs, by the squared angles of the pairs; NaN where there is none."""
    if not reliefs:
        return np.full(num_points, np.nan)
    value = np.concatenate([relief for _, relief in reliefs])
    weight = np.concatenate([np.full(len(relief), np.median(cloud.angle) ** 2) for cloud, relief in reliefs])
    return weighted_medians(value, weight, np.concatenate([cloud.point for cloud, _ in reliefs]), num_points)


def _reliability(first: Array, second: Array) -> float:
    """Of the mean of two independent measurements (P,), from their correlation (Spearman 1910, Brown 1910)."""
    from scipy.stats import spearmanr

    both = np.isfinite(first) & np.isfinite(second)
    if both.sum() < MIN_COMMON:
        return 0.0
    agreement = float(spearmanr(first[both], second[both]).statistic)
    return 2.0 * agreement / (1.0 + agreement) if agreement * np.sqrt(both.sum()) > _SIGNIFICANT else 0.0
