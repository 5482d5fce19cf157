"""A table with a basket in a pool, still and with waves: hard against soft."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_refract.experiments import methods
from colmap_refract.experiments.measure import Plan, compare
from colmap_refract.experiments.parallel import Say
from colmap_refract.experiments.results import Case, ExperimentResult, Finding
from colmap_refract.experiments.scenes import (
    BASKET_HEIGHT,
    WAVE_AMPLITUDE,
    WAVE_PERIOD,
    deep_water_wavelength,
    pool_setups,
)

_STILL, _WAVES = "static interface, still", "moving interface, waves"

PLAN = Plan(
    name="pool",
    title="Table and basket in a pool",
    text=(
        "1.8 m of water, a table of 0.6 m with a basket of 0.3 m and bricks on it; the camera 0.6 m above the water, "
        "20 images along a line of 1.2 m. Still water, and long-crested waves of "
        f"{WAVE_PERIOD:g} s, which over deep water are {deep_water_wavelength(WAVE_PERIOD):.2f} m long, "
        f"{200 * WAVE_AMPLITUDE:g} cm from trough to crest. Nothing hides a point from the camera here. Outliers are "
        "points that are off by more than 3 cm, a tenth of the basket's height. The bound is that of a solver that "
        "knows the length of the waves and their slope, not their direction."
    ),
    view="side",
    outlier_limit=0.1 * BASKET_HEIGHT,
    methods=(methods.IGNORED, methods.TRD, methods.HARD, methods.REFERENCE, methods.SOFT),
    findings=(
        Finding(
            text="hard is accurate in still water", better=Case(scenario=_STILL, method=methods.HARD.name),
            worse=Case(scenario=_STILL, method=methods.IGNORED.name),
        ),
        Finding(
            text="soft compensates for the outliers that waves cause with hard", measure="outliers",
            better=Case(scenario=_WAVES, method=methods.SOFT.name),
            worse=Case(scenario=_WAVES, method=methods.HARD.name),
        ),
        Finding(
            text="soft reconstructs better than hard under waves",
            better=Case(scenario=_WAVES, method=methods.SOFT.name),
            worse=Case(scenario=_WAVES, method=methods.HARD.name),
        ),
    ),
)  # fmt: skip


def run(seeds: Sequence[int], say: Say, *, num_images: int = 20, num_points: int = 250) -> ExperimentResult:
    """All methods on all seeds; the sizes are those of `pool_setups`."""
    return compare(PLAN, lambda seed: pool_setups(seed, num_images=num_images, num_points=num_points), seeds, say)
