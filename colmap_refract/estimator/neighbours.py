"""The soft constraint's regulariser as a quadratic form: weights of the pairs of normals that it compares.

The paper sums `|n_k - mean(N_ij)|^2` over every observation `ij` and every `n_k` of its neighbourhood
`N_ij`: the observations of the same image within a radius about the keypoint, itself included. The variance
of a set is a sum over its pairs, `sum_k |n_k - mean|^2 = 1/|N| sum_{k<l} |n_k - n_l|^2`, so that the whole is

    sum_{k<l} w_kl |n_k - n_l|^2,   w_kl = sum of 1/|N_ij| over all N_ij that hold both k and l.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array


def neighbour_weights(keypoints: Array, radius: float) -> sparse.csr_array:
    """Weights `w_kl` of the pairs of normals of one image.

    Args:
        keypoints: (n, 2) px, all of one image.
        radius: px, of the neighbourhoods; a keypoint at this very distance is a neighbour.

    Returns:
        (n, n) the strict upper triangle; keypoints up to two radii apart share a neighbourhood.

    Raises:
        RefractError: a radius that is not positive.
    """
    if not (np.isfinite(radius) and radius > 0):
        raise RefractError(f"a neighbourhood of {radius:g} px holds no neighbours: give a positive radius")
    n = len(keypoints)
    if n == 0:
        return sparse.csr_array((0, 0))
    pairs = cKDTree(keypoints).query_pairs(radius, output_type="ndarray")
    itself = np.arange(n)
    row = np.concatenate([pairs[:, 0], pairs[:, 1], itself])
    column = np.concatenate([pairs[:, 1], pairs[:, 0], itself])
    # Row ij marks who is in N_ij.
    holds = sparse.csr_array((np.ones(len(row)), (row, column)), shape=(n, n))
    size = np.asarray(holds.sum(axis=1)).ravel()
    shared = holds.T @ (sparse.diags_array(1.0 / size) @ holds)
    return sparse.csr_array(sparse.triu(shared, k=1))
