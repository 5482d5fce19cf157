"""Comparison through a wavy surface: a board on the bottom of a tank, seen from above."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_refract.experiments import methods
from colmap_refract.experiments.measure import Plan, compare
from colmap_refract.experiments.parallel import Say
from colmap_refract.experiments.results import Case, ExperimentResult, Finding
from colmap_refract.experiments.scenes import wavy_setups

_FIXED, _STATIC, _MOVING = "fixed camera", "static interface", "moving interface"
_HARD, _SFM = methods.HARD.name, methods.IGNORED.name

PLAN = Plan(
    name="wavy",
    title="Wavy surface",
    text=(
        "A board of 130 markers, 0.48 by 0.36 m, lies on the bottom of a tank under 0.25 m of water, the camera "
        "0.5 m above the water. Waves of 0.1 to 0.3 m, new in every image, have slopes of 1.5 degrees (root mean "
        "square); the inclinations of the tank are 5 degrees (root mean square). Fixed camera, moving with tank "
        "and board: 20 images at each of 3 inclinations, and one without water. Static interface: 15 images, no "
        "inclination, the camera moved by up to 25 cm. Moving interface: 20 images, each of another inclination "
        "and place. The bound is that of a solver that knows the statistics of the waves; DfT and TRD know more, "
        "and can be below it."
    ),
    view="plan",
    outlier_limit=0.03,
    methods=(
        methods.IGNORED, methods.TURBULENCE, methods.REFRACTION, methods.REFRACTION_KNOWN, methods.TRD, methods.HARD,
        methods.REFERENCE, methods.PRINTED, methods.SOFT,
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
            worse=Case(scenario=_STATIC, method=_SFM),
        ),
        Finding(
            text="hard is slightly worse than SfM with a moving interface", better=Case(scenario=_MOVING, method=_SFM),
            worse=Case(scenario=_MOVING, method=_HARD),
        ),
    ),
)  # fmt: skip


def run(
    seeds: Sequence[int],
    say: Say,
    *,
    markers: tuple[int, int] = (13, 10),
    inclinations: int = 3,
    images: tuple[int, int, int] = (20, 15, 20),
) -> ExperimentResult:
    """All methods on all seeds; the sizes are those of `wavy_setups`."""
    return compare(
        PLAN, lambda seed: wavy_setups(seed, markers=markers, inclinations=inclinations, images=images), seeds, say
    )
