"""Observations that a model is refined without, and how well it predicts them.

Residuals say little between models of different freedom: the freer one always fits better. What neither has seen
tells them apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.estimator.optics import project_direction
from colmap_refract.estimator.wavy_projection import project_through_surface
from colmap_refract.files.model_io import copy_model
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.interface import Array
from colmap_refract.refiner.arrangement import select_tracks
from colmap_refract.refiner.observations import Observations, pixel_errors, read_observations

if TYPE_CHECKING:
    import pycolmap

_LEAST_TRACK = 3
"""Observations of a point from which one is held out: two others still tell where it is."""
_MOST_OF_TRACK = 0.2
"""Part of a point's observations that may be held out, if that is more than one."""
_MOST_OF_IMAGE = 0.2
"""Part of an image's observations that may be held out."""
_LEAST_KEPT = 20
"""Observations that an image keeps, or loses none."""


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """A model without some of its observations.

    Attributes:
        reconstruction: the model that is left; images, keypoints and names are all there.
        observations: the K that were held out, each under a point of its own: ids of points may be there twice.
    """

    reconstruction: pycolmap.Reconstruction
    observations: Observations

    def errors(self, reconstruction: pycolmap.Reconstruction, sidecar: Sidecar) -> Array:
        """How far off a refined model predicts what was held out.

        Args:
            reconstruction, sidecar: a refinement of `self.reconstruction`.

        Returns:
            (K,) px; infinite where the refined model has no such point any more, or cannot see it.
        """
        held = self.observations
        points = np.full((len(held.points), 3), np.nan)
        for k, point3D_id in enumerate(held.point3D_ids.tolist()):
            if reconstruction.exists_point3D(point3D_id):
                points[k] = reconstruction.point3D(point3D_id).xyz
        direction = np.full((len(points), 3), np.nan)
        for i in np.unique(held.image).tolist():
            mine = (held.image == i) & np.isfinite(points).all(axis=1)
            direction[mine] = predict_directions(reconstruction, sidecar, int(held.image_ids[i]), points[mine])
        # The refinement may have had other intrinsics, given or found.
        cameras = [reconstruction.camera(int(camera_id)) for camera_id in held.camera_ids]
        return pixel_errors(replace(held, cameras=cameras), direction)


def hold_out(
    reconstruction: pycolmap.Reconstruction, *, part: float, per_image: int | None = None, seed: int = 0
) -> HeldOut:
    """Choose observations at random and take them out of a copy of the model.

    Of points with three or more, and of each one or a fifth at most; spread over the images, of which none loses
    more than a fifth of what it has, nor any that would be left with fewer than 20.

    Args:
        reconstruction: a COLMAP model; not altered.
        part: of all observations, to be held out where there are as many to choose from.
        per_image: with about as many observations in each image, in a model that has more: the other points
            are left out of the copy altogether. None: all of them.
        seed: of the choice.

    Returns:
        `HeldOut`.

    Raises:
        RefractError: no observation can be spared.
    """
    observations = read_observations(reconstruction)
    if per_image is not None:
        observations = observations.select(select_tracks(observations, per_image, seed))
    chosen = _choose(observations, part, np.random.default_rng(seed))
    if not len(chosen):
        raise RefractError(
            "no observation can be held out: it takes points that three images see, and more than "
            f"{_LEAST_KEPT} of them in an image; name the scenario"
        )
    held = _single(observations, chosen)
    rest = copy_model(reconstruction)
    used = set(observations.point3D_ids.tolist())
    for point3D_id in list(rest.point3D_ids()):
        if point3D_id not in used:
            rest.delete_point3D(point3D_id)
    for i, point2D_idx in zip(held.image.tolist(), held.point2D_idx.tolist(), strict=True):
        rest.delete_observation(int(held.image_ids[i]), point2D_idx)
    return HeldOut(reconstruction=rest, observations=held)


def predict_directions(
    reconstruction: pycolmap.Reconstruction, sidecar: Sidecar, image_id: int, points: Array
) -> Array:
    """In which directions an image of a refined model sees points of the world.

    Args:
        reconstruction, sidecar: a refined model and its interfaces.
        image_id: of a registered image.
        points: (n, 3) in the world.

    Returns:
        (n, 3) unit directions in the camera's frame; a point on the camera's side of the interface, or of an image
        without one, is seen straight. Not a number where a wavy surface shows a point in no single place.
    """
    image = reconstruction.image(image_id)
    pose = image.cam_from_world()
    in_cam = points @ pose.rotation.matrix().T + pose.translation
    interface = sidecar.images[image.name]
    if interface.normal_in_cam is None or interface.distance is None:
        return np.asarray(in_cam / np.linalg.norm(in_cam, axis=1)[:, None])
    normal = np.array(interface.normal_in_cam)
    if interface.surface is not None:
        return project_through_surface(in_cam, normal, interface.distance, sidecar.layers, interface.surface)
    return project_direction(in_cam, normal, interface.distance, sidecar.layers)


def _choose(observations: Observations, part: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of what to hold out, by point."""
    counts = np.bincount(observations.image, minlength=len(observations.image_ids))
    room = np.clip(np.minimum(np.floor(_MOST_OF_IMAGE * counts), counts - _LEAST_KEPT), 0, None).astype(int)
    taken = np.zeros(len(counts), dtype=np.int64)
    target = max(1, round(part * len(observations.image)))
    chosen: set[int] = set()
    lengths = np.diff(observations.start)
    most = np.where(lengths < _LEAST_TRACK, 0, np.maximum(1, np.floor(_MOST_OF_TRACK * lengths))).astype(int)
    # One of every point, then a second of those that have it to spare: few of many points say more than many of few.
    order = rng.permutation(len(lengths))
    for p in [p for turn in range(int(most.max(initial=0))) for p in order[most[order] > turn].tolist()]:
        first, last = observations.start[p], observations.start[p + 1]
        image = observations.image[first:last]
        # The image that has lost the least so far; a choice at random would leave some with hardly any.
        share = np.where(taken[image] < room[image], (taken[image] + rng.random(len(image))) / counts[image], np.inf)
        share[[k for k in range(len(image)) if first + k in chosen]] = np.inf
        k = int(share.argmin())
        if np.isfinite(share[k]):
            chosen.add(int(first) + k)
            taken[image[k]] += 1
        if len(chosen) == target:
            break
    return np.array(sorted(chosen), dtype=np.int64)


def _single(observations: Observations, chosen: NDArray[np.int64]) -> Observations:
    """The observations at `chosen`, and their points, once for each."""
    point = observations.point[chosen]
    return replace(
        observations,
        point3D_ids=observations.point3D_ids[point],
        points=observations.points[point],
        start=np.arange(len(chosen) + 1),
        image=observations.image[chosen],
        point2D_idx=observations.point2D_idx[chosen],
        pixel=observations.pixel[chosen],
        direction=observations.direction[chosen],
        metric=observations.metric[chosen],
        weight=None if observations.weight is None else observations.weight[chosen],
    )
