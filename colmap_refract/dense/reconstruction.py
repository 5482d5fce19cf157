"""The sequence: a reference, its neighbours, matches on its grid, points, what does not belong; and the next one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.dense.choice import choose_neighbours, choose_reference, lines_of_sight
from colmap_refract.dense.grid import Grid
from colmap_refract.dense.known_images import KnownImages, Mask
from colmap_refract.dense.matching import match, predict
from colmap_refract.dense.neighbourhood import near_median, normals
from colmap_refract.dense.options import DenseOptions
from colmap_refract.dense.triangulation import DensePoints, triangulate
from colmap_refract.errors import RefractError
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.interface import Array
from colmap_refract.optical_flow.frame import MIN_TRACKS
from colmap_refract.optical_flow.reference import check_names
from colmap_refract.photographs.images import Gray, shrink

if TYPE_CHECKING:
    import pycolmap

ReadGray = Callable[[str], Gray]
ReadColours = Callable[[str], NDArray[np.uint8]]
Say = Callable[[str], None]

_AT_ONCE = 400_000
"""Matches that are triangulated together: some 100 MB."""
_OPENCV_TO_COLMAP = 0.5


@dataclass(frozen=True, kw_only=True)
class DenseView:
    """What one reference image has given. Counts are of its grid's nodes.

    Attributes:
        name: of the reference image.
        neighbours: names of the images that it was matched with.
        num_nodes: of the grid; num_covered: that had points of earlier references, and were left out.
        num_unmatched: found in too few images; num_large_error: fit too few of those that they were found in;
            num_small_angle, num_far_off: removed for that.
        picture: (H, W, 3) RGB, the reference image, or the copy of it that was matched.
        step, margin: of the grid.
        depth: (rows, columns) along the camera's axis, model units; NaN where there is no point.
        points, normals: (n, 3), world. colours: (n, 3) RGB.
        errors: (n,) median reprojection error of each, px.
        num_views: (n,) images that see it; angles: (n,) largest between its rays, degrees.
    """

    name: str
    neighbours: list[str]
    num_nodes: int
    num_covered: int
    num_unmatched: int
    num_large_error: int
    num_small_angle: int
    num_far_off: int
    picture: NDArray[np.uint8]
    step: int
    margin: int
    depth: Array
    points: Array
    normals: Array
    colours: NDArray[np.uint8]
    errors: Array
    num_views: NDArray[np.int64]
    angles: Array

    @property
    def coverage(self) -> float:
        """Part of the nodes with a point, of this reference or an earlier one."""
        return (len(self.points) + self.num_covered) / self.num_nodes


def reconstruct(
    model: pycolmap.Reconstruction,
    sidecar: Sidecar,
    read_gray: ReadGray,
    read_colours: ReadColours,
    options: DenseOptions,
    *,
    say: Say = lambda text: None,
) -> list[DenseView]:
    """Dense points of a refined model.

    Args:
        model, sidecar: as the refiner wrote them; not altered.
        read_gray, read_colours: (H, W) and (H, W, 3) RGB of an image by its name.
        options: how.
        say: told in a few words what is being done.

    Returns:
        What each reference has given; with several there are fewer than asked for if nothing is left to see.

    Raises:
        RefractError: an unknown reference, too few images that show the same, pictures that are not the model's, no
            point that is left; and what the readers raise.
    """
    images = KnownImages(model, sidecar)
    check_names(images.names, options.reference_image or None)
    lines = lines_of_sight(images)
    chosen: list[int] = []
    views: list[DenseView] = []
    while len(chosen) < options.num_references:
        if options.reference_image and not chosen:
            reference: int | None = images.names.index(options.reference_image)
        else:
            reference = choose_reference(images, chosen)
        if reference is None:
            if not chosen:
                raise RefractError(f"no image of the model sees {MIN_TRACKS} points; refine it from more matches")
            break
        chosen.append(reference)
        neighbours = choose_neighbours(images, reference, lines, options).tolist()
        known = np.concatenate([view.points for view in views]) if views else np.zeros((0, 3))
        view = _from_reference(
            images, reference, neighbours, known, read_gray, read_colours, options, sidecar.scenario, say
        )
        views.append(view)
    if not sum(len(view.points) for view in views):
        view = views[0]
        raise RefractError(
            f"no dense point is left: of {view.num_nodes} nodes of '{view.name}' {view.num_unmatched} were not matched "
            f"in {options.min_num_views} images, {view.num_large_error} have a larger error than max_reproj_error, "
            f"{view.num_small_angle} a smaller angle than min_tri_angle; do the images belong to this model?"
        )
    return views


def _from_reference(
    images: KnownImages,
    reference: int,
    neighbours: list[int],
    known: Array,
    read_gray: ReadGray,
    read_colours: ReadColours,
    options: DenseOptions,
    scenario: str,
    say: Say,
) -> DenseView:
    """The points of one reference that are not among the `known` ones (n, 3)."""

    def read(image: int) -> Gray:
        gray, camera, name = read_gray(images.names[image]), images.camera(image), images.names[image]
        if gray.shape != (camera.height, camera.width):
            raise RefractError(
                f"image '{name}' has {gray.shape[1]} x {gray.shape[0]} pixels, its camera in the model "
                f"{camera.width} x {camera.height}; give the images that the model was made from"
            )
        return shrink(gray, options.max_image_size)

    def ratio(image: int, gray: Gray) -> Array:
        """Pixels of an image per pixel of its copy, (2,): x and y are rounded each by itself."""
        camera = images.camera(image)
        return np.array([camera.width, camera.height]) / gray.shape[::-1]

    name = images.names[reference]
    first = read(reference)
    own_ratio = ratio(reference, first)
    height, width = first.shape
    grid = Grid(width=width, height=height, step=options.step_for(width, height), margin=options.half_window + 1)
    covered = _covered(images, reference, grid, own_ratio, known)
    nodes = grid.nodes
    pixels = np.full((1 + len(neighbours), len(nodes), 2), np.nan, dtype=np.float32)
    pixels[0] = np.where(covered[:, None], np.nan, (nodes + _OPENCV_TO_COLMAP) * own_ratio)
    sparse = images.sparse
    seen = np.unique(sparse.point[sparse.image == reference])
    points = sparse.points[seen]
    places = images.project(reference, points) / own_ratio - _OPENCV_TO_COLMAP
    for m, neighbour in enumerate(neighbours):
        say(f"Matching '{name}': image {m + 1} of {len(neighbours)}")
        frame = read(neighbour)
        its_ratio = ratio(neighbour, frame)
        others = images.project(neighbour, points) / its_ratio - _OPENCV_TO_COLMAP
        predicted = predict(places, others, width, height)
        if predicted is not None:
            found = match(first, frame, grid, predicted, options)
            pixels[1 + m] = np.where(covered[:, None], np.nan, (found + _OPENCV_TO_COLMAP) * its_ratio)
    members = [reference, *neighbours]
    dense = _triangulated(images, members, pixels, options, say)
    del pixels
    few = dense.num_matched < options.min_num_views
    poor = ~few & ~(dense.num_views >= options.min_num_views)
    small = ~few & ~poor & ~(dense.angles >= options.min_angle(scenario))
    kept = ~few & ~poor & ~small
    say(f"Normals of '{name}' ...")
    depth = np.where(kept, images.in_cam(reference, dense.points)[:, 2], np.nan)
    near = near_median(depth.reshape(grid.shape), options.max_depth_error).ravel()
    on_grid = np.where((kept & near)[:, None], dense.points, np.nan)
    # The rays' direction at the points: what is seen faces it.
    rays = images.rays(reference, (nodes + _OPENCV_TO_COLMAP) * own_ratio)
    facing = normals(on_grid.reshape(*grid.shape, 3), np.nan_to_num(rays.ray).reshape(*grid.shape, 3)).reshape(-1, 3)
    good = np.flatnonzero(kept & near & np.isfinite(facing).all(axis=1))
    left = np.full(len(nodes), np.nan)
    left[good] = depth[good]
    picture = shrink(read_colours(name), options.max_image_size)
    column, row = nodes[good].astype(np.int64).T
    return DenseView(
        name=name,
        neighbours=[images.names[n] for n in neighbours],
        num_nodes=len(nodes),
        num_covered=int(covered.sum()),
        num_unmatched=int((few & ~covered).sum()),
        num_large_error=int(poor.sum()),
        num_small_angle=int(small.sum()),
        num_far_off=int(kept.sum()) - len(good),
        picture=picture,
        step=grid.step,
        margin=grid.margin,
        depth=left.reshape(grid.shape),
        points=dense.points[good],
        normals=facing[good],
        colours=picture[row, column],
        errors=dense.errors[good],
        num_views=dense.num_views[good],
        angles=dense.angles[good],
    )


def _triangulated(
    images: KnownImages, members: list[int], pixels: NDArray[np.float32], options: DenseOptions, say: Say
) -> DensePoints:
    """All nodes, a strip of them at a time."""
    count = pixels.shape[1]
    strip = max(1, _AT_ONCE // len(members))
    parts = []
    for first in range(0, count, strip):
        say(f"Triangulating: {first} of {count} nodes")
        some = pixels[:, first : first + strip].astype(np.float64)
        parts.append(triangulate(images, members, some, options.max_reproj_error))
    return DensePoints(
        points=np.concatenate([part.points for part in parts]),
        num_matched=np.concatenate([part.num_matched for part in parts]),
        num_views=np.concatenate([part.num_views for part in parts]),
        errors=np.concatenate([part.errors for part in parts]),
        angles=np.concatenate([part.angles for part in parts]),
    )


def _covered(images: KnownImages, reference: int, grid: Grid, ratio: Array, known: Array) -> Mask:
    """Which nodes have a known point nearer than a step, or lie between such nodes."""
    rows, columns = grid.shape
    result = np.zeros((rows, columns), dtype=np.bool_)
    if not len(known):
        return result.ravel()
    with np.errstate(invalid="ignore"):
        place = (images.project(reference, known) / ratio - _OPENCV_TO_COLMAP - grid.margin) / grid.step
        # What is behind the camera projects as well.
        place[images.in_cam(reference, known)[:, 2] <= 0] = np.nan
        inside = ((place > -0.5) & (place < np.array([columns, rows]) - 0.5)).all(axis=1)
    column, row = np.rint(place[inside]).astype(np.int64).T
    result[row, column] = True
    # A node between covered ones is covered, too: alone it would have no neighbours to be judged by.
    closed = cv2.morphologyEx(result.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return np.asarray(closed.ravel() > 0)
