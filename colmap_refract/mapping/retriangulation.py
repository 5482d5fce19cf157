"""Refining a model together with its database: refine, complete the tracks with refracted rays, refine again."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.files.model_io import copy_model
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.mapping.completion import Completed, Limits, complete_tracks
from colmap_refract.mapping.database import Correspondences, Index
from colmap_refract.mapping.known_views import Views
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.refiner.continuation import Watch
from colmap_refract.refiner.observations import Observations, lift, read_observations
from colmap_refract.refiner.refinement import Refinement, refine
from colmap_refract.refiner.start import image_depths

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger(__name__)

_MAX_ROUNDS = 5
_NEGLIGIBLE_GAIN = 2e-3
"""Part of the observations: fewer new ones are not worth another solve."""
_NOISES = 6.0
"""Of a keypoint: how far off a match may be and still be taken up."""
_LEAST_LIMIT = 1.0
_SAME_PIXEL = 0.01
_MIN_TRACK_LENGTH = 3
"""Of new points: as COLMAP's, two rays that meet by chance make none."""


@dataclass(frozen=True, kw_only=True)
class Gain:
    """What a completion gave back: observations that joined points, points that were one, and new points."""

    num_completed: int = 0
    num_merged: int = 0
    num_created: int = 0

    def __add__(self, other: Gain) -> Gain:
        return Gain(
            num_completed=self.num_completed + other.num_completed,
            num_merged=self.num_merged + other.num_merged,
            num_created=self.num_created + other.num_created,
        )


def refine_with_database(
    reconstruction: pycolmap.Reconstruction,
    options: RefinerOptions,
    correspondences: Correspondences,
    *,
    notes: ImageNotes | None = None,
    cameras: Mapping[int, pycolmap.Camera] | None = None,
    watch: Watch | None = None,
) -> Refinement:
    """Refine a model, and get back what refraction cost it of the matches in its database.

    Args:
        reconstruction, options, notes, cameras, watch: as `refine` takes them.
        correspondences: of the model's database, matches that the verification threw away included
            (`read_correspondences(path, verified=False)`).

    Returns:
        As `refine`; the sidecar's statistics tell what came back: `num_completed_observations`,
        `num_merged_points3D`, `num_created_points3D`; and `num_dissolved_points3D`, points that were left with
        too few observations.

    Raises:
        RefractError: as `refine`, or the database is not the model's.
    """
    check_keypoints(reconstruction, correspondences)
    result = refine(reconstruction, options, notes=notes, cameras=cameras, watch=watch)
    rounds, gained = [result.sidecar.statistics], Gain()
    options = replace(options, reference_image=str(result.sidecar.solver["reference_image"]))
    for _ in range(_MAX_ROUNDS):
        model, gain = complete_model(result.reconstruction, result.sidecar, correspondences, options)
        num_observations = result.reconstruction.compute_num_observations()
        added = model.compute_num_observations() - num_observations
        logger.debug("completion: %s, %d observations added", gain, added)
        if added <= _NEGLIGIBLE_GAIN * num_observations and not gain.num_merged:
            break
        again = refine(model, options, notes=notes, earlier=result.sidecar, watch=watch)
        if again.reconstruction.compute_num_observations() <= num_observations and not gain.num_merged:
            break
        result, gained = again, gained + gain
        rounds.append(again.sidecar.statistics)
    result.sidecar.statistics.update(_of_the_whole(rounds, gained))
    return result


_SUMMED = ("num_filtered_large_error", "num_filtered_small_angle", "solve_seconds", "total_seconds")


def _of_the_whole(rounds: list[dict[str, Any]], gained: Gain) -> dict[str, Any]:
    """Statistics from before the first round to after the last."""
    first, last = rounds[0], rounds[-1]
    before = {key: value for key, value in first.items() if key.endswith("_before")}
    summed = {key: sum(statistics[key] for statistics in rounds) for key in _SUMMED}
    gone = before["num_points3D_before"] + gained.num_created - gained.num_merged - last["num_points3D"]
    return {
        **before,
        **summed,
        "num_completed_observations": gained.num_completed,
        "num_merged_points3D": gained.num_merged,
        "num_created_points3D": gained.num_created,
        "num_dissolved_points3D": max(gone - summed["num_filtered_small_angle"], 0),
    }


def check_keypoints(reconstruction: pycolmap.Reconstruction, correspondences: Correspondences) -> None:
    """Raise RefractError unless the keypoints of every registered image are the database's."""
    row = {name: i for i, name in enumerate(correspondences.image_names)}
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.image(image_id)
        if image.name not in row:
            raise RefractError(f"the database does not hold image '{image.name}' of the model: give the model's own")
        known = correspondences.keypoints[row[image.name]]
        if image.num_points2D() != len(known):
            raise RefractError(
                f"image '{image.name}' has {image.num_points2D()} keypoints in the model and {len(known)} in the "
                "database: give the database that the model was made from"
            )
        idxs = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        pixels = np.array([point.xy for point in image.get_observation_points2D()]).reshape(-1, 2)
        if len(idxs) and np.abs(known[idxs] - pixels).max() > _SAME_PIXEL:
            raise RefractError(
                f"the keypoints of image '{image.name}' are others in the database than in the model: give the "
                "database that the model was made from"
            )


def complete_model(
    reconstruction: pycolmap.Reconstruction, earlier: Sidecar, correspondences: Correspondences, options: RefinerOptions
) -> tuple[pycolmap.Reconstruction, Gain]:
    """A refined model with its tracks merged, completed and created from matches, its poses and interfaces held.

    Args:
        reconstruction: refined; not altered.
        earlier: its interfaces.
        correspondences: of its database.
        options: for the limits of what counts as seen.
    """
    model = copy_model(reconstruction)
    observations = read_observations(model)
    keypoints, row_of = _all_keypoints(observations, correspondences)
    unit = float(np.median(image_depths(observations)))
    views = Views(keypoints, earlier, unit, wavy=True)
    label = np.full(len(keypoints.image), -1)
    mine = row_of(observations.image, observations.point2D_idx)
    label[mine[mine >= 0]] = observations.point[mine >= 0]
    limits = Limits(
        max_reproj_error=_limit(options, float(earlier.statistics.get("noise") or 1.0)),
        min_tri_angle=options.min_tri_angle,
        min_track_length=min(_MIN_TRACK_LENGTH, len(observations.image_ids)),
    )
    matches = _edges(observations, correspondences, row_of)
    done = complete_tracks(views, label, observations.points / unit, matches, limits)
    _write_tracks(model, observations, keypoints, label, done, unit)
    gain = Gain(num_completed=done.num_completed, num_merged=done.num_merged, num_created=done.num_created)
    return model, gain


def _limit(options: RefinerOptions, noise: float) -> float:
    limit = max(_NOISES * noise, _LEAST_LIMIT)
    return min(limit, options.filter_max_reproj_error) if options.filter_max_reproj_error > 0 else limit


class _RowOf:
    """The row, among all keypoints that take part, of a keypoint of an image; -1 if it does not."""

    def __init__(self, first: Index, row: Index) -> None:
        self._first, self._row = first, row

    def __call__(self, image: Index, point2D_idx: Index) -> Index:
        return np.asarray(self._row[self._first[image] + point2D_idx])


def _all_keypoints(observations: Observations, correspondences: Correspondences) -> tuple[Observations, _RowOf]:
    """Every keypoint of the registered images as an observation of one pseudo-point, but for those that no ray has."""
    by_name = {name: i for i, name in enumerate(correspondences.image_names)}
    pixels = [correspondences.keypoints[by_name[name]] for name in observations.image_names]
    counts = np.array([len(pixel) for pixel in pixels])
    first = np.concatenate([[0], np.cumsum(counts)])
    total = int(first[-1])
    image = np.repeat(np.arange(len(pixels)), counts)
    keypoints = lift(
        replace(
            observations,
            point3D_ids=np.zeros(1, dtype=np.int64),
            points=np.zeros((1, 3)),
            start=np.array([0, total]),
            image=image,
            point2D_idx=np.arange(total) - first[image],
            pixel=np.concatenate(pixels),
            direction=np.zeros((total, 3)),
            metric=np.zeros((total, 2, 3)),
        )
    )
    row = np.full(total, -1)
    row[first[keypoints.image] + keypoints.point2D_idx] = np.arange(len(keypoints.image))
    return keypoints, _RowOf(first, row)


def _edges(observations: Observations, correspondences: Correspondences, row_of: _RowOf) -> Index:
    """Matches between registered images as pairs of rows."""
    names = {name: i for i, name in enumerate(observations.image_names)}
    image = np.array([names.get(name, -1) for name in correspondences.image_names])
    edges = [np.zeros((0, 2), dtype=np.int64)]
    for (i, j), pair in zip(correspondences.pairs, correspondences.matches, strict=True):
        if image[i] >= 0 and image[j] >= 0:
            edges.append(np.column_stack([row_of(image[i], pair[:, 0]), row_of(image[j], pair[:, 1])]))
    matches = np.concatenate(edges)
    return matches[(matches >= 0).all(axis=1)]


def _write_tracks(
    model: pycolmap.Reconstruction,
    observations: Observations,
    keypoints: Observations,
    before: Index,
    done: Completed,
    unit: float,
) -> None:
    """The changed tracks into the model: ids of points that stay are kept, a merged one's goes to the one it joined."""
    import pycolmap

    image_id = observations.image_ids[keypoints.image].tolist()
    point2D_idx = keypoints.point2D_idx.tolist()
    num_before = len(observations.point3D_ids)
    changed = before != done.label
    touched = np.unique(np.concatenate([before[changed], done.label[changed]]))
    order = np.argsort(done.label, kind="stable")
    first = np.searchsorted(done.label[order], np.arange(len(done.points) + 1))
    # All that change are taken out before any is put back, since keypoints go from one to another.
    colors = {}
    for p in touched[(touched >= 0) & (touched < num_before)].tolist():
        point3D_id = int(observations.point3D_ids[p])
        colors[p] = model.point3D(point3D_id).color.copy()
        model.delete_point3D(point3D_id)
    for p in touched[touched >= 0].tolist():
        rows = order[first[p] : first[p + 1]].tolist()
        if not rows:
            continue
        track = pycolmap.Track([pycolmap.TrackElement(image_id[k], point2D_idx[k]) for k in rows])
        xyz = done.points[p] * unit
        if p < num_before:
            point = pycolmap.Point3D(xyz=xyz, color=colors[p], track=track)
            model.add_point3D_with_id(int(observations.point3D_ids[p]), point)
        else:
            model.add_point3D(xyz, track)
