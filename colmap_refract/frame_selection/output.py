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
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

import cv2

from colmap_refract.errors import RefractError
from colmap_refract.files.output import WORK_PREFIX, output_folder
from colmap_refract.frame_selection.plot import plot
from colmap_refract.frame_selection.report import FORMAT, to_json
from colmap_refract.frame_selection.selection import Selection
from colmap_refract.photographs.frames import FrameSource

IMAGES, LIST, FIGURES, PLOT = "images", "image_list.txt", "selection.json", "selection.png"
OLD = "old"
OWN = (IMAGES, LIST, FIGURES, PLOT)


@contextmanager
def selection_folder(path: Path, *, source_path: Path, overwrite: bool) -> Iterator[Path]:
    """A temporary folder whose files appear in `path` all together, and only if the block ends without an exception.

    Of a folder that exists, an earlier choice is replaced; whatever else is in it stays.

    Args:
        path: folder to be written; its parents are made as needed.
        source_path: of the images' folder or the video, which must not be altered.
        overwrite: whether a folder that is not empty may be written to.

    Yields:
        An empty folder on the same disk.

    Raises:
        RefractError: `path` is in the way of the source, is a file, is not empty without `overwrite`, holds images
            that no earlier choice wrote, or cannot be written to. In the block: the disk is full.
    """
    try:
        target = path.resolve()
        occupied = _check(path, target, source_path.resolve(), overwrite)
    except (OSError, RuntimeError) as error:
        raise RefractError(f"cannot write to {path} ({error}); choose another folder") from None
    if not occupied:
        with output_folder(path, input_path=None, overwrite=False) as folder:
            yield folder
        return
    # Inside the target: the disk is the same, so that what is in it need only be renamed.
    staged = target / f"{WORK_PREFIX}{uuid4().hex[:12]}"
    with output_folder(staged, input_path=None, overwrite=False) as folder:
        yield folder
    try:
        _exchange(staged, target)
    except OSError as error:
        raise RefractError(
            f"cannot write to {path} ({error.strerror}); choose another folder, nothing was changed in this one"
        ) from None
    finally:
        for name in OWN:
            _remove(staged / name)
        # Only what is empty: files that could not be put back are kept in `old`.
        for emptied in (staged / OLD, staged):
            with suppress(OSError):
                emptied.rmdir()


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


def _check(path: Path, target: Path, source: Path, overwrite: bool) -> bool:
    """Whether there is something in the target, which may be replaced."""
    images = target / IMAGES
    # The images' folder may neither be written into nor be replaced.
    if source in (target, images) or source in target.parents or images in source.parents:
        raise RefractError(f"the output folder {path} would be mixed with the input {source}; choose another")
    if not target.exists():
        return False
    if not target.is_dir():
        raise RefractError(f"the output {path} is a file; choose a folder")
    # What a killed run left does not count.
    if not any(not inside.name.startswith(WORK_PREFIX) for inside in target.iterdir()):
        return False
    if not overwrite:
        raise RefractError(
            f"the output folder {path} is not empty; choose another, or have the choice in it replaced (--overwrite 1)"
        )
    foreign = _foreign(target)
    if foreign:
        raise RefractError(f"{path / foreign} was not written by an earlier choice; choose another output folder")
    return True


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


def _exchange(new: Path, target: Path) -> None:
    """Replace an old choice in `target` by that in `new`, or change nothing at all."""
    old = new / OLD
    moves = [(target / name, old / name) for name in OWN if os.path.lexists(target / name)]
    moves += [(new / name, target / name) for name in OWN]
    old.mkdir()
    try:
        for source, destination in moves:
            os.rename(source, destination)
    except BaseException:
        for source, destination in reversed(moves):
            # What was moved is put back; what was not has its source still.
            if not os.path.lexists(source):
                os.rename(destination, source)
        raise
    for name in OWN:
        _remove(old / name)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
