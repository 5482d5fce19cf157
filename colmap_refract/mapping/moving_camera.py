"""Start values for a camera that moved: the clouds of pairs that share the reference image, averaged, and what grows
from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.scenario import Index
from colmap_refract.machine import threads
from colmap_refract.mapping.clouds import Cloud, average_clouds, pair_cloud
from colmap_refract.mapping.dry_adjustment import Mask, settle
from colmap_refract.mapping.model_from_database import Posed
from colmap_refract.mapping.pairs import rank_pairs
from colmap_refract.mapping.registration import begin, register_images, tie_rigs, without_rigs
from colmap_refract.refiner.observations import Observations

_MOST_CLOUDS = 12
"""Of one image, that are averaged."""
_FIRST_TRIES = 10
"""Pairs that a first cloud is sought in where the reference image has none."""
_MIN_INLIER_RATIO = 0.4
_MIN_ANGLE_DEG = 1.0
"""Median angle of a cloud's rays: with less, depths are noise."""


def start_moving_camera(
    observations: Observations,
    common: Index,
    group: Index,
    anchor: int,
    *,
    random_seed: int,
    num_threads: int,
    watch: Callable[[int, int], None] | None = None,
) -> tuple[Posed, list[Cloud]]:
    """Every image by PnP on the averaged cloud of the reference image, and on what grows from it.

    Args:
        observations: of all images; their poses do not count.
        common: as `pairs.common_points` counts them.
        group: indices of the images to register.
        anchor: index of the reference image.
        random_seed: of the samples.
        num_threads: of the adjustments; -1: as many as there are cores.
        watch: called with the number of images registered and wanted.

    Returns:
        The start, seen from the reference image, and the clouds that it began with.

    Raises:
        RefractError: no pair has a geometry, or no image can be placed beside the first.
    """
    num_threads = threads(num_threads)
    single = without_rigs(observations)
    first, clouds = _first_clouds(single, common, group, anchor, random_seed)
    registered = begin(single, first, average_clouds(clouds, len(single.points)))
    registered = register_images(
        single, registered, group, random_seed=random_seed, num_threads=num_threads, watch=watch
    )
    if registered.posed.sum() < 2:
        raise RefractError(
            "no image could be placed beside the first pair: too few right matches, or intrinsics far off (camera_path)"
        )
    if len(observations.frame_ids) < len(observations.image_ids):
        registered = settle(observations, tie_rigs(observations, registered), num_threads=num_threads)
    posed = replace(
        observations,
        rig_from_world_rotation=registered.rotation,
        rig_from_world_translation=registered.translation,
        points=registered.points,
    )
    has_size = bool(np.abs(observations.sensor_translation).max() > 0)
    at = anchor if registered.posed[observations.image_frame[anchor]] else first
    seen = _seen_from(posed, at, registered.inlier, has_size)
    return Posed(observations=seen, posed=registered.posed, keep=registered.inlier), clouds


def _first_clouds(
    observations: Observations, common: Index, group: Index, anchor: int, random_seed: int
) -> tuple[int, list[Cloud]]:
    """Clouds that share their first image: the reference, or another where it has none."""
    first_images = [anchor]
    first_images += [pair.first for pair in rank_pairs(observations, common, group)[:_FIRST_TRIES]]
    for first in dict.fromkeys(first_images):
        clouds = []
        for pair in rank_pairs(observations, common, group, anchor=first)[:_MOST_CLOUDS]:
            cloud = pair_cloud(observations, pair, random_seed)
            if (
                cloud is not None
                and cloud.inlier_ratio >= _MIN_INLIER_RATIO
                and np.degrees(np.median(cloud.angle)) >= _MIN_ANGLE_DEG
            ):
                clouds.append(cloud)
        if clouds:
            return first, clouds
    raise RefractError(
        "no pair of images shows the scene from two sides: too few right matches, a camera that only turned, or one "
        "that stood still (scenario fixed_camera)"
    )


def _seen_from(observations: Observations, image: int, keep: Mask, has_size: bool) -> Observations:
    """The observations in the frame of an image, with the median depth of its points as the unit."""
    rotation, translation = observations.cam_from_world
    turn, shift = rotation[image], translation[image]
    points = observations.points @ turn.T + shift
    mine = keep & (observations.image == image)
    depth = points[observations.point[mine], 2]
    unit = 1.0 if has_size or not len(depth) else float(np.median(depth))
    frames = observations.rig_from_world_rotation @ turn.T
    moved = observations.rig_from_world_translation - frames @ shift
    return replace(
        observations,
        rig_from_world_rotation=frames,
        rig_from_world_translation=moved / unit,
        points=points / unit,
    )
