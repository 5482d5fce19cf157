"""What uncertain parameters of a camera mean in its images: they are correlated, and single ones say little."""

from __future__ import annotations

import numpy as np
import pycolmap

from colmap_refract.calibration.adjustment import cam_ray_from_img, img_from_cam
from colmap_refract.interface import Array

_STEP = 1e-6  # of a parameter, relative to itself or 1; of a rotation, radians


def image_std(camera: pycolmap.Camera, covariance: Array, xy: Array) -> Array:
    """Standard deviation of where the camera sees a given direction.

    A small rotation of the whole camera is no error, for a reconstruction undoes it; the one that does so best is taken
    out.

    Args:
        camera: calibrated.
        covariance: (P, P) of its parameters.
        xy: (K, 2) pixels, spread over the image; the rotation is fitted to all of them.

    Returns:
        (K,) px, along the worse axis; infinite where the distortion cannot be inverted.
    """
    rays = cam_ray_from_img(camera, xy)
    back = img_from_cam(camera, rays)
    # Where the polynomial turns back, the ray of a pixel leads to another one, or there is none.
    known = np.linalg.norm(back - xy, axis=1) < 0.01
    result = np.full(len(xy), np.inf)
    if known.sum() < 3:
        return result
    rays = rays[known]
    by_param = []
    for index, value in enumerate(np.asarray(camera.params)):
        step = _STEP * max(1.0, abs(float(value)))
        ends = [img_from_cam(_changed(camera, index, sign * step), rays) for sign in (1.0, -1.0)]
        by_param.append((ends[0] - ends[1]) / (2 * step))
    by_turn = []
    for axis in np.eye(3):
        ends = [img_from_cam(camera, rays + sign * _STEP * np.cross(axis, rays)) for sign in (1.0, -1.0)]
        by_turn.append((ends[0] - ends[1]) / (2 * _STEP))
    params, turns = (np.stack(by, axis=-1).reshape(2 * len(rays), -1) for by in (by_param, by_turn))
    # Places that are badly known must not turn the others.
    spread = np.sqrt(np.einsum("kp,pq,kq->k", params, covariance, params).reshape(-1, 2).sum(axis=1))
    weights = np.repeat(1.0 / np.maximum(spread, 1e-12), 2)[:, None]
    left = params - turns @ np.linalg.lstsq(weights * turns, weights * params, rcond=None)[0]
    left = left.reshape(len(rays), 2, -1)
    variances = np.einsum("kip,pq,kjq->kij", left, covariance, left)
    result[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(variances)[:, -1], 0.0))
    return result


def _changed(camera: pycolmap.Camera, index: int, step: float) -> pycolmap.Camera:
    params = np.array(camera.params)
    params[index] += step
    return pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=params)
