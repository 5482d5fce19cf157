"""The simulation's projection, against the polynomial of flat refraction and against Snell's law."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers
from colmap_refract.simulation import least_path_direction

FOCAL_LENGTH = 1200.0


def quartic_direction(point: Array, normal: Array, distance: float, mu: float) -> Array:
    """Direction by the polynomial of flat refraction (Agrawal et al. 2012), its one admissible root.

    `u` is where the ray crosses the plane, over the point's distance from the axis. Snell's law squared:
    `u^2 ((1 - u)^2 rho^2 + h^2) = mu^2 (1 - u)^2 (d^2 + u^2 rho^2)`.
    """
    depth = float(point @ normal)
    radial = point - depth * normal
    r2, d2, h2 = radial @ radial, distance**2, (depth - distance) ** 2
    one = (1 - mu) * (1 + mu)
    polynomial = np.array([r2 * one, -2 * r2 * one, r2 * one + h2 - mu**2 * d2, 2 * mu**2 * d2, -(mu**2) * d2])
    # On the axis the first coefficients vanish, and dividing by them overflows.
    roots = np.roots(np.where(abs(polynomial) < 1e-30 * abs(polynomial).max(), 0, polynomial))
    real = roots[abs(roots.imag) < 1e-9 * abs(roots)].real
    (u,) = real[(real > 0) & (real < 1)]
    direction = distance * normal + u * radial
    return np.asarray(direction / np.linalg.norm(direction))


def unit(vector: Any) -> Array:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector)


def seen_at_angle(angle: Array, normal: Array, distance: float, layers: Layers, last: float, rng: Any) -> Array:
    """(n, 3) points that are seen at `angle` from the normal (radians), `last` behind the walls: Snell's law."""
    across = np.cross(normal, rng.normal(size=(len(angle), 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    radius = distance * np.tan(angle)
    for h, mu in zip([*layers.thickness, last], layers.index, strict=True):
        radius = radius + h * np.tan(np.arcsin(np.sin(angle) / mu))
    return np.asarray((distance + sum(layers.thickness) + last) * normal + radius[:, None] * across)


def pixel_error(a: Array, b: Array) -> float:
    """Largest difference of unit vectors, in px on the optical axis: the lens does not matter here."""
    return float(FOCAL_LENGTH * np.abs(a - b).max())


TILTED = unit([0.3, -0.2, 0.9])
# Angles from the normal, normal, distance of the plane, index, height of the water.
REGIMES = {
    "axis": (np.array([1e-12, 1e-9, 1e-6, 1e-4]), [0, 0, 1], 1.0, 1.333, 1.5),
    "oblique": (np.linspace(0.1, 1.2, 20), [0, 0, 1], 1.0, 1.333, 1.5),
    "tilted": (np.linspace(0.01, 1.2, 20), TILTED, 0.7, 1.333, 2.0),
    "grazing": (np.radians([85.0, 88, 89, 89.5]), TILTED, 1.0, 1.333, 1.5),
    "index near 1": (np.linspace(0.01, 1.2, 20), TILTED, 1.0, 1 + 1e-7, 1.5),
    "dense": (np.linspace(0.01, 1.2, 20), TILTED, 1.0, 2.4, 1.5),
    "water to air": (np.linspace(0.01, 0.8, 20), TILTED, 1.0, 1 / 1.333, 1.5),
    "plane at the camera": (np.linspace(0.01, 1.2, 20), TILTED, 1e-6, 1.333, 1.5),
    "point near the plane": (np.linspace(0.01, 1.2, 20), TILTED, 1.0, 1.333, 1e-3),
}


@pytest.mark.parametrize("regime", REGIMES)
def test_least_path_agrees_with_the_quartic(regime: str) -> None:
    angle, normal, distance, mu, last = REGIMES[regime]
    points = seen_at_angle(angle, unit(normal), distance, Layers(index=(mu,)), last, np.random.default_rng(0))
    found = least_path_direction(points, unit(normal), distance, Layers(index=(mu,)))
    expected = np.array([quartic_direction(point, unit(normal), distance, mu) for point in points])
    assert pixel_error(found, expected) < 1e-9


@pytest.mark.parametrize("thickness", [(), (0.02,), (1e-9, 0.3)])
@pytest.mark.parametrize("regime", [*REGIMES, "point at the plane"])
def test_a_point_is_seen_where_its_ray_was_sent_from(regime: str, thickness: tuple[float, ...]) -> None:
    # The quartic has a double root at the plane and says little there.
    at_plane = (np.linspace(0.01, 1.2, 20), TILTED, 1.0, 1.333, 1e-9)
    angle, normal, distance, mu, last = REGIMES.get(regime, at_plane)
    layers = Layers(thickness=thickness, index=(*(1.52,) * len(thickness), mu))
    points = seen_at_angle(angle, unit(normal), distance, layers, last, np.random.default_rng(0))
    found = least_path_direction(points, unit(normal), distance, layers)
    sine = np.linalg.norm(np.cross(found, unit(normal)), axis=1)
    # The points are rounded to 1e-16 of their size, which is 1e-13 of a grazing ray's height.
    np.testing.assert_allclose(np.arctan2(sine, found @ unit(normal)), angle, rtol=1e-12, atol=1e-15)


@settings(max_examples=100, deadline=None)
@given(
    point=st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(0.1, 20)),
    slope=st.tuples(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7)),
    ratio=st.floats(0.01, 0.99),
    mu=st.floats(0.6, 2.5),
)
def test_least_path_agrees_with_the_quartic_anywhere(
    point: tuple[float, float, float], slope: tuple[float, float], ratio: float, mu: float
) -> None:
    normal = unit([*slope, 1.0])
    depth = float(np.dot(point, normal))
    if depth < 0.05 * np.linalg.norm(point):  # about 87 degrees; the grazing regime has its own test
        return
    found = least_path_direction([point], normal, ratio * depth, Layers(index=(mu,)))
    assert pixel_error(found[0], quartic_direction(np.array(point), normal, ratio * depth, mu)) < 1e-9


@pytest.mark.parametrize("index", [(1.52, 1.49, 1.333), (1.333, 1.0, 1.52), (0.9, 1.1, 0.8)])
def test_snell_holds_at_every_interface(index: tuple[float, ...]) -> None:
    rng = np.random.default_rng(1)
    normals = np.array([unit([*rng.uniform(-0.4, 0.4, 2), 1]) for _ in range(200)])
    layers = Layers(thickness=(0.02, 0.3), index=index)
    points = rng.uniform([-2, -2, 2.5], [2, 2, 5], (200, 3))
    distance = rng.uniform(0.01, 1.0, 200)
    ray = least_path_direction(points, normals, distance, layers)

    position, before = distance[:, None] / np.einsum("ij,ij->i", ray, normals)[:, None] * ray, 1.0
    for thickness, after in zip([*layers.thickness, None], layers.index, strict=True):
        # The component along the plane, times the index, is what Snell's law keeps.
        tangential = before / after * (ray - np.einsum("ij,ij->i", ray, normals)[:, None] * normals)
        ray = tangential + np.sqrt(1 - np.sum(tangential**2, axis=1))[:, None] * normals
        before = after
        if thickness is not None:
            position = position + thickness / np.einsum("ij,ij->i", ray, normals)[:, None] * ray
    miss = np.linalg.norm(np.cross(points - position, ray), axis=1)
    assert miss.max() < 1e-12


def test_without_refraction_the_ray_is_straight() -> None:
    points = np.random.default_rng(2).uniform([-5, -5, 1], [5, 5, 3], (500, 3))
    straight = points / np.linalg.norm(points, axis=1, keepdims=True)
    # One rounding of a unit vector is 1.3e-13 px.
    for layers in (Layers(index=(1.0,)), Layers(thickness=(0.1, 0.2), index=(1.0, 1.0, 1.0))):
        assert pixel_error(least_path_direction(points, TILTED, 0.3, layers), straight) < 5e-12


def test_points_in_front_of_the_plane_are_seen_straight() -> None:
    points = np.array([[0.5, 0.2, 0.9], [0.5, 0.2, 1.0], [0.5, 0.2, -1.0]])
    found = least_path_direction(points, [0, 0, 1], 1.0, Layers())
    assert pixel_error(found, points / np.linalg.norm(points, axis=1, keepdims=True)) < 1e-12


def test_a_wall_counts_as_far_as_the_point_is_behind_it() -> None:
    point, normal = np.array([[0.5, 0.2, 1.05]]), np.array([0, 0, 1])
    inside = least_path_direction(point, normal, 1.0, Layers(thickness=(0.1,), index=(1.52, 1.333)))
    assert pixel_error(inside, least_path_direction(point, normal, 1.0, Layers(index=(1.52,)))) < 1e-12
    no_wall = least_path_direction(point, normal, 1.0, Layers(thickness=(0.0,), index=(1.52, 1.333)))
    assert pixel_error(no_wall, least_path_direction(point, normal, 1.0, Layers())) < 1e-12


def test_distance_must_be_positive() -> None:
    with pytest.raises(RefractError, match="distance"):
        least_path_direction([[0, 0, 1]], [0, 0, 1], 0.0, Layers())


def test_every_point_in_a_batch_has_its_own_plane() -> None:
    rng = np.random.default_rng(3)
    points, distance = rng.uniform([-1, -1, 2], [1, 1, 3], (20, 3)), rng.uniform(0.1, 1, 20)
    normals = np.array([unit([*rng.uniform(-0.3, 0.3, 2), 1]) for _ in range(20)])
    batch = least_path_direction(points, normals, distance, Layers())
    single = [least_path_direction(*each, Layers())[0] for each in zip(points, normals, distance, strict=True)]
    assert pixel_error(batch, np.array(single)) < 1e-12
    assert least_path_direction(np.empty((0, 3)), TILTED, 1.0, Layers()).shape == (0, 3)
