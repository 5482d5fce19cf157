"""Tyings: who shares what, and the derivative of each image's own parameters by the shared ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from colmap_refract.estimator.rotation import cross_matrix, exp_and_left_jacobian, mean_rotation
from colmap_refract.estimator.scenario import (
    SCENARIOS,
    Change,
    State,
    Structure,
    apply,
    evaluate_views,
    share_planes,
)
from colmap_refract.interface import Array, plane_in_cam, tangent_basis
from colmap_refract.options import Scenario

STEP = 1e-5
"""Of central differences: their error is about STEP^2 = 1e-10, and rounding adds 1e-16 / STEP = 1e-11."""
TOLERANCE = 1e-8
"""A wrong sign or a missing term is of the order of 0.1 or more in these problems."""


def unit(vector: Any) -> Array:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector, axis=-1, keepdims=True)


def arrange(scenario: Scenario, *, sensors: int, groups: bool = False, seed: int = 0) -> tuple[Structure, State]:
    """Four frames of `sensors` images by two rigs in turn, in random poses; the last image is dry."""
    rng = np.random.default_rng(seed)
    frames = 4
    frame = np.repeat(np.arange(frames), sensors)
    camera = np.tile(np.arange(2 * sensors), frames // 2)
    group = ["a" if groups and 1 <= f <= 2 else None for f in frame]
    dry = [i == len(frame) - 1 for i in range(len(frame))]
    image_plane, in_world, _ = share_planes(scenario, frame.tolist(), camera.tolist(), group, dry)
    reference = np.tile(np.arange(sensors) == 0, frames)
    turn = exp_and_left_jacobian(0.3 * rng.normal(size=(2 * sensors, 3)))[0][camera]
    shift = rng.normal(size=(2 * sensors, 3))[camera]
    planes = len(in_world)
    structure = Structure(
        image_pose=frame % 2 if scenario == "fixed_camera" else frame,
        image_plane=image_plane,
        image_camera=camera,
        sensor_rotation=np.where(reference[:, None, None], np.eye(3), turn),
        sensor_translation=np.where(reference[:, None], 0.0, shift),
        plane_in_world=in_world,
        plane_anchor=rng.normal(size=(planes, 3)),
    )
    poses = structure.num_poses
    state = State(
        rotation=exp_and_left_jacobian(rng.normal(size=(poses, 3)))[0],
        translation=rng.normal(size=(poses, 3)),
        normal=unit(np.column_stack([0.4 * rng.normal(size=(planes, 2)), np.ones(planes)])),
        distance=rng.uniform(0.5, 2, planes),
        index=1.333,
        lens=rng.normal(size=(2 * sensors, 2)),
    )
    return structure, state


def random_change(state: State, size: float, seed: int = 1) -> Change:
    rng = np.random.default_rng(seed)
    zero = Change.zero(state)
    return Change(
        pose=size * rng.normal(size=zero.pose.shape),
        plane=size * rng.normal(size=zero.plane.shape),
        index=size * 0.1,
        lens=size * rng.normal(size=zero.lens.shape),
    )


CASES = [(scenario, sensors, groups) for scenario in SCENARIOS for sensors in (1, 2) for groups in (False, True)]
cases = pytest.mark.parametrize(("scenario", "sensors", "groups"), CASES)


@cases
@pytest.mark.parametrize("size", [0.0, 0.2])
def test_pose_map_is_the_derivative_of_the_poses(scenario: Scenario, sensors: int, groups: bool, size: float) -> None:
    structure, state = arrange(scenario, sensors=sensors, groups=groups)
    change = random_change(state, size)
    views = evaluate_views(structure, state, change, np.zeros((structure.num_images, 5), np.int32))

    def pose(j: int, step: float) -> tuple[Array, Array]:
        moved = change.pose.copy()
        moved[:, j] += step  # every block at once: an image depends on its own only
        return apply(state, replace(change, pose=moved)).cam_from_world(structure)

    for j in range(6):
        (ahead_r, ahead_t), (behind_r, behind_t) = pose(j, STEP), pose(j, -STEP)
        skew = (ahead_r - behind_r) / (2 * STEP) @ views.rotation.transpose(0, 2, 1)
        turn = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        # x_cam = R x + t changes by turn x x_cam + shift.
        shift = (ahead_t - behind_t) / (2 * STEP) - np.cross(turn, views.translation)
        np.testing.assert_allclose(views.pose_map[:, :, j], np.hstack([turn, shift]), atol=TOLERANCE)


@cases
@pytest.mark.parametrize("size", [0.0, 0.2])
def test_plane_map_is_the_derivative_of_the_planes(scenario: Scenario, sensors: int, groups: bool, size: float) -> None:
    structure, state = arrange(scenario, sensors=sensors, groups=groups)
    change = random_change(state, size)
    views = evaluate_views(structure, state, change, np.zeros((structure.num_images, 5), np.int32))
    wet = structure.image_plane >= 0

    def plane(j: int, step: float) -> Array:
        moved = change.plane.copy()
        moved[:, j] += step
        normal, distance = apply(state, replace(change, plane=moved)).planes_in_cam(structure)
        return np.column_stack([normal, distance])[wet]

    for j in range(3):
        difference = (plane(j, STEP) - plane(j, -STEP)) / (2 * STEP)
        np.testing.assert_allclose(views.plane_map[wet][:, :, j], difference, atol=TOLERANCE)
    assert abs(views.plane_map[wet]).max() > 0.5


@cases
def test_views_are_the_changed_state(scenario: Scenario, sensors: int, groups: bool) -> None:
    structure, state = arrange(scenario, sensors=sensors, groups=groups)
    change = random_change(state, 0.2)
    columns = np.arange(4 * structure.num_images, dtype=np.int32).reshape(-1, 4)
    views = evaluate_views(structure, state, change, columns)
    moved = apply(state, change)
    np.testing.assert_allclose(np.linalg.norm(moved.normal, axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(
        moved.rotation @ moved.rotation.transpose(0, 2, 1), [np.eye(3)] * structure.num_poses, atol=1e-14
    )
    wet = structure.image_plane >= 0
    for value, expected in zip((views.rotation, views.translation), moved.cam_from_world(structure), strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-14)
    for value, expected in zip((views.normal, views.distance), moved.planes_in_cam(structure), strict=True):
        np.testing.assert_allclose(value[wet], expected[wet], atol=1e-14)
        assert np.isnan(expected[~wet]).all() and np.isfinite(value[~wet]).all()
    np.testing.assert_array_equal(views.in_world[wet], structure.plane_in_world[structure.image_plane[wet]])
    assert not views.in_world[~wet].any()
    np.testing.assert_allclose(views.lens_change, moved.lens[structure.image_camera])
    assert views.columns is columns
    # No change is no change.
    np.testing.assert_array_equal(apply(state, Change.zero(state)).rotation, state.rotation)


def test_turning_a_camera_leaves_its_centre() -> None:
    structure, state = arrange("static_interface", sensors=1)
    change = Change.zero(state)
    change.pose[:, :3] = np.random.default_rng(2).normal(size=(structure.num_poses, 3))
    moved = apply(state, change)
    centers = [-np.einsum("nji,nj->ni", s.rotation, s.translation) for s in (state, moved)]
    np.testing.assert_allclose(*centers, atol=1e-14)


@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface"])
@pytest.mark.parametrize("sensors", [1, 2])
def test_a_world_that_moves_as_a_whole_looks_the_same(scenario: Scenario, sensors: int) -> None:
    """One rigid motion of cameras, planes and anchors: no camera's plane changes."""
    structure, state = arrange(scenario, sensors=sensors, groups=True)
    turn, shift = exp_and_left_jacobian(np.array([0.5, -1.0, 0.7]))[0], np.array([30.0, -2.0, 7.0])
    in_world = structure.plane_in_world[:, None]
    assert in_world.any()
    moved_structure = replace(structure, plane_anchor=structure.plane_anchor @ turn.T + shift)
    rotation = state.rotation @ turn.T
    moved = replace(
        state,
        rotation=rotation,
        translation=state.translation - rotation @ shift,
        normal=np.where(in_world, state.normal @ turn.T, state.normal),
    )
    for before, after in zip(state.planes_in_cam(structure), moved.planes_in_cam(moved_structure), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-13)


def test_the_anchor_is_only_an_origin() -> None:
    """A plane's distance is measured from its anchor; another anchor with the distance to match is the same plane."""
    structure, state = arrange("static_interface", sensors=1)
    anchor = structure.plane_anchor + [[3.0, -8.0, 2.0]]
    distance = state.distance - np.einsum("bi,bi->b", state.normal, anchor - structure.plane_anchor)
    same = replace(state, distance=distance).planes_in_cam(replace(structure, plane_anchor=anchor))
    np.testing.assert_allclose(same[0], state.planes_in_cam(structure)[0], atol=1e-14)
    np.testing.assert_allclose(same[1], state.planes_in_cam(structure)[1], atol=1e-13)
    # And it agrees with the plane as an equation in the world.
    offset = state.distance[0] + state.normal[0] @ structure.plane_anchor[0]
    rotation, translation = state.cam_from_world(structure)
    normal, d = plane_in_cam(state.normal[0], float(offset), rotation[1], translation[1])
    np.testing.assert_allclose(same[0][1], normal, atol=1e-14)
    np.testing.assert_allclose(same[1][1], d, atol=1e-13)


def test_without_any_interface_there_are_no_planes() -> None:
    structure, state = arrange("static_interface", sensors=1)
    structure = replace(
        structure, image_plane=np.full(4, -1), plane_in_world=np.zeros(0, bool), plane_anchor=np.zeros((0, 3))
    )
    state = replace(state, normal=np.zeros((0, 3)), distance=np.zeros(0))
    views = evaluate_views(structure, state, Change.zero(state), np.full((4, 5), -1, np.int32))
    assert np.isnan(state.planes_in_cam(structure)[0]).all()
    assert np.isfinite(views.normal).all() and (views.distance > 0).all() and not views.in_world.any()


# Two frames of two images (cameras 0 and 1), then two frames of one image each (camera 2).
FRAME = [0, 0, 1, 1, 2, 3]
CAMERA = [0, 1, 0, 1, 2, 2]
NOBODY: list[str | None] = [None] * 6


@pytest.mark.parametrize(
    ("scenario", "planes", "in_world"),
    [
        # The images of one frame are taken at one instant, of one surface that stands in the world.
        ("moving_interface", [0, 0, 1, 1, 2, 3], [True, True, False, False]),
        ("fixed_camera", [0, 0, 1, 1, 2, 3], [True, True, False, False]),
        ("static_interface", [0] * 6, [True]),
        ("camera_housing", [0, 1, 0, 1, 2, 2], [False, False, False]),
    ],
)
def test_who_shares_a_plane(scenario: Scenario, planes: list[int], in_world: list[bool]) -> None:
    found = share_planes(scenario, FRAME, CAMERA, NOBODY, [False] * 6)
    assert (found[0].tolist(), found[1].tolist(), found[2]) == (planes, in_world, [None] * len(in_world))


@pytest.mark.parametrize(
    ("scenario", "planes", "in_world", "names"),
    [
        ("moving_interface", [0, 0, 1, 1, 1, 1], [True, True], [None, "tank"]),
        ("fixed_camera", [0, 0, 1, 1, 1, 1], [True, True], [None, "tank"]),
        ("static_interface", [0, 0, 1, 1, 1, 1], [True, True], [None, "tank"]),
        ("camera_housing", [0, 1, 2, 2, 2, 2], [False, False, False], [None, None, "tank"]),
    ],
)
def test_groups_share_a_plane(
    scenario: Scenario, planes: list[int], in_world: list[bool], names: list[str | None]
) -> None:
    group = [None, None, "tank", "tank", "tank", "tank"]
    found = share_planes(scenario, FRAME, CAMERA, group, [False] * 6)
    assert (found[0].tolist(), found[1].tolist(), found[2]) == (planes, in_world, names)


def test_a_group_has_no_plane_in_common_with_what_its_name_resembles() -> None:
    group = ["world", "0", None, None, None, None]
    assert share_planes("static_interface", FRAME, CAMERA, group, [False] * 6)[0].tolist() == [0, 1, 2, 2, 2, 2]
    assert share_planes("camera_housing", FRAME, CAMERA, group, [False] * 6)[0].tolist() == [0, 1, 2, 3, 4, 4]


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_dry_images_have_no_plane(scenario: Scenario) -> None:
    dry = [False, True, True, True, False, True]
    planes, in_world, names = share_planes(scenario, FRAME, CAMERA, ["tank", "tank", None, None, None, None], dry)
    assert (planes < 0).tolist() == dry
    assert len(in_world) == len(names) == 2
    # An image left alone with its plane carries it along.
    assert in_world.tolist() == [scenario == "static_interface"] * 2
    planes, in_world, names = share_planes(scenario, FRAME, CAMERA, NOBODY, [True] * 6)
    assert (planes == -1).all() and len(in_world) == len(names) == 0


@given(
    scenario=st.sampled_from(SCENARIOS),
    images=st.lists(
        st.tuples(st.integers(0, 4), st.integers(0, 2), st.sampled_from([None, "a", "b"]), st.booleans()), max_size=12
    ),
)
def test_plane_blocks_are_contiguous(scenario: Scenario, images: list[tuple[int, int, str | None, bool]]) -> None:
    frame, camera, group, dry = (list(column) for column in zip(*images, strict=True)) if images else ([],) * 4
    planes, in_world, names = share_planes(scenario, frame, camera, group, dry)
    assert set(planes.tolist()) - {-1} == set(range(len(in_world))) and len(names) == len(in_world)
    for i, (_, _, name, is_dry) in enumerate(images):
        assert (planes[i] < 0) == is_dry
        if not is_dry:
            assert names[planes[i]] == name


# Rotation vectors: no rotation, below and above where series take over, ordinary, nearly half a turn.
ANGLES = [0.0, 1e-300, 1e-9, 0.99e-4, 1.01e-4, 1e-3, 1.0, 3.0, 3.14159]


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_map(angle: float) -> None:
    vector = angle * unit(np.random.default_rng(3).normal(size=(20, 3)))
    rotation, jacobian = exp_and_left_jacobian(vector)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)
    for j, axis in enumerate(np.eye(3)):
        ahead, behind = (exp_and_left_jacobian(vector + s * STEP * axis)[0] for s in (1, -1))
        skew = (ahead - behind) / (2 * STEP) @ rotation.transpose(0, 2, 1)
        turn = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        np.testing.assert_allclose(jacobian[:, :, j], turn, atol=1e-9)


def test_exponential_map_of_any_shape() -> None:
    vector = np.random.default_rng(4).normal(size=(2, 3, 3))
    rotation, jacobian = exp_and_left_jacobian(vector)
    assert rotation.shape == jacobian.shape == (2, 3, 3, 3)
    np.testing.assert_array_equal(exp_and_left_jacobian(vector[1, 2])[0], rotation[1, 2])
    assert exp_and_left_jacobian(np.zeros((0, 3)))[0].shape == (0, 3, 3)
    other = np.random.default_rng(5).normal(size=(2, 3, 3))
    product = np.einsum("...ij,...j->...i", cross_matrix(vector), other)
    np.testing.assert_allclose(product, np.cross(vector, other), atol=1e-15)


def test_mean_rotation() -> None:
    rng = np.random.default_rng(6)
    center = exp_and_left_jacobian(np.array([1.0, -2.0, 0.5]))[0]
    np.testing.assert_allclose(mean_rotation(center[None]), center, atol=1e-15)
    # Turns to either side cancel.
    turn = 0.3 * rng.normal(size=(10, 3))
    both = exp_and_left_jacobian(np.concatenate([turn, -turn]))[0] @ center
    np.testing.assert_allclose(mean_rotation(both), center, atol=1e-14)
    # Far apart, the sum of rotations can be nearer to a reflection than to a rotation.
    far = exp_and_left_jacobian(np.pi * unit(np.eye(3)))[0]
    mean = mean_rotation(far)
    assert np.linalg.det(mean) == pytest.approx(1.0)
    # Nearest to their sum: no rotation in its neighbourhood has a larger inner product with it.
    some = exp_and_left_jacobian(rng.normal(size=(5, 3)))[0]
    best = mean_rotation(some)
    nearby = exp_and_left_jacobian(0.1 * rng.normal(size=(200, 3)))[0] @ best
    assert (np.einsum("nij,ij->n", nearby, some.sum(axis=0)) < np.sum(best * some.sum(axis=0))).all()


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_tangent_basis(vector: tuple[float, float, float]) -> None:
    normal = unit(vector)
    basis = tangent_basis(normal)
    np.testing.assert_allclose(basis.T @ basis, np.eye(2), atol=1e-14)
    np.testing.assert_allclose(np.cross(basis[:, 0], basis[:, 1]), normal, atol=1e-14)
    # Smooth where normals are: near the optical axis.
    if normal[2] > 0.8:
        assert np.abs(tangent_basis(unit(normal + 1e-7)) - basis).max() < 1e-6
