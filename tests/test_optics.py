"""Refraction forward and backward: against the path of least time, Snell's law, and each other.

Errors are differences of unit vectors times the focal length: pixels on the optical axis of a pinhole
camera. The derivatives of the projection are tested where they are used, in `test_elimination`.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from colmap_refract.estimator.optics import back_project, is_wet, project_direction, refract
from colmap_refract.interface import Array, Layers
from colmap_refract.simulation import least_path_direction

FOCAL_LENGTH = 1200.0
ROUNDING = 1e-12
"""Pixels: a unit vector is exact to 1e-16, which is 1.3e-13 px, and a handful of such roundings add up."""

WATER = Layers()
WINDOW = Layers(thickness=(0.03,), index=(1.52, 1.333))
TANK = Layers(thickness=(0.01, 0.2), index=(1.49, 1.0, 1.333))
PORTHOLE = Layers(thickness=(0.02,), index=(1.52 / 1.333, 1 / 1.333))
TILTED = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
AXIS = np.array([0.0, 0.0, 1.0])
OBLIQUE = np.linspace(0.05, 1.2, 24)

# Angles of the ray in the air from the normal, normal, distance of the plane, media, path in the water.
REGIMES: dict[str, tuple[Array, Array, float, Layers, float]] = {
    "on the axis": (np.zeros(4), TILTED, 1.0, WATER, 1.5),
    "near the axis": (np.array([1e-300, 1e-160, 1e-12, 1e-8, 1e-4]), TILTED, 1.0, WATER, 1.5),
    "oblique": (OBLIQUE, AXIS, 1.0, WATER, 1.5),
    "tilted": (OBLIQUE, TILTED, 0.7, WATER, 2.0),
    "grazing": (np.radians([85.0, 88.0, 89.0]), TILTED, 1.0, WATER, 1.5),
    "index near 1": (OBLIQUE, TILTED, 1.0, Layers(index=(1 + 1e-7,)), 1.5),
    "dense": (OBLIQUE, TILTED, 1.0, Layers(index=(2.4,)), 1.5),
    "index below 1": (np.linspace(0.05, 0.84, 24), TILTED, 1.0, Layers(index=(1 / 1.333,)), 1.5),
    "camera at the plane": (OBLIQUE, TILTED, 1e-9, WATER, 1.5),
    "point at the plane": (OBLIQUE, TILTED, 1.0, WATER, 1e-9),
    "large units": (OBLIQUE, TILTED, 1e6, WATER, 1.5e6),
    "one wall": (OBLIQUE, TILTED, 0.5, WINDOW, 1.5),
    "two walls": (OBLIQUE, TILTED, 0.5, TANK, 1.5),
    "grazing through walls": (np.radians([85.0, 88.0, 89.0]), TILTED, 0.5, TANK, 1.5),
    "out of the water": (np.linspace(0.05, 0.84, 24), TILTED, 0.5, PORTHOLE, 1.5),
}


def unit(vector: Any) -> Array:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector, axis=-1, keepdims=True)


def pixel_error(a: Array, b: Array) -> float:
    return float(FOCAL_LENGTH * np.abs(a - b).max())


def regime(name: str) -> tuple[Array, Array, Array, float, Layers]:
    """Directions (n, 3), the points (n, 3) they lead to by Snell's law, normal, distance and media."""
    angle, normal, distance, layers, last = REGIMES[name]
    across = unit(np.cross(normal, np.random.default_rng(0).normal(size=(len(angle), 3))))
    radius = distance * np.tan(angle)
    for h, mu in zip([*layers.thickness, last], layers.index, strict=True):
        radius = radius + h * np.tan(np.arcsin(np.sin(angle) / mu))
    depth = distance + sum(layers.thickness) + last
    direction = np.cos(angle)[:, None] * normal + np.sin(angle)[:, None] * across
    return direction, depth * normal + radius[:, None] * across, normal, distance, layers


@pytest.mark.parametrize("name", REGIMES)
def test_projection_follows_the_least_path(name: str) -> None:
    direction, points, normal, distance, layers = regime(name)
    found = project_direction(points, normal, distance, layers)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-15)
    assert pixel_error(found, least_path_direction(points, normal, distance, layers)) < 1e-9
    # Where the points came from: the least path and the projection could share an error in the points' depth.
    assert pixel_error(found, direction) < 1e-9


# Everyday values, and those next to where a formula divides by zero or changes its branch; no nearer than the least
# path itself can be found to 1e-9 px.
offsets = st.one_of(st.floats(-20, 20), st.sampled_from([0.0, 1e-300, 1e-160, -1e-12, 1e-8, -1e-4, 1e3]))
slopes = st.one_of(st.floats(-0.7, 0.7), st.sampled_from([0.0, 1e-200, -1e-9, 1e-5]))
indices = st.one_of(st.floats(0.6, 2.5), st.sampled_from([1.0, 1 + 1e-15, 1 - 1e-15, 1 + 1e-9, 1 - 1e-5, 1.333]))
ratios = st.one_of(st.floats(0.01, 0.99), st.sampled_from([1e-9, 1e-6, 1 - 1e-4]))
walls_before = st.one_of(
    st.tuples(st.one_of(st.floats(0.001, 0.4), st.just(1e-5)), indices),
    # A wall without thickness bends nothing. (One that is also thinner than air has no ray through it.)
    st.tuples(st.just(0.0), st.floats(1, 2)),
)


@settings(max_examples=300, deadline=None)
@given(
    point=st.tuples(offsets, offsets, st.floats(0.1, 20)),
    slope=st.tuples(slopes, slopes),
    ratio=ratios,
    walls=st.lists(walls_before, max_size=2),
    mu=indices,
)
def test_projection_follows_the_least_path_anywhere(
    point: tuple[float, float, float],
    slope: tuple[float, float],
    ratio: float,
    walls: list[tuple[float, float]],
    mu: float,
) -> None:
    normal = unit([*slope, 1.0])
    depth = float(np.dot(point, normal))
    if depth < 0.02 * np.linalg.norm(point):
        return
    distance = ratio * depth
    thickness = tuple(share * (depth - distance) for share, _ in walls)
    layers = Layers(thickness=thickness, index=(*(index for _, index in walls), mu))
    found = project_direction(np.array([point]), normal, distance, layers)
    # Where the ray is beyond 89 degrees in some medium the numbers that describe the point are too coarse.
    if np.linalg.norm(np.cross(found[0], normal)) < 0.9998 * min(1.0, *layers.index):
        assert pixel_error(found, least_path_direction([point], normal, distance, layers)) < 1e-9


@pytest.mark.parametrize(
    "layers",
    [
        Layers(index=(1.0,)),
        Layers(index=(1 + 1e-15,)),
        Layers(index=(1 - 1e-15,)),
        Layers(thickness=(0.1, 0.2), index=(1.0, 1.0, 1.0)),
    ],
)
def test_without_refraction_points_are_seen_straight(layers: Layers) -> None:
    points = np.random.default_rng(2).uniform([-5, -5, 1], [5, 5, 3], (500, 3))
    for normal in (AXIS, TILTED):
        near = points[unit(points) @ normal > 0.1]
        found = project_direction(near, normal, 0.2, layers, wet=np.ones(len(near), dtype=bool))
        # Snell's law bends a ray by its tangent, here up to 10, times the index' difference from 1.
        assert pixel_error(found, unit(near)) < ROUNDING + 10 * FOCAL_LENGTH * abs(layers.refractive_index - 1)


def test_distance_zero_is_the_limit_of_small_distances() -> None:
    """Seen through a plane at the lens, a ray is only bent: its sine is the index times the sine in the water."""
    angle = np.linspace(0.01, 0.84, 50)  # in the water; total reflection is at 0.848
    points = 2.0 * np.stack([np.sin(angle), np.zeros(50), np.cos(angle)], axis=1)
    expected = np.stack([1.333 * np.sin(angle), np.zeros(50), np.sqrt(1 - (1.333 * np.sin(angle)) ** 2)], axis=1)
    errors = [pixel_error(project_direction(points, AXIS, d, WATER), expected) for d in (1e-6, 1e-9, 1e-12, 0.0)]
    assert errors[0] < 1.0
    assert errors[-1] < 1e-9
    assert errors == sorted(errors, reverse=True)


def test_beyond_total_reflection_a_close_plane_is_seen_grazing() -> None:
    points = np.array([[3.0, 0.0, 1.0], [0.0, -50.0, 1.0]])
    found = project_direction(points, AXIS, 1e-9, WATER)
    assert np.isfinite(found).all()
    assert (found[:, 2] < 1e-3).all() and (found[:, 2] > 0).all()
    np.testing.assert_allclose(found[:, :2], [[1, 0], [0, -1]], atol=1e-6)


@pytest.mark.parametrize("name", REGIMES)
def test_back_projection_passes_through_the_point(name: str) -> None:
    direction, points, normal, distance, layers = regime(name)
    origin, ray = back_project(project_direction(points, normal, distance, layers), normal, distance, layers)
    np.testing.assert_allclose(origin @ normal, distance + sum(layers.thickness), rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1.0, rtol=1e-12)
    miss = np.linalg.norm(np.cross(points - origin, ray), axis=1)
    # A direction's rounding of 1e-16 is stretched by 1/cos^2 at the plane: 3000 at 89 degrees.
    cosine = direction @ normal
    assert (miss < 1e-14 * np.linalg.norm(points, axis=1) / cosine**2).all()


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 2))
def test_forward_and_backward_are_inverse(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    layers = Layers(thickness=tuple(rng.uniform(0, 0.3, count)), index=tuple(rng.uniform(0.8, 1.7, count + 1)))
    direction = unit(np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)]))
    normal = unit(np.column_stack([rng.normal(size=(50, 2)) * 10.0 ** rng.uniform(-9, -0.8), np.ones(50)]))
    distance = 10.0 ** rng.uniform(-6, 1, 50)
    origin, ray = back_project(direction, normal, distance, layers)
    reached = np.isfinite(ray).all(axis=1)
    assert reached.any()
    points = origin + 10.0 ** rng.uniform(-3, 2, (50, 1)) * ray
    found = project_direction(points[reached], normal[reached], distance[reached], layers)
    # Near total reflection the last medium's angle is a square root, and loses half of its digits.
    cosine = np.einsum("ij,ij->i", ray, normal)[reached]
    assert (FOCAL_LENGTH * np.abs(found - direction[reached]).max(axis=1) < 1e-9 / np.minimum(cosine, 1) ** 2).all()


@pytest.mark.parametrize("index_ratio", [1.333, 1 / 1.333, 1.0])
def test_refraction_obeys_snell_with_a_normal_per_ray(index_ratio: float) -> None:
    rng = np.random.default_rng(3)
    direction = unit(np.column_stack([rng.uniform(-0.4, 0.4, (200, 2)), np.ones(200)]))
    normal = unit(np.column_stack([rng.uniform(-0.2, 0.2, (200, 2)), np.ones(200)]))
    ray = refract(direction, normal, index_ratio)
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1.0, rtol=1e-14)
    # n x v, times the index, is the same before and behind: the sines and the plane of incidence at once.
    np.testing.assert_allclose(index_ratio * np.cross(normal, ray), np.cross(normal, direction), atol=1e-15)
    assert (np.einsum("ij,ij->i", ray, normal) > 0).all()


def test_back_projection_bends_at_the_normal_of_the_wave() -> None:
    rng = np.random.default_rng(4)
    direction = unit(np.column_stack([rng.uniform(-0.4, 0.4, (200, 2)), np.ones(200)]))
    wave = unit(TILTED + 0.1 * rng.normal(size=(200, 3)))
    origin, ray = back_project(direction, TILTED, 0.8, WATER, normal_at_point=wave)
    # The wave changes where the ray goes, not where it enters.
    np.testing.assert_allclose(origin, back_project(direction, TILTED, 0.8, WATER)[0], rtol=1e-15)
    np.testing.assert_allclose(1.333 * np.cross(wave, ray), np.cross(wave, direction), atol=1e-15)


def test_back_projection_through_walls_bends_at_the_wave_first() -> None:
    rng = np.random.default_rng(5)
    direction = unit(np.column_stack([rng.uniform(-0.3, 0.3, (50, 2)), np.ones(50)]))
    wave = unit(AXIS + 0.1 * rng.normal(size=(50, 3)))
    origin, ray = back_project(direction, AXIS, 0.8, WINDOW, normal_at_point=wave)
    entry = 0.8 * direction / direction[:, 2:]
    in_wall = unit(origin - entry)
    np.testing.assert_allclose(1.52 * np.cross(wave, in_wall), np.cross(wave, direction), atol=1e-13)
    np.testing.assert_allclose(1.333 * np.cross(AXIS, ray), 1.52 * np.cross(AXIS, in_wall), atol=1e-13)


def test_rays_that_never_arrive_are_not_numbers() -> None:
    """They come without an exception or a warning: solvers meet them."""
    away = np.array([[0.0, 0.6, -0.8], [1.0, 0.0, 0.0]])
    grazing = unit([[1.0, 0.0, 0.1]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for layers in (WATER, WINDOW, TANK):
            assert np.isnan(back_project(away, AXIS, 1.0, layers)[0]).all()
        assert np.isnan(refract(grazing, AXIS, 1 / 1.333)).all()
        assert np.isnan(back_project(grazing, AXIS, 1.0, PORTHOLE)[1]).all()


@pytest.mark.parametrize("layers", [WATER, WINDOW, Layers(index=(1 / 1.333,)), Layers(index=(1.0,))])
@pytest.mark.parametrize("normal", [AXIS, TILTED])
def test_projection_is_smooth_where_the_water_ends(layers: Layers, normal: Array) -> None:
    """Point and plane may change places during a solve: direction and slopes must not jump there.

    First and second differences on both sides of the plane are compared: for a smooth function they part in
    proportion to the step, while a kink does not depend on it.
    """
    rng = np.random.default_rng(6)
    surface = 0.8 + sum(layers.thickness)
    across = np.array([surface * normal + 0.5 * unit(np.cross(normal, v)) for v in rng.normal(size=(20, 3))])
    wet = np.ones(20, dtype=bool)

    def at(shift: float, points: Array = across, distance: float = 0.8) -> Array:
        return project_direction(points + shift * normal, normal, distance, layers, wet=wet)

    assert pixel_error(at(1e-15), at(-1e-15)) < 1e-9
    if not layers.thickness:
        assert pixel_error(at(0.0), unit(across)) < ROUNDING

    def jump(step: float, order: int) -> float:
        samples = [np.array([at(sign * k * step) for k in range(order + 1)]) for sign in (1.0, -1.0)]
        behind, before = (np.diff(side, n=order, axis=0)[0] / step**order for side in samples)
        return float(np.abs(behind - (-1.0) ** order * before).max())

    for order in (1, 2):
        # Rounding of the samples, over the step.
        noise = 1e-14 / 1e-3**order
        assert jump(1e-3, order) < 0.2 * jump(1e-2, order) + noise
    # Across the plane, and for the plane that moves through the point.
    e1 = unit(np.cross(normal, [0.1, 1.0, 0.2]))
    for h in (1e-7, -1e-7):
        slope = (at(h, across + 1e-5 * e1) - at(h, across - 1e-5 * e1)) / 2e-5
        other = (at(-h, across + 1e-5 * e1) - at(-h, across - 1e-5 * e1)) / 2e-5
        np.testing.assert_allclose(slope, other, atol=1e-6)
        moved = (at(h, distance=0.8 + 1e-5) - at(h, distance=0.8 - 1e-5)) / 2e-5
        other = (at(-h, distance=0.8 + 1e-5) - at(-h, distance=0.8 - 1e-5)) / 2e-5
        np.testing.assert_allclose(moved, other, atol=1e-6)


@settings(max_examples=200, deadline=None)
@given(
    point=st.tuples(offsets, offsets, st.floats(0.1, 20)),
    distance=st.floats(0.01, 50),
    walls=st.lists(st.tuples(st.floats(0, 1), st.floats(1, 2)), max_size=2),
    mu=st.one_of(st.floats(1, 2.5), st.sampled_from([1.0, 1 + 1e-12])),
)
@example(point=(1e3, 0.0, 0.1), distance=50.0, walls=[], mu=2.5)
def test_the_continuation_before_the_plane_solves_the_same_equation(
    point: tuple[float, float, float], distance: float, walls: list[tuple[float, float]], mu: float
) -> None:
    """A point in front of the plane that is marked wet: Snell's law holds, with a negative path in the water.

    Not shown, because it need not hold: a point that the walls' thickness alone would put behind the camera.
    """
    layers = Layers(thickness=tuple(h for h, _ in walls), index=(*(index for _, index in walls), mu))
    if point[2] <= sum(layers.thickness):
        return
    found = project_direction(np.array([point]), AXIS, distance, layers, wet=np.array([True]))[0]
    assert np.isfinite(found).all() and found[2] > 0
    thickness = np.array([distance, *layers.thickness, point[2] - distance - sum(layers.thickness)])
    sine = np.hypot(found[0], found[1]) / np.array([1.0, *layers.index])
    if sine[0] > 0.9999:  # beyond 89 degrees, where the sine itself is too coarse
        return
    reach = thickness @ (sine / np.sqrt(1 - sine**2))
    radius = np.hypot(point[0], point[1])
    # As exact as the direction is: a change of the sine moves the end of the path by its derivative.
    size = abs(thickness) @ (sine / (1 - sine**2) ** 1.5)
    assert abs(reach - radius) <= 1e-14 * (radius + size) + 1e-300


def test_points_outside_the_domain_are_seen_straight() -> None:
    """Behind the camera, beside it, or beyond what the continuation reaches, without an exception or a warning."""
    points = np.array([[0.5, 0.2, -1.0], [0.3, -2.0, 0.0], [0.0, 0.0, -3.0], [0.1, 0.1, 1e-3]])
    with warnings.catch_warnings(), np.errstate(all="raise"):
        warnings.simplefilter("error")
        for wet in (None, np.ones(4, dtype=bool)):
            found = project_direction(points[:3], AXIS, 1.0, WATER, wet)
            assert pixel_error(found, unit(points[:3])) < ROUNDING
        # The plane far behind the point, in a denser medium before it: there is no such ray.
        found = project_direction(points[3:], AXIS, 1.0, Layers(index=(1 / 1.333,)), np.ones(1, dtype=bool))
        assert np.isfinite(found).all()


def test_points_in_front_of_the_plane_are_dry() -> None:
    points = np.array([[0.5, 0.2, 0.99], [0.5, 0.2, 1.01], [0.5, 0.2, 1.04], [0.0, 0.0, -2.0]])
    assert is_wet(points, AXIS, 1.0, WATER).tolist() == [False, True, True, False]
    assert is_wet(points, AXIS, 1.0, WINDOW).tolist() == [False, False, True, False]
    assert is_wet(points, AXIS, np.array([0.9, 1.1, 1.1, 1.1]), WATER).tolist() == [True, False, False, False]
    found = project_direction(points, AXIS, 1.0, WATER)
    straight = project_direction(points, AXIS, 1.0, WATER, np.zeros(4, dtype=bool))
    assert pixel_error(straight, unit(points)) < ROUNDING
    assert (np.abs(found - straight).max(axis=1) > 1e-4).tolist() == [False, True, True, False]


def test_every_point_may_have_its_own_plane() -> None:
    rng = np.random.default_rng(7)
    points, distance = rng.uniform([-1, -1, 2], [1, 1, 3], (20, 3)), rng.uniform(0.1, 1, 20)
    normal = unit(np.column_stack([rng.uniform(-0.3, 0.3, (20, 2)), np.ones(20)]))
    batch = project_direction(points, normal, distance, TANK)
    single = [project_direction(p[None], n, d, TANK)[0] for p, n, d in zip(points, normal, distance, strict=True)]
    np.testing.assert_array_equal(batch, single)
    assert project_direction(np.empty((0, 3)), AXIS, 1.0, WATER).shape == (0, 3)
