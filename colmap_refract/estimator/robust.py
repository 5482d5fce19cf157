"""Robust losses as compiled code has them, with Ceres' definitions."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from colmap_refract.estimator.optics import FAST
from colmap_refract.options import Loss

TRIVIAL, HUBER, SOFT_L1, CAUCHY = range(4)

LOSSES: dict[Loss, int] = {"trivial": TRIVIAL, "huber": HUBER, "soft_l1": SOFT_L1, "cauchy": CAUCHY}


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def robust(s, loss, scale):
    """`rho(s)` and `rho'(s)` of a squared residual in pixels, Ceres' definitions."""
    b = scale * scale
    if loss == HUBER:
        if s <= b:
            return s, 1.0
        root = math.sqrt(s)
        return 2.0 * scale * root - b, scale / root
    if loss == SOFT_L1:
        root = math.sqrt(1.0 + s / b)
        return 2.0 * b * (root - 1.0), 1.0 / root
    if loss == CAUCHY:
        return b * math.log1p(s / b), 1.0 / (1.0 + s / b)
    return s, 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def weights(squared, loss, scale):
    """`rho'` (n,) of squared residuals (n,)."""
    out = np.empty(squared.shape[0])
    for k in range(squared.shape[0]):
        out[k] = robust(squared[k], loss, scale)[1]
    return out
