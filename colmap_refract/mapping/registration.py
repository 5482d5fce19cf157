"""Incremental registration of a camera that moved: a first cloud, then poses by PnP and points by turns.

Refraction is ignored, so residuals are larger and the model is bent; what is asked of it is to be a start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array
from colmap_refract.mapping.dry_adjustment import Registered, settle
from colmap_refract.refiner.observations import Observations

_MIN_INLIERS = 12
_MIN_INLIER_RATIO = 0.3
_MAX_ERRORS = (12.0, 36.0)
"""Pixels, tried in turn, of a pose's inliers: a bent model is off by several pixels where it grows."""
_ALONGSIDE = 0.7
"""Images that see this part of the points that the best placed one sees are registered in the same round."""
_MORE = 1.2
"""Times the points it saw before, for an image that could not be registered to be tried again."""


def without_rigs(observations: Observations) -> Observations:
    """The same observations with a frame for each image."""
    count = len(observations.image_ids)
    return replace(
        observations,
        image_frame=np.arange(count),
        frame_ids=observations.image_ids,
        rig_from_world_rotation=np.tile(np.eye(3), (count, 1, 1)),
        rig_from_world_translation=np.zeros((count, 3)),
        sensor_rotation=np.tile(np.eye(3), (count, 1, 1)),
        sensor_translation=np.zeros((count, 3)),
    )


def begin(observations: Observations, first: int, away: Array) -> Registered:
    """The first image at the origin, and points along its rays.

    Args:
        observations: without rigs.
        first: index of the image.
        away: (P,) distances from it; NaN where unknown.
    """
    count = len(observations.image_ids)
    posed = np.zeros(count, dtype=np.bool_)
    posed[first] = True
    mine = observations.image == first
    points = np.zeros((len(observations.points), 3))
    point = observations.point[mine]
    points[point] = observations.direction[mine] * np.nan_to_num(away[point])[:, None]
    known = np.zeros(len(points), dtype=np.bool_)
    known[point] = np.isfinite(away[point])
    return Registered(
        posed=posed,
        rotation=np.tile(np.eye(3), (count, 1, 1)),
        translation=np.zeros((count, 3)),
        points=points,
        known=known,
        inlier=mine & known[observations.point],
    )


def register_images(
    observations: Observations,
    registered: Registered,
    images: Index,
    *,
    random_seed: int,
    num_threads: int = 1,
    watch: Callable[[int, int], None] | None = None,
) -> Registered:
    """Register images one round after the other, those that see most known points first, until none can be added.

    Args:
        observations: without rigs; their poses do not count.
        registered: what is known so far.
        images: indices of the images to register.
        random_seed: of the samples that poses are sought with.
        num_threads: of the adjustments.
        watch: called with the number of images registered and wanted.
    """
    tried = np.zeros(len(observations.image_ids))
    while True:
        known = registered.known[observations.point]
        sees = np.bincount(observations.image[known], minlength=len(tried))
        open_ = images[~registered.posed[images]]
        open_ = open_[(sees[open_] >= _MIN_INLIERS) & (sees[open_] >= _MORE * tried[open_])]
        if not len(open_):
            return registered
        best = open_[sees[open_] >= _ALONGSIDE * sees[open_].max()]
        rotation, translation, posed = (
            registered.rotation.copy(),
            registered.translation.copy(),
            registered.posed.copy(),
        )
        for i in best.tolist():
            tried[i] = sees[i]
            pose = _find_pose(observations, registered, i, random_seed)
            if pose is not None:
                rotation[i], translation[i] = pose
                posed[i] = True
        if (posed != registered.posed).any():
            registered = replace(registered, rotation=rotation, translation=translation, posed=posed)
            registered = settle(observations, registered, num_threads=num_threads)
        if watch is not None:
            watch(int(registered.posed[images].sum()), len(images))


def _find_pose(
    observations: Observations, registered: Registered, image: int, random_seed: int
) -> tuple[Array, Array] | None:
    import pycolmap

    rows = np.flatnonzero((observations.image == image) & registered.known[observations.point])
    points = registered.points[observations.point[rows]]
    camera = observations.cameras[observations.image_camera[image]]
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed = random_seed
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    for max_error in _MAX_ERRORS:
        options.ransac.max_error = max_error
        found = pycolmap.estimate_and_refine_absolute_pose(
            observations.pixel[rows], points, camera, options, refinement
        )
        if found is not None and found["num_inliers"] >= max(_MIN_INLIERS, _MIN_INLIER_RATIO * len(rows)):
            pose = found["cam_from_world"]
            return pose.rotation.matrix(), np.asarray(pose.translation)
    return None


def tie_rigs(observations: Observations, registered: Registered) -> Registered:
    """Frames in place of images registered one by one: the baselines of the rigs give the size.

    A frame has its pose from the image of it that sees most. Images that were not registered themselves come
    along with their frame.

    Args:
        observations: with rigs.
        registered: images, as `register_images` leaves them.
    """
    frames, count = observations.image_frame, len(observations.frame_ids)
    centers = -np.einsum("nji,nj->ni", registered.rotation, registered.translation)
    on_rig = -np.einsum("nji,nj->ni", observations.sensor_rotation, observations.sensor_translation)
    ratios = [
        np.linalg.norm(on_rig[i] - on_rig[j]) / max(float(np.linalg.norm(centers[i] - centers[j])), 1e-12)
        for i, j in zip(*np.nonzero(np.triu(frames[:, None] == frames, 1)), strict=True)
        if registered.posed[i] and registered.posed[j]
    ]
    scale = float(np.median(ratios)) if ratios and np.median(ratios) > 0 else 1.0
    sees = np.where(registered.posed, np.bincount(observations.image[registered.inlier], minlength=len(frames)), -1)
    posed = np.zeros(count, dtype=np.bool_)
    rotation, translation = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    for frame in np.unique(frames[registered.posed]).tolist():
        members = np.flatnonzero(frames == frame)
        i = int(members[sees[members].argmax()])
        turn = observations.sensor_rotation[i].T
        posed[frame] = True
        rotation[frame] = turn @ registered.rotation[i]
        translation[frame] = turn @ (scale * registered.translation[i] - observations.sensor_translation[i])
    return replace(
        registered, posed=posed, rotation=rotation, translation=translation, points=scale * registered.points
    )
