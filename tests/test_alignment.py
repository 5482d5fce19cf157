"""A similarity moves points, poses and planes together, and is found again from poses of which some are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from colmap_refract.estimator.rotation import mean_rotation
from colmap_refract.interface import Array, Layers, plane_in_cam
from colmap_refract.refiner.alignment import Similarity, align_poses, rescale_about
from colmap_refract.simulation import least_path_direction

KNOWN_SCALES = [None, 3.5]


def rotations(count: int, rng: np.random.Generator) -> Array:
    """(count, 3, 3), all over the sphere."""
    return np.array([mean_rotation(rng.standard_normal((1, 3, 3))) for _ in range(count)])


def some_similarity(rng: np.random.Generator) -> Similarity:
    return Similarity(scale=3.5, rotation=rotations(1, rng)[0], translation=np.array([20.0, -3.0, 7.0]))


def some_poses(centers: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    rotation = rotations(len(centers), rng)
    return rotation, -np.einsum("nij,nj->ni", rotation, centers)


def assert_same(found: Similarity | None, expected: Similarity, tolerance: float) -> None:
    assert found is not None
    assert found.scale == pytest.approx(expected.scale, rel=tolerance)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=tolerance)
    np.testing.assert_allclose(found.translation, expected.translation, atol=30 * tolerance)


def test_rotations_of_the_tests_are_rotations() -> None:
    rotation = rotations(20, np.random.default_rng(0))
    np.testing.assert_allclose(rotation @ rotation.mT, np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)


def test_points_poses_and_planes_move_together() -> None:
    """What a camera sees of a point through a plane is the same before and after."""
    rng = np.random.default_rng(1)
    move = some_similarity(rng)
    points = rng.uniform(-1, 1, (50, 3)) + [0.0, 0.0, 5.0]
    normal, offset = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0]), 2.0
    layers = Layers(thickness=(0.2,), index=(1.5, 1.333))
    rotation, translation = some_poses(0.3 * rng.standard_normal((4, 3)), rng)
    moved_rotation, moved_translation = move.cam_from_world(rotation, translation)
    moved_normal, moved_offset = move.plane(normal, offset)
    moved_points = move.points(points)
    for i in range(4):
        seen = least_path_direction(
            points @ rotation[i].T + translation[i], *plane_in_cam(normal, offset, rotation[i], translation[i]), layers
        )
        plane = plane_in_cam(moved_normal, moved_offset, moved_rotation[i], moved_translation[i])
        moved_seen = least_path_direction(
            moved_points @ moved_rotation[i].T + moved_translation[i], *plane, layers.scaled(move.scale)
        )
        np.testing.assert_allclose(moved_seen, seen, atol=1e-12)
        # Against vacuity: the points are refracted.
        straight = points @ rotation[i].T + translation[i]
        straight /= np.linalg.norm(straight, axis=1)[:, None]
        assert np.abs(seen - straight).max() > 0.01


def test_a_plane_of_the_world_keeps_its_points() -> None:
    rng = np.random.default_rng(2)
    move = some_similarity(rng)
    normal = np.array([0.0, 0.6, 0.8])
    on_plane = rng.standard_normal((10, 3))
    on_plane += (1.5 - on_plane @ normal)[:, None] * normal
    moved_normal, moved_offset = move.plane(normal, 1.5)
    assert np.linalg.norm(moved_normal) == pytest.approx(1.0, rel=1e-14)
    np.testing.assert_allclose(move.points(on_plane) @ moved_normal, moved_offset)


@pytest.mark.parametrize("scale", KNOWN_SCALES)
@pytest.mark.parametrize("layout", ["cloud", "line", "pair"])
def test_known_similarity_is_found(layout: str, scale: float | None) -> None:
    """Centres in a line leave a turn about it open, which the poses' own turns tell."""
    rng = np.random.default_rng(3)
    centers = {
        "cloud": rng.standard_normal((12, 3)),
        "line": np.outer(np.linspace(-1, 1, 12), [1.0, 2.0, -0.5]),
        "pair": np.array([[0.0, 0, 0], [1.0, 0, 0]]),
    }[layout]
    poses = some_poses(centers, rng)
    move = some_similarity(rng)
    assert_same(align_poses(poses, move.cam_from_world(*poses), spread=1e-3, scale=scale), move, 1e-10)


@pytest.mark.parametrize("scale", KNOWN_SCALES)
@pytest.mark.parametrize("layout", ["cloud", "line"])
def test_wrong_poses_do_little_harm(layout: str, scale: float | None) -> None:
    """A fifth of the poses are anywhere; the others are a thousandth off, as those of a bent model are.

    The alignment is robust, not exact: wrong poses have a weight that falls with how far off they are.
    """
    rng = np.random.default_rng(4)
    centers = rng.standard_normal((30, 3)) if layout == "cloud" else np.outer(np.linspace(-2, 2, 30), [1.0, 0.2, 0])
    poses = some_poses(centers, rng)
    move = some_similarity(rng)
    rotation, translation = move.cam_from_world(*poses)
    translation = translation + 1e-3 * rng.standard_normal((30, 3))
    rotation[::5] = rotations(6, rng)
    translation[::5] += 10.0 * rng.standard_normal((6, 3))
    assert_same(align_poses(poses, (rotation, translation), spread=1e-3, scale=scale), move, 0.01)


def test_centres_at_one_place_tell_no_scale() -> None:
    rng = np.random.default_rng(5)
    centers = np.array([1.0, 2.0, 3.0]) + 1e-6 * rng.standard_normal((8, 3))
    poses = some_poses(centers, rng)
    move = some_similarity(rng)
    target = move.cam_from_world(*poses)
    assert align_poses(poses, target, spread=1e-3) is None
    # Where the scale is known, there is nothing to tell.
    assert_same(align_poses(poses, target, spread=1e-3, scale=3.5), move, 1e-4)


def test_rescaling_leaves_its_center_alone() -> None:
    center = np.array([1.0, -2.0, 0.5])
    move = rescale_about(center, 3.0)
    np.testing.assert_allclose(move.points(center[None])[0], center, atol=1e-14)
    np.testing.assert_allclose(move.points(center[None] + [[0, 0, 1.0]])[0], center + [0, 0, 3.0], atol=1e-14)
    # A camera there sees the same as before.
    rotation, translation = some_poses(center[None], np.random.default_rng(6))
    moved_rotation, moved_translation = move.cam_from_world(rotation, translation)
    np.testing.assert_allclose(moved_rotation, rotation)
    np.testing.assert_allclose(moved_translation, translation, atol=1e-14)
