"""Which pairs of images tell most of the geometry: many points in common, seen from truly different viewpoints.

What a rotation of the camera explains tells nothing of depth, so a pair is judged by what is left of its points'
displacement once the best rotation has been taken out. That counts the same for a camera that moved and for one
that stood still behind a surface that moved, whose viewpoints are virtual.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array
from colmap_refract.refiner.observations import Observations

MIN_COMMON = 12
"""Points in common, for a pair to be looked at: five make an essential matrix, the others say if it holds."""
_MOST_JUDGED = 2000
"""Pairs whose displacement is looked at."""
_ENOUGH = 200
"""Points of a pair whose displacement is looked at."""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two images and the m points that both see.

    Attributes:
        first, second: indices of the images.
        first_row, second_row: (m,) rows of the observations.
        parallax: median angle, radians, that is left of the displacement after the best rotation.
    """

    first: int
    second: int
    first_row: Index
    second_row: Index
    parallax: float

    @property
    def information(self) -> float:
        """What the pair tells of the geometry: squared parallax, summed over the points."""
        return self.parallax**2 * len(self.first_row)


def rows_by_image(observations: Observations) -> list[Index]:
    """The rows of the observations of each image, ascending by point."""
    order = np.argsort(observations.image, kind="stable")
    ends = np.cumsum(np.bincount(observations.image, minlength=len(observations.image_ids)))
    return np.split(order, ends[:-1])


def common_points(observations: Observations) -> NDArray[np.int64]:
    """(I, I) how many points two images have in common; on the diagonal how many each has."""
    from scipy.sparse import csr_array

    count = len(observations.image_ids)
    sees = csr_array(
        (np.ones(len(observations.image)), (observations.image, observations.point)),
        shape=(count, len(observations.points)),
    )
    return np.asarray((sees @ sees.T).toarray(), dtype=np.int64)


def connected_groups(common: NDArray[np.int64]) -> list[Index]:
    """Images that pairs with enough points in common join, directly or through others; the largest group first.

    Args:
        common: as `common_points` counts them.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    _, label = connected_components(csr_array(common >= MIN_COMMON), directed=False)
    groups = [np.flatnonzero(label == k) for k in range(label.max() + 1)]
    return sorted(groups, key=lambda group: (len(group), common[np.ix_(group, group)].sum()), reverse=True)


def choose_reference(common: NDArray[np.int64], group: Index) -> int:
    """The image of a group that shares most with the others."""
    shared = common[np.ix_(group, group)] - np.diag(np.diag(common)[group])
    return int(group[shared.sum(axis=1).argmax()])


def rank_pairs(
    observations: Observations, common: NDArray[np.int64], images: Index, anchor: int | None = None
) -> list[Pair]:
    """Pairs of images with enough points in common, the most informative first.

    Args:
        images: indices of the images to pair.
        anchor: the first image of every pair; None for all pairs.
    """
    first, second = np.triu_indices(len(images), 1) if anchor is None else (np.zeros(0, int), np.zeros(0, int))
    first, second = images[first], images[second]
    if anchor is not None:
        second = images[images != anchor]
        first = np.full(len(second), anchor)
    enough = common[first, second] >= MIN_COMMON
    first, second = first[enough], second[enough]
    step = max(1, -(-len(first) // _MOST_JUDGED))
    rows = rows_by_image(observations)
    pairs = [
        _pair(observations, rows, i, j) for i, j in zip(first[::step].tolist(), second[::step].tolist(), strict=True)
    ]
    return sorted(pairs, key=lambda pair: pair.information, reverse=True)


def _pair(observations: Observations, rows: list[Index], first: int, second: int) -> Pair:
    point = observations.point
    _, a, b = np.intersect1d(point[rows[first]], point[rows[second]], assume_unique=True, return_indices=True)
    a, b = rows[first][a], rows[second][b]
    some = slice(None, None, max(1, len(a) // _ENOUGH))
    parallax = rotational_residual(observations.direction[a[some]], observations.direction[b[some]])
    return Pair(first=first, second=second, first_row=a, second_row=b, parallax=float(np.median(parallax)))


def rotational_residual(first: Array, second: Array) -> Array:
    """Angles (m,), radians, between unit directions (m, 3) after the rotation that brings the first to the second
    best (Kabsch 1976, reweighted so that wrong matches lose their say)."""
    weight = np.ones(len(first))
    angle = np.zeros(len(first))
    for _ in range(5):
        u, _, vt = np.linalg.svd((second * weight[:, None]).T @ first)
        rotation = (u * [1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        angle = np.linalg.norm(first @ rotation.T - second, axis=1)
        weight = 1.0 / (1.0 + (angle / max(float(np.median(angle)), 1e-9)) ** 2)
    return np.asarray(angle)
