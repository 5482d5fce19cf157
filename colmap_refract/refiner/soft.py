"""The soft constraint at scale: a solution with waves on every surface, from a start that knows of none."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import Adjustment, SolverSettings, adjust
from colmap_refract.estimator.chunk import LevelPrior, Problem
from colmap_refract.interface import Array, plane_in_cam
from colmap_refract.refiner.arrangement import Arrangement, select_tracks
from colmap_refract.refiner.continuation import Watch, counted, named, residuals, retriangulate
from colmap_refract.refiner.filtering import Filtered, filter_observations, in_cameras, predicted_directions
from colmap_refract.refiner.start import image_depths, viewing_directions, world_plane
from colmap_refract.refiner.wave_statistics import estimate_statistics, log_evidence
from colmap_refract.refiner.waves import WaveStatistics, Wavy, frozen, spread_waves, surface_effects, with_waves

logger = logging.getLogger(__name__)

_START_RATIO = 0.4
"""Distance over depth of the level plane that a moving interface starts from; the outcome does not depend on it."""
_FEW_OBSERVATIONS = 150
"""Per image, of the tracks that statistics and a first solution are found with."""
_FIRST_MODES = (10, 16, 24)
_STATISTICS_MODES = 24
_FIRST_SLOPE, _FIRST_TILT, _FIRST_LIFT = np.tan(np.radians(2.0)), np.radians(2.0), 0.05
_FIRST_WAVELENGTH = 2.0
"""Over the width of what an image sees of its surface."""
_FIRST_NOISE = 0.5
_SCALES = (0.5, 2.0)
_MOST_SCALINGS = 2
_JOINT_ITERATIONS, _FROZEN_ITERATIONS = 15, 30
_FINE, _FINER = 1e-6, 1e-8
"""Function tolerances while the waves are looked up anew, and of the last solves."""
_FAR, _NEAR = 1e4, 1e6
"""Radii of the first trust region, before there is a solution and from one: smaller ones double the iterations."""
_NUM_STATISTICS = 6
_STAYS = 0.15
"""Relative change of the slope deviation that ends the search for it."""
_MATTERS = 0.5
"""Noise deviations: waves that move the keypoints by less are none."""
_MOST_FROZEN = 6
_SETTLED = 0.05
"""Noise deviations by which predicted keypoints still move between the rounds that end the last solves."""
_NEARLY = 4.0
"""Times that: only then is a fine tolerance worth its iterations."""
_LOSS_SCALE_IN_NOISE = 4.0
_WIDE = 4.0
"""Times the median residual: the scale of the loss of the first solves."""
MIN_OBSERVATIONS = 15
"""Per image: fewer say nothing of a surface's shape."""


class Unsupported(Exception):
    """The data do not determine waves; says why."""


@dataclass(frozen=True, kw_only=True)
class WaveOptions:
    """What the user says of the waves; None: estimated.

    Attributes:
        slope_deviation: a tangent; tilt: radians; lift: over the interface distance.
        wavelength: over the median interface distance, or
        wavelength_in_depths: over the median depth: a model's size is known by its depth, not by its interface.
        level_prior: whether there is one.
        num_modes: per image.
    """

    slope_deviation: float | None
    wavelength: float | None
    wavelength_in_depths: float | None
    level_prior: bool
    tilt: float | None
    lift: float | None
    num_modes: int


@dataclass(frozen=True, kw_only=True)
class SoftSolution:
    """A solution with waves.

    Attributes:
        wavy: the observations that were solved with, at the solution.
        statistics, level: the priors in the end.
        adjustment: the last.
        solved: what it solved, at its solution: the waves' effects as they stood.
    """

    wavy: Wavy
    statistics: WaveStatistics
    level: LevelPrior | None
    adjustment: Adjustment
    solved: Problem


def level_start(arrangement: Arrangement, ratio: float = _START_RATIO) -> Problem:
    """All observations, with every plane on one level plane through the depth at `ratio`.

    Waves make planes that are free in every image run away from what is known: water is level, on average.
    """
    observations, structure = arrangement.observations, arrangement.structure
    problem = arrangement.start(ratio, observations)
    rotation, translation = observations.cam_from_world
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    viewing = np.einsum("nji,nj->ni", rotation, viewing_directions(observations))
    mean, offset = world_plane(centers, viewing, image_depths(observations), ratio)
    normal, distance = problem.state.normal.copy(), problem.state.distance.copy()
    for block in range(structure.num_planes):
        image = int(np.flatnonzero(structure.image_plane == block)[0])
        if structure.plane_in_world[block]:
            normal[block], distance[block] = mean, offset - mean @ structure.plane_anchor[block]
        else:
            normal[block], distance[block] = plane_in_cam(mean, offset, rotation[image], translation[image])
    if not (distance > 0).all():
        raise RefractError("no level interface fits between the cameras and the points: check the scenario")
    return retriangulate(
        replace(problem, state=replace(problem.state, normal=normal, distance=distance), loss="cauchy", loss_scale=20.0)
    )


def wave_options(arrangement: Arrangement) -> WaveOptions:
    """What the user said of the waves."""
    options = arrangement.options
    wavelength, metric = options.wavelength, options.interface_distance
    slope, tilt = options.wave_slope_deg, options.level_tilt_deg
    return WaveOptions(
        slope_deviation=None if slope is None else float(np.tan(np.radians(slope))),
        wavelength=wavelength / metric if wavelength is not None and metric is not None else None,
        wavelength_in_depths=None if wavelength is None or metric is not None else wavelength / arrangement.unit,
        level_prior=options.level_prior
        and options.scenario == "moving_interface"
        and arrangement.structure.num_planes > 1,
        tilt=None if tilt is None else float(np.radians(tilt)),
        lift=options.level_lift,
        num_modes=options.num_wave_modes,
    )


class _Solver:
    """The waves of one set of observations, solved again and again as what is known of them grows."""

    def __init__(self, flat: Problem, options: WaveOptions, settings: SolverSettings, watch: Watch | None) -> None:
        # Refined intrinsics and a refined index would take up what the waves do.
        held = replace(flat.held, lens=True, index=True, waves=False)
        self.flat = replace(flat, held=held, wave_prior=None, level_prior=None)
        self.options = options
        self.settings = settings
        self.watch = watch
        # A fixed camera tells the depth of the water by how much the waves do: the one must not explain the other.
        self.always_frozen = bool(held.poses.all())

    def solve(
        self,
        current: Problem | None,
        statistics: WaveStatistics,
        level: LevelPrior | None,
        num_modes: int,
        *,
        stage: str,
        joint: bool,
        wide: bool = False,
        iterations: int | None = None,
        fine: bool = True,
    ) -> tuple[Wavy, Adjustment, Problem]:
        """One round: the design at the current solution, and a solve."""
        if self.options.wavelength_in_depths is not None:
            length = self.options.wavelength_in_depths / _distance_in_depths(self.flat if current is None else current)
            statistics = replace(statistics, wavelength=length)
        wavy = with_waves(self.flat, statistics, num_modes, current, counted(self.watch, f"{stage}, surfaces"))
        scale = _LOSS_SCALE_IN_NOISE * statistics.noise
        if wide:
            # Before waves are known, all residuals are large; wrong matches are larger.
            scale = max(scale, _WIDE * float(np.median(np.abs(residuals(wavy.problem)))))
        problem = replace(wavy.problem, level_prior=level, loss="cauchy", loss_scale=scale)
        count = iterations or (_JOINT_ITERATIONS if joint else _FROZEN_ITERATIONS)
        quick = replace(
            self.settings,
            max_num_iterations=min(self.settings.max_num_iterations, count),
            function_tolerance=max(self.settings.function_tolerance, _FINER if fine and not joint else _FINE),
            initial_trust_region_radius=_FAR if wide else _NEAR,
        )
        joint = joint and not self.always_frozen
        posed = problem if joint else frozen(problem)
        adjustment = adjust(posed, quick, on_progress=named(self.watch, stage))
        finite = np.isfinite(adjustment.state.distance).all() and np.isfinite(adjustment.points).all()
        if adjustment.termination == "failure" or not finite:
            raise Unsupported("Waves are not determined: the solver failed with them")
        found = {"state": adjustment.state, "points": adjustment.points}
        return replace(wavy, problem=replace(problem, **found)), adjustment, replace(posed, **found)  # type: ignore[arg-type]


def solve_soft(
    arrangement: Arrangement,
    start: Problem,
    keep: NDArray[np.bool_],
    options: WaveOptions,
    settings: SolverSettings,
    watch: Watch | None = None,
) -> SoftSolution:
    """Solve with waves.

    Args:
        arrangement: of all N observations.
        start: of all observations, without waves.
        keep: (N,) the observations that take part.
        options: what is known.
        settings: of Ceres.
        watch: for progress.

    Raises:
        Unsupported: too few observations for waves.
    """
    few = keep & select_tracks(arrangement.observations, _FEW_OBSERVATIONS, arrangement.options.random_seed)
    check_support(arrangement, keep)
    solver = _Solver(_part(start, few), options, settings, watch)
    statistics, level = _first_guess(solver.flat, options)
    statistics_modes = min(_STATISTICS_MODES, options.num_modes)
    current: Problem | None = None
    for num_modes in _FIRST_MODES:
        wavy, *_ = solver.solve(
            current, statistics, level, min(num_modes, options.num_modes), stage="Waves", joint=True, wide=True
        )
        current = wavy.problem
    assert current is not None
    # Only now: statistics of a solution that is still far from its minimum would lead it astray.
    statistics, level = _updated(wavy, statistics, options, settings.num_threads)
    if options.wavelength is None and options.wavelength_in_depths is None:
        statistics, current = _choose_wavelength(solver, current, statistics, level, options)
    for _ in range(_NUM_STATISTICS):
        wavy, *_ = solver.solve(current, statistics, level, statistics_modes, stage="Wave statistics", joint=True)
        current = wavy.problem
        before = statistics
        counted(watch, "Wave statistics, update")(0, 1)
        statistics, level = _updated(wavy, statistics, options, settings.num_threads)
        if abs(np.log(statistics.slope_deviation / before.slope_deviation)) < _STAYS:
            break
    if _effect(wavy.problem) < _MATTERS * statistics.noise:
        raise Unsupported("The surface shows no waves")
    wavy, *_ = solver.solve(current, statistics, level, options.num_modes, stage="Waves", joint=False)
    if few[keep].all():
        return _frozen_rounds(solver, wavy.problem, statistics, level)
    whole = _Solver(_part(start, keep), options, settings, watch)
    wavy, *_ = whole.solve(
        spread_waves(wavy, whole.flat, counted(watch, "Waves, all observations")),
        statistics,
        level,
        options.num_modes,
        stage="Waves",
        joint=True,
    )
    return _frozen_rounds(whole, wavy.problem, statistics, level)


def _effect(problem: Problem) -> float:
    """How far the waves move a keypoint, px: root mean square of what the surfaces do at the solution."""
    effects = np.einsum("nak,nk->na", surface_effects(problem) @ problem.tracks.waves,
                        problem.state.waves[problem.tracks.image])  # fmt: skip
    return float(np.sqrt((effects**2).mean()))


def _frozen_rounds(
    solver: _Solver, current: Problem, statistics: WaveStatistics, level: LevelPrior | None
) -> SoftSolution:
    """The last solves: the waves' effects as they stand, and looked up anew until they stay."""
    change, solved = np.inf, None
    for number in range(_MOST_FROZEN):
        # The effects of all observations: not kept beside the next round's.
        solved = None
        fine = change < _NEARLY * _SETTLED or number == _MOST_FROZEN - 1
        wavy, adjustment, solved = solver.solve(
            current, statistics, level, solver.options.num_modes, stage=f"Waves, round {number + 1}", joint=False,
            fine=fine,
        )  # fmt: skip
        change = _change(current, wavy.problem)
        current = wavy.problem
        if fine and number > 0 and change < _SETTLED:
            break
    assert solved is not None
    return SoftSolution(wavy=wavy, statistics=statistics, level=level, adjustment=adjustment, solved=solved)


def go_on(
    start: Problem,
    everywhere: Problem,
    keep: NDArray[np.bool_],
    soft: SoftSolution,
    settings: SolverSettings,
    watch: Watch | None,
) -> SoftSolution:
    """The last solves again, with other observations.

    Args:
        start: of all observations, without waves.
        everywhere: all observations at the solution, with waves.
        keep: (N,) those that take part now.
        soft: the solution so far.
        settings, watch: as for `solve_soft`.
    """
    options = WaveOptions(
        slope_deviation=None, wavelength=None, wavelength_in_depths=None, level_prior=soft.level is not None, tilt=None,
        lift=None, num_modes=soft.wavy.problem.num_waves,
    )  # fmt: skip
    solver = _Solver(_part(start, keep), options, settings, watch)
    return _frozen_rounds(solver, _part(everywhere, keep), soft.statistics, soft.level)


def settle_everywhere(start: Problem, soft: SoftSolution, watch: Watch | None = None) -> Problem:
    """All observations at a solution of some, weighted as those are."""
    solved = soft.wavy.problem
    flat = replace(start, held=solved.held, wave_prior=None, level_prior=None)
    on_image = counted(watch, "Waves, all observations")
    spread = spread_waves(soft.wavy, flat, on_image)
    wavy = with_waves(flat, soft.statistics, solved.num_waves, spread, on_image)
    return replace(wavy.problem, loss=solved.loss, loss_scale=solved.loss_scale)


def filter_waves(arrangement: Arrangement, problem: Problem, noise: float) -> Filtered:
    """Mark what to remove at a solution with waves.

    Where slopes are left that the surface cannot take, an error counts less: what is compared with the limit is the
    error over what the waves add to the keypoint's own noise (px). Where that is large, so is the limit.
    """
    options = arrangement.options
    angles = filter_observations(
        problem, arrangement.observations, max_reproj_error=0.0, min_tri_angle=options.min_tri_angle
    )
    large = np.zeros(len(problem.tracks.image), dtype=np.bool_)
    if options.filter_max_reproj_error > 0:
        limit = max(options.filter_max_reproj_error, _LOSS_SCALE_IN_NOISE * noise)
        large = np.linalg.norm(residuals(problem), axis=1) > limit
    return Filtered(keep=angles.keep & ~large, num_large_error=int(large.sum()), num_small_angle=angles.num_small_angle)


def check_support(arrangement: Arrangement, keep: NDArray[np.bool_]) -> None:
    """Raises Unsupported where images see too few points for a surface of their own."""
    structure = arrangement.structure
    counts = np.bincount(arrangement.observations.image[keep], minlength=structure.num_images)
    poor = (counts < MIN_OBSERVATIONS) & (structure.image_plane >= 0)
    if poor.mean() > 0.5:
        raise Unsupported(
            f"Waves are not determined: {int(poor.sum())} of {structure.num_images} images see fewer than "
            f"{MIN_OBSERVATIONS} points"
        )


def _part(start: Problem, keep: NDArray[np.bool_]) -> Problem:
    """The problem of some observations, of points that keep two or more."""
    lengths = np.diff(start.tracks.start)
    counts = np.add.reduceat(keep.astype(np.int64), start.tracks.start[:-1])
    stays = counts >= 2
    keep = keep & np.repeat(stays, lengths)
    first = np.concatenate([[0], np.cumsum(counts[stays])]).astype(np.int64)
    return replace(start, tracks=start.tracks.take(first, keep), points=start.points[stays])


def _first_guess(flat: Problem, options: WaveOptions) -> tuple[WaveStatistics, LevelPrior | None]:
    slope = options.slope_deviation or float(_FIRST_SLOPE)
    wavelength = options.wavelength or _FIRST_WAVELENGTH * _width(flat)
    statistics = WaveStatistics(slope_deviation=slope, wavelength=wavelength, noise=_FIRST_NOISE)
    if not options.level_prior:
        return statistics, None
    tilt = options.tilt if options.tilt is not None else float(_FIRST_TILT)
    lift = options.lift if options.lift is not None else _FIRST_LIFT
    return statistics, LevelPrior(tilt=tilt, lift=lift, noise=_FIRST_NOISE)


def _distance_in_depths(problem: Problem) -> float:
    """Median distance of the interfaces over the median depth of the points."""
    points, *_ = in_cameras(problem)
    _, distance = problem.state.planes_in_cam(problem.structure)
    return float(np.nanmedian(distance) / np.median(points[:, 2]))


def _width(flat: Problem) -> float:
    """Typical width of the part of its surface that an image sees, over the distance."""
    normal, _ = flat.state.planes_in_cam(flat.structure)
    tracks = flat.tracks
    widths = []
    for image in np.unique(tracks.image[tracks.wet]).tolist():
        rays = tracks.direction[(tracks.image == image) & tracks.wet]
        foot = rays / (rays @ normal[image])[:, None]
        spread = foot - foot.mean(axis=0)
        widths.append(np.sqrt((spread**2).sum(axis=1).mean()) * np.sqrt(6.0))
    return float(np.median(widths))


def _updated(
    wavy: Wavy, statistics: WaveStatistics, options: WaveOptions, num_threads: int
) -> tuple[WaveStatistics, LevelPrior | None]:
    given = options.slope_deviation is not None
    before = wavy.problem.level_prior
    statistics, level = estimate_statistics(wavy.problem, statistics, given_slope=given, num_threads=num_threads)
    if level is not None and before is not None:
        level = replace(
            level,
            tilt=before.tilt if options.tilt is not None else level.tilt,
            lift=before.lift if options.lift is not None else level.lift,
        )
    return statistics, level


def _choose_wavelength(
    solver: _Solver, current: Problem, statistics: WaveStatistics, level: LevelPrior | None, options: WaveOptions
) -> tuple[WaveStatistics, Problem]:
    """The wavelength, up to a factor of two, that makes the data most probable."""
    tried: dict[float, tuple[float, Problem]] = {}
    num_modes = min(_STATISTICS_MODES, options.num_modes)

    def judge(wavelength: float) -> float:
        if wavelength not in tried:
            changed = replace(statistics, wavelength=wavelength)
            wavy, *_ = solver.solve(current, changed, level, num_modes, stage="Wavelength", joint=True, iterations=6)
            whitening = np.linalg.norm(wavy.problem.tracks.metric, axis=(1, 2))
            before = np.linalg.norm(solver.flat.tracks.metric, axis=(1, 2))
            log_whitening = 2.0 * float(np.log(whitening / before).sum())
            threads = solver.settings.num_threads
            counted(solver.watch, "Wavelength, evidence")(0, 1)
            evidence = log_evidence(wavy.problem, statistics.noise, log_whitening, threads)
            tried[wavelength] = evidence, wavy.problem
        return tried[wavelength][0]

    best = statistics.wavelength
    for _ in range(_MOST_SCALINGS):
        found = max([best, *(factor * best for factor in _SCALES)], key=judge)
        if found == best:
            break
        best = found
    logger.info("wavelength %.3g of the interface distance", best)
    return replace(statistics, wavelength=best), tried[best][1]


def _change(before: Problem, after: Problem) -> float:
    """How far the points moved between two rounds, over the noise in px, root mean square."""
    moved: Array = _pixels_between(before, after)
    noise = after.wave_prior[0, 0, 0] if after.wave_prior is not None and after.num_waves else 1.0
    return float(np.sqrt(np.mean(np.minimum(moved, 10.0 * noise) ** 2)) / noise)


def _pixels_between(before: Problem, after: Problem) -> Array:
    change = predicted_directions(after) - predicted_directions(before)
    return np.asarray(np.linalg.norm(np.einsum("nij,nj->ni", after.tracks.metric, change), axis=1))
