"""The tables of an experiment: what the Markdown file and the page both show."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from colmap_refract.experiments.results import Case, ExperimentResult
from colmap_refract.interface import Array

HEADINGS = (
    "scenario", "method", "RMSE [mm]", "noise bound [mm]", "RMSE / bound", "median error [mm]", "points found [%]",
    "points off by more [%]", "time [s]", "failed",
)  # fmt: skip


def spread(values: Array, scale: float = 1.0) -> str:
    """Median (least - largest); a dash where there is nothing."""
    scaled = scale * values[np.isfinite(values)]
    if not len(scaled):
        return "-"
    text = f"{np.median(scaled):.3g}"
    return text if len(scaled) == 1 else f"{text} ({scaled.min():.3g} - {scaled.max():.3g})"


def rows(result: ExperimentResult) -> list[list[str]]:
    """A row per scenario and method, as `HEADINGS` names the columns: median (least - largest) over the seeds."""
    out = []
    for scenario in result.scenarios:
        for method in result.methods:
            case = Case(scenario=scenario, method=method)
            runs = result.of(case)
            if not runs:
                continue

            def percent(measure: str, case: Case = case) -> str:
                values = [getattr(run, measure) for run in result.of(case) if not run.failed]
                return f"{100 * np.median(values):.3g}" if values else "-"

            bound, failed = result.bound(scenario), sum(run.failed for run in runs)
            ratio = result.middle(case) / bound
            seconds = np.median([run.seconds for run in runs])
            out.append([
                scenario, method, spread(result.values(case), 1e3), f"{1e3 * bound:.3g}" if np.isfinite(bound) else "-",
                f"{ratio:.2f}" if np.isfinite(ratio) else "-", spread(_every(result, case, "median"), 1e3),
                percent("kept"), percent("outliers"), f"{seconds:.1f}", f"{failed} of {len(runs)}",
            ])  # fmt: skip
    return out


def _every(result: ExperimentResult, case: Case, name: str) -> Array:
    return np.array([getattr(run, name) for run in result.of(case) if not run.failed])


def remarks(result: ExperimentResult) -> list[str]:
    """What failed, and what methods say of their results, a line each; the same words of several seeds are one line."""
    said: dict[tuple[str, str, str], list[int]] = {}
    for run in result.runs:
        text = f"failed: {run.failure}" if run.failed else run.remark
        if text:
            said.setdefault((run.scenario, run.method, text), []).append(run.seed)
    return [
        f"{scenario}, {method}, seed {', '.join(map(str, seeds))}: {text}"
        for (scenario, method, text), seeds in said.items()
    ]


def method_rows(results: Iterable[ExperimentResult]) -> list[list[str]]:
    """What each method is, and what it is given; once each."""
    return [list(row) for row in dict.fromkeys(row for result in results for row in result.described)]


METHOD_HEADINGS = ("method", "what it is", "what it is given besides keypoints, tracks, intrinsics and index")


def markdown(headings: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A table; numbers to the right."""
    words = {"scenario", "method", *METHOD_HEADINGS}
    align = ["---" if heading in words else "---:" for heading in headings]
    lines = [headings, align, *([cell.replace("|", "/") for cell in row] for row in body)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def outlier_heading(result: ExperimentResult, headings: Sequence[str] = HEADINGS) -> list[str]:
    """The headings with the experiment's limit in them."""
    limit = f"points off by more than {1e3 * result.outlier_limit:g} mm [%]"
    return [limit if heading == "points off by more [%]" else heading for heading in headings]
