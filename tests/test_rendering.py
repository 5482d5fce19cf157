"""Rendered images show what light would: rays by Snell's law, against paths of least time, and pixels against both.

What this does not prove: that pictures look like those of a real camera; nor anything of light that takes more than
one way, which is left out.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.optimize import brentq

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers, plane_in_cam
from colmap_refract.simulation import least_path_direction
from colmap_refract.simulation.rendering import Look, develop, radiance, render
from colmap_refract.simulation.surface import Surface, Wave, surface_at
from colmap_refract.simulation.terrain import Terrain, flat_board, hilly_ground
from colmap_refract.simulation.texture import Texture, srgb_decoding, srgb_encoded, stony_texture
from colmap_refract.simulation.view import View, project, trace

GENTLE = (
    Wave(amplitude=0.002, wavelength=0.6, direction_deg=20),
    Wave(amplitude=0.0008, wavelength=0.3, direction_deg=100, phase_deg=50),
)
WALL = Layers(thickness=(0.02, 0.01), index=(1.52, 1.49, 1.34))
SURFACES = {
    "level": surface_at([0, 0, 1], 1.0),
    "tilted": surface_at([0.15, -0.1, 1], 0.9),
    "walls": surface_at([0.1, 0.1, 1], 0.1, layers=WALL),
    "wavy": surface_at([0.03, 0.02, 1], 1.0, waves=GENTLE),
}
GROUND = hilly_ground([-3, -3], [3, 3], 2.4, relief=0.5, hill_size=1.2, seed=3)
UNLIT = Look(subsamples=1, ambient=1.0, exposure=1.0)


def camera(**changed: Any) -> pycolmap.Camera:
    """A distorted camera of 240 x 180 px; `focal_length` may be changed."""
    made = pycolmap.Camera.create_from_model_name(1, "OPENCV", changed.get("focal_length", 190.0), 240, 180)
    made.params = [*made.params[:2], 123.0, 88.0, -0.12, 0.05, 0.002, -0.001]
    return made


def view(surface: Surface, turn: tuple[float, float, float] = (0.2, -0.15, 0.4), **changed: Any) -> View:
    rotation = pycolmap.Rotation3d(np.array(turn)).matrix()
    center = np.array([0.1, -0.2, 0.05])
    return View(
        camera=camera(**changed), cam_from_world=np.column_stack([rotation, -rotation @ center]), surface=surface
    )


def pixels(count: int = 300) -> Array:
    return np.random.default_rng(5).uniform([0, 0], [240, 180], (count, 2))


@pytest.mark.parametrize("name", SURFACES)
def test_project_finds_the_pixels_that_trace_began_with(name: str) -> None:
    """Snell's law as vectors there, stationary time back."""
    taken = view(SURFACES[name])
    points, seen = trace(taken, GROUND, pixels())
    assert seen.all()
    assert points[:, 2] == pytest.approx(GROUND.height(points[:, :2]), abs=1e-10)
    # COLMAP's own undistortion ends at about 1e-9 px.
    assert project(taken, points) == pytest.approx(pixels(), abs=1e-7)
    assert project(taken, points, near=pixels() + 1) == pytest.approx(pixels(), abs=1e-7)


@pytest.mark.parametrize("name", ["level", "tilted", "walls"])
def test_flat_surfaces_agree_with_the_least_path(name: str) -> None:
    taken = view(SURFACES[name])
    points, _ = trace(taken, GROUND, pixels())
    r, t = taken.cam_from_world[:, :3], taken.cam_from_world[:, 3]
    plane = plane_in_cam(taken.surface.normal, taken.surface.offset, r, t)
    direction = least_path_direction(points @ r.T + t, *plane, taken.surface.layers)
    assert direction == pytest.approx(taken.camera.cam_ray_from_img(pixels()), abs=1e-10)
    # Refraction is there to be seen: without it the points would be elsewhere by many pixels.
    straight = taken.camera.img_from_cam(points @ r.T + t)
    assert np.abs(straight - pixels()).max() > 5


@pytest.mark.parametrize("amplitude", [0.002, 0.02])
def test_light_takes_stationary_time_through_waves(amplitude: float) -> None:
    """Fermat: moving the crossing along the surface changes the optical length in second order only."""
    waves = (replace(GENTLE[0], amplitude=amplitude), GENTLE[1])
    taken = view(surface_at([0.03, 0.02, 1], 1.0, waves=waves))
    places = pixels(40)
    points, seen = trace(taken, GROUND, places)
    assert seen.all()
    for ray, point in zip(taken.rays(places), points, strict=True):
        reach = brentq(lambda s, ray=ray: taken.surface.depth_below(taken.center + s * ray)[0], 0, 3, xtol=1e-14)
        crossing = taken.center + reach * ray

        def length(shift: Array, point: Array = point, crossing: Array = crossing) -> float:
            xy = crossing[:2] + shift
            on_surface = np.array([*xy, taken.surface.height(xy)[0]])
            return float(
                np.linalg.norm(on_surface - taken.center)
                + taken.surface.layers.refractive_index * np.linalg.norm(point - on_surface)
            )

        for axis in np.eye(2):
            slope = (length(1e-4 * axis) - length(-1e-4 * axis)) / 2e-4
            # The third derivative leaves 1e-8 x waves' k^2; straight rays would have a slope of 0.1.
            assert abs(slope) < 3e-5


def test_a_ray_ends_at_the_first_ground_it_meets() -> None:
    steep = hilly_ground([-4, -4], [4, 4], 2.2, relief=1.5, hill_size=0.7, roughness=0.3, seed=1)
    taken = view(surface_at([0, 0, 1], 0.3), turn=(0.8, 0.0, 0.0))
    points, seen = trace(taken, steep, pixels(150))
    assert seen.mean() > 0.5
    crossing = []
    for ray in taken.rays(pixels(150)):
        crossing.append(taken.center + (0.3 - taken.center[2]) / ray[2] * ray)
    hidden = 0
    for begin, end in zip(np.array(crossing)[seen], points[seen], strict=True):
        way = begin + np.linspace(0, 1, 400)[:, None] * (end - begin)
        assert (way[:-1, 2] < steep.height(way[:-1, :2])).all()
        beyond = end + np.linspace(0.01, 1, 200)[:, None] * (end - begin)
        hidden += bool((beyond[:, 2] < steep.height(beyond[:, :2])).any())
    # The question is not an empty one: some rays would come out behind a hill again.
    assert hidden > 3


def test_a_shore_is_seen_straight() -> None:
    slope = flat_board([-5, -5], [5, 5], 1.5, slope=(0.8, 0.0))
    taken = view(surface_at([0, 0, 1], 1.2, waves=GENTLE), turn=(0, 0, 0))
    points, seen = trace(taken, slope, pixels())
    dry = taken.surface.depth_below(points) < 0
    assert seen.all() and 20 < dry.sum() < 280
    straight = taken.camera.img_from_cam(points[dry] @ taken.cam_from_world[:, :3].T + taken.cam_from_world[:, 3])
    assert straight == pytest.approx(pixels()[dry], abs=1e-7)
    assert project(taken, points) == pytest.approx(pixels(), abs=1e-7)


def test_total_reflection_and_the_end_of_the_ground_show_nothing() -> None:
    """A camera in water that looks into air: no light beyond the critical angle."""
    board = flat_board([-50, -50], [50, 50], 2.0)
    taken = view(surface_at([0, 0, 1], 1.0, layers=Layers(index=(1 / 1.333,))), turn=(0.5, 0, 0))
    points, seen = trace(taken, board, pixels(2000))
    angle = np.degrees(np.arccos(taken.rays(pixels(2000))[:, 2]))
    critical = np.degrees(np.arcsin(1 / 1.333))
    assert seen[angle > critical + 0.01].sum() == 0 and (angle > critical).sum() > 50
    near = angle < critical - 2
    assert seen[near].all() and np.isnan(points[~seen]).all()

    small = flat_board([-0.2, -0.2], [0.3, 0.3], 2.0)
    points, seen = trace(view(SURFACES["level"]), small, pixels())
    assert 0 < seen.sum() < 200
    assert (points[seen, :2] >= -0.2).all() and (points[seen, :2] <= 0.3 + 1e-12).all()
    assert np.isnan(project(view(SURFACES["wavy"]), np.full((2, 3), np.nan))).all()


RADIUS = 0.025  # of the dots, metres


@cache
def dotted_board(count: int = 7, texel: float = 0.002) -> tuple[Texture, Array]:
    """Dark round dots, drawn by their formula, and their centres (n, 2)."""
    size = 1000
    x = texel * (np.arange(size) + 0.5) - 1.0
    steps = np.linspace(-0.75, 0.75, count)
    centers = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) + 0.013
    light = np.full((size, size), 0.8)
    for cx, cy in centers:
        away = np.hypot(x[None] - cx, x[:, None] - cy)
        light -= 0.7 * np.clip((RADIUS - away) / texel + 0.5, 0, 1)
    image = srgb_encoded(np.repeat(light[..., None], 3, axis=2))
    return Texture(image=image, origin=(-1.0, -1.0), texel=texel), centers


def center_of_mass(outline: Array) -> Array:
    """Of the area within a polygon (n, 2)."""
    (x, y), (u, v) = outline.T, np.roll(outline, -1, axis=0).T
    twice = x * v - u * y
    return np.array([np.sum((x + u) * twice), np.sum((y + v) * twice)]) / (3 * twice.sum())


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize(("subsamples", "blur"), [(1, 0.0), (2, 0.0), (3, 1.0)])
def test_dots_appear_where_they_are_projected(name: str, subsamples: int, blur: float) -> None:
    """Pixel origin, texel origin, levels of the pyramid, subsamples and blur: none moves anything."""
    texture, centers = dotted_board()
    board = flat_board([-1, -1], [1, 1], 1.9, slope=(0.1, -0.05))
    taken = view(SURFACES[name], focal_length=420.0)
    look = replace(UNLIT, subsamples=subsamples, blur=blur)
    light = srgb_decoding()[render(taken, board, texture, look)][:, :, 0].astype(float)
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    circle = RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    errors = []
    for center in centers:
        outline = project(taken, np.column_stack([center + circle, board.height(center + circle)]))
        # The dot is no circle in the image, and its centre not where that of the circle is seen.
        expected = center_of_mass(outline)
        if not ((expected > 12) & (expected < [228, 168])).all():
            continue
        column, row = (expected - 10).astype(int)
        dark = 0.8 - light[row : row + 21, column : column + 21]
        dark[dark < 0.02] = 0
        at = [np.sum(dark.sum(axis=axis) * (np.arange(21) + 0.5)) / dark.sum() for axis in (0, 1)]
        errors.append([column, row] + np.array(at) - expected)
    assert len(errors) >= 6
    # Measured: 0.009 px at most, from 8-bit values and the grain of single rays; in the mean, less than 0.003 px.
    assert np.abs(errors).max() < 0.02
    # A systematic shift would be an error; half a pixel is fifty times what is allowed.
    assert np.abs(np.mean(errors, axis=0)).max() < 0.01


def test_fine_patterns_fade_to_their_mean_light() -> None:
    """A chequerboard far finer than a pixel is grey: no aliasing, and means are of light, not of its encoding."""
    image = np.zeros((1024, 1024, 3), dtype=np.uint8)
    image[np.add.outer(np.arange(1024), np.arange(1024)) % 2 == 0] = 255
    texture = Texture(image=image, origin=(-3.0, -3.0), texel=6 / 1024 / 8)
    whole = replace(texture, texel=6 / 1024)
    board = flat_board([-3, -3], [3, 3], 2.4)
    fine = radiance(view(SURFACES["level"], turn=(0, 0, 0)), board, whole, UNLIT)[60:120, 80:160]
    assert fine.mean() == pytest.approx(0.5, abs=0.02)
    assert fine.std() < 0.1


def test_a_picture_is_determined_by_its_seed_alone() -> None:
    texture = stony_texture([-3, -3], [3, 3], texel=0.02, seed=4)
    again = stony_texture([-3, -3], [3, 3], texel=0.02, seed=4)
    other = stony_texture([-3, -3], [3, 3], texel=0.02, seed=5)
    assert np.array_equal(texture.image, again.image) and not np.array_equal(texture.image, other.image)
    look = Look(shot_noise=0.02, blur=0.5, vignetting=0.5, sky=(0.1, 0.2, 0.3), veil=(0.0, 0.1, 0.1))
    taken = view(SURFACES["wavy"])
    first = render(taken, GROUND, texture, look, seed=1, num_threads=1)
    assert first.shape == (180, 240, 3) and first.dtype == np.uint8
    assert np.array_equal(first, render(taken, GROUND, texture, look, seed=1, num_threads=3))
    assert not np.array_equal(first, render(taken, GROUND, texture, look, seed=2))
    # And it is a picture: bright and dark, at neighbouring pixels as well.
    assert first.std() > 10 and np.abs(np.diff(first[:, :, 1].astype(int), axis=1)).mean() > 3


def test_water_takes_light_by_its_length_and_gives_its_own() -> None:
    texture = Texture(image=np.full((16, 16, 3), 188, dtype=np.uint8), origin=(-3.0, -3.0), texel=0.4)
    board = flat_board([-3, -3], [3, 3], 2.4)
    taken = view(SURFACES["level"])
    grid = np.stack(np.meshgrid(np.arange(240) + 0.5, np.arange(180) + 0.5), axis=-1).reshape(-1, 2)
    points, seen = trace(taken, board, grid)
    ray = taken.rays(grid)
    crossing = taken.center + ((1.0 - taken.center[2]) / ray[:, 2])[:, None] * ray
    path = np.linalg.norm(points - crossing, axis=1).reshape(180, 240)
    assert seen.all() and np.ptp(path) > 0.05
    white = float(srgb_decoding()[188])
    rates, veil = (0.5, 0.1, 0.0), (0.0, 0.2, 0.3)
    light = radiance(taken, board, texture, replace(UNLIT, attenuation=rates, veil=veil))
    for c in range(3):
        passed = np.exp(-rates[c] * path)
        assert light[:, :, c] == pytest.approx(white * passed + veil[c] * (1 - passed), abs=1e-6)
    darker = radiance(taken, board, texture, replace(UNLIT, attenuation=(1.0, 0.2, 0.0)))
    assert (darker[:, :, :2] < light[:, :, :2]).all()


def test_the_sky_is_reflected_by_fresnel() -> None:
    """Straight down, (mu - 1)^2 / (mu + 1)^2 = 2.04 % of it."""
    texture = Texture(image=np.zeros((16, 16, 3), dtype=np.uint8), origin=(-3.0, -3.0), texel=0.4)
    taken = view(SURFACES["level"], turn=(0, 0, 0))
    light = radiance(taken, flat_board([-3, -3], [3, 3], 2.4), texture, replace(UNLIT, sky=(1.0, 0.0, 0.5)))
    assert light[88, 122] == pytest.approx(np.array([1, 0, 0.5]) * (0.333 / 2.333) ** 2, rel=1e-3)
    assert light[0, 0, 0] > light[88, 122, 0]


@pytest.mark.parametrize("level", [0.1, 0.6])
def test_sensor_noise_is_as_asked(level: float) -> None:
    look = Look(shot_noise=0.05, read_noise=0.01, colour_cast=(1.0, 1.0, 0.5))
    light = np.full((300, 300, 3), level)
    taken = srgb_decoding()[develop(light, look, seed=3)].astype(float)
    for c, gain in enumerate(look.colour_cast):
        sigma = np.sqrt(0.05**2 * gain * level + 0.01**2)
        # 9e4 samples know their standard deviation to 0.25 %; rounding to 8 bits adds less than 1 %.
        assert taken[:, :, c].std() == pytest.approx(sigma, rel=0.02)
        assert taken[:, :, c].mean() == pytest.approx(gain * level, abs=0.001)


def test_the_ground_is_smooth_and_its_slope_bounded() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-2.9, 2.9, (20_000, 2))
    step = 1e-6
    for k, axis in enumerate(np.eye(2)):
        rise = (GROUND.height(places + step * axis) - GROUND.height(places - step * axis)) / (2 * step)
        assert GROUND.gradient(places)[:, k] == pytest.approx(rise, abs=1e-7)
    steepest = np.linalg.norm(GROUND.gradient(places), axis=1).max()
    assert 0.2 < steepest <= GROUND.ground[6]
    assert GROUND.height(places).min() >= GROUND.top
    assert np.ptp(GROUND.heights) == pytest.approx(0.5, abs=1e-6)
    tilted = flat_board([-1, 0], [2, 1], 3.0, slope=(0.2, -0.1))
    assert tilted.height([[0.5, 0.5], [1.5, 0.5]]) == pytest.approx([3.0, 3.2], abs=1e-12)


def test_what_cannot_be_rendered_is_told() -> None:
    texture, _ = dotted_board()
    waves = (Wave(amplitude=0.02, wavelength=0.4, phase_deg=-90),)
    for surface in (surface_at([0, 0, 1], -0.1), surface_at([0, 0, 1], 0.01, waves=waves)):
        sunk = View(camera=camera(), cam_from_world=np.eye(3, 4), surface=surface)
        with pytest.raises(RefractError, match="below the surface"):
            render(sunk, GROUND, texture)
        with pytest.raises(RefractError, match="below the surface"):
            trace(sunk, GROUND, pixels())
    for bad, match in [
        ({"subsamples": 0}, "subsamples"),
        ({"blur": -1.0}, "blur"),
        ({"attenuation": (0.1, -0.1, 0.0)}, "attenuation"),
        ({"ambient": 1.5}, "ambient"),
        ({"sun_direction": (0.0, 0.0, 0.0)}, "sun_direction"),
        ({"exposure": np.nan}, "exposure"),
    ]:
        with pytest.raises(RefractError, match=match):
            Look(**bad)  # type: ignore[arg-type]
    with pytest.raises(RefractError, match="8-bit RGB"):
        Texture(image=np.zeros((3, 3), dtype=np.uint8), origin=(0, 0), texel=1)
    with pytest.raises(RefractError, match="too large"):
        stony_texture([0, 0], [1e4, 1e4], texel=0.01)
    with pytest.raises(RefractError, match="2 x 2"):
        Terrain(heights=np.zeros((1, 5)), origin=(0, 0), spacing=1)
    with pytest.raises(RefractError, match="hilly ground"):
        hilly_ground([0, 0], [1, 1], 2.0, relief=-1, hill_size=1)
