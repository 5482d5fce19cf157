"""Running methods on captures, and judging them by the truth, all alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.experiments.methods import Method
from colmap_refract.experiments.parallel import Say
from colmap_refract.experiments.results import Bound, Cloud, ExperimentResult, Finding, Run, View
from colmap_refract.experiments.scenes import Setup
from colmap_refract.interface import Array
from colmap_refract.simulation import bayesian_bound, noise_bound
from colmap_refract.simulation.accuracy import align


@dataclass(frozen=True, kw_only=True)
class Plan:
    """An experiment before it is run; the words are those of `ExperimentResult`."""

    name: str
    title: str
    text: str
    view: View
    outlier_limit: float
    methods: tuple[Method, ...]
    findings: tuple[Finding, ...]


def compare(plan: Plan, captured: Callable[[int], Sequence[Setup]], seeds: Sequence[int], say: Say) -> ExperimentResult:
    """All methods of a plan on the captures of all seeds.

    Args:
        plan: what is compared.
        captured: the captures of a seed.
        seeds: at least one; clouds are kept of the first.
        say: told what is being done.
    """
    began = perf_counter()
    runs: list[Run] = []
    bounds: list[Bound] = []
    clouds: list[Cloud] = []
    scenarios: list[str] = []
    for number, seed in enumerate(seeds, start=1):
        where = plan.name if len(seeds) == 1 else f"{plan.name}, {number} of {len(seeds)}"
        say(f"{where}: photographing")
        for setup in captured(seed):
            if setup.name not in scenarios:
                scenarios.append(setup.name)
            say(f"{where}, {setup.name}: noise bound")
            bounds.append(bound_of(setup, seed))
            for method in plan.methods:
                if not method.suits(setup):
                    continue
                say(f"{where}, {setup.name}: {method.name}")
                run, cloud = attempt(method, setup, seed, plan.outlier_limit)
                runs.append(run)
                if cloud is not None and number == 1:
                    clouds.append(cloud)
    used = {run.method for run in runs}
    return ExperimentResult(
        name=plan.name,
        title=plan.title,
        text=plan.text,
        view=plan.view,
        outlier_limit=plan.outlier_limit,
        scenarios=tuple(scenarios),
        methods=tuple(method.name for method in plan.methods if method.name in used),
        described=tuple((m.name, m.text, m.given) for m in plan.methods if m.name in used),
        runs=runs,
        bounds=bounds,
        findings=plan.findings,
        clouds=clouds,
        seconds=perf_counter() - began,
    )


def attempt(method: Method, setup: Setup, seed: int, outlier_limit: float) -> tuple[Run, Cloud | None]:
    """One method on one capture; what fails is a run that says so."""
    began = perf_counter()
    try:
        estimate = method.estimate(setup)
        found, true = paired(estimate.points, setup)
    except (RefractError, FloatingPointError, np.linalg.LinAlgError) as error:
        failure = str(error) or type(error).__name__
        seconds = perf_counter() - began
        return Run(scenario=setup.name, method=method.name, seed=seed, seconds=seconds, failure=failure), None
    seconds = perf_counter() - began
    aligned = align(found, true, found)
    errors = np.linalg.norm(aligned - true, axis=1)
    run = Run(
        scenario=setup.name,
        method=method.name,
        seed=seed,
        rmse=float(np.sqrt(np.mean(errors**2))),
        median=float(np.median(errors)),
        outliers=float(np.mean(errors > outlier_limit)),
        kept=len(found) / setup.capture.reconstruction.num_points3D(),
        seconds=seconds,
        remark=estimate.remark,
    )
    return run, Cloud(scenario=setup.name, method=method.name, found=aligned, true=true)


def paired(points: dict[int, Array], setup: Setup) -> tuple[Array, Array]:
    """Found and true points (P, 3) of the ids that the truth has, in the order of the ids.

    Raises:
        RefractError: fewer than three finite points, which no alignment can be made of.
    """
    truth = setup.capture.reconstruction.points3D
    common = sorted(i for i, xyz in points.items() if i in truth and np.isfinite(xyz).all())
    if len(common) < 3:
        raise RefractError(f"{len(common)} points were found; three are needed for an alignment")
    return np.array([points[i] for i in common]), np.array([truth[i].xyz for i in common])


def bound_of(setup: Setup, seed: int) -> Bound:
    """The noise bound of a capture; with waves, that of who knows their statistics.

    Where many frames share an inclination it is computed for a few of each: they differ in their waves alone, so that
    the information is in proportion to their number.
    """
    capture = setup.capture if setup.thinned is None else setup.thinned
    rmse = bayesian_bound(capture) if setup.is_wavy else noise_bound(capture)
    rmse *= float(np.sqrt(capture.options.num_images / setup.capture.options.num_images))
    return Bound(scenario=setup.name, seed=seed, rmse=rmse)
