"""Each warning appears in a scene made for it, and none in a good one."""

from __future__ import annotations

from typing import Any

import pycolmap
import pytest
from conftest import Scenes

from colmap_refract.errors import RefractError
from colmap_refract.interface import Layers
from colmap_refract.options import BundleAdjustmentOptions, RefinerOptions, Scenario
from colmap_refract.refiner.refinement import refine
from colmap_refract.simulation import ignore_refraction

REFINED_UNDER_WATER = "look as if COLMAP had refined them"


@pytest.mark.parametrize("scenario", ["moving_interface", "static_interface", "fixed_camera", "camera_housing"])
def test_good_scene_needs_no_advice(scenes: Scenes, scenario: Scenario) -> None:
    assert scenes(scenario).refined.warnings == ()


@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface"])
@pytest.mark.parametrize("camera_model", ["SIMPLE_RADIAL", "OPENCV", "SIMPLE_PINHOLE", "OPENCV_FISHEYE"])
def test_intrinsics_refined_under_water_are_called_out(scenes: Scenes, scenario: Scenario, camera_model: str) -> None:
    """They have absorbed a part of the refraction, which shows in no residual."""
    scene = scenes(scenario, camera_model=camera_model)
    model = ignore_refraction(scene.capture, refine_intrinsics=True)
    result = scene.refine(model)
    assert scene.excess(result.reconstruction) > 2.0
    assert any(REFINED_UNDER_WATER in warning and "--camera_path" in warning for warning in result.warnings)
    # With the intrinsics from air nothing is said, whatever the model's look like.
    good = pycolmap.Camera(scene.capture.reconstruction.camera(1).todict())
    mended = scene.refine(model, cameras={1: good})
    assert mended.warnings == ()
    assert scene.excess(mended.reconstruction) < 1.25


@pytest.mark.parametrize("camera_model", ["SIMPLE_RADIAL", "SIMPLE_PINHOLE"])
def test_intrinsics_refined_in_a_housing_are_called_out(scenes: Scenes, camera_model: str) -> None:
    """There they absorb so much that the plane has nothing left to explain."""
    scene = scenes("camera_housing", camera_model=camera_model)
    model = ignore_refraction(scene.capture, refine_intrinsics=True)
    try:
        said = scene.refine(model).warnings
    except RefractError as error:
        said = (str(error),)
    assert any("air" in sentence and "camera_path" in sentence for sentence in said)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"max_num_iterations": 1}, "did not converge"),
        ({"function_tolerance": 0.1}, "could still be gained"),
    ],
)
def test_solver_that_stopped_early(scenes: Scenes, options: dict[str, Any], sentence: str) -> None:
    scene = scenes("static_interface")
    result = scene.refine(BundleAdjustment=BundleAdjustmentOptions(**options))
    assert any(sentence in warning for warning in result.warnings)


@pytest.mark.parametrize("calibrated", [False, True])
@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface", "camera_housing"])
def test_nothing_refracted(scenes: Scenes, scenario: Scenario, calibrated: bool) -> None:
    """A solver finds some interface in any images; it must not be believed."""
    scene = scenes(scenario, layers=Layers(index=(1.0,)))
    cameras = dict(scene.model.cameras) if calibrated else None
    try:
        result = refine(scene.copy(), RefinerOptions(scenario=scenario), cameras=cameras)
    except RefractError as error:
        assert "the interface ran" in str(error)
    else:
        assert "Straight rays explain the images better" in result.warnings[0]


@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface", "camera_housing"])
def test_refraction_that_is_there_is_believed(scenes: Scenes, scenario: Scenario) -> None:
    doubts = ("Straight rays", "fits as well")
    warnings = scenes(scenario).refined.warnings
    assert not any(doubt in warning for warning in warnings for doubt in doubts)


@pytest.mark.parametrize(
    ("scenario", "scene_options", "sentences"),
    [
        ("static_interface", {"focal_length": 11440.0}, ("distance of the interface", "view is narrow (")),
        ("static_interface", {"oblique_deg": 0.0, "focal_length": 2400.0}, ("normal of the interface", "oblique ones")),
        ("camera_housing", {"focal_length": 2500.0, "tilt_deg": 0.0}, ("distance of the interface", "--interface_")),
        ("camera_housing", {"num_points": 40}, ("distance of the interface", "few points")),
        (
            "fixed_camera",
            {"num_images": 8, "num_points": 120, "tilt_deg": 1.5},
            ("of the points", "no larger; more im"),
        ),
    ],
)
def test_uncertain_planes(
    scenes: Scenes, scenario: Scenario, scene_options: dict[str, Any], sentences: tuple[str, ...]
) -> None:
    warnings = scenes(scenario, **scene_options).refined.warnings
    assert len(warnings) >= 1
    assert any(all(part in warning for part in sentences) for warning in warnings)


@pytest.mark.parametrize(
    ("scenario", "scene_options"),
    [
        ("static_interface", {"oblique_deg": 0.0}),
        ("camera_housing", {"focal_length": 5000.0, "num_points": 60}),
    ],
)
def test_index_that_cannot_be_told(scenes: Scenes, scenario: Scenario, scene_options: dict[str, Any]) -> None:
    scene = scenes(scenario, **scene_options)
    result = scene.refine(refine_refractive_index=True)
    assert any("refractive index" in warning and "cannot be told" in warning for warning in result.warnings)


def test_mostly_dry(scenes: Scenes) -> None:
    """Perhaps the user has taken a shore for a sea bed."""
    result = scenes("static_interface", dry_point_ratio=0.7).refined
    assert any("dry side" in warning for warning in result.warnings)
