"""Getting back what refraction cost: tracks merged, completed and triangulated anew with refracted rays.

Verification and mapping with straight rays throw away good matches and split tracks, since through moving water
one point has no one place for them. Once the interfaces are known, every match of the database can be judged
by where its refracted rays meet, verified before or not. What is done is COLMAP's merge, complete and
re-triangulate (Schoenberger and Frahm, Structure-from-Motion Revisited, 2016, section 4.4), on whole arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array
from colmap_refract.mapping.known_views import Views

Mask = NDArray[np.bool_]

_ROUNDS = 10
"""Of each step, at most: a round adds what the one before has made reachable."""


@dataclass(frozen=True, kw_only=True)
class Completed:
    """Tracks after completion, over the K keypoints that were given, and what became of the P points before.

    Attributes:
        label: (K,) index of each keypoint's point, -1 for none; the first P are the points before.
        points: (Q, 3) world, Q >= P; a point that was merged into another has no keypoints left.
        merged_into: (P,) the point that each became a part of, itself if of none.
        num_completed: keypoints that joined a point that was there.
        num_merged: points that are now part of another.
        num_created: new points.
    """

    label: Index
    points: Array
    merged_into: Index
    num_completed: int
    num_merged: int
    num_created: int


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What counts as seen: errors below `max_reproj_error` px, rays that part by `min_tri_angle` degrees, and for a
    new point `min_track_length` images."""

    max_reproj_error: float = 4.0
    min_tri_angle: float = 0.5
    min_track_length: int = 3


def complete_tracks(views: Views, label: Index, points: Array, matches: Index, limits: Limits) -> Completed:
    """Merge, complete and create tracks, as far as matches and refracted rays agree.

    Args:
        views: K keypoints with known poses and interfaces.
        label: (K,) index of each keypoint's point, or -1.
        points: (P, 3) world, in the views' unit.
        matches: (E, 2) indices of keypoints that may show the same point; some are wrong.
        limits: what counts as seen.
    """
    num_before = len(points)
    label, points = label.copy(), points.copy()
    merged_into = np.arange(num_before)
    created = completed = 0
    for _ in range(_ROUNDS):
        merged = _merge(views, label, points, matches, limits)
        found = 0
        for _ in range(_ROUNDS):
            step = _complete(views, label, points, matches, limits)
            found += step
            if not step:
                break
        label, points, new = _create(views, label, points, matches, limits)
        merged_into = np.array([_last(merged, p) for p in merged_into.tolist()], dtype=np.int64)
        completed, created = completed + found, created + new
        if not (merged or found or new):
            break
    num_merged = int((merged_into != np.arange(num_before)).sum())
    return Completed(
        label=label,
        points=points,
        merged_into=merged_into,
        num_completed=completed,
        num_merged=num_merged,
        num_created=int(len(np.unique(label[label >= num_before]))),
    )


def _last(merged: dict[int, int], point: int) -> int:
    while point in merged:
        point = merged[point]
    return point


def _complete(views: Views, label: Index, points: Array, matches: Index, limits: Limits) -> int:
    """Give free keypoints to points that a match leads to and that are seen there; `label` is altered.

    A point of two observations counts for little: two rays often meet by chance. It yields them to longer tracks.
    """
    ends = np.concatenate([matches, matches[:, ::-1]])
    ends = ends[label[ends[:, 0]] >= 0]
    length = np.bincount(label[label >= 0], minlength=len(points))
    to, of = label[ends].T
    yields = (of >= 0) & (length[of] == 2) & (length[to] > 2)
    ends = ends[(of < 0) | yields]
    if not len(ends):
        return 0
    num_images = views.structure.num_images
    taken = np.unique(label[label >= 0] * num_images + views.image[label >= 0])
    candidates = np.unique(np.column_stack([label[ends[:, 0]], ends[:, 1]]), axis=0)
    candidates = candidates[~np.isin(candidates[:, 0] * num_images + views.image[candidates[:, 1]], taken)]
    if not len(candidates):
        return 0
    point, keypoint = candidates.T
    problem = views.problem(np.arange(len(candidates) + 1), keypoint, points[point])
    error = views.errors(problem, keypoint)
    seen = error < limits.max_reproj_error
    chosen = _best(error, seen, (point * num_images + views.image[keypoint], keypoint))
    label[keypoint[chosen]] = point[chosen]
    length = np.bincount(label[label >= 0], minlength=len(points))
    label[(label >= 0) & (length[label] < 2)] = -1
    return len(chosen)


def _best(error: Array, allowed: Mask, keys: tuple[Index, ...]) -> Index:
    """Rows, the least error first, such that no two of them share a value in any of the keys."""
    order = np.flatnonzero(allowed)
    order = order[np.argsort(error[order], kind="stable")]
    for key in keys:
        _, first = np.unique(key[order], return_index=True)
        order = order[np.sort(first)]
    return order


def _merge(views: Views, label: Index, points: Array, matches: Index, limits: Limits) -> dict[int, int]:
    """Join points that matches link and that one position explains; `label` and `points` are altered.

    Returns:
        The point that each merged one went into.
    """
    merged: dict[int, int] = {}
    refused = np.zeros(0, dtype=np.int64)
    for _ in range(_ROUNDS):
        pairs = np.sort(label[matches], axis=1)
        pairs = pairs[(pairs[:, 0] >= 0) & (pairs[:, 0] != pairs[:, 1])]
        key, support = np.unique(pairs[:, 0] * len(points) + pairs[:, 1], return_counts=True)
        fresh = ~np.isin(key, refused)
        key, support = key[fresh], support[fresh]
        if not len(key):
            break
        # Each point takes part in one trial a round, in that with most matches behind it.
        first, second = np.divmod(key, len(points))
        trial = _disjoint(first, second, support)
        first, second = first[trial], second[trial]
        members = _members(label, len(points))
        runs = [np.concatenate([members(p), members(q)]) for p, q in zip(first, second, strict=True)]
        start = np.concatenate([[0], np.cumsum([len(run) for run in runs])])
        keypoint = np.concatenate(runs)
        joint, error = views.triangulated(start, keypoint, settle=True)
        agreed = np.maximum.reduceat(error, start[:-1]) < limits.max_reproj_error
        refused = np.concatenate([refused, key[trial][~agreed]])
        for k in np.flatnonzero(agreed).tolist():
            p, q = int(first[k]), int(second[k])
            run, errors = runs[k], error[start[k] : start[k + 1]]
            label[run] = -1
            label[run[_best(errors, np.ones(len(run), np.bool_), (views.image[run],))]] = p
            points[p] = joint[k]
            merged[q] = p
    return merged


def _disjoint(first: Index, second: Index, support: Index) -> Index:
    """Rows, the best supported first, such that no value occurs twice."""
    used: set[int] = set()
    rows = []
    for k in np.argsort(-support, kind="stable").tolist():
        p, q = int(first[k]), int(second[k])
        if p not in used and q not in used:
            used.update((p, q))
            rows.append(k)
    return np.array(rows, dtype=np.int64)


def _members(label: Index, num_points: int) -> _Members:
    order = np.argsort(label, kind="stable")
    return _Members(order, np.searchsorted(label[order], np.arange(num_points + 1)))


class _Members:
    """The keypoints of each point."""

    def __init__(self, order: Index, first: Index) -> None:
        self._order, self._first = order, first

    def __call__(self, point: int) -> Index:
        return self._order[self._first[point] : self._first[point + 1]]


def _create(views: Views, label: Index, points: Array, matches: Index, limits: Limits) -> tuple[Index, Array, int]:
    """New points from free keypoints: those that matches join, each match one whose two rays meet."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    free = matches[(label[matches] < 0).all(axis=1)]
    if not len(free):
        return label, points, 0
    _, error = views.triangulated(np.arange(0, 2 * len(free) + 1, 2), free.ravel(), settle=False)
    free = free[error.reshape(-1, 2).max(axis=1) < limits.max_reproj_error]
    if not len(free):
        return label, points, 0
    count = len(label)
    edges = coo_array((np.ones(len(free), dtype=np.int8), (free[:, 0], free[:, 1])), shape=(count, count))
    _, component = connected_components(edges, directed=False)
    keypoint = np.unique(free)
    # Of two keypoints in one image the one with more matches is believed.
    degree = np.bincount(free.ravel(), minlength=count)[keypoint]
    keypoint = keypoint[_best(-degree, np.ones(len(keypoint), np.bool_), (_pair(component, views.image, keypoint),))]
    keypoint = keypoint[np.argsort(component[keypoint], kind="stable")]
    wrong = np.zeros(len(keypoint), dtype=np.bool_)
    for _ in range(_ROUNDS):
        keypoint, start = _long_runs(component, keypoint[~wrong], limits.min_track_length)
        if not len(keypoint):
            return label, points, 0
        found, error = views.triangulated(start, keypoint, settle=True)
        # The worst keypoint of a track goes first: it may have spoilt the others' errors.
        worst = np.repeat(np.maximum.reduceat(error, start[:-1]), np.diff(start))
        wrong = (error >= limits.max_reproj_error) & (error >= worst)
        if not wrong.any():
            break
    else:
        good = np.maximum.reduceat(error, start[:-1]) < limits.max_reproj_error
        keypoint, start = _long_runs(component, keypoint[np.repeat(good, np.diff(start))], limits.min_track_length)
        found = found[good]
    wide = views.angles(start, keypoint, found) >= limits.min_tri_angle
    new = np.where(wide, len(points) + np.cumsum(wide) - 1, -1)
    label[keypoint] = np.repeat(new, np.diff(start))
    return label, np.concatenate([points, found[wide]]), int(wide.sum())


def _pair(component: Index, image: Index, keypoint: Index) -> Index:
    return np.asarray(component[keypoint].astype(np.int64) * (int(image.max()) + 1) + image[keypoint])


def _long_runs(component: Index, keypoint: Index, least: int) -> tuple[Index, Index]:
    """Keypoints, sorted by component, of those components that have at least so many; and where each begins."""
    _, place, length = np.unique(component[keypoint], return_inverse=True, return_counts=True)
    keypoint = keypoint[length[place] >= least]
    length = length[length >= least]
    return keypoint, np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
