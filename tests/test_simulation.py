"""The simulated captures: their projection against the quartic and Snell's law, and what they promise.

What this does not prove: that a solver finds the truth again. That is for the tests of the adjustment.
"""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers, plane_in_world
from colmap_refract.simulation import (
    Capture,
    Scenario,
    SceneOptions,
    ignore_refraction,
    least_path_direction,
    point_rmse,
    simulate,
)

FOCAL_LENGTH = 1200.0
SCENARIOS: tuple[Scenario, ...] = get_args(Scenario)


def quartic_direction(point: Array, normal: Array, distance: float, mu: float) -> Array:
    """Direction by the polynomial of flat refraction (Agrawal et al. 2012), its one admissible root.

    `u` is where the ray crosses the plane, over the point's distance from the axis. Snell's law squared:
    `u^2 ((1 - u)^2 rho^2 + h^2) = mu^2 (1 - u)^2 (d^2 + u^2 rho^2)`.
    """
    depth = float(point @ normal)
    radial = point - depth * normal
    r2, d2, h2 = radial @ radial, distance**2, (depth - distance) ** 2
    one = (1 - mu) * (1 + mu)
    polynomial = np.array([r2 * one, -2 * r2 * one, r2 * one + h2 - mu**2 * d2, 2 * mu**2 * d2, -(mu**2) * d2])
    # On the axis the first coefficients vanish, and dividing by them overflows.
    roots = np.roots(np.where(abs(polynomial) < 1e-30 * abs(polynomial).max(), 0, polynomial))
    real = roots[abs(roots.imag) < 1e-9 * abs(roots)].real
    (u,) = real[(real > 0) & (real < 1)]
    direction = distance * normal + u * radial
    return np.asarray(direction / np.linalg.norm(direction))


def unit(vector: Any) -> Array:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector)


def seen_at_angle(angle: Array, normal: Array, distance: float, layers: Layers, last: float, rng: Any) -> Array:
    """(n, 3) points that are seen at `angle` from the normal (radians), `last` behind the walls: Snell's law."""
    across = np.cross(normal, rng.normal(size=(len(angle), 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    radius = distance * np.tan(angle)
    for h, mu in zip([*layers.thickness, last], layers.index, strict=True):
        radius = radius + h * np.tan(np.arcsin(np.sin(angle) / mu))
    return np.asarray((distance + sum(layers.thickness) + last) * normal + radius[:, None] * across)


def pixel_error(a: Array, b: Array) -> float:
    """Largest difference of unit vectors, in px on the optical axis: the lens does not matter here."""
    return float(FOCAL_LENGTH * np.abs(a - b).max())


TILTED = unit([0.3, -0.2, 0.9])
# Angles from the normal, normal, distance of the plane, index, height of the water.
REGIMES = {
    "axis": (np.array([1e-12, 1e-9, 1e-6, 1e-4]), [0, 0, 1], 1.0, 1.333, 1.5),
    "oblique": (np.linspace(0.1, 1.2, 20), [0, 0, 1], 1.0, 1.333, 1.5),
    "tilted": (np.linspace(0.01, 1.2, 20), TILTED, 0.7, 1.333, 2.0),
    "grazing": (np.radians([85.0, 88, 89, 89.5]), TILTED, 1.0, 1.333, 1.5),
    "index near 1": (np.linspace(0.01, 1.2, 20), TILTED, 1.0, 1 + 1e-7, 1.5),
    "dense": (np.linspace(0.01, 1.2, 20), TILTED, 1.0, 2.4, 1.5),
    "water to air": (np.linspace(0.01, 0.8, 20), TILTED, 1.0, 1 / 1.333, 1.5),
    "plane at the camera": (np.linspace(0.01, 1.2, 20), TILTED, 1e-6, 1.333, 1.5),
    "point near the plane": (np.linspace(0.01, 1.2, 20), TILTED, 1.0, 1.333, 1e-3),
}


@pytest.mark.parametrize("regime", REGIMES)
def test_least_path_agrees_with_the_quartic(regime: str) -> None:
    angle, normal, distance, mu, last = REGIMES[regime]
    points = seen_at_angle(angle, unit(normal), distance, Layers(index=(mu,)), last, np.random.default_rng(0))
    found = least_path_direction(points, unit(normal), distance, Layers(index=(mu,)))
    expected = np.array([quartic_direction(point, unit(normal), distance, mu) for point in points])
    assert pixel_error(found, expected) < 1e-9


@pytest.mark.parametrize("thickness", [(), (0.02,), (1e-9, 0.3)])
@pytest.mark.parametrize("regime", [*REGIMES, "point at the plane"])
def test_a_point_is_seen_where_its_ray_was_sent_from(regime: str, thickness: tuple[float, ...]) -> None:
    # The quartic has a double root at the plane and says little there.
    at_plane = (np.linspace(0.01, 1.2, 20), TILTED, 1.0, 1.333, 1e-9)
    angle, normal, distance, mu, last = REGIMES.get(regime, at_plane)
    layers = Layers(thickness=thickness, index=(*(1.52,) * len(thickness), mu))
    points = seen_at_angle(angle, unit(normal), distance, layers, last, np.random.default_rng(0))
    found = least_path_direction(points, unit(normal), distance, layers)
    sine = np.linalg.norm(np.cross(found, unit(normal)), axis=1)
    # The points are rounded to 1e-16 of their size, which is 1e-13 of a grazing ray's height.
    np.testing.assert_allclose(np.arctan2(sine, found @ unit(normal)), angle, rtol=1e-12, atol=1e-15)


@settings(max_examples=100, deadline=None)
@given(
    point=st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(0.1, 20)),
    slope=st.tuples(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7)),
    ratio=st.floats(0.01, 0.99),
    mu=st.floats(0.6, 2.5),
)
def test_least_path_agrees_with_the_quartic_anywhere(
    point: tuple[float, float, float], slope: tuple[float, float], ratio: float, mu: float
) -> None:
    normal = unit([*slope, 1.0])
    depth = float(np.dot(point, normal))
    if depth < 0.05 * np.linalg.norm(point):  # about 87 degrees; the grazing regime has its own test
        return
    found = least_path_direction([point], normal, ratio * depth, Layers(index=(mu,)))
    assert pixel_error(found[0], quartic_direction(np.array(point), normal, ratio * depth, mu)) < 1e-9


@pytest.mark.parametrize("index", [(1.52, 1.49, 1.333), (1.333, 1.0, 1.52), (0.9, 1.1, 0.8)])
def test_snell_holds_at_every_interface(index: tuple[float, ...]) -> None:
    rng = np.random.default_rng(1)
    normals = np.array([unit([*rng.uniform(-0.4, 0.4, 2), 1]) for _ in range(200)])
    layers = Layers(thickness=(0.02, 0.3), index=index)
    points = rng.uniform([-2, -2, 2.5], [2, 2, 5], (200, 3))
    distance = rng.uniform(0.01, 1.0, 200)
    ray = least_path_direction(points, normals, distance, layers)

    position, before = distance[:, None] / np.einsum("ij,ij->i", ray, normals)[:, None] * ray, 1.0
    for thickness, after in zip([*layers.thickness, None], layers.index, strict=True):
        # The component along the plane, times the index, is what Snell's law keeps.
        tangential = before / after * (ray - np.einsum("ij,ij->i", ray, normals)[:, None] * normals)
        ray = tangential + np.sqrt(1 - np.sum(tangential**2, axis=1))[:, None] * normals
        before = after
        if thickness is not None:
            position = position + thickness / np.einsum("ij,ij->i", ray, normals)[:, None] * ray
    miss = np.linalg.norm(np.cross(points - position, ray), axis=1)
    assert miss.max() < 1e-12


def test_without_refraction_the_ray_is_straight() -> None:
    points = np.random.default_rng(2).uniform([-5, -5, 1], [5, 5, 3], (500, 3))
    straight = points / np.linalg.norm(points, axis=1, keepdims=True)
    # One rounding of a unit vector is 1.3e-13 px.
    for layers in (Layers(index=(1.0,)), Layers(thickness=(0.1, 0.2), index=(1.0, 1.0, 1.0))):
        assert pixel_error(least_path_direction(points, TILTED, 0.3, layers), straight) < 5e-12


def test_points_in_front_of_the_plane_are_seen_straight() -> None:
    points = np.array([[0.5, 0.2, 0.9], [0.5, 0.2, 1.0], [0.5, 0.2, -1.0]])
    found = least_path_direction(points, [0, 0, 1], 1.0, Layers())
    assert pixel_error(found, points / np.linalg.norm(points, axis=1, keepdims=True)) < 1e-12


def test_a_wall_counts_as_far_as_the_point_is_behind_it() -> None:
    point, normal = np.array([[0.5, 0.2, 1.05]]), np.array([0, 0, 1])
    inside = least_path_direction(point, normal, 1.0, Layers(thickness=(0.1,), index=(1.52, 1.333)))
    assert pixel_error(inside, least_path_direction(point, normal, 1.0, Layers(index=(1.52,)))) < 1e-12
    no_wall = least_path_direction(point, normal, 1.0, Layers(thickness=(0.0,), index=(1.52, 1.333)))
    assert pixel_error(no_wall, least_path_direction(point, normal, 1.0, Layers())) < 1e-12


def test_distance_must_be_positive() -> None:
    with pytest.raises(RefractError, match="distance"):
        least_path_direction([[0, 0, 1]], [0, 0, 1], 0.0, Layers())


def test_every_point_in_a_batch_has_its_own_plane() -> None:
    rng = np.random.default_rng(3)
    points, distance = rng.uniform([-1, -1, 2], [1, 1, 3], (20, 3)), rng.uniform(0.1, 1, 20)
    normals = np.array([unit([*rng.uniform(-0.3, 0.3, 2), 1]) for _ in range(20)])
    batch = least_path_direction(points, normals, distance, Layers())
    single = [least_path_direction(*each, Layers())[0] for each in zip(points, normals, distance, strict=True)]
    assert pixel_error(batch, np.array(single)) < 1e-12
    assert least_path_direction(np.empty((0, 3)), TILTED, 1.0, Layers()).shape == (0, 3)


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


def test_rmse_is_free_of_the_similarity() -> None:
    capture = simulate(SceneOptions(scenario="static_interface"))
    moved = pycolmap.Reconstruction(capture.reconstruction)
    moved.transform(pycolmap.Sim3d(3.0, pycolmap.Rotation3d(np.array([0.3, 2.0, -1.0])), np.array([1.0, -20, 5])))
    assert point_rmse(moved, capture) < 1e-12
    rng = np.random.default_rng(6)
    for point in moved.points3D.values():
        point.xyz = point.xyz + 3 * 0.01 * rng.standard_normal(3)
    assert point_rmse(moved, capture) == pytest.approx(0.01 * np.sqrt(3), rel=0.1)


def test_robust_rmse_is_free_of_runaway_points() -> None:
    capture = simulate(SceneOptions(scenario="static_interface"))
    model = pycolmap.Reconstruction(capture.reconstruction)
    for point3D_id in list(model.point3D_ids())[::20]:
        model.points3D[point3D_id].xyz = np.array([0.0, 0.0, 1e3 + point3D_id])
    assert point_rmse(model, capture) > 0.1
    assert point_rmse(model, capture, robust=True) < 1e-12
    with pytest.raises(RefractError, match="in common"):
        point_rmse(pycolmap.Reconstruction(), capture)


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
