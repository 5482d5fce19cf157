"""All experiments that are asked for, and their report."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

from colmap_refract.errors import RefractError
from colmap_refract.experiments.parallel import Say, together
from colmap_refract.experiments.results import ExperimentResult, merged
from colmap_refract.machine import threads

EXPERIMENTS = ("flat", "wavy", "mannequin", "brick", "pool")
"""Names, and modules of this folder with a `run(seeds, say)` each."""
Experiment = Callable[[Sequence[int], Say], ExperimentResult]


@dataclass(frozen=True, kw_only=True)
class Request:
    """What to run."""

    only: tuple[str, ...] = EXPERIMENTS
    num_seeds: int = 5
    num_threads: int = -1
    """Captures that are measured at once."""

    def __post_init__(self) -> None:
        unknown = [name for name in self.only if name not in EXPERIMENTS]
        if unknown:
            raise RefractError(f"there is no experiment '{unknown[0]}': choose among {', '.join(EXPERIMENTS)}")
        if not self.only:
            raise RefractError(f"no experiment is named: choose among {', '.join(EXPERIMENTS)}")
        if self.num_seeds < 1:
            raise RefractError(f"seeds {self.num_seeds} is no number of captures: give 1 or more")
        if self.num_threads == 0 or self.num_threads < -1:
            raise RefractError(f"num_threads {self.num_threads}: give 1 or more, or -1 for one per core")

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(range(self.num_seeds))


def experiment(name: str) -> Experiment:
    """The experiment of a name; its module is loaded now."""
    return import_module(f"colmap_refract.experiments.{name}").run  # type: ignore[no-any-return]


def one_seed(name: str, seed: int, say: Say) -> ExperimentResult:
    """An experiment on one capture of each of its set-ups."""
    from colmap_refract.files.quiet import quiet_pycolmap

    with quiet_pycolmap():
        return experiment(name)((seed,), lambda text: say(f"{text} (seed {seed})"))


def run(request: Request, say: Say) -> list[ExperimentResult]:
    """The results, each experiment once, in the paper's order."""
    names = [name for name in EXPERIMENTS if name in request.only]
    order = [(name, seed) for seed in request.seeds for name in names]
    done = together([partial(one_seed, name, seed) for name, seed in order], threads(request.num_threads), say)
    parts = dict(zip(order, done, strict=True))
    return [merged([parts[name, seed] for seed in request.seeds]) for name in names]


def write(results: Sequence[ExperimentResult], request: Request, command: str, folder: Path, say: Say) -> None:
    """Write `index.html`, `results.md`, `results.json` and the figures into a folder that exists."""
    from colmap_refract.experiments import charts, page
    from colmap_refract.experiments.scenes import PIXEL_NOISE

    figures = []
    for result in results:
        say(f"{result.name}: charts")
        figures += _figures(result)
    report = page.Report(
        command=command,
        environment=_environment(),
        noise=PIXEL_NOISE,
        seeds=request.seeds,
        results=results,
        figures=figures,
    )
    charts.check_matplotlib()
    for figure in figures:
        (folder / figure.name).write_bytes(figure.data)
    (folder / "index.html").write_text(page.page(report), encoding="utf-8")
    (folder / "results.md").write_text(page.markdown(report), encoding="utf-8")
    numbers = {result.name: _numbers(result) for result in results}
    (folder / "results.json").write_text(json.dumps(numbers, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _figures(result: ExperimentResult) -> list[Any]:
    from colmap_refract.experiments import charts
    from colmap_refract.experiments.page import Figure

    name = result.name
    out = [
        Figure(
            experiment=name, name=f"{name}_rmse.svg", data=charts.bars(result),
            text=f"{result.title}: RMSE of the points by scenario and method, mm. The numbers are in the table.",
        )
    ]  # fmt: skip
    drawn = charts.clouds(result)
    if drawn is not None:
        what = (
            "errors in depth over the board, mm"
            if result.view == "plan"
            else "found points over true ones, from the side"
        )
        out.append(
            Figure(
                experiment=name, name=f"{name}_points.png", data=drawn,
                text=f"{result.title}: {what}; the first seed.",
            )
        )  # fmt: skip
    out += [
        Figure(experiment=name, name=f"{picture.name}.png", data=charts.png(picture.image), text=picture.text)
        for picture in result.pictures
    ]
    return out


def _numbers(result: ExperimentResult) -> dict[str, Any]:
    """Every run and bound; null where there is nothing."""

    def plain(row: dict[str, Any]) -> dict[str, Any]:
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}

    return {
        "runs": [plain(asdict(run)) for run in result.runs],
        "bounds": [plain(asdict(bound)) for bound in result.bounds],
        "facts": {fact.text: fact.value for fact in result.facts},
        "seconds": result.seconds,
    }


def _environment() -> str:
    libraries = ", ".join(f"{name} {version(name)}" for name in ("pycolmap", "pyceres", "numpy", "numba"))
    return f"Python {platform.python_version()}, {libraries}; {threads(-1)} cores"
