"""A smooth field of displacements through scattered ones, and frames that are pulled straight by it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.interface import Array
from colmap_refract.photographs.images import Gray

_NEIGHBOURS = 12
_SPREAD = 0.6  # scale of the weights, of the distance to the farthest neighbour
_STIFFNESS = 0.002  # of the slopes, where neighbours are on one side only
_ROUNDS = 4
_NOISE = 0.1  # pixels of displacements that need not be explained
_OUTLYING = 3.0  # of the median error, where the weight is a quarter


@dataclass(frozen=True)
class Field:
    """Displacements (H, W, 2) of the reference's pixels to the frame's."""

    displacements: Array

    def at(self, points: Array) -> Array:
        """Bilinear displacements (P, 2) at points (P, 2); beyond the edge those of the edge."""
        from scipy.ndimage import map_coordinates

        values = [map_coordinates(self.displacements[..., k], points.T[::-1], order=1, mode="nearest") for k in (0, 1)]
        return np.column_stack(values)

    def after(self, first: Field) -> Field:
        """The field (H, W, 2) of two steps: `first` from a picture (H, W), and this one from where that leads."""
        height, width = first.displacements.shape[:2]
        y, x = np.mgrid[0:height, 0:width].astype(np.float32)
        x += first.displacements[..., 0]
        y += first.displacements[..., 1]
        on = cv2.remap(self.displacements, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return Field(np.asarray(on + first.displacements))

    def straighten(self, frame: Gray) -> Gray:
        """The frame (H, W) as it would be if the field were zero: like the reference, as far as the field is right."""
        height, width = self.displacements.shape[:2]
        y, x = np.mgrid[0:height, 0:width].astype(np.float32)
        x += self.displacements[..., 0]
        y += self.displacements[..., 1]
        return np.asarray(cv2.remap(frame, x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT_101), np.uint8)


def fit_field(points: Array, displacements: Array, shape: tuple[int, int], *, spacing: float) -> Field:
    """Moving least squares: at each node of a grid the affine field nearest to the neighbours, robustly.

    Args:
        points: (P, 2), at least three.
        displacements: (P, 2), some of them wrong.
        shape: (H, W) of the pictures.
        spacing: of the nodes, pixels; in between, cubic splines.
    """
    sides = [np.arange(float(length)) for length in shape]
    # At the middle of equal parts of the picture.
    places = [
        (np.arange(count) + 0.5) * length / count - 0.5
        for length, count in ((length, max(2, int(np.ceil(length / spacing)))) for length in shape)
    ]
    y, x = np.meshgrid(*places, indexing="ij")
    values = _local_affine(points, displacements, np.column_stack([x.ravel(), y.ravel()]))
    down, across = (_spline(nodes, pixels) for nodes, pixels in zip(places, sides, strict=True))
    channels = [down @ values[:, k].reshape(y.shape).astype(np.float32) @ across.T for k in range(2)]
    return Field(np.stack(channels, axis=-1))


def _spline(nodes: Array, places: Array) -> NDArray[np.float32]:
    """The matrix (places, nodes) that takes values at nodes to those of their cubic spline.

    OpenCV's cubic interpolation does not keep a ramp straight: with nodes twelve pixels apart, a camera that has
    turned by a quarter would see places half a pixel off.
    """
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(nodes, np.eye(len(nodes)), bc_type="natural")(places), dtype=np.float32)


def _local_affine(points: Array, displacements: Array, nodes: Array) -> Array:
    from scipy.spatial import KDTree

    count = min(_NEIGHBOURS, len(points))
    distance, nearest = KDTree(points).query(nodes, k=np.arange(1, count + 1))
    scale = np.maximum(_SPREAD * distance[:, -1:], 1.0)
    closeness = np.exp(-((distance / scale) ** 2))
    offsets = (points[nearest] - nodes[:, None]) / scale[..., None]
    design = np.concatenate([np.ones((*distance.shape, 1)), offsets], axis=-1)
    given = displacements[nearest]
    prior = np.diag([1e-12, _STIFFNESS, _STIFFNESS])
    # A median does not follow outliers, and tells them apart well enough to begin with.
    errors = np.linalg.norm(given - np.median(given, axis=1, keepdims=True), axis=-1)
    for _ in range(_ROUNDS):
        typical = np.maximum(np.median(errors, axis=1, keepdims=True), _NOISE)
        weights = closeness / (1 + (errors / (_OUTLYING * typical)) ** 2) ** 2
        weighted = np.swapaxes(design * weights[..., None], 1, 2)
        solution = np.linalg.solve(weighted @ design + prior, weighted @ given)
        errors = np.linalg.norm(given - design @ solution, axis=-1)
    return np.asarray(solution[:, 0])
