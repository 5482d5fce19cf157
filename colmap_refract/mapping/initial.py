"""Start values the paper's way, from the matches of a database alone, where COLMAP's mapper finds no usable model.

Pairs of images give essential matrices and clouds of points, refraction ignored; the clouds are averaged at one
scale; poses follow by PnP (the paper's "Initial value estimation"). The result is an ordinary COLMAP model, to be
refined.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError, listed
from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array
from colmap_refract.mapping.database import Correspondences, read_correspondences
from colmap_refract.mapping.fixed_camera import start_fixed_camera
from colmap_refract.mapping.model_from_database import observations_of_tracks, put_into_model, read_unposed_model
from colmap_refract.mapping.moving_camera import start_moving_camera
from colmap_refract.mapping.pairs import MIN_COMMON, choose_reference, common_points, connected_groups
from colmap_refract.mapping.tracks import Tracks, build_tracks
from colmap_refract.options import Scenario

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class PairUsed:
    """A pair of images whose cloud took part: their names, points that agree, and the median angle of their rays."""

    first: str
    second: str
    num_points: int
    angle_deg: float


@dataclass(frozen=True, kw_only=True)
class InitialModel:
    """What `initial_model` returns.

    Attributes:
        reconstruction: an ordinary COLMAP model, refraction ignored. The reference image is at the origin and
            the median depth of its points is one, unless a rig with a baseline gives the size.
        reference_image: name of the image that the clouds were averaged in.
        pairs: whose clouds were averaged, the most informative first.
        unregistered: names of the images without a pose.
        reliability: with a fixed camera, the part of the relief's variance that is not noise; 0 if the
            depths are one constant because the clouds agreed no better than by chance. Otherwise None.
        warnings: what the user should know, one sentence each.
    """

    reconstruction: pycolmap.Reconstruction
    reference_image: str
    pairs: tuple[PairUsed, ...]
    unregistered: tuple[str, ...]
    reliability: float | None
    warnings: tuple[str, ...]


def initial_model_from_database(
    path: str | Path,
    *,
    scenario: Scenario,
    cameras: Mapping[int, pycolmap.Camera] | None = None,
    reference: str | None = None,
    random_seed: int = 0,
    num_threads: int = 1,
    watch: Callable[[int, int], None] | None = None,
) -> InitialModel:
    """`initial_model` of a COLMAP database, which is not altered.

    Args:
        path: the database, with verified matches.
        cameras: intrinsics calibrated in air by camera id, in place of the database's.

    Raises:
        RefractError: no such database, intrinsics that do not fit it, or as `initial_model` does.
    """
    correspondences = read_correspondences(path)
    return initial_model(
        correspondences,
        build_tracks(correspondences),
        read_unposed_model(path, correspondences, cameras=cameras),
        scenario=scenario,
        reference=reference,
        random_seed=random_seed,
        num_threads=num_threads,
        watch=watch,
    )


def initial_model(
    correspondences: Correspondences,
    tracks: Tracks,
    unposed: pycolmap.Reconstruction,
    *,
    scenario: Scenario,
    reference: str | None = None,
    random_seed: int = 0,
    num_threads: int = 1,
    watch: Callable[[int, int], None] | None = None,
) -> InitialModel:
    """A model to start refining from, without COLMAP's mapper.

    Args:
        correspondences: keypoints and matches of a database.
        tracks: as `build_tracks` joins them.
        unposed: the database's cameras, rigs, frames and images, as `read_unposed_model` reads them; not altered.
        scenario: with `fixed_camera` all images get one pose.
        reference: name of the image that clouds are averaged in; by default the one that shares most with others.
        random_seed: of all samples.
        num_threads: of the adjustments; -1: as many as there are cores.
        watch: called with the number of images that are registered and that could be.

    Raises:
        RefractError: too few images or matches, an unknown reference, or no pair with a geometry.
        KeyboardInterrupt: Ctrl-C.
    """
    if len(correspondences.image_ids) < 2:
        raise RefractError("there is one image only; depth shows between images: two or more are needed")
    if not len(correspondences.pairs):
        raise RefractError("there are no matches between the images: match their features first")
    observations = observations_of_tracks(unposed, correspondences, tracks)
    common = common_points(observations)
    group, *others = connected_groups(common)
    names = np.array(correspondences.image_names)
    if len(group) < 2:
        most = int((common - np.diag(np.diag(common))).max())
        raise RefractError(
            f"no two images have {MIN_COMMON} points in common ({most} at most): match more features, or take images "
            "that overlap more"
        )
    anchor = _reference(names, reference, group, common)
    warnings = _guessed_intrinsics(unposed, correspondences)
    if others:
        apart = [name for other in others for name in sorted(names[other])]
        warnings.append(
            f"{len(apart)} of {len(names)} images share too few points with the others and are left out: "
            f"{listed(apart)}"
        )
    reliability = None
    if scenario == "fixed_camera":
        num_cameras = len(np.unique(correspondences.image_camera))
        if num_cameras > 1:
            warnings.append(
                f"the database has {num_cameras} cameras, each of which would have a pose of its own: if one camera "
                "stood still, extract its features with ImageReader.single_camera"
            )
        start, relief = start_fixed_camera(observations, common, group, anchor, random_seed)
        clouds, reliability = relief.clouds, relief.reliability
        if reliability == 0.0:
            warnings.append(
                "the depths that pairs of images give agree no better than by chance: all points start at one depth"
            )
    else:
        start, clouds = start_moving_camera(
            observations, common, group, anchor, random_seed=random_seed, num_threads=num_threads, watch=watch
        )
    missed = sorted(names[group[~start.posed_images[group]]])
    if missed:
        warnings.append(f"no pose was found for {len(missed)} of {len(names)} images: {listed(missed)}")
    model = put_into_model(unposed, start)
    used = [
        PairUsed(
            first=str(names[cloud.pair.first]),
            second=str(names[cloud.pair.second]),
            num_points=len(cloud.point),
            angle_deg=float(np.degrees(np.median(cloud.angle))),
        )
        for cloud in sorted(clouds, key=lambda cloud: cloud.information, reverse=True)
    ]
    return InitialModel(
        reconstruction=model,
        reference_image=str(names[anchor]),
        pairs=tuple(used),
        unregistered=tuple(sorted(names[~start.posed_images])),
        reliability=reliability,
        warnings=tuple(warnings),
    )


def _reference(names: Array, reference: str | None, group: Index, common: Index) -> int:
    if not reference:
        return choose_reference(common, group)
    if reference not in names:
        raise RefractError(f"there is no image named '{reference}' in the database; its images are like '{names[0]}'")
    index = int(np.flatnonzero(names == reference)[0])
    if index not in group:
        raise RefractError(
            f"the reference image '{reference}' shares too few points with most other images: name another, "
            f"such as '{names[choose_reference(common, group)]}'"
        )
    return index


def _guessed_intrinsics(unposed: pycolmap.Reconstruction, correspondences: Correspondences) -> list[str]:
    used = [int(i) for i in correspondences.camera_ids[np.unique(correspondences.image_camera)]]
    guessed = [i for i in used if not unposed.camera(i).has_prior_focal_length]
    if not guessed:
        return []
    which = f"camera {guessed[0]}" if len(guessed) == 1 else f"{len(guessed)} cameras ({listed(map(str, guessed))})"
    return [
        f"the intrinsics of {which} are a guess, without a prior focal length, and the start is no better than they "
        "are: give those calibrated in air (camera_path)"
    ]
