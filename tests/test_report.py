"""The report says what the sidecar says, with units, and copes with what is missing."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Scenes

from colmap_refract.files.sidecar import ImageInterface, Sidecar, WorldPlane, read_sidecar, write_sidecar
from colmap_refract.interface import Layers
from colmap_refract.options import ImageNotes, Scenario
from colmap_refract.refiner.report import report

TILTED = (0.0, 0.6, 0.8)


def a_sidecar() -> Sidecar:
    """Numbers that occur nowhere else."""
    return Sidecar(
        scenario="moving_interface",
        layers=Layers(thickness=(0.0123,), index=(1.517, 1.3391)),
        images={
            "a.jpg": ImageInterface(
                image_id=1,
                normal_in_cam=TILTED,
                distance=0.777,
                group="a.jpg",
                normal_std_deg=0.31,
                distance_std=0.0077,
            ),
            "b.jpg": ImageInterface(
                image_id=2,
                normal_in_cam=(0.0, 0.0, 1.0),
                distance=0.888,
                group="pair",
                normal_std_deg=0.32,
                distance_std=0.0088,
            ),
            "c.jpg": ImageInterface(
                image_id=3,
                normal_in_cam=TILTED,
                distance=0.999,
                group="pair",
                normal_std_deg=0.32,
                distance_std=0.0088,
            ),
            "dry.jpg": ImageInterface(image_id=4),
        },
        world_planes={"pair": WorldPlane(normal_in_world=(0.0, 0.0, 1.0), offset=2.0)},
        units={"distance": "unit of the input model"},
        solver={
            "termination": "convergence",
            "converged": True,
            "message": "Function tolerance reached.",
            "num_iterations": 43,
            "cost": 2345.67,
            "gradient_max_norm": 0.00056,
            "newton_decrement": 6.7e-9,
            "loss_function_type": "cauchy",
            "loss_function_scale": 1.87,
            "refractive_index": 1.3391,
            "refractive_index_std": 0.00215,
            "reference_image": "a.jpg",
            "warnings": ["The sky is falling: stand under something."],
        },
        statistics={
            "num_images": 7,
            "num_reg_images": 4,
            "num_points3D_before": 1901,
            "num_points3D": 1887,
            "num_observations_before": 9205,
            "num_observations": 9106,
            "mean_pinhole_error_before": 3.21,
            "median_pinhole_error_before": 2.43,
            "mean_reprojection_error": 0.654,
            "median_reprojection_error": 0.543,
            "noise": 0.467,
            "num_filtered_large_error": 88,
            "num_filtered_small_angle": 11,
            "num_unusable_observations": 3,
            "num_dry_observations": 171,
        },
    )


def line_with(text: str, *words: str) -> str:
    found = [line for line in text.splitlines() if all(word in line for word in words)]
    assert len(found) == 1, (words, found)
    return found[0]


def test_every_number_of_the_sidecar_is_there() -> None:
    text = report(a_sidecar())
    assert "moving_interface" in text
    assert line_with(text, "Images", "7 (4 registered)")
    assert line_with(text, "Points", "1901 before, 1887 after")
    assert line_with(text, "Observations", "9205 before, 9106 after")
    removed = line_with(text, "Filtered")
    assert all(number in removed for number in ("88 observations", "11 points", "3 observations"))
    assert "171" in line_with(text, "dry")
    assert all(number in line_with(text, "Mean reprojection error") for number in ("3.21 px", "0.654 px"))
    assert all(number in line_with(text, "Median reprojection error") for number in ("2.43 px", "0.543 px"))
    assert "0.467 px" in line_with(text, "noise")
    alone = line_with(text, "a.jpg")
    assert all(number in alone for number in ("0.777 +- 0.0077", "36.87 +- 0.31"))
    pair = line_with(text, "pair")
    assert all(number in pair for number in ("2", "0.888 to 0.999 +- 0.0088", "0 to 36.87 +- 0.32"))
    assert line_with(text, "1 images without an interface")
    assert "1.3391 +- 0.00215" in line_with(text, "Refractive index")
    assert all(part in line_with(text, "Walls") for part in ("0.0123 model units", "1.517"))
    assert "converged after 43 iterations" in line_with(text, "Solver")
    assert "Function tolerance reached." in line_with(text, "Termination")
    assert all(part in line_with(text, "Cost") for part in ("2345.67 px^2", "cauchy", "1.87 px"))
    assert "0.00056" in line_with(text, "Gradient")
    assert "6.7e-09" in line_with(text, "Newton")
    assert line_with(text, "WARNING: The sky is falling: stand under something.")


def test_numbers_have_units() -> None:
    text = report(a_sidecar())
    assert line_with(text, "Interface", "images", "distance [model units]", "tilt [deg]")
    for label, unit in [("reprojection error", "px"), ("noise", "px"), ("Cost", r"px\^2"), ("Gradient", r"px\^2 per")]:
        for line in text.splitlines():
            if label in line:
                assert re.search(rf"[0-9] {unit}\b", line), line
    metric = report(replace(a_sidecar(), units={"distance": "metre"}))
    assert line_with(metric, "distance [m]")
    assert line_with(metric, "Size", "metres", "good to 0.99 %")
    assert "0.0123 m of index" in metric
    assert "model units" not in metric


def test_held_index_has_no_deviation() -> None:
    sidecar = a_sidecar()
    sidecar.solver["refractive_index_std"] = None
    assert "1.3391 (held)" in line_with(report(sidecar), "Refractive index")


def test_failure_is_not_overlooked() -> None:
    sidecar = a_sidecar()
    sidecar.solver["converged"] = False
    assert "DID NOT CONVERGE after 43 iterations" in line_with(report(sidecar), "Solver")


def test_nothing_removed() -> None:
    sidecar = a_sidecar()
    for key in ("num_filtered_large_error", "num_filtered_small_angle", "num_unusable_observations"):
        sidecar.statistics[key] = 0
    sidecar.statistics["num_dry_observations"] = 0
    text = report(sidecar)
    assert line_with(text, "Filtered").endswith("nothing")
    assert "dry points" not in text


def test_long_names_are_shortened() -> None:
    long = "a/very/long/folder/of/images/" * 4 + "frame_0007.jpg"
    sidecar = a_sidecar()
    images = {long: replace(sidecar.images["a.jpg"], group=long)}
    text = report(replace(sidecar, images=images))
    row = line_with(text, "frame_0007.jpg")
    assert long not in row and row.startswith("...")
    # The columns stay where their heads are.
    head = line_with(text, "Interface", "tilt")
    assert row.index("0.777") == head.index("distance")
    assert row.index("36.87") == head.index("tilt")


def test_many_interfaces_are_summarised() -> None:
    sidecar = a_sidecar()
    one = sidecar.images["a.jpg"]
    images = {f"{k:04d}.jpg": replace(one, image_id=k, group=f"{k:04d}.jpg") for k in range(500)}
    text = report(replace(sidecar, images=images))
    assert len(text.splitlines()) < 60
    assert line_with(text, "480 more", "refraction.json")


@pytest.mark.parametrize("missing", ["statistics", "solver", "units", "images", "world_planes", "options"])
def test_missing_parts(missing: str) -> None:
    """Another program, or another version, may have written less."""
    text = report(replace(a_sidecar(), **{missing: {}}))
    assert "moving_interface" in text
    assert "Traceback" not in text


@pytest.mark.parametrize("part", ["statistics", "solver"])
def test_missing_fields(part: str) -> None:
    whole = getattr(a_sidecar(), part)
    for key in whole:
        some = {k: v for k, v in whole.items() if k != key}
        assert report(replace(a_sidecar(), **{part: some}))
        assert report(replace(a_sidecar(), **{part: {**whole, key: None}}))


def test_missing_deviations() -> None:
    sidecar = a_sidecar()
    bare = replace(sidecar.images["a.jpg"], normal_std_deg=None, distance_std=None, group=None)
    row = line_with(report(replace(sidecar, images={"a.jpg": bare}, units={"distance": "metre"})), "a.jpg")
    assert "+-" not in row


@pytest.mark.parametrize("scenario", ["moving_interface", "static_interface", "fixed_camera", "camera_housing"])
def test_report_of_a_refinement(scenes: Scenes, tmp_path: Path, scenario: Scenario) -> None:
    """It is the same after a round trip through the file, and its numbers are the model's."""
    result = scenes(scenario).refined
    text = report(result.sidecar)
    write_sidecar(result.sidecar, tmp_path / "refraction.json")
    assert report(read_sidecar(tmp_path)) == text
    model = result.reconstruction
    assert line_with(text, "Points", f"{model.num_points3D()} after")
    assert line_with(text, "Observations", f"{model.compute_num_observations()} after")
    mean = sum(p.error * p.track.length() for p in model.points3D.values()) / model.compute_num_observations()
    assert f"{mean:.3g} px with it" in line_with(text, "Mean reprojection error")
    assert "None" not in text and "?" not in text and "nan" not in text
    assert max(len(line) for line in text.splitlines() if not line.startswith("WARNING")) <= 120


def test_report_of_a_metric_refinement_with_groups(scenes: Scenes) -> None:
    scene = scenes("moving_interface", frames_per_interface=3)
    names = {i: image.name for i, image in scene.model.images.items()}
    groups = {name: f"tilt {(i - 1) // 3}" for i, name in names.items()}
    result = scene.refine(
        interface_distance=scene.capture.planes[1][1],
        reference_image=names[1],
        notes=ImageNotes(interface_groups=groups),
    )
    text = report(result.sidecar)
    for group in set(groups.values()):
        assert re.search(rf"^{group} +3 ", text, re.MULTILINE)
    assert "model units" not in text
    assert re.search(r"good to [0-9.]+ %", line_with(text, "Size"))
