"""Refinement with a reference image: points on its rays, and the soft constraint as the paper prints it.

The truth is simulated by paths of least optical length, which know nothing of the solver.

What this does not show: that a reference is worth having. It is not, with noise that is the same in all images; a
reference that is better than the rest is not simulated. The printed constraint is tried with known poses, where it is
determined; with free poses it goes on for hundreds of iterations and ends where it may.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from conftest import Scene, Scenes, error_of, snapshot
from test_cli import assert_one_line

from colmap_refract.cli import main
from colmap_refract.interface import Array
from colmap_refract.options import BundleAdjustmentOptions, RefinerOptions, Scenario
from colmap_refract.refiner import printed_solution
from colmap_refract.refiner.refinement import Refinement
from colmap_refract.refiner.report import report
from colmap_refract.simulation import Capture, point_rmse, slope_error

SMALL: dict[str, Any] = {"num_images": 8, "num_points": 100, "tilt_deg": 5.0}
REFERENCE = "frame_0003.jpg"
ON_RAYS: dict[str, Any] = {"reference_rays": True, "reference_image": REFERENCE, "num_threads": 1}


def aligned(result: Refinement, capture: Capture) -> tuple[Array, Array, Array]:
    """Errors of centres (I, 3), of orientations (I,) and of normals (I,), radians, after aligning the centres."""
    found = [image for _, image in sorted(result.reconstruction.images.items())]
    true = [image for _, image in sorted(capture.reconstruction.images.items())]
    a, b = (np.array([image.projection_center() for image in images]) for images in (found, true))
    to_truth = pycolmap.estimate_sim3d(a, b)
    turn = to_truth.rotation.matrix()
    centers = to_truth.scale * a @ turn.T + to_truth.translation - b
    rotations, normals = [], []
    for f, t in zip(found, true, strict=True):
        relative = f.cam_from_world().rotation.matrix() @ turn.T @ t.cam_from_world().rotation.matrix().T
        rotations.append(np.linalg.norm(relative - np.eye(3)))
        normal = result.sidecar.images[f.name].normal_in_cam
        normals.append(np.linalg.norm(np.array(normal) - capture.planes[t.image_id][0]))
    return centers, np.array(rotations), np.array(normals)


@pytest.mark.parametrize(
    ("scenario", "residual"),
    [("moving_interface", "pixels"), ("static_interface", "scene"), ("camera_housing", "pixels")],
)
def test_without_noise_the_truth_is_found(scenes: Scenes, scenario: Scenario, residual: str) -> None:
    scene = scenes(scenario, **SMALL, pixel_noise=0.0)
    result = scene.refine(**ON_RAYS, residual=residual)
    # Metres, at a depth of some: keypoints are exact to 1e-12 or so, and the input is 20 mm off.
    assert point_rmse(scene.model, scene.capture) > 5e-3
    assert point_rmse(result.reconstruction, scene.capture) < 1e-8
    centers, rotations, normals = aligned(result, scene.capture)
    assert np.abs(centers).max() < 1e-7 and rotations.max() < 1e-7 and normals.max() < 1e-6
    assert result.converged
    seen = num_seen(scene.model)
    assert result.sidecar.statistics["reference"] == {
        "image": REFERENCE, "residual": residual, "num_points_adjusted": seen, "num_points_placed": 100 - seen,
    }  # fmt: skip


def num_seen(model: pycolmap.Reconstruction) -> int:
    """Points that the reference sees."""
    return int(next(image for image in model.images.values() if image.name == REFERENCE).num_points3D)


def lateral_noise(scene: Scene) -> float:
    """RMSE, metres, of points that are off by the reference keypoints' noise alone, seen straight at their depth."""
    truth = scene.capture.reconstruction
    image = next(image for image in truth.images.values() if image.name == REFERENCE)
    depth = (image.cam_from_world() * np.array([p.xyz for p in truth.points3D.values()]))[:, 2]
    per_axis = scene.capture.options.pixel_noise * depth / image.camera.mean_focal_length()
    return float(np.sqrt(2.0 * (per_axis**2).mean()))


@pytest.mark.parametrize("scenario", ["moving_interface", "static_interface"])
def test_the_noise_of_the_reference_is_in_all_points(scenes: Scenes, scenario: Scenario) -> None:
    scene = scenes(scenario, **SMALL)
    result = scene.refine(**ON_RAYS)
    free, found = (point_rmse(r.reconstruction, scene.capture) for r in (scene.refined, result))
    # Each residual has the reference's noise besides its own, a variance of 2 in place of 1, and the points have that
    # of their one keypoint. A quarter more for a single draw.
    expected = np.sqrt(2.0 * free**2 + lateral_noise(scene) ** 2)
    assert free < found < 1.25 * expected
    assert expected < 3 * free
    assert result.converged
    # The reference's own errors are gone: everything else has taken them.
    mean = np.mean([point.error for point in result.reconstruction.points3D.values()])
    assert mean > scene.refined.sidecar.statistics["mean_reprojection_error"]


def test_scene_and_pixels(scenes: Scenes) -> None:
    scene = scenes("moving_interface", **SMALL, pixel_noise=0.05)
    pixels, distances = (scene.refine(**ON_RAYS, residual=r) for r in ("pixels", "scene"))
    errors = [point_rmse(r.reconstruction, scene.capture) for r in (pixels, distances)]
    # The same data, weighed by the distance of the points, which differ by a factor of two or so.
    assert errors[1] < 2 * errors[0] and errors[0] < 2 * errors[1]
    assert abs(errors[1] - errors[0]) > 1e-3 * errors[0]
    assert distances.converged
    assert "model units^2" in report(distances.sidecar) and "px^2" in report(pixels.sidecar)


def test_distances_in_the_scene_make_it_small(scenes: Scenes) -> None:
    """With more noise they have no minimum where the scene is, and the user is told so."""
    scene = scenes("static_interface", **SMALL, pixel_noise=1.0)
    assert "smaller scene" in error_of(lambda: scene.refine(**ON_RAYS, residual="scene"))


def unseen_by_reference(scene: Scene, count: int) -> tuple[pycolmap.Reconstruction, set[int]]:
    """The model without some of the reference's observations, and the points they were of."""
    model = scene.copy()
    image = next(i for i in model.images.values() if i.name == REFERENCE)
    idxs = image.get_observation_point2D_idxs()[:count]
    points = {int(image.points2D[k].point3D_id) for k in idxs}
    for k in idxs:
        model.delete_observation(image.image_id, k)
    return model, points


def rmse_of(model: pycolmap.Reconstruction, capture: Capture, points: set[int]) -> float:
    some = pycolmap.Reconstruction(model)
    for point3D_id in set(some.point3D_ids()) - points:
        some.delete_point3D(point3D_id)
    return point_rmse(some, capture)


def test_points_that_the_reference_does_not_see(scenes: Scenes) -> None:
    scene = scenes("moving_interface", **SMALL)
    model, unseen = unseen_by_reference(scene, 40)
    result = scene.refine(model, **ON_RAYS)
    assert set(result.reconstruction.point3D_ids()) == set(model.point3D_ids())
    told = result.sidecar.statistics["reference"]
    seen = num_seen(model)
    assert (told["num_points_adjusted"], told["num_points_placed"]) == (seen, 100 - seen) and 40 < seen < 61
    text = report(result.sidecar)
    assert REFERENCE in text and f"Other points, placed afterwards:  {100 - seen}" in text
    # Of the others' noise alone, through planes that 60 points tell.
    assert rmse_of(result.reconstruction, scene.capture, unseen) < 3 * scene.bound


def test_outliers_of_the_reference_cost_no_others(scenes: Scenes) -> None:
    scene = scenes("moving_interface", **SMALL)
    model = scene.copy()
    image = next(i for i in model.images.values() if i.name == REFERENCE)
    rng = np.random.default_rng(5)
    wrong = image.get_observation_point2D_idxs()[::10]
    points = {int(image.points2D[k].point3D_id) for k in wrong}
    for k in wrong:
        image.points2D[k].xy = image.points2D[k].xy + rng.choice([-1, 1], 2) * rng.uniform(20, 60, 2)
    result = scene.refine(model, **ON_RAYS)
    kept = result.reconstruction.image(image.image_id)
    assert not any(kept.points2D[k].has_point3D() for k in wrong)
    # The points stay, and what others see of them.
    assert points <= set(result.reconstruction.point3D_ids())
    lost = model.compute_num_observations() - result.reconstruction.compute_num_observations()
    assert len(wrong) <= lost <= len(wrong) + 3
    assert rmse_of(result.reconstruction, scene.capture, points) < 3 * scene.bound


def test_an_image_that_shares_hardly_a_point(scenes: Scenes) -> None:
    scene = scenes("moving_interface", **SMALL)
    model = scene.copy()
    other = next(i for i in model.images.values() if i.name == "frame_0006.jpg")
    reference = next(i for i in model.images.values() if i.name == REFERENCE)
    half = set(sorted(model.point3D_ids())[:40])
    for image, drops in ((other, lambda p: p in half), (reference, lambda p: p not in half)):
        for k in image.get_observation_point2D_idxs():
            if drops(int(image.points2D[k].point3D_id)):
                model.delete_observation(image.image_id, k)
    result = scene.refine(model, **ON_RAYS)
    assert any("frame_0006.jpg" in warning and "reference" in warning for warning in result.warnings)
    assert result.reconstruction.num_points3D() == model.num_points3D()


# --- As printed ------------------------------------------------------------------------------------------------------

GENTLE: dict[str, Any] = {
    "num_images": 6, "num_points": 60, "pixel_noise": 0.2, "tilt_deg": 3.0, "depth": 2.0, "distance_ratio": 0.3,
    "wave_slope_deg": 1.5, "wavelength": (1.0, 2.5), "seed": 1,
}  # fmt: skip
PRINTED: dict[str, Any] = {
    "interface_shape": "soft_as_printed", "wave_slope_deg": 1.5, "wavelength": 1.6, "pixel_noise": 0.2,
    "num_threads": 1, "BundleAdjustment": BundleAdjustmentOptions(refine_rig_from_world=False, max_num_iterations=60),
}  # fmt: skip


def known_poses(scene: Scene) -> pycolmap.Reconstruction:
    """The true model with its points off by centimetres."""
    model = pycolmap.Reconstruction(scene.capture.reconstruction)
    rng = np.random.default_rng(3)
    for point in model.points3D.values():
        point.xyz = point.xyz + 0.02 * rng.standard_normal(3)
    return model


def test_as_printed_beats_planes_on_a_swell(scenes: Scenes) -> None:
    scene = scenes("static_interface", **GENTLE)
    model = known_poses(scene)
    planes = scene.refine(model, BundleAdjustment=PRINTED["BundleAdjustment"], num_threads=1)
    printed = scene.refine(model, **PRINTED)
    assert printed.converged
    flat, soft = (point_rmse(r.reconstruction, scene.capture) for r in (planes, printed))
    # A factor of two to three, over seeds in which planes go wrong at all.
    assert soft < 0.6 * flat
    assert set(printed.reconstruction.point3D_ids()) == set(model.point3D_ids())
    # Beside the model each image has the mean of its normals, nearer to the truth than the plane that leans on waves.
    off = []
    for result in (planes, printed):
        normals = {
            i: np.broadcast_to(result.sidecar.images[image.name].normal_in_cam, (image.num_points2D(), 3))
            for i, image in scene.capture.reconstruction.images.items()
        }
        off.append(slope_error(normals, scene.capture))
    assert off[1] < off[0]
    waves = printed.sidecar.statistics["waves"]
    # Smoothed, and without each image's mean: below the 1.5 deg of the truth.
    assert 0.3 < waves["slope_deviation_deg"] < 1.5
    text = report(printed.sidecar)
    assert "one per observation" in text and f"{waves['num_normals']} normals" in text and "(given)" in text


def test_stiffer_normals_scatter_less(scenes: Scenes) -> None:
    scene = scenes("static_interface", **GENTLE)
    model = known_poses(scene)
    options = {**PRINTED, "wave_slope_deg": None, "wavelength": None, "wave_radius": 250.0}
    scatter = [scene.refine(model, **options, wave_smoothness=s).sidecar.statistics["waves"] for s in (1e2, 1e4, 1e8)]
    assert [w["smoothness"] for w in scatter] == [1e2, 1e4, 1e8] and scatter[0]["radius_px"] == 250.0
    slopes = [w["slope_deviation_deg"] for w in scatter]
    assert slopes[0] > slopes[1] > slopes[2]
    # In the limit the normals of an image are one.
    assert slopes[2] < 0.01


# --- What cannot be --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(scenes: Scenes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model in which the reference sees few points, and one image is not registered."""
    scene = scenes("moving_interface", **SMALL)
    model, _ = unseen_by_reference(scene, num_seen(scene.model) - 3)
    lost = next(i for i in model.images.values() if i.name == "frame_0008.jpg")
    model.deregister_frame(lost.frame_id)
    path = tmp_path_factory.mktemp("model")
    model.write(path)
    return path


RAYS = ["--reference_rays", "1"]
SOFT = ["--interface_shape", "soft_as_printed"]
GIVEN = [*SOFT, "--wave_slope_deg", "1"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([*RAYS, "--reference_image", "frame_001.jpg"], "is 'frame_0001.jpg'"),
        ([*RAYS, "--reference_image", "frame_0008.jpg"], "no registered image named 'frame_0008.jpg'"),
        ([*RAYS, "--reference_image", REFERENCE], "sees 3 of"),
        ([*RAYS, "--reference_image", REFERENCE], "name one that sees more, such as 'frame_000"),
        ([*GIVEN, "--reference_image", REFERENCE], "sees 3 of"),
        ([*RAYS, "--interface_shape", "soft"], "flat interfaces"),
        ([*RAYS, "--BundleAdjustment.refine_points3D", "0"], "cannot hold them"),
        (["--residual", "scene"], "add reference_rays"),
        ([*RAYS, "--residual", "scene", "--BundleAdjustment.refine_focal_length", "1"], "intrinsics as known"),
        ([*GIVEN, "--layer_thickness", "0.1", "--layer_refractive_index", "1.5"], "leave out layer_thickness"),
        ([*GIVEN, "--refine_refractive_index", "1"], "index as known"),
        (SOFT, "give wave_slope_deg"),
        ([*SOFT, "--wave_smoothness", "0"], "wave_smoothness 0"),
        ([*SOFT, "--wave_smoothness", "nan"], "wave_smoothness nan"),
        ([*SOFT, "--wave_slope_deg", "-1"], "wave_slope_deg -1"),
        ([*GIVEN, "--wave_radius", "-5"], "wave_radius -5"),
        ([*GIVEN, "--wave_radius", "1e-3"], "holds no neighbours"),
        ([*GIVEN, "--pixel_noise", "0"], "pixel_noise 0"),
        (["--wave_smoothness", "5"], "belongs to interface_shape soft_as_printed"),
        (["--wave_radius", "5"], "belongs to interface_shape soft_as_printed"),
        ([*GIVEN, "--scenario", "camera_housing"], "does not wave"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_cannot_be(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    scenario = [] if "--scenario" in options else ["--scenario", "static_interface"]
    assert said in said_of_failure(folder, tmp_path, capfd, [*scenario, *options])


def said_of_failure(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], options: list[str]
) -> str:  # fmt: skip
    """The one line of a run that fails and writes nothing."""
    before = snapshot(folder)
    capfd.readouterr()
    status = main(["refiner", "--input_path", str(folder), "--output_path", str(tmp_path / "out"), *options])
    out, err = capfd.readouterr()
    assert (status, out) == (1, "")
    assert_one_line(err)
    assert not (tmp_path / "out").exists() and snapshot(folder) == before
    return err


@pytest.mark.parametrize(("dry", "said"), [([1], "is listed as dry"), (range(1, 8), "every image is listed as dry")])
def test_images_without_an_interface(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], dry: Any, said: str
) -> None:
    names = tmp_path / "dry.txt"
    names.write_text("".join(f"frame_{i:04d}.jpg\n" for i in dry))
    for way in (RAYS, GIVEN, ["--interface_shape", "soft"]):
        options = ["--scenario", "moving_interface", "--reference_image", "frame_0001.jpg", *way]
        assert said in said_of_failure(folder, tmp_path, capfd, [*options, "--dry_image_list_path", str(names)])


def test_too_large_for_the_printed_form(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(printed_solution, "MOST_UNKNOWNS", 1000)
    line = said_of_failure(folder, tmp_path, capfd, ["--scenario", "static_interface", *GIVEN])
    # Points, two of a normal for each of their keypoints, and nine an image.
    assert "unknowns" in line and "use interface_shape soft" in line


def test_through_the_command(scenes: Scenes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scene = scenes("moving_interface", **SMALL)
    scene.model.write(tmp_path)
    arguments = ["--input_path", str(tmp_path), "--output_path", str(tmp_path / "out"), "--num_threads", "1"]
    status = main(["refiner", *arguments, "--scenario", "moving_interface", *RAYS, "--reference_image", REFERENCE])
    out, _ = capfd.readouterr()
    assert status == 0 and f"Points it sees, adjusted:         {num_seen(scene.model)}" in out
    again = scene.refine(**ON_RAYS).reconstruction
    written = pycolmap.Reconstruction(tmp_path / "out")
    for i, point in again.points3D.items():
        np.testing.assert_allclose(written.point3D(i).xyz, point.xyz, atol=1e-9)


def test_a_reference_without_a_pose(scenes: Scenes) -> None:
    scene = scenes("moving_interface", **SMALL)
    model = scene.copy()
    model.deregister_frame(next(i for i in model.images.values() if i.name == REFERENCE).frame_id)
    assert "is not registered" in error_of(lambda: scene.refine(model, **ON_RAYS))


def test_options_in_python() -> None:
    assert "wave_slope_deg" in error_of(
        lambda: RefinerOptions(scenario="moving_interface", interface_shape="soft_as_printed")
    )
