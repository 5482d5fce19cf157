"""From a model that ignored refraction to the minimum: a start that is tried on few tracks, then all of them.

The refraction-ignoring solution lies far from the true one, and a robust loss of a pixel or a plane let loose
at once can lead from it into corners: a plane that runs into the camera, or beyond all points, where nothing is
refracted any more. So the planes are held at first while poses and points settle behind them, under a loss that
is wide; the planes are freed, the noise is read off, and only then the user's robust loss is applied. Several
start distances compete, on a few tracks per image, where that costs little.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_refract.estimator import elimination
from colmap_refract.estimator.adjustment import Adjustment, Progress, SolverSettings, adjust, part_done, settle_points
from colmap_refract.estimator.chunk import Problem, robust_cost
from colmap_refract.estimator.triangulation import triangulate
from colmap_refract.interface import Array
from colmap_refract.options import Loss
from colmap_refract.refiner.arrangement import Arrangement, select_tracks
from colmap_refract.refiner.filtering import in_cameras, label_wet, noise
from colmap_refract.refiner.start import start_planes, world_plane

logger = logging.getLogger(__name__)

Watch = Callable[[str, Progress], None]

_TRACKS_PER_IMAGE = 60
_WIDE_LOSS = 4.0
"""Least scale, px, of the Cauchy loss on the way."""
_ANCHORS = (1e6, 1.0, 1e-2, 1e-4, 0.0)
"""Proximal weights, in units of a point's own curvature, for a camera that does not move."""
_ACROSS = 1e-3
"""Proximal weight that keeps a point's depth, which no parallax tells, and leaves it free across its rays."""
_PLANE_DEVIATIONS = (0.1, 1.0, 10.0)
"""Of normal priors on moving planes, radians and units of the solve for residuals of one px, let loose in turn."""
_OPEN_RATIOS = (0.5, 0.15)
_NARROW_RATIOS = (0.5, 0.15, 0.3, 0.8)
_HOUSING_RATIOS = (0.02, 0.2)
_PLAUSIBLE_NOISE = 1.0
"""Pixels, of a keypoint's coordinate: larger residuals let one try another start."""
NARROW_VIEW_DEG = 20.0
_CLEARLY_LESS = 0.9
_MAX_TURNS = 3
_MAX_RELABELS = 6
_NEGLIGIBLE_PART = 1e-3
_CLEARLY = 5.0
"""Times the noise: how much better a point must fit to be taken to be dry."""
MIN_DISTANCE = 1e-4
"""Of the median depth: a plane nearer than this has run into the camera."""
MIN_WET = 0.05
"""Part of the observations: with fewer behind their planes, the solution is the dry one."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where a start distance led to on the chosen tracks.

    Attributes:
        ratio: distance over median depth that it started from.
        problem: with state and points as far as they came.
        cost: of the wide loss.
        sound: whether the planes stand between cameras and points.
    """

    ratio: float
    problem: Problem
    cost: float
    sound: bool


def find_start(arrangement: Arrangement, settings: SolverSettings, watch: Watch | None) -> Start:
    """The best of several start distances, on a selection of tracks; from the options' own if they give one.

    The first that leads to planes between cameras and points, and to residuals as small as keypoints are good,
    is taken; the minimum behind it is the same.

    Raises:
        KeyboardInterrupt: Ctrl-C during a solve.
    """
    observations, scenario = arrangement.observations, arrangement.options.scenario
    plausible = _PLAUSIBLE_NOISE
    few = observations.select(select_tracks(observations, _TRACKS_PER_IMAGE, arrangement.options.random_seed))
    if arrangement.ratio is not None:
        ratios: tuple[float, ...] = (arrangement.ratio,)
    else:
        ratios = _HOUSING_RATIOS if scenario == "camera_housing" else _OPEN_RATIOS
        # Moving planes in a narrow view have many minima, all with small residuals: only the least will do.
        if view_deg(arrangement.start(ratios[0], few)) < NARROW_VIEW_DEG and scenario == "moving_interface":
            ratios, plausible = _NARROW_RATIOS, 0.0
    starts = []
    for ratio in ratios:
        start = _try(arrangement, arrangement.start(ratio, few), ratio, settings, watch)
        if start is not None:
            start = _ashore(start, _through(settings), named(watch, "Dry points"))
            starts.append(start)
            logger.debug("start at %.3g of the depth: cost %.6g, sound %s", ratio, start.cost, start.sound)
            if start.sound and estimate_noise(start.problem) < plausible:
                break
    if not starts:
        raise FloatingPointError("no start value could be evaluated")
    return min(starts, key=lambda start: (not start.sound, start.cost))


def _try(
    arrangement: Arrangement, problem: Problem, ratio: float, settings: SolverSettings, watch: Watch | None
) -> Start | None:
    """Follow one start distance to its minimum: planes held, then free; None where no way was found."""
    on_progress = named(watch, f"Start at {ratio:.3g} of the depth")
    settings = _through(settings)
    if arrangement.options.scenario == "fixed_camera":
        return _fixed_camera(problem, ratio, settings, on_progress)
    if arrangement.options.scenario == "moving_interface":
        common = _from_common_plane(arrangement, problem, ratio, True, settings, on_progress)
        start = None if common is None else _let_loose(common, ratio, settings, on_progress)
        if view_deg(problem) < NARROW_VIEW_DEG:
            # A common plane may come out far from the moving ones: from where it stood at first, too.
            common = _from_common_plane(arrangement, problem, ratio, False, settings, on_progress)
            other = None if common is None else _let_loose(common, ratio, settings, on_progress)
            better = other is not None and other.sound and (start is None or other.cost < _CLEARLY_LESS * start.cost)
            start = other if better else start
        if start is not None:
            return start
    elif not _stands(problem):
        unbent = _unbend(problem, ratio, settings, on_progress)
        if unbent is None:
            return None
        problem = unbent
    return _settle_and_free(problem, ratio, settings, on_progress)


def _through(settings: SolverSettings) -> SolverSettings:
    """As far as a start has to be carried."""
    return replace(settings, max_num_iterations=min(60, settings.max_num_iterations), function_tolerance=1e-6)


def view_deg(problem: Problem) -> float:
    """Full angle of the view that the keypoints fill, by and large, degrees."""
    return 2.0 * float(np.degrees(np.arccos(np.clip(np.quantile(problem.tracks.direction[:, 2], 0.05), -1.0, 1.0))))


def _settle_and_free(
    problem: Problem, ratio: float, settings: SolverSettings, on_progress: Callable[[Progress], None] | None
) -> Start | None:
    """Solve behind planes that stand still, then let them tilt, then with everything free."""
    quick = replace(settings, max_num_iterations=min(25, settings.max_num_iterations), function_tolerance=1e-3)
    all_planes = np.ones_like(problem.held.normals)
    standing = replace(problem.held, normals=all_planes, distances=all_planes, index=True, lens=True)
    tilting = replace(problem.held, distances=all_planes, index=True, lens=True)
    problem = retriangulate(_widened(problem))
    # A plane with a wrong normal would rather run into the camera than tilt: the distance is freed last.
    for held in (standing, tilting):
        problem = _widened(problem)
        settled = adjust(replace(problem, held=held), quick, on_progress=on_progress)
        if settled.termination != "failure":
            problem = replace(problem, state=settled.state, points=settled.points)
    problem = _widened(problem)
    freed = adjust(problem, settings, on_progress=on_progress)
    return _turned_over(problem, ratio, freed, settings, on_progress)


def _from_common_plane(
    arrangement: Arrangement,
    problem: Problem,
    ratio: float,
    tilting: bool,
    settings: SolverSettings,
    on_progress: Callable[[Progress], None] | None,
) -> Problem | None:
    """A start for planes of their own: all images share one for a while.

    Moving interfaces scatter about one plane of the world more often than not (water is level on average), and
    an image's own plane, let loose at once, can run into its camera.
    """
    structure = problem.structure
    wet = structure.image_plane >= 0
    common = replace(
        structure,
        image_plane=np.where(wet, 0, -1),
        plane_in_world=np.ones(1, dtype=np.bool_),
        plane_anchor=np.zeros((1, 3)),
    )
    normal, distance = start_planes(arrangement.observations, common, ratio, arrangement.normal, arrangement.reference)
    free = np.array([not tilting])
    tied = replace(
        problem,
        structure=common,
        state=replace(problem.state, normal=normal, distance=distance),
        held=replace(problem.held, normals=free, distances=free, index=True, lens=True),
    )
    if not _stands(tied):
        return None
    solved = _settle_and_free(tied, ratio, settings, on_progress)
    if solved is None:
        return None
    state = solved.problem.state
    cam_normal, cam_distance = state.planes_in_cam(common)
    normal, distance = problem.state.normal.copy(), problem.state.distance.copy()
    for block in range(structure.num_planes):
        image = int(np.flatnonzero(structure.image_plane == block)[0])
        normal[block], distance[block] = cam_normal[image], cam_distance[image]
        if structure.plane_in_world[block]:
            normal[block] = state.normal[0]
            distance[block] = state.distance[0] - state.normal[0] @ structure.plane_anchor[block]
    normal = np.where(problem.held.normals[:, None], problem.state.normal, normal)
    distance = np.where(problem.held.distances, problem.state.distance, distance)
    return replace(problem, state=replace(state, normal=normal, distance=distance), points=solved.problem.points)


def _start(problem: Problem, ratio: float, adjustment: Adjustment) -> Start | None:
    if not np.isfinite(adjustment.cost) or adjustment.cost < 0:
        return None
    problem = replace(problem, state=adjustment.state, points=adjustment.points)
    return Start(ratio=ratio, problem=problem, cost=_wide_cost(problem), sound=is_sound(problem))


def _let_loose(
    problem: Problem, ratio: float, settings: SolverSettings, on_progress: Callable[[Progress], None] | None
) -> Start | None:
    """Planes freed little by little: a tilt and a turn of the camera look alike in a narrow view, and a plane
    that is free at once leaves with the one for the other."""
    for deviation in _PLANE_DEVIATIONS:
        problem = _widened(problem)
        adjusted = adjust(problem, settings, plane_deviations=(deviation, deviation), on_progress=on_progress)
        if adjusted.termination == "failure":
            return None
        problem = replace(problem, state=adjusted.state, points=adjusted.points)
    problem = _widened(problem)
    freed = adjust(problem, settings, on_progress=on_progress)
    return _turned_over(problem, ratio, freed, settings, on_progress)


def _turned_over(
    problem: Problem,
    ratio: float,
    adjustment: Adjustment,
    settings: SolverSettings,
    on_progress: Callable[[Progress], None] | None,
) -> Start | None:
    """The outcome of an adjustment, with planes that ended behind their points turned over if that is better.

    A tilt shifts an image by about the tilt times the depth of the water: behind the points, with the opposite
    tilt, a plane imitates the one before them, and the solver may come out on the wrong side.
    """
    best = _start(problem, ratio, adjustment)
    for _ in range(_MAX_TURNS):
        if best is None:
            return None
        mirrored = _mirrored(best.problem)
        if mirrored is None:
            break
        mirrored = _widened(retriangulate(mirrored))
        turned = _start(mirrored, ratio, adjust(mirrored, settings, on_progress=on_progress))
        if turned is None or turned.cost >= best.cost:
            break
        best = turned
    return best


def _ashore(start: Start, settings: SolverSettings, on_progress: Callable[[Progress], None] | None) -> Start:
    """The start with the points that are better seen straight taken to be dry, and solved again until that settles.

    A plane that was found with dry points among the wet ones stands in the wrong place to tell them apart, so
    at first the fit decides, not the side.
    """
    problem = start.problem
    if label_wet(problem)[problem.tracks.wet].all():
        return start
    for _ in range(_MAX_RELABELS):
        wet = _wet_by_fit(problem)
        if (wet != problem.tracks.wet).mean() <= _NEGLIGIBLE_PART or not wet.any():
            break
        problem = _widened(retriangulate(replace(problem, tracks=problem.tracks._replace(wet=wet))))
        adjusted = adjust(problem, settings, on_progress=on_progress)
        if adjusted.termination == "failure":
            return start
        problem = replace(problem, state=adjusted.state, points=adjusted.points)
    return replace(start, problem=problem, cost=_wide_cost(problem), sound=is_sound(problem))


def label_by_fit(problem: Problem, *, doubtful: bool = False) -> NDArray[np.bool_]:
    """Which observations (N,) look into the water, as far as the fit tells.

    A plane that is not yet right, or not determined, cuts through points that are wet; only what is clearly
    better seen straight is taken to be dry. Nothing is, unless a point lies before its plane or `doubtful`.
    """
    refracted = problem.structure.image_plane[problem.tracks.image] >= 0
    if not doubtful and label_wet(problem)[refracted].all():
        return refracted
    return _wet_by_fit(problem)


def _wet_by_fit(problem: Problem) -> NDArray[np.bool_]:
    """Which observations (N,) are of points that do not fit clearly better straight than through the interface."""
    refracted = problem.structure.image_plane[problem.tracks.image] >= 0
    costs = []
    for wet in (refracted, np.zeros_like(refracted)):
        trial = retriangulate(replace(problem, tracks=problem.tracks._replace(wet=wet)))
        trial = replace(trial, points=settle_points(trial, SolverSettings()))
        costs.append(_point_costs(trial))
    # Where both fit, as in a narrow view, noise must not decide.
    clearly_dry = costs[0] - costs[1] > (_CLEARLY * estimate_noise(problem)) ** 2
    return np.asarray(refracted & np.repeat(~clearly_dry, np.diff(problem.tracks.start)))


def _mirrored(problem: Problem) -> Problem | None:
    """Planes that most of their points lie before are mirrored at those; None if there are none, or only such."""
    structure, state = problem.structure, problem.state
    points, normals, distances = in_cameras(problem)
    behind = np.einsum("ni,ni->n", points, normals) - distances - sum(problem.layers.thickness)
    block = structure.image_plane[problem.tracks.image]
    median = np.array(
        [np.median(behind[block == b]) if (block == b).any() else 1.0 for b in range(structure.num_planes)]
    )
    wrong = (median < 0.0) & ~problem.held.normals & ~problem.held.distances
    if not wrong.any() or wrong.all():
        return None
    rotation, _ = state.cam_from_world(structure)
    to_world = np.array([rotation[int(np.flatnonzero(structure.image_plane == b)[0])].T for b in range(len(wrong))])
    to_world[structure.plane_in_world] = np.eye(3)
    in_world = np.einsum("bij,bj->bi", to_world, state.normal)
    mirrored = 2.0 * in_world[~wrong].mean(axis=0) - in_world
    mirrored = np.einsum("bji,bj->bi", to_world, mirrored / np.linalg.norm(mirrored, axis=1)[:, None])
    normal = np.where(wrong[:, None], mirrored, state.normal)
    distance = np.where(wrong, state.distance + 2.0 * median, state.distance)
    flipped = replace(problem, state=replace(state, normal=normal, distance=distance))
    return flipped if _stands(flipped) else None


def _wide_cost(problem: Problem) -> float:
    """The cost at the problem's state, under the same loss whatever it was solved with."""
    return float(robust_cost((residuals(problem) ** 2).sum(axis=1), "cauchy", _WIDE_LOSS).sum())


def is_sound(problem: Problem) -> bool:
    """Whether every plane stands clear of its cameras and, by and large, before its points."""
    _, distance = problem.state.planes_in_cam(problem.structure)
    wet = label_wet(problem)
    refracted = problem.structure.image_plane[problem.tracks.image] >= 0
    return bool(np.nanmin(distance) > MIN_DISTANCE and wet[refracted].mean() > MIN_WET)


def _stands(problem: Problem) -> bool:
    """Whether every camera is on the dry side of its plane."""
    _, distance = problem.state.planes_in_cam(problem.structure)
    return bool((distance[np.isfinite(distance)] > 0.0).all())


def retriangulate(problem: Problem) -> Problem:
    """The problem with each point where it is, or where its refracted rays meet if that costs less.

    A robust cost has several minima; wrong matches, and positions from another geometry, lead to the wrong one.
    """
    if problem.held.points:
        return problem
    layers = problem.layers.with_index(problem.state.index)
    meeting = triangulate(problem.tracks, problem.structure, problem.state, layers, problem.points)
    here, there = (_point_costs(replace(problem, points=points)) for points in (problem.points, meeting))
    return replace(problem, points=np.where((here <= there)[:, None], problem.points, meeting))


def _point_costs(problem: Problem) -> Array:
    """Robust cost (P,) of each point where it is."""
    squared = (residuals(problem) ** 2).sum(axis=1)
    each = robust_cost(squared, problem.loss, problem.loss_scale)
    return np.asarray(np.add.reduceat(each, problem.tracks.start[:-1]))


def _widened(problem: Problem, loss: Loss = "cauchy") -> Problem:
    """The problem under a loss wide enough for its residuals as they are."""
    spread = float(np.median(np.linalg.norm(residuals(problem), axis=1)))
    return replace(problem, loss=loss, loss_scale=max(_WIDE_LOSS, 3.0 * spread) if np.isfinite(spread) else 100.0)


def residuals(problem: Problem) -> Array:
    """Residuals (N, 2) in px at the problem's state and points."""
    out = np.empty((len(problem.tracks.image), 2))
    elimination.residuals(problem.points, problem.tracks, problem.views, problem.optics, out)
    return out


def _unbend(
    problem: Problem,
    ratio: float,
    settings: SolverSettings,
    on_progress: Callable[[Progress], None] | None,
) -> Problem | None:
    """A start for world planes where the model is so bent that none fits between its cameras and its points.

    Every image gets a plane of its own for a while, which takes the bend away; the shared planes are
    then fitted to those.
    """
    structure = problem.structure
    own = replace(
        structure,
        image_plane=np.where(structure.image_plane >= 0, np.arange(structure.num_images), -1),
        plane_in_world=np.zeros(structure.num_images, dtype=np.bool_),
        plane_anchor=np.zeros((structure.num_images, 3)),
    )
    count = structure.num_images
    state = replace(problem.state, normal=np.tile([0.0, 0.0, 1.0], (count, 1)), distance=np.full(count, ratio))
    held = replace(problem.held, normals=np.zeros(count, bool), distances=np.zeros(count, bool), index=True, lens=True)
    own_planes = replace(problem, structure=own, state=state, held=held)
    loose = _widened(retriangulate(_widened(own_planes)))
    quick = replace(settings, max_num_iterations=25, function_tolerance=1e-4)
    adjusted = adjust(loose, quick, on_progress=on_progress)
    if adjusted.termination == "failure":
        return None
    rotation, translation = adjusted.state.cam_from_world(own)
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    normals = np.einsum("nji,nj->ni", rotation, adjusted.state.normal)
    normal, distance = problem.state.normal.copy(), problem.state.distance.copy()
    for block in range(structure.num_planes):
        images = np.flatnonzero(structure.image_plane == block)
        if structure.plane_in_world[block]:
            found, offset = world_plane(centers[images], normals[images], adjusted.state.distance[images], 1.0)
            normal[block], distance[block] = found, offset - found @ structure.plane_anchor[block]
    straight = replace(
        problem,
        state=replace(adjusted.state, normal=normal, distance=distance),
        points=adjusted.points,
    )
    return straight if _stands(straight) else None


def _fixed_camera(
    problem: Problem,
    ratio: float,
    settings: SolverSettings,
    on_progress: Callable[[Progress], None] | None,
) -> Start | None:
    """Points behind the planes at first; where that is not enough, also from where they are given.

    A narrow view hardly tells a plane's distance until its tilt is right, and has a minimum that only the second
    way avoids.
    """
    start = _untie(_behind_planes(problem, settings), ratio, settings, on_progress)
    plausible = start is not None and start.sound and estimate_noise(start.problem) < _PLAUSIBLE_NOISE
    if plausible and view_deg(problem) >= NARROW_VIEW_DEG:
        return start
    other = _untie(problem, ratio, settings, on_progress)
    found = [each for each in (start, other) if each is not None]
    return min(found, key=lambda each: (not each.sound, each.cost), default=None)


def _untie(
    problem: Problem,
    ratio: float,
    settings: SolverSettings,
    on_progress: Callable[[Progress], None] | None,
) -> Start | None:
    """Equal planes give a fixed camera no parallax, so each point is tied to where it was, less and less."""
    adjusted = None
    for weight in _ANCHORS:
        held = problem.held
        if weight > 0:
            held = replace(held, index=True, lens=True)
        # At first whole images are far off, by their planes' tilt, and no outliers: they must not lose their weight.
        problem = _widened(problem, "huber" if weight >= 1.0 else "cauchy")
        curvature = _curvature(problem)
        if adjusted is None:
            # Tilts first: they are what moves an image as a whole.
            level = replace(problem, held=replace(held, distances=np.ones_like(held.distances)))
            adjusted = adjust(level, settings, anchor_weights=weight * curvature, on_progress=on_progress)
            problem = _widened(replace(problem, state=adjusted.state, points=adjusted.points), "huber")
        freer = replace(problem, held=held)
        adjusted = adjust(freer, settings, anchor_weights=weight * curvature, on_progress=on_progress)
        if adjusted.termination == "failure":
            return None
        problem = replace(problem, state=adjusted.state, points=adjusted.points)
    assert adjusted is not None
    return _turned_over(problem, ratio, adjusted, settings, on_progress)


def _behind_planes(problem: Problem, settings: SolverSettings) -> Problem:
    """The problem with each point moved across to where its rays lead behind the planes as they stand.

    Points that were put where straight rays lead are farther off than the tilts of the planes tell. Held there,
    they draw the planes to themselves, where nothing is refracted, and on to either side.
    """
    all_planes = np.ones_like(problem.held.normals)
    standing = replace(
        problem.held,
        poses=np.ones_like(problem.held.poses),
        normals=all_planes,
        distances=all_planes,
        index=True,
        lens=True,
    )
    problem = _widened(problem, "huber")
    moved = adjust(replace(problem, held=standing), settings, anchor_weights=_ACROSS * _curvature(problem))
    return problem if moved.termination == "failure" else replace(problem, points=moved.points)


def _curvature(problem: Problem) -> Array:
    """Mean curvature (P,) of each point's cost, px^2 per squared unit: focal length over range, squared and summed."""
    rotation, translation = problem.state.cam_from_world(problem.structure)
    image = problem.tracks.image
    point = np.repeat(problem.points, np.diff(problem.tracks.start), axis=0)
    away = np.linalg.norm(np.einsum("nij,nj->ni", rotation[image], point) + translation[image], axis=1)
    each = (problem.tracks.metric**2).sum(axis=(1, 2)) / np.maximum(away, 1e-6) ** 2
    return np.asarray(np.add.reduceat(each, problem.tracks.start[:-1]) / 3.0)


def spread_out(arrangement: Arrangement, start: Start, settings: SolverSettings) -> Problem:
    """All observations, from a start that was found on a few; the other points go where their rays meet."""
    problem = arrangement.start(start.ratio, arrangement.observations)
    problem = replace(problem, state=start.problem.state, layers=start.problem.layers)
    problem = retriangulate(replace(problem, loss="cauchy", loss_scale=_WIDE_LOSS))
    return replace(problem, points=settle_points(problem, settings))


def estimate_noise(problem: Problem) -> float:
    """Noise of a keypoint coordinate, px, that the residuals of a solution show."""
    structure, seen = problem.structure, np.unique(problem.tracks.image)
    unknowns = 0 if problem.held.points else 3 * len(problem.points)
    unknowns += 6 * int((~problem.held.poses[np.unique(structure.image_pose[seen])]).sum())
    unknowns += 3 * len(np.unique(structure.image_plane[seen]))
    return noise(residuals(problem), unknowns)


def named(watch: Watch | None, stage: str) -> Callable[[Progress], None] | None:
    if watch is None:
        return None
    return lambda progress: watch(stage, progress)


def counted(watch: Watch | None, stage: str) -> Callable[[int, int], None]:
    """Tells the watch how many parts of a stage are done, of how many."""
    if watch is None:
        return lambda done, total: None
    return lambda done, total: watch(stage, part_done(done, total))
