"""The methods that are compared with: exact where there is no noise, as good as the noise allows, and fair in what they
are given.

The truth is the simulation's, whose rays are paths of least optical length. None of this says how the methods do on
real water: here the planes are planes, waves are independent from frame to frame, and keypoints have normal noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
import pytest
from conftest import IMAGES_AND_POINTS, Scenes, error_of

from colmap_refract.comparators import methods
from colmap_refract.comparators.depth_from_refraction import find_plane_and_points, intersect_known_plane
from colmap_refract.comparators.depth_from_turbulence import refracted_depths, spread_depths
from colmap_refract.comparators.level_water import gains, radii
from colmap_refract.interface import Array, Layers
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.refiner.refinement import refine
from colmap_refract.simulation import SceneOptions, ignore_refraction, least_path_direction, point_rmse, simulate

WATER = Layers()
DEPTH, DISTANCE = 0.6, 0.3
LAYERS = {
    "water": WATER,
    "sea water": Layers(index=(1.34,)),
    "behind glass": Layers(thickness=(0.01,), index=(1.52, 1.333)),
}


def camera(model: str = "PINHOLE") -> pycolmap.Camera:
    made = pycolmap.Camera.create_from_model_name(1, model, 1200.0, 1600, 1200)
    for idx in made.extra_params_idxs()[:1]:
        made.params[idx] = -0.03
    return made


@dataclass(frozen=True)
class Board:
    """A tilted planar board at 0.6 m, camera frame, seen through planes at about 0.3 m; pixels are exact."""

    camera: pycolmap.Camera
    points: Array
    normals: Array
    distances: Array
    layers: Layers

    def wet(self) -> Array:
        """(M, F, 2)"""
        seen = [
            self.camera.img_from_cam(least_path_direction(self.points, n, d, self.layers))
            for n, d in zip(self.normals, self.distances, strict=True)
        ]
        return np.stack(seen, axis=1)

    def dry(self) -> Array:
        """(M, 2)"""
        return np.asarray(self.camera.img_from_cam(self.points))


def board(
    frames: int,
    *,
    tilt_deg: float = 3.0,
    lift: float = 0.1,
    rows: int = 7,
    size: float = 1.0,
    layers: Layers = WATER,
    model: str = "PINHOLE",
    seed: int = 0,
) -> Board:
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-0.26, 0.26, rows + 2), np.linspace(-0.19, 0.19, rows))
    turn = pycolmap.Rotation3d(np.radians(20.0) * np.array([0.6, 0.8, 0.0])).matrix()
    points = size * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) @ turn.T + [0.0, 0.0, DEPTH]
    slopes = np.tan(np.radians(tilt_deg)) * rng.standard_normal((frames, 2)) / np.sqrt(2)
    normals = np.column_stack([slopes, np.ones(frames)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distances = DISTANCE * (1 + lift * rng.uniform(-1, 1, frames)) * normals[:, 2]
    return Board(camera(model), points, normals, distances, layers)


def rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1))))


# Depth from refraction


@pytest.mark.parametrize("layers", LAYERS.values(), ids=list(LAYERS))
@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV_FISHEYE"])
def test_known_plane_is_exact(layers: Layers, model: str) -> None:
    """Without noise the rays meet in the point: 1e-6 of the depth is far above rounding, far below approximations."""
    scene = board(1, tilt_deg=8.0, layers=layers, model=model)
    found = intersect_known_plane(
        scene.dry(), scene.wet()[:, 0], scene.camera,
        normal_in_cam=scene.normals[0], distance=scene.distances[0], layers=layers,
    )  # fmt: skip
    np.testing.assert_allclose(found.points, scene.points, atol=1e-6 * DEPTH)
    assert np.isfinite(found.std).all()


@pytest.mark.parametrize("layers", LAYERS.values(), ids=list(LAYERS))
def test_unknown_plane_is_exact_but_for_the_scale(layers: Layers) -> None:
    scene = board(1, tilt_deg=5.0, layers=layers)
    distance = float(scene.distances[0])
    dry, wet = scene.dry(), scene.wet()[:, 0]
    found = find_plane_and_points(dry, wet, scene.camera, distance=distance, layers=layers)
    np.testing.assert_allclose(found.points, scene.points, atol=1e-6 * DEPTH)
    np.testing.assert_allclose(found.normal_in_cam, scene.normals[0], atol=1e-6)
    if not layers.thickness:
        twice = find_plane_and_points(dry, wet, scene.camera, distance=2 * distance, layers=layers)
        np.testing.assert_allclose(twice.points, 2 * found.points, atol=1e-6)
        np.testing.assert_allclose(twice.std, 2 * found.std, rtol=1e-3)


def test_the_point_without_flow() -> None:
    """Along the normal nothing is bent, whatever the depth; beside it the deviation falls with the angle."""
    normal = np.array([0.05, -0.08, 1.0]) / np.linalg.norm([0.05, -0.08, 1.0])
    side = np.cross(normal, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.array([0.0, 0.01, 0.02, 0.04])
    points = DEPTH * (np.cos(angle)[:, None] * normal + np.sin(angle)[:, None] * side)
    lens = camera()
    wet = lens.img_from_cam(least_path_direction(points, normal, DISTANCE, WATER))
    found = intersect_known_plane(
        lens.img_from_cam(points), wet, lens, normal_in_cam=normal, distance=DISTANCE, pixel_noise=0.1
    )
    assert np.isnan(found.points[0]).all() and np.isinf(found.std[0])
    np.testing.assert_allclose(found.points[1:], points[1:], atol=1e-6)
    # 0.04 rad are small: the law is exact to about the angle's square.
    np.testing.assert_allclose(found.std[1:] * angle[1:], found.std[1] * angle[1], rtol=0.01)


def test_noisy_rays_meet_where_the_pixels_err_least() -> None:
    """In both images together, by least paths; the middle of the shortest connection is not that point."""
    scene = board(1, tilt_deg=5.0)
    rng = np.random.default_rng(8)
    normal, distance = scene.normals[0], scene.distances[0]
    dry, wet = (p + 1.0 * rng.standard_normal(p.shape) for p in (scene.dry(), scene.wet()[:, 0]))
    found = intersect_known_plane(dry, wet, scene.camera, normal_in_cam=normal, distance=distance).points

    def cost(points: Array) -> Array:
        bent = scene.camera.img_from_cam(least_path_direction(points, normal, distance, WATER))
        straight = scene.camera.img_from_cam(points)
        return np.asarray(((straight - dry) ** 2).sum(axis=1) + ((bent - wet) ** 2).sum(axis=1))

    step = 1e-5 * DEPTH
    slope = [(cost(found + step * axis) - cost(found - step * axis)) / (2 * step) for axis in np.eye(3)]
    # Of a cost that rises by 4e6 px^2 / m^2 across the line of sight: a slope of 10 is a micrometre off. The metric of
    # the keypoints, in place of the camera's own, is good to that where the errors are of a pixel.
    seen = np.linalg.norm(scene.points[:, :2], axis=1) > 0.1
    assert seen.sum() > 20
    assert np.abs(slope)[:, seen].max() < 10.0
    least = cost(found)[seen]
    assert (least < cost(found + [2e-4, 0.0, 0.0])[seen]).all() and (least < cost(found - [0.0, 2e-4, 0.0])[seen]).all()


def test_deviations_with_a_known_plane_are_the_spread() -> None:
    """Of 500 noisy copies of each point. Not near the point without flow, where nothing is normal any more."""
    scene, copies, noise = board(1, rows=5), 500, 0.1
    rng = np.random.default_rng(1)
    dry, wet = (np.repeat(pixels, copies, axis=0) for pixels in (scene.dry(), scene.wet()[:, 0]))
    found = intersect_known_plane(
        dry + noise * rng.standard_normal(dry.shape), wet + noise * rng.standard_normal(wet.shape), scene.camera,
        normal_in_cam=scene.normals[0], distance=scene.distances[0], pixel_noise=noise,
    )  # fmt: skip
    squared = np.sum((found.points - np.repeat(scene.points, copies, axis=0)) ** 2, axis=1).reshape(-1, copies)
    expected = np.sqrt(np.mean(found.std.reshape(-1, copies) ** 2, axis=1))
    far = expected < 0.02 * DEPTH
    assert far.sum() > 20
    # Mostly one degree of freedom: 500 copies tell a deviation to 3 per cent, and there are 30 of them.
    np.testing.assert_allclose(np.sqrt(squared.mean(axis=1))[far], expected[far], rtol=0.13)
    # And the estimate has no bias worth the name.
    bias = (found.points.reshape(-1, copies, 3).mean(axis=1) - scene.points)[far]
    assert (np.linalg.norm(bias, axis=1) < 0.25 * expected[far]).all()


def test_deviations_with_an_unknown_plane_hold_the_planes_share() -> None:
    """A small board far from the axis says little of the normal, and all its points err together."""
    whole = board(1, rows=3, size=0.35)
    scene = Board(whole.camera, whole.points + [0.15, 0.1, 0.0], whole.normals, whole.distances, WATER)
    distance, noise = float(scene.distances[0]), 0.05
    rng = np.random.default_rng(2)
    share, known_share = [], []
    for _ in range(30):
        dry = scene.dry() + noise * rng.standard_normal((len(scene.points), 2))
        wet = scene.wet()[:, 0] + noise * rng.standard_normal((len(scene.points), 2))
        found = find_plane_and_points(dry, wet, scene.camera, distance=distance, pixel_noise=noise)
        known = intersect_known_plane(
            dry, wet, scene.camera, normal_in_cam=scene.normals[0], distance=distance, pixel_noise=noise
        )
        error = np.sum((found.points - scene.points) ** 2, axis=1)
        share.append(np.mean(error / found.std**2))
        known_share.append(np.mean(error / known.std**2))
    # 30 draws of a normal or two that are wrong for all points at once: about a quarter either way.
    assert np.mean(share) == pytest.approx(1.0, abs=0.4)
    # Without the planes' share it would not hold: the test can fail.
    assert np.mean(known_share) > 1.5


def test_points_that_are_not_in_both_images() -> None:
    scene = board(1)
    dry, wet = scene.dry(), scene.wet()[:, 0].copy()
    dry[3], wet[5] = np.nan, np.nan
    found = intersect_known_plane(dry, wet, scene.camera, normal_in_cam=scene.normals[0], distance=scene.distances[0])
    missing = np.isin(np.arange(len(dry)), [3, 5])
    assert np.isnan(found.points[missing]).all() and np.isinf(found.std[missing]).all()
    np.testing.assert_allclose(found.points[~missing], scene.points[~missing], atol=1e-6)


# Depth from turbulence


@pytest.mark.parametrize("index", [1.333, 1.5])
def test_gains_are_the_derivatives_of_least_paths(index: float) -> None:
    rng = np.random.default_rng(3)
    x = np.concatenate([[0.0, 1e-6], rng.uniform(0.01, 1.2, 40)])
    eta = np.exp(rng.uniform(np.log(0.05), np.log(10), len(x)))
    law, layers, step = gains(radii(x, index), eta), Layers(index=(index,)), 1e-5
    tangent = x / np.hypot(1, x) / index
    points = np.column_stack([x + eta * tangent / np.sqrt(1 - tangent**2), np.zeros_like(x), 1 + eta])

    def moved(slope_x: float, slope_y: float, lift: float, pivot: Array) -> Array:
        """Tangents (n, 2) of points seen through planes through `pivot` (n, 3), lifted."""
        normal = np.array([slope_x, slope_y, 1.0]) / np.linalg.norm([slope_x, slope_y, 1.0])
        direction = least_path_direction(points, normal, pivot @ normal + lift, layers)
        return np.asarray(direction[:, :2] / direction[:, 2:])

    crossing, axis = np.column_stack([x, np.zeros_like(x), np.ones_like(x)]), np.array([[0.0, 0.0, 1.0]])

    def derivative(*change: float, pivot: Array = crossing) -> Array:
        at = np.array(change) * step
        return (moved(*(-at), pivot) - moved(*at, pivot)) / (2 * step)

    # Central differences of 1e-5 leave 1e-9 of truncation and rounding.
    np.testing.assert_allclose(derivative(1, 0, 0)[:, 0], law.radial, atol=1e-7)
    np.testing.assert_allclose(derivative(0, 1, 0)[:, 1], law.across, atol=1e-7)
    np.testing.assert_allclose(derivative(0, 0, 1)[:, 0], law.lift, atol=1e-7)
    np.testing.assert_allclose(derivative(1, 0, 0, pivot=axis)[:, 0], law.radial_plane, atol=1e-7)
    np.testing.assert_allclose(derivative(0, 1, 0, pivot=axis)[:, 1], law.across, atol=1e-7)


def test_small_tilts_give_the_depths_exactly() -> None:
    """What is left is of second order in the tilts, relative to the first, so it falls with them. The mean of so few
    planes is not the axis, and the method is told which it is."""
    errors = []
    for tilt in (1.0, 0.1):
        scene = board(15, tilt_deg=tilt, lift=0.05 * tilt)
        mean = scene.normals.mean(axis=0)
        found = refracted_depths(scene.wet(), scene.camera, scene.points, normal_in_cam=mean)
        errors.append(found.rmse)
        slope = np.sqrt(np.mean((scene.normals[:, :2] - mean[:2]) ** 2))
        assert found.scale == pytest.approx(slope, rel=0.02 * tilt + 1e-3)
        assert found.offset == pytest.approx(scene.distances.mean(), rel=0.02 * tilt + 1e-3)
    assert errors[0] < 2e-3 * DEPTH
    assert errors[1] < 0.2 * errors[0]


def test_noise_averages_out_over_frames() -> None:
    """Planes: the spread is known exactly but for the pixels' noise, so the error falls with the root of the frames."""
    noise, errors = 0.2, []
    for frames in (12, 108):
        squared = []
        for seed in range(2):
            scene = board(frames, tilt_deg=1.5, lift=0.05, rows=5, seed=seed)
            rng = np.random.default_rng(100 + seed)
            keypoints = scene.wet() + noise * rng.standard_normal((len(scene.points), frames, 2))
            found = refracted_depths(
                keypoints, scene.camera, scene.points, pixel_noise=noise, normal_in_cam=scene.normals.mean(axis=0)
            )
            squared.append(found.rmse**2)
        errors.append(np.sqrt(np.mean(squared)))
    # Three times; 35 points twice tell each to 10 per cent, and the random tilts add as much.
    assert 2.2 < errors[0] / errors[1] < 4.2


def waves(frames: int, seed: int) -> tuple[Board, Array]:
    """Slopes of 2 degrees that are independent from point to point and frame to frame; heights are left out."""
    scene = board(1, tilt_deg=0.0, lift=0.0, rows=6, seed=seed)
    rng = np.random.default_rng(200 + seed)
    keypoints = np.empty((len(scene.points), frames, 2))
    for f in range(frames):
        slopes = np.tan(np.radians(2.0)) * rng.standard_normal((len(scene.points), 2)) / np.sqrt(2)
        normals = np.column_stack([slopes, np.ones(len(slopes))])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        level = least_path_direction(scene.points, [0.0, 0.0, 1.0], DISTANCE, WATER)
        crossing = DISTANCE * level / level[:, 2:]
        distances = np.einsum("mi,mi->m", normals, crossing)
        keypoints[:, f] = scene.camera.img_from_cam(least_path_direction(scene.points, normals, distances, WATER))
    return scene, keypoints


def test_spreads_under_waves_are_known_as_well_as_their_number_says() -> None:
    """A deviation from `n` normal slopes on both axes is known to `1 / sqrt(4 n)`, whatever the method.

    Not with few frames: a fit to the truth then does best by playing down what the spreads say, and the error is less.
    """
    errors = []
    for frames in (80, 720):
        scene, keypoints = waves(frames, 0)
        found = refracted_depths(keypoints, scene.camera, scene.points)
        errors.append(found.rmse)
        # From the gain to the depth: d log gain / d log eta = 1 / (1 + eta / mu), 0.57 at eta = 1.
        expected = (DEPTH - DISTANCE) / 0.57 / np.sqrt(4 * frames)
        assert 0.5 * expected < found.rmse < 1.5 * expected
    assert 2.0 < errors[0] / errors[1] < 4.0
    # Then the slopes are known as well: 2 degrees, over both axes.
    assert found.scale == pytest.approx(np.tan(np.radians(2.0)) / np.sqrt(2), rel=0.1)


def test_the_linear_fit_is_least_squares() -> None:
    """Exact where depth is linear in the spread, and otherwise with residuals orthogonal to what was fitted."""
    lens, rng = camera(), np.random.default_rng(4)
    spread, frames = rng.uniform(2e-3, 8e-3, 40), 8
    motion = rng.standard_normal((frames, 2))
    motion -= motion.mean(axis=0)
    motion /= np.sqrt(np.sum(motion**2) / (2 * (frames - 1)))
    place = np.column_stack([rng.uniform(-0.4, 0.4, (40, 2)), np.ones(40)])
    keypoints = 1200.0 * (place[:, None, :2] + spread[:, None, None] * motion) + [800.0, 600.0]
    truth = (0.4 + 50.0 * spread)[:, None] * place
    exact = spread_depths(keypoints, lens, truth)
    np.testing.assert_allclose([exact.offset, exact.scale], [0.4, 50.0], rtol=1e-9)
    np.testing.assert_allclose(exact.points, truth, atol=1e-9)

    bumpy = truth * (1 + 0.1 * rng.standard_normal((40, 1)))
    fitted = spread_depths(keypoints, lens, bumpy)
    left = np.einsum("mi,mi->m", fitted.points - bumpy, place)
    assert abs(left.sum()) < 1e-9 and abs(left @ spread) < 1e-9
    assert fitted.rmse == pytest.approx(rms(fitted.points - bumpy))


def test_the_refracted_fit_is_least_squares() -> None:
    """In the distance, exactly: the error is orthogonal to the points. The slope's is a search, to 1e-5."""
    scene = board(10)
    rng = np.random.default_rng(5)
    keypoints = scene.wet() + 0.3 * rng.standard_normal((len(scene.points), 10, 2))
    found = refracted_depths(keypoints, scene.camera, scene.points, pixel_noise=0.3)
    assert abs(np.sum((found.points - scene.points) * found.points)) < 1e-9
    # Any other scale of the truth scales the outcome and nothing else.
    double = refracted_depths(keypoints, scene.camera, 2 * scene.points, pixel_noise=0.3)
    np.testing.assert_allclose(double.points, 2 * found.points, atol=1e-3 * DEPTH)


def test_the_better_form_is_better() -> None:
    """Planes that tilt, rise and sink, as the tank of the paper: what the two forms are for."""
    scene = board(15)
    keypoints = scene.wet() + 0.2 * np.random.default_rng(6).standard_normal((len(scene.points), 15, 2))
    plain = spread_depths(keypoints, scene.camera, scene.points, pixel_noise=0.2)
    better = refracted_depths(keypoints, scene.camera, scene.points, pixel_noise=0.2)
    assert better.rmse < 0.2 * plain.rmse


def test_gaps_and_wrong_matches() -> None:
    scene = board(15)
    rng = np.random.default_rng(7)
    keypoints = scene.wet() + 0.2 * rng.standard_normal((len(scene.points), 15, 2))
    clean = refracted_depths(keypoints, scene.camera, scene.points, pixel_noise=0.2)
    gaps = np.where(rng.random(keypoints.shape[:2])[:, :, None] < 0.2, np.nan, keypoints)
    gaps[0, 1:], gaps[1] = np.nan, np.nan
    found = refracted_depths(gaps, scene.camera, scene.points, pixel_noise=0.2)
    assert np.isnan(found.points[:2]).all() and np.isfinite(found.points[2:]).all()
    assert found.rmse < 1.5 * clean.rmse
    wrong = rng.random(keypoints.shape[:2]) < 0.02
    keypoints[wrong] += rng.uniform(-60, 60, (int(wrong.sum()), 2))
    assert wrong.sum() > 10
    # In the middle of the points, as two wrong matches of fifteen spoil a point for good.
    robust = refracted_depths(keypoints, scene.camera, scene.points, pixel_noise=0.2)
    medians = [np.median(np.linalg.norm(f.points - scene.points, axis=1)) for f in (robust, clean)]
    assert medians[0] < 2.0 * medians[1]
    # A point without truth has a depth all the same.
    truth = scene.points.copy()
    truth[4] = np.nan
    assert np.isfinite(refracted_depths(keypoints, scene.camera, truth, pixel_noise=0.2).points[4]).all()


# As models


def test_models_keep_what_is_theirs(scenes: Scenes) -> None:
    """Ids, tracks and frame of reference are the input's, and the input stays as it was."""
    scene = scenes("fixed_camera", oblique_deg=10.0, pixel_noise=0.1)
    model, truth = scene.copy(), scene.capture.reconstruction
    normal = np.mean([n for n, _ in scene.capture.planes.values()], axis=0)
    before = {i: point.xyz.copy() for i, point in model.points3D.items()}
    rmse = {}
    for form in ("spread", "refracted"):
        found = methods.depth_from_turbulence(model, truth, form=form, pixel_noise=0.1, normal_in_cam=normal)
        assert set(found.point3D_ids()) == set(model.point3D_ids())
        assert found.compute_num_observations() == model.compute_num_observations()
        # Given scale, offset and frame: no alignment.
        rmse[form] = rms(np.array([found.point3D(i).xyz - truth.point3D(i).xyz for i in found.point3D_ids()]))
    assert rmse["refracted"] < 0.1 * scene.capture.options.camera_height
    assert rmse["refracted"] < 0.5 * rmse["spread"]
    assert all((model.point3D(i).xyz == xyz).all() for i, xyz in before.items())


def with_dry_image(capture_model: pycolmap.Reconstruction, image_id: int) -> pycolmap.Reconstruction:
    """A copy in which one image was taken before the water came, without noise."""
    model = pycolmap.Reconstruction(capture_model)
    image = model.image(image_id)
    for point2D in image.points2D:
        if point2D.has_point3D():
            in_cam = image.cam_from_world() * capture_model.point3D(point2D.point3D_id).xyz
            point2D.xy = image.camera.img_from_cam(in_cam[None])[0]
    return model


def test_depth_from_refraction_of_a_model(scenes: Scenes) -> None:
    capture = scenes("fixed_camera", pixel_noise=0.0).capture
    model = with_dry_image(capture.reconstruction, 1)
    dry, wet = model.image(1).name, model.image(2).name
    for point in model.points3D.values():
        point.xyz = point.xyz * 1.3 + 0.1
    known = methods.depth_from_refraction(model, dry, wet, plane=capture.planes[2])
    shared = [i for i in known.point3D_ids()]
    assert len(shared) > 0.8 * IMAGES_AND_POINTS["num_points"]
    error = [known.point3D(i).xyz - capture.reconstruction.point3D(i).xyz for i in shared]
    assert np.abs(error).max() < 1e-6
    unknown = methods.depth_from_refraction(model, dry, wet)
    assert point_rmse(unknown, capture) < 1e-6
    few = methods.depth_from_refraction(model, dry, wet, plane=capture.planes[2], max_std=0.05)
    assert 0 < few.num_points3D() < known.num_points3D()


@pytest.mark.parametrize("first", [True, False])
def test_the_refiner_takes_a_dry_image_of_a_fixed_camera(scenes: Scenes, first: bool) -> None:
    """The fair opponent, given what depth from refraction is given. As the first image it has the first pose, too."""
    capture = scenes("fixed_camera", pixel_noise=0.0, seed=3).capture
    image_id = 1 if first else 5
    model = with_dry_image(capture.reconstruction, image_id)
    for point in model.points3D.values():
        point.xyz = point.xyz * [1.0, 1.0, 0.9]
    notes = ImageNotes(dry_images=frozenset({model.image(image_id).name}))
    refined = refine(model, RefinerOptions(scenario="fixed_camera"), notes=notes)
    assert point_rmse(refined.reconstruction, capture) < 1e-4
    assert not any("lost all their observations" in warning for warning in refined.warnings)


def test_simple_sfm_is_the_best_fit_of_straight_rays(scenes: Scenes) -> None:
    scene = scenes("static_interface")
    start = pycolmap.Reconstruction(scene.capture.reconstruction)
    found = methods.ignoring_refraction(start)
    reference = ignore_refraction(scene.capture)
    assert found.compute_mean_reprojection_error() == pytest.approx(
        reference.compute_mean_reprojection_error(), rel=1e-3
    )
    assert point_rmse(found, scene.capture) == pytest.approx(point_rmse(reference, scene.capture), rel=0.05)
    assert list(found.camera(1).params) == list(start.camera(1).params)
    # Which is not the truth.
    assert scene.excess(found) > 5.0
    assert "one place" in error_of(lambda: methods.ignoring_refraction(scenes("fixed_camera").copy()))


@pytest.mark.parametrize("scenario", ["moving_interface", "fixed_camera"])
def test_random_distortions_from_what_is_known(scenario: Any) -> None:
    """Exact without noise and waves; with waves nearer than with straight weights is for the triangulator's tests."""
    capture = simulate(SceneOptions(scenario=scenario, num_images=8, num_points=60, pixel_noise=0.0))
    model = pycolmap.Reconstruction(capture.reconstruction)
    for point in model.points3D.values():
        point.xyz = point.xyz + 0.05
    planes: dict[str, methods.Plane | None] = {model.image(i).name: plane for i, plane in capture.planes.items()}
    found = methods.random_refractive_distortions(model, planes, slope_deviation_deg=1.0, pixel_noise=0.5)
    assert set(found.point3D_ids()) == set(model.point3D_ids())
    error = [found.point3D(i).xyz - capture.reconstruction.point3D(i).xyz for i in found.point3D_ids()]
    assert np.abs(error).max() < 1e-6
    planes.pop(model.image(1).name)
    missing = error_of(lambda: methods.random_refractive_distortions(model, planes, slope_deviation_deg=1.0))
    assert "no plane" in missing


# What cannot be


BAD: dict[str, tuple[Callable[[Board], object], str]] = {
    "one frame": (lambda b: refracted_depths(b.wet()[:, :1], b.camera, b.points), "1 frame"),
    "one frame, plain": (lambda b: spread_depths(b.wet()[:, :1], b.camera, b.points), "1 frame"),
    "nothing twice": (
        lambda b: refracted_depths(
            np.where(np.eye(len(b.points), 2, dtype=bool)[:, :, None], b.wet(), np.nan), b.camera, b.points
        ),
        "two frames",
    ),
    "no truth": (lambda b: spread_depths(b.wet(), b.camera, np.full_like(b.points, np.nan)), "0 points with keypoints"),
    "little truth": (
        lambda b: refracted_depths(
            b.wet(), b.camera, np.where(np.arange(len(b.points))[:, None] < 2, b.points, np.nan)
        ),
        "2 points with keypoints",
    ),
    "shapes": (lambda b: refracted_depths(b.wet()[:, 0], b.camera, b.points), "shape"),
    "negative noise": (lambda b: spread_depths(b.wet(), b.camera, b.points, pixel_noise=-1.0), "negative"),
    "air": (lambda b: refracted_depths(b.wet(), b.camera, b.points, refractive_index=1.0), "refractive_index"),
    "behind": (lambda b: refracted_depths(b.wet(), b.camera, b.points, normal_in_cam=(0, 0, -1)), "away"),
    "no point in both": (
        lambda b: intersect_known_plane(
            np.full_like(b.dry(), np.nan), b.wet()[:, 0], b.camera, normal_in_cam=b.normals[0], distance=0.3
        ),
        "no point",
    ),
    "no point in both, plane unknown": (
        lambda b: find_plane_and_points(b.dry(), np.full_like(b.dry(), np.nan), b.camera),
        "no point",
    ),
    "plane behind": (
        lambda b: intersect_known_plane(b.dry(), b.wet()[:, 0], b.camera, normal_in_cam=b.normals[0], distance=-1.0),
        "in front of the camera",
    ),
    "other points": (
        lambda b: intersect_known_plane(b.dry()[1:], b.wet()[:, 0], b.camera, normal_in_cam=b.normals[0], distance=0.3),
        "shape",
    ),
    "too few points": (lambda b: find_plane_and_points(b.dry()[:4], b.wet()[:4, 0], b.camera), "points"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line(name: str) -> None:
    call, words = BAD[name]
    assert words in error_of(lambda: call(board(2)))


def test_bad_models_are_one_line(scenes: Scenes) -> None:
    fixed, moving = scenes("fixed_camera"), scenes("moving_interface")
    truth = fixed.capture.reconstruction
    wet = fixed.model.image(2).name
    assert "no registered image 'dry.jpg'" in error_of(
        lambda: methods.depth_from_refraction(fixed.model, "dry.jpg", wet)
    )
    assert "does not move" in error_of(lambda: methods.depth_from_turbulence(moving.model, moving.model))
    assert "none of the model's points" in error_of(
        lambda: methods.depth_from_turbulence(fixed.model, pycolmap.Reconstruction())
    )
    form: Any = "blurred"
    assert "no form" in error_of(lambda: methods.depth_from_turbulence(fixed.model, truth, form=form))
