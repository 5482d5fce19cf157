"""The camera and the poses of a board that fit its corners best: COLMAP's bundle adjustment with the corners held.

COLMAP's camera models are those that the result is used with, and its solver knows their derivatives, so that one path
serves them all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap

from colmap_refract.calibration.boards import View
from colmap_refract.files.quiet import quiet_pycolmap
from colmap_refract.interface import Array, tangent_basis

Pose = tuple[Array, Array]
"""`x_cam = R x_board + t`: R (3, 3), and t (3,) in squares."""

_LOSS_SCALE = 1.0  # px; only for starts and for finding views that are wrong, the last adjustment is plain


@dataclass(frozen=True, kw_only=True)
class Adjustment:
    """A camera, and the board before it in some views.

    Attributes:
        camera: its parameters at the minimum.
        poses: `cam_from_board` by index into the views.
        covariance: (P, P) of the camera's parameters for corners of unit noise; None if they are not determined.
    """

    camera: pycolmap.Camera
    poses: Mapping[int, Pose]
    covariance: Array | None


def find_pose(camera: pycolmap.Camera, corners: Array, view: View) -> Pose | None:
    """The pose of a board in one view for a given camera, good enough to start from.

    Args:
        camera: of the view.
        corners: (N, 3) of the board, squares.
        view: of at least four corners that are not on a line.

    Returns:
        `cam_from_board`, None if the corners show none.
    """
    rays = cam_ray_from_img(camera, view.xy)
    seen = np.isfinite(rays).all(axis=1)
    # Turned so that the board is in the middle: then wide views need no other treatment than narrow ones.
    middle = rays[seen].sum(axis=0)
    if seen.sum() < 4 or not np.linalg.norm(middle) > 0:
        return None
    middle /= np.linalg.norm(middle)
    turn = np.column_stack([tangent_basis(middle), middle]).T
    turned = rays @ turn.T
    seen &= turned[:, 2] > 0.05  # within 87 degrees of the middle
    if seen.sum() < 4:
        return None
    try:
        found, rotation, translation = cv2.solvePnP(
            corners[view.corner_idxs][seen], turned[seen, :2] / turned[seen, 2:], np.eye(3), np.zeros(4),
            flags=cv2.SOLVEPNP_IPPE,
        )  # fmt: skip
    except cv2.error:
        return None
    turned_from_board = np.asarray(cv2.Rodrigues(rotation)[0], np.float64), np.asarray(translation, np.float64).ravel()
    pose = turn.T @ turned_from_board[0], turn.T @ turned_from_board[1]
    return pose if found and np.isfinite(pose[0]).all() and np.isfinite(pose[1]).all() else None


def adjust(
    camera: pycolmap.Camera, corners: Array, views: Sequence[View], poses: Mapping[int, Pose], *, robust: bool
) -> Adjustment | None:
    """Adjust all parameters of a camera and the poses of the board.

    Args:
        camera: to start from, which stays as it is.
        corners: (N, 3) of the board, squares.
        views: of which those with a pose are used.
        poses: to start from, by index into `views`; at least one.
        robust: whether large errors count less, or as least squares have it.

    Returns:
        The minimum, None if the solver failed.
    """
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(_copy(camera))
    config = pycolmap.BundleAdjustmentConfig()
    point3D_ids = [model.add_point3D(corner, pycolmap.Track()) for corner in corners]
    for v, (rotation, translation) in poses.items():
        image = pycolmap.Image(image_id=v + 1, camera_id=1, name=str(v), keypoints=views[v].xy)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation))
        config.add_image(v + 1)
        for point2D_idx, corner_idx in enumerate(views[v].corner_idxs):
            model.add_observation(point3D_ids[corner_idx], pycolmap.TrackElement(v + 1, point2D_idx))
    # COLMAP takes no point with a single observation. An image that is not adjusted gives each corner one more, which
    # has no part in the solve.
    extra = max(poses) + 2
    image = pycolmap.Image(image_id=extra, camera_id=1, name="extra", keypoints=np.zeros((len(corners), 2)))
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for point2D_idx, point3D_id in enumerate(point3D_ids):
        model.add_observation(point3D_id, pycolmap.TrackElement(extra, point2D_idx))

    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, refine_points3D=False, print_summary=False)
    options.ceres.solver_options.function_tolerance = 1e-12
    options.ceres.solver_options.gradient_tolerance = 1e-10
    if robust:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
        options.ceres.loss_function_scale = _LOSS_SCALE
    covariance = None
    with quiet_pycolmap():  # starts may well fail
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
        usable = adjuster.solve().is_solution_usable() and bool(np.isfinite(model.camera(1).params).all())
        if usable and not robust:
            estimate = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(damping=0.0), model, adjuster)
            covariance = None if estimate is None else estimate.get_other_params_cov(model.camera(1).params)
    if not usable:
        return None
    # Rounding makes one that is not positive of a system that is singular.
    if covariance is not None and not (np.isfinite(covariance).all() and (np.diag(covariance) > 0).all()):
        covariance = None
    adjusted = {}
    for v in poses:
        cam_from_board = model.image(v + 1).cam_from_world()
        adjusted[v] = cam_from_board.rotation.matrix(), np.array(cam_from_board.translation)
    return Adjustment(camera=_copy(model.camera(1)), poses=adjusted, covariance=covariance)


def residuals(camera: pycolmap.Camera, corners: Array, view: View, pose: Pose | None) -> Array:
    """Seen minus projected corners, (C, 2), px; NaN where the camera does not see a corner, or there is no pose."""
    if pose is None:
        return np.full(view.xy.shape, np.nan)
    rotation, translation = pose
    return view.xy - img_from_cam(camera, corners[view.corner_idxs] @ rotation.T + translation)


def img_from_cam(camera: pycolmap.Camera, points: Array) -> Array:
    """Pixels (K, 2) of points (K, 3) in the camera's frame; NaN where the camera does not see them."""
    return np.asarray(camera.img_from_cam(points), np.float64)


def cam_ray_from_img(camera: pycolmap.Camera, xy: Array) -> Array:
    """Unit directions (K, 3) in the camera's frame that are seen at pixels (K, 2); NaN where there is none."""
    return np.asarray(camera.cam_ray_from_img(xy), np.float64)


def _copy(camera: pycolmap.Camera) -> pycolmap.Camera:
    """A camera that does not share its parameters with another object of pycolmap."""
    return pycolmap.Camera(
        camera_id=1, model=camera.model, width=camera.width, height=camera.height, params=np.array(camera.params)
    )
