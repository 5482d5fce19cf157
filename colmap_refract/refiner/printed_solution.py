from __future__ import annotations
from colmap_refract.estimator.adjustment import SolverSettings
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.refiner.arrangement import Arrangement
from colmap_refract.refiner.continuation import Watch
from colmap_refract.refiner.solution import Solution


def solve_as_printed(
    arrangement: Arrangement, settings: SolverSettings, earlier: Sidecar | None, watch: Watch | None
) -> Solution:
    raise NotImplementedError
