"""Surfaces through heights at nodes: what they are between the nodes, where rays meet them, what is seen through them.

What this does not prove: that a refinement finds the right heights.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import error_of
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from colmap_refract.estimator.optics import project_direction
from colmap_refract.estimator.wavy_projection import project_through_surface
from colmap_refract.files.sidecar import ImageInterface, Sidecar
from colmap_refract.interface import Array, Layers, plane_in_cam, tangent_basis
from colmap_refract.refiner.held_out import predict_directions
from colmap_refract.simulation import SceneOptions, simulate
from colmap_refract.simulation.surface import Surface
from colmap_refract.simulation.wave_path import least_crossings, stationary_crossings
from colmap_refract.water_surface import WaterSurface, sampled

FLAT = np.eye(3)[:, :2]
Z = np.array([0.0, 0.0, 1.0])


def rough(spacing: float, length: float, count: int = 9) -> WaterSurface:
    """Heights at random, over a plane that is seen straight on."""
    rng = np.random.default_rng(4)
    x, y = spacing * np.arange(count), 0.7 + spacing * np.arange(count - 2)
    heights = 0.05 * rng.standard_normal((count - 2, count))
    return WaterSurface(axes=FLAT, x=x, y=y, heights=heights, correlation_length=length)


def waves(slope_deg: float, wavelengths: tuple[float, float], seed: int = 0, count: int = 6) -> Array:
    """Sinusoids (count, 4) of equal slope, as `Surface` has them, of some root mean square slope over both axes."""
    rng = np.random.default_rng(seed)
    number = 2 * np.pi / rng.uniform(*wavelengths, count)
    angle, phase = rng.uniform(0, 2 * np.pi, (2, count))
    amplitude = np.sqrt(2 / count) * np.tan(np.radians(slope_deg)) / number
    return np.column_stack([number * np.cos(angle), number * np.sin(angle), amplitude, phase])


def seen_from(
    surface: Surface, rotation: Array, translation: Array, wavelength: float, reach: float
) -> tuple[Array, float, WaterSurface]:
    """Plane and surface in a camera of a level surface of the world, with nodes around the camera's foot point."""
    normal, distance = plane_in_cam(surface.normal, surface.offset, rotation, translation)
    axes = tangent_basis(normal)

    def heights(places: Array) -> Array:
        in_cam = places @ axes.T + distance * normal
        return np.asarray(surface.height(((in_cam - translation) @ rotation)[:, :2]) - surface.offset)

    corners = reach * np.array([[-1.0, -1.0], [1.0, 1.0]])
    return normal, distance, sampled(heights, corners, axes=axes, correlation_length=wavelength / (np.sqrt(2) * np.pi))


def units(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@pytest.mark.parametrize("spacing", [0.8, 1.5, 4.0])
def test_kriging_of_a_grid_is_that_of_its_nodes(spacing: float) -> None:
    """Against one linear system with all nodes, which nodes this far apart allow; the axes are told apart."""
    surface = rough(spacing, 1.0)
    nodes = np.array([[x, y] for y in surface.y for x in surface.x])
    places = np.random.default_rng(0).uniform(-2, 8 * spacing + 2, (200, 2))

    def covariance(a: Array, b: Array) -> Array:
        return np.asarray(np.exp(-0.5 * ((a[:, None] - b[None]) ** 2).sum(axis=2)))

    expected = covariance(places, nodes) @ np.linalg.solve(covariance(nodes, nodes), surface.heights.ravel())
    # The condition number is 1e5 at most, and heights are of the order of a tenth.
    assert surface.height_and_slopes(places)[:, 0] == pytest.approx(expected, abs=1e-9)
    assert np.abs(expected).max() > 0.05
    assert surface.height_and_slopes(nodes)[:, 0] == pytest.approx(surface.heights.ravel(), abs=1e-10)


def test_slopes_are_derivatives() -> None:
    surface, step = rough(1.0, 1.0), 1e-5
    places = np.random.default_rng(1).uniform(0, 8, (300, 2))
    slopes = surface.height_and_slopes(places)[:, 1:]
    assert np.abs(slopes).max() > 0.05
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        before, after = (surface.height_and_slopes(places + sign * shift)[:, 0] for sign in (-1, 1))
        assert slopes[:, axis] == pytest.approx((after - before) / (2 * step), abs=1e-8)


def test_far_from_the_nodes_it_is_the_plane() -> None:
    surface = rough(1.0, 1.0)
    far = np.array([[-8.0, 3.0], [3.0, 16.0], [50.0, -50.0]])
    assert np.abs(surface.height_and_slopes(far)).max() < 1e-9
    assert surface.covers(far).tolist() == [False] * 3
    assert surface.covers(np.array([[0.0, 0.7], [8.0, 6.7], [8.0, 6.71], [np.nan, 3]])).tolist() == [
        True, True, False, False,
    ]  # fmt: skip


@pytest.mark.parametrize("spacing", [0.1, 0.2, 0.4])
@pytest.mark.parametrize("noise", [0.0, 1e-9])
def test_nodes_much_closer_than_the_correlation_length(spacing: float, noise: float) -> None:
    """Their covariance has no inverse in double precision: what is seen of it must neither break nor lose the wave."""
    x = np.arange(-3, 3 + spacing / 2, spacing)

    def wave(x: Array, y: Array) -> Array:
        return np.asarray(0.1 * np.sin(2 * np.pi * (0.8 * x + 0.6 * y) / 4.4))

    heights = wave(x, x[:, None]) + noise * np.random.default_rng(0).standard_normal((len(x), len(x)))
    surface = WaterSurface(axes=FLAT, x=x, y=x, heights=heights, correlation_length=1.0)
    places = np.random.default_rng(1).uniform(-2, 2, (500, 2))
    at = surface.height_and_slopes(places)
    # A thousandth of an amplitude of the wave is far below what can be seen of it.
    assert at[:, 0] == pytest.approx(wave(*places.T), abs=1e-5)
    phase = 2 * np.pi * (places @ [0.8, 0.6]) / 4.4
    assert at[:, 1] == pytest.approx(0.1 * 2 * np.pi / 4.4 * 0.8 * np.cos(phase), abs=1e-4)


def test_other_units() -> None:
    surface = replace(rough(1.0, 1.0), slope_deviation=0.1)
    larger = surface.scaled(2.5)
    places = np.random.default_rng(1).uniform(-1, 9, (50, 2))
    expected = surface.height_and_slopes(places) * [2.5, 1, 1]
    assert larger.height_and_slopes(2.5 * places) == pytest.approx(expected, abs=1e-10)
    assert larger.slope_deviation == 0.1 and larger != surface
    assert larger.scaled(0.4).heights == pytest.approx(surface.heights)
    assert surface.scaled(1.0) == surface and surface != "surface"


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_local_planes_are_where_rays_meet_the_surface(tilt: float) -> None:
    """Against a bracketed root along the ray, and a normal from differences."""
    rotation = Rotation.from_rotvec([tilt, -0.3 * tilt, 0.2]).as_matrix()
    surface = seen_from(Surface(normal=Z, offset=1.0, waves=waves(5, (0.5, 1))), rotation, np.zeros(3), 0.5, 2.0)
    normal, distance, wavy = surface
    rng = np.random.default_rng(0)
    direction = units(rng.uniform(-0.7, 0.7, (60, 3)) * [1, 1, 0] + [0, 0, 1]) @ rotation.T
    local, local_distance = wavy.local_planes(direction, normal, distance)

    def height(places: Array) -> Array:
        return wavy.height_and_slopes(places)[:, 0]

    moved = []
    for ray, n, d in zip(direction, local, local_distance, strict=True):

        def gap(reach: float, ray: Array = ray) -> float:
            return float(reach * ray @ normal - distance - height(reach * ray[None] @ wavy.axes)[0])

        reach = brentq(gap, 0.5 * distance, 3 * distance, xtol=1e-15, rtol=1e-14)
        # Both have the rounding of the heights, 1e-12 of the distance.
        assert d / (n @ ray) == pytest.approx(reach, rel=2e-12)
        place = reach * ray @ wavy.axes
        tangents = []
        for step in 1e-5 * np.eye(2):
            rise = np.diff(height(np.array([place - step, place + step])))[0]
            tangents.append(2 * wavy.axes @ step + rise * normal)
        expected = np.cross(*tangents)
        expected *= np.sign(expected @ normal) / np.linalg.norm(expected)
        assert n == pytest.approx(expected, abs=1e-7)
        moved.append(np.linalg.norm(n - normal))
    assert np.median(moved) > 0.05


def test_rays_that_do_not_meet_the_surface() -> None:
    wavy = rough(1.0, 1.0)
    direction = np.array([[1.0, 0, 0], [0, 0, -1], [0.6, 0, -0.8], [np.nan, 0, 0], [0, 0, 1]])
    local, distance = wavy.local_planes(direction, Z, 2.0)
    assert np.isnan(local).all(axis=1).tolist() == np.isnan(distance).tolist() == [True] * 4 + [False]
    # A crest that reaches beyond the camera hides the surface from it.
    high = WaterSurface(axes=FLAT, x=np.zeros(1), y=np.zeros(1), heights=np.array([[-3.0]]), correlation_length=9.0)
    assert np.isnan(high.local_planes(direction[4:], Z, 2.0)[1]).all()


def test_sampled_reaches_beyond_and_keeps_to_a_number_of_nodes() -> None:
    """Many sinusoids of wavelengths within a factor of two, all over the places."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (1000, 2)) * [1, 0.7]
    for wavelength in (0.3, 1.0, 3.0):
        true = Surface(normal=Z, offset=0.0, waves=waves(5, (0.7 * wavelength, 1.4 * wavelength), count=40))
        length = wavelength / (np.sqrt(2) * np.pi)
        wavy = sampled(true.height, places, axes=FLAT, correlation_length=length, slope_deviation=0.1)
        assert wavy.correlation_length == pytest.approx(length) and wavy.slope_deviation == 0.1
        assert wavy.covers(places).all()
        wrong = wavy.height_and_slopes(places)[:, 1:] - true.gradient(places)
        # Of a root mean square slope of 0.087. A fraction of that turns the light by a quarter as much.
        assert np.abs(wrong).max() < 5e-4
    wide = sampled(true.height, places, axes=FLAT, correlation_length=0.001)
    assert wide.heights.size < 11_000 and wide.correlation_length > 0.02


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"axes": np.eye(3)}, "orthonormal"),
    ({"axes": 2 * FLAT}, "orthonormal"),
    ({"x": np.array([0.0, 2.0, 1.0])}, "increasing"),
    ({"x": np.array([0.0, 1.0, np.nan])}, "increasing"),
    ({"x": np.array([0.0, 1.0, 1.0])}, "increasing"),
    ({"y": np.empty(0)}, "increasing"),
    ({"heights": np.zeros((3, 2))}, r"shape (3, 2)"),
    ({"heights": np.full((2, 3), np.inf)}, "finite"),
    ({"correlation_length": 0.0}, "not positive"),
    ({"slope_deviation": -1.0}, "negative"),
]


@pytest.mark.parametrize(("change", "expected"), WRONG)
def test_what_is_no_surface_is_told(change: dict[str, Any], expected: str) -> None:
    right: dict[str, Any] = {
        "axes": FLAT, "x": np.arange(3.0), "y": np.arange(2.0), "heights": np.zeros((2, 3)), "correlation_length": 1.0,
    }  # fmt: skip
    WaterSurface(**right)
    assert expected in error_of(lambda: WaterSurface(**{**right, **change}))


POSES = [
    (np.eye(3), np.zeros(3)),
    (Rotation.from_rotvec([0.25, -0.2, 1.0]).as_matrix(), np.array([0.1, 0.2, -0.05])),
]


@pytest.mark.parametrize(("rotation", "translation"), POSES)
@pytest.mark.parametrize("layers", [Layers(), Layers(index=(1.5,))])
@pytest.mark.parametrize(("slope", "wavelengths"), [(2.0, (1.0, 2.5)), (4.0, (1.0, 2.0))])
def test_points_are_seen_where_light_takes_the_least_time(
    rotation: Array, translation: Array, layers: Layers, slope: float, wavelengths: tuple[float, float]
) -> None:
    """Swell, from half a metre above it, over deep water."""
    surface = Surface(normal=Z, offset=0.5, layers=layers, waves=waves(slope, wavelengths))
    normal, distance, wavy = seen_from(surface, rotation, translation, wavelengths[0], 1.0)
    rng = np.random.default_rng(2)
    points = rng.uniform([-2, -2, 0.65], [2, 2, 2.5], (300, 3))
    center = -rotation.T @ translation
    crossing = least_crossings(surface, center, points)
    in_cam = points @ rotation.T + translation
    near = wavy.covers((crossing @ rotation.T + translation) @ wavy.axes)
    assert near.sum() > 200
    expected = units(crossing - center)[near] @ rotation.T
    direction = project_through_surface(in_cam[near], normal, distance, layers, wavy)
    # Nodes leave 1e-6 of the slopes open, where none is beyond the rim; the pixels of a good camera see 1e-4.
    assert np.median(np.linalg.norm(direction - expected, axis=1)) < 2e-6
    assert np.linalg.norm(direction - expected, axis=1).max() < 2e-4
    flat = project_direction(in_cam[near], normal, distance, layers)
    assert np.median(np.linalg.norm(flat - expected, axis=1)) > 3e-3


def test_flat_and_dry() -> None:
    flat = WaterSurface(axes=FLAT, x=np.arange(4.0), y=np.arange(3.0), heights=np.zeros((3, 4)), correlation_length=1.0)
    points = np.random.default_rng(0).uniform([-1, -1, 0.2], [1, 1, 3], (100, 3))
    walls = Layers(thickness=(0.1,), index=(1.5, 1.33))
    for layers in (Layers(), walls):
        expected = project_direction(points, Z, 1.0, layers)
        assert project_through_surface(points, Z, 1.0, layers, flat) == pytest.approx(expected, abs=1e-13)
    # Between the mean plane and the surface: in the crest under water, in the trough above it.
    wavy = replace(flat, heights=np.array([[0.0] * 4, [-0.3, -0.3, 0.3, 0.3], [0.0] * 4]))
    points = np.array([[0.3, 1.0, 0.85], [2.6, 1.0, 1.15]])
    direction = project_through_surface(points, Z, 1.0, Layers(), wavy)
    assert np.linalg.norm(direction - units(points), axis=1) == pytest.approx([0, 0], abs=0.2)
    assert np.linalg.norm(direction[0] - units(points)[0]) > 1e-3
    assert direction[1] == pytest.approx(units(points)[1], abs=1e-15)


def test_ripples_that_show_a_point_several_times() -> None:
    """What is found is one of the paths that light takes; where the iteration does not settle, it says so."""
    surface = Surface(normal=Z, offset=0.5, waves=waves(6, (0.05, 0.1)))
    normal, distance, wavy = seen_from(surface, np.eye(3), np.zeros(3), 0.05, 0.3)
    points = np.random.default_rng(2).uniform([-0.5, -0.5, 1.5], [0.5, 0.5, 2], (200, 3))
    direction = project_through_surface(points, normal, distance, Layers(), wavy)
    found = np.isfinite(direction).all(axis=1)
    assert 20 < found.sum() < 180
    assert (np.isfinite(direction).any(axis=1) == found).all()
    local, local_distance = wavy.local_planes(direction[found], normal, distance)
    crossing = (local_distance / np.einsum("ni,ni->n", local, direction[found]))[:, None] * direction[found]
    inside = units(points[found] - crossing)
    # Snell's law, exact for the surface at hand.
    assert np.cross(direction[found], local) == pytest.approx(1.333 * np.cross(inside, local), abs=1e-10)
    # And for the sinusoids, but for what the nodes leave open: a stationary path is next to each that was found.
    stationary = stationary_crossings(surface, np.zeros(3), points[found], crossing[:, :2])
    apart = np.linalg.norm(stationary - crossing, axis=1)
    assert np.median(apart) < 1e-6


def test_a_refined_model_predicts_through_its_surfaces() -> None:
    """A capture over swell: its exact pixels, from the points, the planes and the surfaces."""
    capture = simulate(
        SceneOptions(
            scenario="moving_interface", num_images=3, num_points=150, depth=2.0, distance_ratio=0.3, tilt_deg=0.0,
            wave_slope_deg=2.0, wavelength=(1.0, 2.0),
        )
    )  # fmt: skip
    model = capture.reconstruction
    images = {}
    for image_id, image in model.images.items():
        pose, (normal, distance) = image.cam_from_world(), capture.planes[image_id]
        rotation, surface = pose.rotation.matrix(), capture.surfaces[image_id]
        assert surface.normal == pytest.approx(Z, abs=1e-12), "heights are along the plane's normal"
        _, _, wavy = seen_from(surface, rotation, pose.translation, 1.0, 1.5)
        images[image.name] = ImageInterface(
            image_id=image_id, normal_in_cam=tuple(normal.tolist()), distance=float(distance), surface=wavy
        )
    sidecar = Sidecar(scenario="moving_interface", layers=capture.layers, images=images)
    flat = replace(sidecar, images={name: replace(image, surface=None) for name, image in images.items()})
    for image_id, image in model.images.items():
        idxs = image.get_observation_point2D_idxs()
        points = np.array([model.point3D(image.point2D(idx).point3D_id).xyz for idx in idxs])
        assert len(points) > 50
        wrong = []
        for interfaces in (sidecar, flat):
            direction = predict_directions(model, interfaces, image_id, points)
            pixel = image.camera.img_from_cam(direction)
            wrong.append(np.linalg.norm(pixel - capture.pixels[image_id][idxs], axis=1))
        # A hundredth of a pixel, where waves move things by several.
        assert wrong[0].max() < 0.01
        assert np.median(wrong[1]) > 1
