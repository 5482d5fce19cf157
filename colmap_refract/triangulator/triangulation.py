"""The sequence: rays meet, points settle under the weights of their depth, what is wrong goes, the rest settles again.

Poses, planes and media are taken from the model and its sidecar and stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError, listed
from colmap_refract.estimator import random_slopes
from colmap_refract.estimator.chunk import Problem, robust_cost
from colmap_refract.estimator.random_slopes import Deviations, KnownViews, Sights
from colmap_refract.estimator.robust import LOSSES
from colmap_refract.files.model_io import copy_model
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.interface import Array
from colmap_refract.mapping.known_views import Views
from colmap_refract.refiner.filtering import label_wet, reprojection_errors
from colmap_refract.refiner.observations import Observations, read_observations
from colmap_refract.triangulator.options import TriangulatorOptions
from colmap_refract.triangulator.outcome import Triangulation, outcome

if TYPE_CHECKING:
    import pycolmap

_SLICE = 20_000
"""Points between two words to whoever watches, and two chances for Ctrl-C."""
_RELABELLINGS = 4
_FILTERINGS = 5


@dataclass(frozen=True, kw_only=True)
class _Solution:
    """P points at rest, lengths in units of the solve.

    Attributes:
        observations: N of them, in the model's units.
        problem: with the points, and which observations are wet.
        squared: (N,) squared errors in units of their own standard deviations.
        information: (P, 3, 3) inverse covariances.
        num_restless: points that did not settle.
    """

    observations: Observations
    problem: Problem
    squared: Array
    information: Array
    num_restless: int


def triangulate_points(
    model: pycolmap.Reconstruction,
    sidecar: Sidecar,
    options: TriangulatorOptions,
    *,
    say: Callable[[str], None] = lambda text: None,
) -> Triangulation:
    """Triangulate the points of a model anew, through waves about its known interfaces.

    The errors of all observations are taken to be independent. Where neighbouring keypoints of one image look through
    the same wave, the standard deviations of single points still hold, but the points err together: averaging near
    points gains less than their number promises.

    Args:
        model: with poses, keypoints and tracks; it is not altered. Its points are one start, where the refracted
            rays meet is another.
        sidecar: the interfaces and media of its images.
        options: what is known of waves and keypoints, and what is to be removed.
        say: told in a few words what is being done.

    Returns:
        The model with the new points and their covariances.

    Raises:
        RefractError: the sidecar does not speak of all images, has walls where there are waves, or no point is left.
    """
    observations = read_observations(model)
    _check(observations, sidecar, options)
    if not len(observations.points):
        raise RefractError("no point of the model is seen by two images: there is nothing to triangulate")
    unit = _median_range(observations)
    views = Views(observations, sidecar, unit)
    say("Intersecting rays ...")
    solution = _settled(views, observations, _starts(views, observations, unit, options), options, say)
    min_tri_angle = options.min_tri_angle(sidecar.scenario)
    num_large, num_small, num_dissolved = 0, 0, len(model.points3D) - len(observations.points)
    for _ in range(_FILTERINGS):
        large, small = _marks(views, solution, options, min_tri_angle)
        if not (large.any() or small.any()):
            break
        num_large += int(large.sum())
        num_small += int(small.sum())
        before, point = solution.observations, solution.observations.point
        selected = before.select(~large & ~small[point])
        num_dissolved += int((~small).sum()) - len(selected.points)
        if not len(selected.points):
            raise RefractError(
                "every point was filtered: the poses or interfaces do not fit the images, or slope_deviation_deg "
                f"{options.slope_deviation_deg:g} or filter_min_tri_angle {min_tri_angle:g} does not suit this capture"
            )
        points = solution.problem.points[np.isin(before.point3D_ids, selected.point3D_ids)]
        views = Views(selected, sidecar, unit)
        solution = _settled(views, selected, points, options, say)
    observations, problem = solution.observations, solution.problem
    with np.errstate(divide="ignore", invalid="ignore"):
        values, vectors = np.linalg.eigh(solution.information)
        variances = np.where(values > 1e-12 * values[:, -1:], 1.0 / values, np.inf)
    return outcome(
        copy_model(model),
        sidecar,
        options,
        replace(observations, points=problem.points * unit),
        principal_axes=vectors,
        principal_variances=variances * unit**2,
        errors=reprojection_errors(problem, observations),
        squared=solution.squared,
        num_dry=int((~problem.tracks.wet & (problem.structure.image_plane[observations.image] >= 0)).sum()),
        num_filtered_large_error=num_large,
        num_filtered_small_angle=num_small,
        num_dissolved=num_dissolved,
        num_restless=solution.num_restless,
    )


def _check(observations: Observations, sidecar: Sidecar, options: TriangulatorOptions) -> None:
    missing = [name for name in observations.image_names if name not in sidecar.images]
    if missing:
        raise RefractError(
            f"refraction.json has no entry for image {listed(missing)}: give the one that belongs to this model; an "
            "image without an interface is listed with normal_in_cam and distance null"
        )
    if options.slope_deviation_deg > 0 and any(thickness > 0 for thickness in sidecar.layers.thickness):
        raise RefractError("the interface has walls, and a wall makes no waves: give --slope_deviation_deg 0")


def _median_range(observations: Observations) -> float:
    """Median distance of the points from the cameras that see them, model units; the solver likes it to be one."""
    rotation, translation = observations.cam_from_world
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    ranges = np.linalg.norm(observations.points[observations.point] - centers[observations.image], axis=1)
    median = float(np.median(ranges))
    return median if median > 0 else 1.0


def _deviations(options: TriangulatorOptions) -> Deviations:
    return Deviations(options.pixel_noise, options.slope_deviation)


def _arrays(problem: Problem) -> tuple[Sights, KnownViews]:
    """A problem as the compiled functions take it."""
    tracks, structure = problem.tracks, problem.structure
    rotation, translation = problem.state.cam_from_world(structure)
    normal, distance = problem.state.planes_in_cam(structure)
    dry = structure.image_plane < 0
    normal[dry], distance[dry] = (0.0, 0.0, 1.0), 1.0
    sights = Sights(tracks.start, tracks.image, tracks.direction, tracks.metric, tracks.wet)
    return sights, KnownViews(np.ascontiguousarray(rotation), translation, normal, distance)


def _appraised(problem: Problem, options: TriangulatorOptions) -> tuple[Array, Array]:
    """Squared standardised errors (N,) and information (P, 3, 3) at the problem's points."""
    squared, information = np.empty(len(problem.tracks.image)), np.empty((len(problem.points), 3, 3))
    random_slopes.appraise(
        problem.points, *_arrays(problem), problem.optics, _deviations(options), squared, information
    )
    return squared, information


def _labelled(views: Views, observations: Observations, points: Array) -> Problem:
    """The problem with its points on the side of the interfaces that they lie on."""
    problem = views.problem(observations.start, np.arange(len(observations.image)), points)
    return replace(problem, tracks=problem.tracks._replace(wet=label_wet(problem)))


def _starts(views: Views, observations: Observations, unit: float, options: TriangulatorOptions) -> Array:
    """Where each point's rays meet, or where the model has it, whichever costs less."""
    meeting, _ = views.triangulated(observations.start, np.arange(len(observations.image)), settle=False)
    costs, starts = [], [meeting, observations.points / unit]
    for points in starts:
        squared, _ = _appraised(_labelled(views, observations, points), options)
        # The loss need not be robust where the solve is, but the choice must.
        each = np.nan_to_num(robust_cost(squared, "cauchy", options.loss_function_scale), nan=np.inf)
        costs.append(np.add.reduceat(each, observations.start[:-1]))
    return np.where((costs[0] < costs[1])[:, None], *starts)


def _settled(
    views: Views,
    observations: Observations,
    points: Array,
    options: TriangulatorOptions,
    say: Callable[[str], None],
) -> _Solution:
    """The points at rest, each on the side of the interfaces that it was taken to be on, if there is such a place."""
    points = points.copy()
    problem = _labelled(views, observations, points)
    loss = LOSSES[options.loss_function_type]
    num_restless = 0
    for _ in range(_RELABELLINGS):
        sights, known = _arrays(problem)
        num_restless = 0
        for first in range(0, len(points), _SLICE):
            say(f"Triangulating: {first} of {len(points)} points")
            num_restless += random_slopes.settle(
                points, first, min(first + _SLICE, len(points)), sights, known, problem.optics, _deviations(options),
                loss, options.loss_function_scale,
            )  # fmt: skip
        problem = replace(problem, points=points)
        wet = label_wet(problem)
        if (wet == problem.tracks.wet).all():
            break
        problem = replace(problem, tracks=problem.tracks._replace(wet=wet))
    squared, information = _appraised(problem, options)
    return _Solution(
        observations=observations, problem=problem, squared=squared, information=information, num_restless=num_restless
    )


def _marks(
    views: Views, solution: _Solution, options: TriangulatorOptions, min_tri_angle: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Observations (N,) with a large error, and points (P,) with a small angle."""
    observations, problem = solution.observations, solution.problem
    # Not seen at all, as behind the camera, is wrong by any measure.
    large = ~np.isfinite(solution.squared) | ~np.isfinite(reprojection_errors(problem, observations))
    if options.filter_max_error_std > 0:
        large |= solution.squared > options.filter_max_error_std**2
    small = np.zeros(len(problem.points), dtype=np.bool_)
    if min_tri_angle > 0:
        keypoint = np.arange(len(observations.image))
        small = ~(views.angles(observations.start, keypoint, problem.points) >= min_tri_angle)
    return large, small
