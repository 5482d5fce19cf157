"""The stated standard deviations are those of repeated measurements, and what changes no observation has none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
import pytest
from conftest import Scene, Scenes

from colmap_refract.estimator.adjustment import SolverSettings, settle_points
from colmap_refract.estimator.chunk import Problem, split
from colmap_refract.interface import Array, Layers, plane_in_world
from colmap_refract.options import BundleAdjustmentOptions, ImageNotes, RefinerOptions, Scenario
from colmap_refract.refiner.arrangement import arrange
from colmap_refract.refiner.observations import read_observations
from colmap_refract.refiner.refinement import Refinement
from colmap_refract.refiner.uncertainty import Key, estimate_uncertainty, gauge
from colmap_refract.simulation import Capture, ignore_refraction

SMALL = {"num_images": 8, "num_points": 120}


def photographed_again(capture: Capture, seed: int) -> Capture:
    """The same scene, with other noise on the keypoints."""
    rng = np.random.default_rng([7, seed])
    truth = pycolmap.Reconstruction(capture.reconstruction)
    for image_id, pixels in capture.pixels.items():
        noisy = pixels + capture.options.pixel_noise * rng.standard_normal(pixels.shape)
        for point2D, xy in zip(truth.image(image_id).points2D, noisy, strict=True):
            point2D.xy = xy
    return replace(capture, reconstruction=truth)


def true_size(result: Refinement, capture: Capture) -> float:
    """What brings the result to the truth's size: by the camera centres, or by the points if there is but one."""
    truth = [image.projection_center() for _, image in sorted(capture.reconstruction.images.items())]
    found = [image.projection_center() for _, image in sorted(result.reconstruction.images.items())]
    if capture.scenario == "fixed_camera":
        # All cameras stand at one place, by which the result was not moved.
        true_points, points = capture.reconstruction.points3D, result.reconstruction.points3D
        logs = [
            np.log(np.linalg.norm(true_points[i].xyz - truth[0]) / np.linalg.norm(points[i].xyz - found[0]))
            for i in points
        ]
        return float(np.exp(np.mean(logs)))
    return float(np.linalg.norm(truth - np.mean(truth, axis=0)) / np.linalg.norm(found - np.mean(found, axis=0)))


def normalised_errors(result: Refinement, capture: Capture, known_size: bool) -> tuple[Array, Array]:
    """Errors of normals and distances (I,), over the standard deviations that the result states."""
    size = 1.0 if known_size else true_size(result, capture)
    angle, length = [], []
    for image_id, (normal, distance) in capture.planes.items():
        entry = result.sidecar.images[capture.reconstruction.image(image_id).name]
        assert entry.distance and entry.distance_std and entry.normal_in_cam and entry.normal_std_deg
        turned = np.degrees(2 * np.arcsin(0.5 * np.linalg.norm(normal - entry.normal_in_cam)))
        angle.append(turned / entry.normal_std_deg)
        length.append((size * entry.distance - distance) / (size * entry.distance_std))
    return np.array(angle), np.array(length)


@pytest.mark.parametrize(
    ("scenario", "ratio", "num_seeds", "options"),
    [
        ("static_interface", 0.5, 20, {}),
        ("moving_interface", 0.5, 10, {}),
        ("fixed_camera", 0.5, 8, {}),
        ("camera_housing", 0.02, 20, {}),
        # A baseline tells the size, and the distance has an uncertainty that needs no alignment.
        ("camera_housing", 0.02, 20, {"sensors_per_frame": 2}),
    ],
)
def test_stated_deviations_are_those_of_repetitions(
    scenes: Scenes, scenario: Scenario, ratio: float, num_seeds: int, options: dict[str, Any]
) -> None:
    """Twenty repetitions know a standard deviation to 16 %, so a factor of 1.5 is three of those.

    The normal's is stated along the longer axis of its ellipse: the angle's mean square is between one and two
    times its square.
    """
    scene = scenes(scenario, **SMALL, **options)
    angles, lengths = [], []
    for seed in range(num_seeds):
        capture = photographed_again(scene.capture, seed)
        model = ignore_refraction(capture)
        name = model.image(1).name
        result = scene.refine(model, initial_distance_ratio=ratio, reference_image=name)
        angle, length = normalised_errors(result, capture, known_size="sensors_per_frame" in options)
        angles.append(angle)
        lengths.append(length)
    assert 0.8 < np.sqrt(np.mean(np.square(angles))) < 1.25 * np.sqrt(2)
    assert 0.65 < np.sqrt(np.mean(np.square(lengths))) < 1.5


def start_of(scene: Scene, **options: Any) -> Problem:
    """An adjustment at its start: what the gauge is does not depend on where."""
    options = {"scenario": scene.capture.scenario, **options}
    notes = options.pop("notes", ImageNotes())
    arrangement = arrange(read_observations(scene.model), RefinerOptions(**options), notes)
    ratio = 0.02 if scene.capture.scenario == "camera_housing" else 0.4
    return arrangement.start(arrangement.ratio or ratio, arrangement.observations)


def reduced_hessian(problem: Problem) -> tuple[Array, list[Key], dict[Key, int]]:
    """The whole reduced Gauss-Newton matrix, with the blocks and their first columns."""
    (chunk,) = split(problem, 1)
    reduced = chunk.reduce([np.zeros(width) for width in chunk.widths], None)
    assert reduced is not None
    upper = np.triu(reduced[2])
    return upper + np.triu(upper, 1).T, chunk.keys, chunk.first_column


HOLD_POSES = BundleAdjustmentOptions(refine_rig_from_world=False)
HOLD_POINTS = BundleAdjustmentOptions(refine_points3D=False)


@pytest.mark.parametrize(
    ("scenario", "scene_options", "options", "expected"),
    [
        ("moving_interface", {}, {}, 7),
        ("static_interface", {}, {}, 7),
        ("camera_housing", {}, {}, 7),
        ("camera_housing", {"num_cameras": 2}, {}, 7),
        # The one pose is the world's frame; everything may grow from it.
        ("fixed_camera", {}, {}, 1),
        ("moving_interface", {"sensors_per_frame": 2}, {}, 6),
        ("static_interface", {"sensors_per_frame": 2}, {}, 6),
        ("camera_housing", {"sensors_per_frame": 2}, {}, 6),
        # A wall in metres and a distance in metres: the distance carries the size.
        (
            "static_interface",
            {},
            {"layer_thickness": (0.1,), "layer_refractive_index": (1.5,), "interface_distance": 1.0},
            0,
        ),
        ("moving_interface", {}, {"refine_refractive_index": True}, 7),
        ("moving_interface", {}, {"BundleAdjustment": HOLD_POSES}, 0),
        ("static_interface", {}, {"BundleAdjustment": HOLD_POSES}, 0),
        ("camera_housing", {}, {"BundleAdjustment": HOLD_POINTS}, 0),
        # Planes that are held, and the reference's pose with them.
        ("camera_housing", {}, {"refine_interface_normal": False}, 1),
        ("static_interface", {}, {"refine_interface_normal": False}, 1),
        ("camera_housing", {}, {"interface_distance": 0.05, "refine_interface_distance": False}, 0),
    ],
)
def test_gauge(
    scenes: Scenes, scenario: Scenario, scene_options: dict[str, Any], options: dict[str, Any], expected: int
) -> None:
    problem = start_of(scenes(scenario, **SMALL, **scene_options), **options)
    hessian, keys, columns = reduced_hessian(problem)
    directions = gauge(problem, keys, columns, len(hessian))
    assert directions.shape == (len(hessian), expected)
    if not expected:
        return
    # Held parts of a block have columns, which an adjustment does not move.
    assert np.linalg.matrix_rank(directions) == expected
    # In units that the blocks' curvatures set; rounding leaves ten digits, a wrong sign or a lever forgotten none.
    scale = 1 / np.sqrt(np.diag(hessian))
    scaled, seen = hessian * scale * scale[:, None], directions / scale[:, None]
    seen /= np.linalg.norm(seen, axis=0)
    assert np.abs(scaled @ seen).max() < 1e-8
    rng = np.random.default_rng(0)
    other = rng.standard_normal(len(hessian))
    assert np.abs(scaled @ (other / np.linalg.norm(other))).max() > 1e-3


def test_there_is_no_more_gauge_than_that(scenes: Scenes) -> None:
    problem = start_of(scenes("moving_interface", **SMALL))
    hessian, _, _ = reduced_hessian(problem)
    scale = 1 / np.sqrt(np.diag(hessian))
    eigenvalues = np.linalg.eigvalsh(hessian * scale * scale[:, None])
    assert (np.abs(eigenvalues[:7]) < 1e-8).all()
    assert eigenvalues[7] > 1e-6


def test_planes_that_bend_nothing_are_undetermined(scenes: Scenes) -> None:
    problem = start_of(scenes("static_interface", **SMALL), refractive_index=1.0)
    uncertainty = estimate_uncertainty(problem)
    assert not uncertainty.determined
    assert np.isnan(uncertainty.normal).all() and np.isnan(uncertainty.distance).all()


def test_an_image_with_too_few_points_is_undetermined(scenes: Scenes) -> None:
    """Nine unknowns against four equations; the other images are determined as before."""
    scene = scenes("moving_interface", **SMALL)
    arrangement = arrange(read_observations(scene.model), RefinerOptions(scenario="moving_interface"), ImageNotes())
    observations = arrangement.observations
    poor = (arrangement.reference + 1) % SMALL["num_images"]
    keep = observations.image != poor
    keep[np.flatnonzero(~keep)[:2]] = True
    uncertainty = estimate_uncertainty(arrangement.start(0.4, observations.select(keep)))
    poor_normal = uncertainty.normal[poor]
    # An inverse that rounding has made finite says a radian per px, or nothing.
    assert not uncertainty.determined or np.isnan(poor_normal) or poor_normal > 1.0


def test_more_noise_and_fewer_points_are_less_certain(scenes: Scenes) -> None:
    whole = start_of(scenes("static_interface", **SMALL))
    base = estimate_uncertainty(whole)
    assert base.determined
    arrangement = arrange(
        read_observations(scenes("static_interface", **SMALL).model),
        RefinerOptions(scenario="static_interface"),
        ImageNotes(),
    )
    observations = arrangement.observations
    half = estimate_uncertainty(arrangement.start(0.4, observations.select(observations.point % 2 == 0)))
    # Half of the points: the square root of two, but for which points they are.
    assert 1.1 < half.normal[0] / base.normal[0] < 2.0
    assert 1.1 < half.distance[0] / base.distance[0] < 2.0


def test_wall_adds_no_freedom(scenes: Scenes) -> None:
    """A wall of no thickness is no wall."""
    scene = scenes("camera_housing", **SMALL)
    plain = estimate_uncertainty(start_of(scene))
    problem = start_of(scene)
    walled = estimate_uncertainty(replace(problem, layers=Layers(thickness=(0.0,), index=(1.5, 1.333))))
    np.testing.assert_allclose(walled.normal, plain.normal, rtol=1e-6)
    np.testing.assert_allclose(walled.distance, plain.distance, rtol=1e-6)


def test_what_is_held_has_no_deviation(scenes: Scenes) -> None:
    scene = scenes("camera_housing", **SMALL)
    held = estimate_uncertainty(start_of(scene, refine_interface_normal=False))
    assert np.isnan(held.normal).all() and np.isfinite(held.distance).all()
    assert np.isnan(held.index)
    free = estimate_uncertainty(start_of(scene, refine_refractive_index=True))
    assert np.isfinite(free.index) and free.index > 0
    assert 0 < free.index_correlation <= 1 + 1e-9
    # Whatever else is free makes the plane less certain.
    assert (free.distance > estimate_uncertainty(start_of(scene)).distance).all()


@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface", "camera_housing"])
def test_the_deviation_of_points_is_that_of_repetitions(scenes: Scenes, scenario: Scenario) -> None:
    """With cameras and interfaces at the truth; the largest of three estimated variances is a little too large."""
    scene = scenes(scenario, **SMALL)
    found, stated = [], []
    for seed in range(60):
        capture = photographed_again(scene.capture, seed)
        read = read_observations(capture.reconstruction)
        arrangement = arrange(read, RefinerOptions(scenario=scenario), ImageNotes())
        problem = arrangement.start(0.4, arrangement.observations)
        structure, rotation, translation = problem.structure, *problem.state.cam_from_world(problem.structure)
        normal, distance = problem.state.normal.copy(), problem.state.distance.copy()
        for i, image_id in enumerate(read.image_ids.tolist()):
            n, d = capture.planes[image_id][0], capture.planes[image_id][1] / arrangement.unit
            block = structure.image_plane[i]
            if structure.plane_in_world[block]:
                n, offset = plane_in_world(n, d, rotation[i], translation[i])
                d = offset - n @ structure.plane_anchor[block]
            normal[block], distance[block] = n, d
        problem = replace(
            problem,
            state=replace(problem.state, normal=normal, distance=distance),
            points=(read.points - arrangement.origin) / arrangement.unit,
            loss="trivial",
        )
        problem = replace(problem, points=settle_points(problem, SolverSettings(num_threads=1)))
        found.append(problem.points)
        stated.append(estimate_uncertainty(problem).points)
    variance = [np.linalg.eigvalsh(np.cov(draws.T))[-1] for draws in np.moveaxis(np.array(found), 1, 0)]
    expected = float(np.median(stated)) * scene.capture.options.pixel_noise
    assert 0.95 < np.median(np.sqrt(variance)) / expected < 1.15
