"""Image files, read as COLMAP reads them: raw pixels, whatever the orientation that EXIF asks for."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.photographs.silence import silence

Gray: TypeAlias = NDArray[np.uint8]
"""Shape (H, W), 0 is black."""

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".jpe", ".png", ".bmp", ".tif", ".tiff", ".ppm", ".pgm", ".pnm", ".webp"})
"""Formats that both COLMAP and OpenCV read; WebP only where COLMAP was built with it."""


def list_images(folder: Path) -> list[str]:
    """Names of the images in a folder and below it.

    Args:
        folder: as COLMAP's `image_path`.

    Returns:
        Paths relative to `folder` with '/', sorted: COLMAP's image names. Hidden files and folders are left out.

    Raises:
        RefractError: there is no such folder, it cannot be read, or it holds no image.
    """
    if not folder.exists():
        raise RefractError(f"there is no folder {folder}; give the folder that holds the images")
    if not folder.is_dir():
        raise RefractError(f"{folder} is a file; give the folder that holds the images")
    try:
        below = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
        next(folder.iterdir(), None)  # rglob passes over a folder that it may not read
    except OSError as error:
        raise RefractError(f"the folder {folder} cannot be read ({error.strerror}); give another") from None
    names = sorted(
        path.as_posix()
        for path in below
        if path.suffix.lower() in IMAGE_SUFFIXES and not any(part.startswith(".") for part in path.parts)
    )
    if not names:
        raise RefractError(f"{folder} holds no image ({', '.join(sorted(IMAGE_SUFFIXES))}); give the folder of images")
    return names


def read_gray(path: Path) -> Gray:
    """The grey values of an image file, (H, W), 16-bit and floating-point images scaled to 8 bit.

    Raises:
        RefractError: the file cannot be read.
    """
    return _to_8_bit(_decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH))


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """The colours of an image file, (H, W, 3) RGB, 16-bit and floating-point images scaled to 8 bit.

    Raises:
        RefractError: the file cannot be read.
    """
    bgr = _to_8_bit(_decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH))
    return np.ascontiguousarray(bgr[..., ::-1])


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, pixels, as stored. Decodes the file: it is known to be sound afterwards.

    Raises:
        RefractError: the file cannot be read.
    """
    height, width = _decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH).shape
    return width, height


def check_images(folder: Path, names: Iterable[str]) -> dict[tuple[int, int], list[str]]:
    """Read every image, and say which are of which size.

    Args:
        folder: that of the images.
        names: relative to `folder`.

    Returns:
        Names by (width, height), in the order given; the size of most images first.

    Raises:
        RefractError: a file cannot be read.
    """
    by_size: dict[tuple[int, int], list[str]] = {}
    for name in names:
        by_size.setdefault(image_size(folder / name), []).append(name)
    return dict(sorted(by_size.items(), key=lambda item: -len(item[1])))


def common_size(by_size: dict[tuple[int, int], list[str]]) -> tuple[int, int]:
    """The one size of all images of `check_images`, (width, height).

    Raises:
        RefractError: there are several; the message names an image of each of two.
    """
    if not by_size:
        raise RefractError("there is no image; give some")
    (size, names), *others = by_size.items()
    if others:
        other, other_names = others[0]
        raise RefractError(
            f"the images are not all of one size: '{names[0]}' has {size[0]} x {size[1]} pixels, '{other_names[0]}' "
            f"has {other[0]} x {other[1]}; give images of one camera"
        )
    return size


def shrink(gray: Gray, side: int) -> Gray:
    """A copy (H, W) or (H, W, 3) whose longer side has `side` pixels, each the mean of those that it covers.

    A smaller picture stays as it is.
    """
    scale = side / max(gray.shape[:2])
    if scale >= 1:
        return gray
    height, width = (max(1, round(length * scale)) for length in gray.shape[:2])
    return np.asarray(cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _decode(path: Path, flags: int) -> NDArray[Any]:
    # cv2.imread takes no path with letters that the system's encoding lacks.
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise RefractError(f"the image {path} cannot be read ({error.strerror}); remove or replace it") from None
    try:
        with silence():  # the error below says it in one line
            image = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    except cv2.error:
        image = None
    if image is None:
        raise RefractError(f"the image {path} cannot be decoded; remove or replace it")
    return np.asarray(image)


def _to_8_bit(image: NDArray[Any]) -> NDArray[np.uint8]:
    if image.dtype == np.uint8:
        return image
    white = 1.0 if np.issubdtype(image.dtype, np.floating) else np.iinfo(image.dtype).max
    scale = 255.0 / white
    return np.asarray(np.clip(np.rint(np.nan_to_num(image) * scale), 0, 255), np.uint8)
