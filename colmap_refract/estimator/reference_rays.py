"""A reference image: the paper's `E_hard`, and its distances in the scene.

`E_hard` puts every point on the refracted ray of the reference image's keypoint, so that one length `d_j` is all that
is unknown of it, and sums the squared errors of all other images. Points that the reference does not see take no
part; they can be settled afterwards. The constraint is exact (module `on_ray`), whatever the loss, and the size of
the scene does not matter, so that no pose and no distance need be held.

`D_ij`, distances in the scene (module `scene_residual`), are smaller in a smaller scene: they hold the reference's pose
and the distance of its plane, the paper's `d_r`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import SolverSettings, settle_points
from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.printed_unknowns import anchored
from colmap_refract.estimator.scenario import Index
from colmap_refract.estimator.triangulation import refracted_rays
from colmap_refract.interface import Array


@dataclass(frozen=True, kw_only=True)
class ReferenceRays:
    """A problem whose points live on the rays of a reference image.

    Attributes:
        problem: the points that take part, with the reference's observation first.
        reference: index of the image.
        points: (p,) of the points in the problem that it was made of.
        rows: (n,) of its observations in that problem.
    """

    problem: Problem
    reference: int
    points: Index
    rows: Index

    @property
    def num_points_shared(self) -> Index:
        """(I,) points that each image has in common with the reference. An image that has none stays as it is."""
        num_images = self.problem.structure.num_images
        pairs = np.unique(_points_of(self.problem) * num_images + self.problem.tracks.image)
        return np.bincount(pairs % num_images, minlength=num_images)


def num_points_seen(problem: Problem) -> Index:
    """(I,) points that each image sees and others see as well: what it would have as a reference."""
    point, image = _points_of(problem), problem.tracks.image
    num_images = problem.structure.num_images
    pairs = np.unique(point * num_images + image)
    seen_by = np.bincount(pairs // num_images, minlength=len(problem.points))
    return np.bincount((pairs % num_images)[seen_by[pairs // num_images] > 1], minlength=num_images)


def on_reference_rays(problem: Problem, reference: int, *, min_num_points: int) -> ReferenceRays:
    """The problem of the points that an image sees, each on its ray, from the same start.

    A second observation of a point by the reference is left out, and a point whose ray never reaches the interface.
    Dry points that the reference sees have straight rays.

    Args:
        problem: data, tying and start.
        reference: index of the image.
        min_num_points: that the reference must have in common with others.

    Raises:
        RefractError: known points, or a reference that sees too few points.
    """
    if problem.held.points:
        raise RefractError("a reference image puts points on its rays: known points cannot be moved there")
    tracks, point = problem.tracks, _points_of(problem)
    from_reference = tracks.image == reference
    of_reference = np.flatnonzero(from_reference)
    layers = problem.layers.with_index(problem.state.index)
    origin, ray = refracted_rays(tracks, problem.structure, problem.state, layers)
    of_reference = of_reference[np.isfinite(origin + ray)[of_reference].all(axis=1)]
    seen, first = np.unique(point[of_reference], return_index=True)
    others = np.flatnonzero(~from_reference & np.isin(point, seen))
    points = np.unique(point[others])
    if len(points) < max(min_num_points, 1):
        raise RefractError(
            f"the reference image sees {len(points)} points that other images see, its rays need {min_num_points}: "
            "choose a reference image that sees more"
        )
    rows = np.concatenate([of_reference[first[np.isin(seen, points)]], others])
    # Stable, so that the reference's observation stays the first of its point.
    rows = rows[np.argsort(point[rows], kind="stable")]
    start = np.searchsorted(point[rows], [*points, len(problem.points)]).astype(np.int64)
    restricted = replace(problem, tracks=tracks.take(start, rows), points=problem.points[points], on_rays=True)
    return ReferenceRays(problem=restricted, reference=reference, points=points, rows=rows)


def with_other_points(problem: Problem, rays: ReferenceRays, solved: Problem, settings: SolverSettings) -> Array:
    """All points (P, 3): those on rays as they are, the others at their minima with everything else held.

    Args:
        problem: what `rays` was made of.
        rays: of the reference image.
        solved: `rays.problem` with the solution as its state and points.
        settings: of the solver.
    """
    points = problem.points.copy()
    points[rays.points] = solved.points
    others = np.setdiff1d(np.arange(len(points)), rays.points)
    if not others.size:
        return points
    point = _points_of(problem)
    rows = np.flatnonzero(np.isin(point, others))
    start = np.searchsorted(point[rows], [*others, len(points)]).astype(np.int64)
    free = replace(
        problem, tracks=problem.tracks.take(start, rows), structure=solved.structure, state=solved.state,
        points=points[others],
    )  # fmt: skip
    points[others] = settle_points(free, settings)
    return points


def with_distances_in_scene(rays: ReferenceRays, weights: Array | None = None) -> Problem:
    """The problem with residuals `D_ij` in the scene, the reference's pose and the distance of its plane held.

    The problem's robust loss and its scale apply to the weighted distances.

    Args:
        rays: of the reference image.
        weights: (n, 2, 2) of the two coordinates of each distance across the reference camera's optical axis; those of
            the reference's own observations do not matter. By default they are 1, and distances are in units of the
            solve.

    Raises:
        RefractError: walls, refined intrinsics, or a reference image without an interface.
    """
    reference, structure, held = rays.reference, rays.problem.structure, rays.problem.held
    block = int(structure.image_plane[reference])
    if any(rays.problem.layers.thickness):
        raise RefractError("distances in the scene are taken behind one refracting surface: leave walls out")
    if rays.problem.state.lens.any() or not held.lens:
        raise RefractError(
            "distances in the scene take intrinsics as known: lift the keypoints with the refined ones first, and hold "
            "them"
        )
    if block < 0:
        raise RefractError("the reference image has no interface: choose one that has")
    problem = anchored(rays.problem, reference)
    across = problem.state.cam_from_world(structure)[0][reference]
    scene = np.tile(across, (len(problem.tracks.image), 1, 1))
    if weights is not None:
        scene[:, :2] = np.einsum("nij,jk->nik", weights, across[:2])
    poses, distances = held.poses.copy(), held.distances.copy()
    poses[structure.image_pose[reference]] = True
    distances[block] = True
    return replace(
        problem, tracks=problem.tracks._replace(scene=scene), held=replace(held, poses=poses, distances=distances)
    )


def _points_of(problem: Problem) -> Index:
    """(N,) the point of each observation."""
    return np.repeat(np.arange(len(problem.points)), np.diff(problem.tracks.start))
