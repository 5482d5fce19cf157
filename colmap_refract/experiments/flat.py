"""Comparison through a flat interface: a board in a tank, seen through its front."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_refract.experiments import methods
from colmap_refract.experiments.measure import Plan, compare
from colmap_refract.experiments.parallel import Say
from colmap_refract.experiments.results import Case, ExperimentResult, Finding
from colmap_refract.experiments.scenes import flat_setups

_FIXED, _STATIC, _MOVING = "fixed camera", "static interface", "moving interface"
_HARD = methods.HARD.name

PLAN = Plan(
    name="flat",
    title="Flat interface",
    text=(
        "A board of 130 markers, 0.48 by 0.36 m, hangs 0.22 m behind the front of a tank, turned by 10 to 20 degrees; "
        "the front is 0.5 m from the camera. Fixed camera: 15 images, the tank turned by 8 degrees (root mean square) "
        "and shifted by up to 3 cm between them, and one before the water was poured in. Static interface: 10 images, "
        "the camera moved by up to 25 cm. Moving interface: 10 images, both moved. The tank's glass is left out."
    ),
    view="plan",
    outlier_limit=0.01,
    methods=(
        methods.IGNORED, methods.TURBULENCE, methods.REFRACTION, methods.REFRACTION_KNOWN, methods.TRD, methods.HARD,
        methods.REFERENCE,
    ),
    findings=(
        Finding(
            text="hard is better than DfT with a fixed camera", better=Case(scenario=_FIXED, method=_HARD),
            worse=Case(scenario=_FIXED, method=methods.TURBULENCE.name),
        ),
        Finding(
            text="hard is better than DfR with a fixed camera", better=Case(scenario=_FIXED, method=_HARD),
            worse=Case(scenario=_FIXED, method=methods.REFRACTION.name),
        ),
        Finding(
            text="hard is better than SfM with a static interface", better=Case(scenario=_STATIC, method=_HARD),
            worse=Case(scenario=_STATIC, method=methods.IGNORED.name),
        ),
        Finding(
            text="hard is better than SfM with a moving interface", better=Case(scenario=_MOVING, method=_HARD),
            worse=Case(scenario=_MOVING, method=methods.IGNORED.name),
        ),
        Finding(
            text="hard errs slightly more with a moving interface than with a static one",
            better=Case(scenario=_STATIC, method=_HARD), worse=Case(scenario=_MOVING, method=_HARD),
        ),
    ),
)  # fmt: skip


def run(
    seeds: Sequence[int],
    say: Say,
    *,
    markers: tuple[int, int] = (13, 10),
    images: tuple[int, int, int] = (15, 10, 10),
) -> ExperimentResult:
    """All methods on all seeds; the sizes are those of `flat_setups`."""
    return compare(PLAN, lambda seed: flat_setups(seed, markers=markers, images=images), seeds, say)
