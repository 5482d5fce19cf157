"""Which image is the reference, and which are matched with it."""

from __future__ import annotations

import numpy as np

from colmap_refract.dense.known_images import KnownImages
from colmap_refract.dense.options import DenseOptions
from colmap_refract.errors import RefractError
from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array
from colmap_refract.optical_flow.frame import MIN_TRACKS

_WIDEST_DEG = 40.0  # between rays of two images that still look alike
_GOOD_DEG = 5.0  # more does not make a neighbour better


def lines_of_sight(images: KnownImages) -> Array:
    """Unit directions (N, 3), world, in which the sparse observations' rays arrive at their points."""
    sparse = images.sparse
    origin = np.full((len(sparse.image), 3), np.nan)
    for image in range(len(images.names)):
        mine = np.flatnonzero(sparse.image == image)
        if len(mine):
            rays = images.rays(image, sparse.pixel[mine])
            wet = images.is_wet(image, rays, sparse.points[sparse.point[mine]])
            origin[mine] = np.where(wet[:, None], rays.origin, images.center(image))
    lines = sparse.points[sparse.point] - origin
    return np.asarray(lines / np.linalg.norm(lines, axis=1, keepdims=True))


def choose_reference(images: KnownImages, chosen: list[int]) -> int | None:
    """The image that sees most sparse points which the `chosen` ones do not; None where there is none such."""
    sparse = images.sparse
    known = np.zeros(len(sparse.points), dtype=np.bool_)
    known[sparse.point[np.isin(sparse.image, chosen)]] = True
    counts = np.bincount(sparse.image[~known[sparse.point]], minlength=len(images.names))
    counts[chosen] = 0
    best = int(counts.argmax())
    return best if counts[best] >= MIN_TRACKS else None


def choose_neighbours(images: KnownImages, reference: int, lines: Array, options: DenseOptions) -> Index:
    """Images to be matched with a reference, the best first: many common points, at angles neither small nor large.

    What is a small angle depends on the capture: of a camera that stands still, waves open a degree or two.

    Args:
        images, reference: by index.
        lines: of `lines_of_sight`.
        options: with the number of images.

    Raises:
        RefractError: too few share points with the reference.
    """
    sparse = images.sparse
    toward = np.full((len(sparse.points), 3), np.nan)
    mine = sparse.image == reference
    toward[sparse.point[mine]] = lines[mine]
    chord = np.linalg.norm(lines - toward[sparse.point], axis=1)
    angle = np.degrees(2 * np.arcsin(np.minimum(0.5 * chord, 1.0)))
    shared = np.isfinite(angle) & ~mine & (angle <= _WIDEST_DEG)
    if shared.any():
        good = max(min(_GOOD_DEG, float(np.median(angle[shared]))), 1e-9)
        score = np.bincount(
            sparse.image[shared], weights=np.minimum(angle[shared] / good, 1.0), minlength=len(images.names)
        )
        counts = np.bincount(sparse.image[shared], minlength=len(images.names))
        order = np.argsort(-score, kind="stable")
        usable = order[counts[order] >= MIN_TRACKS][: options.max_num_images]
    else:
        usable = np.zeros(0, dtype=np.int64)
    if len(usable) < options.min_num_views - 1:
        raise RefractError(
            f"{len(usable)} images share {MIN_TRACKS} points or more with the reference '{images.names[reference]}', "
            f"too few for min_num_views {options.min_num_views}; give another reference_image, or fewer views"
        )
    return np.asarray(usable)
