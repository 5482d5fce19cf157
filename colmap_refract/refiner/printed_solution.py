"""The soft constraint as the paper prints it, from a level start: a normal for every observation.

What it finds are poses, points and normals. Beside the model an image has one plane: that of its mean normal through
the mean of where its rays meet the water. Keypoints of points that the reference does not see take the mean normal of
their neighbours, and the points go where those rays meet.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import j0

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import Adjustment, SolverSettings, settle_points
from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.neighbours import neighbour_weights
from colmap_refract.estimator.printed_terms import pixel_weights
from colmap_refract.estimator.printed_unknowns import Pairing, blocks_at_start, pair, points_in_reference
from colmap_refract.estimator.scenario import Index
from colmap_refract.estimator.soft_as_printed import PrintedAdjustment, adjust_as_printed
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.refiner.arrangement import Arrangement
from colmap_refract.refiner.continuation import Watch, is_sound, named, residuals
from colmap_refract.refiner.filtering import Filtered, filter_observations, reprojection_errors
from colmap_refract.refiner.own_normals import everywhere, slope_deviation
from colmap_refract.refiner.reference_solution import SHRUNK, check_reference, poorly_tied
from colmap_refract.refiner.selection import Selection
from colmap_refract.refiner.soft import wave_options
from colmap_refract.refiner.soft_solution import check_waves, wavy_start
from colmap_refract.refiner.solution import Solution
from colmap_refract.refiner.uncertainty import Uncertainty

MOST_UNKNOWNS = 60_000
"""Some 25 000 observations. An iteration, of which hundreds may be needed, evaluates each through Python: seconds."""
_FUNCTION_TOLERANCE = 1e-6
"""The planes are such weak directions that less than this ends at no place that is any better."""
_NEIGHBOURS = 10
_SHORT = 1e-9
"""A wavelength over which no two keypoints' normals are alike."""
_WIDE = 4.0
"""Times the median residual at the start, which is mostly waves: the scale of the loss."""


def solve_as_printed(
    arrangement: Arrangement, settings: SolverSettings, earlier: Sidecar | None, watch: Watch | None
) -> Solution:
    """Solve with a normal for every observation; see `solution.Way`.

    Raises:
        RefractError: what is refracted cannot wave, the reference sees too few points, the problem is too large, or
            nothing sound is found.
        FloatingPointError: nothing can be evaluated.
    """
    options, observations = arrangement.options, arrangement.observations
    check_waves(arrangement)
    check_reference(arrangement, arrangement.start(0.5, observations))
    pairing = pair(arrangement.start(0.5, observations), arrangement.reference)
    _check_size(arrangement, pairing)
    begin = wavy_start(arrangement, settings, earlier, watch)
    taking_part = np.concatenate([pairing.of_reference, pairing.others])
    radius = options.wave_radius if options.wave_radius is not None else _radius(arrangement, taking_part)
    smoothness = _smoothness(arrangement, begin, pairing, radius)
    given = options.BundleAdjustment.loss_function_scale
    wide = _WIDE * float(np.median(np.linalg.norm(residuals(begin)[pairing.others], axis=1)))
    per_pixel = _units_per_pixel(begin, pairing) if options.residual == "scene" else 1.0
    printed = adjust_as_printed(
        begin,
        observations.pixel,
        reference=arrangement.reference,
        smoothness=smoothness,
        radius=radius,
        residual=options.residual,
        loss=options.BundleAdjustment.loss_function_type,
        loss_scale=per_pixel * (wide if given is None else given),
        settings=replace(settings, function_tolerance=max(settings.function_tolerance, _FUNCTION_TOLERANCE)),
        on_progress=named(watch, "Soft constraint as printed"),
    )
    flat, wavy = everywhere(begin, printed, observations.pixel, radius)
    if printed.termination == "failure" or not is_sound(flat):
        raise RefractError(
            SHRUNK if options.residual == "scene" else
            "soft_as_printed found nothing between cameras and points: give another wave_smoothness, or use soft"
        )  # fmt: skip
    wavy = replace(wavy, points=settle_points(wavy, settings))
    placed = ~np.isfinite(printed.points[:, 0])
    points = np.where(placed[:, None], wavy.points, printed.points)
    flat, wavy = replace(flat, points=points), replace(wavy, points=points)
    marks = _filter(arrangement, flat, wavy)
    counts = np.add.reduceat(marks.keep.astype(np.int64), flat.tracks.start[:-1])
    keep = marks.keep & np.repeat(counts >= 2, np.diff(flat.tracks.start))
    if not keep.any():
        raise RefractError("every point was filtered: give another wave_smoothness or wave_radius, or use soft")
    selection = Selection(arrangement=arrangement, problem=flat, keep=keep, marks=marks)
    active, problem = selection.active()
    kept = selection.keep_point
    deviation = slope_deviation(wavy, np.isfinite(printed.normals[:, 0]))

    def describe(sidecar: Sidecar, scale: float) -> None:
        of_residual = scale**2 if options.residual == "scene" else 1.0
        sidecar.statistics["reference"] = {
            "image": observations.image_names[arrangement.reference],
            "residual": options.residual,
            "num_points_adjusted": int((kept & ~placed).sum()),
            "num_points_placed": int((kept & placed).sum()),
        }
        sidecar.statistics["waves"] = {
            "slope_deviation_deg": deviation,
            "num_normals": int(np.isfinite(printed.normals[:, 0]).sum()),
            "smoothness": smoothness * of_residual,
            "radius_px": radius,
            "noise_px": options.pixel_noise,
        }
        for key in ("cost", "gradient_max_norm"):
            sidecar.solver[key] *= of_residual

    pairs = np.unique(np.column_stack([observations.point[taking_part], observations.image[taking_part]]), axis=0)
    shared = np.bincount(pairs[:, 1], minlength=len(observations.image_names))
    return Solution(
        selection=selection,
        problem=problem,
        adjustment=_as_adjustment(printed),
        uncertainty=_unknown(problem),
        # Normals of their own take most of the noise out of the residuals.
        noise=options.pixel_noise,
        residuals=residuals(wavy)[keep],
        errors=reprojection_errors(wavy, observations)[keep],
        remarks=poorly_tied(arrangement, shared),
        describe=describe,
    )


def _check_size(arrangement: Arrangement, pairing: Pairing) -> None:
    structure = arrangement.structure
    unknowns = len(pairing.point) + 2 * (len(pairing.of_reference) + len(pairing.others))
    unknowns += 6 * structure.num_poses + 3 * structure.num_planes
    if unknowns > MOST_UNKNOWNS:
        raise RefractError(
            f"soft_as_printed would have {unknowns} unknowns, a normal for each of {len(pairing.others)} observations; "
            f"more than {MOST_UNKNOWNS} take hours: use interface_shape soft"
        )


def _radius(arrangement: Arrangement, rows: Index) -> float:
    """The radius, px, within which a typical keypoint of those that take part has so many, itself included."""
    observations = arrangement.observations
    distances = [np.zeros(0)]
    for i in np.unique(observations.image[rows]).tolist():
        pixels = observations.pixel[rows[observations.image[rows] == i]]
        if len(pixels) >= _NEIGHBOURS:
            distances.append(cKDTree(pixels).query(pixels, k=_NEIGHBOURS)[0][:, -1])
    every = np.concatenate(distances)
    if not every.size or not np.median(every) > 0:
        raise RefractError(
            f"no image has {_NEIGHBOURS} keypoints at places of their own that the reference image sees as well: "
            "give wave_radius, or another reference_image"
        )
    return float(np.median(every))


def _smoothness(arrangement: Arrangement, begin: Problem, pairing: Pairing, radius: float) -> float:
    """The paper's `lambda` in units of the solve: the user's, or what noise and waves make of it.

    It weighs the data against the regulariser `R` as probabilities do, if it is `2 n sigma^2 / E(R)` with `n` normals.
    Normals differ by `E|n_k - n_l|^2 = 2 s^2 (1 - rho)`, where `rho` is `J0` of their distance over the wavelength for
    waves from all sides, and 0 if nothing is said of it: then `E(R) = n (m - 1) s^2`.
    """
    options, observations = arrangement.options, arrangement.observations
    if options.wave_smoothness is not None:
        return options.wave_smoothness / (arrangement.unit**2 if options.residual == "scene" else 1.0)
    assert options.wave_slope_deg is not None
    rows = np.concatenate([pairing.of_reference, pairing.others])
    rows = rows[begin.tracks.wet[rows]]
    normal, distance = begin.state.planes_in_cam(begin.structure)
    expected, free = 0.0, 0
    for i in np.unique(observations.image[rows]).tolist():
        mine = rows[observations.image[rows] == i]
        pairs = neighbour_weights(observations.pixel[mine], radius).tocoo()
        ray = observations.direction[mine]
        foot = ray / (ray @ normal[i])[:, None]
        apart = np.linalg.norm(foot[pairs.row] - foot[pairs.col], axis=1)
        alike = j0(2.0 * np.pi * apart / _wavelength(arrangement, float(distance[i])))
        expected += float(pairs.data @ (2.0 * (1.0 - alike)))
        free += 2 * (len(mine) - 1)
    if not expected > 0:
        raise RefractError(f"wave_radius {radius:g} px holds no neighbours of any keypoint: give a larger one")
    noise = options.pixel_noise * (_units_per_pixel(begin, pairing) if options.residual == "scene" else 1.0)
    return float(free * noise**2 / (expected * np.tan(np.radians(options.wave_slope_deg)) ** 2))


def _wavelength(arrangement: Arrangement, distance: float) -> float:
    """Over an interface's distance, in units of the solve; next to nothing if it is not given."""
    given = wave_options(arrangement)
    if given.wavelength is not None:
        return given.wavelength
    return _SHORT if given.wavelength_in_depths is None else given.wavelength_in_depths / distance


def _units_per_pixel(problem: Problem, pairing: Pairing) -> float:
    """How far apart in the scene a point and a ray typically are for an error of a pixel, units of the solve."""
    points = points_in_reference(problem, problem.state, pairing, blocks_at_start(problem, pairing))
    return float(np.median(1.0 / np.linalg.norm(pixel_weights(problem, pairing, points), ord=2, axis=(1, 2))))


def _filter(arrangement: Arrangement, flat: Problem, wavy: Problem) -> Filtered:
    """What to remove: errors are those through the normals, angles those of the mean planes."""
    options = arrangement.options
    angles = filter_observations(
        flat, arrangement.observations, max_reproj_error=0.0, min_tri_angle=options.min_tri_angle
    )
    large = np.zeros(len(flat.tracks.image), dtype=np.bool_)
    if options.filter_max_reproj_error > 0:
        large = reprojection_errors(wavy, arrangement.observations) > options.filter_max_reproj_error
    return replace(angles, keep=angles.keep & ~large, num_large_error=int(large.sum()))


def _as_adjustment(printed: PrintedAdjustment) -> Adjustment:
    return Adjustment(
        state=printed.state,
        points=printed.points,
        cost=printed.cost,
        initial_cost=float("nan"),
        num_iterations=printed.num_iterations,
        termination=printed.termination,
        message=printed.message,
        gradient_max_norm=printed.gradient_max_norm,
        seconds=float("nan"),
    )


def _unknown(problem: Problem) -> Uncertainty:
    """No covariances: normals and planes are far from a normal distribution."""
    nan = np.full(len(problem.state.normal), np.nan)
    return Uncertainty(
        normal=nan, distance=nan.copy(), index=np.nan, index_correlation=np.nan, decrement=np.nan, determined=True
    )
