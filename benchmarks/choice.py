"""How often the scenario and the shape of the interface are found by what predicts held-out observations best.

python benchmarks/choice.py [--seeds 10] [--only static_interface/swell ...] [--jobs 2]

The Markdown file is written anew after every kind: a run that is interrupted keeps what it has.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from tables import RESULTS, ProgressLine, command, environment, publish, table

from colmap_refract.errors import RefractError
from colmap_refract.options import RefinerRequest, Scenario
from colmap_refract.refiner.scenario_choice import choose_scenario
from colmap_refract.simulation import SceneOptions, ignore_refraction, simulate

OPEN_WATER: tuple[Scenario, ...] = ("static_interface", "moving_interface", "fixed_camera")
WAVES = {"swell": (1.0, 2.5), "ripples": (0.02, 0.1)}
"""Shortest and longest wavelength, metres."""
STEEPNESS_DEG = {"swell": (2.0,), "ripples": (1.0,)}
NUM_IMAGES, NUM_POINTS, NOISE = 15, 250, 0.3
RATIOS, TILTS_DEG = (0.2, 0.45), (3.0, 5.0)
HOUSING_RATIO = 0.05
LEAST_RIGHT = 0.9

TITLE = "Choice of the scenario and of the shape"
INTRO = """\
`--scenario auto --interface_shape auto` on simulated captures: {images} images of {points} points, {noise} px of noise,
2 m from the cameras to the floor, the interface at {low:g} to {high:g} of it ({housing:g} in the housing), planes that
tilt by {flat:g} to {steep:g} degrees, waves as in `waves.py`; {seeds} scenes of each kind, drawn anew. *Right* are
those in which both the scenario and the shape are the true ones. Waves' true shape is soft."""


class Kind(NamedTuple):
    """What is simulated; a slope of 0 is still water."""

    scenario: Scenario
    waves: str
    slope_deg: float

    @property
    def name(self) -> str:
        return f"{self.scenario}/flat" if self.slope_deg == 0 else f"{self.scenario}/{self.waves}/{self.slope_deg:g}"

    @property
    def label(self) -> str:
        """Of the candidate that is the true one."""
        return f"{self.scenario}, {'plane' if self.slope_deg == 0 else 'soft'}"

    def options(self, seed: int) -> SceneOptions:
        rng = np.random.default_rng([seed, 7])
        ratio, tilt = rng.uniform(*RATIOS), rng.uniform(*TILTS_DEG)
        return SceneOptions(
            scenario=self.scenario, num_images=NUM_IMAGES, num_points=NUM_POINTS, pixel_noise=NOISE, depth=2.0,
            distance_ratio=HOUSING_RATIO if self.scenario == "camera_housing" else float(ratio), tilt_deg=float(tilt),
            wave_slope_deg=self.slope_deg, wavelength=WAVES.get(self.waves, (1.0, 2.5)), seed=seed,
        )  # fmt: skip


def all_kinds() -> Iterator[Kind]:
    yield Kind("camera_housing", "", 0.0)
    for scenario in OPEN_WATER:
        yield Kind(scenario, "", 0.0)
        for waves, slopes in STEEPNESS_DEG.items():
            for slope_deg in slopes:
                yield Kind(scenario, waves, slope_deg)


def choose(kind: Kind, seed: int) -> tuple[str, float]:
    """The label of what is chosen, or what the user is told instead, and seconds."""
    start = ignore_refraction(simulate(kind.options(seed)))
    began = perf_counter()
    try:
        request = RefinerRequest(scenario="auto", interface_shape="auto", num_threads=1)
        chosen = choose_scenario(start, request).chosen.label
    except RefractError as error:
        chosen = str(error)
    return chosen, perf_counter() - began


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """What was chosen for the scenes of a kind."""

    kind: Kind
    labels: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    @property
    def num_right(self) -> int:
        return self.labels.count(self.kind.label)


def findings(done: Sequence[Chosen]) -> tuple[str, list[str]]:
    """The table, and the kinds that are not found often enough."""
    rows, missed = [], []
    for chosen in done:
        kind, count = chosen.kind, len(chosen.labels)
        others = Counter(label for label in chosen.labels if label != kind.label)
        rows.append([
            kind.scenario, kind.waves or "flat", f"{kind.slope_deg:g}", f"{chosen.num_right}/{count}",
            "; ".join(f"{label} ({times})" for label, times in others.most_common()) or "-",
            f"{np.median(chosen.seconds):.0f}",
        ])  # fmt: skip
        if chosen.num_right < LEAST_RIGHT * count:
            missed.append(f"{kind.name}: right in {chosen.num_right} of {count}")
    head = ["scenario", "waves", "slope [deg]", "right", "chosen instead", "time, median [s]"]
    return table(head, rows), missed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="scenes of each kind (10)")
    parser.add_argument("--only", nargs="+", default=[""], metavar="KIND", help="kinds whose name has this in it")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="scenes at once, a process each (2)")
    parser.add_argument("--output_path", type=Path, default=RESULTS / "choice.md", help="Markdown file to write")
    arguments = parser.parse_args()
    if arguments.seeds < 1 or arguments.jobs < 1:
        parser.error("--seeds and --jobs must be 1 or more")
    kinds = [kind for kind in all_kinds() if any(part in kind.name for part in arguments.only)]
    if not kinds:
        parser.error(f"--only {' '.join(arguments.only)}: no kind of that name; there is {next(all_kinds()).name}")
    line = ProgressLine(len(kinds) * arguments.seeds)
    arguments.output_path.parent.mkdir(parents=True, exist_ok=True)
    intro = INTRO.format(
        images=NUM_IMAGES, points=NUM_POINTS, noise=NOISE, low=RATIOS[0], high=RATIOS[1], housing=HOUSING_RATIO,
        flat=TILTS_DEG[0], steep=TILTS_DEG[1], seeds=arguments.seeds,
    )  # fmt: skip
    done: list[Chosen] = []
    with ProcessPoolExecutor(arguments.jobs, multiprocessing.get_context("spawn")) as pool:
        for kind in kinds:
            chosen = Chosen(kind=kind)
            done.append(chosen)
            for label, seconds in pool.map(choose, [kind] * arguments.seeds, range(arguments.seeds)):
                line.step(kind.name)
                chosen.labels.append(label)
                chosen.seconds.append(seconds)
            parts = [f"# {TITLE}", f"    {command()}", environment(), intro, findings(done)[0]]
            arguments.output_path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    line.clear()
    text, missed = findings(done)
    return publish(arguments.output_path, TITLE, [intro, text], missed)


if __name__ == "__main__":
    sys.exit(main())
