"""Frames in their order, from wherever they come: what a folder of images and a video have in common."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

from colmap_refract.errors import RefractError
from colmap_refract.files.output import DISK_ERRORS
from colmap_refract.photographs.images import Gray, list_images, read_gray


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One frame, as it is looked at."""

    index: int
    """From 0, in the source."""
    name: str
    """Of the image file that it is, or will be."""
    time: float | None
    """Seconds since the video's beginning; None for an image."""
    gray: Gray


class FrameSource(Protocol):
    """Frames that can be gone through more than once."""

    @property
    def path(self) -> Path:
        """Of the folder or video."""

    def count(self) -> int:
        """About how many frames there are."""

    def frames(self, step: int) -> Iterator[Frame]:
        """Every `step`-th frame, from the first on; they may be of several sizes."""

    def write(self, indices: Collection[int], folder: Path) -> None:
        """Image files of some frames, under their names."""


@dataclass(frozen=True)
class ImageFolder:
    """The images of a folder in the order of their names."""

    path: Path

    @cached_property
    def names(self) -> list[str]:
        """Those of `list_images`."""
        return list_images(self.path)

    def count(self) -> int:
        """Number of images."""
        return len(self.names)

    def frames(self, step: int) -> Iterator[Frame]:
        """Every `step`-th image.

        Raises:
            RefractError: an image cannot be read.
        """
        for index in range(0, len(self.names), step):
            name = self.names[index]
            yield Frame(index=index, name=name, time=None, gray=read_gray(self.path / name))

    def write(self, indices: Collection[int], folder: Path) -> None:
        """Copy files as they are, with the folders in their names.

        Raises:
            RefractError: a file cannot be read any more.
        """
        for index in indices:
            source, destination = self.path / self.names[index], folder / self.names[index]
            destination.parent.mkdir(parents=True, exist_ok=True)
            try:
                shutil.copyfile(source, destination)
            except OSError as error:
                if error.errno in DISK_ERRORS:
                    raise
                raise RefractError(f"the image {source} cannot be copied ({error.strerror}); look at it") from None
