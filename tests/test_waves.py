"""Captures through a wavy surface: light, statistics, and what can be known of such a scene.

What this does not prove: that a solver finds the waves, nor that the bound holds where a point is seen several
times at once, through ripples over deep water; the bound is linear.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers
from colmap_refract.options import Scenario
from colmap_refract.simulation import (
    Capture,
    SceneOptions,
    bayesian,
    bayesian_bound,
    least_path_direction,
    noise_bound,
    scene,
    simulate,
    slope_error,
)
from colmap_refract.simulation import precision as bounds
from colmap_refract.simulation.accuracy import configuration_of
from colmap_refract.simulation.point_elimination import CorrelatedNoise
from colmap_refract.simulation.surface import Surface
from colmap_refract.simulation.wave_path import least_crossings, optical_derivatives, optical_length
from colmap_refract.simulation.waves import WaveStatistics

SWELL: dict[str, Any] = {"wave_slope_deg": 2.0, "wavelength": (1.0, 2.5)}
RIPPLES: dict[str, Any] = {"wave_slope_deg": 4.0, "wavelength": (0.02, 0.1)}


def pool(scenario: Scenario = "moving_interface", **options: Any) -> Capture:
    """Half a metre of air over one and a half of water, which waves distort the most."""
    usual: dict[str, Any] = {"num_images": 4, "num_points": 60, "depth": 2.0, "distance_ratio": 0.3, "tilt_deg": 3.0}
    return simulate(SceneOptions(scenario=scenario, **{**usual, **options}))


def observed(capture: Capture, image_id: int) -> tuple[Array, Array, Array]:
    """Centre (3,) of an image, its points (n, 3) in the world and where their light crosses the surface (n, 3)."""
    model, image = capture.reconstruction, capture.reconstruction.image(image_id)
    idxs = image.get_observation_point2D_idxs()
    points = np.array([model.point3D(image.point2D(idx).point3D_id).xyz for idx in idxs])
    return image.projection_center(), points, capture.crossings[image_id][idxs]


def units(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@pytest.mark.parametrize("waves", [SWELL, RIPPLES])
@pytest.mark.parametrize("index", [1.333, 1.0])
def test_light_obeys_snell_at_the_crossing(waves: dict[str, Any], index: float) -> None:
    capture = pool(**waves, layers=Layers(index=(index,)))
    for image_id, surface in capture.surfaces.items():
        center, points, crossing = observed(capture, image_id)
        assert len(points) > 40
        assert surface.depth_below(crossing) == pytest.approx(0, abs=1e-12)
        normal = units(np.column_stack([-surface.gradient(crossing[:, :2]), np.ones(len(crossing))]))
        outside, inside = np.cross(units(crossing - center), normal), np.cross(units(points - crossing), normal)
        # The gradient is below 1e-10, and slopes and obliqueness make it no smaller than half of these sines.
        assert np.abs(outside - index * inside).max() < 3e-10
        assert (np.einsum("ij,ij->i", points - crossing, normal) > 0).all()
        # Snell at the mean plane would be wrong by much more.
        level = (
            capture.reconstruction.image(image_id).cam_from_world().rotation.matrix().T @ capture.planes[image_id][0]
        )
        wrong = np.cross(units(crossing - center), level) - index * np.cross(units(points - crossing), level)
        assert index == 1 or np.median(np.linalg.norm(wrong, axis=1)) > 0.002


@pytest.mark.parametrize("waves", [SWELL, {"wave_slope_deg": 1.0, "wavelength": (0.02, 0.1)}, RIPPLES])
def test_no_other_path_is_shorter(waves: dict[str, Any]) -> None:
    """Brute force: a fifth of a metre around the crossing, in steps of a tenth of the shortest wave or less."""
    capture = pool(**waves, num_images=2)
    places = np.stack(np.meshgrid(*2 * [np.linspace(-0.1, 0.1, 101)], indexing="ij"), axis=-1).reshape(-1, 2)
    basins = []
    for image_id, surface in capture.surfaces.items():
        center, points, crossing = observed(capture, image_id)
        gradient, _ = optical_derivatives(surface, center, points, crossing[:, :2])
        assert np.abs(gradient).max() < 1e-10
        shortest = optical_length(surface, center, points, crossing[:, :2])
        for point, middle, length in zip(points[:30], crossing, shortest, strict=False):
            around = optical_length(surface, center, np.tile(point, (len(places), 1)), middle[:2] + places)
            # Among ripples two basins can be alike to less than a micrometre, which no pixel knows.
            assert around.min() > length - 1e-6
            square = around.reshape(101, 101)
            inner = square[1:-1, 1:-1]
            beside = [square[i : 99 + i, j : 99 + j] for i, j in np.ndindex(3, 3) if (i, j) != (1, 1)]
            basins.append((inner < np.min(beside, axis=0)).sum())
    # Through the swell a point is seen once, through steep ripples it can be several times.
    assert max(basins) == 1 if waves is SWELL else True
    assert np.mean(np.array(basins) > 1) > 0.3 if waves is RIPPLES else True


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.1, -0.2, 1.0)])
def test_without_height_waves_are_the_plane(normal: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(3)
    unit = np.array(normal) / np.linalg.norm(normal)
    waves = WaveStatistics(rms_slope=0.1, wavelength=(0.05, 1.0)).draw(rng) * [1, 1, 0, 1]
    points, center = rng.uniform([-1, -1, 1.5], [1, 1, 3], (300, 3)), np.array([0.2, 0.1, -0.1])
    for ripples in (waves, np.empty((0, 4))):
        crossing = least_crossings(Surface(normal=unit, offset=1.0, waves=ripples), center, points)
        plain = least_path_direction(points - center, unit, 1.0 - unit @ center, Layers())
        assert units(crossing - center) == pytest.approx(plain, abs=1e-12)
    assert np.abs(units(points - center) - plain).max() > 0.03


def test_dry_points_have_no_crossing() -> None:
    surface = Surface(normal=np.array([0, 0, 1.0]), offset=1.0, waves=np.array([[3.0, 0, 0.05, 0]]))
    crossing = least_crossings(surface, np.zeros(3), np.array([[0.5, 0, 0.5], [0.5, 0, 1.5], [-0.5, 0, 0.97]]))
    # The last is in a crest, above the mean plane.
    assert np.isnan(crossing[0]).all()
    assert np.isfinite(crossing[1:]).all()
    assert surface.depth_below(crossing[1:]) == pytest.approx(0, abs=1e-12)


def test_crossings_normals_and_heights_are_those_of_the_keypoints() -> None:
    capture = pool(**SWELL, dry_point_ratio=0.1)
    dry = 0
    for image_id, surface in capture.surfaces.items():
        image, crossing = capture.reconstruction.image(image_id), capture.crossings[image_id]
        wet = np.isfinite(crossing).all(axis=1)
        dry += int((~wet).sum())
        pixels = image.camera.img_from_cam(image.cam_from_world() * crossing[wet])
        assert pixels == pytest.approx(capture.pixels[image_id][wet], abs=1e-9)
        normal, distance = capture.planes[image_id]
        above = distance - (image.cam_from_world() * crossing[wet]) @ normal
        assert capture.heights(image_id)[wet] == pytest.approx(above, abs=1e-12)
        # Finite differences of the height, turned into the camera.
        step, xy = 1e-6, crossing[wet, :2]
        rise = [(surface.height(xy + step * a) - surface.height(xy - step * a)) / (2 * step) for a in np.eye(2)]
        true = units(np.column_stack([-rise[0], -rise[1], np.ones(len(xy))]))
        found = capture.normals_in_cam(image_id)
        assert found[wet] == pytest.approx(true @ image.cam_from_world().rotation.matrix().T, abs=1e-8)
        assert np.isnan(found[~wet]).all() and np.isnan(capture.heights(image_id)[~wet]).all()
    assert dry >= 4


def test_flat_captures_have_their_planes_as_surfaces() -> None:
    for scenario in ("static_interface", "camera_housing"):
        capture = pool(scenario, layers=Layers(thickness=(0.02,), index=(1.5, 1.333)))
        for image_id, (normal, distance) in capture.planes.items():
            image = capture.reconstruction.image(image_id)
            in_cam = image.cam_from_world() * capture.crossings[image_id]
            assert in_cam @ normal == pytest.approx(distance, abs=1e-12)
            assert image.camera.img_from_cam(in_cam) == pytest.approx(capture.pixels[image_id], abs=1e-9)
            assert capture.normals_in_cam(image_id) == pytest.approx(np.tile(normal, (len(in_cam), 1)), abs=1e-12)
            assert capture.heights(image_id) == pytest.approx(0, abs=1e-12)


def test_each_frame_has_waves_of_its_own() -> None:
    capture = pool(**SWELL, num_images=8, sensors_per_frame=2, frames_per_interface=2)
    for image_id in (1, 3, 5, 7):
        assert capture.surfaces[image_id] is capture.surfaces[image_id + 1]
    assert len({surface.waves.tobytes() for surface in capture.surfaces.values()}) == 4
    # Two frames share a mean plane nevertheless.
    assert capture.surfaces[1].offset == pytest.approx(capture.surfaces[3].offset, abs=1e-12)
    assert abs(capture.surfaces[1].offset - capture.surfaces[5].offset) > 1e-4


def test_a_seed_determines_the_waves_and_nothing_else_changes() -> None:
    first, same, other, flat = (
        pool(**{**SWELL, "wave_slope_deg": slope}, seed=seed) for seed, slope in [(4, 2), (4, 2), (5, 2), (4, 0)]
    )
    for image_id, surface in first.surfaces.items():
        assert np.array_equal(surface.waves, same.surfaces[image_id].waves)
        assert np.array_equal(first.pixels[image_id], same.pixels[image_id])
        assert not np.array_equal(surface.waves, other.surfaces[image_id].waves)
        # Waves are drawn beside everything else: the scene under them is the same.
        assert np.array_equal(first.planes[image_id][0], flat.planes[image_id][0])
        pose, still = (c.reconstruction.image(image_id).cam_from_world().matrix() for c in (first, flat))
        assert np.array_equal(pose, still)
    assert all(len(surface.waves) == 0 for surface in flat.surfaces.values())


@pytest.mark.parametrize("wavelength", [(0.3, 0.9), (0.5, 0.5)])
def test_the_covariance_is_that_of_drawn_surfaces(wavelength: tuple[float, float]) -> None:
    statistics, rng = WaveStatistics(rms_slope=0.05, wavelength=wavelength), np.random.default_rng(8)
    places = np.array([[0, 0], [0.1, 0], [0.05, 0.2], [-0.4, 0.3], [1.0, -0.6]])
    rows = []
    for _ in range(10_000):
        surface = Surface(normal=np.array([0, 0, 1.0]), offset=0.0, waves=statistics.draw(rng))
        rows.append(np.column_stack([surface.height(places), surface.gradient(places)]).ravel())
    empirical = np.cov(np.array(rows).T, bias=True)
    analytic = statistics.covariance(places).reshape(15, 15)
    std = np.sqrt(np.diag(analytic))
    # Of 10,000 draws each correlation is known to 1 %, and 120 of them are looked at.
    assert empirical / np.outer(std, std) == pytest.approx(analytic / np.outer(std, std), abs=0.045)
    assert analytic == pytest.approx(analytic.T, abs=1e-15)
    assert np.linalg.eigvalsh(analytic).min() > 0
    assert std[0] == pytest.approx(statistics.rms_height, rel=1e-6)
    assert std[1:3] == pytest.approx(0.05 / np.sqrt(2), rel=1e-6)
    # Slopes and heights of neighbours belong together, or half of this would be a test of zeros.
    correlation = analytic / np.outer(std, std)
    assert abs(correlation[0, 4]) > 0.2 and correlation[0, 3] > 0.5 > correlation[0, 12]


def test_slopes_are_the_derivatives_of_heights() -> None:
    """Finite differences of the height's covariance, over a band whose longest wave is 25 times the shortest."""
    statistics, step = WaveStatistics(rms_slope=0.1, wavelength=(0.04, 1.0)), 1e-3
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-0.5, 0.5, (2, 40, 2))
    whole = statistics.covariance(x, y)

    def height(a: Array, b: Array) -> Array:
        return statistics.covariance(a, b)[:, 0, :, 0]

    for i, e in enumerate(step * np.eye(2)):
        assert whole[:, 0, :, 1 + i] == pytest.approx((height(x, y + e) - height(x, y - e)) / (2 * step), abs=2e-5)
        for j, f in enumerate(step * np.eye(2)):
            both = height(x + e, y + f) - height(x + e, y - f) - height(x - e, y + f) + height(x - e, y - f)
            # The fourth derivative leaves (q step)^2 / 6 = 0.4 % of a variance of 0.005.
            assert whole[:, 1 + i, :, 1 + j] == pytest.approx(both / (4 * step**2), abs=5e-5)
    assert np.abs(whole[:, 1:, :, 1:]).max() > 1e-3


def test_waves_are_as_steep_as_asked() -> None:
    rng = np.random.default_rng(6)
    for slope, wavelength in [(0.02, (1.0, 2.5)), (0.2, (0.02, 0.1))]:
        for _ in range(3):
            waves = WaveStatistics(rms_slope=slope, wavelength=wavelength).draw(rng)
            assert Surface(normal=np.array([0, 0, 1.0]), offset=1.0, waves=waves).rms_slope == pytest.approx(slope)
            lengths = 2 * np.pi / np.linalg.norm(waves[:, :2], axis=1)
            assert wavelength[0] <= lengths.min() < 1.1 * wavelength[0]
            assert wavelength[1] >= lengths.max() > 0.9 * wavelength[1]
    capture = pool(**SWELL, num_images=40)
    planes = {i: np.tile(plane[0], (len(capture.pixels[i]), 1)) for i, plane in capture.planes.items()}
    # Forty frames see little more than one wave each: some 80 independent slopes.
    assert slope_error(planes, capture) == pytest.approx(2.0, rel=0.2)


def test_slope_error_is_the_angle_between_normals() -> None:
    capture = pool(**SWELL)
    found = {}
    for image_id in (1, 2, 4):
        normal = capture.normals_in_cam(image_id)
        aside = units(np.cross(normal, [0.3, 1, 0.2]))
        found[image_id] = 2.0 * (np.cos(0.02) * normal + np.sin(0.02) * aside)
        found[image_id][::3] = np.nan
    assert slope_error(found, capture) == pytest.approx(np.degrees(0.02), rel=1e-12)
    for wrong, match in [({1: np.ones((3, 3))}, "keypoints"), ({9: found[1]}, "surface"), ({}, "no normal")]:
        with pytest.raises(RefractError, match=match):
            slope_error(wrong, capture)


def test_first_order_noise_of_waves_is_that_of_drawn_waves() -> None:
    """The covariance that the bound is made of, against pixels through many faint surfaces by least path."""
    faint: dict[str, Any] = {"wave_slope_deg": 0.02, "wavelength": (0.3, 1.0)}
    capture = pool(**faint, num_points=25, num_images=2, pixel_noise=1.0)
    configuration = configuration_of(capture)
    noise = bayesian._noise(configuration, capture.options.wave_statistics, 1.0)
    rng = np.random.default_rng(0)
    for image, (group, factor) in enumerate(zip(noise.groups, noise.factors, strict=True)):
        pose = configuration.views(np.zeros(12))[0][image]
        flat, points = capture.surfaces[image + 1], configuration.points[configuration.point[group]]
        center, draws = -pose[:, :3].T @ pose[:, 3], []
        for _ in range(400):
            surface = replace(flat, waves=capture.options.wave_statistics.draw(rng))
            crossing = least_crossings(surface, center, points)
            draws.append(configuration.cameras[0].img_from_cam(crossing @ pose[:, :3].T + pose[:, 3]).ravel())
        empirical, expected = np.cov(np.array(draws).T), factor @ factor.T - np.eye(2 * len(group))
        # Of 400 draws a correlation is known to 5 %; the waves move pixels by 0.1 px, in the linear range.
        std = np.sqrt(np.diag(expected))
        assert len(group) > 15 and std.min() > 0.02
        assert empirical / np.outer(std, std) == pytest.approx(expected / np.outer(std, std), abs=0.3)
        # What draws of normal numbers leave of a covariance (Wishart), and a half more.
        usual = np.sqrt((np.sum(expected**2) + np.trace(expected) ** 2) / len(draws))
        assert np.linalg.norm(empirical - expected) < 1.5 * usual < 0.4 * np.linalg.norm(expected)


def across_similarities(points: Array) -> Array:
    """The projection (3P, 3P) on what an alignment of points (P, 3) leaves of their changes."""
    turns = [np.cross(axis, points).ravel() for axis in np.eye(3)]
    g = np.stack([*np.tile(np.eye(3), len(points)), *turns, points.ravel()], axis=1)
    return np.asarray(np.eye(len(g)) - g @ np.linalg.solve(g.T @ g, g.T))


@pytest.mark.parametrize(
    ("scenario", "options"),
    [
        ("moving_interface", {}),
        ("static_interface", {"sensors_per_frame": 2}),
        # Each point is seen through two interfaces or one, which says nothing of its depth.
        ("fixed_camera", {"frames_per_interface": 3}),
    ],
)
def test_bound_with_correlated_noise_is_that_of_the_dense_equations(scenario: Scenario, options: Any) -> None:
    """One large matrix, its pseudo-inverse and a projection. The derivatives are those of the code under test: that
    they are right is for the tests of the accuracy."""
    capture = pool(scenario, num_images=6, num_points=30, **options, **SWELL)
    configuration, rng = configuration_of(capture), np.random.default_rng(2)
    by_point, by_block = bounds._jacobian(configuration)
    count, num_points = len(by_point), len(configuration.points)
    dense = np.zeros((count, 2, num_points, 3))
    dense[np.arange(count), :, configuration.point] = by_point
    jacobian = np.concatenate([dense.reshape(2 * count, -1), by_block.reshape(2 * count, -1)], axis=1)

    # Any covariance will do, with frames whose observations are not in a row.
    frame = rng.integers(0, 4, count)
    groups, covariance = [np.flatnonzero(frame == k) for k in range(4)], np.zeros((2 * count, 2 * count))
    factors = []
    for group in groups:
        root = rng.standard_normal((2 * len(group), 5))
        part = np.eye(2 * len(group)) + root @ root.T
        rows = (2 * group[:, None] + [0, 1]).ravel()
        covariance[np.ix_(rows, rows)] = part
        factors.append(np.linalg.cholesky(part))
    information = jacobian.T @ np.linalg.solve(covariance, jacobian)
    scale = 1 / np.sqrt(np.diag(information))
    posterior = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-13, hermitian=True)
    posterior = (posterior * np.outer(scale, scale))[: 3 * num_points, : 3 * num_points]
    beside = across_similarities(configuration.points)
    expected = np.sqrt(np.trace(beside @ posterior @ beside.T) / num_points)
    found = bounds.precision(configuration, noise=CorrelatedNoise(groups=groups, factors=factors)).rmse
    assert found == pytest.approx(expected, rel=1e-4)
    assert abs(found / bounds.precision(configuration).rmse - 1) > 0.02


@pytest.mark.parametrize("scenario", ["moving_interface", "static_interface", "fixed_camera", "camera_housing"])
def test_without_waves_and_prior_it_is_the_noise_bound(scenario: Scenario) -> None:
    capture = pool(scenario, num_images=6)
    assert bayesian_bound(capture) == pytest.approx(noise_bound(capture), rel=1e-12)
    # Through the joint elimination, with waves of no height.
    faint = replace(capture, options=replace(capture.options, wave_slope_deg=1e-7)) if scenario[0] != "c" else capture
    assert bayesian_bound(faint) == pytest.approx(noise_bound(capture), rel=1e-6)


@pytest.mark.parametrize("scenario", ["moving_interface", "static_interface"])
def test_steeper_waves_leave_less(scenario: Scenario) -> None:
    flat = pool(scenario, num_images=6, num_points=40)

    def bound(**options: Any) -> float:
        return bayesian_bound(replace(flat, options=replace(flat.options, **options)))

    found = [noise_bound(flat), *(bound(wave_slope_deg=slope) for slope in (0.2, 1.0, 4.0))]
    assert (np.diff(found) > 0.05 * found[0]).all()
    # With hardly any other noise, it is in proportion to waves so short that the points say nothing of each other's.
    short = [bound(wave_slope_deg=slope, wavelength=(0.05, 0.2), pixel_noise=0.01) for slope in (1.0, 4.0)]
    assert short[1] / short[0] == pytest.approx(np.tan(np.radians(4)) / np.tan(np.radians(1)), rel=0.02)


@pytest.mark.parametrize("slope", [0.0, 2.0])
@pytest.mark.parametrize("scenario", ["moving_interface", "fixed_camera"])
def test_the_level_prior_is_between_free_planes_and_one(scenario: Scenario, slope: float) -> None:
    capture = pool(scenario, num_images=5, num_points=30, **{**SWELL, "wave_slope_deg": slope}, pixel_noise=2.0)
    free, level = bayesian_bound(capture), bayesian_bound(capture, level_prior=True)
    assert level < free
    if scenario == "moving_interface":
        one = replace(capture, options=replace(capture.options, scenario="static_interface"))
        assert bayesian_bound(one) < level
        assert bayesian_bound(one, level_prior=True) == bayesian_bound(one)


def test_the_level_prior_is_that_of_the_planes_that_are_drawn() -> None:
    options = SceneOptions(scenario="moving_interface", num_images=3000, tilt_deg=4.0)
    targets = np.random.default_rng(1).uniform(-1, 1, (3000, 2))
    normals, offsets = scene.world_planes(options, targets, np.random.default_rng(2))
    slopes = -normals[:, :2] / normals[:, 2:]
    lift = offsets / normals[:, 2] + np.sum(slopes * targets, axis=1) - options.interface_height
    slope_std, lift_std = scene.plane_scatter(options)
    # 3000 draws know a deviation to 1.3 %.
    assert slopes.std(axis=0) == pytest.approx(slope_std, rel=0.05)
    assert lift.std() == pytest.approx(lift_std, rel=0.05)
    assert slope_std > 0.04 and lift_std > 0.01


def test_rows_of_the_level_prior_are_derivatives() -> None:
    capture = pool(num_images=4, frames_per_interface=2, tilt_deg=8.0)
    configuration, options = configuration_of(capture), capture.options
    rows = bayesian._level_prior(configuration, options).reshape(2, 3, -1)
    slope_std, lift_std = scene.plane_scatter(options)
    targets = scene.lay_out(options, np.random.default_rng(options.seed)).targets[::2]

    def deviations(change: Array) -> Array:
        """(2, 3) of both planes, all changed alike by tilt and lift (3,), from a level one."""
        _, normal, distance = configuration.views(np.concatenate([np.zeros(9), change]))
        rotation, translation = configuration.rig_from_world[::2, :, :3], configuration.rig_from_world[::2, :, 3]
        normal, distance = normal[::2], distance[::2]
        offset = distance - np.einsum("ij,ij->i", normal, translation)
        normal = np.einsum("iba,ib->ia", rotation, normal)
        slope = -normal[:, :2] / normal[:, 2:]
        lift = offset / normal[:, 2] + np.sum(slope * targets, axis=1)
        return np.column_stack([slope / slope_std, lift / lift_std])

    for k, step in enumerate(1e-5 * np.eye(3)):
        by_plane = (deviations(step) - deviations(-step)) / 2e-5
        for plane in range(2):
            assert rows[plane, :, 24 + 3 * plane + k] == pytest.approx(by_plane[plane], rel=1e-6, abs=1e-6)
            assert not rows[plane, :, 24 + 3 * (1 - plane) + k].any()
    assert not rows[:, :, :24].any()
    common = rows[:, :, -3:] * np.array([slope_std, slope_std, lift_std])[:, None]
    for plane in range(2):
        assert common[plane] == pytest.approx(-np.array([[1, 0, 0], [0, 1, 0], [*targets[plane], 1]]))


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"wave_slope_deg": -1.0}, "wave_slope_deg"),
        ({"wave_slope_deg": np.nan}, "wave_slope_deg"),
        ({"wave_slope_deg": 20.0}, "break"),
        ({"wave_slope_deg": 1.0, "wavelength": (0.0, 1.0)}, "wavelengths"),
        ({"wave_slope_deg": 1.0, "wavelength": (2.0, 1.0)}, "wavelengths"),
        ({"wave_slope_deg": 1.0, "wavelength": (1.0, np.inf)}, "wavelengths"),
        ({"wave_slope_deg": 1.0, "scenario": "camera_housing"}, "camera_housing"),
        ({"wave_slope_deg": 1.0, "layers": Layers(thickness=(0.1,), index=(1.5, 1.33))}, "wall"),
    ],
)
def test_waves_that_cannot_be_are_told(options: dict[str, Any], match: str) -> None:
    with pytest.raises(RefractError, match=match):
        SceneOptions(**{"scenario": "static_interface", **options})


def test_waves_that_reach_a_camera_or_have_no_bound_are_told() -> None:
    with pytest.raises(RefractError, match="above a camera"):
        pool(wave_slope_deg=17.0, wavelength=(40.0, 60.0))
    with pytest.raises(RefractError, match="pixel_noise"):
        bayesian_bound(pool(**SWELL, pixel_noise=0.0))
