"""Refractive adjustments made up at random, and in plain numpy what the compiled kernel says of them.

A residual is told in a few lines: points through `State` and `project_direction`, which have tests of their own,
times the metric. With waves, the plane is the one that touches the surface where the keypoint's ray meets it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pyceres

from colmap_refract.estimator.chunk import Chunk, Held, Problem
from colmap_refract.estimator.elimination import LENS, MEDIUM, PLANE, POSE, WAVES, Anchors, Tracks
from colmap_refract.estimator.optics import project_direction
from colmap_refract.estimator.rotation import exp_and_left_jacobian
from colmap_refract.estimator.scenario import Change, State, Structure, apply, share_planes
from colmap_refract.interface import Array, Layers, tangent_basis
from colmap_refract.options import Loss, Scenario

FOCAL_LENGTH = 1200.0
WATER = Layers()
TANK = Layers(thickness=(0.02, 0.1), index=(1.49, 1.0, 1.333))
# A camera under water that looks out through a porthole: the last medium has the lowest index.
PORTHOLE = Layers(thickness=(0.02,), index=(1.52 / 1.333, 1 / 1.333))

STEP = 1e-5
TOLERANCE = 1e-6
"""Of derivatives, relative to the norms of the columns involved: central differences of this step are good to
about 1e-8 of them. A sign flip is 2, a missing term 1e-3 or more."""

Key = tuple[int, int]


def unit(vector: Any) -> Array:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector, axis=-1, keepdims=True)


def make_problem(
    scenario: Scenario = "moving_interface",
    *,
    sensors: int = 1,
    groups: bool = False,
    dry_image: bool = False,
    odd_points: bool = False,
    layers: Layers = WATER,
    index: bool = False,
    lens: int = 0,
    loss: Loss = "trivial",
    noise: float = 1.0,
    num_points: int = 12,
    seed: int = 0,
) -> Problem:
    """Frames of `sensors` images that look down on points at 2 to 3, through an interface at about 1.

    Args:
        sensors: images to a frame; rigs need not have their reference sensor among them.
        groups: the middle frames share an interface.
        dry_image: the last image has no interface.
        odd_points: also points next to the plane on either side marked wet, and one behind the cameras.
        index, lens: the refractive index is free, and so many intrinsics of each camera.
        noise: of the keypoints, px.
    """
    rng = np.random.default_rng(seed)
    frames = 4
    frame = np.repeat(np.arange(frames), sensors)
    images = len(frame)
    camera = np.tile(np.arange(sensors), frames)
    dry = [dry_image and i == images - 1 for i in range(images)]
    group = ["tank" if groups and 1 <= f <= 2 else None for f in frame]
    plane, in_world, _ = share_planes(scenario, frame.tolist(), camera.tolist(), group, dry)
    planes = len(in_world)
    anchor = rng.normal(size=(planes, 3))
    normal = unit(np.column_stack([0.1 * rng.normal(size=(planes, 2)), np.ones(planes)]))
    structure = Structure(
        image_pose=np.zeros(images, np.int64) if scenario == "fixed_camera" else frame,
        image_plane=plane,
        image_camera=camera,
        sensor_rotation=exp_and_left_jacobian(0.1 * rng.normal(size=(sensors, 3)))[0][camera],
        sensor_translation=0.2 * rng.normal(size=(sensors, 3))[camera] if sensors > 1 else np.zeros((images, 3)),
        plane_in_world=in_world,
        plane_anchor=anchor,
    )
    poses = structure.num_poses
    rotation = exp_and_left_jacobian(0.1 * rng.normal(size=(poses, 3)))[0]
    centers = np.column_stack([rng.uniform(-0.5, 0.5, (poses, 2)), 0.1 * rng.normal(size=poses)])
    state = State(
        rotation=rotation,
        translation=-np.einsum("nij,nj->ni", rotation, centers),
        normal=normal,
        distance=rng.uniform(0.9, 1.1, planes) - in_world * np.einsum("bi,bi->b", normal, anchor),
        index=layers.refractive_index,
        lens=0.1 * rng.normal(size=(sensors, lens)),
    )
    points = rng.uniform([-0.6, -0.6, 2], [0.6, 0.6, 3], (num_points, 3))
    seen = rng.random((num_points, images)) < 0.8
    seen[:, :2] = True
    point, image = np.nonzero(seen)
    wet = ~np.array(dry)[image]
    if scenario != "fixed_camera":  # which sees a dry point without any parallax
        points[:2, 2] = 0.5
        wet &= point >= 2
    if odd_points:
        points[2:4, 2] = 1.3  # a little behind all planes, or a little before: marked wet all the same
        points[4:6, 2] = 0.9
        points[6, 2] = -2.0
    tracks = Tracks(
        start=np.concatenate([[0], np.cumsum(seen.sum(axis=1))]),
        image=image.astype(np.int32),
        direction=np.zeros((len(image), 3)),
        metric=np.zeros((len(image), 2, 3)),
        lens=FOCAL_LENGTH * rng.normal(size=(len(image), 2, lens)),
        wet=wet,
    )
    problem = Problem(
        tracks=tracks,
        structure=structure,
        layers=layers,
        state=state,
        points=points,
        held=replace(Held.nothing(state), index=not index, lens=lens == 0),
        loss=loss,
        loss_scale=4 * noise,
    )
    direction = predict(problem, state, points)
    direction = unit(direction + noise / FOCAL_LENGTH * rng.normal(size=direction.shape))
    metric = FOCAL_LENGTH * np.array([tangent_basis(d).T for d in direction])
    lens_at_start = np.einsum("nij,nj->ni", tracks.lens, state.lens[structure.image_camera[image]])
    # The keypoints were lifted with the intrinsics as they are: cancel what the change of them does.
    shift = np.einsum("nij,ni->nj", metric, lens_at_start) / FOCAL_LENGTH**2
    return replace(problem, tracks=tracks._replace(direction=direction + shift, metric=metric))


def local_planes(problem: Problem, state: State) -> tuple[Array, Array]:
    """Normals (N, 3) and distances (N,) of the planes that the keypoints are refracted by, in the camera's frame."""
    tracks, structure = problem.tracks, problem.structure
    normal, distance = (part[tracks.image] for part in state.planes_in_cam(structure))
    if not tracks.waves.shape[2]:
        return normal, distance
    height, *slopes = np.einsum("nak,nk->an", tracks.waves, state.waves[tracks.image])
    share = distance * (1 + height) / np.sum(tracks.sight * normal, axis=1)
    surface_point = share[:, None] * tracks.sight
    first, second = np.moveaxis(structure.wave_axes[tracks.image], 2, 0)
    local = unit(normal + slopes[0][:, None] * first + slopes[1][:, None] * second)
    return local, np.sum(local * surface_point, axis=1)


def predict(problem: Problem, state: State, points: Array) -> Array:
    tracks, structure = problem.tracks, problem.structure
    rotation, translation = state.cam_from_world(structure)
    normal, distance = local_planes(problem, state)
    of = np.repeat(points, np.diff(tracks.start), axis=0)
    image = tracks.image
    in_cam = np.einsum("nij,nj->ni", rotation[image], of) + translation[image]
    layers = problem.layers.with_index(state.index)
    return project_direction(in_cam, normal, distance, layers, tracks.wet)


def residuals(problem: Problem, change: Change, points: Array) -> Array:
    """(N, 2), px."""
    state, tracks = apply(problem.state, change), problem.tracks
    camera = problem.structure.image_camera[tracks.image]
    error = np.einsum("nij,nj->ni", tracks.metric, predict(problem, state, points) - tracks.direction)
    error += np.einsum("nij,nj->ni", tracks.lens, state.lens[camera])
    if tracks.effects.shape[2]:
        error += tracks.offset + np.einsum("nij,nj->ni", tracks.effects, state.waves[tracks.image])
    return np.asarray(error)


def change_of(problem: Problem, keys: list[Key], parameters: list[Array]) -> Change:
    change, index = Change.zero(problem.state), 0.0
    for (slot, block), value in zip(keys, parameters, strict=True):
        if slot == POSE:
            change.pose[block] = value
        elif slot == PLANE:
            change.plane[block] = value
        elif slot == LENS:
            change.lens[block] = value
        elif slot == WAVES:
            change.waves[block] = value
        else:
            index = float(value[0])
    return replace(change, index=index)


def steps(parameters: list[Array]) -> Iterator[tuple[list[Array], list[Array]]]:
    """The parameters with one entry increased and decreased by STEP, for each entry."""
    for k, block in enumerate(parameters):
        for j in range(len(block)):
            both = []
            for sign in (1, -1):
                moved = [value.copy() for value in parameters]
                moved[k][j] += sign * STEP
                both.append(moved)
            yield both[0], both[1]


def jacobians(problem: Problem, keys: list[Key], parameters: list[Array], points: Array) -> tuple[Array, Array]:
    """Dense derivatives of all residuals by the camera side (2N, n) and by the points (2N, 3P)."""

    def at(values: list[Array]) -> Array:
        return residuals(problem, change_of(problem, keys, values), points).ravel()

    by_cameras = np.stack([(at(ahead) - at(behind)) / (2 * STEP) for ahead, behind in steps(parameters)], axis=1)
    change = change_of(problem, keys, parameters)
    point = np.repeat(np.arange(len(points)), np.diff(problem.tracks.start))
    by_points = np.zeros((len(point), 2, len(points), 3))
    for j, axis in enumerate(np.eye(3)):
        # Every point at once: an observation depends on its own only.
        ahead, behind = (residuals(problem, change, points + sign * STEP * axis) for sign in (1, -1))
        by_points[np.arange(len(point)), :, point, j] = (ahead - behind) / (2 * STEP)
    return by_cameras, by_points.reshape(2 * len(point), -1)


def some_parameters(chunk: Chunk, size: float, seed: int = 3) -> list[Array]:
    """A change of everything that is free: radians, units, hundredths of an index."""
    rng = np.random.default_rng(seed)
    return [size * (0.2 if slot == MEDIUM else 1.0) * rng.normal(size=width)
            for (slot, _), width in zip(chunk.keys, chunk.widths, strict=True)]  # fmt: skip


def whole(problem: Problem, num_slices: int = 1) -> Chunk:
    return Chunk(problem, np.arange(len(problem.points)), num_slices)


def settled(chunk: Chunk, parameters: list[Array]) -> tuple[Array, float]:
    result = chunk.settle(parameters, None)
    assert result is not None
    return result


def reduced(chunk: Chunk, parameters: list[Array]) -> tuple[float, Array, Array]:
    result = chunk.reduce(parameters, None)
    assert result is not None
    return result


def assert_same_system(
    gradient: Array, matrix: Array, expected_gradient: Array, expected_matrix: Array, norms: Array, size: float
) -> None:
    """`norms`: of the Jacobian's columns; `size`: norm of the residuals."""
    assert (norms > 0).all()
    np.testing.assert_allclose(gradient / norms, expected_gradient / norms, atol=TOLERANCE * size)
    scale = np.outer(norms, norms)
    np.testing.assert_allclose(np.triu(matrix / scale), np.triu(expected_matrix / scale), atol=TOLERANCE)


LOSSES: list[Loss] = ["trivial", "huber", "soft_l1", "cauchy"]


def ceres_loss(loss: Loss, scale: float) -> Callable[[float], Array]:
    kinds = {"huber": pyceres.HuberLoss, "soft_l1": pyceres.SoftLOneLoss, "cauchy": pyceres.CauchyLoss}
    instance = pyceres.TrivialLoss() if loss == "trivial" else kinds[loss](scale)
    return lambda s: np.asarray(instance.evaluate(s))


def robust_weights(problem: Problem, r: Array) -> Array:
    """(2N,) square roots of the weights of the residuals (N, 2)."""
    loss = ceres_loss(problem.loss, problem.loss_scale)
    return np.sqrt(np.repeat([loss(s)[1] for s in np.sum(r**2, axis=1)], 2))


def schur_complement(
    problem: Problem, keys: list[Key], parameters: list[Array], points: Array, anchors: Anchors
) -> tuple[Array, Array, Array]:
    """Dense `(gradient, matrix, column norms)` of the camera side after eliminating the points."""
    r = residuals(problem, change_of(problem, keys, parameters), points)
    root = robust_weights(problem, r)
    by_cameras, by_points = (root[:, None] * j for j in jacobians(problem, keys, parameters, points))
    error = root * r.ravel()
    anchor = np.repeat(anchors.weight, 3)
    point_matrix = by_points.T @ by_points + np.diag(anchor)
    point_gradient = by_points.T @ error + anchor * (points - anchors.position).ravel()
    coupling = by_cameras.T @ by_points
    eliminated = coupling @ np.linalg.inv(point_matrix)
    gradient = by_cameras.T @ error - eliminated @ point_gradient
    matrix = by_cameras.T @ by_cameras - eliminated @ coupling.T
    return gradient, matrix, np.linalg.norm(by_cameras, axis=0)


def strip(loss: Loss = "trivial", scenario: Scenario = "static_interface") -> Problem:
    """A flight line of 16 images, with about 5 of them to a point: what is cut into several chunks."""
    problem = make_problem(scenario, num_points=2)
    rng = np.random.default_rng(7)
    images = 16
    along = 0.4 * np.arange(images)
    centers = np.column_stack([along, 0.1 * rng.normal(size=(images, 2))])
    points = rng.uniform([0, -0.6, 2], [along[-1], 0.6, 3], (900, 3))
    seen = np.abs(points[:, None, 0] - along) < 1.0
    point, image = np.nonzero(seen)
    static = scenario == "static_interface"
    planes = 1 if static else images
    structure = Structure(
        image_pose=np.arange(images),
        image_plane=np.zeros(images, np.int64) if static else np.arange(images),
        image_camera=np.zeros(images, np.int64),
        sensor_rotation=np.array([np.eye(3)] * images),
        sensor_translation=np.zeros((images, 3)),
        plane_in_world=np.full(planes, static),
        plane_anchor=np.zeros((planes, 3)),
    )
    rotation = exp_and_left_jacobian(0.05 * rng.normal(size=(images, 3)))[0]
    state = State(
        rotation=rotation,
        translation=-np.einsum("nij,nj->ni", rotation, centers),
        normal=unit(np.column_stack([0.05 * rng.normal(size=(planes, 2)), np.ones(planes)])),
        distance=np.full(planes, 1.0),
        index=1.333,
        lens=np.zeros((1, 0)),
    )
    tracks = Tracks(
        start=np.concatenate([[0], np.cumsum(seen.sum(axis=1))]),
        image=image.astype(np.int32),
        direction=np.zeros((len(image), 3)),
        metric=np.zeros((len(image), 2, 3)),
        lens=np.zeros((len(image), 2, 0)),
        wet=np.ones(len(image), bool),
    )
    problem = replace(
        problem, tracks=tracks, structure=structure, state=state, points=points, held=Held.nothing(state),
        loss=loss, loss_scale=2.0,
    )  # fmt: skip
    direction = unit(predict(problem, state, points) + 0.5 / FOCAL_LENGTH * rng.normal(size=(len(image), 3)))
    metric = FOCAL_LENGTH * np.array([tangent_basis(d).T for d in direction])
    bent = replace(state, translation=state.translation + 0.01 * rng.normal(size=(images, 3)))
    return replace(
        problem,
        tracks=tracks._replace(direction=direction, metric=metric),
        state=bent,
        points=points + 0.01 * rng.normal(size=points.shape),
    )
