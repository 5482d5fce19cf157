"""Tracks: the keypoints that matches join into points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_refract.mapping.database import Correspondences, Index


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """N keypoints of P points, sorted by point.

    Attributes:
        start: (P + 1,) first row of each point.
        image: (N,) index of the image.
        point2D_idx: (N,) of the keypoint in its image.
    """

    start: Index
    image: Index
    point2D_idx: Index

    @property
    def point(self) -> Index:
        """(N,) index of the point of each keypoint."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))


def build_tracks(correspondences: Correspondences) -> Tracks:
    """Keypoints that matches join, directly or through others, as far as no image is in a track twice.

    What holds two keypoints of one image has a wrong match in it somewhere, and one can chain all points of a
    scene together. There, matches are taken one by one, first those that most other keypoints bear out (by being
    matched with both), and one that would bring two keypoints of an image into a track is not.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first = correspondences.first_keypoint
    total = int(first[-1])
    ends = [
        np.column_stack([first[i] + pair[:, 0], first[j] + pair[:, 1]])
        for (i, j), pair in zip(correspondences.pairs, correspondences.matches, strict=True)
    ]
    edges = np.concatenate([*ends, np.zeros((0, 2), dtype=np.int64)])
    ones = np.ones(len(edges), dtype=np.int8)
    _, label = connected_components(coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(total, total)), False)
    image = np.repeat(np.arange(len(correspondences.keypoints)), np.diff(first))
    _, place, count = np.unique(label * len(first) + image, return_inverse=True, return_counts=True)
    contradictory = np.zeros(total, dtype=np.bool_)
    contradictory[label[count[place] > 1]] = True
    members = np.flatnonzero(contradictory[label])
    doubted = edges[contradictory[label[edges[:, 0]]]]
    label = label.astype(np.int64)
    label[members] = total + _join_cautiously(doubted, members, image[members])
    length = np.bincount(label, minlength=total)
    rows = np.flatnonzero(length[label] >= 2)
    rows = rows[np.argsort(label[rows], kind="stable")]
    _, lengths = np.unique(label[rows], return_counts=True)
    return Tracks(
        start=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        image=image[rows],
        point2D_idx=rows - first[image[rows]],
    )


def _join_cautiously(edges: Index, members: Index, image: Index) -> Index:
    """Label (M,) of M keypoints, each the position of one of its track, so that no image is in a track twice.

    Args:
        edges: (E, 2) matches between members.
        members: (M,) keypoints counted through, ascending; image: (M,) of each.
    """
    from scipy.sparse import csr_array

    count = len(members)
    a, b = np.searchsorted(members, edges).T
    adjacent = csr_array((np.ones(2 * len(a)), (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(count, count))
    borne_out = (adjacent @ adjacent).multiply(adjacent).tocsr()
    support = np.asarray(borne_out[a, b]).ravel() if len(a) else np.zeros(0)
    root = list(range(count))
    images = [{i} for i in image.tolist()]

    def find(k: int) -> int:
        while root[k] != k:
            root[k] = root[root[k]]
            k = root[k]
        return k

    order = np.argsort(-support, kind="stable")
    for i, j in zip(a[order].tolist(), b[order].tolist(), strict=True):
        i, j = find(i), find(j)
        if i != j and images[i].isdisjoint(images[j]):
            i, j = (i, j) if len(images[i]) >= len(images[j]) else (j, i)
            root[j] = i
            images[i] |= images[j]
    return np.array([find(k) for k in range(count)], dtype=np.int64)
