"""Points from refracted rays that were made by another projection: the path of least time."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from colmap_refract.estimator.elimination import Tracks
from colmap_refract.estimator.rotation import exp_and_left_jacobian
from colmap_refract.estimator.scenario import SCENARIOS, State, Structure, share_planes
from colmap_refract.estimator.triangulation import refracted_rays, triangulate, triangulation_angles
from colmap_refract.interface import Array, Layers, tangent_basis
from colmap_refract.options import Scenario
from colmap_refract.simulation import least_path_direction

FOCAL_LENGTH = 1200.0
WATER = Layers()
TANK = Layers(thickness=(0.02, 0.1), index=(1.49, 1.0, 1.333))


def unit(vector: Any) -> Array:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector, axis=-1, keepdims=True)


def scene(
    scenario: Scenario = "moving_interface", layers: Layers = WATER, *, num_images: int = 6, num_points: int = 40
) -> tuple[Tracks, Structure, State, Array]:
    """Cameras half a metre apart that look down on points at 2 to 3 m, through an interface at about 1 m.

    Every image sees every point, in its exact direction; some points stand out of the water.
    """
    rng = np.random.default_rng(0)
    poses = 1 if scenario == "fixed_camera" else num_images
    rotation = exp_and_left_jacobian(0.1 * rng.normal(size=(poses, 3)))[0]
    centers = np.column_stack([rng.uniform(-0.5, 0.5, (poses, 2)), 0.1 * rng.normal(size=poses)])
    image = np.arange(num_images)
    plane, in_world, _ = share_planes(
        scenario, image.tolist(), [0] * num_images, [None] * num_images, [False] * num_images
    )
    anchor = rng.normal(size=(len(in_world), 3))
    normal = unit(np.column_stack([0.15 * rng.normal(size=(len(in_world), 2)), np.ones(len(in_world))]))
    distance = rng.uniform(0.9, 1.1, len(in_world)) - in_world * np.einsum("bi,bi->b", normal, anchor)
    structure = Structure(
        image_pose=np.zeros(num_images, np.int64) if scenario == "fixed_camera" else image,
        image_plane=plane,
        image_camera=np.zeros(num_images, np.int64),
        sensor_rotation=np.array([np.eye(3)] * num_images),
        sensor_translation=np.zeros((num_images, 3)),
        plane_in_world=in_world,
        plane_anchor=anchor,
    )
    state = State(
        rotation=rotation,
        translation=-np.einsum("nij,nj->ni", rotation, centers),
        normal=normal,
        distance=distance,
        index=layers.refractive_index,
        lens=np.zeros((1, 0)),
    )
    points = rng.uniform([-0.6, -0.6, 2], [0.6, 0.6, 3], (num_points, 3))
    points[: num_points // 8, 2] = 0.5
    return observe(points, structure, state, layers), structure, state, points


def observe(points: Array, structure: Structure, state: State, layers: Layers) -> Tracks:
    """Every image's direction of every point, by least path."""
    count = structure.num_images
    rotation, translation = state.cam_from_world(structure)
    normal, distance = state.planes_in_cam(structure)
    in_cam = np.einsum("nij,pj->pni", rotation, points) + translation
    image = np.tile(np.arange(count), len(points))
    flat = in_cam.reshape(-1, 3)
    depth = np.einsum("ni,ni->n", flat, normal[image])
    direction = least_path_direction(flat, normal[image], distance[image], layers)
    basis = np.array([tangent_basis(d) for d in direction])
    return Tracks(
        start=count * np.arange(len(points) + 1),
        image=image.astype(np.int32),
        direction=direction,
        metric=FOCAL_LENGTH * basis.transpose(0, 2, 1),
        lens=np.zeros((len(flat), 2, 0)),
        wet=depth > distance[image] + sum(layers.thickness),
    )


def turned(direction: Array, pixels: float, rng: np.random.Generator) -> Array:
    return unit(direction + pixels / FOCAL_LENGTH * rng.normal(size=direction.shape))


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("layers", [WATER, TANK])
def test_exact_rays_give_the_exact_points(scenario: Scenario, layers: Layers) -> None:
    tracks, structure, state, points = scene(scenario, layers)
    assert 0 < tracks.wet.sum() < len(tracks.wet)
    fallback = np.full_like(points, 99.0)
    found = triangulate(tracks, structure, state, layers, fallback)
    # A fixed camera sees a dry point along one ray: there is nothing to triangulate.
    seen = tracks.wet.reshape(len(points), -1).any(axis=1) if scenario == "fixed_camera" else np.ones(len(points), bool)
    # Refraction alone parts the rays of a fixed camera by 2 degrees: 1e-15 of direction is 1e-12 of depth.
    np.testing.assert_allclose(found[seen], points[seen], atol=1e-10 if scenario == "fixed_camera" else 1e-12)
    np.testing.assert_array_equal(found[~seen], fallback[~seen])
    np.testing.assert_array_equal(fallback, 99.0)  # it is not altered


@pytest.mark.parametrize("layers", [WATER, TANK])
def test_rays_pass_through_their_points(layers: Layers) -> None:
    tracks, structure, state, points = scene("static_interface", layers)
    origin, ray = refracted_rays(tracks, structure, state, layers)
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1.0, rtol=1e-12)
    of = np.repeat(points, np.diff(tracks.start), axis=0)
    np.testing.assert_allclose(np.cross(of - origin, ray), 0.0, atol=1e-12)
    # A dry ray starts at its camera, a wet one on the far side of the walls.
    rotation, translation = state.cam_from_world(structure)
    centers = -np.einsum("nji,nj->ni", rotation, translation)[tracks.image]
    np.testing.assert_allclose(origin[~tracks.wet], centers[~tracks.wet], atol=1e-12)
    height = (origin - structure.plane_anchor[0]) @ state.normal[0] - state.distance[0]
    np.testing.assert_allclose(height[tracks.wet], sum(layers.thickness), atol=1e-12)


def test_images_without_an_interface_have_straight_rays() -> None:
    tracks, structure, state, points = scene("static_interface")
    dry = replace(structure, image_plane=np.where(np.arange(6) < 2, -1, structure.image_plane))
    of = np.repeat(points, 6, axis=0)
    rotation, translation = state.cam_from_world(structure)
    in_cam = np.einsum("nij,nj->ni", rotation[tracks.image], of) + translation[tracks.image]
    straight = np.where((tracks.image < 2)[:, None], unit(in_cam), tracks.direction)
    found = triangulate(tracks._replace(direction=straight), dry, state, WATER, np.zeros_like(points))
    np.testing.assert_allclose(found, points, atol=1e-12)


def test_one_wrong_ray_in_six_has_no_say() -> None:
    """For 95 points in 100. Reweighting can settle at a wrong place, too: that is for the filter behind it."""
    tracks, structure, state, points = scene(num_points=400)
    rng = np.random.default_rng(1)
    noisy = turned(tracks.direction, 0.3, rng)
    clean = triangulate(tracks._replace(direction=noisy), structure, state, WATER, np.zeros_like(points))
    spoilt = noisy.copy()
    wrong = tracks.start[:-1] + rng.integers(0, 6, len(points))
    spoilt[wrong] = turned(noisy[wrong], 100.0, rng)
    found = triangulate(tracks._replace(direction=spoilt), structure, state, WATER, np.zeros_like(points))
    error, best = (np.linalg.norm(p - points, axis=1) for p in (found, clean))
    # 100 px are 0.2 m at this depth; an equal say of one in six would be some centimetres.
    assert np.median(error) < 1.5 * np.median(best) < 3e-3
    assert np.quantile(error, 0.95) < 2 * np.quantile(best, 0.95) < 0.01


def test_points_without_parallax_keep_their_fallback() -> None:
    tracks, structure, state, points = scene()
    fallback = np.random.default_rng(2).normal(size=points.shape)
    # One pose and one plane for all: every ray of a point is the same.
    same = replace(
        structure, image_pose=np.zeros(6, np.int64), image_plane=np.zeros(6, np.int64), plane_in_world=np.zeros(6, bool)
    )
    one = observe(points, same, state, WATER)
    np.testing.assert_array_equal(triangulate(one, same, state, WATER, fallback), fallback)
    # Rays side by side: the points lie at infinity.
    aside = replace(state, rotation=np.array([np.eye(3)] * 6), normal=np.array([[0.0, 0.0, 1.0]] * 6))
    ahead = tracks._replace(
        direction=np.tile(unit([0.1, 0.2, 1.0]), (len(tracks.image), 1)), wet=np.ones_like(tracks.wet)
    )
    found = triangulate(ahead, replace(structure, plane_in_world=np.zeros(6, bool)), aside, WATER, fallback)
    np.testing.assert_array_equal(found, fallback)


def test_rays_that_miss_the_interface_are_ignored() -> None:
    tracks, structure, state, points = scene()
    direction = tracks.direction.copy()
    direction[0::6] = [0.0, 0.6, -0.8]  # away from it
    direction[1::6] = np.nan
    wet = tracks.wet.copy()
    wet[0::6] = True
    fallback = np.full_like(points, 7.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        missing = tracks._replace(direction=direction, wet=wet)
        found = triangulate(missing, structure, state, WATER, fallback)
        np.testing.assert_allclose(found, points, atol=1e-11)
        alone = triangulate(
            missing._replace(wet=np.ones_like(wet), direction=-abs(direction)), structure, state, WATER, fallback
        )
    np.testing.assert_array_equal(alone, fallback)


@pytest.mark.parametrize("layers", [WATER, TANK])
def test_angles_are_the_largest_between_any_two_rays(layers: Layers) -> None:
    tracks, structure, state, points = scene(layers=layers)
    angles = triangulation_angles(tracks, structure, state, layers, points)
    _, ray = refracted_rays(tracks, structure, state, layers)
    for p in range(len(points)):
        mine = ray[tracks.start[p] : tracks.start[p + 1]]
        # Exact rays run to the point itself.
        pairs = [np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b) for a in mine for b in mine]
        assert angles[p] == pytest.approx(np.degrees(max(pairs)), rel=1e-9)
    assert angles.max() > 5


def test_small_angles_keep_their_digits() -> None:
    tracks, structure, state, points = scene(num_images=2)
    baseline = 1e-7
    state = replace(
        state,
        rotation=np.array([np.eye(3)] * 2),
        translation=np.array([[0.0, 0.0, 0.0], [-baseline, 0.0, 0.0]]),
        normal=np.array([[0.0, 0.0, 1.0]] * 2),
        distance=np.ones(2),
    )
    dry = tracks._replace(wet=np.zeros_like(tracks.wet))
    angles = np.radians(triangulation_angles(dry, structure, state, WATER, points))
    expected = baseline * np.hypot(points[:, 1], points[:, 2]) / np.einsum("ni,ni->n", points, points)
    np.testing.assert_allclose(angles, expected, rtol=1e-6)


def test_angles_of_rays_that_miss_are_no_angles() -> None:
    tracks, structure, state, points = scene()
    missing = tracks._replace(direction=-tracks.direction, wet=np.ones_like(tracks.wet))
    np.testing.assert_array_equal(triangulation_angles(missing, structure, state, WATER, points), 0.0)
