"""A problem cut into chunks of tracks, each with the reduced system that the eliminated points leave.

A chunk needs its observations and the images that it touches, nothing else, and returns a small matrix: it is the
unit of parallel work, and one residual block of the solver's (module `adjustment`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator import elimination
from colmap_refract.estimator.elimination import (
    LENS,
    MEDIUM,
    NUM_SLOTS,
    PLANE,
    POSE,
    WAVES,
    Anchors,
    Optics,
    Tracks,
    Views,
)
from colmap_refract.estimator.optics import Media
from colmap_refract.estimator.robust import LOSSES
from colmap_refract.estimator.scenario import Change, State, Structure, evaluate_views
from colmap_refract.interface import Array, Layers
from colmap_refract.options import Loss

MAX_CHUNK_COLUMNS = 700
"""Up to this many unknowns all tracks form one chunk; beyond, Ceres' product of the Jacobian with itself,
cubic in a chunk's unknowns, is worth splitting for."""

_WORTH = 0.9
"""Part of a chunk's unknowns that a half of it may still touch for the split to be made."""


@dataclass(frozen=True, kw_only=True)
class Held:
    """What an adjustment leaves as it is.

    Attributes:
        poses: (F,) pose blocks.
        normals, distances: (B,) of the plane blocks.
        points, index, lens, waves: all of them.
    """

    poses: NDArray[np.bool_]
    normals: NDArray[np.bool_]
    distances: NDArray[np.bool_]
    points: bool = False
    index: bool = True
    lens: bool = True
    waves: bool = False

    @staticmethod
    def nothing(state: State) -> Held:
        planes = len(state.normal)
        return Held(
            poses=np.zeros(len(state.rotation), bool),
            normals=np.zeros(planes, bool),
            distances=np.zeros(planes, bool),
        )


@dataclass(frozen=True, kw_only=True)
class LevelPrior:
    """The planes of a moving interface scatter about one plane of the world.

    The common plane is unknown itself, and stands wherever the others draw it. A plane's height is compared where
    its own camera stands, so that a tilt far from the origin is no height.

    Attributes:
        tilt: standard deviation of the slope in each of two directions, radians.
        lift: standard deviation of the height, over the distance of the cameras from the common plane.
        noise: of a keypoint coordinate, px: what a deviation of one standard deviation is worth.
    """

    tilt: float
    lift: float
    noise: float

    @property
    def weights(self) -> Array:
        """(4,) px per radian and per relative height, of the residuals that `compare_to_level` gives."""
        return self.noise / np.array([self.tilt, self.tilt, self.tilt, self.lift])


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A refractive bundle adjustment: data, tying, start and robust loss, in units of the solve."""

    tracks: Tracks
    structure: Structure
    layers: Layers
    state: State
    points: Array
    held: Held
    loss: Loss = "trivial"
    loss_scale: float = 1.0
    pinned_pose: int | None = None
    """Pose block whose distance from the origin stays, so that the size does, which a wall's thickness would
    otherwise tell, and badly."""
    wave_prior: Array | None = None
    """(I, M, K) in px: half the squared length of `wave_prior[i] @ waves[i]` is added to the cost."""
    level_prior: LevelPrior | None = None
    on_rays: bool = False
    """Each point lies on the refracted ray of its first observation, exactly, which has no residual of its own: a
    reference image's (see `reference_rays`). Not for known points."""

    @property
    def num_waves(self) -> int:
        """Wave coefficients per image; 0 where all surfaces are flat."""
        return int(self.state.waves.shape[1])

    @property
    def views(self) -> Views:
        """The images at the state, for compiled code, with nothing free."""
        columns = np.full((self.structure.num_images, NUM_SLOTS), -1, dtype=np.int32)
        return evaluate_views(self.structure, self.state, Change.zero(self.state), columns)

    @property
    def optics(self) -> Optics:
        """The media at the state's index, for compiled code."""
        return media_at(self.layers, self.state.index)


def media_at(layers: Layers, index: float) -> Optics:
    media = Media(layers.with_index(index))
    return Optics(media.ratio, media.ratio_by_index, media.walls)


def slot_width(slot: int, state: State) -> int:
    return (6, 3, 1, state.lens.shape[1], state.waves.shape[1], 3)[slot]


def image_blocks(problem: Problem, image: int) -> list[tuple[int, int]]:
    """The free blocks that an image depends on, as (slot, block)."""
    held, structure = problem.held, problem.structure
    blocks = []
    pose, plane = int(structure.image_pose[image]), int(structure.image_plane[image])
    if not held.poses[pose]:
        blocks.append((POSE, pose))
    if plane >= 0 and not (held.normals[plane] and held.distances[plane]):
        blocks.append((PLANE, plane))
    if plane >= 0 and not held.index:
        blocks.append((MEDIUM, 0))
    if not held.lens:
        blocks.append((LENS, int(structure.image_camera[image])))
    if plane >= 0 and problem.state.waves.shape[1] and not held.waves:
        blocks.append((WAVES, image))
    return blocks


def _local(indices: NDArray[np.int64], used: NDArray[np.int64]) -> NDArray[np.int64]:
    """Positions of `indices` in the sorted array `used`; -1 stays -1."""
    return np.where(indices < 0, -1, np.searchsorted(used, np.maximum(indices, 0)))


def change_of(state: State, values: Iterable[tuple[tuple[int, int], Array]]) -> Change:
    """The change of a state's blocks that parameter values, each with its (slot, block), stand for."""
    change = Change.zero(state)
    index = 0.0
    for (slot, block), value in values:
        if slot == POSE:
            change.pose[block] = value
        elif slot == PLANE:
            change.plane[block] = value
        elif slot == MEDIUM:
            index = float(value[0])
        elif slot == LENS:
            change.lens[block] = value
        elif slot == WAVES:
            change.waves[block] = value
    return replace(change, index=index)


class Chunk:
    """A range of tracks with just the images that see them, and the reduced system they give."""

    def __init__(self, problem: Problem, point_indices: NDArray[np.int64], num_slices: int) -> None:
        tracks, structure = problem.tracks, problem.structure
        lengths = np.diff(tracks.start)[point_indices]
        start = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        take = np.arange(start[-1]) + np.repeat(tracks.start[point_indices] - start[:-1], lengths)
        images = np.unique(tracks.image[take]).astype(np.int64)
        self.point_indices = point_indices
        mine = tracks.take(start, take)
        self.tracks = mine._replace(image=_local(mine.image.astype(np.int64), images).astype(np.int32))
        poses = np.unique(structure.image_pose[images])
        planes = np.unique(structure.image_plane[images])
        planes = planes[planes >= 0]
        cameras = np.unique(structure.image_camera[images])
        self.structure = Structure(
            image_pose=_local(structure.image_pose[images], poses),
            image_plane=_local(structure.image_plane[images], planes),
            image_camera=_local(structure.image_camera[images], cameras),
            sensor_rotation=structure.sensor_rotation[images],
            sensor_translation=structure.sensor_translation[images],
            plane_in_world=structure.plane_in_world[planes],
            plane_anchor=structure.plane_anchor[planes],
            wave_axes=structure.wave_axes[images] if len(structure.wave_axes) else structure.wave_axes,
        )
        state = problem.state
        self.state = State(
            rotation=state.rotation[poses],
            translation=state.translation[poses],
            normal=state.normal[planes],
            distance=state.distance[planes],
            index=state.index,
            lens=state.lens[cameras],
            waves=state.waves[images] if problem.num_waves else state.waves,
        )
        self.keys: list[tuple[int, int]] = sorted({key for i in images for key in image_blocks(problem, int(i))})
        self.widths = [slot_width(slot, state) for slot, _ in self.keys]
        self.first_column = dict(zip(self.keys, np.concatenate([[0], np.cumsum(self.widths)]).tolist(), strict=False))
        self.num_columns = int(sum(self.widths))
        self.columns = np.full((len(images), NUM_SLOTS), -1, dtype=np.int32)
        for row, image in enumerate(images):
            for key in image_blocks(problem, int(image)):
                self.columns[row, key[0]] = self.first_column[key]
        self._place = {POSE: poses, PLANE: planes, MEDIUM: np.zeros(1, np.int64), LENS: cameras, WAVES: images}
        self._problem = problem
        self._loss = (LOSSES[problem.loss], problem.loss_scale)
        self.points = np.ascontiguousarray(problem.points[point_indices])
        self.anchors = Anchors(weight=np.zeros(len(point_indices)), position=self.points.copy())
        # Slices of about equally many observations, for threads within the chunk.
        bounds = np.searchsorted(start, np.linspace(0, start[-1], num_slices + 1)[1:-1])
        edges = np.concatenate([[0], bounds, [len(point_indices)]]).astype(int)
        self.slices = [(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True) if b > a]
        # Where the points were last settled: Ceres linearises where it has just tried.
        self._trial: tuple[Array, Array, float] | None = None

    def views(self, parameters: Sequence[Array]) -> tuple[elimination.Views, Optics] | None:
        """The images at Ceres' parameter values; None where a plane would lie behind its camera."""
        places = ((slot, int(np.searchsorted(self._place[slot], block))) for slot, block in self.keys)
        change = change_of(self.state, zip(places, parameters, strict=True))
        if not all(np.isfinite(a).all() for a in (change.pose, change.plane, change.lens, change.waves)):
            return None
        views = evaluate_views(self.structure, self.state, change, self.columns)
        if not (views.distance > 0.0).all() or self.state.index + change.index <= 0.0:
            return None
        return views, media_at(self._problem.layers, self.state.index + change.index)

    def _run(self, pool: ThreadPoolExecutor | None, job: Callable[[int, int, int], Any]) -> list[Any]:
        if pool is None or len(self.slices) == 1:
            return [job(n, a, b) for n, (a, b) in enumerate(self.slices)]
        futures = [pool.submit(job, n, a, b) for n, (a, b) in enumerate(self.slices)]
        return [future.result() for future in futures]

    def settle(self, parameters: Sequence[Array], pool: ThreadPoolExecutor | None) -> tuple[Array, float] | None:
        """Points at their minima for the given parameters, and the cost there."""
        at = np.concatenate([np.zeros(0), *parameters])
        if self._trial is not None and np.array_equal(self._trial[0], at):
            return self._trial[1], self._trial[2]
        state = self.views(parameters)
        if state is None:
            return None
        views, optics = state
        points = self.points.copy()
        if self._problem.held.points:
            out = np.empty((len(self.tracks.image), 2))
            elimination.residuals(points, self.tracks, views, optics, out)
            cost = 0.5 * float(robust_cost((out**2).sum(axis=1), self._problem.loss, self._problem.loss_scale).sum())
        else:
            cost = sum(
                self._run(
                    pool,
                    lambda _, a, b: elimination.settle(
                        points, self.anchors, a, b, self.tracks, views, optics, *self._loss, self._problem.on_rays
                    ),
                )
            )
        if not np.isfinite(cost):
            return None
        self._trial = (at, points, cost)
        return points, cost

    def reduce(self, parameters: Sequence[Array], pool: ThreadPoolExecutor | None) -> tuple[float, Array, Array] | None:
        """Cost, gradient (n,) and Gauss-Newton matrix (n, n; upper triangle) at the given parameters."""
        settled = self.settle(parameters, pool)
        state = self.views(parameters)
        if settled is None or state is None:
            return None
        views, optics = state
        self.points = settled[0]
        n = self.num_columns
        matrices = [np.zeros((n, n)) for _ in self.slices]
        gradients = [np.zeros(n) for _ in self.slices]
        costs = self._run(
            pool,
            lambda k, a, b: elimination.reduce(
                self.points, self._problem.held.points, self.anchors, a, b, self.tracks, views, optics,
                *self._loss, matrices[k], gradients[k], np.zeros((0, 0)), self._problem.on_rays,
            ),
        )  # fmt: skip
        for matrix, gradient in zip(matrices[1:], gradients[1:], strict=True):
            matrices[0] += matrix
            gradients[0] += gradient
        return sum(costs), gradients[0], matrices[0]


def robust_cost(squared: Array, loss: Loss, scale: float) -> Array:
    """`rho` of squared residuals in px^2, as Ceres defines the losses."""
    b = scale * scale
    if loss == "huber":
        return np.where(squared <= b, squared, 2.0 * scale * np.sqrt(squared) - b)
    if loss == "soft_l1":
        return 2.0 * b * (np.sqrt(1.0 + squared / b) - 1.0)
    if loss == "cauchy":
        return np.asarray(b * np.log1p(squared / b))
    return squared


def _touched(tracks: Tracks, lengths: NDArray[np.int64], part: NDArray[np.int64]) -> NDArray[np.int32]:
    """The images that see some of the points `part`."""
    rows = np.repeat(tracks.start[part], lengths[part])
    offsets = np.arange(len(rows)) - np.repeat(np.cumsum(lengths[part]) - lengths[part], lengths[part])
    return np.unique(tracks.image[rows + offsets])


def split(problem: Problem, num_threads: int) -> list[Chunk]:
    """Cut the tracks into chunks that touch few images each.

    Points are halved along the widest axis of where their observers stand until a chunk's images have at
    most `MAX_CHUNK_COLUMNS` unknowns (or it has few points left).
    """
    tracks, structure = problem.tracks, problem.structure
    num_points = len(tracks.start) - 1
    rotation, translation = problem.state.cam_from_world(structure)
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    lengths = np.diff(tracks.start)
    observer = np.add.reduceat(centers[tracks.image], tracks.start[:-1], axis=0) / lengths[:, None]
    own = np.array([sum(slot_width(s, problem.state) for s, _ in image_blocks(problem, i) if s != MEDIUM)
                    for i in range(structure.num_images)])  # fmt: skip
    parts: list[NDArray[np.int64]] = []
    pending = [np.arange(num_points)]
    total = sum(slot_width(s, problem.state) for s, _ in {k for i in range(structure.num_images)
                                                           for k in image_blocks(problem, i)})  # fmt: skip
    while pending:
        part = pending.pop()
        if total > MAX_CHUNK_COLUMNS and len(part) > 200:
            touched = _touched(tracks, lengths, part)
            spread = np.ptp(observer[part], axis=0)
            if own[touched].sum() > MAX_CHUNK_COLUMNS / 2 and spread.max() > 0:
                order = np.argsort(observer[part, int(spread.argmax())], kind="stable")
                halves = [part[order[: len(part) // 2]], part[order[len(part) // 2 :]]]
                # Where every image sees everything, halves would touch as many unknowns as the whole.
                if min(own[_touched(tracks, lengths, half)].sum() for half in halves) < _WORTH * own[touched].sum():
                    pending += halves
                    continue
        parts.append(np.sort(part))
    num_slices = num_threads if len(parts) < num_threads else 1
    return [Chunk(problem, part, num_slices) for part in parts]
