"""The simulated captures: what they promise.

What this does not prove: that a solver finds the truth again. That is for the tests of the adjustment.
"""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pycolmap
import pytest

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers, plane_in_world
from colmap_refract.options import Scenario
from colmap_refract.simulation import (
    Capture,
    SceneOptions,
    ignore_refraction,
    least_path_direction,
    point_rmse,
    simulate,
)

SCENARIOS: tuple[Scenario, ...] = get_args(Scenario)


def keypoints(capture: Capture, image_id: int) -> Array:
    return np.array([point2D.xy for point2D in capture.reconstruction.image(image_id).points2D])


def world_planes(capture: Capture) -> Array:
    """(images, 4)"""
    planes = []
    for image_id, (normal, distance) in capture.planes.items():
        pose = capture.reconstruction.image(image_id).cam_from_world().matrix()
        in_world, offset = plane_in_world(normal, distance, pose[:, :3], pose[:, 3])
        planes.append([*in_world, offset])
    return np.array(planes)


def cam_planes(capture: Capture) -> Array:
    """(images, 4)"""
    return np.array([[*normal, distance] for normal, distance in capture.planes.values()])


def test_a_seed_determines_the_capture() -> None:
    first, same, other = (simulate(SceneOptions(scenario="moving_interface", seed=seed)) for seed in (4, 4, 5))
    for image_id in first.planes:
        assert np.array_equal(keypoints(first, image_id), keypoints(same, image_id))
    assert point_rmse(same.reconstruction, first) < 1e-12
    assert point_rmse(other.reconstruction, first) > 0.01


@pytest.mark.parametrize("noise", [0.0, 0.5, 2.0])
def test_noise_is_as_asked(noise: float) -> None:
    capture = simulate(SceneOptions(scenario="static_interface", pixel_noise=noise))
    residual = np.concatenate([keypoints(capture, i) - exact for i, exact in capture.pixels.items()])
    assert residual.size > 10_000
    # 11 k samples know their standard deviation to 0.7 %.
    assert np.std(residual) == pytest.approx(noise, rel=0.03, abs=1e-12)
    assert np.mean(residual) == pytest.approx(0, abs=0.05 * noise + 1e-12)


def test_outliers_are_as_asked() -> None:
    capture = simulate(SceneOptions(scenario="static_interface", outlier_ratio=0.1))
    assert len(capture.outliers) / capture.reconstruction.compute_num_observations() == pytest.approx(0.1, abs=0.015)
    for image_id, exact in capture.pixels.items():
        far = np.linalg.norm(keypoints(capture, image_id) - exact, axis=1) > 4
        outlier = np.array([(image_id, idx) in capture.outliers for idx in range(len(exact))])
        assert not (far & ~outlier).any()
        assert far[outlier].mean() > 0.9


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("layers", [Layers(), Layers(thickness=(0.02, 0.01), index=(1.52, 1.49, 1.34))])
def test_the_model_and_its_planes_explain_the_pixels(scenario: Scenario, layers: Layers) -> None:
    capture = simulate(SceneOptions(scenario=scenario, layers=layers, dry_point_ratio=0.1 * (scenario[0] in "ms")))
    model = capture.reconstruction
    assert model.is_valid()
    assert model.num_points3D() > 350
    assert min(point.track.length() for point in model.points3D.values()) >= 2
    for image_id, image in model.images.items():
        idxs = image.get_observation_point2D_idxs()
        assert len(idxs) > 100
        points = np.array([model.point3D(image.point2D(idx).point3D_id).xyz for idx in idxs])
        direction = least_path_direction(image.cam_from_world() * points, *capture.planes[image_id], layers)
        np.testing.assert_allclose(image.camera.img_from_cam(direction), capture.pixels[image_id][idxs], atol=1e-6)
        assert (keypoints(capture, image_id) >= 0).all()
        # Refraction matters in all of them, or nothing that follows would be a test.
        straight = image.camera.img_from_cam(image.cam_from_world() * points)
        assert np.median(np.linalg.norm(straight - capture.pixels[image_id][idxs], axis=1)) > 5


def test_moving_interfaces_differ() -> None:
    planes = world_planes(simulate(SceneOptions(scenario="moving_interface", tilt_deg=5, num_images=200)))
    assert len(np.unique(planes.round(6), axis=0)) == 200
    tilt = np.degrees(np.arccos(planes[:, 2]))
    assert np.sqrt(np.mean(tilt**2)) == pytest.approx(5, rel=0.15)


@pytest.mark.parametrize("scenario", ["moving_interface", "fixed_camera"])
def test_a_group_of_frames_shares_its_interface(scenario: Scenario) -> None:
    planes = world_planes(simulate(SceneOptions(scenario=scenario, frames_per_interface=5)))
    assert np.abs(planes.reshape(3, 5, 4) - planes.reshape(3, 5, 4)[:, :1]).max() < 1e-12
    assert len(np.unique(planes.round(6), axis=0)) == 3


def test_a_static_interface_is_one_plane_of_the_world() -> None:
    capture = simulate(SceneOptions(scenario="static_interface"))
    assert capture.world_plane is not None
    normal, offset = capture.world_plane
    assert np.abs(world_planes(capture) - [*normal, offset]).max() < 1e-12
    assert np.ptp(cam_planes(capture), axis=0).min() > 0.01


def test_a_fixed_camera_has_one_pose_and_many_planes() -> None:
    capture = simulate(SceneOptions(scenario="fixed_camera"))
    poses = np.array([image.cam_from_world().matrix() for image in capture.reconstruction.images.values()])
    assert np.array_equal(poses, np.broadcast_to(poses[0], poses.shape))
    assert len(np.unique(cam_planes(capture).round(6), axis=0)) == len(poses)


def test_a_housing_has_one_plane_per_camera() -> None:
    capture = simulate(SceneOptions(scenario="camera_housing", num_images=12, num_cameras=2, tilt_deg=4))
    planes, images = cam_planes(capture), list(capture.reconstruction.images.values())
    camera_ids = np.array([image.camera_id for image in images])
    assert set(camera_ids) == {1, 2}
    for camera_id in (1, 2):
        assert np.ptp(planes[camera_ids == camera_id], axis=0).max() == 0
    assert len(np.unique(planes, axis=0)) == 2
    np.testing.assert_allclose(np.degrees(np.arccos(planes[:, 2])), 4)


def test_a_rig_moves_as_one() -> None:
    capture = simulate(SceneOptions(scenario="static_interface", num_images=16, sensors_per_frame=2, num_cameras=2))
    model = capture.reconstruction
    assert (model.num_rigs(), model.num_cameras(), model.num_frames(), model.num_images()) == (2, 4, 8, 16)
    for frame in model.frames.values():
        first, second = (model.image(data_id.id) for data_id in sorted(frame.image_ids, key=lambda data_id: data_id.id))
        assert (first.name[:8], second.name[:8]) == ("sensor1/", "sensor2/")
        second_from_first = second.cam_from_world() * first.cam_from_world().inverse()
        known = frame.rig.sensor_from_rig(model.camera(second.camera_id).sensor_id)
        np.testing.assert_allclose(second_from_first.matrix(), known.matrix(), atol=1e-12)
        assert first.camera_id != second.camera_id
        assert np.linalg.norm(second.projection_center() - first.projection_center()) == pytest.approx(0.25)
    assert np.abs(np.ptp(world_planes(capture), axis=0)).max() < 1e-12


@pytest.mark.parametrize("model", [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"])
def test_any_camera_model_works(model: str) -> None:
    capture = simulate(SceneOptions(scenario="static_interface", num_images=4, camera_model=model))
    assert capture.reconstruction.camera(1).model_name == model
    assert capture.reconstruction.num_points3D() > 350


def test_a_narrow_view_shows_the_same_scene_from_afar() -> None:
    wide, narrow = (
        simulate(SceneOptions(scenario="static_interface", focal_length=f, width=1305, height=979)) for f in (979, 9333)
    )
    assert np.degrees(2 * np.arctan(0.5 * 1305 / 9333)) == pytest.approx(8, abs=0.01)
    extent = [np.ptp([p.xyz for p in each.reconstruction.points3D.values()], axis=0) for each in (wide, narrow)]
    np.testing.assert_allclose(extent[0], extent[1], rtol=0.2)
    water = [each.options.camera_height - each.options.interface_height for each in (wide, narrow)]
    np.testing.assert_allclose(water, 1.5, rtol=0.01)
    assert cam_planes(narrow)[:, 3].min() > 15


@pytest.mark.parametrize("layout", ["strip", "survey"])
def test_a_flight_sees_a_point_about_eight_times(layout: Any) -> None:
    capture = simulate(SceneOptions(scenario="static_interface", layout=layout, num_images=60, num_points=3000))
    assert 7 < capture.reconstruction.compute_mean_track_length() < 9
    # Some points are seen once: keypoints without a point, and a gap in the ids.
    unmatched = sum(image.num_points2D() - image.num_points3D for image in capture.reconstruction.images.values())
    assert unmatched == 0 if layout == "strip" else unmatched > 0
    assert capture.reconstruction.num_points3D() == 3000 - unmatched


def test_nadir_images_look_straight_down_and_still_have_a_baseline() -> None:
    model = simulate(SceneOptions(scenario="static_interface", oblique_deg=0)).reconstruction
    views = np.array([image.viewing_direction() for image in model.images.values()])
    np.testing.assert_allclose(views, np.broadcast_to([0, 0, 1], views.shape), atol=1e-12)
    assert np.ptp([image.projection_center()[:2] for image in model.images.values()], axis=0).min() > 0.5


def test_dry_points_stand_out_of_the_water() -> None:
    capture = simulate(SceneOptions(scenario="static_interface", dry_point_ratio=0.2))
    assert capture.world_plane is not None
    normal, offset = capture.world_plane
    dry = np.array([point.xyz @ normal < offset for point in capture.reconstruction.points3D.values()])
    assert dry.mean() == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("scenario", ["moving_interface", "static_interface", "camera_housing"])
def test_ignoring_refraction_bends_the_model(scenario: Scenario) -> None:
    capture = simulate(SceneOptions(scenario=scenario))
    model = ignore_refraction(capture)
    assert set(model.point3D_ids()) == set(capture.reconstruction.point3D_ids())
    assert np.array_equal(model.camera(1).params, capture.reconstruction.camera(1).params)
    assert 0.01 < point_rmse(model, capture) < 0.2
    assert point_rmse(capture.reconstruction, capture) < 1e-12  # the truth is left alone
    focal_ratio = ignore_refraction(capture, refine_intrinsics=True).camera(1).focal_length / 1200
    assert (
        focal_ratio == pytest.approx(1.333, rel=0.02) if scenario == "camera_housing" else abs(focal_ratio - 1) > 0.01
    )


def test_where_nothing_is_refracted_ignoring_it_is_right() -> None:
    capture = simulate(SceneOptions(scenario="static_interface", layers=Layers(index=(1.0,)), pixel_noise=0))
    model = ignore_refraction(capture)
    assert point_rmse(model, capture) < 1e-6
    assert model.compute_mean_reprojection_error() < 1e-4


def test_a_fixed_camera_starts_from_a_flat_scene() -> None:
    capture = simulate(SceneOptions(scenario="fixed_camera"))
    model = ignore_refraction(capture)
    image = model.image(1)
    points = image.cam_from_world() * np.array([point.xyz for point in model.points3D.values()])
    np.testing.assert_allclose(points[:, 2], 2.5)
    mean = {i: np.mean([keypoint_of(model, e) for e in p.track.elements], axis=0) for i, p in model.points3D.items()}
    pixels = model.camera(1).img_from_cam(points)
    np.testing.assert_allclose(np.asarray(pixels), np.array([mean[i] for i in model.points3D]), atol=1.0)


def keypoint_of(model: pycolmap.Reconstruction, element: pycolmap.TrackElement) -> Array:
    return np.array(model.image(element.image_id).point2D(element.point2D_idx).xy)


@pytest.mark.parametrize(
    "options",
    [
        {"scenario": "fixed_camera", "num_cameras": 2},
        {"scenario": "static_interface", "num_images": 15, "sensors_per_frame": 2},
        {"scenario": "static_interface", "num_images": 1},
        {"scenario": "camera_housing", "dry_point_ratio": 0.1},
        {"scenario": "moving_interface", "distance_ratio": 0.01, "tilt_deg": 20.0},
    ],
)
def test_contradictions_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(RefractError):
        simulate(SceneOptions(**options))
