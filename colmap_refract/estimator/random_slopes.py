"""Points through a surface of random slopes, with cameras and mean planes that are known.

The model of Alterman, Schechner and Swirski, "Triangulation in Random Refractive Distortions" (TPAMI 2017), in the
image: where a ray crosses the surface, it is tilted from the image's mean plane by two independent normal slopes. To
first order a keypoint is then off its prediction through the mean plane by a normal deviate with the covariance

    R = sigma_px^2 I + sigma_slope^2 S S^T,

where S (2x2) is what the two slopes do to the predicted pixel. The local plane tilts about the crossing `c`: its
normal changes by `dn` and so does its distance, by `dn . c`. S depends on the point: it is zero at the surface and
grows with the share of the way that lies in the water, so that a shallow observation counts for more than a deep one.
An observation of a dry point, or of an image without an interface, has `R = sigma_px^2 I`.

A point solves `sum_k J^T R^-1 e = 0`, with the errors `e` and the derivatives `J` of the prediction by the point:
least squares with weights that are evaluated at the point itself. It is no minimum of anything:

- `sum_k e^T R(X)^-1 e` over the weights as well would be biased, as it gains by moving the point to where larger
  errors are allowed;
- the exact likelihood adds `log det R(X)`, which undoes the bias, and reads the depth from how large the errors are.
  For cameras that move, parallax tells so much more that the points of both differ by 0.03 to 0.08 standard
  deviations (slopes of 2 and 5 degrees, 6 to 20 images). A fixed camera, without parallax but for the tilts of its
  planes, gains a quarter, if the slope deviation is exact; with one that is 30 per cent too small it loses more, and
  its points are too deep. Here a wrong slope deviation costs precision, and makes no bias.

The height of the waves is left out. For waves as long as the water is deep, at rays of 30 degrees, it does a tenth of
what their slopes do; for shorter ones less.

The observations are taken to be independent. Neighbouring keypoints of one image look through nearly the same place
of the surface, and are not: each point's covariance is right, but the errors of points near each other are alike.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from colmap_refract.estimator.optics import FAST, one_interface, slope_derivatives, snell_root
from colmap_refract.estimator.robust import robust
from colmap_refract.interface import Array

MAX_STEPS = 100
_SETTLED, _SETTLED_BY_COST = 1e-10, 1e-12
"""Squared standard deviations that the next step would move the point by, and the part of the cost that this may be:
of less, the rounding of the cost cannot tell whether it is a gain."""
_MOST_DAMPING = 1e12
_GUARD = 1e-13


class Sights(NamedTuple):
    """N observations sorted by point, P points, in images indexed from 0.

    Attributes:
        start: (P + 1,) first observation of each point.
        image: (N,) index of the image.
        direction: (N, 3) unit direction of the keypoint in the camera's frame.
        metric: (N, 2, 3) pixels per change of direction, at the keypoint.
        wet: (N,) whether the point lies in the water as seen from this image.
    """

    start: NDArray[np.int64]
    image: NDArray[np.int32]
    direction: Array
    metric: Array
    wet: NDArray[np.bool_]


class KnownViews(NamedTuple):
    """What is known of I images.

    Attributes:
        rotation: (I, 3, 3), translation: (I, 3): `cam_from_world`.
        normal: (I, 3) `normal_in_cam` of the mean plane, distance: (I,); finite also where there is no interface.
    """

    rotation: Array
    translation: Array
    normal: Array
    distance: Array


class Deviations(NamedTuple):
    """Standard deviations of what is random: `pixel`, of each coordinate of a keypoint, px; `slope`, of each of the
    surface's two slopes, a tangent."""

    pixel: float
    slope: float


# Layout of one observation's values in scratch memory.
_ERROR = 0  # 2
_BY_POINT = 2  # 2 x 3, by the point in the world
_COVARIANCE = 8  # 00, 01, 11
_VALUES = 11


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _observe(k, point, sights, views, optics, deviations, out):
    """Error of observation `k` in pixels, its derivative by the point, and its covariance (see the layout above)."""
    i = sights.image[k]
    rotation = views.rotation
    x, y, w = point[0], point[1], point[2]
    cx = rotation[i, 0, 0] * x + rotation[i, 0, 1] * y + rotation[i, 0, 2] * w + views.translation[i, 0]
    cy = rotation[i, 1, 0] * x + rotation[i, 1, 1] * y + rotation[i, 1, 2] * w + views.translation[i, 1]
    cz = rotation[i, 2, 0] * x + rotation[i, 2, 1] * y + rotation[i, 2, 2] * w + views.translation[i, 2]
    nx, ny, nz = views.normal[i, 0], views.normal[i, 1], views.normal[i, 2]
    d = views.distance[i]
    z = nx * cx + ny * cy + nz * cz
    px, py, pz = cx - z * nx, cy - z * ny, cz - z * nz
    vx, vy, vz = cx, cy, cz
    big, big_s, big_z, big_d = 1.0, 0.0, 0.0, 0.0
    refracted = False
    if sights.wet[k] and z > 0.0:
        s = px * px + py * py + pz * pz
        if optics.ratio.shape[0] == 2 and optics.ratio[1] < 1.0:
            big, big_s, big_z, big_d, _ = one_interface(z, s, d, optics.ratio[1], optics.ratio_by_index[1])
        else:
            g, h = snell_root(z, s, d, optics.ratio, optics.walls)
            big, big_s, big_z, big_d, _ = slope_derivatives(
                g, h, s, d, optics.ratio, optics.ratio_by_index, optics.walls
            )
        if math.isfinite(big):
            refracted = True
            vx, vy, vz = nx + big * px, ny + big * py, nz + big * pz
    inverse = 1.0 / math.sqrt(vx * vx + vy * vy + vz * vz)
    ux, uy, uz = vx * inverse, vy * inverse, vz * inverse
    dx, dy, dz = ux - sights.direction[k, 0], uy - sights.direction[k, 1], uz - sights.direction[k, 2]
    s00, s01, s02, s10, s11, s12 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(2):
        m0, m1, m2 = sights.metric[k, row, 0], sights.metric[k, row, 1], sights.metric[k, row, 2]
        out[_ERROR + row] = m0 * dx + m1 * dy + m2 * dz
        # a = d pixel / d v, through the normalisation of v.
        along = m0 * ux + m1 * uy + m2 * uz
        a0, a1, a2 = (m0 - along * ux) * inverse, (m1 - along * uy) * inverse, (m2 - along * uz) * inverse
        b0, b1, b2 = a0, a1, a2
        if refracted:
            ap = a0 * px + a1 * py + a2 * pz
            an = a0 * nx + a1 * ny + a2 * nz
            # v = n + G p by X: a G + (a . p) (2 G_s p + G_z n) - G (a . n) n
            fp = 2.0 * big_s * ap
            fn = big_z * ap - big * an
            b0 = big * a0 + fp * px + fn * nx
            b1 = big * a1 + fp * py + fn * ny
            b2 = big * a2 + fp * pz + fn * nz
            # By n, the plane pivoting about the crossing d v: dn moves the distance by d G (p . dn).
            fa = 1.0 - big * z
            fp = ap * (big_z - 2.0 * z * big_s + d * big * big_d) - big * an
            t0, t1, t2 = fa * (a0 - an * nx) + fp * px, fa * (a1 - an * ny) + fp * py, fa * (a2 - an * nz) + fp * pz
            if row == 0:
                s00, s01, s02 = t0, t1, t2
            else:
                s10, s11, s12 = t0, t1, t2
        by_point = _BY_POINT + 3 * row
        out[by_point] = b0 * rotation[i, 0, 0] + b1 * rotation[i, 1, 0] + b2 * rotation[i, 2, 0]
        out[by_point + 1] = b0 * rotation[i, 0, 1] + b1 * rotation[i, 1, 1] + b2 * rotation[i, 2, 1]
        out[by_point + 2] = b0 * rotation[i, 0, 2] + b1 * rotation[i, 1, 2] + b2 * rotation[i, 2, 2]
    # The slopes are alike in all directions, so no axes need be chosen along the plane.
    pixel, slope = deviations.pixel * deviations.pixel, deviations.slope * deviations.slope
    out[_COVARIANCE] = pixel + slope * (s00 * s00 + s01 * s01 + s02 * s02)
    out[_COVARIANCE + 1] = slope * (s00 * s10 + s01 * s11 + s02 * s12)
    out[_COVARIANCE + 2] = pixel + slope * (s10 * s10 + s11 * s11 + s12 * s12)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def _invert(values, out):
    """The inverse (00, 01, 11) of an observation's covariance."""
    c00, c01, c11 = values[_COVARIANCE], values[_COVARIANCE + 1], values[_COVARIANCE + 2]
    determinant = c00 * c11 - c01 * c01
    out[0], out[1], out[2] = c11 / determinant, -c01 / determinant, c00 / determinant


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _system(point, p, weigh, sights, views, optics, deviations, loss, scale, values, weight, matrix, gradient):
    """Cost of point `p`, its gradient (3,) and Gauss-Newton matrix (3, 3), errors weighed by `weight` (n, 3).

    With `weigh` the weights are evaluated at the point first.
    """
    cost = 0.0
    matrix[:] = 0.0
    gradient[:] = 0.0
    first = sights.start[p]
    for k in range(first, sights.start[p + 1]):
        _observe(k, point, sights, views, optics, deviations, values)
        if weigh:
            _invert(values, weight[k - first])
        w00, w01, w11 = weight[k - first]
        e0, e1 = values[_ERROR], values[_ERROR + 1]
        f0, f1 = w00 * e0 + w01 * e1, w01 * e0 + w11 * e1
        rho, factor = robust(e0 * f0 + e1 * f1, loss, scale)
        cost += 0.5 * rho
        for a in range(3):
            j0, j1 = values[_BY_POINT + a], values[_BY_POINT + 3 + a]
            gradient[a] += factor * (j0 * f0 + j1 * f1)
            g0, g1 = factor * (w00 * j0 + w01 * j1), factor * (w01 * j0 + w11 * j1)
            for b in range(a, 3):
                matrix[a, b] += g0 * values[_BY_POINT + b] + g1 * values[_BY_POINT + 3 + b]
    return cost


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _solve(matrix, damping, gradient, step):
    """`step = (matrix + damping diag(matrix))^-1 gradient` by Cholesky; `gradient . step`."""
    guard = _GUARD * (matrix[0, 0] + matrix[1, 1] + matrix[2, 2]) + 1e-300
    l00 = math.sqrt(matrix[0, 0] * (1.0 + damping) + guard)
    l10, l20 = matrix[0, 1] / l00, matrix[0, 2] / l00
    l11 = math.sqrt(max(matrix[1, 1] * (1.0 + damping) + guard - l10 * l10, guard))
    l21 = (matrix[1, 2] - l20 * l10) / l11
    l22 = math.sqrt(max(matrix[2, 2] * (1.0 + damping) + guard - l20 * l20 - l21 * l21, guard))
    y0 = gradient[0] / l00
    y1 = (gradient[1] - l10 * y0) / l11
    y2 = (gradient[2] - l20 * y0 - l21 * y1) / l22
    step[2] = y2 / l22
    step[1] = (y1 - l21 * step[2]) / l11
    step[0] = (y0 - l10 * step[1] - l20 * step[2]) / l00
    return y0 * y0 + y1 * y1 + y2 * y2


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def settle(points, first_point, stop_point, sights, views, optics, deviations, loss, scale):
    """Bring points to where `sum_k J^T R^-1 e = 0`; Levenberg-Marquardt, the weights renewed at every step.

    Args:
        points: (P, 3) world positions, changed in place. One from which nothing can be computed stays.
        first_point, stop_point: the range of points to work on.
        sights, views, optics, deviations: see the tuples.
        loss, scale: robust loss on `e^T R^-1 e`, and its scale in standard deviations.

    Returns:
        The number of points that did not come to rest.
    """
    longest = 1
    for p in range(first_point, stop_point):
        longest = max(longest, sights.start[p + 1] - sights.start[p])
    weight, values = np.empty((longest, 3)), np.empty(_VALUES)
    matrix, gradient, step, trial = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    restless = 0
    for p in range(first_point, stop_point):
        damping, settled, stale, cost = 0.0, False, True, 0.0
        for _ in range(MAX_STEPS):
            if stale:
                cost = _system(
                    points[p], p, True, sights, views, optics, deviations, loss, scale, values, weight, matrix, gradient
                )
            move = _solve(matrix, damping, gradient, step)
            if damping == 0.0 and move <= _SETTLED + _SETTLED_BY_COST * cost:
                settled = True
                break
            for j in range(3):
                trial[j] = points[p, j] - step[j]
            # The weights stay for the comparison: with its own, a deeper point has the smaller cost.
            trial_cost = _cost(trial, p, weight, sights, views, optics, deviations, loss, scale, values)
            stale = trial_cost <= cost * (1.0 + 1e-14)
            if stale:
                points[p] = trial
                damping *= 0.1 if damping > 1e-6 else 0.0
            else:
                damping = max(1e-3, 10.0 * damping)
                if not damping < _MOST_DAMPING:
                    break
        restless += not settled
    return restless


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _cost(point, p, weight, sights, views, optics, deviations, loss, scale, values):
    cost = 0.0
    first = sights.start[p]
    for k in range(first, sights.start[p + 1]):
        _observe(k, point, sights, views, optics, deviations, values)
        w00, w01, w11 = weight[k - first]
        e0, e1 = values[_ERROR], values[_ERROR + 1]
        rho, _ = robust(w00 * e0 * e0 + 2.0 * w01 * e0 * e1 + w11 * e1 * e1, loss, scale)
        cost += 0.5 * rho
    return cost


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def appraise(points, sights, views, optics, deviations, squared, information):
    """What the observations are worth at given points, no loss.

    Args:
        points: (P, 3).
        sights, views, optics, deviations: see the tuples.
        squared: (N,) becomes `e^T R^-1 e`, chi-square of two degrees of freedom if the model is true.
        information: (P, 3, 3) becomes `sum_k J^T R^-1 J`, the inverse of a point's covariance.
    """
    values, inverse = np.empty(_VALUES), np.empty(3)
    for p in range(points.shape[0]):
        information[p] = 0.0
        for k in range(sights.start[p], sights.start[p + 1]):
            _observe(k, points[p], sights, views, optics, deviations, values)
            _invert(values, inverse)
            e0, e1 = values[_ERROR], values[_ERROR + 1]
            squared[k] = inverse[0] * e0 * e0 + 2.0 * inverse[1] * e0 * e1 + inverse[2] * e1 * e1
            for a in range(3):
                j0, j1 = values[_BY_POINT + a], values[_BY_POINT + 3 + a]
                g0, g1 = inverse[0] * j0 + inverse[1] * j1, inverse[1] * j0 + inverse[2] * j1
                for b in range(3):
                    information[p, a, b] += g0 * values[_BY_POINT + b] + g1 * values[_BY_POINT + 3 + b]
