"""Pictures that no camera took, but light could have: exact rays from every pixel to the ground.

A camera ray comes from pycolmap's own camera model, is bent at the surface it really meets by Snell's law, and ends
on the ground. What is left out: light that takes more than one way (reflections at the ground and below the
surface), caustics, and waves that hide each other; a ray that leaves the water again shows the veil.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array
from colmap_refract.machine import threads
from colmap_refract.simulation.terrain import Terrain
from colmap_refract.simulation.texture import Image, Texture, srgb_decoding, srgb_encoded
from colmap_refract.simulation.view import View, optics

Colour = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Look:
    """How light, water, lens and sensor make the picture; light from 0 to 1, full scale. Nothing by default."""

    subsamples: int = 2
    """A pixel is the mean of this number squared of rays, evenly spread over it."""
    exposure: float = 1.1
    """Light that a white ground under full light brings to the camera through clear water."""
    sun_direction: tuple[float, float, float] = (0.35, 0.25, -0.9)
    """Towards the sun, in the world (z down), as it falls on the ground."""
    ambient: float = 0.45
    """Part of the light that comes from everywhere."""
    attenuation: Colour = (0.0, 0.0, 0.0)
    """Of red, green and blue per metre of water between the ground and the surface."""
    veil: Colour = (0.0, 0.0, 0.0)
    """Light of water without end, which replaces what is attenuated; and of what is beyond the ground."""
    colour_cast: Colour = (1.0, 1.0, 1.0)
    """Gains of red, green and blue: a wrong white balance."""
    sky: Colour = (0.0, 0.0, 0.0)
    """Light of an even sky that the surface reflects (Fresnel, unpolarised)."""
    vignetting: float = 0.0
    """1: the light falls off by the fourth power of the cosine from the optical axis; 0: not at all."""
    blur: float = 0.0
    """Standard deviation of the lens's Gaussian blur, px."""
    shot_noise: float = 0.0
    """Standard deviation of a pixel at full scale; that of a darker one goes with the root of its light."""
    read_noise: float = 0.0
    """Standard deviation of a pixel without light."""

    def __post_init__(self) -> None:
        if not 1 <= self.subsamples <= 16:
            raise RefractError(f"subsamples {self.subsamples} is not from 1 to 16")
        for name in ("exposure", "attenuation", "veil", "colour_cast", "sky", "blur", "shot_noise", "read_noise"):
            for value in np.atleast_1d(getattr(self, name)).tolist():
                if not (np.isfinite(value) and value >= 0):
                    raise RefractError(f"{name} {value:g} is not a number >= 0")
        if not (0 <= self.ambient <= 1 and 0 <= self.vignetting <= 1):
            raise RefractError("ambient and vignetting are parts from 0 to 1")
        if not np.linalg.norm(self.sun_direction) > 0:
            raise RefractError(f"sun_direction {self.sun_direction} is not a direction")


def render(
    view: View,
    terrain: Terrain,
    texture: Texture,
    look: Look | None = None,
    *,
    seed: int | Sequence[int] = 0,
    num_threads: int = -1,
) -> Image:
    """The picture of a view.

    Args:
        view: camera, pose and surface.
        terrain, texture: the ground.
        look: light and sensor.
        seed: of the sensor's noise.
        num_threads: -1 for one per core.

    Returns:
        (H, W, 3) RGB, sRGB-encoded, the texel [row, column] centred at the pixel (column + 0.5, row + 0.5).

    Raises:
        RefractError: the camera is under its surface.
    """
    look = look if look is not None else Look()
    light = radiance(view, terrain, texture, look, num_threads=num_threads)
    return develop(light, look, seed=seed)


def radiance(view: View, terrain: Terrain, texture: Texture, look: Look, *, num_threads: int = -1) -> Array:
    """Linear light (H, W, 3) that comes to the pixels, before lens blur and sensor; the arguments are `render`'s."""
    from colmap_refract.simulation.painting import paint

    view.check()
    width, height, n = view.camera.width, view.camera.height, look.subsamples
    pyramid, levels = texture.pyramid
    sheet = np.array([*texture.origin, texture.texel])
    sun = np.array(look.sun_direction) / np.linalg.norm(look.sun_direction)
    step = (np.arange(n) + 0.5) / n
    columns = (np.arange(width)[:, None] + step).reshape(-1)
    middle = view.rays([[0.5 * width, 0.5 * height], [0.5 * width + 1, 0.5 * height]])
    angle = float(np.linalg.norm(middle[1] - middle[0]))
    light = np.empty((height, width, 3))
    media, center, ground = optics(view.surface), view.center, (terrain.top, terrain.coefficients, terrain.ground)

    def paint_rows(first: int) -> None:
        rows = range(first, min(first + rows_at_once, height))
        lines = (np.array(rows)[:, None] + step).reshape(-1)
        pixels = np.stack(np.meshgrid(columns, lines), axis=-1)
        directions = view.rays(pixels).reshape(len(rows), n, width, n, 3).transpose(0, 2, 1, 3, 4)
        paint(
            center,
            np.ascontiguousarray(directions).reshape(-1, n * n, 3),
            angle,
            view.cam_from_world[2, :3].copy(),
            *media,
            *ground,
            pyramid,
            levels,
            srgb_decoding(),
            sheet,
            sun,
            look.ambient,
            np.array(look.attenuation),
            # Of the ground's light, which the exposure then multiplies.
            np.array(look.veil) / max(look.exposure, 1e-12),
            np.array(look.sky) / max(look.exposure, 1e-12),
            look.vignetting,
            light[rows.start : rows.stop].reshape(-1, 3),
        )

    # Blocks of about a megabyte of rays: few enough calls, and little to wait for at the end.
    rows_at_once = max(1, 40_000 // (width * n * n))
    with ThreadPoolExecutor(threads(num_threads)) as pool:
        list(pool.map(paint_rows, range(0, height, rows_at_once)))
    return look.exposure * light


def develop(light: Array, look: Look, *, seed: int | Sequence[int] = 0) -> Image:
    """The picture (H, W, 3) that lens and sensor make of linear light (H, W, 3)."""
    from scipy.ndimage import gaussian_filter

    light = light * np.array(look.colour_cast)
    if look.blur > 0:
        light = gaussian_filter(light, (look.blur, look.blur, 0), mode="nearest")
    if look.shot_noise > 0 or look.read_noise > 0:
        rng = np.random.default_rng(seed)
        sigma = np.sqrt(look.shot_noise**2 * np.maximum(light, 0) + look.read_noise**2)
        light = light + sigma * rng.standard_normal(light.shape)
    return srgb_encoded(light)
