"""What is won by solving for the waves of open water: simulated swell and ripples, in every scenario of open water.

python benchmarks/waves.py [--seeds 5] [--only moving_interface/swell ...] [--printed 1] [--large 1]

The Markdown file is written anew after every row: a run that is interrupted keeps the rows it has.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
import pycolmap
from speed import peak_since_reset, reset_peak
from tables import RESULTS, ProgressLine, command, environment, publish, table

from colmap_refract.errors import RefractError
from colmap_refract.estimator.adjustment import SolverSettings
from colmap_refract.estimator.neighbours import neighbour_weights
from colmap_refract.estimator.printed_unknowns import pair
from colmap_refract.estimator.soft_as_printed import adjust_as_printed
from colmap_refract.interface import Array
from colmap_refract.options import ImageNotes, RefinerOptions, Scenario
from colmap_refract.refiner.arrangement import arrange
from colmap_refract.refiner.observations import Observations, read_observations
from colmap_refract.refiner.refinement import Refinement, refine
from colmap_refract.refiner.soft import level_start
from colmap_refract.simulation import (
    Capture,
    SceneOptions,
    bayesian_bound,
    ignore_refraction,
    point_rmse,
    simulate,
    slope_error,
)

SCENARIOS: tuple[Scenario, ...] = ("moving_interface", "static_interface", "fixed_camera")
WAVES = {"swell": (1.0, 2.5), "ripples": (0.02, 0.1)}
"""Shortest and longest wavelength, metres."""
SLOPES_DEG = (1.0, 2.0, 4.0)
NUM_IMAGES, NUM_POINTS, NOISE = 20, 400, 0.3
WORSE_LIMIT = 1.05
"""RMSE with waves over that without, each draw."""
RADIUS = 250.0
"""Of the printed regulariser's neighbourhoods, px: about ten keypoints."""
PRINTED_IMAGES, PRINTED_POINTS, PRINTED_ITERATIONS = 10, 120, 100
TIMED_POINTS, TIMED_SLOPE_DEG, REPEATS = 1000, 2.0, 3
LARGE_IMAGES, LARGE_POINTS = 200, 50_000

TITLE = "Waves"
INTRO = """\
## Accuracy

{images} images of {points} points, {noise} px of noise, {depth} m from the cameras to the floor, of which {water:g} m
are water, planes that tilt by {tilt:g} degrees; {seeds} seeds. *Swell* has wavelengths of {swell}, *ripples*
of {ripples}; slopes are root mean squares of the steepest direction, and every image has waves of its own. RMSE is
of the points after a similarity alignment, in mm: the median over the seeds, then the least and the largest.
The input is the bundle adjustment that ignores refraction; with a fixed camera, points at one depth.

- *hard*: `interface_shape` plane, the paper's hard constraint. *soft*: `interface_shape` soft. Both have their default
  options: nothing is known of the waves. *soft, slope given*: `wave_slope_deg` is the true one.
- *bound*: what a solver can do at best that knows the statistics of the waves, and, with a moving interface, those of
  the planes' tilts and heights. A single draw may lie on either side of it.
- *slope error*: root mean square angle between the normals of the recovered surface and the true ones where the light
  of the keypoints crosses it. *true slope* is that of the true normals to the mean plane: the error of a perfect plane.
  *shape error*: the same without the mean error of each image: a tilt of its whole surface goes with its pose, and
  hardly shows in the points.
- *soft / hard*: the largest of all draws in which both end."""
PRINTED = """\
## The soft constraint as printed

`E_soft` of the paper has a normal per observation, and takes long: here are {images} images of {points} points,
otherwise the same. Residuals are in pixels, neighbourhoods of {radius:g} px, and {iterations} iterations at most from
the level start of *soft*; it converges slowly, and where it did not is said below. Its `lambda` is taken from the
truth, which no user has: `2 n sigma^2 / R` with the noise `sigma` in px, the number `n` of normals and the
regulariser `R` of the true normals. For waves shorter than a neighbourhood, which holds `m` keypoints, that is about
`2 sigma^2 / ((m - 1) s^2)`, with `s` the slope's deviation. Points that its reference image does not see have no part
in that column. With flat water `lambda` is infinite, which is the hard constraint."""
TIMES = """\
## Time

{images} images of {points} points, swell of {slope:g} degrees; seconds of a whole refinement, the median of {repeats},
after a first that is not counted."""
LARGE = """\
## A large survey

{images} images over a moving interface with a swell of {slope:g} degrees, {per_image:.0f} keypoints to an image,
{observations} observations of {points} points. The peak of resident memory counts from when the scene was there."""


class Row(NamedTuple):
    """Of the table: the waves' name, or flat."""

    scenario: Scenario
    waves: str
    slope_deg: float

    @property
    def name(self) -> str:
        return f"{self.scenario}/flat" if self.slope_deg == 0 else f"{self.scenario}/{self.waves}/{self.slope_deg:g}"

    def options(self, seed: int, num_images: int = NUM_IMAGES, num_points: int = NUM_POINTS) -> SceneOptions:
        return SceneOptions(
            scenario=self.scenario, num_images=num_images, num_points=num_points, pixel_noise=NOISE, tilt_deg=3.0,
            depth=2.0, distance_ratio=0.3, wave_slope_deg=self.slope_deg, wavelength=WAVES.get(self.waves, (1.0, 2.5)),
            seed=seed,
        )  # fmt: skip


@dataclass(kw_only=True)
class Draws:
    """What became of the seeds of a row: lengths in metres, angles in degrees, NaN where there is nothing."""

    row: Row
    values: list[dict[str, float]] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    unconverged: int = 0

    def of(self, name: str) -> Array:
        return np.array([value.get(name, math.nan) for value in self.values])

    def ratio(self, over: str, under: str) -> Array:
        return self.of(over) / self.of(under)


def all_rows() -> Iterator[Row]:
    for scenario in SCENARIOS:
        yield Row(scenario, "flat", 0.0)
        for waves in WAVES:
            for slope_deg in SLOPES_DEG:
                yield Row(scenario, waves, slope_deg)


def timed(start: pycolmap.Reconstruction, options: RefinerOptions) -> tuple[Refinement | str, float]:
    """The refinement, or what the user is told instead, and seconds."""
    began = perf_counter()
    try:
        result: Refinement | str = refine(start, options)
    except RefractError as error:
        result = str(error)
    return result, perf_counter() - began


def recovered_normals(result: Refinement, capture: Capture) -> dict[int, Array]:
    """Of the recovered surfaces where they see their keypoints, per image id, camera frame."""
    normals = {}
    for image_id, image in capture.reconstruction.images.items():
        recovered = result.sidecar.images.get(image.name)
        if recovered is None or recovered.normal_in_cam is None or recovered.distance is None:
            continue
        normal = np.array(recovered.normal_in_cam)
        normals[image_id] = np.tile(normal, (image.num_points2D(), 1))
        if recovered.surface is not None:
            rays = image.camera.cam_ray_from_img(np.array([point2D.xy for point2D in image.points2D]))
            rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
            normals[image_id], _ = recovered.surface.local_planes(rays, normal, recovered.distance)
    return normals


def true_slope(capture: Capture) -> float:
    """Root mean square angle of the true surface to its mean plane at the keypoints, degrees."""
    planes = {i: np.broadcast_to(normal, capture.normals_in_cam(i).shape) for i, (normal, _) in capture.planes.items()}
    return slope_error(planes, capture)


def shape_error(normals: dict[int, Array], capture: Capture) -> float:
    """`slope_error` of what is left when each image's mean error, a tilt of its whole surface, is taken away."""
    squares = []
    for image_id, found in normals.items():
        error = found - capture.normals_in_cam(image_id)
        error = error[np.isfinite(error).all(axis=1)]
        squares.append(((error - error.mean(axis=0)) ** 2).sum(axis=1))
    return float(np.degrees(np.sqrt(np.mean(np.concatenate(squares)))))


def true_regulariser(capture: Capture, observations: Observations, taking_part: Array) -> tuple[float, int]:
    """The printed regulariser of the true normals, and how many degrees of freedom it weighs."""
    total, free = 0.0, 0
    for i, image_id in enumerate(observations.image_ids.tolist()):
        mine = taking_part[observations.image[taking_part] == i]
        pairs = neighbour_weights(observations.pixel[mine], RADIUS).tocoo()
        true = capture.normals_in_cam(image_id)[observations.point2D_idx[mine]]
        total += float(pairs.data @ ((true[pairs.row] - true[pairs.col]) ** 2).sum(axis=1))
        free += 2 * max(len(mine) - 1, 0)
    return total, free


def as_printed(start: pycolmap.Reconstruction, capture: Capture, draws: Draws) -> dict[str, float]:
    """RMSE, slope error and seconds of the printed soft constraint."""
    seed = capture.options.seed
    arrangement = arrange(read_observations(start), RefinerOptions(scenario=capture.scenario), ImageNotes())
    observations = arrangement.observations
    began = perf_counter()
    try:
        problem = level_start(arrangement)
        pairing = pair(problem, arrangement.reference)
        taking_part = np.sort(np.concatenate([pairing.of_reference, pairing.others]))
        regulariser, free = true_regulariser(capture, observations, taking_part)
        result = adjust_as_printed(
            problem,
            observations.pixel,
            reference=arrangement.reference,
            smoothness=free * capture.options.pixel_noise**2 / regulariser,
            radius=RADIUS,
            residual="pixels",
            settings=SolverSettings(max_num_iterations=PRINTED_ITERATIONS, function_tolerance=1e-6),
        )
    except RefractError as error:
        draws.told.append(f"{draws.row.name}, seed {seed}, as printed: {error}")
        return {}
    seconds = perf_counter() - began
    if result.termination != "convergence":
        draws.told.append(f"{draws.row.name}, seed {seed}, as printed: {result.message}")
    if result.termination == "failure":
        return {}
    model = pycolmap.Reconstruction(start)
    found = np.isfinite(result.points).all(axis=1)
    for point3D_id in set(model.point3D_ids()) - set(observations.point3D_ids[found].tolist()):
        model.delete_point3D(point3D_id)
    for point3D_id, xyz in zip(observations.point3D_ids[found].tolist(), result.points[found], strict=True):
        model.point3D(point3D_id).xyz = xyz
    normals = {}
    for i, image_id in enumerate(observations.image_ids.tolist()):
        mine = observations.image == i
        normals[image_id] = np.full((capture.reconstruction.image(image_id).num_points2D(), 3), np.nan)
        normals[image_id][observations.point2D_idx[mine]] = result.normals[mine]
    return {
        "printed": point_rmse(model, capture),
        "printed_slope": slope_error(normals, capture),
        "printed_shape": shape_error(normals, capture),
        "printed_seconds": seconds,
        "printed_kept": float(found.mean()),
    }


def measure(draws: Draws, seed: int, *, printed: bool, given: bool) -> None:
    """Refine one draw of a row in every way; `printed` is for small scenes."""
    row = draws.row
    capture = simulate(row.options(seed, PRINTED_IMAGES, PRINTED_POINTS) if printed else row.options(seed))
    start = ignore_refraction(capture)
    value = {
        "ignored": point_rmse(start, capture),
        "bound": bayesian_bound(capture, level_prior=row.scenario == "moving_interface"),
        "true_slope": true_slope(capture),
    }
    draws.values.append(value)
    ways = {
        "hard": RefinerOptions(scenario=row.scenario, interface_shape="plane"),
        "soft": RefinerOptions(scenario=row.scenario, interface_shape="soft"),
    }
    if given and row.slope_deg > 0:
        ways["given"] = RefinerOptions(scenario=row.scenario, interface_shape="soft", wave_slope_deg=row.slope_deg)
    for way, options in ways.items():
        result, seconds = timed(start, options)
        value[f"{way}_seconds"] = seconds
        if isinstance(result, str):
            draws.told.append(f"{row.name}, seed {seed}, {way}: {result}")
            continue
        value[way] = point_rmse(result.reconstruction, capture)
        normals = recovered_normals(result, capture)
        value[f"{way}_slope"], value[f"{way}_shape"] = slope_error(normals, capture), shape_error(normals, capture)
        value[f"{way}_kept"] = result.reconstruction.num_points3D() / capture.reconstruction.num_points3D()
        value[f"{way}_estimate"] = result.sidecar.statistics.get("waves", {}).get("slope_deviation_deg", math.nan)
        if way == "soft":
            draws.unconverged += not result.converged
            if "waves" not in result.sidecar.statistics:
                draws.told.append(f"{row.name}, seed {seed}, {way}: fell back to planes")
    if printed and row.slope_deg > 0:
        value.update(as_printed(start, capture, draws))


def shown(values: Array, scale: float = 1.0, digits: int = 3) -> str:
    """Median, least and largest; how many there are none of."""
    good = scale * values[np.isfinite(values)]
    lost = len(values) - len(good)
    if not len(good):
        return f"fails {lost}/{len(values)}"
    text = f"{np.median(good):.{digits}g}"
    if len(good) > 1:
        text += f" ({good.min():.{digits}g} - {good.max():.{digits}g})"
    return text + (f", fails {lost}/{len(values)}" if lost else "")


def middle(values: Array, form: str = ".3g") -> str:
    """The median of those that there are."""
    good = values[np.isfinite(values)]
    return f"{np.median(good):{form}}" if len(good) else "-"


def accuracy_tables(done: Sequence[Draws], *, printed: bool, given: bool) -> str:
    """Errors of the points, then slopes and times."""
    points, slopes = [], []
    for draws in done:
        row = draws.row
        wavy = row.slope_deg > 0
        waves = [row.waves, f"{row.slope_deg:g}"]
        ratio = draws.ratio("soft", "hard")
        points.append([
            row.scenario, *waves, shown(1e3 * draws.of("ignored")), shown(1e3 * draws.of("hard")),
            *([shown(1e3 * draws.of("printed")) if wavy else "-"] if printed else []),
            shown(1e3 * draws.of("soft")),
            *([shown(1e3 * draws.of("given")) if wavy else "-"] if given else []),
            middle(1e3 * draws.of("bound")), middle(draws.ratio("soft", "bound"), ".2f"),
            middle(ratio, ".3f"), f"{np.nanmax(ratio):.3f}" if np.isfinite(ratio).any() else "-",
        ])  # fmt: skip
        slopes.append([
            row.scenario, *waves, middle(draws.of("true_slope")), middle(draws.of("hard_slope")),
            *([middle(draws.of("printed_slope"))] if printed else []),
            middle(draws.of("soft_slope")), middle(draws.of("hard_shape")),
            *([middle(draws.of("printed_shape"))] if printed else []),
            middle(draws.of("soft_shape")), middle(draws.of("soft_estimate")),
            middle(100 * draws.of("soft_kept"), ".1f"),
            f"{len(draws.values) - draws.unconverged}/{len(draws.values)}",
            middle(draws.of("hard_seconds"), ".1f"), middle(draws.of("soft_seconds"), ".1f"),
            middle(draws.ratio("soft_seconds", "hard_seconds"), ".1f"),
            *([middle(draws.of("printed_seconds"), ".0f")] if printed else []),
        ])  # fmt: skip
    as_printed_head = ["soft as printed"] if printed else []
    first = table(
        ["scenario", "waves", "slope [deg]", "refraction ignored", "hard", *as_printed_head, "soft",
         *(["soft, slope given"] if given else []), "bound", "soft / bound", "soft / hard, median", "largest"],
        points,
    )  # fmt: skip
    second = table(
        ["scenario", "waves", "slope [deg]", "true slope [deg]", "slope error, hard", *as_printed_head, "soft",
         "shape error, hard", *as_printed_head, "soft", "slope as estimated", "points kept [%]", "converged",
         "hard [s]", "soft [s]", "soft / hard",
         *(["as printed [s]"] if printed else [])],
        slopes,
    )  # fmt: skip
    told = [f"- {sentence}" for draws in done for sentence in draws.told]
    parts = [first, f"Slopes, and what it takes; medians over the seeds.\n\n{second}"]
    if told:
        parts.append("What ended otherwise:\n\n" + "\n".join(told))
    return "\n\n".join(parts)


def misses(done: Sequence[Draws]) -> list[str]:
    missed = []
    for draws in done:
        name = draws.row.name
        for seed, ratio in enumerate(draws.ratio("soft", "hard")):
            if ratio > WORSE_LIMIT:
                missed.append(f"{name}, seed {seed}: soft / hard is {ratio:.3f}, more than {WORSE_LIMIT}")
        lost = int(np.isnan(draws.of("soft")).sum())
        if lost:
            missed.append(f"{name}: soft gave up on {lost} of {len(draws.values)}")
        if draws.unconverged:
            missed.append(f"{name}: {draws.unconverged} of {len(draws.values)} did not converge")
    return missed


def time_section(line: ProgressLine) -> str:
    """Hard against soft."""
    rows = []
    for scenario in SCENARIOS:
        row = Row(scenario, "swell", TIMED_SLOPE_DEG)
        start = ignore_refraction(simulate(row.options(0, num_points=TIMED_POINTS)))
        line.step(f"time, {scenario}")
        hard = RefinerOptions(scenario=scenario, interface_shape="plane")
        soft = RefinerOptions(scenario=scenario, interface_shape="soft")
        runs = [(timed(start, hard), timed(start, soft)) for _ in range(REPEATS)]
        a, b = (float(np.median([run[way][1] for run in runs])) for way in (0, 1))
        failed = ["*" if isinstance(runs[0][way][0], str) else "" for way in (0, 1)]
        rows.append([
            scenario, str(start.compute_num_observations()), f"{a:.2f}{failed[0]}", f"{b:.2f}{failed[1]}",
            f"{b / a:.1f}",
        ])  # fmt: skip
    intro = TIMES.format(images=NUM_IMAGES, points=TIMED_POINTS, slope=TIMED_SLOPE_DEG, repeats=REPEATS)
    if any("*" in cell for row in rows for cell in row):
        intro += " A star: until it gave up."
    return f"{intro}\n\n{table(['scenario', 'observations', 'hard [s]', 'soft [s]', 'soft / hard'], rows)}"


def large_section(line: ProgressLine) -> tuple[str, list[str]]:
    """Soft alone on a survey."""
    line.step("a large survey")
    capture = simulate(
        SceneOptions(
            scenario="moving_interface", layout="survey", num_images=LARGE_IMAGES, num_points=LARGE_POINTS,
            pixel_noise=NOISE, tilt_deg=3.0, depth=2.0, distance_ratio=0.3, wave_slope_deg=TIMED_SLOPE_DEG,
            wavelength=WAVES["swell"],
        )
    )  # fmt: skip
    start = ignore_refraction(capture, num_threads=-1)
    before = point_rmse(start, capture)
    observations = start.compute_num_observations()
    intro = LARGE.format(
        images=LARGE_IMAGES, slope=TIMED_SLOPE_DEG, per_image=observations / LARGE_IMAGES, observations=observations,
        points=start.num_points3D(),
    )  # fmt: skip
    reset_peak()
    held = peak_since_reset()
    result, seconds = timed(start, RefinerOptions(scenario="moving_interface", interface_shape="soft"))
    peak = peak_since_reset()
    if isinstance(result, str):
        return f"{intro}\n\n> ERROR: {result}\n\nAfter {seconds:.0f} s.", ["the large survey: soft gave up"]
    after = point_rmse(result.reconstruction, capture)
    head = [
        "soft [s]", "peak memory [MB]", "of it the scene", "refraction ignored [mm]", "soft [mm]", "points kept [%]",
        "converged",
    ]  # fmt: skip
    kept = result.reconstruction.num_points3D() / start.num_points3D()
    body = [
        f"{seconds:.0f}", f"{peak:.0f}", f"{held:.0f}", f"{1e3 * before:.2f}", f"{1e3 * after:.2f}",
        f"{100 * kept:.1f}", "yes" if result.converged else "no",
    ]  # fmt: skip
    missed = [] if result.converged else ["the large survey: did not converge"]
    return f"{intro}\n\n{table(head, [body])}", missed


def intro(seeds: int) -> str:
    options = Row("moving_interface", "swell", 1.0).options(0)
    bands = {name: f"{low:g} to {high:g} m" for name, (low, high) in WAVES.items()}
    return INTRO.format(
        images=NUM_IMAGES, points=NUM_POINTS, noise=NOISE, depth=options.depth, water=options.water_depth,
        tilt=options.tilt_deg, seeds=seeds, **bands,
    )  # fmt: skip


def small_intro() -> str:
    return PRINTED.format(images=PRINTED_IMAGES, points=PRINTED_POINTS, radius=RADIUS, iterations=PRINTED_ITERATIONS)


def introduction(seeds: int, *, small: bool, first: bool) -> str:
    """Of a section; what the columns are is said in the first."""
    return "\n\n".join(([intro(seeds)] if first else []) + ([small_intro()] if small else []))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="scenes per row (5); 0: no rows")
    parser.add_argument(
        "--only",
        nargs="+",
        default=[""],
        metavar="ROW",
        help="rows whose name has this in it: moving_interface/swell/2",
    )
    parser.add_argument(
        "--printed", choices=("0", "1", "only"), default="0", help="also the paper's own terms, or only those: slow (0)"
    )
    parser.add_argument("--given", type=int, choices=(0, 1), default=0, help="also soft with the true slope given (0)")
    parser.add_argument("--time", type=int, choices=(0, 1), default=1, help="hard against soft, 1000 points (1)")
    parser.add_argument("--large", type=int, choices=(0, 1), default=0, help="also 200 images of 2000 keypoints (0)")
    parser.add_argument("--output_path", type=Path, default=RESULTS / "waves.md", help="Markdown file to write")
    arguments = parser.parse_args()
    if arguments.seeds < 0:
        parser.error("--seeds must be 0 or more")
    rows = [row for row in all_rows() if any(part in row.name for part in arguments.only)]
    if not rows:
        parser.error(f"--only {' '.join(arguments.only)}: no row of that name; there is {next(all_rows()).name}")
    if arguments.seeds == 0:
        rows = []
    sizes = {"0": [False], "1": [False, True], "only": [True]}[arguments.printed]
    num_rows = {printed: sum(row.slope_deg > 0 or not printed for row in rows) for printed in sizes}
    line = ProgressLine(sum(num_rows.values()) * arguments.seeds + len(SCENARIOS) * arguments.time + arguments.large)
    # The first refinement of a process waits for the compiler.
    warm = ignore_refraction(simulate(Row("moving_interface", "swell", 1.0).options(0, num_points=100)))
    for shape in ("plane", "soft"):
        timed(warm, RefinerOptions(scenario="moving_interface", interface_shape=shape))
    arguments.output_path.parent.mkdir(parents=True, exist_ok=True)
    done: dict[bool, list[Draws]] = {printed: [] for printed in sizes}
    sections: list[str] = []
    for printed in sizes:
        for row in rows:
            if printed and row.slope_deg == 0:
                continue
            draws = Draws(row=row)
            for seed in range(arguments.seeds):
                line.step(f"{row.name}, seed {seed}{', as printed' if printed else ''}")
                measure(draws, seed, printed=printed, given=bool(arguments.given))
            done[printed].append(draws)
            sections = [
                f"{introduction(arguments.seeds, small=small, first=small == sizes[0])}\n\n"
                f"{accuracy_tables(part, printed=small, given=bool(arguments.given))}"
                for small, part in done.items()
                if part
            ]
            progress = f"{sum(map(len, done.values()))} of {sum(num_rows.values())} rows so far."
            parts = [f"# {TITLE}", f"    {command()}", environment(), progress, *sections]
            arguments.output_path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    missed = misses(done.get(False, []))
    if arguments.time:
        sections.append(time_section(line))
    if arguments.large:
        section, found = large_section(line)
        sections.append(section)
        missed += found
    line.clear()
    return publish(arguments.output_path, TITLE, sections, missed)


if __name__ == "__main__":
    sys.exit(main())
