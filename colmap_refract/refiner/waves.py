"""Waves on a problem whose surfaces were flat: a random surface over each image, and what it cannot resolve as noise.

A surface is a sum of `modes`, its most probable shapes, whose coefficients are unknowns of unit variance. Where a
keypoint's ray meets it follows from the latest solution: the design is made anew a few times (`with_waves`).

Two things keep the solution from being biased, and both matter more than the pixel noise itself:

- The surface is looked up where the *solution* sees a point, not where its keypoint is. A keypoint's noise moves the
  place, the slope there moves with it, and the product of the two looks like a lens.
- Solves take the waves' effects on the pixels as they stand (`frozen`): generalised least squares with a known
  covariance. With effects that follow the solution, deeper water explains the same noise by smaller waves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from colmap_refract.estimator import elimination
from colmap_refract.estimator.adjustment import SolverSettings, settle_points
from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.random_surface import Modes, RandomSlopes, RandomSurface, modes, node_grid
from colmap_refract.estimator.robust import LOSSES, weights
from colmap_refract.estimator.surface import local_planes
from colmap_refract.interface import Array, tangent_basis
from colmap_refract.refiner.continuation import residuals, retriangulate
from colmap_refract.refiner.filtering import predicted_directions

_FIT = 1e-3
"""Of the slope deviation: how closely the coefficients follow the surface when its design changes."""
_NUM_CROSSINGS = 3
"""Rounds to find where a ray meets its surface: each brings a factor of the slope."""
_WIDE_LOSS = 20.0
"""Pixels."""
_MOST_ADRIFT = 3.0
"""Noise deviations between keypoint and solution up to which the solution says where a ray meets the surface."""


@dataclass(frozen=True, kw_only=True)
class WaveStatistics:
    """What is known or assumed of the waves.

    Attributes:
        slope_deviation: root mean square slope over both axes, a tangent.
        wavelength: the dominant one, over the median distance of the interfaces.
        noise: of a keypoint coordinate, px.
        unresolved: variance of the slopes that the modes cannot take, over what the spectrum has there.
        free_slopes: whether slopes are free, in place of those of a surface.
    """

    slope_deviation: float
    wavelength: float
    noise: float
    unresolved: float = 1.0
    free_slopes: bool = False

    def total_slope(self, explained: float) -> float:
        """Slope deviation of all waves, where the modes can take a part of the variance that the spectrum has."""
        return self.slope_deviation * float(np.sqrt(explained + (1.0 - explained) * self.unresolved))


@dataclass(frozen=True, kw_only=True)
class Wavy:
    """A problem with waves.

    Attributes:
        problem: every observation with a local plane of its own.
        modes: (I,) the shapes on each image's plane, lengths over its distance; None for images without interface.
        explained: the part of the slopes' variance that the modes can take; the rest counts as noise.
        whiten: (N, 2, 2) what residuals were multiplied with for it.
    """

    problem: Problem
    modes: list[Modes | None]
    explained: float
    whiten: Array


def with_waves(
    flat: Problem,
    statistics: WaveStatistics,
    num_modes: int,
    current: Problem | None = None,
    on_image: Callable[[int, int], None] = lambda done, total: None,
) -> Wavy:
    """Put waves on all surfaces of a problem.

    Args:
        flat: without waves; its observations, tying and metric.
        statistics: of the waves; the prior.
        num_modes: coefficients per image, at most; with 0 all slopes count as noise, and one coefficient does nothing.
        current: the latest solution of the same observations, with waves or not, to go on from; else `flat`'s state.
        on_image: called before each image, with how many are done, of how many.
    """
    structure, tracks = flat.structure, flat.tracks
    solution = flat if current is None else current
    normal, distance = solution.state.planes_in_cam(structure)
    typical = float(np.nanmedian(distance))
    refracted = structure.image_plane >= 0
    axes = np.zeros((structure.num_images, 3, 2))
    for image in np.flatnonzero(refracted).tolist():
        axes[image] = tangent_basis(normal[image])
    sight, relief = tracks.direction, np.zeros((len(tracks.image), 3))
    if current is not None:
        sight = _sight(current, statistics.noise)
        relief = relief_of(current, axes)
    with np.errstate(invalid="ignore"):
        foot = sight / np.einsum("ni,ni->n", sight, normal[tracks.image])[:, None]
    places = np.einsum("nia,ni->na", axes[tracks.image], foot) * (1.0 + relief[:, :1])
    resolved, num_modes = num_modes > 0, max(num_modes, 1)
    by_image: list[Modes | None] = [None] * structure.num_images
    waves = np.zeros((len(tracks.image), 3, num_modes))
    coefficients = np.zeros((structure.num_images, num_modes))
    tolerance = _FIT * statistics.slope_deviation
    field = RandomSlopes if statistics.free_slopes else RandomSurface
    for image in np.flatnonzero(refracted).tolist():
        on_image(image, structure.num_images)
        mine = np.flatnonzero((tracks.image == image) & np.isfinite(places).all(axis=1))
        if not len(mine) or not resolved:
            continue
        length = statistics.wavelength * typical / distance[image]
        surface = field(slope_deviation=statistics.slope_deviation, wavelength=length)
        shapes = modes(surface, node_grid(places[mine], length), num_modes)
        by_image[image] = shapes
        # The normal leans against the slope.
        design = shapes.at(places[mine]) * np.array([1.0, -1.0, -1.0])[:, None]
        waves[mine, :, : design.shape[2]] = design
        if current is not None:
            stacked = design.reshape(-1, design.shape[2]) / tolerance
            system = stacked.T @ stacked + np.eye(design.shape[2])
            right = stacked.T @ relief[mine].ravel() / tolerance
            coefficients[image, : design.shape[2]] = np.linalg.solve(system, right)
    wavy = replace(
        solution,
        tracks=tracks._replace(waves=waves, sight=np.ascontiguousarray(sight)),
        structure=replace(structure, wave_axes=axes),
        state=replace(solution.state, waves=coefficients),
        wave_prior=np.tile(statistics.noise * np.eye(num_modes), (structure.num_images, 1, 1)),
    )
    per_axis = 0.5 * statistics.slope_deviation**2
    left = per_axis * np.eye(2) - np.einsum("nak,nbk->nab", waves[:, 1:], waves[:, 1:])
    share = np.einsum("naa->n", left)[refracted[tracks.image]] / (2.0 * per_axis)
    whiten = _whitening(surface_effects(wavy)[:, :, 1:], statistics.unresolved * left, statistics.noise)
    whitened = wavy.tracks._replace(metric=whiten @ tracks.metric, lens=whiten @ tracks.lens)
    return Wavy(
        problem=replace(wavy, tracks=whitened), modes=by_image, explained=float(1.0 - share.mean()), whiten=whiten
    )


def spread_waves(wavy: Wavy, flat: Problem, on_image: Callable[[int, int], None] = lambda done, total: None) -> Problem:
    """The surfaces of a solution before other observations of the same images.

    Args:
        wavy: at its solution.
        flat: the other observations, without waves; their points go where their rays meet behind the surfaces.
        on_image: as for `with_waves`.
    """
    solution, tracks = wavy.problem, flat.tracks
    normal, _ = solution.state.planes_in_cam(solution.structure)
    waves = np.zeros((len(tracks.image), 3, solution.num_waves))
    for image, shapes in enumerate(wavy.modes):
        on_image(image, len(wavy.modes))
        mine = np.flatnonzero(tracks.image == image)
        if shapes is None or not len(mine):
            continue
        ray = tracks.direction[mine]
        foot = (ray @ solution.structure.wave_axes[image]) / (ray @ normal[image])[:, None]
        coefficients = solution.state.waves[image, : shapes.shapes.shape[1]]
        places = foot
        for _ in range(_NUM_CROSSINGS):
            places = foot * (1.0 + shapes.at(places)[:, 0] @ coefficients)[:, None]
        waves[mine, :, : len(coefficients)] = shapes.at(places) * np.array([1.0, -1.0, -1.0])[:, None]
    spread = replace(
        flat,
        tracks=tracks._replace(waves=waves, sight=tracks.direction),
        structure=solution.structure,
        state=solution.state,
        loss="cauchy",
        loss_scale=_WIDE_LOSS,
    )
    spread = retriangulate(spread)
    return replace(spread, points=settle_points(spread, SolverSettings()))


def _sight(current: Problem, noise: float) -> Array:
    """Where a solution sees its points, or the keypoint where it does not see them near there (a wrong match)."""
    tracks = current.tracks
    seen = predicted_directions(current)
    adrift = np.linalg.norm(np.einsum("nij,nj->ni", tracks.metric, seen - tracks.direction), axis=1)
    near = np.isfinite(adrift) & (adrift < _MOST_ADRIFT * noise)
    return np.where(near[:, None], seen, tracks.direction)


def _whitening(effect: Array, covariance: Array, noise: float) -> Array:
    """(N, 2, 2) that gives residuals with additional slopes of some covariance the variance of the noise."""
    total = np.eye(2) + effect @ covariance @ effect.transpose(0, 2, 1) / noise**2
    return np.asarray(np.linalg.inv(np.linalg.cholesky(total)))


def relief_of(problem: Problem, axes: Array) -> Array:
    """Height over the plane's distance, and parts of the normal along `axes` (I, 3, 2), of each keypoint's surface."""
    if not problem.num_waves or not problem.tracks.waves.shape[2]:
        return np.zeros((len(problem.tracks.image), 3))
    normal, distance = problem.state.planes_in_cam(problem.structure)
    local, local_distance = local_planes(problem.tracks, problem.structure, problem.state)
    image, ray = problem.tracks.image, problem.tracks.sight
    normal, distance = normal[image], distance[image]
    reach = local_distance / np.einsum("ni,ni->n", local, ray)
    tilted = local / np.einsum("ni,ni->n", local, normal)[:, None] - normal
    height = reach * np.einsum("ni,ni->n", normal, ray) / distance - 1.0
    return np.column_stack([height, np.einsum("nia,ni->na", axes[image], tilted)])


def surface_effects(problem: Problem) -> Array:
    """Pixels (N, 2, 3) by height and slopes of the local surface, at the problem's waves."""
    out = np.zeros((len(problem.tracks.image), 2, 3))
    elimination.surface_effects(problem.points, problem.tracks, problem.views, problem.optics, out)
    return out


def between(before: Problem, after: Problem, share: float) -> Problem:
    """A state that has gone only a share of the way between two of the same observations, surfaces included."""
    first, second, structure = before.state, after.state, after.structure

    def mix(a: Array, b: Array) -> Array:
        return (1.0 - share) * a + share * b

    normal = mix(first.normal, second.normal)
    turn = Rotation.from_matrix(second.rotation @ first.rotation.transpose(0, 2, 1)).as_rotvec()
    relief = mix(relief_of(before, structure.wave_axes), relief_of(after, structure.wave_axes))
    state = replace(
        second,
        rotation=Rotation.from_rotvec(share * turn).as_matrix() @ first.rotation,
        translation=mix(first.translation, second.translation),
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        distance=mix(first.distance, second.distance),
        waves=np.ones((structure.num_images, 1)),
    )
    tracks = after.tracks._replace(waves=relief[:, :, None])
    return replace(after, state=state, points=mix(before.points, after.points), tracks=tracks)


def frozen(wavy: Problem, *, bent: bool) -> Problem:
    """The problem with the waves' effects on the pixels as they are at its state: linear in the coefficients.

    What points, poses and planes do to a pixel depends on the surface, too.

    Args:
        wavy: at a solution.
        bent: take that at the surface that the other keypoints of the image show (`_by_others`); else at the plane.
    """
    tracks = wavy.tracks
    effects = surface_effects(wavy) @ tracks.waves
    relief = _by_others(wavy, effects) if bent else np.zeros((0, 3))
    if relief.any():
        rest = tracks._replace(waves=np.zeros((0, 3, 0)), relief=relief)
    else:
        rest = tracks._replace(waves=np.zeros((0, 3, 0)), sight=np.zeros((0, 3)))
    now = np.einsum("nak,nk->na", effects, wavy.state.waves[tracks.image])
    offset = residuals(wavy) - residuals(replace(wavy, tracks=rest)) - now
    return replace(wavy, tracks=rest._replace(effects=effects, offset=offset))


def _by_others(wavy: Problem, effects: Array) -> Array:
    """(N, 3) height and parts of the normal of each keypoint's surface, as the others of its image have it.

    The coefficients with one observation left out follow from those with all in closed form, at given points and
    poses. A surface that follows a keypoint's own error would change what the point does to it by as much, always to
    the same side: deeper water with smaller waves. Prediction by the others has no part in that error, and its
    residual none in theirs (the argument of the jackknife instrumental variable: Angrist, Imbens and Krueger 1999).
    """
    tracks = wavy.tracks
    relief: Array = np.einsum("nak,nk->na", tracks.waves, wavy.state.waves[tracks.image])
    if not relief.any() or wavy.wave_prior is None:
        return relief
    error = residuals(wavy)
    weight = weights((error**2).sum(axis=1), LOSSES[wavy.loss], wavy.loss_scale)
    for image in np.unique(tracks.image).tolist():
        mine = np.flatnonzero(tracks.image == image)
        factor = np.sqrt(weight[mine])[:, None]
        mode, unit = factor[:, :, None] * effects[mine], wavy.wave_prior[image]
        stacked = mode.reshape(-1, mode.shape[2])
        by_mode = mode @ np.linalg.inv(stacked.T @ stacked + unit.T @ unit)
        leverage = np.einsum("nak,nbk->nab", by_mode, mode)
        left_out = np.linalg.solve(np.eye(2) - leverage, (factor * error[mine])[:, :, None])[:, :, 0]
        relief[mine] += np.einsum("nak,nbk,nb->na", tracks.waves[mine], by_mode, left_out)
    return relief
