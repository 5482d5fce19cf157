"""Keypoints of frames that share camera and interface, averaged per track: what differs between them is noise.

The paper averages 1000 frames of a fixed camera in 10 groups, one per inclination of the interface (its brick
experiment). The mean of n keypoints is known to their spread over the root of n, which becomes its weight: a deep
point that turbulence moves a lot has less to say than a shallow one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.estimator.scenario import Index
from colmap_refract.options import RefinerOptions
from colmap_refract.refiner.arrangement import one_pose_for_all, segment_median
from colmap_refract.refiner.observations import Observations, lift

_OUTLIER = 4.0
"""Robust standard deviations from the median of its track beyond which a keypoint is a wrong match."""
_SURELY = 3.0
"""Samples' worth of the typical spread in each spread: three frames alone tell their scatter badly."""
_LEAST_SPREAD = 0.02
"""Pixels: no keypoint is better than that."""


@dataclass(frozen=True, kw_only=True)
class Averaged:
    """Means in place of single keypoints.

    Attributes:
        observations: M means; the image of each is its group's with most observations.
        member_of: (N,) the mean that each single keypoint is a part of, -1 for those that were left out.
    """

    observations: Observations
    member_of: Index

    def members(self, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The single keypoints (N,) behind the means that `keep` (M,) marks."""
        return np.asarray((self.member_of >= 0) & keep[self.member_of])


def average_groups(observations: Observations, options: RefinerOptions, groups: Mapping[str, str]) -> Averaged:
    """One keypoint per track and group: the mean of those near the median of the group.

    Args:
        observations: single keypoints.
        options: for the scenario; only frames of a fixed camera have their pose in common.
        groups: image name to group name; images without a group stay as they are.

    Raises:
        RefractError: no group of two images, or a scenario in which the frames of a group have poses of their own.
    """
    if options.scenario != "fixed_camera":
        raise RefractError(
            f"average_groups with {options.scenario}: only frames of a fixed_camera see their points at the same place"
        )
    image_group = _image_groups(observations, groups)
    if len(np.unique(image_group)) == len(image_group):
        raise RefractError("average_groups: no two images share an interface; list groups in interface_group_path")
    counts = np.bincount(observations.image, minlength=len(image_group))
    # The image with most observations stands for its group.
    by_count = np.argsort(-counts, kind="stable")
    delegate = np.empty(image_group.max() + 1, dtype=np.int64)
    delegate[image_group[by_count[::-1]]] = by_count[::-1]

    key = observations.point * len(delegate) + image_group[observations.image]
    order = np.argsort(key, kind="stable")
    runs, first = np.unique(key[order], return_index=True)
    start = np.concatenate([[0], np.append(first[1:], len(order))]).astype(np.int64)
    pixel = observations.pixel[order]
    run = np.repeat(np.arange(len(runs)), np.diff(start))
    center = np.stack([segment_median(pixel[:, j], start) for j in range(2)], axis=1)
    away = pixel - center[run]
    several = np.diff(start) > 2
    spread = 1.4826 * segment_median(np.abs(away).max(axis=1), start)
    typical = max(float(np.median(spread[several])) if several.any() else 0.0, _LEAST_SPREAD)
    fits = np.abs(away).max(axis=1) <= _OUTLIER * np.maximum(spread, typical)[run]

    number = np.bincount(run, weights=fits, minlength=len(runs))
    mean = np.stack(
        [np.bincount(run, weights=fits * pixel[:, j], minlength=len(runs)) / number for j in range(2)], axis=1
    )
    squares = np.bincount(run, weights=fits * ((pixel - mean[run]) ** 2).mean(axis=1), minlength=len(runs))
    pooled = np.sqrt(squares.sum() / max((number - 1).sum(), 1))
    variance = (squares + _SURELY * pooled**2) / (np.maximum(number - 1, 0) + _SURELY)
    deviation = np.sqrt(np.maximum(variance, _LEAST_SPREAD**2) / number)

    point = runs // len(delegate)
    image = delegate[runs % len(delegate)]
    means = replace(
        observations,
        start=np.searchsorted(point, np.arange(len(observations.points) + 1)),
        image=image,
        point2D_idx=observations.point2D_idx[order[start[:-1]]],
        pixel=mean,
        direction=np.zeros((len(runs), 3)),
        metric=np.zeros((len(runs), 2, 3)),
        weight=float(np.median(deviation)) / deviation,
    )
    member_of = np.full(len(order), -1)
    member_of[order[fits]] = run[fits]
    return _with_parallax(Averaged(observations=means, member_of=member_of))


def _image_groups(observations: Observations, groups: Mapping[str, str]) -> Index:
    """(I,) a number for each image's group, within its rig where rigs have poses; its own where it has no group."""
    rigs = np.zeros_like(observations.image_rig) if one_pose_for_all(observations) else observations.image_rig
    names = [
        (int(rig), groups.get(name, f"image {name}"), name in groups)
        for name, rig in zip(observations.image_names, rigs, strict=True)
    ]
    _, number = np.unique([repr(name) for name in names], return_inverse=True)
    return np.asarray(number, dtype=np.int64)


def _with_parallax(averaged: Averaged) -> Averaged:
    """Without the points that only one group sees, and without means that no ray has."""
    means = averaged.observations
    tagged = replace(means, point2D_idx=np.arange(len(means.image)))
    everything = np.ones(len(means.image), dtype=np.bool_)
    lifted = lift(tagged.select(everything))
    kept = lifted.point2D_idx
    place = np.full(len(means.image) + 1, -1)
    place[kept] = np.arange(len(kept))
    return Averaged(
        observations=replace(lifted, point2D_idx=means.point2D_idx[kept]), member_of=place[averaged.member_of]
    )
