"""Refinement of simulated captures: the truth comes back from noise, what is held stays, what is not ours is kept.

What this does not show: how near to the noise bound the results are in general. A single small capture scatters about
its bound by some ten per cent, hence the loose limits here; the accuracy benchmark has more and larger captures and
tighter figures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pycolmap
import pytest
from conftest import Scene, Scenes

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers, plane_in_world
from colmap_refract.options import BundleAdjustmentOptions, ImageNotes, RefinerOptions, Scenario
from colmap_refract.refiner.refinement import Refinement, refine
from colmap_refract.simulation import Capture, ignore_refraction, least_path_direction, noise_bound, point_rmse

SCENARIOS: tuple[Scenario, ...] = get_args(Scenario)
# Each has a pose per image, so that the camera centres tell frame and size.
MOVING_CAMERA: tuple[Scenario, ...] = ("moving_interface", "static_interface", "camera_housing")

# RMSE over bound of a capture of this size: 1.0 in the mean, and one in a thousand is above this.
NEAR_BOUND = 1.25
# Standard deviations of the farthest of some dozens of normal deviates.
FEW_SIGMA = 4.5


def reg_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [image for _, image in sorted(model.images.items()) if image.has_pose]


def positions(model: pycolmap.Reconstruction) -> dict[int, Array]:
    return {point3D_id: point.xyz.copy() for point3D_id, point in sorted(model.points3D.items())}


def position_array(model: pycolmap.Reconstruction) -> Array:
    return np.array(list(positions(model).values()))


def poses(model: pycolmap.Reconstruction) -> Array:
    """(F, 7) quaternions and translations, frames by id."""
    rigs = [model.frame(frame_id).rig_from_world for frame_id in sorted(model.reg_frame_ids())]
    return np.array([[*rig.rotation.quat, *rig.translation] for rig in rigs])


def centers(model: pycolmap.Reconstruction) -> Array:
    return np.array([image.projection_center() for image in reg_images(model)])


def planes(result: Refinement) -> tuple[Array, Array]:
    """Normals (I, 3) and distances (I,) of the images that have an interface, by image id."""
    wet = sorted((i for i in result.sidecar.images.values() if i.distance is not None), key=lambda i: i.image_id)
    return np.array([i.normal_in_cam for i in wet]), np.array([i.distance for i in wet])


def plane_deviations(result: Refinement) -> tuple[Array, Array]:
    """Standard deviations of `planes`, radians and units of the model; NaN where the plane is held."""
    wet = sorted((i for i in result.sidecar.images.values() if i.distance is not None), key=lambda i: i.image_id)
    normal = np.array([np.nan if i.normal_std_deg is None else np.radians(i.normal_std_deg) for i in wet])
    return normal, np.array([np.nan if i.distance_std is None else i.distance_std for i in wet])


def true_planes(capture: Capture) -> tuple[Array, Array]:
    return np.array([n for n, _ in capture.planes.values()]), np.array([d for _, d in capture.planes.values()])


def angles(a: Array, b: Array) -> Array:
    """Between unit vectors (I, 3), radians; exact also where they are nearly the same."""
    return 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(a - b, axis=1), 1.0))


def spread(points: Array) -> float:
    return float(np.linalg.norm(points - points.mean(axis=0)))


def true_size(result: Refinement, capture: Capture) -> float:
    """Length of the truth over that of the result, as the camera centres show it (the planes with a fixed camera)."""
    if capture.scenario == "fixed_camera":
        distance, truth = planes(result)[1], true_planes(capture)[1]
        return float(distance @ truth / (distance @ distance))
    return spread(centers(capture.reconstruction)) / spread(centers(result.reconstruction))


def assert_planes_are_true(result: Refinement, capture: Capture, few: float = FEW_SIGMA) -> None:
    """Normals and distances are the true ones, but for the standard deviations that the result itself states."""
    normal, distance = planes(result)
    normal_std, distance_std = plane_deviations(result)
    true_normal, true_distance = true_planes(capture)
    assert (angles(normal, true_normal) < few * normal_std).all()
    size = true_size(result, capture)
    assert (np.abs(size * distance - true_distance) < few * size * distance_std).all()
    # Against vacuity: the stated deviations are small themselves.
    assert np.degrees(normal_std).max() < 3.0
    assert (distance_std / distance).max() < 0.3


def refractive_errors(result: Refinement) -> dict[int, list[float]]:
    """Errors, px, of all observations of each point: along the least path through the sidecar's planes."""
    model, sidecar = result.reconstruction, result.sidecar
    errors: dict[int, list[float]] = {point3D_id: [] for point3D_id in model.point3D_ids()}
    for image in reg_images(model):
        observed = image.get_observation_points2D()
        in_cam = image.cam_from_world() * np.array([model.point3D(p.point3D_id).xyz for p in observed])
        interface = sidecar.images[image.name]
        if interface.normal_in_cam is not None and interface.distance is not None:
            in_cam = least_path_direction(in_cam, interface.normal_in_cam, interface.distance, sidecar.layers)
        pixels = image.camera.img_from_cam(in_cam)
        for point2D, pixel in zip(observed, pixels, strict=True):
            errors[point2D.point3D_id].append(float(np.linalg.norm(pixel - point2D.xy)))
    return errors


def assert_errors_are_refractive(result: Refinement) -> None:
    """`point3D.error` is the mean refractive error, in a projection that is not the solver's own."""
    assert result.reconstruction.num_points3D() > 0
    for point3D_id, errors in refractive_errors(result).items():
        assert result.reconstruction.point3D(point3D_id).error == pytest.approx(np.mean(errors), abs=1e-6)


def moved_truth(scene: Scene, size: float = 0.02) -> pycolmap.Reconstruction:
    """The true model with its points off by some centimetres."""
    model = pycolmap.Reconstruction(scene.capture.reconstruction)
    rng = np.random.default_rng(3)
    for point in model.points3D.values():
        point.xyz = point.xyz + size * rng.standard_normal(3)
    return model


def with_outliers(scene: Scene, ratio: float) -> tuple[Capture, pycolmap.Reconstruction]:
    """The scene with a part of its observations at random pixels; all others keep the noise they have."""
    capture = scene.capture
    truth = pycolmap.Reconstruction(capture.reconstruction)
    rng = np.random.default_rng(4)
    outliers = set()
    for image_id, image in sorted(truth.images.items()):
        for idx in image.get_observation_point2D_idxs():
            if rng.random() < ratio:
                image.points2D[idx].xy = rng.random(2) * [image.camera.width, image.camera.height]
                outliers.add((image_id, idx))
    spoiled = replace(capture, reconstruction=truth, outliers=outliers)
    return spoiled, ignore_refraction(spoiled)


# --- Recovery --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_truth_comes_back_from_noise(scenes: Scenes, scenario: Scenario) -> None:
    scene = scenes(scenario)
    result = scene.refined
    assert result.converged
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    assert scene.excess(scene.model) > 3.0
    assert result.sidecar.statistics["noise"] == pytest.approx(0.5, rel=0.1)
    assert_planes_are_true(result, scene.capture)
    assert_errors_are_refractive(result)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_outliers_do_little_harm(scenes: Scenes, scenario: Scenario) -> None:
    """The tenth of the observations that is lost costs 5 %; what else may be lost is scatter."""
    scene = scenes(scenario)
    capture, model = with_outliers(scene, 0.1)
    result = scene.refine(model)
    assert point_rmse(result.reconstruction, capture) < 1.15 * point_rmse(scene.refined.reconstruction, capture)

    kept = {
        (element.image_id, element.point2D_idx)
        for point in result.reconstruction.points3D.values()
        for element in point.track.elements
    }
    everything = {
        (element.image_id, element.point2D_idx) for point in model.points3D.values() for element in point.track.elements
    }
    assert len(capture.outliers) > 200
    # One random pixel in a few ten thousand is near the right one.
    assert len(kept & capture.outliers) < 5
    assert not (everything - kept) - capture.outliers


# The minimum is the same up to where the solver stops and the loss's scale, which the noise on the way decides.
SAME_MINIMUM = 0.05


def assert_same_minimum(results: list[Refinement]) -> None:
    first, *others = results
    normal, distance = planes(first)
    normal_std, distance_std = plane_deviations(first)
    for other in others:
        other_normal, other_distance = planes(other)
        assert (angles(normal, other_normal) < SAME_MINIMUM * normal_std).all()
        assert (np.abs(distance - other_distance) < SAME_MINIMUM * distance_std).all()
        assert other.sidecar.solver["cost"] == pytest.approx(first.sidecar.solver["cost"], rel=1e-4)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_minimum_does_not_depend_on_the_start(scenes: Scenes, scenario: Scenario) -> None:
    scene = scenes(scenario)
    # The port is at 0.02 of the depth.
    ratios = (0.01, 0.02, 0.08) if scenario == "camera_housing" else (0.2, 0.5, 0.8)
    results = [scene.refine(initial_distance_ratio=ratio) for ratio in ratios]
    assert_same_minimum([scene.refined, *results])


@pytest.mark.parametrize(
    ("scenario", "pixel_noise"),
    [
        ("static_interface", 0.02),
        ("static_interface", 0.1),
        ("moving_interface", 0.02),
        ("fixed_camera", 0.02),
        ("fixed_camera", 0.1),
    ],
)
def test_narrow_view_has_one_minimum(scenes: Scenes, scenario: Scenario, pixel_noise: float) -> None:
    """Eight degrees of view, the plane unknown, keypoints good enough to show it.

    That the common minimum is the right one is seen by its noise: a wrong one leaves pixels, not hundredths.
    """
    scene = scenes(scenario, focal_length=11440.0, pixel_noise=pixel_noise)
    results = [scene.refine(initial_distance_ratio=ratio) for ratio in (0.2, 0.5, 0.8)]
    for result in results:
        assert result.converged
        assert result.sidecar.statistics["noise"] == pytest.approx(pixel_noise, rel=0.1)
    assert_same_minimum(results)


@pytest.mark.parametrize("seed", [2, 3])
def test_narrow_view_with_moving_planes_is_solved_by_default(scenes: Scenes, seed: int) -> None:
    """Few points and planes that differ much have many minima, the wrong ones with residuals of a tenth of a pixel."""
    scene = scenes("moving_interface", focal_length=11440.0, pixel_noise=0.02, seed=seed)
    assert scene.refined.sidecar.statistics["noise"] == pytest.approx(0.02, rel=0.1)


def test_uncertain_planes_do_not_unsettle_the_solution(scenes: Scenes) -> None:
    """A plane's distance is known to some ten per cent here, and may come out beyond single points.

    Straight rays do not fit those, so taking them to be dry must not spoil what was solved.
    """
    scene = scenes("moving_interface", focal_length=11440.0, pixel_noise=0.1, seed=7)
    result = scene.refined
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    assert result.sidecar.statistics["noise"] == pytest.approx(0.1, rel=0.1)
    assert result.converged


@pytest.mark.parametrize(
    "options",
    [
        {"tilt_deg": 1.5, "seed": 1},
        {"tilt_deg": 1.5, "seed": 3},
        {"tilt_deg": 3.0, "seed": 3, "distance_ratio": 0.8},
        {"tilt_deg": 5.0, "seed": 1, "focal_length": 700.0},
    ],
)
def test_planes_of_a_fixed_camera_stay_before_their_points(scenes: Scenes, options: dict[str, Any]) -> None:
    """Small tilts or a wide view: planes beyond the points, with the opposite tilts, are nearly as good at first."""
    scene = scenes("fixed_camera", **options)
    results = [scene.refined, *(scene.refine(initial_distance_ratio=ratio) for ratio in (0.2, 0.8))]
    for result in results:
        assert result.converged
        assert scene.excess(result.reconstruction) < NEAR_BOUND
    assert_same_minimum(results)


def test_fixed_camera_whose_distance_cannot_be_told_is_called_out(scenes: Scenes) -> None:
    scene = scenes("fixed_camera", tilt_deg=0.1, seed=1)
    with pytest.raises(RefractError, match="distance cannot be told from these images"):
        scene.refine()


def test_solver_goes_on_while_there_is_something_to_gain(scenes: Scenes) -> None:
    """Tilts of a tenth of a degree make a valley, along which the solver's steps are small long before its end."""
    result = scenes("fixed_camera", tilt_deg=0.1, seed=3).refined
    assert result.converged
    assert result.sidecar.solver["newton_decrement"] < 1e-4
    assert not [warning for warning in result.warnings if "could still be gained" in warning]


# --- What can be free or held ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", MOVING_CAMERA)
def test_held_poses(scenes: Scenes, scenario: Scenario) -> None:
    """True poses are given, so size and frame are the truth's and nothing has to be aligned."""
    scene = scenes(scenario)
    model = moved_truth(scene)
    result = scene.refine(model, BundleAdjustment=BundleAdjustmentOptions(refine_rig_from_world=False))
    np.testing.assert_array_equal(poses(result.reconstruction), poses(model))
    np.testing.assert_array_equal(centers(result.reconstruction), centers(model))
    normal, distance = planes(result)
    normal_std, distance_std = plane_deviations(result)
    true_normal, true_distance = true_planes(scene.capture)
    assert (angles(normal, true_normal) < FEW_SIGMA * normal_std).all()
    assert (np.abs(distance - true_distance) < FEW_SIGMA * distance_std).all()
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    assert_errors_are_refractive(result)


def test_held_pose_of_a_fixed_camera_says_nothing_of_the_size(scenes: Scenes) -> None:
    scene = scenes("fixed_camera")
    held = scene.refine(BundleAdjustment=BundleAdjustmentOptions(refine_rig_from_world=False))
    free = scene.refined
    np.testing.assert_allclose(poses(held.reconstruction), poses(scene.model), atol=1e-14)
    # The pose is held in any case, so nothing else may differ.
    np.testing.assert_allclose(
        position_array(held.reconstruction), position_array(free.reconstruction), rtol=0, atol=0.05 * scene.bound
    )


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_held_points(scenes: Scenes, scenario: Scenario) -> None:
    """True points are given: they tell frame and size, so poses and planes are the truth's without alignment."""
    scene = scenes(scenario)
    model = scene.copy()
    for point3D_id, xyz in positions(scene.capture.reconstruction).items():
        model.point3D(point3D_id).xyz = xyz
    result = scene.refine(model, BundleAdjustment=BundleAdjustmentOptions(refine_points3D=False))
    assert result.reconstruction.num_points3D() == model.num_points3D()
    assert result.sidecar.statistics["noise"] == pytest.approx(0.5, rel=0.1)
    np.testing.assert_array_equal(position_array(result.reconstruction), position_array(model))
    normal, distance = planes(result)
    normal_std, distance_std = plane_deviations(result)
    true_normal, true_distance = true_planes(scene.capture)
    assert (angles(normal, true_normal) < FEW_SIGMA * normal_std).all()
    assert (np.abs(distance - true_distance) < FEW_SIGMA * distance_std).all()
    assert_errors_are_refractive(result)


@pytest.mark.parametrize("scenario", ["static_interface", "camera_housing"])
def test_held_normal(scenes: Scenes, scenario: Scenario) -> None:
    scene = scenes(scenario)
    name = scene.model.image(3).name
    normal = scene.capture.planes[3][0]
    result = scene.refine(interface_normal=tuple(2.5 * normal), refine_interface_normal=False, reference_image=name)
    held = result.sidecar.images[name]
    np.testing.assert_allclose(held.normal_in_cam, normal, rtol=0, atol=1e-15)
    assert held.normal_std_deg is None
    assert held.distance_std is not None
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    assert_errors_are_refractive(result)


def test_normal_is_only_a_start_by_default(scenes: Scenes) -> None:
    scene = scenes("camera_housing")
    result = scene.refine(interface_normal=(0.0, 0.0, 1.0))
    # The port is tilted by 5 degrees.
    assert angles(planes(result)[0], np.tile([0.0, 0.0, 1.0], (12, 1))).min() > np.radians(4.0)
    assert_same_minimum([scene.refined, result])


@pytest.mark.parametrize("hold_normal", [False, True])
@pytest.mark.parametrize("hold_distance", [False, True])
def test_held_planes_of_moving_interfaces(scenes: Scenes, hold_normal: bool, hold_distance: bool) -> None:
    """Planes that happen to be the same in every image: a housing's, seen as moving interfaces."""
    scene = scenes("camera_housing", distance_ratio=0.3)
    normal, distance = scene.capture.planes[1]
    name = scene.model.image(1).name
    result = scene.refine(
        scenario="moving_interface",
        reference_image=name,
        interface_normal=tuple(normal),
        interface_distance=distance,
        refine_interface_normal=not hold_normal,
        refine_interface_distance=not hold_distance,
    )
    normals, distances = planes(result)
    turned = angles(normals, np.tile(normal, (12, 1)))
    if hold_normal:
        assert turned.max() < 1e-15
    else:
        assert turned.min() > 1e-6
    # That of the reference is what metres are.
    np.testing.assert_allclose(distances[: 12 if hold_distance else 1], distance, rtol=1e-14)
    assert hold_distance or np.abs(distances[1:] - distance).max() > 1e-6
    # The bound is of a housing, with fewer unknowns.
    assert scene.excess(result.reconstruction) < 1.5


@pytest.mark.parametrize("hold_distance", [False, True])
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_known_distance_makes_metres(scenes: Scenes, scenario: Scenario, hold_distance: bool) -> None:
    """The model's size is arbitrary, the distance that is given is in metres."""
    if hold_distance and scenario in ("moving_interface", "fixed_camera"):
        pytest.skip("a distance held in every image is not true of planes that move")
    scene = scenes(scenario)
    model = scene.copy()
    model.transform(pycolmap.Sim3d(0.01, pycolmap.Rotation3d(), np.zeros(3)))
    name = scene.model.image(5).name
    distance = scene.capture.planes[5][1]
    result = scene.refine(
        model, interface_distance=distance, refine_interface_distance=not hold_distance, reference_image=name
    )
    assert result.sidecar.images[name].distance == pytest.approx(distance, rel=1e-15)
    assert result.sidecar.units["distance"] == "metre"
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    # The size is as uncertain as the distance was before it was said.
    free = scene.refined.sidecar.images[name]
    assert free.distance is not None and free.distance_std is not None
    truth = position_array(scene.capture.reconstruction)
    ratio = spread(position_array(result.reconstruction)) / spread(truth)
    assert abs(ratio - 1) < FEW_SIGMA * free.distance_std / free.distance + 0.005
    assert_errors_are_refractive(result)


@pytest.mark.parametrize("scenario", MOVING_CAMERA)
def test_refractive_index(scenes: Scenes, scenario: Scenario) -> None:
    scene = scenes(scenario, oblique_deg=35.0, focal_length=800.0)
    result = scene.refine(refractive_index=1.30, refine_refractive_index=True)
    index, deviation = (result.sidecar.solver[key] for key in ("refractive_index", "refractive_index_std"))
    assert deviation < 0.005
    assert abs(index - 1.333) < FEW_SIGMA * deviation
    assert result.sidecar.layers.refractive_index == index
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    assert_errors_are_refractive(result)
    held = scene.refined.sidecar
    assert held.layers.refractive_index == 1.333
    assert held.solver["refractive_index_std"] is None


def test_refractive_index_of_a_fixed_camera(scenes: Scenes) -> None:
    scene = scenes("fixed_camera")
    result = scene.refine(refractive_index=1.32, refine_refractive_index=True)
    assert result.sidecar.layers.refractive_index == pytest.approx(1.333, abs=0.05)
    assert result.sidecar.statistics["noise"] == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("scenario", MOVING_CAMERA)
@pytest.mark.parametrize(
    ("free", "wrong"),
    [
        # By how much each parameter is off: focal length, principal point, distortion.
        ("refine_focal_length", (15.0, 0.0, 0.0, 0.0)),
        ("refine_principal_point", (0.0, 8.0, -6.0, 0.0)),
        ("refine_extra_params", (0.0, 0.0, 0.0, 0.02)),
    ],
)
def test_intrinsics(scenes: Scenes, scenario: Scenario, free: str, wrong: tuple[float, ...]) -> None:
    """The minimum is one of the pixels' errors, so that it cannot be higher than with the true intrinsics held.

    Linearised at noisy keypoints, which is nearly as good for each, the focal length comes out some px too long.
    """
    scene = scenes(scenario, oblique_deg=30.0)
    model = scene.copy()
    truth = scene.capture.reconstruction.camera(1).params
    model.camera(1).params = truth + wrong
    # The scale of the loss is given, so that costs can be compared.
    at_truth = scene.refine(BundleAdjustment=BundleAdjustmentOptions(loss_function_scale=2.0))
    result = scene.refine(model, BundleAdjustment=BundleAdjustmentOptions(**{free: True}, loss_function_scale=2.0))
    found = result.reconstruction.camera(1).params
    off = np.array(wrong) != 0
    # A few standard deviations of captures of this size.
    assert (np.abs(found - truth)[off] < np.array([6.0, 1.5, 1.5, 0.004])[off]).all()
    np.testing.assert_array_equal(found[~off], truth[~off])
    assert point_contents(result.reconstruction) == point_contents(model)
    # Intrinsics are refined on residuals that are linear in the direction, so the minimum is missed by a part of sigma.
    assert result.sidecar.solver["cost"] < at_truth.sidecar.solver["cost"] * (1 + 5e-4)
    assert scene.excess(result.reconstruction) < 1.3 * NEAR_BOUND
    assert_errors_are_refractive(result)


def test_held_intrinsics_stay(scenes: Scenes) -> None:
    """Also where they are wrong, and the points suffer."""
    scene = scenes("static_interface", oblique_deg=30.0)
    model = scene.copy()
    model.camera(1).params = model.camera(1).params + [15.0, 0.0, 0.0, 0.0]
    result = scene.refine(model)
    np.testing.assert_array_equal(result.reconstruction.camera(1).params, model.camera(1).params)
    assert scene.excess(result.reconstruction) > 2.0


def test_given_intrinsics_replace_those_of_the_model(scenes: Scenes) -> None:
    scene = scenes("camera_housing")
    model = scene.copy()
    model.camera(1).params = model.camera(1).params * [1.05, 1, 1, 5]
    good = pycolmap.Camera(scene.model.camera(1).todict())
    good.camera_id = 7
    result = scene.refine(model, cameras={7: good})
    np.testing.assert_array_equal(result.reconstruction.camera(1).params, good.params)
    np.testing.assert_array_equal(model.camera(1).params, scene.model.camera(1).params * [1.05, 1, 1, 5])
    assert_same_minimum([scene.refined, result])


WALL = Layers(thickness=(0.05,), index=(1.52, 1.333))


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_wall_with_known_distance(scenes: Scenes, scenario: Scenario) -> None:
    """Thickness and distance are both in metres, and the size of the model is not known."""
    scene = scenes(scenario, layers=WALL, distance_ratio=0.1 if scenario == "camera_housing" else None)
    model = scene.copy()
    model.transform(pycolmap.Sim3d(0.01, pycolmap.Rotation3d(), np.zeros(3)))
    name, distance = scene.model.image(1).name, scene.capture.planes[1][1]
    result = scene.refine(
        model,
        layer_thickness=WALL.thickness,
        layer_refractive_index=WALL.index[:1],
        interface_distance=distance,
        reference_image=name,
    )
    assert result.sidecar.layers.thickness == pytest.approx(WALL.thickness, rel=1e-12)
    assert result.sidecar.images[name].distance == pytest.approx(distance, rel=1e-12)
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    truth = position_array(scene.capture.reconstruction)
    assert spread(position_array(result.reconstruction)) / spread(truth) == pytest.approx(1.0, abs=0.05)
    assert_errors_are_refractive(result)


@pytest.mark.parametrize("scenario", MOVING_CAMERA)
def test_wall_in_units_of_the_model(scenes: Scenes, scenario: Scenario) -> None:
    """Without a distance the model keeps its size, and so does the wall: three per cent are the bending."""
    scene = scenes(scenario, layers=WALL, distance_ratio=0.1 if scenario == "camera_housing" else None)
    model = scene.copy()
    model.transform(pycolmap.Sim3d(10.0, pycolmap.Rotation3d(), np.zeros(3)))
    result = scene.refine(model, layer_thickness=(0.5,), layer_refractive_index=WALL.index[:1])
    assert result.converged
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    assert result.sidecar.layers.thickness == pytest.approx((0.5,), rel=0.03)
    assert_errors_are_refractive(result)


def test_wall_of_a_fixed_camera_needs_a_distance(scenes: Scenes) -> None:
    """Its model has the depth that somebody made up, which is no size to give a thickness in."""
    with pytest.raises(RefractError, match="interface_distance"):
        scenes("fixed_camera").refine(layer_thickness=(0.05,), layer_refractive_index=(1.52,))


# --- Who shares what -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", ["moving_interface", "fixed_camera"])
def test_groups_share_a_plane_of_the_world(scenes: Scenes, scenario: Scenario) -> None:
    scene = scenes(scenario, frames_per_interface=3)
    groups = {image.name: f"tilt {(i - 1) // 3}" for i, image in scene.model.images.items() if i > 3}
    result = scene.refine(notes=ImageNotes(interface_groups=groups))
    sidecar = result.sidecar
    assert set(sidecar.world_planes) == set(groups.values())
    for image in reg_images(result.reconstruction):
        entry = sidecar.images[image.name]
        if image.name not in groups:
            assert entry.group == image.name
            continue
        assert entry.group == groups[image.name]
        world = sidecar.world_planes[groups[image.name]]
        pose = image.cam_from_world().matrix()
        normal, offset = plane_in_world(np.array(entry.normal_in_cam), entry.distance or 0, pose[:, :3], pose[:, 3])
        np.testing.assert_allclose(normal, world.normal_in_world, atol=1e-12)
        assert offset == pytest.approx(world.offset, abs=1e-12)
    # The bound knows of the groups; three images of the twelve were not told of theirs.
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    assert_errors_are_refractive(result)


def test_static_interface_is_one_plane(scenes: Scenes) -> None:
    scene = scenes("static_interface")
    result = scene.refined
    (world,) = result.sidecar.world_planes.values()
    for image in reg_images(result.reconstruction):
        entry = result.sidecar.images[image.name]
        pose = image.cam_from_world().matrix()
        normal, offset = plane_in_world(np.array(entry.normal_in_cam), entry.distance or 0, pose[:, :3], pose[:, 3])
        np.testing.assert_allclose(normal, world.normal_in_world, atol=1e-12)
        assert offset == pytest.approx(world.offset, abs=1e-12)


def test_dry_images(scenes: Scenes) -> None:
    """Two images that were taken before the tank was filled."""
    scene = scenes("static_interface")
    truth = pycolmap.Reconstruction(scene.capture.reconstruction)
    rng = np.random.default_rng(5)
    for image_id in (2, 9):
        image = truth.image(image_id)
        for point2D in image.points2D:
            if point2D.has_point3D():
                in_cam = image.cam_from_world() * truth.point3D(point2D.point3D_id).xyz
                point2D.xy = image.camera.img_from_cam(in_cam[None])[0] + 0.5 * rng.standard_normal(2)
    capture = replace(scene.capture, reconstruction=truth)
    model = ignore_refraction(capture)
    dry = frozenset(truth.image(image_id).name for image_id in (2, 9))
    result = scene.refine(model, notes=ImageNotes(dry_images=dry))
    for name, entry in result.sidecar.images.items():
        assert (entry.distance is None) == (entry.normal_in_cam is None) == (name in dry)
    # Two images that see straight can only help.
    assert point_rmse(result.reconstruction, capture) < NEAR_BOUND * scene.bound
    assert_errors_are_refractive(result)
    # Taken to be wet, they do not fit.
    wrong = scene.refine(model)
    assert wrong.sidecar.statistics["num_filtered_large_error"] > 100
    assert result.sidecar.statistics["num_filtered_large_error"] < 5


@pytest.mark.parametrize("scenario", MOVING_CAMERA)
def test_several_cameras(scenes: Scenes, scenario: Scenario) -> None:
    scene = scenes(scenario, num_cameras=2)
    result = scene.refined
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    assert_planes_are_true(result, scene.capture)
    assert_errors_are_refractive(result)
    num_planes = {"moving_interface": 12, "static_interface": 1, "camera_housing": 2}[scenario]
    assert len({entry.group for entry in result.sidecar.images.values()}) == num_planes


def with_camera_per_image(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """As COLMAP models images of which it is not told that one camera took them: a camera and a rig for each."""
    split = pycolmap.Reconstruction()
    for image_id, image in sorted(model.images.items()):
        camera = pycolmap.Camera(image.camera.todict())
        camera.camera_id = image_id
        split.add_camera_with_trivial_rig(camera)
        own = pycolmap.Image(image.name, [point2D.xy for point2D in image.points2D])
        own.image_id, own.camera_id = image_id, image_id
        split.add_image_with_trivial_frame(own, image.cam_from_world())
    for point3D_id, point in sorted(model.points3D.items()):
        split.add_point3D_with_id(point3D_id, point)
    return split


def test_fixed_camera_is_one_whatever_its_ids(scenes: Scenes) -> None:
    """Poses of a camera per image would be unknowns of their own, and the points worse by a factor of nearly two."""
    scene = scenes("fixed_camera", seed=1)
    model = with_camera_per_image(scene.model)
    assert model.num_cameras() == model.num_rigs() == 12
    result = scene.refine(model)
    np.testing.assert_array_equal(poses(result.reconstruction), np.repeat(poses(scene.model)[:1], 12, axis=0))
    # Nothing but the ids differs; the tolerance is for sums in another order.
    np.testing.assert_allclose(
        position_array(result.reconstruction),
        position_array(scene.refined.reconstruction),
        rtol=0,
        atol=1e-3 * scene.bound,
    )
    assert len({entry.group for entry in result.sidecar.images.values()}) == 12


@pytest.mark.parametrize("scenario", MOVING_CAMERA)
def test_rigs(scenes: Scenes, scenario: Scenario) -> None:
    """The baseline tells the size, so nothing is aligned: sizes are the truth's."""
    scene = scenes(scenario, sensors_per_frame=2)
    result = scene.refined
    for rig_id, rig in scene.model.rigs.items():
        for sensor in rig.non_ref_sensors:
            kept = result.reconstruction.rig(rig_id).sensor_from_rig(sensor)
            np.testing.assert_array_equal(kept.matrix(), rig.sensor_from_rig(sensor).matrix())
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    true_normal, true_distance = true_planes(scene.capture)
    normal, distance = planes(result)
    normal_std, distance_std = plane_deviations(result)
    assert (angles(normal, true_normal) < FEW_SIGMA * normal_std).all()
    assert (np.abs(distance - true_distance) < FEW_SIGMA * distance_std).all()
    assert_errors_are_refractive(result)
    if scenario == "moving_interface":
        for frame in result.reconstruction.frames.values():
            names = [result.reconstruction.image(data.id).name for data in frame.image_ids]
            assert len(names) == 2
            assert len({result.sidecar.images[name].group for name in names}) == 1
            world = []
            for name in names:
                pose = result.reconstruction.find_image_with_name(name).cam_from_world().matrix()
                entry = result.sidecar.images[name]
                world.append(
                    plane_in_world(np.array(entry.normal_in_cam), entry.distance or 0, pose[:, :3], pose[:, 3])
                )
            np.testing.assert_allclose(world[0][0], world[1][0], atol=1e-12)
            assert world[0][1] == pytest.approx(world[1][1], abs=1e-12)


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface"])
def test_shore(scenes: Scenes, scenario: Scenario, seed: int) -> None:
    """Points on a pier, on the dry side of the interface, are seen straight, counted, and not taken for outliers."""
    scene = scenes(scenario, dry_point_ratio=0.15, seed=seed)
    result = scene.refined
    capture = scene.capture
    num_dry = 0
    for image_id, image in capture.reconstruction.images.items():
        normal, distance = capture.planes[image_id]
        ids = [point2D.point3D_id for point2D in image.get_observation_points2D()]
        in_cam = image.cam_from_world() * np.array([capture.reconstruction.point3D(i).xyz for i in ids])
        num_dry += int((in_cam @ normal < distance).sum())
    assert num_dry > 50
    assert result.sidecar.statistics["num_filtered_large_error"] < 5
    # A point at the water's edge may fall on either side.
    assert result.sidecar.statistics["num_dry_observations"] == pytest.approx(num_dry, rel=0.1)
    assert scene.excess(result.reconstruction) < NEAR_BOUND
    assert_errors_are_refractive(result)


CAMERA_MODELS = sorted(name for name in pycolmap.CameraModelId.__members__ if name != "INVALID")


@pytest.mark.parametrize("camera_model", CAMERA_MODELS)
def test_camera_models(scenes: Scenes, camera_model: str) -> None:
    """Every model COLMAP has, mildly distorted by its first parameter.

    Fewer observations scatter more, and a panorama of this size has few pixels on the scene.
    """
    scene = scenes("static_interface", camera_model=camera_model, num_images=8, num_points=150)
    result = scene.refined
    assert result.reconstruction.camera(1).model.name == camera_model
    assert scene.excess(result.reconstruction) < 1.35
    assert scene.excess(scene.model) > 2.0
    assert_planes_are_true(result, scene.capture)
    assert_errors_are_refractive(result)


def test_points_with_two_observations(scenes: Scenes) -> None:
    scene = scenes("static_interface")
    truth, model = pycolmap.Reconstruction(scene.capture.reconstruction), scene.copy()
    thinned = sorted(truth.point3D_ids())[::3]
    for point3D_id in thinned:
        elements = sorted((e.image_id, e.point2D_idx) for e in truth.point3D(point3D_id).track.elements)
        # The first and one half way around: they have a baseline.
        for element in [e for k, e in enumerate(elements) if k not in (0, len(elements) // 2)]:
            truth.delete_observation(*element)
            model.delete_observation(*element)
    result = scene.refine(model)
    assert set(thinned) <= set(result.reconstruction.point3D_ids())
    assert all(result.reconstruction.point3D(i).track.length() == 2 for i in thinned)
    bound = noise_bound(replace(scene.capture, reconstruction=truth))
    assert bound > 1.1 * scene.bound
    assert point_rmse(result.reconstruction, scene.capture) < NEAR_BOUND * bound
    assert_errors_are_refractive(result)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_unregistered_images_stay_out(scenes: Scenes, scenario: Scenario) -> None:
    scene = scenes(scenario)
    model = scene.copy()
    model.deregister_frame(4)
    keypoints = np.array([point2D.xy for point2D in model.image(4).points2D])
    result = scene.refine(model)
    after = result.reconstruction
    assert after.num_images() == 12 and after.num_reg_images() == 11
    assert not after.image(4).has_pose
    np.testing.assert_array_equal([point2D.xy for point2D in after.image(4).points2D], keypoints)
    assert not any(point2D.has_point3D() for point2D in after.image(4).points2D)
    assert after.image(4).name not in result.sidecar.images
    assert len(result.sidecar.images) == 11
    assert scene.excess(after) < 1.1 * NEAR_BOUND


def test_fixed_camera_has_one_pose(scenes: Scenes) -> None:
    """Poses that all are equal are normal, and what little a mapper makes of them does not matter."""
    scene = scenes("fixed_camera")
    name = scene.model.image(6).name
    rng = np.random.default_rng(6)
    model = scene.copy()
    for frame in model.frames.values():
        turn = pycolmap.Rotation3d(0.01 * rng.standard_normal(3))
        frame.rig_from_world = pycolmap.Rigid3d(turn, 0.02 * rng.standard_normal(3)) * frame.rig_from_world
    results = [scene.refine(reference_image=name), scene.refine(model, reference_image=name)]
    for result, given in zip(results, [scene.model, model], strict=True):
        found = poses(result.reconstruction)
        assert (found == found[0]).all()
        # It is the reference's.
        np.testing.assert_allclose(found[5], poses(given)[5], atol=1e-12)
        assert scene.excess(result.reconstruction) < NEAR_BOUND
    normal, other = (planes(result)[0] for result in results)
    assert (angles(normal, other) < SAME_MINIMUM * plane_deviations(results[0])[0]).all()


# --- What is kept ----------------------------------------------------------------------------------------------------


def unchanging(model: pycolmap.Reconstruction) -> dict[str, Any]:
    """What a refinement leaves alone in any case."""
    return {
        "cameras": {i: (c.model.name, c.width, c.height) for i, c in model.cameras.items()},
        "rigs": {i: str(rig.todict()) for i, rig in model.rigs.items()},
        "frames": {i: (f.rig_id, sorted(str(d) for d in f.data_ids), f.has_pose()) for i, f in model.frames.items()},
        "images": {i: (im.name, im.camera_id, im.frame_id, im.has_pose) for i, im in model.images.items()},
        "keypoints": {i: [tuple(p.xy) for p in image.points2D] for i, image in model.images.items()},
    }


def point_contents(model: pycolmap.Reconstruction) -> dict[int, tuple[Any, ...]]:
    return {
        i: (tuple(point.color), sorted((e.image_id, e.point2D_idx) for e in point.track.elements))
        for i, point in model.points3D.items()
    }


def everything(model: pycolmap.Reconstruction) -> dict[str, Any]:
    return {
        **unchanging(model),
        "points": point_contents(model),
        "values": {i: (tuple(point.xyz), point.error) for i, point in model.points3D.items()},
        "poses": poses(model).tolist(),
        "params": {i: tuple(camera.params) for i, camera in model.cameras.items()},
        "owners": {i: [p.point3D_id for p in image.points2D] for i, image in model.images.items()},
    }


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_everything_else_is_kept(scenes: Scenes, scenario: Scenario) -> None:
    scene = scenes(scenario)
    result = scene.refined
    after = result.reconstruction
    assert unchanging(after) == unchanging(scene.model)
    assert point_contents(after) == point_contents(scene.model)
    np.testing.assert_array_equal(after.camera(1).params, scene.model.camera(1).params)
    statistics = result.sidecar.statistics
    assert statistics["num_reg_images"] == 12
    assert statistics["num_points3D_before"] == statistics["num_points3D"] == scene.model.num_points3D()
    assert statistics["num_observations"] == after.compute_num_observations()
    assert set(result.sidecar.images) == {image.name for image in scene.model.images.values()}
    assert {name: entry.image_id for name, entry in result.sidecar.images.items()} == {
        image.name: image_id for image_id, image in scene.model.images.items()
    }


def test_what_is_removed_is_counted(scenes: Scenes) -> None:
    """Outliers, and points whose rays hardly part, go; ids, colours and the other elements of their tracks stay."""
    scene = scenes("moving_interface", num_cameras=2)
    capture, model = with_outliers(scene, 0.1)
    lonely = sorted(model.point3D_ids())[:5]
    for point3D_id in lonely:
        # What is left are two images whose centres are nearest each other.
        elements = [(e.image_id, e.point2D_idx) for e in model.point3D(point3D_id).track.elements]
        at = {i: model.image(i).projection_center() for i, _ in elements}
        a, b = min(
            ((a, b) for a in at for b in at if a < b), key=lambda pair: float(np.linalg.norm(at[pair[0]] - at[pair[1]]))
        )
        for element in elements:
            if element[0] not in (a, b):
                model.delete_observation(*element)
    before = everything(model)
    result = scene.refine(model, filter_min_tri_angle=8.0)
    assert everything(model) == before

    after = result.reconstruction
    assert unchanging(after) == unchanging(model)
    old, new = point_contents(model), point_contents(after)
    assert set(new) < set(old)
    for point3D_id, (color, track) in new.items():
        assert color == old[point3D_id][0]
        assert set(track) <= set(old[point3D_id][1])
        for image_id, idx in track:
            assert after.image(image_id).points2D[idx].point3D_id == point3D_id
    gone = {element for _, track in old.values() for element in track}
    gone -= {element for _, track in new.values() for element in track}
    assert not any(after.image(image_id).points2D[idx].has_point3D() for image_id, idx in gone)

    statistics = result.sidecar.statistics
    assert statistics["num_points3D_before"] == len(old) and statistics["num_points3D"] == len(new)
    assert statistics["num_observations_before"] - statistics["num_observations"] == len(gone)
    assert statistics["num_filtered_small_angle"] >= 1
    # The rest went with the points of a small angle or was the last observation of a point.
    assert 0.9 * len(gone) < statistics["num_filtered_large_error"] < len(gone)
    assert len(gone & capture.outliers) > 0.9 * len(gone)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_frame_and_size_of_the_world_are_kept(scenes: Scenes, scenario: Scenario) -> None:
    """A bent model has no one frame: a few per cent of the depth is how far it was off."""
    scene = scenes(scenario)
    after = scene.refined.reconstruction
    depth = scene.capture.options.camera_height
    shift = np.linalg.norm(centers(after) - centers(scene.model), axis=1)
    assert np.median(shift) < 0.03 * depth
    if scenario != "fixed_camera":
        assert spread(centers(after)) == pytest.approx(spread(centers(scene.model)), rel=0.03)
    # Behind a port all is seen at three quarters of its depth, and a mapper makes it up with the focal length it has.
    shift = np.linalg.norm(position_array(after) - position_array(scene.model), axis=1)
    assert np.median(shift) < (0.35 if scenario == "camera_housing" else 0.15) * depth


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_result_moves_with_the_input(scenes: Scenes, scenario: Scenario) -> None:
    """Neither the unit nor the origin nor the axes of the input's world matter: tolerances are relative."""
    scene = scenes(scenario)
    move = pycolmap.Sim3d(300.0, pycolmap.Rotation3d(np.array([0.4, -1.0, 2.0])), np.array([5e4, -2e4, 1e4]))
    model = scene.copy()
    model.transform(move)
    moved = scene.refine(model)
    expected = pycolmap.Reconstruction(scene.refined.reconstruction)
    expected.transform(move)
    # 5e4 units have eleven digits behind the noise bound's, of which the solver needs some.
    tolerance = 1e-3 * 300.0 * scene.bound
    np.testing.assert_allclose(position_array(moved.reconstruction), position_array(expected), rtol=0, atol=tolerance)
    np.testing.assert_allclose(centers(moved.reconstruction), centers(expected), rtol=0, atol=tolerance)
    np.testing.assert_allclose(planes(moved)[1], 300.0 * planes(scene.refined)[1], rtol=1e-5)
    np.testing.assert_allclose(planes(moved)[0], planes(scene.refined)[0], atol=1e-6)


def test_input_is_not_altered(scenes: Scenes) -> None:
    scene = scenes("moving_interface")
    model = scene.copy()
    before = everything(model)
    result = scene.refine(model, BundleAdjustment=BundleAdjustmentOptions(refine_focal_length=True))
    assert everything(model) == before
    assert everything(result.reconstruction) != before


@pytest.mark.parametrize("scenario", ["moving_interface", "fixed_camera"])
def test_one_thread_gives_the_same_twice(scenes: Scenes, scenario: Scenario) -> None:
    scene = scenes(scenario)
    first, second, two = (scene.refine(num_threads=n) for n in (1, 1, 2))
    assert everything(first.reconstruction) == everything(second.reconstruction)
    assert first.sidecar.images == second.sidecar.images
    # Sums in another order differ in their last digits; what the solver makes of that is far below the noise.
    np.testing.assert_allclose(
        position_array(two.reconstruction), position_array(first.reconstruction), rtol=0, atol=1e-3 * scene.bound
    )


# --- What cannot be solved -------------------------------------------------------------------------------------------


def test_scripts_get_one_line_too(scenes: Scenes) -> None:
    empty = pycolmap.Reconstruction()
    with pytest.raises(RefractError, match="no registered image"):
        refine(empty, RefinerOptions(scenario="static_interface"))
    model = scenes("static_interface").copy()
    model.points3D[next(iter(model.points3D))].xyz = np.full(3, np.nan)
    with pytest.raises(RefractError, match="not finite"):
        refine(model, RefinerOptions(scenario="static_interface"))


def test_dry_scene_is_called_out(scenes: Scenes) -> None:
    """Nothing is refracted: the planes are no use, and somebody has to say so."""
    scene = scenes("static_interface", layers=Layers(index=(1.0,)))
    try:
        result = scene.refine()
    except RefractError as error:
        assert "beyond the points" in str(error) or "into the camera" in str(error)
    else:
        assert result.warnings


def test_watch_sees_every_stage(scenes: Scenes) -> None:
    scene = scenes("static_interface")
    seen: list[tuple[str, int]] = []
    watch: Callable[..., None] = lambda stage, progress: seen.append((stage, progress.iteration))  # noqa: E731
    refine(scene.model, RefinerOptions(scenario="static_interface"), watch=watch)
    assert len({stage for stage, _ in seen}) >= 2
    assert all(np.isfinite(iteration) for _, iteration in seen)


def test_interrupt_gets_through(scenes: Scenes) -> None:
    scene = scenes("static_interface")
    before = everything(scene.model)

    def interrupt(stage: str, progress: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine(scene.model, RefinerOptions(scenario="static_interface"), watch=interrupt)
    assert everything(scene.model) == before
