"""The surface's waves: a sum of sinusoids that travel as gravity waves do.

What this does not prove: that rays meet the surface where it is. That is for the tests of the rendering.
"""

from __future__ import annotations

import numpy as np
import pytest

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers
from colmap_refract.simulation.surface import Surface, Wave, surface_at

WAVES = (
    Wave(amplitude=0.02, wavelength=0.9, direction_deg=30, phase_deg=10),
    Wave(amplitude=0.007, wavelength=0.31, direction_deg=-80, phase_deg=200),
)


def places(count: int = 200) -> Array:
    return np.random.default_rng(1).uniform(-3, 3, (count, 2))


@pytest.mark.parametrize("normal", [[0, 0, 1.0], [0.1, -0.2, 1.0]])
def test_the_height_is_the_plane_and_its_sinusoids(normal: list[float]) -> None:
    surface = surface_at(normal, 0.8, waves=WAVES)
    x, y = places().T
    unit = np.array(normal) / np.linalg.norm(normal)
    expected = (0.8 - unit[0] * x - unit[1] * y) / unit[2]
    for wave in WAVES:
        direction = np.radians(wave.direction_deg)
        along = x * np.cos(direction) + y * np.sin(direction)
        expected += wave.amplitude * np.sin(2 * np.pi * along / wave.wavelength + np.radians(wave.phase_deg))
    assert surface.height(places()) == pytest.approx(expected, abs=1e-13)
    on_surface = np.column_stack([x, y, expected])
    assert surface.depth_below(on_surface) == pytest.approx(0, abs=1e-13)
    assert (surface.depth_below(on_surface + [0, 0, 0.01]) > 0).all()


def test_slopes_and_curvatures_are_derivatives() -> None:
    surface, step = surface_at([0.1, -0.2, 1.0], 0.8, waves=WAVES), 1e-5
    for axis in np.eye(2):
        k = int(axis[1])
        rise = (surface.height(places() + step * axis) - surface.height(places() - step * axis)) / (2 * step)
        assert surface.gradient(places())[:, k] == pytest.approx(rise, abs=1e-7)
        bend = (surface.gradient(places() + step * axis) - surface.gradient(places() - step * axis)) / (2 * step)
        assert surface.curvature(places())[:, :, k] == pytest.approx(bend, abs=1e-6)


def test_rms_slope_is_that_of_many_places() -> None:
    surface = surface_at([0, 0, 1], 1.0, waves=WAVES)
    many = np.random.default_rng(2).uniform(-500, 500, (200_000, 2))
    sampled = np.sqrt(np.mean(np.sum(surface.gradient(many) ** 2, axis=1)))
    # The mean of 2e5 squares is known to about 0.3 %.
    assert surface.rms_slope == pytest.approx(sampled, rel=0.01)
    assert surface.rms_slope > 0.1
    assert surface_at([0, 0, 1], 1.0).rms_slope == 0


@pytest.mark.parametrize("water_depth", [np.inf, 0.05])
def test_crests_travel_with_the_speed_of_gravity_waves(water_depth: float) -> None:
    wave = Wave(amplitude=0.01, wavelength=2.0, direction_deg=60)
    # Deep: c = sqrt(g L / 2 pi). Shallow: c = sqrt(g h), here to (k h)^2 / 6 = 0.4 %.
    speed = np.sqrt(9.81 * 2.0 / (2 * np.pi)) if water_depth == np.inf else np.sqrt(9.81 * water_depth)
    assert wave.wavelength / wave.period(water_depth) == pytest.approx(speed, rel=0.005)
    time = 0.37
    moved = wave.wavelength / wave.period(water_depth) * time * np.array([np.cos(np.pi / 3), np.sin(np.pi / 3)])
    before = surface_at([0, 0, 1], 1.0, waves=(wave,), water_depth=water_depth)
    after = surface_at([0, 0, 1], 1.0, waves=(wave,), water_depth=water_depth, time=time)
    assert after.height(places() + moved) == pytest.approx(before.height(places()), abs=1e-12)
    assert np.abs(after.height(places()) - before.height(places())).max() > 0.005


def test_what_cannot_be_is_told() -> None:
    for amplitude, wavelength, match in [(0.1, 0, "wavelength"), (-0.1, 1, "negative"), (0.2, 1, "break")]:
        with pytest.raises(RefractError, match=match):
            Wave(amplitude=amplitude, wavelength=wavelength)
    with pytest.raises(RefractError, match="wall"):
        surface_at([0, 0, 1], 1.0, layers=Layers(thickness=(0.01,), index=(1.5, 1.33)), waves=WAVES)
    with pytest.raises(RefractError, match="from above"):
        surface_at([1, 0, 0], 1.0, waves=WAVES)
    with pytest.raises(RefractError, match="not the normal"):
        surface_at([0, 0, 0], 1.0)
    with pytest.raises(RefractError, match="time"):
        surface_at([0, 0, 1], 1.0, time=np.nan)
    assert Surface(normal=np.array([1.0, 0, 0]), offset=1.0, waves=np.empty((0, 4))).depth_below([2, 0, 0]) == 1
