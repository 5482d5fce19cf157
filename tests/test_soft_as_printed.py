"""`E_soft` as printed, against the paper's formulas written out in plain numpy and against SciPy's solver.

The reference below refracts by angles, loops over observations, and sums the regulariser as the paper prints it. It
shares `State` and `Structure` with the code, which have tests of their own.

What this does not show: that the minimum is near the truth where the surface waves. That is for experiments.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from conftest import error_of
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from colmap_refract.estimator.adjustment import Progress, SolverSettings
from colmap_refract.estimator.chunk import Held, Problem
from colmap_refract.estimator.neighbours import neighbour_weights
from colmap_refract.estimator.optics import project_direction
from colmap_refract.estimator.printed_terms import DistanceToRay, ImageViews, pixel_weights
from colmap_refract.estimator.printed_unknowns import Blocks, Pairing, pair
from colmap_refract.estimator.scenario import SCENARIOS, Change, State, apply
from colmap_refract.estimator.soft_as_printed import PrintedAdjustment, adjust_as_printed
from colmap_refract.interface import Array, Layers, plane_in_world
from colmap_refract.options import ImageNotes, RefinerOptions, Scenario
from colmap_refract.refiner.arrangement import arrange
from colmap_refract.refiner.observations import read_observations
from colmap_refract.simulation import SceneOptions, simulate

REFERENCE = 2
FINE = SolverSettings(max_num_iterations=100, function_tolerance=1e-14, parameter_tolerance=1e-13)


@cache
def at_the_truth(
    scenario: Scenario, noise: float = 0.0, num_images: int = 6, num_points: int = 40, sensors: int = 1
) -> tuple[Problem, Array]:
    """A capture at its true poses, planes and points, in units of the solve; keypoints (N, 2) with noise in px."""
    options = SceneOptions(
        scenario=scenario, num_images=num_images, num_points=num_points, pixel_noise=noise, sensors_per_frame=sensors
    )
    capture = simulate(options)
    read = read_observations(capture.reconstruction)
    arrangement = arrange(read, RefinerOptions(scenario=scenario), ImageNotes())
    observations, structure = arrangement.observations, arrangement.structure
    problem = arrangement.start(0.4, observations)
    rotation, translation = problem.state.cam_from_world(structure)
    normal, distance = problem.state.normal.copy(), problem.state.distance.copy()
    for i, image_id in enumerate(observations.image_ids.tolist()):
        block, plane = structure.image_plane[i], capture.planes[image_id]
        plane = plane[0], plane[1] / arrangement.unit
        if structure.plane_in_world[block]:
            n, offset = plane_in_world(*plane, rotation[i], translation[i])
            plane = n, offset - n @ structure.plane_anchor[block]
        normal[block], distance[block] = plane
    state = replace(problem.state, normal=normal, distance=distance)
    # A fixed camera's points are put elsewhere by `arrange`.
    points = (read.points - arrangement.origin) / arrangement.unit
    return replace(problem, state=state, points=points, held=Held.nothing(state)), observations.pixel


def moved(problem: Problem, size: float, seed: int = 0) -> Problem:
    """The problem from a start off by `size`: all but the reference's pose and its plane's distance."""
    rng = np.random.default_rng(seed)
    structure, zero = problem.structure, Change.zero(problem.state)
    change = replace(zero, pose=size * rng.normal(size=zero.pose.shape), plane=size * rng.normal(size=zero.plane.shape))
    change.pose[structure.image_pose[REFERENCE]] = 0.0
    change.plane[structure.image_plane[REFERENCE], 2] = 0.0
    state = apply(problem.state, change)
    # A turn about a world plane's anchor changes how far that plane is from the reference.
    shift = problem.state.planes_in_cam(structure)[1] - state.planes_in_cam(structure)[1]
    distance = state.distance.copy()
    distance[structure.image_plane[REFERENCE]] += shift[REFERENCE]
    points = problem.points + size * rng.normal(size=problem.points.shape)
    return replace(problem, state=replace(state, distance=distance), points=points)


def refracted(u: Array, normal: Array, index: float) -> Array:
    """Snell's law by angles, (n, 3)."""
    across = u - (u * normal).sum(axis=1, keepdims=True) * normal
    sine = np.linalg.norm(across, axis=1, keepdims=True)
    behind = np.arcsin(sine / index)
    return np.asarray(np.cos(behind) * normal + np.sin(behind) * across / sine)


def back_projected(u: Array, depth: Array, plane: tuple[Array, Array], normal: Array, index: float) -> Array:
    """`BP(p, d_j, n, d, n_ij, mu)`, (n, 3)."""
    reach = plane[1] / (u * plane[0]).sum(axis=1)
    return np.asarray(reach[:, None] * u + depth[:, None] * refracted(u, normal, index))


def points_in_reference(problem: Problem, state: State, pairing: Pairing, normals: Array, depths: Array) -> Array:
    """`P_j` (p, 3)."""
    normal, distance = state.planes_in_cam(problem.structure)
    k, u = pairing.of_reference, problem.tracks.direction
    image = problem.tracks.image[k]
    return back_projected(u[k], depths, (normal[image], distance[image]), normals[k], state.index)


def depths_of(problem: Problem, state: State, pairing: Pairing, normals: Array, points: Array) -> Array:
    """The `d_j` (p,) at which the reference's rays come nearest to points (p, 3) of the world."""
    rotation, translation = state.cam_from_world(problem.structure)
    origin, one = (
        points_in_reference(problem, state, pairing, normals, np.full(len(points), depth)) for depth in (0.0, 1.0)
    )
    in_cam = points @ rotation[REFERENCE].T + translation[REFERENCE]
    return np.asarray(((one - origin) * (in_cam - origin)).sum(axis=1))


def distances(problem: Problem, state: State, pairing: Pairing, normals: Array, depths: Array) -> Array:
    """All `D_ij` (m, 3) in the reference camera's frame."""
    rotation, translation = state.cam_from_world(problem.structure)
    normal, distance = state.planes_in_cam(problem.structure)
    k, u, r = pairing.others, problem.tracks.direction, REFERENCE
    i = problem.tracks.image[k]
    ends = []
    for length in (0.0, 1.0):
        x = back_projected(u[k], np.full(len(k), length), (normal[i], distance[i]), normals[k], state.index)
        in_world = np.einsum("nji,nj->ni", rotation[i], x - translation[i])
        ends.append(in_world @ rotation[r].T + translation[r])
    origin, ray = ends[0], ends[1] - ends[0]
    point = points_in_reference(problem, state, pairing, normals, depths)[pairing.point_of]
    t = (point[:, 2] - origin[:, 2]) / ray[:, 2]
    return np.asarray(point - origin - t[:, None] * ray)


def regulariser(normals: Array, image: Array, keypoints: Array, radius: float) -> Array:
    """All `n_k - mean(N_ij)` of the double sum as printed, (number of terms, 3)."""
    terms = []
    for i in np.unique(image):
        mine = np.flatnonzero(image == i)
        for k in mine:
            near = mine[np.linalg.norm(keypoints[mine] - keypoints[k], axis=1) <= radius]
            terms.append(normals[near] - normals[near].mean(axis=0))
    return np.concatenate(terms)


def by_point(problem: Problem) -> Array:
    return np.repeat(np.arange(len(problem.points)), np.diff(problem.tracks.start))


def soft(problem: Problem, keypoints: Array, **options: Any) -> PrintedAdjustment:
    passed = {"reference": REFERENCE, "smoothness": 1.0, "radius": 300.0, "settings": FINE, **options}
    return adjust_as_printed(problem, keypoints, **passed)


@pytest.mark.parametrize(
    ("scenario", "sensors"),
    [*((scenario, 1) for scenario in SCENARIOS), ("static_interface", 2), ("camera_housing", 2)],
)
def test_distances_are_the_papers_and_derivatives_theirs(scenario: Scenario, sensors: int) -> None:
    problem, _ = at_the_truth(scenario, num_points=30, sensors=sensors)
    structure, rng = problem.structure, np.random.default_rng(3)
    pairing = pair(problem, REFERENCE)
    own_pose = int(structure.image_pose[REFERENCE])
    surface = problem.state.planes_in_cam(structure)[0][problem.tracks.image] + 0.03 * rng.normal(
        size=(len(by_point(problem)), 3)
    )
    surface /= np.linalg.norm(surface, axis=1, keepdims=True)
    change = Change.zero(problem.state)
    blocks = Blocks(
        depth=[np.array([d]) for d in rng.uniform(0.4, 0.8, len(pairing.point))],
        normal=dict(enumerate(surface)),
        pose={p: 0.02 * rng.normal(size=6) for p in range(structure.num_poses) if p != own_pose},
        plane={b: 0.02 * rng.normal(size=3) * problem.state.distance[b] for b in range(structure.num_planes)},
    )
    for block, value in blocks.pose.items():
        change.pose[block] = value
    for block, value in blocks.plane.items():
        change.plane[block] = value
    state = apply(problem.state, change)
    views = {i: ImageViews(structure, problem.state, i, REFERENCE) for i in range(structure.num_images)}
    weight = rng.normal(size=(2, 2))
    step = 1e-6
    shared = 0
    every = distances(problem, state, pairing, surface, np.ravel(blocks.depth))
    rows = np.arange(0, len(pairing.others), 7)
    assert len(np.unique(problem.tracks.image[pairing.others[rows]])) == structure.num_images - 1
    for row in rows.tolist():
        error: list[BaseException] = []
        cost = DistanceToRay(problem, pairing, row, blocks, views, weight, error)
        expected = every[row]
        assert abs(expected[2]) < 1e-12
        assert np.abs(expected).max() > 1e-4  # so that there is something to weigh

        def value(parameters: list[Array], cost: DistanceToRay = cost, error: list[BaseException] = error) -> Array:
            residual = np.full(2, np.nan)
            assert cost.Evaluate(parameters, residual, None), error
            return residual

        np.testing.assert_allclose(value(cost.blocks), weight @ expected[:2], atol=1e-12)
        jacobians = [np.full(2 * len(block), np.nan) for block in cost.blocks]
        residual = np.full(2, np.nan)
        assert cost.Evaluate(cost.blocks, residual, jacobians)
        np.testing.assert_allclose(residual, weight @ expected[:2], atol=1e-12)
        shared += len(cost.blocks) < 6
        for b, jacobian in enumerate(jacobians):
            numeric = np.empty((2, len(cost.blocks[b])))
            for j in range(len(cost.blocks[b])):
                both = [[block.copy() for block in cost.blocks] for _ in range(2)]
                both[0][b][j] += step
                both[1][b][j] -= step
                numeric[:, j] = (value(both[0]) - value(both[1])) / (2 * step)
            # Central differences of this step are good to about 1e-9 of values near 1; a sign flip is 2.
            np.testing.assert_allclose(jacobian.reshape(2, -1), numeric, atol=1e-7 * max(1.0, np.abs(numeric).max()))
    assert (shared > 0) == (scenario != "moving_interface")


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_plane_surface_without_noise_is_found_exactly(scenario: Scenario) -> None:
    truth, keypoints = at_the_truth(scenario)
    start = moved(truth, 0.003 if scenario == "camera_housing" else 0.01)
    result = soft(start, keypoints)
    assert result.termination == "convergence"
    used = np.isfinite(result.points[:, 0])
    assert used.sum() > 30
    off = np.abs(start.points[used] - truth.points[used]).max()
    # The keypoints are exact to 1e-9 px or so; a thousandth of the start's error would be a wrong minimum.
    assert np.abs(result.points - truth.points)[used].max() < 1e-4 * off
    normals = truth.state.planes_in_cam(truth.structure)[0][truth.tracks.image]
    takes_part = np.isfinite(result.normals[:, 0])
    assert takes_part.sum() > 3 * used.sum()
    assert np.abs(result.normals - normals)[takes_part].max() < 1e-5
    assert result.cost < 1e-12


def test_weights_of_pairs_are_the_double_sum() -> None:
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(0, 100, (60, 2))
    keypoints[1] = keypoints[0]
    keypoints[2] = keypoints[0] + [12.0, 0.0]  # at the very radius
    keypoints[3] = [1000.0, 1000.0]  # alone
    normals = rng.normal(size=(60, 3))
    weights = neighbour_weights(keypoints, 12.0).tocoo()
    assert (weights.row < weights.col).all() and 60 < weights.nnz < 60 * 59 / 2
    assert 3 not in weights.row and 3 not in weights.col
    value = (weights.data * ((normals[weights.row] - normals[weights.col]) ** 2).sum(axis=1)).sum()
    direct = (regulariser(normals, np.zeros(60), keypoints, 12.0) ** 2).sum()
    assert value == pytest.approx(direct, rel=1e-12)
    assert neighbour_weights(np.zeros((0, 2)), 1.0).shape == (0, 0)
    for radius in (0.0, -1.0, np.nan, np.inf):
        assert "radius" in error_of(lambda radius=radius: neighbour_weights(keypoints, radius))


@pytest.mark.parametrize("residual", ["scene", "pixels"])
def test_costs_are_what_is_printed(residual: Any) -> None:
    problem, keypoints = at_the_truth("moving_interface", noise=1.0)
    seen: list[Progress] = []
    smoothness = {"scene": 1e-3, "pixels": 1e4}[residual]
    result = soft(
        problem, keypoints, residual=residual, smoothness=smoothness, radius=150.0, on_progress=seen.append,
        settings=SolverSettings(max_num_iterations=8),
    )  # fmt: skip
    k = np.flatnonzero(np.isfinite(result.normals[:, 0]))
    terms = regulariser(result.normals[k], problem.tracks.image[k], keypoints[k], 150.0)
    assert result.smoothness_cost == pytest.approx(0.5 * smoothness * (terms**2).sum(), rel=1e-9)
    assert result.smoothness_cost > 0.01 * result.cost
    assert result.cost == pytest.approx(min(p.cost for p in seen), rel=1e-9)
    assert result.cost == result.data_cost + result.smoothness_cost
    assert len(seen) == result.num_iterations == 9 and seen[-1].cost < seen[0].cost
    np.testing.assert_allclose(np.linalg.norm(result.normals[k], axis=1), 1.0, rtol=1e-12)


def test_pixels_are_reprojection_errors_to_first_order() -> None:
    problem, keypoints = at_the_truth("moving_interface", noise=0.3)
    # Nothing to solve for: one step of no length tells the start's cost.
    seen: list[Progress] = []
    stay = SolverSettings(max_num_iterations=0)
    soft(problem, keypoints, residual="pixels", settings=stay, on_progress=seen.append)
    pairing, structure, r = pair(problem, REFERENCE), problem.structure, REFERENCE
    image = problem.tracks.image[pairing.others]
    rotation, translation = problem.state.cam_from_world(structure)
    normal, plane_distance = problem.state.planes_in_cam(structure)
    surface = normal[problem.tracks.image]
    # Points on the reference's rays, as near to the truth as those come.
    depths = depths_of(problem, problem.state, pairing, surface, problem.points[pairing.point])
    points = points_in_reference(problem, problem.state, pairing, surface, depths)
    world = (points - translation[r]) @ rotation[r]
    in_cam = np.einsum("nij,nj->ni", rotation[image], world[pairing.point_of]) + translation[image]
    seen_at = project_direction(in_cam, normal[image], plane_distance[image], problem.layers)
    metric = problem.tracks.metric[pairing.others]
    errors = np.einsum("nij,nj->ni", metric, seen_at - problem.tracks.direction[pairing.others])
    weight = pixel_weights(problem, pairing, points)
    assert len(weight) > 100
    d = distances(problem, problem.state, pairing, surface, depths)
    # Second order in errors of a px over a focal length of 1200 px.
    np.testing.assert_allclose(np.einsum("nij,nj->ni", weight, d[:, :2]), errors, atol=5e-3 * np.abs(errors).max())
    assert seen[0].cost == pytest.approx(0.5 * (errors**2).sum(), rel=1e-2)


def test_the_minimum_is_that_of_another_solver() -> None:
    problem, keypoints = at_the_truth("moving_interface", noise=0.3, num_images=5, num_points=20)
    smoothness, radius = 0.03, 500.0
    settings = replace(FINE, max_num_iterations=300)
    result = soft(problem, keypoints, smoothness=smoothness, radius=radius, settings=settings)
    assert result.termination == "convergence"
    pairing = pair(problem, REFERENCE)
    taking_part = np.sort(np.concatenate([pairing.of_reference, pairing.others]))
    structure, state = problem.structure, problem.state
    own = structure.image_pose[REFERENCE]
    others = [i for i in range(structure.num_poses) if i != own]
    tracks = problem.tracks
    num_pairs, n, m = len(pairing.others), len(taking_part), structure.num_planes

    # The terms are linear in the normals: those of unit vectors are the matrix.
    terms = regulariser(np.eye(n), tracks.image[taking_part], keypoints[taking_part], radius)

    def unpack(x: Array) -> tuple[State, Array, Array]:
        depths, slopes, planes, distances, poses = np.split(x, np.cumsum([len(pairing.point), 2 * n, 2 * m, m - 1]))
        normals = np.full((len(tracks.image), 3), np.nan)
        normals[taking_part] = np.column_stack([slopes.reshape(-1, 2), np.ones(n)])
        plane_normals = np.column_stack([planes.reshape(-1, 2), np.ones(m)])
        rotation, translation = state.rotation.copy(), state.translation.copy()
        plane_distance = state.distance.copy()
        plane_distance[[b for b in range(m) if b != structure.image_plane[REFERENCE]]] = distances
        for i, pose in zip(others, poses.reshape(-1, 6), strict=True):
            rotation[i] = Rotation.from_rotvec(pose[:3]).as_matrix() @ state.rotation[i]
            translation[i] = pose[3:]
        unit = plane_normals / np.linalg.norm(plane_normals, axis=1, keepdims=True)
        new = replace(state, rotation=rotation, translation=translation, normal=unit, distance=plane_distance)
        return new, normals / np.linalg.norm(normals, axis=1, keepdims=True), depths

    def residuals(x: Array) -> Array:
        new, normals, depths = unpack(x)
        data = distances(problem, new, pairing, normals, depths)[:, :2]
        return np.concatenate([data.ravel(), np.sqrt(smoothness) * (terms @ normals[taking_part]).ravel()])

    solved, normals = result.state, result.normals
    surface = normals[taking_part]
    turn = [Rotation.from_matrix(solved.rotation[i] @ state.rotation[i].T).as_rotvec() for i in others]
    x = np.concatenate([
        depths_of(problem, solved, pairing, normals, result.points[pairing.point]),
        (surface[:, :2] / surface[:, 2:]).ravel(),
        (solved.normal[:, :2] / solved.normal[:, 2:]).ravel(),
        np.delete(solved.distance, structure.image_plane[REFERENCE]),
        *(np.concatenate([w, solved.translation[i]]) for w, i in zip(turn, others, strict=True)),
    ])  # fmt: skip
    at = residuals(x)
    # Its own cost, in other words and by other formulas.
    assert 0.5 * at @ at == pytest.approx(result.cost, rel=1e-7)
    assert 0.5 * (at[: 2 * num_pairs] ** 2).sum() == pytest.approx(result.data_cost, rel=1e-7)
    with threadpool_limits(1):
        # What one more Gauss-Newton step would gain, by SciPy's own differences.
        jacobian = least_squares(residuals, x, jac="3-point", max_nfev=1).jac
        step = np.linalg.lstsq(jacobian, -at, rcond=None)[0]
        assert at @ at - ((at + jacobian @ step) ** 2).sum() < 1e-6 * (at @ at)
        # From the solution, pushed off: another minimum nearby would be found, and a lower one be seen.
        pushed = x + 5e-4 * np.random.default_rng(1).normal(size=len(x))
        assert residuals(pushed) @ residuals(pushed) > 5 * (at @ at)
        again = least_squares(residuals, pushed, x_scale="jac", max_nfev=8)
    # It converges slowly along weak directions: from ten times the cost it comes back to within 3e-4.
    assert result.cost * (1 - 1e-7) < again.cost < result.cost * (1 + 1e-3)


def test_strong_smoothness_leaves_one_normal_to_an_image() -> None:
    problem, keypoints = at_the_truth("moving_interface", noise=1.0)
    free, stiff = (
        soft(problem, keypoints, smoothness=s, radius=600.0, settings=SolverSettings(max_num_iterations=30))
        for s in (1e-4, 1e6)
    )

    def spread(result: PrintedAdjustment) -> float:
        used = np.isfinite(result.normals[:, 0])
        image, normals = problem.tracks.image[used], result.normals[used]
        return max(float(np.ptp(normals[image == i], axis=0).max()) for i in np.unique(image))

    assert spread(free) > 1e-3
    assert spread(stiff) < 1e-6
    assert stiff.data_cost > 2 * free.data_cost


def test_without_smoothness_every_noise_is_explained() -> None:
    problem, keypoints = at_the_truth("static_interface", noise=1.0)
    seen: list[Progress] = []
    result = soft(
        problem, keypoints, smoothness=0.0, settings=SolverSettings(max_num_iterations=15), on_progress=seen.append
    )
    assert result.smoothness_cost == 0.0
    assert result.data_cost < 1e-6 * seen[0].cost


@pytest.mark.parametrize("scenario", ["moving_interface", "static_interface"])
def test_what_is_held_stays(scenario: Scenario) -> None:
    truth, keypoints = at_the_truth(scenario, noise=1.0)
    problem, structure = moved(truth, 0.003), truth.structure
    held = Held.nothing(problem.state)
    held.poses[0] = held.normals[0] = True
    held.distances[-1] = True
    # A plane measured from elsewhere: what is held is its distance from the reference all the same.
    anchor = structure.plane_anchor + 0.3 * structure.plane_in_world[:, None]
    shift = np.einsum("bi,bi->b", problem.state.normal, structure.plane_anchor - anchor)
    state = replace(problem.state, distance=problem.state.distance + shift * structure.plane_in_world)
    problem = replace(problem, held=held, structure=replace(structure, plane_anchor=anchor), state=state)
    result = soft(problem, keypoints, settings=SolverSettings(max_num_iterations=10))
    before, after = problem.state, result.state
    own = int(structure.image_pose[REFERENCE])
    for pose in range(structure.num_poses):
        stays = pose in (0, own)
        assert np.array_equal(before.rotation[pose], after.rotation[pose]) == stays
        assert np.array_equal(before.translation[pose], after.translation[pose]) == stays
    old, new = (s.planes_in_cam(problem.structure) for s in (before, after))
    assert new[1][REFERENCE] == pytest.approx(old[1][REFERENCE], rel=1e-14)
    np.testing.assert_allclose(after.normal[0], before.normal[0], atol=1e-15)
    if scenario == "moving_interface":
        assert after.distance[-1] == before.distance[-1]
        assert (np.abs(after.normal[1:] - before.normal[1:]).max(axis=1) > 1e-6).all()
        free = [b for b in range(structure.num_planes - 1) if b != REFERENCE]
        assert (np.abs(after.distance - before.distance)[free] > 1e-9).all()
    assert result.cost > 0 and after.index == before.index


def test_points_that_the_reference_does_not_see_take_no_part() -> None:
    problem, keypoints = at_the_truth("moving_interface", noise=0.3)
    tracks, point = problem.tracks, by_point(problem)
    seen = np.isin(np.arange(len(problem.points)), point[tracks.image == REFERENCE])
    # Take some more points away from the reference, and put others on its dry side.
    gone = np.flatnonzero(seen)[:5]
    keep = ~((tracks.image == REFERENCE) & np.isin(point, gone))
    counts = np.bincount(point[keep], minlength=len(problem.points))
    wet = tracks.wet.copy()
    dry = np.flatnonzero(seen)[5:8]
    wet[np.isin(point, dry) & (tracks.image == REFERENCE)] = False
    # A point that another image sees straight: its ray has no normal.
    straight = np.flatnonzero((point == np.flatnonzero(seen)[9]) & (tracks.image != REFERENCE))[0]
    wet[straight] = False
    cut = tracks._replace(
        start=np.concatenate([[0], np.cumsum(counts)]), image=tracks.image[keep], direction=tracks.direction[keep],
        metric=tracks.metric[keep], lens=tracks.lens[keep], wet=wet[keep],
    )  # fmt: skip
    result = soft(replace(problem, tracks=cut), keypoints[keep], settings=SolverSettings(max_num_iterations=3))
    expected = seen.copy()
    expected[gone] = expected[dry] = False
    assert np.array_equal(np.isfinite(result.points[:, 0]), expected) and expected.sum() > 20
    expected_normals = expected[point[keep]] & wet[keep]
    assert np.array_equal(np.isfinite(result.normals[:, 0]), expected_normals)
    assert not expected_normals[int(keep[:straight].sum())]


def test_a_robust_loss_lets_a_wrong_match_be_wrong() -> None:
    truth, keypoints = at_the_truth("static_interface", noise=0.3)
    pairing = pair(truth, REFERENCE)
    k = int(pairing.others[7])
    direction = truth.tracks.direction.copy()
    direction[k, 0] += 0.05
    direction[k] /= np.linalg.norm(direction[k])
    problem = replace(truth, tracks=truth.tracks._replace(direction=direction))
    settings = SolverSettings(max_num_iterations=20)
    plain, robust = (
        soft(problem, keypoints, residual="pixels", smoothness=1e7, radius=500.0, loss=loss, settings=settings)
        for loss in ("trivial", "cauchy")
    )
    used = np.isfinite(plain.points[:, 0])
    wrong, right = (np.abs(r.points - truth.points)[used].max() for r in (plain, robust))
    assert right < 0.5 * wrong
    assert robust.cost < 0.5 * plain.cost


def test_what_cannot_be_solved_is_refused() -> None:
    problem, keypoints = at_the_truth("moving_interface")
    for smoothness in (-1.0, np.nan, np.inf):
        assert "smoothness" in error_of(lambda smoothness=smoothness: soft(problem, keypoints, smoothness=smoothness))
    assert "radius" in error_of(lambda: soft(problem, keypoints, radius=0.0))
    walls = replace(problem, layers=Layers(thickness=(0.01,), index=(1.5, 1.333)))
    assert "wall" in error_of(lambda: soft(walls, keypoints))
    known = replace(problem, held=replace(problem.held, points=True))
    assert "points" in error_of(lambda: soft(known, keypoints))
    lens = replace(problem, state=replace(problem.state, lens=np.ones((1, 1))))
    assert "intrinsics" in error_of(lambda: soft(lens, keypoints))
    plane = problem.structure.image_plane.copy()
    plane[REFERENCE] = -1
    dry = replace(problem, structure=replace(problem.structure, image_plane=plane))
    assert "no interface" in error_of(lambda: soft(dry, keypoints))
    few = np.isin(by_point(problem), pair(problem, REFERENCE).point[:4])
    wet = problem.tracks.wet & (few | (problem.tracks.image != REFERENCE))
    poor = replace(problem, tracks=problem.tracks._replace(wet=wet))
    assert "sees 4 points" in error_of(lambda: soft(poor, keypoints))


def test_an_interrupt_passes_through() -> None:
    problem, keypoints = at_the_truth("moving_interface", noise=0.3)

    def interrupt(progress: Progress) -> None:
        if progress.iteration == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        soft(problem, keypoints, on_progress=interrupt)
