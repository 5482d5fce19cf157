"""At the truth, what is marked is what does not belong: labels, errors and angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from conftest import Scene, Scenes

from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.triangulation import triangulation_angles
from colmap_refract.interface import Array, Layers
from colmap_refract.options import ImageNotes, RefinerOptions, Scenario
from colmap_refract.refiner.arrangement import arrange
from colmap_refract.refiner.filtering import filter_observations, label_wet, noise, pinhole_errors, reprojection_errors
from colmap_refract.refiner.observations import Observations, read_observations

WALL = Layers(thickness=(0.05,), index=(1.52, 1.333))


def at_the_truth(scene: Scene, notes: ImageNotes | None = None) -> tuple[Problem, Observations]:
    """The adjustment of a capture with a plane per image, at the true poses, planes and points."""
    capture = scene.capture
    options = RefinerOptions(
        scenario="moving_interface",
        layer_thickness=capture.layers.thickness,
        layer_refractive_index=capture.layers.index[:-1],
    )
    arrangement = arrange(read_observations(capture.reconstruction), options, notes or ImageNotes())
    problem = arrangement.start(0.4, arrangement.observations)
    normal, distance = problem.state.normal.copy(), problem.state.distance.copy()
    for i, image_id in enumerate(arrangement.observations.image_ids.tolist()):
        block = arrangement.structure.image_plane[i]
        if block >= 0:
            normal[block], distance[block] = capture.planes[image_id]
    state = replace(problem.state, normal=normal, distance=distance / arrangement.unit)
    problem = replace(problem, state=state)
    return replace(problem, tracks=problem.tracks._replace(wet=label_wet(problem))), arrangement.observations


def true_errors(scene: Scene, observations: Observations) -> Array:
    """How far each keypoint is from its exact pixel."""
    exact = np.array(
        [
            scene.capture.pixels[int(observations.image_ids[i])][idx]
            for i, idx in zip(observations.image, observations.point2D_idx, strict=True)
        ]
    )
    return np.asarray(np.linalg.norm(observations.pixel - exact, axis=1))


@pytest.mark.parametrize("layers", [Layers(), WALL])
@pytest.mark.parametrize("camera_model", ["SIMPLE_RADIAL", "OPENCV_FISHEYE"])
def test_errors_are_those_of_the_keypoints(scenes: Scenes, camera_model: str, layers: Layers) -> None:
    scene = scenes("moving_interface", camera_model=camera_model, layers=layers)
    problem, observations = at_the_truth(scene)
    errors = reprojection_errors(problem, observations)
    np.testing.assert_allclose(errors, true_errors(scene, observations), atol=1e-6)
    # Without refraction it is another matter.
    assert np.median(pinhole_errors(observations)) > 10 * np.median(errors)


def test_pinhole_errors_are_those_of_colmap(scenes: Scenes) -> None:
    model = scenes("moving_interface").copy()
    observations = read_observations(model)
    errors = pinhole_errors(observations)
    model.update_point_3d_errors()
    mean = np.add.reduceat(errors, observations.start[:-1]) / np.diff(observations.start)
    expected = [model.point3D(int(i)).error for i in observations.point3D_ids]
    np.testing.assert_allclose(mean, expected, rtol=1e-6)


def test_labels(scenes: Scenes) -> None:
    """A pier stands out of the water; a dry image has no water at all."""
    scene = scenes("moving_interface", dry_point_ratio=0.2)
    model = scene.capture.reconstruction
    dry_image = model.image(3).name
    problem, observations = at_the_truth(scene, ImageNotes(dry_images=frozenset({dry_image})))
    wet = problem.tracks.wet
    expected = []
    for image, point3D_id in zip(
        observations.image_ids[observations.image], observations.point3D_ids[observations.point], strict=True
    ):
        normal, distance = scene.capture.planes[int(image)]
        in_cam = model.image(int(image)).cam_from_world() * model.point3D(int(point3D_id)).xyz
        expected.append(bool(in_cam @ normal > distance) and int(image) != 3)
    np.testing.assert_array_equal(wet, expected)
    assert 100 < (~wet).sum() < 0.4 * len(wet)
    # Dry points are exact as well; the keypoints of the "dry" image are not dry in truth.
    there = observations.image_ids[observations.image] != 3
    errors = reprojection_errors(problem, observations)
    np.testing.assert_allclose(errors[there], true_errors(scene, observations)[there], atol=1e-6)


def test_large_errors_are_marked(scenes: Scenes) -> None:
    scene = scenes("moving_interface", outlier_ratio=0.1)
    problem, observations = at_the_truth(scene)
    filtered = filter_observations(problem, observations, max_reproj_error=4.0, min_tri_angle=0.0)
    removed = true_errors(scene, observations) > 4.0
    np.testing.assert_array_equal(~filtered.keep, removed)
    assert filtered.num_large_error == removed.sum() > 100
    assert filtered.num_small_angle == 0
    outlier = [
        (int(image), int(idx)) in scene.capture.outliers
        for image, idx in zip(observations.image_ids[observations.image], observations.point2D_idx, strict=True)
    ]
    assert (removed & ~np.array(outlier)).sum() == 0
    everything = filter_observations(problem, observations, max_reproj_error=0.0, min_tri_angle=0.0)
    assert everything.keep.all() and everything.num_large_error == 0


def test_small_angles_are_marked(scenes: Scenes) -> None:
    """Points are marked whole, and those that also have a large error are not counted twice as one thing."""
    scene = scenes("moving_interface")
    problem, observations = at_the_truth(scene)
    angle = triangulation_angles(problem.tracks, problem.structure, problem.state, problem.layers, problem.points)
    limit = float(np.median(angle))
    filtered = filter_observations(problem, observations, max_reproj_error=0.0, min_tri_angle=limit)
    small = angle < limit
    assert filtered.num_small_angle == small.sum() == len(small) // 2
    np.testing.assert_array_equal(filtered.keep, ~small[observations.point])
    assert filtered.num_large_error == 0
    both = filter_observations(problem, observations, max_reproj_error=1.0, min_tri_angle=limit)
    np.testing.assert_array_equal(both.keep, filtered.keep & ~(reprojection_errors(problem, observations) > 1.0))


@pytest.mark.parametrize("scenario", ["moving_interface", "fixed_camera"])
def test_default_angle_lets_good_points_pass(scenes: Scenes, scenario: Scenario) -> None:
    """A fixed camera's rays differ by refraction only, and still have to pass."""
    scene = scenes(scenario)
    problem, observations = at_the_truth(scene)
    limit = RefinerOptions(scenario=scenario).min_tri_angle
    filtered = filter_observations(problem, observations, max_reproj_error=0.0, min_tri_angle=limit)
    assert filtered.keep.mean() > 0.99


def test_noise_is_that_of_a_coordinate() -> None:
    """Also with a tenth of outliers, and after a fit that took freedom away."""
    rng = np.random.default_rng(0)
    residuals = 0.7 * rng.standard_normal((20000, 2))
    assert noise(residuals, 0) == pytest.approx(0.7, rel=0.03)
    residuals[::10] = 100.0
    # The median of absolute values moves by an eighth for a tenth of outliers.
    assert noise(residuals, 0) == pytest.approx(0.7, rel=0.2)
    # A fit of half as many unknowns as numbers leaves half of the variance.
    assert noise(residuals, 20000) == pytest.approx(np.sqrt(2) * noise(residuals, 0))
    assert np.isfinite(noise(residuals, 10**6))


def test_points_left_with_one_observation_go(scenes: Scenes) -> None:
    scene = scenes("moving_interface")
    model = pycolmap.Reconstruction(scene.capture.reconstruction)
    observations = read_observations(model)
    keep = np.ones(len(observations.image), dtype=np.bool_)
    first = observations.start[0], observations.start[1]
    keep[first[0] + 1 : first[1]] = False
    left = observations.select(keep)
    assert observations.point3D_ids[0] not in left.point3D_ids
    assert len(left.points) == len(observations.points) - 1
