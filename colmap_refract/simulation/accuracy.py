"""How near a model's points are to the truth, and how near the pixel noise lets them be."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array
from colmap_refract.simulation.capture import Capture

if TYPE_CHECKING:
    import pycolmap


def point_rmse(reconstruction: pycolmap.Reconstruction, capture: Capture, robust: bool = False) -> float:
    """Distance of the points to the truth after a similarity alignment, in metres.

    Args:
        reconstruction: a model with the capture's point ids; those it lacks are left out.
        robust: the median distance, aligned to the best 90 % of the points, in place of the root mean square.

    Raises:
        RefractError: fewer than three points in common.
    """
    truth = capture.reconstruction
    common = sorted(set(reconstruction.point3D_ids()) & set(truth.point3D_ids()))
    if len(common) < 3:
        raise RefractError(f"{len(common)} points in common with the truth; three are needed")
    source = np.array([reconstruction.points3D[i].xyz for i in common])
    target = np.array([truth.points3D[i].xyz for i in common])
    if not robust:
        return float(np.sqrt(np.mean(np.sum((_align(source, target, source) - target) ** 2, axis=1))))
    # Runaway points would spoil a first alignment, and they are far from the others.
    error = np.linalg.norm(source - np.median(source, axis=0), axis=1)
    for _ in range(20):
        best = np.argsort(error)[: max(3, int(0.9 * len(error)))]
        error = np.linalg.norm(_align(source[best], target[best], source) - target, axis=1)
    return float(np.median(error))


def _align(source: Array, target: Array, points: Array) -> Array:
    """`points` moved by the similarity that brings `source` to `target` (Umeyama 1991)."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    u, singular, vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    scale = singular @ sign / np.sum((source - source_mean) ** 2)
    return np.asarray(scale * (points - source_mean) @ (u * sign @ vt).T + target_mean)
