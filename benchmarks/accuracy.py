"""How near refined points come to what the pixel noise allows, on simulated scenes, without and with wrong matches.

python benchmarks/accuracy.py [--seeds 10] [--scenario static_interface ...]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
import pycolmap
from tables import RESULTS, ProgressLine, publish, table

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import SolverSettings, adjust
from colmap_refract.interface import Array, plane_in_world
from colmap_refract.options import ImageNotes, Loss, RefinerOptions, Scenario
from colmap_refract.refiner.arrangement import arrange
from colmap_refract.refiner.observations import read_observations
from colmap_refract.refiner.refinement import Refinement, refine
from colmap_refract.simulation import Capture, SceneOptions, ignore_refraction, noise_bound, point_rmse, simulate

MEDIAN_LIMIT = 1.05
WORST_LIMIT = 1.10
OUTLIER_LIMIT = 1.10
OUTLIER_RATIO = 0.1

TITLE = "Accuracy"
CLEAN = """\
## Pixel noise alone

{images} images of {points} points, {noise} px of noise, {seeds} seeds. The input is the bundle adjustment that ignores
refraction, its intrinsics those in air; the refiner has its default options. RMSE is of the points after a similarity
alignment, in mm at a depth of 2.5 m; of the first three columns and of the normals' error the median over the seeds is
shown. The *bound* is that of Cramer and Rao. It is for the mean over all draws of the noise, about which a single
draw scatters; *pooled* takes the root mean squares over the seeds on both sides. The *optimum* is what least squares
without a robust loss or a filter, started at the truth, makes of the same draw: a ratio of 1 to it says that the
refiner has found all that is to be found in that draw."""
OUTLIERS = """\
## With gross outliers

The same scenes with the same noise, but {percent:.0f} % of the observations replaced by random pixels of their image.
Fewer good observations are left then, so that the bound itself rises. RMSE is pooled over the seeds, in mm; the optimum
is that of the good observations alone."""


@dataclass(frozen=True, kw_only=True)
class Draw:
    """What became of one scene with one draw of the noise; lengths in metres, NaN where the refiner gave up.

    Attributes:
        before, after: RMSE of the input's points and of the refined ones.
        bound: the RMSE that the noise allows.
        optimum: the RMSE of least squares from the truth without the outliers, over the points of `after`.
        normal_deg: median over the images, degrees.
        kept: part of the points.
        outliers_removed: part of those that were put in.
        converged: the solver's word.
    """

    before: float
    after: float
    bound: float
    optimum: float
    normal_deg: float
    kept: float
    outliers_removed: float
    converged: bool


def with_outliers(capture: Capture, ratio: float) -> Capture:
    """The capture with part of its observations replaced by random pixels, and the noise of the others as it was."""
    options = capture.options
    rng = np.random.default_rng([options.seed, 1])
    model = pycolmap.Reconstruction(capture.reconstruction)
    outliers = set()
    for image_id, image in sorted(model.images.items()):
        for idx, point2D in enumerate(image.points2D):
            if point2D.has_point3D() and rng.random() < ratio:
                point2D.xy = rng.random(2) * [options.width, options.height]
                outliers.add((image_id, idx))
    return replace(capture, options=replace(options, outlier_ratio=ratio), reconstruction=model, outliers=outliers)


def minimum_at_truth(
    model: pycolmap.Reconstruction,
    planes: dict[int, tuple[Array, float]],
    scenario: Scenario,
    *,
    loss: Loss = "trivial",
    loss_scale: float = 1.0,
) -> tuple[pycolmap.Reconstruction, float]:
    """The minimum nearest to the truth, all observations kept.

    Args:
        model: true poses, points and intrinsics, and the keypoints to fit.
        planes: `(normal_in_cam, distance)` by image id, the truth.
        scenario: how images share them.
        loss, loss_scale: the robust loss, and its scale in px.

    Returns:
        The model with its points there, in a frame and size of their own, and the cost in px^2.
    """
    observations = read_observations(model)
    arrangement = arrange(observations, RefinerOptions(scenario=scenario), ImageNotes())
    problem = arrangement.start(0.5, arrangement.observations)
    structure, state = problem.structure, problem.state
    rotation, translation = state.cam_from_world(structure)
    normal, distance = state.normal.copy(), state.distance.copy()
    for block in range(structure.num_planes):
        image = int(np.flatnonzero(structure.image_plane == block)[0])
        true_normal, true_distance = planes[int(observations.image_ids[image])]
        normal[block], distance[block] = true_normal, true_distance / arrangement.unit
        if structure.plane_in_world[block]:
            normal[block], offset = plane_in_world(normal[block], distance[block], rotation[image], translation[image])
            distance[block] = offset - normal[block] @ structure.plane_anchor[block]
    problem = replace(
        problem,
        state=replace(state, normal=normal, distance=distance),
        points=(observations.points - arrangement.origin) / arrangement.unit,
        loss=loss,
        loss_scale=loss_scale,
    )
    adjustment = adjust(problem, SolverSettings(function_tolerance=1e-12, max_num_iterations=200))
    model = pycolmap.Reconstruction(model)
    for point3D_id in set(model.point3D_ids()) - set(observations.point3D_ids.tolist()):
        model.delete_point3D(point3D_id)
    for point3D_id, xyz in zip(observations.point3D_ids.tolist(), adjustment.points, strict=True):
        model.point3D(point3D_id).xyz = xyz
    return model, adjustment.cost


def least_squares(capture: Capture) -> pycolmap.Reconstruction:
    """The minimum of the squared residuals of all observations but the outliers."""
    model = pycolmap.Reconstruction(capture.reconstruction)
    for outlier in capture.outliers:
        # The point goes with its last observation but one.
        if model.image(outlier[0]).point2D(outlier[1]).has_point3D():
            model.delete_observation(*outlier)
    return minimum_at_truth(model, capture.planes, capture.scenario)[0]


def rmse_over(model: pycolmap.Reconstruction, capture: Capture, reference: pycolmap.Reconstruction) -> float:
    """`point_rmse` of a model over the points that another one has."""
    model = pycolmap.Reconstruction(model)
    for point3D_id in set(model.point3D_ids()) - set(reference.point3D_ids()):
        model.delete_point3D(point3D_id)
    return point_rmse(model, capture)


def normal_error(result: Refinement, capture: Capture) -> float:
    """Median over the images, degrees."""
    images = result.sidecar.images
    names = {image_id: image.name for image_id, image in capture.reconstruction.images.items()}
    cosines = [np.array(images[names[i]].normal_in_cam) @ normal for i, (normal, _) in capture.planes.items()]
    return float(np.median(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))))


def measure(capture: Capture) -> Draw:
    """Refine a capture as a user would, from the model that ignores refraction."""
    start = ignore_refraction(capture)
    before, bound = point_rmse(start, capture), noise_bound(capture)
    try:
        result = refine(start, RefinerOptions(scenario=capture.scenario))
    except RefractError as error:
        print(f"{capture.scenario}, seed {capture.options.seed}: {error}", file=sys.stderr)
        nan = float("nan")
        return Draw(
            before=before, after=nan, bound=bound, optimum=nan, normal_deg=nan, kept=0.0, outliers_removed=nan,
            converged=False,
        )  # fmt: skip
    refined = result.reconstruction
    left = {(e.image_id, e.point2D_idx) for point in refined.points3D.values() for e in point.track.elements}
    outliers = capture.outliers
    return Draw(
        before=before,
        after=point_rmse(refined, capture),
        bound=bound,
        optimum=rmse_over(least_squares(capture), capture, refined),
        normal_deg=normal_error(result, capture),
        kept=refined.num_points3D() / capture.reconstruction.num_points3D(),
        outliers_removed=1.0 - len(outliers & left) / len(outliers) if outliers else float("nan"),
        converged=result.converged,
    )


def pooled(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def clean_table(draws: dict[Scenario, list[Draw]]) -> tuple[str, list[str]]:
    """The table of the scenes without outliers, and the limits that they miss."""
    header = [
        "scenario", "RMSE ignoring refraction", "RMSE", "bound", "RMSE / bound, median", "worst", "pooled",
        "RMSE / optimum, median", "worst", "optimum / bound, worst", "normal error [deg]", "points kept [%]",
        "converged",
    ]  # fmt: skip
    rows, missed = [], []
    for scenario, seeds in draws.items():
        ratio = np.array([draw.after / draw.bound for draw in seeds])
        to_optimum = np.array([draw.after / draw.optimum for draw in seeds])
        optimum = np.array([draw.optimum / draw.bound for draw in seeds])
        before, after, bound, normal_deg, kept = (
            np.median([getattr(draw, name) for draw in seeds])
            for name in ("before", "after", "bound", "normal_deg", "kept")
        )
        converged = sum(draw.converged for draw in seeds)
        overall = pooled([draw.after for draw in seeds]) / pooled([draw.bound for draw in seeds])
        rows.append([
            scenario, f"{1e3 * before:.1f}", f"{1e3 * after:.2f}", f"{1e3 * bound:.2f}", f"{np.median(ratio):.3f}",
            f"{ratio.max():.3f}", f"{overall:.3f}", f"{np.median(to_optimum):.3f}", f"{to_optimum.max():.3f}",
            f"{optimum.max():.3f}", f"{normal_deg:.3f}", f"{100 * kept:.1f}", f"{converged}/{len(seeds)}",
        ])  # fmt: skip
        if not np.median(ratio) <= MEDIAN_LIMIT:
            missed.append(f"{scenario}: RMSE / bound is {np.median(ratio):.3f} in the median, more than {MEDIAN_LIMIT}")
        for seed, (value, best) in enumerate(zip(ratio, optimum, strict=True)):
            if not value <= WORST_LIMIT:
                missed.append(
                    f"{scenario}, seed {seed}: RMSE / bound is {value:.3f}, more than {WORST_LIMIT}; the optimum of "
                    f"this draw has {best:.3f}"
                )
        if converged < len(seeds):
            missed.append(f"{scenario}: {len(seeds) - converged} of {len(seeds)} did not converge")
    return table(header, rows), missed


def outlier_table(clean: dict[Scenario, list[Draw]], dirty: dict[Scenario, list[Draw]]) -> tuple[str, list[str]]:
    """The table of the scenes with outliers, and the limits that they miss."""
    header = [
        "scenario", "RMSE without outliers", "with", "ratio, pooled", "median", "worst", "ratio of the bounds",
        "RMSE / optimum, pooled", "worst", "outliers removed [%]", "points kept [%]", "converged",
    ]  # fmt: skip
    rows, missed = [], []
    for scenario, seeds in dirty.items():
        without = [draw.after for draw in clean[scenario]]
        after = [draw.after for draw in seeds]
        ratio = np.array(after) / without
        overall = pooled(after) / pooled(without)
        optimum = [draw.optimum for draw in seeds]
        bounds = pooled([draw.bound for draw in seeds]) / pooled([draw.bound for draw in clean[scenario]])
        converged = sum(draw.converged for draw in seeds)
        rows.append([
            scenario, f"{1e3 * pooled(without):.2f}", f"{1e3 * pooled(after):.2f}", f"{overall:.3f}",
            f"{np.median(ratio):.3f}", f"{ratio.max():.3f}", f"{bounds:.3f}",
            f"{pooled(after) / pooled(optimum):.3f}", f"{np.max(np.divide(after, optimum)):.3f}",
            f"{100 * np.mean([draw.outliers_removed for draw in seeds]):.1f}",
            f"{100 * np.mean([draw.kept for draw in seeds]):.1f}", f"{converged}/{len(seeds)}",
        ])  # fmt: skip
        if not overall <= OUTLIER_LIMIT:
            missed.append(f"{scenario}: RMSE with outliers is {overall:.3f} of that without, more than {OUTLIER_LIMIT}")
        if converged < len(seeds):
            missed.append(f"{scenario} with outliers: {len(seeds) - converged} of {len(seeds)} did not converge")
    return table(header, rows), missed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="scenes per scenario (10)")
    parser.add_argument("--scenario", nargs="+", choices=get_args(Scenario), default=get_args(Scenario))
    parser.add_argument("--output_path", type=Path, default=RESULTS / "accuracy.md", help="Markdown file to write")
    arguments = parser.parse_args()
    if arguments.seeds < 1:
        parser.error("--seeds must be 1 or more")
    scenarios: Sequence[Scenario] = arguments.scenario
    clean: dict[Scenario, list[Draw]] = {scenario: [] for scenario in scenarios}
    dirty: dict[Scenario, list[Draw]] = {scenario: [] for scenario in scenarios}
    line = ProgressLine(len(scenarios) * arguments.seeds)
    for scenario in scenarios:
        for seed in range(arguments.seeds):
            line.step(f"{scenario}, seed {seed}")
            capture = simulate(SceneOptions(scenario=scenario, seed=seed))
            clean[scenario].append(measure(capture))
            dirty[scenario].append(measure(with_outliers(capture, OUTLIER_RATIO)))
    line.clear()
    defaults = SceneOptions(scenario="static_interface")
    intro = CLEAN.format(
        images=defaults.num_images, points=defaults.num_points, noise=defaults.pixel_noise, seeds=arguments.seeds
    )
    first, missed = clean_table(clean)
    second, missed_with_outliers = outlier_table(clean, dirty)
    outliers = OUTLIERS.format(percent=100 * OUTLIER_RATIO)
    sections = [f"{intro}\n\n{first}", f"{outliers}\n\n{second}"]
    return publish(arguments.output_path, TITLE, sections, [*missed, *missed_with_outliers])


if __name__ == "__main__":
    sys.exit(main())
