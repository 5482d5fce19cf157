"""What small motions of a nearly level surface do to keypoints: the gains that depth from turbulence reads backwards.

All is relative to the mean surface: places are tangents `x` of the angle to its normal, lengths are in its distance.
A point in water of depth `eta` (over the interface's distance) is seen at radius `x = tan a`, through a ray in the
water with the tangent `t = tan w`, `sin w = sin a / mu`; its own radius is `x + eta t`. Where the surface tilts by a
small slope about the ray's crossing, and where it moves along its normal, the ray that meets the point moves by

    along the radius  dx = eta A_r / (1 + eta B_r) s_r + L e,   A_r = A_t / cos^2 w,  B_r = dt / dx
    across it         dx = eta A_t / (1 + eta B_t) s_t,         A_t = 1 - cos a / (mu cos w),  B_t = t / x

with `L = (x - t) / (1 + eta B_r)`, the slopes `s` and the lift `e` counted so that they move the keypoint outwards. A
tilt of a whole plane also moves it at the crossing, by `-x s_r`. On the axis and near it both gains are
`eta (1 - 1/mu) / (1 + eta/mu)`: with the apparent depth `1 + eta/mu` of the point, its inverse is linear in the gain.
That is why a spread tells depths but for a scale and an offset: the slopes and the distance are not known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from colmap_refract.interface import Array

_ON_AXIS = 1e-9


class Radii(NamedTuple):
    """M points by the tangents of their directions: all (M,), see the module's docstring."""

    x: Array
    t: Array
    a_r: Array
    a_t: Array
    b_r: Array
    b_t: Array


class Gains(NamedTuple):
    """By depth, of the shape that the depths have with the points first."""

    radial: Array
    """Of a slope at the crossing."""
    across: Array
    lift: Array
    radial_plane: Array
    """Of a slope of the whole plane, which lifts the crossing as well."""


def radii(x: Array, refractive_index: float) -> Radii:
    """The coefficients of points at tangents (M,) >= 0."""
    cos_a = 1 / np.hypot(1, x)
    sin_w = x * cos_a / refractive_index
    cos_w = np.sqrt(1 - sin_w**2)
    bent = cos_a / (refractive_index * cos_w)
    tangent = sin_w / cos_w
    ratio = np.divide(tangent, x, out=np.full_like(x, 1 / refractive_index), where=x > _ON_AXIS)
    return Radii(
        x=x,
        t=tangent,
        a_r=(1 - bent) / cos_w**2,
        a_t=1 - bent,
        b_r=bent * cos_a**2 / cos_w**2,
        b_t=ratio,
    )


def gains(points: Radii, eta: Array) -> Gains:
    """The gains of points in water of depths `eta`, (M,) or (M, K)."""
    x, t, a_r, a_t, b_r, b_t = (value.reshape(-1, *[1] * (eta.ndim - 1)) for value in points)
    along, across = 1 / (1 + eta * b_r), 1 / (1 + eta * b_t)
    radial, lift = eta * a_r * along, (x - t) * along
    return Gains(radial=radial, across=eta * a_t * across, lift=lift, radial_plane=radial - x * lift)
