"""Poses and points adjusted without refraction: what holds a model together while it grows.

The adjustment is this package's own, without interfaces. A model through water does not fit straight rays, so
what is an outlier is judged by the errors that most observations have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator.adjustment import SolverSettings, adjust
from colmap_refract.estimator.chunk import Held, Problem
from colmap_refract.estimator.elimination import Tracks
from colmap_refract.estimator.scenario import Index, State, Structure
from colmap_refract.estimator.triangulation import triangulation_angles
from colmap_refract.interface import Array, Layers
from colmap_refract.refiner.continuation import retriangulate
from colmap_refract.refiner.filtering import reprojection_errors
from colmap_refract.refiner.observations import Observations

Mask = NDArray[np.bool_]

_MIN_ANGLE_DEG = 1.0
_OUTLYING = 6.0
"""Times the median error: what is not solved with."""
_FAR_OUT = 20.0
"""Times the median error: what is left out for good. A bent model has large errors that are no wrong matches."""
_LEAST_LIMIT = 4.0
"""Pixels: what is solved with at least."""


@dataclass(frozen=True, kw_only=True)
class Registered:
    """Poses and points as far as they are known.

    Attributes:
        posed: (F,) the frames that have a pose.
        rotation, translation: (F, 3, 3), (F, 3) `rig_from_world`.
        points: (P, 3), known: (P,) which of them have a place.
        inlier: (N,) observations of posed images that are not far off their points, as long as those are known.
    """

    posed: Mask
    rotation: Array
    translation: Array
    points: Array
    known: Mask
    inlier: Mask


def settle(observations: Observations, registered: Registered, *, num_threads: int = 1) -> Registered:
    """All points of posed images triangulated anew, and poses and points adjusted without refraction."""
    seen = registered.posed[observations.image_frame[observations.image]]
    count = np.bincount(observations.point[seen], minlength=len(registered.points))
    rows, members = np.flatnonzero(seen & (count[observations.point] >= 2)), np.flatnonzero(count >= 2)
    active = observations.select(seen)
    problem = retriangulate(_problem(active, registered, members))
    settings = SolverSettings(num_threads=num_threads, max_num_iterations=50, function_tolerance=1e-4)
    # Poses that were found one by one are off by more than they will be: judged anew after a first adjustment.
    for _ in range(2):
        keep, limit = _judge(problem, active)
        if not keep.any():
            break
        has = np.bincount(active.point[keep], minlength=len(members)) >= 2
        subset = _problem(active.select(keep), registered, members[has])
        subset = replace(subset, points=problem.points[has], state=problem.state, loss_scale=limit)
        try:
            solved = adjust(subset, settings)
        except FloatingPointError:
            break
        if solved.termination == "failure":
            break
        points = problem.points.copy()
        points[has] = solved.points
        problem = retriangulate(replace(problem, state=solved.state, points=points))
    keep, _ = _judge(problem, active)
    known, points = np.zeros(len(registered.points), dtype=np.bool_), registered.points.copy()
    known[members] = np.bincount(active.point[keep], minlength=len(members)) >= 2
    points[members] = problem.points
    wide, _ = _judge(problem, active, _FAR_OUT)
    inlier = np.zeros(len(observations.image), dtype=np.bool_)
    inlier[rows[wide]] = True
    inlier &= known[observations.point]
    state = problem.state
    return replace(
        registered, rotation=state.rotation, translation=state.translation, points=points, known=known, inlier=inlier
    )


def _judge(problem: Problem, observations: Observations, outlying: float = _OUTLYING) -> tuple[Mask, float]:
    """Observations (N,) that agree with their points, where those have a parallax; and the limit in px."""
    errors = reprojection_errors(problem, observations)
    finite = errors[np.isfinite(errors)]
    limit = max(_LEAST_LIMIT, outlying * float(np.median(finite))) if len(finite) else _LEAST_LIMIT
    angle = triangulation_angles(problem.tracks, problem.structure, problem.state, problem.layers, problem.points)
    keep = (errors <= limit) & (angle >= _MIN_ANGLE_DEG)[observations.point]
    enough = np.bincount(observations.point[keep], minlength=len(problem.points)) >= 2
    return np.asarray(keep & enough[observations.point]), limit


def _problem(observations: Observations, registered: Registered, points: Index) -> Problem:
    """The dry adjustment of the posed images."""
    count = len(observations.image_ids)
    structure = Structure(
        image_pose=observations.image_frame,
        image_plane=np.full(count, -1),
        image_camera=observations.image_camera,
        sensor_rotation=observations.sensor_rotation,
        sensor_translation=observations.sensor_translation,
        plane_in_world=np.zeros(0, dtype=np.bool_),
        plane_anchor=np.zeros((0, 3)),
    )
    state = State(
        rotation=registered.rotation,
        translation=registered.translation,
        normal=np.zeros((0, 3)),
        distance=np.zeros(0),
        index=1.0,
        lens=np.zeros((len(observations.cameras), 0)),
    )
    tracks = Tracks(
        start=observations.start,
        image=observations.image.astype(np.int32),
        direction=observations.direction,
        metric=observations.metric,
        lens=np.zeros((len(observations.image), 2, 0)),
        wet=np.zeros(len(observations.image), dtype=np.bool_),
    )
    return Problem(
        tracks=tracks,
        structure=structure,
        layers=Layers(index=(1.0,)),
        state=state,
        points=registered.points[points],
        held=Held.nothing(state),
        loss="cauchy",
        loss_scale=_LEAST_LIMIT,
    )
