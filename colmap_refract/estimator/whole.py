"""A problem as one system in all camera-side parameters, for wide blocks: waves give each image some forty of them.

Ceres multiplies a chunk's Jacobian by itself, cubic in the unknowns that the chunk touches, and stores it; with waves
that is most of the time and more memory than there is. Here the tracks are not copied, and what they leave goes
straight into a banded matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee
from threadpoolctl import threadpool_limits

from colmap_refract.estimator import elimination
from colmap_refract.estimator.assembly import add_groups
from colmap_refract.estimator.banded import Banded
from colmap_refract.estimator.chunk import Problem, change_of, image_blocks, media_at, robust_cost, slot_width
from colmap_refract.estimator.elimination import LEVEL, NUM_SLOTS, PLANE, POSE, Anchors, Views
from colmap_refract.estimator.priors import all_to_level, first_images, mean_plane, prior_blocks
from colmap_refract.estimator.robust import LOSSES
from colmap_refract.estimator.scenario import Change, evaluate_views
from colmap_refract.interface import Array

_GROUP = 32
"""Points that are reduced together: the fewer, the fewer images they touch; the more, the less is copied."""
_SHARED = 16
"""Images; a block that more of them share is in the border."""
_MOST_COPIES = 60_000_000
"""Entries of the matrices of all threads together."""

Key = tuple[int, int]


class Whole:
    """The cost, gradient and Gauss-Newton matrix of a problem without chunks.

    Attributes:
        keys: (slot, block) of the free parameter blocks, in the order of their columns.
        columns: where each begins; widths.
        num_columns: of all, of which the last `num_shared` are in the border.
        held_columns: those of blocks that are only partly free.
    """

    def __init__(self, problem: Problem, num_threads: int = 1) -> None:
        tracks, structure, state = problem.tracks, problem.structure, problem.state
        self.problem = problem
        self._loss = (LOSSES[problem.loss], problem.loss_scale)
        # All planes are compared with the level at once: one by one they take as long as the points.
        self.priors = prior_blocks(replace(problem, level_prior=None))
        self._level = mean_plane(structure, state) if problem.level_prior is not None else None
        self._level_images = first_images(structure)
        self._seen = np.unique(tracks.image)
        lengths = np.diff(tracks.start)
        order = _beside_each_other(problem)
        blocks_of = {int(image): image_blocks(problem, int(image)) for image in order}
        shared_by: dict[Key, int] = {}
        for blocks in blocks_of.values():
            for key in blocks:
                shared_by[key] = shared_by.get(key, 0) + 1
        own = [key for image in order for key in blocks_of[int(image)] if shared_by[key] <= _SHARED]
        border = sorted(key for key, count in shared_by.items() if count > _SHARED)
        self.keys = list(dict.fromkeys(own)) + border
        num_own = len(self.keys) - len(border)
        # What only priors look at, such as the level plane, is everybody's.
        looked_at = {key for prior in self.priors for key in prior.keys}
        looked_at |= {key for keys in self._level_keys() for key in keys}
        self.keys += sorted(looked_at - set(self.keys))
        self.widths = {key: slot_width(key[0], state) for key in self.keys}
        firsts = np.concatenate([[0], np.cumsum([self.widths[key] for key in self.keys])]).astype(np.int64)
        self.columns = dict(zip(self.keys, firsts[:-1].tolist(), strict=True))
        self.num_columns = int(firsts[-1])
        num_banded = int(firsts[num_own])
        self.num_shared = self.num_columns - num_banded
        self._columns = np.full((structure.num_images, NUM_SLOTS), -1, dtype=np.int32)
        for seen, blocks in blocks_of.items():
            for key in blocks:
                self._columns[seen, key[0]] = self.columns[key]
        self._reach = self._find_reach(blocks_of, lengths, num_banded)
        self.held_columns = self._find_held()
        self._members, self._bounds = _groups(problem, lengths)
        self.points = np.ascontiguousarray(problem.points)
        self._anchors = Anchors(weight=np.zeros(len(lengths)), position=problem.points)
        size = num_banded * (self._reach + 1)
        self._num_slices = max(1, min(num_threads, _MOST_COPIES // max(size, 1), len(self._bounds) - 1))
        self._ranges = np.linspace(0, len(lengths), max(1, num_threads) + 1).astype(int)

    def _find_reach(self, blocks_of: dict[int, list[Key]], lengths: NDArray[np.int64], num_banded: int) -> int:
        """Columns between the first and the last of those that share a point, at most."""
        first = np.full(self.problem.structure.num_images, self.num_columns)
        last = np.zeros(self.problem.structure.num_images, dtype=np.int64)
        for seen, blocks in blocks_of.items():
            banded = [key for key in blocks if self.columns[key] < num_banded]
            if banded:
                first[seen] = min(self.columns[key] for key in banded)
                last[seen] = max(self.columns[key] + self.widths[key] for key in banded) - 1
        image, start = self.problem.tracks.image, self.problem.tracks.start[:-1]
        reach = np.maximum.reduceat(last[image], start) - np.minimum.reduceat(first[image], start)
        if self.problem.held.points:
            reach = last - first
        of_priors = [0]
        for keys in [*(prior.keys for prior in self.priors), *self._level_keys()]:
            at = [self.columns[key] for key in keys if self.columns[key] < num_banded]
            ends = [self.columns[key] + self.widths[key] - 1 for key in keys if self.columns[key] < num_banded]
            of_priors += [max(ends) - min(at)] if at else []
        return int(min(max(int(reach.max(initial=0)), *of_priors, 0), max(num_banded - 1, 0)))

    def _level_keys(self) -> list[list[Key]]:
        """The blocks that the comparison of each free plane with the level looks at."""
        held, structure = self.problem.held, self.problem.structure
        if self._level is None:
            return []
        free = ~(held.normals & held.distances)
        keys = []
        for block, image in enumerate(self._level_images.tolist()):
            pose = int(structure.image_pose[image])
            own: list[Key] = [] if held.poses[pose] else [(POSE, pose)]
            keys.append([*own, (PLANE, block), (LEVEL, 0)] if free[block] else [])
        return keys

    def _of_level(self, x: Array) -> list[tuple[list[Key], Array, list[Array]]]:
        """`(blocks, residual, derivative by each)` of every free plane."""
        problem = self.problem
        if self._level is None or problem.level_prior is None:
            return []
        change, weights = self.change(x), problem.level_prior.weights
        pose = change.pose[problem.structure.image_pose[self._level_images]]
        deviation, *by = all_to_level(
            problem.structure, problem.state, self._level_images, pose, change.plane, self._level,
            x[self.columns[LEVEL, 0] : self.columns[LEVEL, 0] + 3],
        )  # fmt: skip
        by = [weights[:, None] * part for part in by]
        found = []
        for block, keys in enumerate(self._level_keys()):
            if keys:
                found.append((keys, weights * deviation[block], [part[block] for part in by[-len(keys) :]]))
        return found

    def _find_held(self) -> NDArray[np.int64]:
        held, columns = self.problem.held, []
        for (slot, block), first in self.columns.items():
            if slot == PLANE:
                columns += [first, first + 1] if held.normals[block] else []
                columns += [first + 2] if held.distances[block] else []
        return np.array(columns, dtype=np.int64)

    def change(self, x: Array) -> Change:
        """The change of the state that values of all columns stand for."""
        return change_of(
            self.problem.state,
            [(key, x[self.columns[key] : self.columns[key] + self.widths[key]]) for key in self.keys],
        )

    def _views(self, x: Array) -> tuple[Views, elimination.Optics] | None:
        change = self.change(x)
        problem = self.problem
        views = evaluate_views(problem.structure, problem.state, change, self._columns)
        index = problem.state.index + change.index
        if not (np.isfinite(x).all() and (views.distance[self._seen] > 0.0).all() and index > 0.0):
            return None
        return views, media_at(problem.layers, index)

    def settle(self, x: Array, start: Array, pool: ThreadPoolExecutor | None) -> tuple[Array, float] | None:
        """Points at their minima, from where they start, and the cost there with that of the priors; None: nowhere."""
        found = self._views(x)
        if found is None:
            return None
        views, optics = found
        points, problem = start.copy(), self.problem
        if problem.held.points:
            out = np.empty((len(problem.tracks.image), 2))
            elimination.residuals(points, problem.tracks, views, optics, out)
            cost = 0.5 * float(robust_cost((out**2).sum(axis=1), problem.loss, problem.loss_scale).sum())
        else:
            cost = sum(
                _run(
                    pool,
                    lambda a, b: elimination.settle(
                        points, self._anchors, a, b, problem.tracks, views, optics, *self._loss, False
                    ),
                    list(zip(self._ranges[:-1].tolist(), self._ranges[1:].tolist(), strict=True)),
                )
            )
        for prior in self.priors:
            cost += 0.5 * float((prior.evaluate(self._of(prior.keys, x))[0] ** 2).sum())
        for _, residual, _ in self._of_level(x):
            cost += 0.5 * float(residual @ residual)
        return (points, cost) if np.isfinite(cost) else None

    def _of(self, keys: list[Key], x: Array) -> list[Array]:
        return [x[self.columns[key] : self.columns[key] + self.widths[key]] for key in keys]

    def reduce(self, x: Array, points: Array, pool: ThreadPoolExecutor | None) -> tuple[Array, Banded] | None:
        """Gradient and Gauss-Newton matrix at settled points, held columns those of the identity."""
        found = self._views(x)
        if found is None:
            return None
        views, optics = found
        problem, n, m = self.problem, self.num_columns - self.num_shared, self.num_shared
        edges = np.linspace(0, len(self._bounds) - 1, self._num_slices + 1).astype(int)

        def job(a: int, b: int) -> tuple[Array, Banded]:
            gradient = np.zeros(n + m)
            matrix = Banded(band=np.zeros((n, self._reach + 1)), border=np.zeros((n, m)), corner=np.zeros((m, m)))
            add_groups(
                points, problem.held.points, self._anchors, self._members, self._bounds[a : b + 1], problem.tracks,
                views._replace(columns=np.empty_like(self._columns)), optics, *self._loss, self._columns, matrix.band,
                matrix.border, matrix.corner, gradient,
            )  # fmt: skip
            return gradient, matrix

        with threadpool_limits(limits=1, user_api="blas"):
            parts = _run(pool, job, list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)))
        gradient, matrix = parts[0]
        for other_gradient, other in parts[1:]:
            gradient += other_gradient
            matrix.band[...] += other.band
            matrix.border[...] += other.border
            matrix.corner[...] += other.corner
        for prior in self.priors:
            residual, by_blocks = prior.evaluate(self._of(prior.keys, x))
            self._add_prior(matrix, gradient, prior.keys, residual, by_blocks)
        for keys, residual, by_blocks in self._of_level(x):
            self._add_prior(matrix, gradient, keys, residual, by_blocks)
        gradient[self.held_columns] = 0.0
        matrix.hold(self.held_columns)
        return gradient, matrix

    def _add_prior(
        self, matrix: Banded, gradient: Array, keys: list[Key], residual: Array, by_blocks: list[Array]
    ) -> None:
        n = self.num_columns - self.num_shared
        at = np.concatenate([self.columns[key] + np.arange(self.widths[key]) for key in keys])
        jacobian = np.hstack(by_blocks)
        gradient[at] += jacobian.T @ residual
        product = jacobian.T @ jacobian
        i, j = np.meshgrid(at, at, indexing="ij")
        upper = i <= j
        i, j, product = i[upper], j[upper], product[upper]
        own, across, shared = j < n, (i < n) & (j >= n), i >= n
        matrix.band[i[own], (j - i)[own]] += product[own]
        matrix.border[i[across], j[across] - n] += product[across]
        matrix.corner[i[shared] - n, j[shared] - n] += product[shared]


def evaluated(problem: Problem, num_threads: int = 1) -> tuple[Whole, float, Array, Banded] | None:
    """A problem's system, and its cost, gradient and matrix at its state with settled points.

    None where there is nothing free, or a plane lies behind its camera.
    """
    system = Whole(problem, num_threads)
    if not system.keys:
        return None
    pool = ThreadPoolExecutor(num_threads) if num_threads > 1 else None
    try:
        x = np.zeros(system.num_columns)
        settled = system.settle(x, system.points, pool)
        reduced = None if settled is None else system.reduce(x, settled[0], pool)
    finally:
        if pool is not None:
            pool.shutdown()
    if settled is None or reduced is None:
        return None
    return system, settled[1], *reduced


def _run(pool: ThreadPoolExecutor | None, job: Callable[[int, int], Any], ranges: list[tuple[int, int]]) -> list[Any]:
    if pool is None or len(ranges) == 1:
        return [job(a, b) for a, b in ranges]
    return [future.result() for future in [pool.submit(job, a, b) for a, b in ranges]]


def _beside_each_other(problem: Problem) -> NDArray[np.int64]:
    """Images that see points, in an order in which those that share points are near each other."""
    tracks = problem.tracks
    num_points = len(tracks.start) - 1
    point = np.repeat(np.arange(num_points), np.diff(tracks.start))
    sees = sp.csr_array(
        (np.ones(len(point), dtype=np.float32), (point, tracks.image)),
        shape=(num_points, problem.structure.num_images),
    )
    order = np.asarray(reverse_cuthill_mckee(sp.csr_matrix(sees.T @ sees), symmetric_mode=True), dtype=np.int64)
    return order[np.isin(order, tracks.image)]


def _groups(problem: Problem, lengths: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Points by where their observers stand: `(members, bounds)` of groups that few images see."""
    tracks = problem.tracks
    rotation, translation = problem.state.cam_from_world(problem.structure)
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    observer = np.add.reduceat(centers[tracks.image], tracks.start[:-1], axis=0) / lengths[:, None]
    parts: list[NDArray[np.int64]] = []
    pending = [np.arange(len(lengths))]
    while pending:
        part = pending.pop()
        if len(part) <= _GROUP:
            parts.append(part)
            continue
        order = np.argsort(observer[part, int(np.ptp(observer[part], axis=0).argmax())], kind="stable")
        pending += [part[order[len(part) // 2 :]], part[order[: len(part) // 2]]]
    members = np.concatenate([np.zeros(0, np.int64), *parts])
    return members, np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)
