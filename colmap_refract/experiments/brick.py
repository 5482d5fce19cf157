"""Bricks under waves, a camera that is fixed to the tank: what averaging the frames of an inclination is worth."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_refract.experiments import methods
from colmap_refract.experiments.measure import Plan, compare
from colmap_refract.experiments.parallel import Say
from colmap_refract.experiments.results import Case, ExperimentResult, Finding
from colmap_refract.experiments.scenes import brick_setup

_FIXED = "fixed camera"

PLAN = Plan(
    name="brick",
    title="Bricks, with and without averaging",
    text=(
        "Three bricks, one across two, on the bottom of a tank under 0.3 m of water; the camera is fixed to the tank, "
        "0.5 m above the water. 10 inclinations of 5 degrees (root mean square), 100 frames at each, with waves of "
        "5 to 20 cm whose slopes are 2.5 degrees (root mean square). The bound is that of a solver that knows the "
        "statistics of the waves and which frames share an inclination."
    ),
    view="side",
    outlier_limit=0.01,
    methods=(methods.TURBULENCE, methods.TRD, methods.SOME, methods.TIED, methods.AVERAGED),
    findings=(
        Finding(
            text="averaging the frames of an inclination improves on a plane per frame",
            better=Case(scenario=_FIXED, method=methods.AVERAGED.name),
            worse=Case(scenario=_FIXED, method=methods.SOME.name),
        ),
        Finding(
            text="averaging improves on frames that are told to share an inclination",
            better=Case(scenario=_FIXED, method=methods.AVERAGED.name),
            worse=Case(scenario=_FIXED, method=methods.TIED.name),
        ),
    ),
)


def run(
    seeds: Sequence[int], say: Say, *, inclinations: int = 10, frames: int = 100, num_points: int = 120
) -> ExperimentResult:
    """All methods on all seeds; the sizes are those of `brick_setup`."""
    return compare(
        PLAN,
        lambda seed: [brick_setup(seed, inclinations=inclinations, frames=frames, num_points=num_points)],
        seeds,
        say,
    )
