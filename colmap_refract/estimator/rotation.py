"""Rotation vectors in batches: the exponential map, its left Jacobian, and the mean of rotations."""

from __future__ import annotations

import numpy as np

from colmap_refract.interface import Array


def cross_matrix(vector: Array) -> Array:
    """(..., 3) to the (..., 3, 3) matrices with `cross_matrix(a) @ b = a x b`."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape[:-1], 3, 3)


def exp_and_left_jacobian(vector: Array) -> tuple[Array, Array]:
    """Rotations of rotation vectors, and how they change with them.

    Args:
        vector: (..., 3) in radians.

    Returns:
        `(rotation, jacobian)`, both (..., 3, 3): a change `d` of the vector turns the rotation further by
        the rotation vector `jacobian @ d`, applied on the left.
    """
    angle2 = np.einsum("...i,...i->...", vector, vector)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle2 < 1e-8
    safe = np.where(small, 1.0, angle)
    sinc = np.where(small, 1.0 - angle2 / 6.0, np.sin(safe) / safe)
    half = np.where(small, 0.5 - angle2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    third = np.where(small, 1.0 / 6.0 - angle2 / 120.0, (safe - np.sin(safe)) / safe**3)
    k = cross_matrix(vector)
    k2 = k @ k
    return np.eye(3) + sinc * k + half * k2, np.eye(3) + half * k + third * k2


def mean_rotation(rotations: Array) -> Array:
    """Chordal mean of (N, 3, 3) rotations: the rotation nearest to their sum."""
    u, _, vt = np.linalg.svd(rotations.sum(axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
