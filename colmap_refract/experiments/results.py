"""What an experiment brings: the runs of all methods, the noise bounds, and what the paper found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_refract.interface import Array

Measure = Literal["rmse", "outliers"]
View = Literal["plan", "side"]

_SAME = 0.05
"""Relative difference of medians that nothing is concluded from."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One method on one capture. Lengths are metres, not a number where the method failed."""

    scenario: str
    """Name of the capture in its experiment."""
    method: str
    seed: int
    rmse: float = np.nan
    """Root mean square error of the points that the method gives, after a similarity alignment to the truth."""
    median: float = np.nan
    """Median of the same errors."""
    outliers: float = np.nan
    """Part of the points whose error is larger than the experiment's limit."""
    kept: float = np.nan
    """Part of the capture's points that the method gives."""
    seconds: float = np.nan
    failure: str = ""
    """What the user is told in place of a result."""
    remark: str = ""
    """What the method says of its result, such as that it did not converge."""

    @property
    def failed(self) -> bool:
        return bool(self.failure)


@dataclass(frozen=True, kw_only=True)
class Bound:
    """What the noise leaves, however the points are found, metres: `noise_bound`, with waves `bayesian_bound`."""

    scenario: str
    seed: int
    rmse: float


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """The points of one run beside the truth, for a picture."""

    scenario: str
    method: str
    found: Array
    """(P, 3) aligned, metres."""
    true: Array
    """(P, 3)."""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture that an experiment makes itself, beside those that all have."""

    name: str
    """Of its file, without an ending."""
    image: NDArray[np.uint8]
    """(H, W, 3) RGB."""
    text: str
    """What it shows."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A method on a capture."""

    scenario: str
    method: str


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something that the paper says: that one case is better than another."""

    text: str
    """In a few words."""
    better: Case
    worse: Case
    measure: Measure = "rmse"


@dataclass(frozen=True, kw_only=True)
class Fact:
    """A number that the tables have no column for."""

    text: str
    value: str


@dataclass(frozen=True, kw_only=True)
class ExperimentResult:
    """An experiment with all of its seeds."""

    name: str
    title: str
    text: str
    """The set-up in words."""
    view: View
    """How its clouds are drawn."""
    outlier_limit: float
    """Metres."""
    scenarios: tuple[str, ...]
    methods: tuple[str, ...]
    described: tuple[tuple[str, str, str], ...]
    """Of every method its name, what it is, and what it is given."""
    runs: list[Run]
    bounds: list[Bound]
    findings: tuple[Finding, ...] = ()
    clouds: list[Cloud] = field(default_factory=list)
    """Of the first seed."""
    pictures: list[Picture] = field(default_factory=list)
    facts: list[Fact] = field(default_factory=list)
    seconds: float = np.nan

    def of(self, case: Case) -> list[Run]:
        """The runs of a method on a capture, a seed each."""
        return [run for run in self.runs if (run.scenario, run.method) == (case.scenario, case.method)]

    def values(self, case: Case, measure: Measure = "rmse") -> Array:
        """What did not fail, (n,)."""
        return np.array([getattr(run, measure) for run in self.of(case) if not run.failed])

    def middle(self, case: Case, measure: Measure = "rmse") -> float:
        """The median over the seeds; not a number where there is none."""
        values = self.values(case, measure)
        return float(np.median(values)) if len(values) else np.nan

    def bound(self, scenario: str) -> float:
        """The median over the seeds."""
        values = [bound.rmse for bound in self.bounds if bound.scenario == scenario]
        return float(np.median(values)) if values else np.nan


def merged(parts: Sequence[ExperimentResult]) -> ExperimentResult:
    """One experiment of several seeds, from a result of each; clouds and pictures are those of the first."""
    facts: dict[str, list[str]] = {}
    for part in parts:
        for fact in part.facts:
            facts.setdefault(fact.text, []).append(fact.value)
    return replace(
        parts[0],
        runs=[run for part in parts for run in part.runs],
        bounds=[bound for part in parts for bound in part.bounds],
        facts=[Fact(text=text, value="; ".join(dict.fromkeys(values))) for text, values in facts.items()],
        seconds=sum(part.seconds for part in parts),
    )


def judged(finding: Finding, result: ExperimentResult) -> str:
    """Whether what was measured agrees with the paper, in a sentence."""
    better, worse = (result.middle(case, finding.measure) for case in (finding.better, finding.worse))
    unit, scale = ("mm", 1e3) if finding.measure == "rmse" else ("% of the points", 1e2)
    if not (np.isfinite(better) and np.isfinite(worse)):
        cases = ((finding.better, better), (finding.worse, worse))
        here = [
            f"{case.method} has {scale * value:.3g} {unit}" if np.isfinite(value) else f"{case.method} has no result"
            for case, value in cases
        ]
        return f"The paper: {finding.text}. Here they cannot be compared: {', '.join(here)}."
    figures = f"{scale * better:.3g} against {scale * worse:.3g} {unit}"
    if abs(better - worse) < _SAME * max(better, worse):
        return f"The paper: {finding.text}. Here they hardly differ: {figures}."
    if better < worse:
        return f"The paper: {finding.text}. Here, too: {figures}."
    return f"The paper: {finding.text}. Here it is otherwise: {figures}."
