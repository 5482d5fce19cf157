"""What the ground looks like: a picture made by the program, rich at every scale, and its pyramid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array

Image = NDArray[np.uint8]

# Part of the ground that the stones of each octave of sizes would cover, if they did not cover each other.
STONY = 0.16
# Linear reflectances (red, green, blue) of dry sand and of the stones on it.
SAND = np.array([0.46, 0.39, 0.29])
STONES = np.array(
    [
        [0.30, 0.28, 0.26],
        [0.52, 0.49, 0.44],
        [0.15, 0.145, 0.14],
        [0.36, 0.28, 0.21],
        [0.26, 0.27, 0.25],
        [0.58, 0.52, 0.42],
        [0.29, 0.22, 0.18],
    ]
)


def srgb_decoding() -> NDArray[np.float32]:
    """Linear light (256,) from 0 to 1 of the values of an sRGB image (IEC 61966-2-1)."""
    value = np.arange(256) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def srgb_encoded(light: Array | NDArray[np.float32]) -> Image:
    """sRGB values of linear light, clipped to 0 ... 1 and rounded."""
    clipped: Array = np.clip(light, 0, 1)
    value = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * value), dtype=np.uint8)


@dataclass(frozen=True, kw_only=True)
class Texture:
    """A picture on the world's xy plane, seen from above by whatever height the ground has there.

    Beyond its edge the colour of the edge goes on.
    """

    image: Image
    """(H, W, 3) sRGB; columns along x and rows along y."""
    origin: tuple[float, float]
    """x and y of the outer corner of the texel [0, 0]."""
    texel: float
    """Metres; square."""

    def __post_init__(self) -> None:
        if self.image.ndim != 3 or self.image.shape[2] != 3 or self.image.dtype != np.uint8 or not self.image.size:
            raise RefractError(f"a texture is an 8-bit RGB image; got {self.image.dtype} of shape {self.image.shape}")
        if not self.texel > 0:
            raise RefractError(f"a texel of {self.texel:g} m is not positive")

    @cached_property
    def pyramid(self) -> tuple[Image, NDArray[np.int64]]:
        """Every level, each the 2 x 2 means (of linear light) of the one before, as one array.

        Returns:
            the texels of all levels behind each other, and per level (L, 3) where it begins, its height and width.
        """
        decode = srgb_decoding()
        level = self.image
        parts, table = [level.reshape(-1)], [[0, *level.shape[:2]]]
        while min(level.shape[:2]) >= 4:
            height, width = level.shape[0] // 2, level.shape[1] // 2
            quads = level[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3)
            mean = sum(decode[quads[:, i, :, j]] for i in (0, 1) for j in (0, 1)) * np.float32(0.25)
            level = srgb_encoded(np.asarray(mean))
            table.append([table[-1][0] + parts[-1].size, height, width])
            parts.append(level.reshape(-1))
        return np.concatenate(parts), np.array(table, dtype=np.int64)


def stony_texture(low: ArrayLike, high: ArrayLike, *, texel: float, seed: int = 0) -> Texture:
    """Sand with stones of all sizes, cracks in them and spots on them.

    Args:
        low, high: (2,) the x and y that it covers at least, metres.
        texel: metres. Stones have diameters of 2 to 160 texels.
        seed: determines it.

    Raises:
        RefractError: an area that is not positive, or that has more than 2^27 texels.
    """
    first, last = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if not ((last > first).all() and texel > 0):
        raise RefractError("a texture needs an area and a texel > 0")
    width, height = np.maximum(np.ceil((last - first) / texel), 16).astype(int).tolist()
    if width * height > 2**27:
        raise RefractError(f"a texture of {width} x {height} texels is too large; use a larger texel or a smaller area")
    rng = np.random.default_rng(seed)
    light = _sand(height, width, rng)
    _lay_stones(light, rng)
    grain = _noise(height, width, 0.35, rng)
    light *= np.exp(np.float32(0.10) * grain)[..., None]
    return Texture(image=srgb_encoded(light), origin=(float(first[0]), float(first[1])), texel=texel)


def _noise(height: int, width: int, power: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Noise of mean 0 and standard deviation 1 whose amplitude falls with the frequency to `power`."""
    from scipy import fft

    shape = [fft.next_fast_len(height, real=True), fft.next_fast_len(width, real=True)]
    spectrum = fft.rfft2(rng.standard_normal(shape, dtype=np.float32), workers=2)
    frequency = np.hypot(fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None]).astype(np.float32)
    frequency[0, 0] = np.inf
    noise = fft.irfft2(spectrum * frequency**-power, s=shape, workers=2)[:height, :width]
    return np.asarray((noise - noise.mean()) / noise.std(), dtype=np.float32)


def _sand(height: int, width: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """(H, W, 3) reflectance: brightness at all scales, the tint at the large ones."""
    bright = np.exp(0.35 * _noise(height, width, 1.0, rng))
    tint = _noise(height, width, 1.4, rng)
    colour = SAND * np.exp(tint[..., None] * np.array([0.04, 0.0, -0.05]))
    return np.asarray(bright[..., None] * colour, dtype=np.float32)


def _lay_stones(light: NDArray[np.float32], rng: np.random.Generator) -> None:
    """Stones of 1 to 80 texels of radius, each octave of which covers the same part of the ground."""
    from colmap_refract.simulation.stones import lay_stones

    height, width = light.shape[:2]
    # The small ones come first: of many that lie on a large stone nothing would be seen of it. A few do, at last.
    sizes = ((2.0, 1.0), (4.0, 1.0), (8.0, 1.0), (16.0, 1.0), (32.0, 1.0), (80.0, 1.0), (10.0, 0.12), (4.0, 0.12))
    for largest, part in sizes:
        mean_area = np.pi * (0.75 * largest) ** 2 * 0.8
        count = max(1, int(part * STONY * height * width / mean_area))
        shapes = rng.uniform(
            [0, 0, 0.5 * largest, 0, 0, 0.65, 0.03, 0.08, 0.0, 0],
            [width, height, largest, 2 * np.pi, 2 * np.pi, 1.0, 0.15, 0.25, 0.12, 1],
            (count, 10),
        )
        bright, tint = rng.lognormal(0, 0.3, (count, 1)), rng.lognormal(0, 0.04, (count, 3))
        colours = STONES[rng.integers(len(STONES), size=count)] * bright * tint
        speckle, veins = _noise(512, 512, 0.6, rng), np.abs(_noise(512, 512, 1.5, rng))
        lay_stones(light, shapes, colours, speckle, veins)
