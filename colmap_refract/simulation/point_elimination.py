"""Points taken out of the linear equations of a bound, one by one or, with correlated noise, all together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from colmap_refract.interface import Array

Index = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class CorrelatedNoise:
    """Noise of observations that do not err each on their own, as those of one image through unknown waves do.

    Attributes:
        groups: indices of the observations that are correlated; each observation is in one group.
        factors: of each group of n, the lower Cholesky factor (2n, 2n) of the covariance of its pixels, px^2.
    """

    groups: list[Index]
    factors: list[Array]

    def whiten(self, jacobian: Array) -> Array:
        """Rows (N, 2, C) of observations in other units: those of independent noise of 1."""
        from scipy.linalg import solve_triangular

        white = np.empty_like(jacobian)
        for group, factor in zip(self.groups, self.factors, strict=True):
            rows = jacobian[group].reshape(2 * len(group), -1)
            white[group] = solve_triangular(factor, rows, lower=True).reshape(len(group), 2, -1)
        return white


class Eliminated(NamedTuple):
    """What is left when the points follow every change of the blocks."""

    own: Array
    """Covariances (P, 3, 3) of the points if the blocks were known."""
    beside: Array
    """(P, 3, 7): the covariance of all points if the blocks were known, times the similarities."""
    follow: Array
    """(3P, C): a change of the blocks moves the points by minus this."""
    reduced: Array
    """(R, C): what the pixels tell of the blocks, in rows of unit variance."""


def eliminate_singly(point: Index, by_point: Array, by_block: Array, similarity: Array) -> Eliminated:
    """Each point is eliminated from its own rows; the arguments are those of `eliminate_jointly`."""
    num_points, num_columns = len(similarity) // 3, by_block.shape[2]
    normal_matrix = np.zeros((num_points, 3, 3))
    np.add.at(normal_matrix, point, by_point.mT @ by_point)
    own = np.asarray(np.linalg.pinv(normal_matrix, rcond=1e-12, hermitian=True), dtype=np.float64)
    coupling = np.zeros((num_points, 3, num_columns))
    np.add.at(coupling, point, by_point.mT @ by_block)
    follow = own @ coupling
    reduced = by_block - by_point @ follow[point]
    return Eliminated(
        own=own,
        beside=own @ similarity.reshape(num_points, 3, 7),
        follow=follow.reshape(3 * num_points, num_columns),
        reduced=reduced.reshape(-1, num_columns),
    )


def eliminate_jointly(
    point: Index, by_point: Array, by_block: Array, similarity: Array, noise: CorrelatedNoise
) -> Eliminated:
    """All points are eliminated at once, by a QR decomposition of the white Jacobian.

    Args:
        point: (N,) of each observation.
        by_point, by_block: derivatives of its pixel by its point (N, 2, 3) and by the blocks (N, 2, C).
        similarity: orthonormal velocities (3P, 7) of the points under similarities.
        noise: of the pixels.
    """
    from scipy.linalg import solve_triangular

    num_points = len(similarity) // 3
    # What a point's pixels say nothing of is left out: along these axes no noise changes that.
    normal_matrix = np.zeros((num_points, 3, 3))
    np.add.at(normal_matrix, point, by_point.mT @ by_point)
    value, axes = np.linalg.eigh(normal_matrix)
    known = (value > 1e-12 * value[:, -1:]).ravel()
    dense = np.zeros((len(point), 2, num_points, 3))
    dense[np.arange(len(point)), :, point] = by_point @ axes[point]
    white = noise.whiten(np.concatenate([dense.reshape(len(point), 2, -1)[:, :, known], by_block], axis=2))
    r: Array = np.asarray(np.linalg.qr(white.reshape(2 * len(point), -1), mode="r"))

    count = int(known.sum())
    inverse = solve_triangular(r[:count, :count], np.column_stack([np.eye(count), r[:count, count:]]))
    in_axes = np.zeros((3 * num_points, inverse.shape[1]))
    in_axes[known] = inverse
    in_world = (axes @ in_axes.reshape(num_points, 3, -1)).reshape(3 * num_points, -1)
    root = in_world[:, :count]
    per_point = root.reshape(num_points, 3, count)
    return Eliminated(
        own=per_point @ per_point.mT,
        beside=(root @ (root.T @ similarity)).reshape(num_points, 3, 7),
        follow=in_world[:, count:],
        reduced=r[count:, count:],
    )
