"""Captures that many tests look at, simulated and solved once, and how tests look at errors and files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array
from colmap_refract.options import RefinerOptions, Scenario
from colmap_refract.refiner.refinement import Refinement, refine
from colmap_refract.simulation import Capture, SceneOptions, ignore_refraction, noise_bound, point_rmse, simulate

IMAGES_AND_POINTS = {"num_images": 12, "num_points": 200}


@dataclass(frozen=True)
class Scene:
    """A capture and the model that COLMAP makes of it. Tests must not alter either; `copy` is theirs."""

    capture: Capture
    model: pycolmap.Reconstruction

    def copy(self) -> pycolmap.Reconstruction:
        """The model, to be altered."""
        return pycolmap.Reconstruction(self.model)

    @cached_property
    def bound(self) -> float:
        """RMSE of the points that the noise allows, metres."""
        return noise_bound(self.capture)

    def excess(self, reconstruction: pycolmap.Reconstruction) -> float:
        """RMSE of a model's points over the noise bound."""
        return point_rmse(reconstruction, self.capture) / self.bound

    def refine(self, model: pycolmap.Reconstruction | None = None, **options: Any) -> Refinement:
        """The refined `model`, by default the scene's own; `notes` and `cameras` are those of `refine`."""
        passed = {name: options.pop(name) for name in ("notes", "cameras") if name in options}
        options = {"scenario": self.capture.scenario, **options}
        return refine(self.model if model is None else model, RefinerOptions(**options), **passed)

    @cached_property
    def refined(self) -> Refinement:
        """The model, refined with the default options."""
        return self.refine()


class Scenes:
    """Small scenes by their options, each made once."""

    def __init__(self) -> None:
        self._made: dict[str, Scene] = {}

    def __call__(self, scenario: Scenario, **options: Any) -> Scene:
        simulated = SceneOptions(scenario=scenario, **{**IMAGES_AND_POINTS, **options})
        key = repr(simulated)
        if key not in self._made:
            capture = simulate(simulated)
            self._made[key] = Scene(capture, ignore_refraction(capture))
        return self._made[key]


@pytest.fixture(scope="session")
def scenes() -> Scenes:
    return Scenes()


def error_of(call: Callable[[], object]) -> str:
    """The one line of the error that a call must end with."""
    with pytest.raises(RefractError) as caught:
        call()
    message = str(caught.value)
    assert message and "\n" not in message
    return message


def snapshot(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones included."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def centers_of(reconstruction: pycolmap.Reconstruction) -> Array:
    """Projection centres (I, 3), images by id."""
    return np.array([image.projection_center() for _, image in sorted(reconstruction.images.items()) if image.has_pose])


@pytest.fixture(scope="session")
def centers() -> Callable[[pycolmap.Reconstruction], Array]:
    return centers_of
