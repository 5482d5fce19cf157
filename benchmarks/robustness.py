"""Whether the minimum depends on where the interface starts: on real tracks put under water, and in narrow views.

python benchmarks/robustness.py [--data PATH]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap
from accuracy import minimum_at_truth
from numpy.typing import NDArray
from tables import RESULTS, ProgressLine, publish, table

from colmap_refract.errors import RefractError
from colmap_refract.options import RefinerOptions, Scenario
from colmap_refract.refiner.refinement import Refinement, refine
from colmap_refract.simulation import SceneOptions, ignore_refraction, noise_bound, point_rmse, simulate

Array = NDArray[np.float64]

TITLE = "Robustness"
DEFAULT_DATA = Path(__file__).parents[2] / "shared" / "data"
STARTS = (0.2, 0.5, 0.8)
HOUSING_RATIO = 0.012
HOUSING_FACTORS = (0.5, 1.0, 2.0, 4.0)
# Limit of the median distance to the truth, in median depths, over the best 90 % of the points of the real models.
LARGEST_ERROR: dict[str, float] = {
    "static_interface": 0.000123,
    "moving_interface": 0.000119,
    "camera_housing": 0.000087,
}
LEAST_KEPT = 0.97
NARROW_FOCAL_LENGTH = 11440.0
NARROW_SCENES: dict[Scenario, float | None] = {
    "static_interface": None,
    "moving_interface": None,
    "fixed_camera": None,
    "camera_housing": 0.4,
}
NARROW_NOISES = (0.02, 0.1)
NARROW_STARTS: Sequence[tuple[str, float | None]] = (("default", None), *((f"{ratio:g}", ratio) for ratio in STARTS))
LARGEST_SPREAD = 0.1
"""Of the reference image's interface distance between starts, in its standard deviations."""
LARGEST_COST_SPREAD = 1e-3
"""Between starts on the real models, relative."""
LARGEST_EXCESS = 0.01
"""Of the cost over that at the minimum nearest to the truth, relative: the last few outliers go after the solve."""
LEAST_OBSERVATIONS_KEPT = 0.99
"""Of those of a simulated scene, none of which is an outlier."""
LARGEST_QUIET_RATIO = 2.0
"""Of RMSE to the bound, for a result that comes without any warning."""

REAL = """\
## Real tracks

Poses, tracks and residuals of a real model, wrong matches included, put under water. *Start* is the interface distance
in median depths (in the housing, in multiples of the true one). Errors are median distances to the true points, in
millionths of the median depth, after a similarity alignment to the best 90 % of the points: over all points that were
kept, over the 97 % of them with the smallest reprojection error, and over the best 90 %. *At truth* is the
error over all points at the minimum that the same loss has nearest to the truth, on the observations that were kept.
*Interface* is how far the reference image's distance is from where the default start ends, in standard deviations."""
SKIPPED = """\
## Real tracks

Skipped: there is no model at `../shared/data`. Give with `--data` a folder of folders, each with `sparse/0` (a COLMAP
model that ignored refraction) and `truth.npz` (`point3D_ids`, `points`, `names`, `cam_from_world`, `planes` with normal
and distance per image, and `scenario`). To make one, take any COLMAP model as the truth, project its points through a
plane as `colmap_refract.simulation` does, add to each pixel its own residual in that model, and bundle-adjust the
result with the intrinsics held."""
NARROW = """\
## Narrow view

Simulated scenes seen through a lens of 8 degrees, the interface unknown; in the housing it is at {housing} of the
depth. *Cost at truth* is that of the minimum that the same loss has nearest to the truth, on the observations that were
kept. *Spread* is the largest difference between the starts of the reference image's interface distance, in standard
deviations."""
UNDETERMINED = """\
## Where the interface is not determined

A lens of 8 degrees in a housing with the port at 0.02 of the depth, and 0.5 px of noise: the refraction that is left
looks like another focal length, and the distance cannot be told. What the user is told:"""


@dataclass
class Findings:
    """Rows of a table, and the limits that they miss."""

    rows: list[list[str]] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class RealModel:
    """A real model put under water, and the truth.

    Attributes:
        name: of its folder.
        scenario: of the interface.
        reconstruction: the model that ignores refraction.
        points: true positions by point id.
        cam_from_world: true poses (3, 4) by image name.
        planes: `(normal_in_cam, distance)` by image name, the truth.
        depth: median over the observations, units of the truth.
    """

    name: str
    scenario: Scenario
    reconstruction: pycolmap.Reconstruction
    points: dict[int, Array]
    cam_from_world: dict[str, Array]
    planes: dict[str, tuple[Array, float]]
    depth: float


def read_real_model(folder: Path) -> RealModel:
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    with np.load(folder / "truth.npz") as truth:
        points = dict(zip(truth["point3D_ids"].tolist(), truth["points"], strict=True))
        names = truth["names"].tolist()
        poses = dict(zip(names, truth["cam_from_world"], strict=True))
        planes = {name: (plane[:3], float(plane[3])) for name, plane in zip(names, truth["planes"], strict=True)}
        scenario: Scenario = str(truth["scenario"])  # type: ignore[assignment]
    depths = []
    for image in model.images.values():
        axis = poses[image.name][2]
        seen = np.array([points[point2D.point3D_id] for point2D in image.get_observation_points2D()])
        depths.append(seen @ axis[:3] + axis[3])
    return RealModel(
        name=folder.name,
        scenario=scenario,
        reconstruction=model,
        points=points,
        cam_from_world=poses,
        planes=planes,
        depth=float(np.median(np.concatenate(depths))),
    )


def aligned_errors(source: Array, target: Array) -> Array:
    """Distances (N,) after the similarity that brings the best 90 % of the points (N, 3) to their targets."""
    # Runaway points would spoil a first alignment, and they are far from the others.
    error: Array = np.linalg.norm(source - np.median(source, axis=0), axis=1)
    for _ in range(50):
        best = np.argsort(error)[: int(0.9 * len(error))]
        similarity = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.zeros(3))
        similarity = pycolmap.estimate_sim3d(source[best], target[best]) or similarity
        error = np.linalg.norm(similarity * source - target, axis=1)
    return error


def errors_in_depths(real: RealModel, model: pycolmap.Reconstruction) -> Array:
    """Distances (N,) of a model's points to the truth in the order of their ids, in median depths."""
    ids = sorted(model.point3D_ids())
    source = np.array([model.point3D(i).xyz for i in ids])
    return aligned_errors(source, np.array([real.points[i] for i in ids])) / real.depth


def median_of_best(errors: Array) -> float:
    return float(np.median(np.sort(errors)[: int(0.9 * len(errors))]))


def median_of_small_residuals(errors: Array, model: pycolmap.Reconstruction) -> float:
    """Over the points whose reprojection error is among the smallest 97 %; `errors` in the order of the ids."""
    residual = np.array([model.point3D(i).error for i in sorted(model.point3D_ids())])
    return float(np.median(errors[residual <= np.quantile(residual, LEAST_KEPT)]))


def cost_and_model_at_truth(
    result: Refinement,
    scenario: Scenario,
    points: Mapping[int, Array],
    cam_from_world: Mapping[str, Array],
    planes: Mapping[str, tuple[Array, float]],
) -> tuple[float, pycolmap.Reconstruction]:
    """The minimum nearest to the truth of the refiner's loss, on the observations that it kept.

    Args:
        result: what to compare with.
        scenario: of the interface.
        points: true positions by point id.
        cam_from_world: true poses (3, 4) by image name, one image per frame.
        planes: true `(normal_in_cam, distance)` by image name.
    """
    model = pycolmap.Reconstruction(result.reconstruction)
    for image in model.images.values():
        pose = cam_from_world[image.name]
        model.frame(image.frame_id).rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3])
    for point3D_id, point in model.points3D.items():
        point.xyz = points[point3D_id]
    by_id = {image_id: planes[image.name] for image_id, image in model.images.items()}
    solver = result.sidecar.solver
    model, cost = minimum_at_truth(
        model, by_id, scenario, loss=solver["loss_function_type"], loss_scale=solver["loss_function_scale"]
    )
    return cost, model


def reference_distance(result: Refinement) -> tuple[float, float]:
    """Distance of the reference image's interface and its standard deviation, model units."""
    image = result.sidecar.images[result.sidecar.solver["reference_image"]]
    assert image.distance is not None
    return image.distance, image.distance_std if image.distance_std is not None else math.nan


def attempt(reconstruction: pycolmap.Reconstruction, options: RefinerOptions) -> Refinement | str:
    """The refinement, or what the user is told instead."""
    try:
        return refine(reconstruction, options)
    except RefractError as error:
        return str(error)


def real_starts(scenario: Scenario) -> list[tuple[str, float | None]]:
    """Labels and `initial_distance_ratio` of the starts; the default first."""
    if scenario == "camera_housing":
        return [("default", None), *((f"{factor:g} x true", factor * HOUSING_RATIO) for factor in HOUSING_FACTORS)]
    return [("default", None), *((f"{ratio:g}", ratio) for ratio in STARTS)]


def from_all_starts(real: RealModel, line: ProgressLine, findings: Findings) -> None:
    """Refine a real model from every start."""
    before = errors_in_depths(real, real.reconstruction)
    limit = LARGEST_ERROR.get(real.scenario, math.nan)
    home: float | None = None
    costs, worst = [], 0.0
    at_truth = math.nan
    for label, ratio in real_starts(real.scenario):
        line.step(f"{real.name}, start {label}")
        who = f"{real.name}, start {label}"
        result = attempt(real.reconstruction, RefinerOptions(scenario=real.scenario, initial_distance_ratio=ratio))
        if isinstance(result, str):
            findings.missed.append(f"{who}: {result}")
            findings.rows.append([real.scenario, label, *("-" * 11), "no"])
            continue
        refined = result.reconstruction
        after = errors_in_depths(real, refined)
        kept = len(after) / len(before)
        distance, deviation = reference_distance(result)
        if home is None:
            home = distance
            _, best = cost_and_model_at_truth(result, real.scenario, real.points, real.cam_from_world, real.planes)
            at_truth = float(np.median(errors_in_depths(real, best)))
        moved = (distance - home) / deviation
        solver = result.sidecar.solver
        findings.rows.append([
            real.scenario, label, f"{1e6 * np.median(before):.0f}", f"{1e6 * median_of_best(before):.0f}",
            f"{1e6 * np.median(after):.1f}", f"{1e6 * median_of_small_residuals(after, refined):.1f}",
            f"{1e6 * median_of_best(after):.1f}", f"{1e6 * at_truth:.1f}", f"{1e6 * limit:.0f}",
            f"{100 * kept:.2f}", f"{solver['cost']:.2f}", f"{moved:+.3f}", str(solver["num_iterations"]),
            "yes" if result.converged else "no",
        ])  # fmt: skip
        worst = max(worst, median_of_best(after))
        costs.append(solver["cost"])
        if kept < LEAST_KEPT:
            findings.missed.append(f"{who}: {100 * kept:.1f} % of the points kept, less than {100 * LEAST_KEPT:.0f}")
        if not abs(moved) <= LARGEST_SPREAD:
            findings.missed.append(f"{who}: the interface is {moved:+.2f} standard deviations from the default start's")
        if not result.converged:
            findings.missed.append(f"{who}: the solver did not converge")
    if worst > limit:
        findings.missed.append(
            f"{real.name}: the median error of the best 90 % of the points is {1e6 * worst:.1f} millionths, over "
            f"the limit of {1e6 * limit:.0f}"
        )
    if costs and max(costs) > (1.0 + LARGEST_COST_SPREAD) * min(costs):
        findings.missed.append(f"{real.name}: the starts end at costs from {min(costs):.6g} to {max(costs):.6g}")


def real_section(data: Path, line: ProgressLine) -> tuple[str, list[str]]:
    folders = real_folders(data)
    if not folders:
        return SKIPPED, []
    findings = Findings()
    for folder in folders:
        from_all_starts(read_real_model(folder), line, findings)
    header = [
        "scenario", "start", "error before, all", "best 90 %", "error after, all", "97 %", "best 90 %", "at truth",
        "limit of best 90 %", "points kept [%]", "cost [px^2]", "interface [sigma]", "iterations", "converged",
    ]  # fmt: skip
    return f"{REAL}\n\n{table(header, findings.rows)}", findings.missed


def real_folders(data: Path) -> list[Path]:
    return sorted(truth.parent for truth in data.glob("*/truth.npz") if (truth.parent / "sparse" / "0").is_dir())


def narrow_view(scenario: Scenario, noise: float, line: ProgressLine, findings: Findings, told: list[str]) -> None:
    """Refine one scene from every start; what the user is told goes to `told`."""
    capture = simulate(
        SceneOptions(
            scenario=scenario,
            focal_length=NARROW_FOCAL_LENGTH,
            pixel_noise=noise,
            distance_ratio=NARROW_SCENES[scenario],
        )
    )
    truth = capture.reconstruction
    points = {point3D_id: point.xyz for point3D_id, point in truth.points3D.items()}
    poses = {image.name: image.cam_from_world().matrix() for image in truth.images.values()}
    planes = {truth.image(image_id).name: plane for image_id, plane in capture.planes.items()}
    start, bound = ignore_refraction(capture), noise_bound(capture)
    who = f"narrow view, {scenario}, {noise:g} px"
    results = []
    for label, ratio in NARROW_STARTS:
        line.step(f"{who}, start {label}")
        results.append((label, attempt(start, RefinerOptions(scenario=scenario, initial_distance_ratio=ratio))))
    ends = [reference_distance(result) for _, result in results if not isinstance(result, str)]
    spread = math.nan
    if ends:
        spread = float(np.ptp([distance for distance, _ in ends]) / np.median([deviation for _, deviation in ends]))
    if not spread <= LARGEST_SPREAD:
        findings.missed.append(f"{who}: the starts end {spread:.3g} standard deviations of the interface apart")
    for label, result in results:
        head = [scenario, f"{noise:g}", label, f"{point_rmse(start, capture) / bound:.1f}"]
        where = f"{who}, start {label}"
        if isinstance(result, str):
            findings.missed.append(f"{where}: {result}")
            findings.rows.append([*head, *("-" * 9), "no"])
            continue
        accuracy = point_rmse(result.reconstruction, capture) / bound
        distance, deviation = reference_distance(result)
        kept = result.reconstruction.compute_num_observations() / start.compute_num_observations()
        solver = result.sidecar.solver
        at_truth = math.nan
        try:
            at_truth, _ = cost_and_model_at_truth(result, scenario, points, poses, planes)
        except RefractError as error:
            findings.missed.append(f"{where}: what was kept cannot be refined again: {error}")
        findings.rows.append([
            *head, f"{accuracy:.3f}", f"{100 * kept:.1f}", f"{solver['cost']:.5g}",
            f"{at_truth:.5g}" if math.isfinite(at_truth) else "-",
            f"{distance:.3f}", f"{deviation:.3g}", f"{spread:.3f}", str(solver["num_iterations"]),
            str(len(result.warnings)), "yes" if result.converged else "no",
        ])  # fmt: skip
        told += [f"- {where}: {sentence}" for sentence in result.warnings]
        if kept < LEAST_OBSERVATIONS_KEPT:
            findings.missed.append(f"{where}: {100 * kept:.1f} % of the observations kept, though none is an outlier")
        if solver["cost"] > (1.0 + LARGEST_EXCESS) * at_truth:
            findings.missed.append(f"{where}: the cost is {solver['cost']:.5g}, at the truth {at_truth:.5g}")
        if not result.converged:
            findings.missed.append(f"{where}: the solver did not converge")
        if accuracy > LARGEST_QUIET_RATIO and not result.warnings:
            findings.missed.append(f"{where}: RMSE / bound is {accuracy:.3g}, without a warning")


def narrow_section(line: ProgressLine) -> tuple[str, list[str]]:
    findings, told = Findings(), list[str]()
    for scenario in NARROW_SCENES:
        for noise in NARROW_NOISES:
            narrow_view(scenario, noise, line, findings, told)
    header = [
        "scenario", "noise [px]", "start", "RMSE / bound before", "after", "observations kept [%]", "cost [px^2]",
        "cost at truth", "interface", "sigma", "spread [sigma]", "iterations", "warnings", "converged",
    ]  # fmt: skip
    intro = NARROW.format(housing=NARROW_SCENES["camera_housing"])
    warnings = "\n\nWhat the user is told:\n\n" + "\n".join(told) if told else ""
    return f"{intro}\n\n{table(header, findings.rows)}{warnings}", findings.missed


def undetermined_section(line: ProgressLine) -> tuple[str, list[str]]:
    """What is said where an interface cannot be found."""
    line.step("undetermined interface")
    options = SceneOptions(scenario="camera_housing", focal_length=NARROW_FOCAL_LENGTH, distance_ratio=0.02)
    capture = simulate(options)
    result = attempt(ignore_refraction(capture), RefinerOptions(scenario="camera_housing"))
    if isinstance(result, str):
        return f"{UNDETERMINED}\n\n> ERROR: {result}", []
    accuracy = point_rmse(result.reconstruction, capture) / noise_bound(capture)
    ended = f"A model is written, its RMSE {accuracy:.2f} of the bound."
    if not result.warnings:
        return f"{UNDETERMINED} nothing. {ended}", ["undetermined interface: no error and no warning"]
    said = "\n>\n".join(f"> WARNING: {sentence}" for sentence in result.warnings)
    return f"{UNDETERMINED}\n\n{said}\n\n{ended}", []


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data",
        type=Path,
        default=DEFAULT_DATA,
        help="folder of real models put under water, each with sparse/0 and truth.npz (../shared/data)",
    )
    parser.add_argument("--output_path", type=Path, default=RESULTS / "robustness.md", help="Markdown file to write")
    arguments = parser.parse_args()
    data: Path = arguments.data
    if data != DEFAULT_DATA and not real_folders(data):
        parser.error(f"--data {data}: no folder with sparse/0 and truth.npz there")
    steps = sum(len(HOUSING_FACTORS if "housing" in folder.name else STARTS) + 1 for folder in real_folders(data))
    line = ProgressLine(steps + len(NARROW_SCENES) * len(NARROW_NOISES) * len(NARROW_STARTS) + 1)
    parts: Sequence[tuple[str, list[str]]] = [
        real_section(data, line),
        narrow_section(line),
        undetermined_section(line),
    ]
    line.clear()
    missed = [sentence for _, found in parts for sentence in found]
    return publish(arguments.output_path, TITLE, [section for section, _ in parts], missed)


if __name__ == "__main__":
    sys.exit(main())
