"""Points that live on the refracted ray of one observation, the paper's `P_j = BP(p_rj, d_j)`, exactly.

The constraint is that the observation's own residual is zero. Its derivatives `A` by the point and `B` by the
observation's blocks `x` say how the point follows them, with `a` the direction of the ray (`A a = 0`):

    dP = a dd + S dx,   S = -A^T (A A^T)^-1 B.

How much of `S` runs along the ray does not matter once the length `d` is eliminated.
"""

from __future__ import annotations

import math

from numba import njit

from colmap_refract.estimator.observed import is_wavy, local_plane
from colmap_refract.estimator.optics import FAST

_GUARD = 1e-11


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def refracted_ray(k, tracks, views, optics, origin, ray):
    """The ray behind the interface on which observation `k` has no error, in the world: `IP` and `RV` of the paper.

    A dry observation has a straight ray from the projection centre.

    Args:
        k, tracks, views, optics: as for `elimination`.
        origin, ray: (3,) out, a point of the ray and its unit direction; not a number where it is totally reflected
            or does not reach the interface.
    """
    i = tracks.image[k]
    # The direction u' without error, metric (u' - u) = -moved: what the metric sees of it, and the rest of its length
    # along the vector that the metric does not see. Intrinsics and linearised waves move it from the keypoint's.
    e0, e1 = 0.0, 0.0
    for j in range(3):
        e0 += tracks.metric[k, 0, j] * tracks.direction[k, j]
        e1 += tracks.metric[k, 1, j] * tracks.direction[k, j]
    for q in range(tracks.lens.shape[2]):
        e0 -= tracks.lens[k, 0, q] * views.lens_change[i, q]
        e1 -= tracks.lens[k, 1, q] * views.lens_change[i, q]
    if tracks.effects.shape[2] > 0:
        e0 -= tracks.offset[k, 0]
        e1 -= tracks.offset[k, 1]
        for q in range(tracks.effects.shape[2]):
            e0 -= tracks.effects[k, 0, q] * views.waves[i, q]
            e1 -= tracks.effects[k, 1, q] * views.waves[i, q]
    a0, a1, a2 = tracks.metric[k, 0, 0], tracks.metric[k, 0, 1], tracks.metric[k, 0, 2]
    b0, b1, b2 = tracks.metric[k, 1, 0], tracks.metric[k, 1, 1], tracks.metric[k, 1, 2]
    aa, ab, bb = a0 * a0 + a1 * a1 + a2 * a2, a0 * b0 + a1 * b1 + a2 * b2, b0 * b0 + b1 * b1 + b2 * b2
    determinant = aa * bb - ab * ab
    f0, f1 = (bb * e0 - ab * e1) / determinant, (aa * e1 - ab * e0) / determinant
    ux, uy, uz = f0 * a0 + f1 * b0, f0 * a1 + f1 * b1, f0 * a2 + f1 * b2
    kx, ky, kz = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    rest = math.sqrt((1.0 - (ux * ux + uy * uy + uz * uz)) / determinant)
    if kx * tracks.direction[k, 0] + ky * tracks.direction[k, 1] + kz * tracks.direction[k, 2] < 0.0:
        rest = -rest
    ux, uy, uz = ux + rest * kx, uy + rest * ky, uz + rest * kz
    ox, oy, oz = 0.0, 0.0, 0.0
    rx, ry, rz = ux, uy, uz
    if tracks.wet[k]:
        nx, ny, nz, d = views.normal[i, 0], views.normal[i, 1], views.normal[i, 2], views.distance[i]
        if is_wavy(tracks):
            nx, ny, nz, d, _, _, _, _ = local_plane(k, i, tracks, views)
        last = optics.ratio.shape[0] - 1
        for layer in range(last):
            cosine = rx * nx + ry * ny + rz * nz
            reach = (d if layer == 0 else optics.walls[layer - 1]) / cosine
            # Negative: the ray leaves the interface behind, or cannot pass.
            reach = reach if reach >= 0.0 else math.nan
            ox, oy, oz = ox + reach * rx, oy + reach * ry, oz + reach * rz
            mu = optics.ratio[layer] / optics.ratio[layer + 1]
            bend = math.sqrt(1.0 - (1.0 - cosine * cosine) / (mu * mu)) - cosine / mu
            rx, ry, rz = rx / mu + bend * nx, ry / mu + bend * ny, rz / mu + bend * nz
    ox, oy, oz = ox - views.translation[i, 0], oy - views.translation[i, 1], oz - views.translation[i, 2]
    for j in range(3):
        turn = views.rotation
        origin[j] = turn[i, 0, j] * ox + turn[i, 1, j] * oy + turn[i, 2, j] * oz
        ray[j] = turn[i, 0, j] * rx + turn[i, 1, j] * ry + turn[i, 2, j] * rz


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def eliminate_length(
    ray, by_point, by_blocks, place_of_slot, widths, v, point_gradient, coupling, column, width, num_blocks, shift,
    matrix, gradient,
):  # fmt: skip
    """Take a point on a ray out of the system that its other observations make.

    Args:
        ray: (3,) unit direction of the ray, world.
        by_point: (2, 3) `A`, by_blocks: (5, 2, width) `B` of the observation that the ray belongs to.
        place_of_slot: (5,) where its slots stand among the blocks, -1 where held.
        widths: (5,) of the slots.
        v, point_gradient: the point's matrix (xx, xy, xz, yy, yz, zz) and gradient from its other observations.
        coupling: (blocks, 3, width) of the point with all blocks, from its other observations; overwritten.
        column, width: (blocks,) of the blocks; num_blocks: how many there are.
        shift: (5, 3, width) scratch.
        matrix, gradient: of the camera side, changed in place; the blocks on and above the diagonal.

    Returns:
        What the length gains by one more Newton step; to be subtracted from the cost.
    """
    a0, a1, a2 = ray[0], ray[1], ray[2]
    va0, va1, va2 = (
        v[0] * a0 + v[1] * a1 + v[2] * a2,
        v[1] * a0 + v[3] * a1 + v[4] * a2,
        v[2] * a0 + v[4] * a1 + v[5] * a2,
    )
    root = math.sqrt(a0 * va0 + a1 * va1 + a2 * va2 + _GUARD * (v[0] + v[3] + v[5]) + 1e-300)
    y = (a0 * point_gradient[0] + a1 * point_gradient[1] + a2 * point_gradient[2]) / root
    p = by_point
    p00 = p[0, 0] * p[0, 0] + p[0, 1] * p[0, 1] + p[0, 2] * p[0, 2]
    p01 = p[0, 0] * p[1, 0] + p[0, 1] * p[1, 1] + p[0, 2] * p[1, 2]
    p11 = p[1, 0] * p[1, 0] + p[1, 1] * p[1, 1] + p[1, 2] * p[1, 2]
    determinant = p00 * p11 - p01 * p01
    # The point's shift with the ray's own blocks moves the other observations' errors.
    for slot in range(5):
        at = place_of_slot[slot]
        if at < 0:
            continue
        for j in range(widths[slot]):
            e0, e1 = by_blocks[slot, 0, j], by_blocks[slot, 1, j]
            f0, f1 = (p11 * e0 - p01 * e1) / determinant, (p00 * e1 - p01 * e0) / determinant
            s0 = -(f0 * p[0, 0] + f1 * p[1, 0])
            s1 = -(f0 * p[0, 1] + f1 * p[1, 1])
            s2 = -(f0 * p[0, 2] + f1 * p[1, 2])
            shift[slot, 0, j], shift[slot, 1, j], shift[slot, 2, j] = s0, s1, s2
            gradient[column[at] + j] += s0 * point_gradient[0] + s1 * point_gradient[1] + s2 * point_gradient[2]
            # Half of the shift's own share: the blocks' pairs take it from both sides.
            coupling[at, 0, j] += 0.5 * (v[0] * s0 + v[1] * s1 + v[2] * s2)
            coupling[at, 1, j] += 0.5 * (v[1] * s0 + v[3] * s1 + v[4] * s2)
            coupling[at, 2, j] += 0.5 * (v[2] * s0 + v[4] * s1 + v[5] * s2)
    for slot in range(5):
        own = place_of_slot[slot]
        if own < 0:
            continue
        for b in range(num_blocks):
            before = column[b] <= column[own]
            after = column[b] >= column[own]
            for i in range(widths[slot]):
                s0, s1, s2 = shift[slot, 0, i], shift[slot, 1, i], shift[slot, 2, i]
                for j in range(width[b]):
                    change = s0 * coupling[b, 0, j] + s1 * coupling[b, 1, j] + s2 * coupling[b, 2, j]
                    if after:
                        matrix[column[own] + i, column[b] + j] += change
                    if before:
                        matrix[column[b] + j, column[own] + i] += change
    # The length itself: one row is left of the three, kept where the first was.
    for b in range(num_blocks):
        for j in range(width[b]):
            coupling[b, 0, j] = (a0 * coupling[b, 0, j] + a1 * coupling[b, 1, j] + a2 * coupling[b, 2, j]) / root
    for slot in range(5):
        at = place_of_slot[slot]
        if at < 0:
            continue
        for j in range(widths[slot]):
            half = va0 * shift[slot, 0, j] + va1 * shift[slot, 1, j] + va2 * shift[slot, 2, j]
            coupling[at, 0, j] += 0.5 * half / root
    for b in range(num_blocks):
        for i in range(width[b]):
            f = coupling[b, 0, i]
            gradient[column[b] + i] -= f * y
            for c in range(num_blocks):
                if column[c] >= column[b]:
                    for j in range(width[c]):
                        matrix[column[b] + i, column[c] + j] -= f * coupling[c, 0, j]
    return 0.5 * y * y
