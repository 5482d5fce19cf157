"""The error of a model's points is free of a similarity, and its bound is that of the dense equations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pycolmap
import pytest

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers, plane_in_cam, plane_in_world, tangent_basis
from colmap_refract.options import Scenario
from colmap_refract.simulation import (
    Capture,
    SceneOptions,
    least_path_direction,
    noise_bound,
    point_rmse,
    simulate,
)


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


def small(scenario: Scenario, **options: Any) -> Capture:
    return simulate(SceneOptions(scenario=scenario, **{"num_images": 6, "num_points": 40, **options}))


def reinterpreted(capture: Capture, scenario: Scenario) -> Capture:
    """The same pixels, with other unknowns."""
    return replace(capture, options=replace(capture.options, scenario=scenario))


class _View(NamedTuple):
    """One image: its place among frames and planes, the keypoints it has (n,) and their points (n,)."""

    camera: pycolmap.Camera
    sensor_from_rig: pycolmap.Rigid3d
    frame: int
    block: int
    keypoints: Any
    points: Any


def unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def dense_jacobian(capture: Capture) -> tuple[Array, Array]:
    """The points of the bound (P, 3) and the derivative of all their pixels by one unknown at a time.

    Columns: points (3 each), poses (6 per frame), planes (3 each).
    """
    model, options = capture.reconstruction, capture.options
    kept = [element for point in model.points3D.values() for element in point.track.elements]
    kept = [e for e in kept if (e.image_id, e.point2D_idx) not in capture.outliers]
    ids = [model.image(e.image_id).point2D(e.point2D_idx).point3D_id for e in kept]
    kept = [e for e, i in zip(kept, ids, strict=True) if ids.count(i) >= 2]
    ids = [i for i in ids if ids.count(i) >= 2]
    rows = {point_id: k for k, point_id in enumerate(sorted(set(ids)))}
    truth = np.array([model.point3D(i).xyz for i in rows])

    views: list[_View] = []
    planes: dict[int, tuple[Array, float]] = {}
    rig_from_world: dict[int, pycolmap.Rigid3d] = {}
    for image_id, image in sorted(model.images.items()):
        mine = [(e.point2D_idx, rows[i]) for e, i in zip(kept, ids, strict=True) if e.image_id == image_id]
        pose, interface = image.cam_from_world(), (image.frame_id - 1) // options.frames_per_interface
        block = {"static_interface": 0, "camera_housing": image.camera_id - 1}.get(options.scenario, interface)
        plane = capture.planes[image_id]
        if options.scenario != "camera_housing":
            plane = plane_in_world(*plane, pose.rotation.matrix(), pose.translation)
        planes[block] = plane
        rig = rig_from_world.setdefault(image.frame_id - 1, pose)  # the first sensor is the rig's reference
        views.append(
            _View(model.camera(image.camera_id), pose * rig.inverse(), image.frame_id - 1, block, *np.array(mine).T)
        )
    num_poses = 0 if options.scenario == "fixed_camera" else len(rig_from_world)

    def pixels(change: Array) -> Array:
        by_point, by_pose, by_plane = np.split(change, np.cumsum([truth.size, 6 * num_poses]))
        points = truth + by_point.reshape(-1, 3)
        in_cam, normals, distances = [], [], []
        for view in views:
            rig = rig_from_world[view.frame]
            if num_poses:
                w, v = by_pose.reshape(-1, 2, 3)[view.frame]
                rig = pycolmap.Rigid3d(pycolmap.Rotation3d(w), v) * rig
            pose = view.sensor_from_rig * rig
            normal, distance = planes[view.block]
            tilt = by_plane.reshape(-1, 3)[view.block]
            normal, distance = unit(normal + tangent_basis(normal) @ tilt[:2]), distance + tilt[2]
            if options.scenario != "camera_housing":
                normal, distance = plane_in_cam(normal, distance, pose.rotation.matrix(), pose.translation)
            in_cam.append(pose * points[view.points])
            normals += [normal] * len(view.points)
            distances += [distance] * len(view.points)
        rays = least_path_direction(np.concatenate(in_cam), normals, distances, options.layers)
        per_view = np.split(rays, np.cumsum([len(part) for part in in_cam])[:-1])
        found = [np.asarray(view.camera.img_from_cam(rays)) for view, rays in zip(views, per_view, strict=True)]
        return np.concatenate(found).ravel()

    unknowns = truth.size + 6 * num_poses + 3 * len(planes)
    exact = np.concatenate([capture.pixels[i][view.keypoints] for i, view in enumerate(views, start=1)]).ravel()
    np.testing.assert_allclose(pixels(np.zeros(unknowns)), exact, atol=1e-9)
    steps = 1e-5 * np.eye(unknowns)
    return truth, np.stack([(pixels(step) - pixels(-step)) / 2e-5 for step in steps], axis=1)


def across_similarities(points: Array) -> Array:
    """The projection (3P, 3P) on what an alignment of points (P, 3) leaves of their changes."""
    turns = [np.cross(axis, points).ravel() for axis in np.eye(3)]
    g = np.stack([*np.tile(np.eye(3), len(points)), *turns, points.ravel()], axis=1)
    return np.asarray(np.eye(len(g)) - g @ np.linalg.solve(g.T @ g, g.T))


@pytest.mark.parametrize(
    ("scenario", "options"),
    [
        ("moving_interface", {}),
        ("static_interface", {"outlier_ratio": 0.2}),
        ("fixed_camera", {}),
        ("camera_housing", {"num_cameras": 2}),
        ("moving_interface", {"sensors_per_frame": 2, "num_images": 8}),
        ("camera_housing", {"sensors_per_frame": 2}),
        ("moving_interface", {"frames_per_interface": 3}),
        ("fixed_camera", {"frames_per_interface": 2}),
        ("static_interface", {"layers": Layers(thickness=(0.3,), index=(1.52, 1.333))}),
    ],
)
def test_bound_is_that_of_the_dense_equations(scenario: Scenario, options: dict[str, Any]) -> None:
    capture = small(scenario, **options)
    points, jacobian = dense_jacobian(capture)
    # The gauge is at 1e-16 of the largest eigenvalue or below, what the pixels determine above 1e-9.
    covariance = 0.5**2 * np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-12, hermitian=True)
    covariance = covariance[: points.size, : points.size]
    beside = across_similarities(points)
    bound = np.sqrt(np.trace(beside @ covariance @ beside.T) / len(points))
    assert noise_bound(capture) == pytest.approx(bound, rel=1e-5)
    assert len(points) >= 30


def test_bound_is_the_error_of_the_least_squares_solution() -> None:
    # Noise so small that the pixels are linear: what this adds is that `point_rmse` is what is bounded.
    capture = small("static_interface")
    capture = replace(capture, options=replace(capture.options, pixel_noise=1e-3))
    points, jacobian = dense_jacobian(capture)
    solve = np.linalg.pinv(jacobian, rcond=1e-8)[: points.size]
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(100):
        model = pycolmap.Reconstruction(capture.reconstruction)
        changes = (solve @ (1e-3 * rng.standard_normal(len(jacobian)))).reshape(-1, 3)
        for (_, point), change in zip(sorted(model.points3D.items()), changes, strict=True):
            point.xyz = point.xyz + change
        errors.append(point_rmse(model, capture))
    # A hundred errors, each of some 80 independent numbers, know their root mean square to about 2 %.
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(noise_bound(capture), rel=0.05)


def test_bound_is_proportional_to_the_noise() -> None:
    capture = small("moving_interface")
    bounds = []
    for noise in (0.0, 0.5, 2.0):
        bounds.append(noise_bound(replace(capture, options=replace(capture.options, pixel_noise=noise))))
    assert bounds[0] == 0 < bounds[1]
    assert bounds[2] == pytest.approx(4 * bounds[1], rel=1e-12)


def test_more_unknowns_have_a_larger_bound() -> None:
    static = small("static_interface")
    moving = reinterpreted(static, "moving_interface")
    grouped = replace(moving, options=replace(moving.options, frames_per_interface=3))
    assert 1.01 * noise_bound(static) < noise_bound(grouped) < noise_bound(moving) / 1.01


def test_planes_that_bend_nothing_are_no_unknowns() -> None:
    capture = small("static_interface", layers=Layers(index=(1.0,)))
    assert noise_bound(reinterpreted(capture, "moving_interface")) == pytest.approx(noise_bound(capture), rel=1e-9)


def test_bound_needs_three_points() -> None:
    capture = small("static_interface")
    everything = {
        (element.image_id, element.point2D_idx)
        for point in capture.reconstruction.points3D.values()
        for element in point.track.elements
    }
    with pytest.raises(RefractError, match="0 points"):
        noise_bound(replace(capture, outliers=everything))
