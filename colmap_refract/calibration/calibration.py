"""Zhang's calibration: a camera and its standard deviations from views of a flat board, without those that do not fit.

Z. Zhang, A Flexible New Technique for Camera Calibration, PAMI 2000. In place of his closed form the adjustment starts
from several focal lengths: that serves fisheyes as well, and costs a moment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal, get_args

import numpy as np
import pycolmap
from scipy.spatial.distance import cdist

from colmap_refract.calibration.adjustment import Adjustment, Pose, adjust, find_pose, residuals
from colmap_refract.calibration.boards import View
from colmap_refract.errors import RefractError
from colmap_refract.interface import Array

CameraModel = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE",
]  # fmt: skip

FEWEST_VIEWS = 3
FEWEST_CORNERS = 6  # of a view, not on a line

_FOCAL_LENGTHS = (0.3, 0.5, 0.8, 1.2, 2.0, 4.0)  # over the longer side of the image, to start from
_FAR = 1e3  # px, the error of a corner that is not seen where it should be
_OUTLYING = 3.0  # times the median error of the views
_FINE = 0.2  # px, an error that no view is dropped for
_VAGUE = 0.05  # relative standard deviation of a focal length that is none
_SAME_DIRECTION = 3.0  # degrees; views of a board that turns less than this are parallel


@dataclass(frozen=True, kw_only=True)
class ViewFit:
    """How a view fits.

    Attributes:
        view: its corners.
        residuals: (C, 2), seen minus projected, px; NaN where nothing is projected. Of a dropped view those that it was
            dropped for.
        pose: `cam_from_board`, squares; None where there is none.
        dropped: why the view is not used; empty if it is.
    """

    view: View
    residuals: Array
    pose: Pose | None
    dropped: str = ""

    @property
    def errors(self) -> Array:
        """(C,) distances between seen and projected corners, px."""
        return np.asarray(np.linalg.norm(self.residuals, axis=1), np.float64)

    @property
    def rms_error(self) -> float:
        """Root of the mean squared distance, px; NaN if a corner is not seen."""
        return float(np.sqrt(np.mean(self.errors**2))) if len(self.residuals) else float("nan")


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A camera and what it was found from.

    Attributes:
        camera: its parameters, COLMAP's pixel origin.
        covariance: (P, P) of the parameters, for independent errors of the corners of `noise`.
        noise: standard deviation of a corner along each axis, px, from the residuals.
        correlation: of the residuals of neighbouring corners. Near 0 if their errors are independent; near 1 the
            deviations are far too small, for a bent board or a wrong model moves neighbours alike.
        views: one per picture with a board, in the order given.
        max_view_error: rms error above which views were dropped, px.
    """

    camera: pycolmap.Camera
    covariance: Array
    noise: float
    correlation: float
    views: tuple[ViewFit, ...]
    max_view_error: float

    @property
    def std(self) -> Array:
        """(P,) standard deviations of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def kept(self) -> list[ViewFit]:
        """The views that the camera was found from."""
        return [view for view in self.views if not view.dropped]

    @property
    def tilt(self) -> float:
        """The largest angle between the board's directions in two kept views, degrees."""
        normals = []
        for rotation, translation in (view.pose for view in self.kept if view.pose is not None):
            # A chessboard may be numbered as if seen from behind.
            normals.append(rotation[:, 2] * np.sign(rotation[:, 2] @ translation))
        cosines = [float(a @ b) for a, b in combinations(normals, 2)]
        return float(np.degrees(np.arccos(np.clip(min(cosines, default=1.0), -1.0, 1.0))))

    @property
    def rms_error(self) -> float:
        """Over all corners of the kept views, px."""
        return float(np.sqrt(np.mean(np.concatenate([view.errors for view in self.kept]) ** 2)))


def calibrate(
    corners: Array,
    views: Sequence[View],
    size: tuple[int, int],
    camera_model: CameraModel,
    max_view_error: float | None = None,
) -> Calibration:
    """Calibrate a camera.

    Args:
        corners: (N, 3) of the board, squares.
        views: of the board, all by one camera.
        size: width and height of the images, px.
        camera_model: COLMAP's name.
        max_view_error: views with a larger rms error, px, are dropped. By default three times the median of the views,
            and no less than 0.2 px.

    Returns:
        The camera, and how each view fits.

    Raises:
        RefractError: too few views show enough of the board or fit, or they do not determine the camera.
    """
    if camera_model not in get_args(CameraModel):
        raise RefractError(f"cannot calibrate '{camera_model}'; give one of {', '.join(get_args(CameraModel))}")
    if max_view_error is not None and not max_view_error > 0:
        raise RefractError(f"max_view_error {max_view_error:g} px is not positive; leave it out for the default")
    dropped = {}
    for v, view in enumerate(views):
        if why := _unusable(corners, view):
            dropped[v] = ViewFit(view=view, residuals=np.full(view.xy.shape, np.nan), pose=None, dropped=why)
    used = [v for v in range(len(views)) if v not in dropped]
    if len(used) < FEWEST_VIEWS:
        raise RefractError(
            f"{len(used)} of {len(views)} views show enough of the board, {FEWEST_VIEWS} are needed and 10 or more "
            "advised; take more pictures of the whole board, tilted to different sides"
        )

    fit = _start(camera_model, size, corners, [views[v] for v in used])
    limit = _FINE
    fitted: dict[int, ViewFit] = {}
    for robust in (True, False):  # large errors count less until the views that have them are gone
        bad = list(used)
        while bad:
            fit = _refit(fit, corners, views, used, robust=robust)
            fitted = {
                v: ViewFit(view=views[v], pose=pose, residuals=residuals(fit.camera, corners, views[v], pose))
                for v in used
                for pose in [fit.poses.get(v)]
            }
            errors = {v: float(np.nan_to_num(view.rms_error, nan=np.inf)) for v, view in fitted.items()}
            limit = max_view_error or max(_FINE, _OUTLYING * float(np.median(list(errors.values()))))
            bad = [v for v in used if not errors[v] <= limit]
            dropped |= {v: replace(fitted[v], dropped=_misfit(fitted[v], limit)) for v in bad}
            used = [v for v in used if v not in bad]
            if len(used) < FEWEST_VIEWS:
                raise RefractError(
                    f"only {len(used)} of {len(views)} views fit to {limit:.3g} px (rms); check the board's numbers of "
                    "squares and that it is flat, use sharp pictures of one camera with fixed focus and zoom, "
                    "or allow more with max_view_error"
                )

    every = {**dropped, **fitted}
    squares = sum(float(np.sum(fitted[v].residuals ** 2)) for v in used)
    freedom = sum(fitted[v].residuals.size for v in used) - len(fit.camera.params) - 6 * len(used)
    noise = float(np.sqrt(squares / max(freedom, 1)))
    unit = fit.covariance
    calibration = Calibration(
        camera=fit.camera,
        covariance=np.full(2 * (len(fit.camera.params),), np.inf) if unit is None else noise**2 * unit,
        noise=noise,
        correlation=_correlation(corners, [fitted[v] for v in used]),
        views=tuple(every[v] for v in range(len(views))),
        max_view_error=limit,
    )
    _check_determined(calibration)
    return calibration


def _unusable(corners: Array, view: View) -> str:
    """Why a view cannot be used at all, empty if it can."""
    count = len(view.corner_idxs)
    if count == 0:
        return "the board was not found"
    if count < FEWEST_CORNERS:
        return f"only {count} corners of the board were found, {FEWEST_CORNERS} are needed"
    places = corners[view.corner_idxs, :2]
    across = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] / np.sqrt(count)
    return "all corners that were found are on one line" if across < 0.1 else ""


def _misfit(fit: ViewFit, limit: float) -> str:
    if not np.isfinite(fit.rms_error):
        return "no pose of the board fits its corners"
    return f"error of {fit.rms_error:.3g} px (rms; largest {fit.errors.max():.3g} px) above {limit:.3g} px"


def _start(camera_model: CameraModel, size: tuple[int, int], corners: Array, views: Sequence[View]) -> Adjustment:
    """The best of what the adjustment makes of several focal lengths, whatever single views say."""
    best, least = None, np.inf
    for ratio in _FOCAL_LENGTHS:
        camera = pycolmap.Camera.create_from_model_name(1, camera_model, ratio * max(size), *size)
        poses = {v: pose for v, view in enumerate(views) if (pose := find_pose(camera, corners, view)) is not None}
        fit = adjust(camera, corners, views, poses, robust=True) if poses else None
        if fit is None:
            continue
        seen = [residuals(fit.camera, corners, view, fit.poses.get(v)) for v, view in enumerate(views)]
        errors = np.nan_to_num(np.linalg.norm(np.concatenate(seen), axis=1), nan=_FAR)
        cost = float(np.sum(np.hypot(1.0, np.minimum(errors, _FAR))))
        if cost < least:
            best, least = fit, cost
    if best is None:
        raise RefractError(
            f"no {camera_model} camera fits the views; check the numbers of squares, or take another camera_model"
        )
    return best


def _refit(fit: Adjustment, corners: Array, views: Sequence[View], used: Sequence[int], *, robust: bool) -> Adjustment:
    """Adjust again, with poses found anew: of a board far away two look alike, and a start may have the wrong one."""
    poses = {v: pose for v in used if (pose := find_pose(fit.camera, corners, views[v])) is not None}
    adjusted = adjust(fit.camera, corners, views, poses, robust=robust) if poses else None
    if adjusted is None:
        raise RefractError("the solver failed; take more pictures of the board, tilted to different sides")
    return adjusted


def _correlation(corners: Array, fits: Sequence[ViewFit]) -> float:
    """Of the residuals of corners that are a square apart, over all views."""
    common, every = 0.0, 0.0
    for fit in fits:
        places = corners[fit.view.corner_idxs]
        near = np.argwhere(np.triu(np.abs(cdist(places, places) - 1) < 0.1))
        first, second = fit.residuals[near[:, 0]], fit.residuals[near[:, 1]]
        common += float(np.sum(first * second))
        every += float(np.sum(first**2 + second**2)) / 2
    return common / every if every > 0 else 0.0


def _check_determined(calibration: Calibration) -> None:
    """Raise if the views leave the camera open."""
    camera = calibration.camera
    if calibration.tilt < _SAME_DIRECTION:
        raise RefractError(
            f"the board has the same direction in all views (within {calibration.tilt:.1f} degrees), which leaves the "
            "focal length open; take pictures with the board tilted by 20 to 40 degrees to different sides"
        )
    focal = np.asarray(camera.params)[list(camera.focal_length_idxs())]
    uncertainty = float(np.max(calibration.std[list(camera.focal_length_idxs())] / np.abs(focal)))
    if not (uncertainty < _VAGUE and (focal > 0).all()):
        raise RefractError(
            "the views do not determine the focal length"
            + (f" (it is uncertain by {100 * uncertainty:.0f} %)" if np.isfinite(uncertainty) else "")
            + "; take more pictures with the board tilted by 20 to 40 degrees to different sides, "
            "or a camera_model with fewer parameters"
        )
