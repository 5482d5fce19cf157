"""The soft constraint at scale: a solution with waves on every surface, from a start that knows of none."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import Adjustment, SolverSettings, adjust
from colmap_refract.estimator.chunk import LevelPrior, Problem
from colmap_refract.interface import Array, plane_in_cam
from colmap_refract.refiner.arrangement import Arrangement, select_tracks
from colmap_refract.refiner.continuation import Watch, counted, is_sound, named, residuals, retriangulate
from colmap_refract.refiner.filtering import Filtered, filter_observations, in_cameras, predicted_directions
from colmap_refract.refiner.start import image_depths, viewing_directions, world_plane
from colmap_refract.refiner.wave_statistics import estimate_statistics, log_evidence, raw_residuals
from colmap_refract.refiner.waves import WaveStatistics, Wavy, between, frozen, spread_waves, with_waves

logger = logging.getLogger(__name__)

_START_RATIO = 0.4
"""Distance over depth of the level plane that a moving interface starts from; the outcome does not depend on it."""
_FEW_OBSERVATIONS = 400
"""Per image, of the tracks that statistics and a first solution are found with."""
_FIRST_MODES = ((), (6, 10, 16))
"""Of the first solves of a swell. With many modes at once a surface can follow wrong matches before the rest is where
it belongs; with few to begin with, steep waves are not followed. Both are tried."""
_STATISTICS_MODES = 24
_FIRST_TILT, _FIRST_LIFT = np.radians(4.0), 0.1
_FIRST_WAVES = (
    WaveStatistics(wavelength=2.0, slope_deviation=np.tan(np.radians(6.0)), noise=0.5, unresolved=0.1),
    WaveStatistics(wavelength=0.1, slope_deviation=np.tan(np.radians(4.0)), noise=0.5),
)
"""A swell, and ripples; wavelengths over the width of what an image sees of its surface. Longer waves than that are
tilts of its plane. A swell that is thought to be steeper than it is is found; one that is thought to be flat may not.
What is left of a smooth surface is noise rather than slopes."""
_CHOP = (0.4, 0.2)
"""Wavelengths over the same width of what is between the two, and sought from a solution with ripples."""
_SCALES = (1.4, 0.5)
"""By which the wavelength of a swell is changed while the data become more probable."""
_FIRST_SLOPE_AT_REST = np.tan(np.radians(2.0))
"""For cameras whose poses are held: there the waves alone tell the depth of the water."""
_SHORTEST_RESOLVED = 0.15
"""Over the same width: some tens of modes say next to nothing of shorter waves, which all count as noise."""
_STILL = np.tan(np.radians(0.01))
"""Slope deviation of water that is as good as flat."""
_MOST_SCALINGS = 3
_EXPLAINED = 0.7
"""Median residual, px, of a swell that needs no ripples."""
_MOST_ITERATIONS = 30
_FINER = 1e-8
"""Function tolerance: the design changes between solves."""
_FAR, _NEAR = 1e4, 1e6
"""Radii of the first trust region, before there is a solution and from one: smaller ones double the iterations."""
_MOST_FIRST, _NUM_WIDE, _MOST_BETWEEN, _NUM_UPDATES = 6, 2, 4, 3
"""Solves with a guess of the statistics, until the points stay, and those of them with a wide loss; solves between two
updates of the statistics, and updates."""
_STAYS = 0.15
"""Relative change of the slope deviation that ends the search for it."""
_SETTLED, _HOPELESS = 0.3, 5.0
"""Noise deviations by which predicted keypoints still move between solves, and by which they move where there is no
solution to come to."""
_MOST_LAST, _CLOSE, _UNSETTLED = 8, 0.1, 2.0
"""Last solves, at most; noise deviations by which predicted keypoints move between two of them in the end, and by which
they may not. With a slope of 4 degrees it took 3 to 8."""
_LOOSER = 5.0
"""How much wider the level prior is where waves are not resolved, and in the last solves. What is known of the planes
is worth a few per cent, but draws the interface towards where the planes need to scatter less."""
_FAR_OFF = 10.0
"""Noise deviations; a point that moves by more counts as if it moved by so much."""
_SHORTEST_STEP = 0.2
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
        free_slopes: as of `WaveStatistics`.
    """

    slope_deviation: float | None
    wavelength: float | None
    wavelength_in_depths: float | None
    level_prior: bool
    tilt: float | None
    lift: float | None
    num_modes: int
    free_slopes: bool

    @property
    def knows_wavelength(self) -> bool:
        """Whether the user said the wavelength, in either measure."""
        return self.wavelength is not None or self.wavelength_in_depths is not None


@dataclass(frozen=True, kw_only=True)
class Round:
    """One solve.

    Attributes:
        wavy: at the solution.
        solved: what was solved, at its solution: the waves' effects as they stood.
        adjustment: the solver's word.
        statistics, level: what is known of waves and planes; the level prior of `solved` can be looser.
        moved: noise deviations by which keypoints moved from the solution that the design is of.
    """

    wavy: Wavy
    solved: Problem
    adjustment: Adjustment
    statistics: WaveStatistics
    level: LevelPrior | None
    moved: float = np.inf


@dataclass(frozen=True, kw_only=True)
class SoftSolution:
    """A solution with waves.

    Attributes:
        wavy: the observations that were solved with, at the solution.
        statistics, level: of waves and planes, in the end.
        adjustment: the last.
        solved: what it solved, at its solution: the waves' effects as they stood.
        log_likelihood: log probability of the observations before any were filtered, averaged over the waves, at the
            best of all other unknowns; up to a constant that is that of the observations.
    """

    wavy: Wavy
    statistics: WaveStatistics
    level: LevelPrior | None
    adjustment: Adjustment
    solved: Problem
    log_likelihood: float


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
        free_slopes=options.wave_nodes == "slopes",
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
        self.width = _width(self.flat)
        # With planes that move freely a design at the planes may not settle; with one plane, or one camera, it does,
        # and one at the surfaces drifts along what is hardly determined.
        self.bends = flat.structure.num_planes > 1 and not held.poses.all()

    def solve(
        self,
        current: Problem | None,
        statistics: WaveStatistics,
        level: LevelPrior | None,
        num_modes: int,
        *,
        stage: str,
        wide: bool = False,
        bent: bool = False,
        last: bool = False,
    ) -> Round:
        """One round: the design at the current solution, and a solve; `bent` as for `frozen`.

        While a solution is sought, and `last` is not, the level prior keeps the planes of a swell together.
        """
        if self.options.wavelength_in_depths is not None:
            length = self.options.wavelength_in_depths / _distance_in_depths(self.flat if current is None else current)
            statistics = replace(statistics, wavelength=length)
        _, distance = (self.flat if current is None else current).state.planes_in_cam(self.flat.structure)
        if not (distance[self.flat.structure.image_plane >= 0] > 0).all():
            raise Unsupported("Waves are not determined: with them the interface runs into the cameras")
        if not self.resolves(statistics):
            num_modes = 0
        wavy = with_waves(self.flat, statistics, num_modes, current, counted(self.watch, f"{stage}, surfaces"))
        scale = _LOSS_SCALE_IN_NOISE * statistics.noise
        if wide:
            # Before waves are known, all residuals are large; wrong matches are larger.
            scale = max(scale, _WIDE * float(np.median(np.abs(residuals(wavy.problem)))))
        looser = last or not self.resolves(statistics)
        prior = self._looser(level) if looser and level is not None else level
        problem = replace(wavy.problem, level_prior=prior, loss="cauchy", loss_scale=scale)
        quick = replace(
            self.settings,
            max_num_iterations=min(self.settings.max_num_iterations, _MOST_ITERATIONS),
            function_tolerance=max(self.settings.function_tolerance, _FINER),
            initial_trust_region_radius=_FAR if wide else _NEAR,
        )
        posed = frozen(problem, bent=bent)
        adjustment = adjust(posed, quick, on_progress=named(self.watch, stage))
        finite = np.isfinite(adjustment.state.distance).all() and np.isfinite(adjustment.points).all()
        if adjustment.termination == "failure" or not finite:
            raise Unsupported("Waves are not determined: the solver failed with them")
        found = {"state": adjustment.state, "points": adjustment.points}
        return Round(
            wavy=replace(wavy, problem=replace(problem, **found)),  # type: ignore[arg-type]
            solved=replace(posed, **found),  # type: ignore[arg-type]
            adjustment=adjustment,
            statistics=statistics,
            level=level,
        )

    def resolves(self, statistics: WaveStatistics) -> bool:
        """Whether modes say anything of waves that long."""
        return statistics.wavelength >= _SHORTEST_RESOLVED * self.width

    def _looser(self, level: LevelPrior) -> LevelPrior:
        """A wider level prior, but for what the user said."""
        return replace(
            level,
            tilt=level.tilt * (1.0 if self.options.tilt is not None else _LOOSER),
            lift=level.lift * (1.0 if self.options.lift is not None else _LOOSER),
        )


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
    found = _find_waves(solver)
    if not _shows_waves(solver, found):
        raise Unsupported("The surface shows no waves")
    soft = _last_solves(solver, found.wavy.problem, found.statistics, found.level)
    if few[keep].all():
        return soft
    whole = _Solver(_part(start, keep), options, settings, watch)
    spread = spread_waves(soft.wavy, whole.flat, counted(watch, "Waves, all observations"))
    return _last_solves(whole, spread, soft.statistics, soft.level)


def _find_waves(solver: _Solver) -> Round:
    """The statistics that make the data most probable, at a solution: swell or ripples first, then how long."""
    tried: list[tuple[float, Round]] = []
    failed: Unsupported | None = None
    (swell, *shorter), level = _first_guesses(solver)
    starts = [(swell, first_modes) for first_modes in _FIRST_MODES] + [(statistics, ()) for statistics in shorter]
    firsts: list[Round] = []
    for statistics, first_modes in starts:
        if statistics is not swell and any(_is_explained(found) for _, found in tried):
            continue
        try:
            first = _first_solution(solver, statistics, level, first_modes)
            if statistics is swell and any(_is_the_same(first, other) for other in firsts):
                continue
            firsts.append(first)
            found = _with_statistics(solver, first)
        except Unsupported as unsupported:
            failed = unsupported
            continue
        tried.append((_evidence(solver, found), found))
    if not tried:
        assert failed is not None
        raise failed
    found = tried[-1][1]
    # Planes that move freely take up what little is known of such waves, and run away.
    sought = not solver.bends and not solver.options.knows_wavelength
    if sought and not solver.resolves(found.statistics) and _is_solution(found):
        tried += _chop(solver, found, level)
    best, found = max(tried, key=lambda one: (_is_solution(one[1]), one[0]))
    if not solver.options.knows_wavelength and solver.resolves(found.statistics):
        for factor in _SCALES:
            better = _rescaled(solver, found, best, factor)
            if better is not found:
                found = _with_statistics(solver, better)
                break
        logger.info("wavelength %.3g of the interface distance", found.statistics.wavelength)
    return found


def _chop(solver: _Solver, ripples: Round, level: LevelPrior | None) -> list[tuple[float, Round]]:
    """Solutions with waves that can be resolved in part, from one that takes all for noise."""
    tried = []
    for wavelength in _CHOP:
        statistics = replace(ripples.statistics, wavelength=wavelength * solver.width)
        try:
            first = _settled(solver, ripples.wavy.problem, statistics, level, _MOST_FIRST)
            found = _with_statistics(solver, first)
        except Unsupported:
            continue
        tried.append((_evidence(solver, found), found))
    return tried


def _rescaled(solver: _Solver, found: Round, evidence: float, factor: float) -> Round:
    """The solution with waves that are longer or shorter by a factor, again and again while that is more probable."""
    for _ in range(_MOST_SCALINGS):
        statistics = replace(found.statistics, wavelength=factor * found.statistics.wavelength)
        try:
            other = _solve_once(solver, found.wavy.problem, statistics, found.level)
            if _evidence(solver, other) <= evidence:
                break
            other = _settled(solver, other.wavy.problem, statistics, found.level, _MOST_BETWEEN)
        except Unsupported:
            break
        if not _is_solution(other) or (rescaled := _evidence(solver, other)) <= evidence:
            break
        evidence, found = rescaled, other
    return found


def _solve_once(
    solver: _Solver,
    current: Problem | None,
    statistics: WaveStatistics,
    level: LevelPrior | None,
    *,
    most_modes: int = _STATISTICS_MODES,
    wide: bool = False,
    bent: bool = False,
) -> Round:
    num_modes = min(most_modes, solver.options.num_modes)
    return solver.solve(current, statistics, level, num_modes, stage="Wave statistics", wide=wide, bent=bent)


def _first_solution(
    solver: _Solver, statistics: WaveStatistics, level: LevelPrior | None, first_modes: tuple[int, ...]
) -> Round:
    """A solution with a guess of the statistics."""
    current = None
    # What few modes leave is what the spectrum has there.
    rough = replace(statistics, unresolved=1.0)
    for most_modes in first_modes:
        current = _solve_once(solver, current, rough, level, most_modes=most_modes, wide=True).wavy.problem
    return _settled(solver, current, statistics, level, _MOST_FIRST, num_wide=0 if first_modes else _NUM_WIDE)


def _settled(
    solver: _Solver,
    current: Problem | None,
    statistics: WaveStatistics,
    level: LevelPrior | None,
    most: int,
    num_wide: int = 0,
) -> Round:
    """Solve until the points stay: statistics of a solution that is far from its minimum would lead it astray."""

    def solve(current: Problem | None, number: int, bent: bool) -> Round:
        return _solve_once(solver, current, statistics, level, wide=number < num_wide, bent=bent)

    return _repeated(solve, current, most, _SETTLED, solver.bends)


def _repeated(
    solve: Callable[[Problem | None, int, bool], Round], current: Problem | None, most: int, close: float, bends: bool
) -> Round:
    """Solve, each time with the design at the solution before, until predicted keypoints stay.

    Args:
        solve: from a solution, with the number of the solve, and whether there are surfaces to bend the design by.
        current: to begin with; None: no solution yet.
        most: solves.
        close: noise deviations by which keypoints still move.
        bends: whether surfaces bend the design. Where they lead nowhere it is tried once more without.
    """
    found, straight = _followed(solve, current, most, close, bends)
    if found.moved > _UNSETTLED and straight is not None:
        found = min(found, _followed(solve, straight, most, close, False)[0], key=lambda one: one.moved)
    return found


def _followed(
    solve: Callable[[Problem | None, int, bool], Round], current: Problem | None, most: int, close: float, bends: bool
) -> tuple[Round, Problem | None]:
    """What `_repeated` comes to, and the solution from which the design was bent for the first time.

    Along what is hardly determined a design that is taken too far makes the next one come back too far: how much of
    a step to go follows from two of them (Aitken's relaxation: Irons and Tuck 1969).
    """
    share, last, bent, straight = 1.0, None, False, None
    for number in range(most):
        before = current
        if bent and straight is None:
            straight = before
        found = solve(before, number, bent)
        current = found.wavy.problem
        if before is None:
            continue
        found = replace(found, moved=_change(before, current))
        if found.moved < close:
            break
        # Until then surfaces may be any.
        bent = bends and found.moved < _HOPELESS
        move = _move(before, current)
        if last is not None:
            turned = move - last
            share = float(np.clip(-share * np.vdot(last, turned) / np.vdot(turned, turned), _SHORTEST_STEP, 1.0))
        current, last = between(before, current, share) if share < 1.0 else current, move
    return found, straight


def _is_solution(found: Round) -> bool:
    return found.moved <= _UNSETTLED and is_sound(found.wavy.problem)


def _is_the_same(one: Round, other: Round) -> bool:
    """Whether two settled solutions with the same statistics are one, but for how well they settled."""
    settled = max(one.moved, other.moved) < _SETTLED
    return settled and _change(one.wavy.problem, other.wavy.problem) < 2.0 * _SETTLED


def _is_explained(found: Round) -> bool:
    """Whether a swell leaves nothing for shorter waves."""
    return _is_solution(found) and float(np.median(np.abs(raw_residuals(found.wavy, found.solved)))) < _EXPLAINED


def _with_statistics(solver: _Solver, found: Round) -> Round:
    """Say anew how steep the waves are, and solve again, until that stays; the last that settled, if any does."""
    settled = found
    for _ in range(_NUM_UPDATES):
        if found.moved > _HOPELESS:
            # Of no solution are there statistics.
            break
        before = found.statistics
        counted(solver.watch, "Wave statistics, update")(0, 1)
        statistics, level = _updated(solver, found)
        found = _settled(solver, found.wavy.problem, statistics, level, _MOST_BETWEEN)
        if found.moved <= _UNSETTLED:
            settled = found
        if abs(np.log(statistics.slope_deviation / before.slope_deviation)) < _STAYS:
            break
    # With less noise a surface is steeper, and solutions may come to no end.
    return settled if settled.moved <= _UNSETTLED else found


def _shows_waves(solver: _Solver, found: Round) -> bool:
    """Whether waves make the data more probable than still water does."""
    still = replace(found.statistics, slope_deviation=float(_STILL), unresolved=1.0)
    try:
        flat = _solve_once(solver, found.wavy.problem, still, found.level)
        for _ in range(_NUM_UPDATES):
            statistics, level = estimate_statistics(
                flat.wavy, flat.solved, flat.statistics, given_slope=True, num_threads=solver.settings.num_threads
            )
            flat = _solve_once(solver, flat.wavy.problem, statistics, level)
    except Unsupported:
        # Flat water that comes to no solution explains nothing.
        return True
    return _evidence(solver, found) > _evidence(solver, flat)


def _evidence(solver: _Solver, found: Round) -> float:
    """Log probability of the data with a round's statistics."""
    whitening = float(np.log(np.linalg.det(found.wavy.whiten)).sum())
    return log_evidence(found.solved, found.statistics.noise, whitening, solver.settings.num_threads)


def _last_solves(
    solver: _Solver, current: Problem, statistics: WaveStatistics, level: LevelPrior | None
) -> SoftSolution:
    """With all modes, until the points stay."""

    def solve(current: Problem | None, number: int, bent: bool) -> Round:
        return solver.solve(
            current, statistics, level, solver.options.num_modes, stage=f"Waves, solve {number + 1}",
            wide=number == 0, bent=bent, last=True,
        )  # fmt: skip

    found = _repeated(solve, current, _MOST_LAST, _CLOSE, solver.bends)
    if solver.bends and solver.resolves(statistics):
        flat = _repeated(solve, found.wavy.problem, _MOST_LAST, _CLOSE, False)
        found = max(found, flat, key=lambda one: (one.moved <= _UNSETTLED, _evidence(solver, one)))
    if found.moved > _UNSETTLED:
        raise Unsupported("Waves are not determined: solutions with them do not settle")
    return SoftSolution(
        wavy=found.wavy, statistics=found.statistics, level=level, adjustment=found.adjustment, solved=found.solved,
        log_likelihood=_evidence(solver, found),
    )  # fmt: skip


def go_on(
    start: Problem,
    keep: NDArray[np.bool_],
    soft: SoftSolution,
    options: WaveOptions,
    settings: SolverSettings,
    watch: Watch | None,
) -> SoftSolution:
    """The last solve again, with fewer observations.

    Args:
        start: of all N observations, without waves.
        keep: (N,) those that take part now.
        soft: the solution so far, with all of them.
        options, settings, watch: as for `solve_soft`.
    """
    solver = _Solver(_part(start, keep), options, settings, watch)
    last = _last_solves(solver, _part(soft.wavy.problem, keep), soft.statistics, soft.level)
    return replace(last, log_likelihood=soft.log_likelihood)


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


def _first_guesses(solver: _Solver) -> tuple[list[WaveStatistics], LevelPrior | None]:
    """What to start from: each of the waves may end in another minimum."""
    options = solver.options
    level = None
    if options.level_prior:
        tilt = options.tilt if options.tilt is not None else float(_FIRST_TILT)
        lift = options.lift if options.lift is not None else _FIRST_LIFT
        level = LevelPrior(tilt=tilt, lift=lift, noise=_FIRST_WAVES[0].noise)
    waves = [
        replace(statistics, wavelength=statistics.wavelength * solver.width, free_slopes=options.free_slopes)
        for statistics in _FIRST_WAVES
    ]
    if options.knows_wavelength:
        # In depths it is put into distances at each solve.
        waves = [waves[0] if options.wavelength is None else replace(waves[0], wavelength=options.wavelength)]
    slope = options.slope_deviation
    if slope is None and solver.flat.held.poses.all():
        slope = float(_FIRST_SLOPE_AT_REST)
    if slope is not None:
        waves = [replace(statistics, slope_deviation=slope) for statistics in waves]
    return waves, level


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


def _updated(solver: _Solver, found: Round) -> tuple[WaveStatistics, LevelPrior | None]:
    options = solver.options
    statistics, level = estimate_statistics(
        found.wavy,
        found.solved,
        found.statistics,
        given_slope=options.slope_deviation is not None,
        num_threads=solver.settings.num_threads,
    )
    before = found.level
    if not solver.resolves(found.statistics):
        level = before
    elif level is not None and before is not None:
        level = replace(
            level,
            tilt=before.tilt if options.tilt is not None else level.tilt,
            lift=before.lift if options.lift is not None else level.lift,
        )
    return statistics, level


def _change(before: Problem, after: Problem) -> float:
    """How far the points moved between two rounds, over the noise in px, root mean square."""
    return float(np.sqrt((_move(before, after) ** 2).sum(axis=1).mean()))


def _move(before: Problem, after: Problem) -> Array:
    """(N, 2) by how much predicted keypoints moved, over the noise; no farther than `_FAR_OFF`."""
    noise = after.wave_prior[0, 0, 0] if after.wave_prior is not None and after.num_waves else 1.0
    change = predicted_directions(after) - predicted_directions(before)
    moved = np.einsum("nij,nj->ni", after.tracks.metric, change) / noise
    length = np.linalg.norm(moved, axis=1, keepdims=True)
    return np.asarray(moved * (_FAR_OFF / np.maximum(length, _FAR_OFF)))
