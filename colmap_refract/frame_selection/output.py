"""The files of a choice of frames, written whole or not at all.

    images/            the chosen frames: COLMAP's image_path
    image_list.txt     their names, one per line
    selection.json     all figures of all frames, what was chosen and why
    selection.png      the same as a picture

The images have a folder of their own, since COLMAP takes every picture in `image_path` for one of the scene.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from colmap_refract.errors import RefractError
from colmap_refract.files.output import output_folder
from colmap_refract.frame_selection.plot import plot
from colmap_refract.frame_selection.report import FORMAT, to_json
from colmap_refract.frame_selection.selection import Selection
from colmap_refract.photographs.frames import FrameSource

IMAGES, LIST, FIGURES, PLOT = "images", "image_list.txt", "selection.json", "selection.png"
OWN = (IMAGES, LIST, FIGURES, PLOT)


@contextmanager
def selection_folder(path: Path, *, source_path: Path, overwrite: bool) -> Iterator[Path]:
    """A temporary folder whose files appear in `path` as those of `output_folder` do, in place of an earlier choice.

    Args:
        path: folder to be written; its parents are made as needed.
        source_path: of the images' folder or the video, which must not be altered.
        overwrite: whether a folder that is not empty may be written to.

    Yields:
        An empty folder on the same disk.

    Raises:
        RefractError: as `output_folder`, or `path` is in the way of the source or holds images that no earlier choice
            wrote.
    """
    try:
        _check(path, source_path.resolve(), overwrite)
    except (OSError, RuntimeError) as error:
        raise RefractError(f"cannot write to {path} ({error}); choose another folder") from None
    with output_folder(path, input_path=None, overwrite=overwrite, own_files=OWN) as folder:
        yield folder


def write_selection(selection: Selection, source: FrameSource, folder: Path) -> None:
    """Write the chosen images and what is to be known of them into an empty folder.

    Args:
        selection: the choice.
        source: what it was made from.
        folder: of `selection_folder`.

    Raises:
        RefractError: a frame cannot be read any more.
    """
    images = folder / IMAGES
    images.mkdir()
    source.write([frame.index for frame in selection.chosen], images)
    names = "".join(f"{frame.name}\n" for frame in selection.chosen)
    (folder / LIST).write_text(names, encoding="utf-8")
    (folder / FIGURES).write_text(to_json(selection), encoding="utf-8")
    (folder / PLOT).write_bytes(cv2.imencode(".png", plot(selection))[1].tobytes())


def _check(path: Path, source: Path, overwrite: bool) -> None:
    target = path.resolve()
    images = target / IMAGES
    # The images' folder may neither be written into nor be replaced.
    if source in (target, images) or source in target.parents or images in source.parents:
        raise RefractError(f"the output folder {path} would be mixed with the input {source}; choose another")
    foreign = _foreign(target) if overwrite and target.is_dir() else ""
    if foreign:
        raise RefractError(f"{path / foreign} was not written by an earlier choice; choose another output folder")


def _foreign(target: Path) -> str:
    """A file in the place of ours that no earlier choice wrote, or nothing."""
    try:
        earlier = json.loads((target / FIGURES).read_text(encoding="utf-8"))
        written = set(earlier["chosen"]) if earlier["format"] == FORMAT else None
    except (OSError, ValueError, KeyError, TypeError):
        written = None
    for name in OWN:
        place = target / name
        if os.path.lexists(place) and (written is None or place.is_symlink() or place.is_dir() != (name == IMAGES)):
            return name
    for inside in (target / IMAGES).rglob("*"):
        name = inside.relative_to(target / IMAGES).as_posix()
        if not inside.is_dir() and name not in (written or ()):
            return f"{IMAGES}/{name}"
    return ""
