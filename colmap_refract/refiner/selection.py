"""Which observations are solved with: all are judged anew after every solve, so that no early mistake lasts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import SolverSettings, settle_points
from colmap_refract.estimator.chunk import Problem
from colmap_refract.refiner.arrangement import Arrangement
from colmap_refract.refiner.continuation import retriangulate
from colmap_refract.refiner.filtering import Filtered, filter_observations, predicted_directions
from colmap_refract.refiner.observations import lift


@dataclass(frozen=True, kw_only=True)
class Selection:
    """All observations of a model, and those of them that take part.

    Attributes:
        arrangement: with all N observations of P points.
        problem: of all observations; its state and points are the latest.
        keep: (N,) the observations that take part; at least two of each point that does.
        marks: why the others do not; None before the first filter.
    """

    arrangement: Arrangement
    problem: Problem
    keep: NDArray[np.bool_]
    marks: Filtered | None = None

    @property
    def keep_point(self) -> NDArray[np.bool_]:
        """(P,) the points that take part."""
        return np.asarray(np.logical_or.reduceat(self.keep, self.problem.tracks.start[:-1]))

    def active(self) -> tuple[Arrangement, Problem]:
        """The arrangement and problem of what takes part."""
        if self.keep.all():
            return self.arrangement, self.problem
        observations = self.arrangement.observations.select(self.keep)
        tracks = self.problem.tracks
        active = tracks.take(observations.start, self.keep)
        points = self.problem.points[self.keep_point]
        return replace(self.arrangement, observations=observations), replace(self.problem, tracks=active, points=points)

    def solved(self, active: Problem) -> Selection:
        """After a solve of what takes part: the other points go where their rays now meet."""
        points = self.problem.points.copy()
        points[self.keep_point] = active.points
        problem = replace(active, tracks=self.problem.tracks, points=points)
        if not self.keep.all():
            points = retriangulate(problem).points
            points[self.keep_point] = active.points
            problem = replace(problem, points=points)
        return replace(self, problem=problem)

    def relifted(self) -> tuple[Selection, bool]:
        """Refined intrinsics put into the cameras and the keypoints lifted anew; and whether they still moved."""
        problem, arrangement = self.problem, self.arrangement
        if problem.held.lens:
            return self, False
        change = problem.state.lens
        largest = 0.0
        for c, camera in enumerate(arrangement.observations.cameras):
            params = np.array(camera.params)
            for j, index in enumerate(arrangement.lens_parameters[c]):
                params[index] += change[c, j]
                largest = max(largest, abs(change[c, j]) / max(abs(params[index]), 1e-3))
            camera.params = params.tolist()
        observations = lift(arrangement.observations)
        if len(observations.image) != len(problem.tracks.image):
            raise RefractError(
                "the refined intrinsics do not see all keypoints any more: hold the distortion parameters"
            )
        arrangement = replace(arrangement, observations=observations)
        predicted = predicted_directions(problem)
        tracks = arrangement.tracks(observations, predicted)._replace(wet=problem.tracks.wet)
        state = replace(problem.state, lens=np.zeros_like(change))
        problem = replace(problem, tracks=tracks, state=state)
        return replace(self, arrangement=arrangement, problem=problem), largest > _LENS_MOVES

    def changes_sides(self, wet: NDArray[np.bool_]) -> bool:
        """Whether an observation that takes part is on another side by `wet` (N,)."""
        return bool((wet != self.problem.tracks.wet)[self.keep].any())

    def relabelled(self, wet: NDArray[np.bool_]) -> Selection:
        """The same observations, with those that `wet` (N,) marks taken to be of points in the water."""
        problem = self.problem
        if (wet == problem.tracks.wet).all():
            return self
        return replace(self, problem=retriangulate(replace(problem, tracks=problem.tracks._replace(wet=wet))))

    def filtered(
        self, wet: NDArray[np.bool_], settings: SolverSettings, max_reproj_error: float
    ) -> tuple[Selection, float]:
        """All observations judged at the latest state.

        Args:
            wet: (N,) which observations are of points in the water.
            settings: for settling points that have changed sides, or were left out.
            max_reproj_error: px; 0 keeps all.

        Returns:
            The new selection, and the part of all observations that came, went or changed sides.

        Raises:
            RefractError: nothing is left.
        """
        problem = self.problem
        relabelled = wet != problem.tracks.wet
        problem = self.relabelled(wet).problem
        if relabelled.any() or not self.keep.all():
            problem = replace(problem, points=settle_points(problem, settings))
        marks = filter_observations(
            problem,
            self.arrangement.observations,
            max_reproj_error=max_reproj_error,
            min_tri_angle=self.arrangement.options.min_tri_angle,
        )
        counts = np.add.reduceat(marks.keep.astype(np.int64), problem.tracks.start[:-1])
        keep = marks.keep & np.repeat(counts >= 2, np.diff(problem.tracks.start))
        if not keep.any():
            raise RefractError(
                "every point was filtered: the scenario or the intrinsics do not fit the images, or "
                "filter_max_reproj_error is too small for this noise"
            )
        changed = float((relabelled | (keep != self.keep)).mean())
        return replace(self, problem=problem, keep=keep, marks=marks), changed


_LENS_MOVES = 1e-6
"""Relative change of an intrinsic parameter that is worth lifting the keypoints and solving again for."""
