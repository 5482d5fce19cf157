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

from colmap_refract import elimination
from colmap_refract.adjustment import Adjustment, Problem, Progress, SolverSettings, adjust
from colmap_refract.arrangement import Arrangement, select_tracks
from colmap_refract.filtering import label_wet, noise
from colmap_refract.interface import Array
from colmap_refract.scenario import Change, evaluate_views
from colmap_refract.start import world_plane
from colmap_refract.triangulation import triangulate

logger = logging.getLogger(__name__)

Watch = Callable[[str, Progress], None]

_TRACKS_PER_IMAGE = 60
_WIDE_LOSS = 4.0
"""Least scale, px, of the Huber loss on the way."""
_ANCHORS = (1e6, 1.0, 1e-2, 1e-4, 0.0)
"""Proximal weights, in units of a point's own curvature, for a camera that does not move."""
_OPEN_RATIOS = (0.5, 0.15)
_HOUSING_RATIOS = (0.02, 0.2)
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

    Raises:
        KeyboardInterrupt: Ctrl-C during a solve.
    """
    observations = arrangement.observations
    few = observations.select(select_tracks(observations, _TRACKS_PER_IMAGE, arrangement.options.random_seed))
    if arrangement.ratio is not None:
        ratios: tuple[float, ...] = (arrangement.ratio,)
    else:
        ratios = _HOUSING_RATIOS if arrangement.options.scenario == "camera_housing" else _OPEN_RATIOS
    starts = []
    for ratio in ratios:
        start = _try(arrangement, arrangement.start(ratio, few), ratio, settings, watch)
        if start is not None:
            starts.append(start)
            logger.debug("start at %.3g of the depth: cost %.6g, sound %s", ratio, start.cost, start.sound)
    if not starts:
        raise FloatingPointError("no start value could be evaluated")
    return min(starts, key=lambda start: (not start.sound, start.cost))


def _try(
    arrangement: Arrangement, problem: Problem, ratio: float, settings: SolverSettings, watch: Watch | None
) -> Start | None:
    on_progress = named(watch, f"Start at {ratio:.3g} of the depth")
    quick = replace(settings, max_num_iterations=min(25, settings.max_num_iterations), function_tolerance=1e-3)
    through = replace(settings, max_num_iterations=min(60, settings.max_num_iterations), function_tolerance=1e-6)
    problem = _widened(problem)
    everything = replace(
        problem.held,
        normals=np.ones_like(problem.held.normals),
        distances=np.ones_like(problem.held.distances),
        index=True,
        lens=True,
    )
    if arrangement.options.scenario == "fixed_camera":
        return _fixed_camera(arrangement, problem, ratio, through, on_progress)
    if not _stands(problem):
        unbent = _unbend(arrangement, problem, ratio, quick, on_progress)
        if unbent is None:
            return None
        problem = unbent
    else:
        settled = adjust(replace(problem, held=everything), quick, on_progress=on_progress)
        if settled.termination != "failure":
            problem = replace(problem, state=settled.state, points=settled.points)
    problem = _widened(problem)
    freed = adjust(problem, through, on_progress=on_progress)
    return _start(arrangement, problem, ratio, freed)


def _start(arrangement: Arrangement, problem: Problem, ratio: float, adjustment: Adjustment) -> Start | None:
    if not np.isfinite(adjustment.cost) or adjustment.cost < 0:
        return None
    problem = replace(problem, state=adjustment.state, points=adjustment.points)
    return Start(ratio=ratio, problem=problem, cost=adjustment.cost, sound=is_sound(problem))


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


def _widened(problem: Problem) -> Problem:
    """The problem under a Huber loss wide enough for its residuals as they are."""
    spread = float(np.median(np.linalg.norm(residuals(problem), axis=1)))
    return replace(problem, loss="huber", loss_scale=max(_WIDE_LOSS, 3.0 * spread) if np.isfinite(spread) else 100.0)


def residuals(problem: Problem) -> Array:
    """Residuals (N, 2) in px at the problem's state and points."""
    views = evaluate_views(
        problem.structure, problem.state, Change.zero(problem.state),
        np.full((problem.structure.num_images, 4), -1, dtype=np.int32),
    )  # fmt: skip
    out = np.empty((len(problem.tracks.image), 2))
    elimination.residuals(problem.points, problem.tracks, views, problem.optics, out)
    return out


def _unbend(
    arrangement: Arrangement,
    problem: Problem,
    ratio: float,
    settings: SolverSettings,
    on_progress: Callable[[Progress], None] | None,
) -> Problem | None:
    """A start for planes fixed in the world where the model is bent so much that none fits between its cameras and points.

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
    state = replace(
        problem.state, normal=np.tile([0.0, 0.0, 1.0], (count, 1)), distance=np.full(count, ratio)
    )
    held = replace(problem.held, normals=np.zeros(count, bool), distances=np.zeros(count, bool), index=True, lens=True)
    loose = _widened(replace(problem, structure=own, state=state, held=held))
    adjusted = adjust(loose, settings, on_progress=on_progress)
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
    arrangement: Arrangement,
    problem: Problem,
    ratio: float,
    settings: SolverSettings,
    on_progress: Callable[[Progress], None] | None,
) -> Start | None:
    """Proximal continuation: equal planes give a fixed camera no parallax, so each point is tied to where it was, ever less."""
    adjusted = None
    for weight in _ANCHORS:
        curvature = _curvature(problem)
        adjusted = adjust(problem, settings, anchor_weights=weight * curvature, on_progress=on_progress)
        if adjusted.termination == "failure":
            return None
        problem = replace(problem, state=adjusted.state, points=adjusted.points)
    assert adjusted is not None
    return _start(arrangement, problem, ratio, adjusted)


def _curvature(problem: Problem) -> Array:
    """Mean curvature (P,) of each point's cost, px^2 per squared unit: focal length over range, squared and summed."""
    rotation, translation = problem.state.cam_from_world(problem.structure)
    image = problem.tracks.image
    point = np.repeat(problem.points, np.diff(problem.tracks.start), axis=0)
    away = np.linalg.norm(np.einsum("nij,nj->ni", rotation[image], point) + translation[image], axis=1)
    each = (problem.tracks.metric**2).sum(axis=(1, 2)) / np.maximum(away, 1e-6) ** 2
    return np.asarray(np.add.reduceat(each, problem.tracks.start[:-1]) / 3.0)


def spread_out(arrangement: Arrangement, start: Start) -> Problem:
    """All observations, from a start that was found on a few: points are triangulated from the refracted rays."""
    problem = arrangement.start(start.ratio, arrangement.observations)
    problem = replace(problem, state=start.problem.state, layers=start.problem.layers)
    if arrangement.held.points:
        return problem
    layers = problem.layers.with_index(problem.state.index)
    points = triangulate(problem.tracks, problem.structure, problem.state, layers, problem.points)
    return replace(problem, points=points)


def estimate_noise(problem: Problem) -> float:
    """Noise of a keypoint coordinate, px, that the residuals of a solution show."""
    unknowns = 0 if problem.held.points else 3 * len(problem.points)
    return noise(residuals(problem), unknowns + 9 * problem.structure.num_images)


def named(watch: Watch | None, stage: str) -> Callable[[Progress], None] | None:
    if watch is None:
        return None
    return lambda progress: watch(stage, progress)

