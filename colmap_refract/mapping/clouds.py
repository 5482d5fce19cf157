"""Clouds of points from pairs of images: essential matrix, triangulation, and the average of several clouds.

This is the paper's start ("Initial value estimation"): refraction is ignored, each pair's cloud is scaled to a
mean depth of one, and the clouds are averaged. All of them speak of the depths along one image's rays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array
from colmap_refract.mapping.pairs import MIN_COMMON, Pair
from colmap_refract.refiner.observations import Observations

_MAX_ERRORS = (2.0, 6.0, 18.0)
"""Pixels, tried in turn: refraction leaves little to an essential matrix of still water, and more behind a port."""
_MOST_RIGHT = 0.75
"""Part of the matches that agree, at which the next, wider limit is not tried."""


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """The m points of a pair that its essential matrix explains.

    Attributes:
        pair: the images.
        point: (m,) indices of the points, first_row, second_row: (m,) rows of the observations.
        away: (m,) distance from the first camera along the keypoint's ray; the median is one.
        angle: (m,) at which the rays meet, radians.
        inlier_ratio: part of the pair's points that they are.
    """

    pair: Pair
    point: Index
    first_row: Index
    second_row: Index
    away: Array
    angle: Array
    inlier_ratio: float

    @property
    def information(self) -> float:
        """Squared angles, summed."""
        return float((self.angle**2).sum())


def pair_cloud(observations: Observations, pair: Pair, random_seed: int) -> Cloud | None:
    """The cloud of a pair by the five-point algorithm, with the cameras as given; None where there is none."""
    import pycolmap

    first, second = (observations.cameras[observations.image_camera[i]] for i in (pair.first, pair.second))
    pixels = observations.pixel[pair.first_row], observations.pixel[pair.second_row]
    found = None
    for max_error in _MAX_ERRORS:
        options = pycolmap.RANSACOptions(max_error=max_error, random_seed=random_seed)
        options.min_num_trials, options.max_num_trials = 200, 5000
        found = pycolmap.estimate_essential_matrix(*pixels, first, second, options) or found
        if found is not None and found["num_inliers"] >= _MOST_RIGHT * len(pair.first_row):
            break
    if found is None:
        return None
    pose = found["cam2_from_cam1"]
    a, b = observations.direction[pair.first_row], observations.direction[pair.second_row]
    away, angle, before = _meet(a @ pose.rotation.matrix().T, b, pose.translation)
    good = found["inlier_mask"] & before
    if good.sum() < MIN_COMMON:
        return None
    return Cloud(
        pair=pair,
        point=observations.point[pair.first_row][good],
        first_row=pair.first_row[good],
        second_row=pair.second_row[good],
        away=away[good] / np.median(away[good]),
        angle=angle[good],
        inlier_ratio=float(good.mean()),
    )


def _meet(first: Array, second: Array, shift: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Where rays meet nearest: `s first + shift = t second`.

    Returns:
        `s` (m,), the angles between the rays, and whether the rays part and meet before both cameras.
    """
    cosine = np.einsum("ni,ni->n", first, second)
    squared_sine = (np.cross(first, second) ** 2).sum(axis=1)
    f, s = first @ shift, second @ shift
    with np.errstate(divide="ignore", invalid="ignore"):
        along_first = (cosine * s - f) / squared_sine
        along_second = (s - cosine * f) / squared_sine
    before = np.isfinite(along_first) & np.isfinite(along_second) & (along_first > 0) & (along_second > 0)
    return along_first, np.arctan2(np.sqrt(squared_sine), cosine), np.asarray(before)


def average_clouds(clouds: list[Cloud], num_points: int) -> Array:
    """The distances (P,) of the points along the rays of the image that all clouds have first; NaN where unknown.

    The clouds are brought to one scale by the points they share, the most informative first, and their inverse
    distances, in which the noise is even, are averaged.
    """
    inverse = np.full(num_points, np.nan)
    point, value, weight = np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0)
    for cloud in sorted(clouds, key=lambda cloud: cloud.information, reverse=True):
        shared = np.isfinite(inverse[cloud.point])
        scale = 1.0
        if shared.sum() >= MIN_COMMON:
            scale = float(np.median(inverse[cloud.point[shared]] * cloud.away[shared]))
        point = np.concatenate([point, cloud.point])
        value = np.concatenate([value, scale / cloud.away])
        weight = np.concatenate([weight, cloud.angle**2])
        inverse = weighted_medians(value, weight, point, num_points)
    return np.asarray(1.0 / inverse)


def weighted_medians(value: Array, weight: Array, label: Index, count: int) -> Array:
    """The weighted median (count,) of the values of each label; NaN where there is none."""
    order = np.lexsort((value, label))
    value, weight, label = value[order], weight[order], label[order]
    total = np.bincount(label, weight, minlength=count)
    below = np.cumsum(weight) - np.concatenate([[0.0], np.cumsum(total)])[label]
    medians = np.full(count, np.nan)
    # The first of each label that is not below the half: later rows of the same label are written first.
    reached = np.flatnonzero(below >= 0.5 * total[label] * (1.0 - 1e-12))[::-1]
    medians[label[reached]] = value[reached]
    return medians
