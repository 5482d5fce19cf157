"""The output folder: what is written to it appears whole or not at all."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from colmap_refract.errors import RefractError, reason_of
from colmap_refract.files.model_files import MODEL_FILES
from colmap_refract.files.sidecar import SIDECAR_NAME
from colmap_refract.files.surface_files import SURFACES_NAME, foreign_file

POINT_STD_NAME = "point_std.csv"
"""The table of the points' standard deviations that some commands write beside a model."""
MODEL_AND_COMPANIONS = (*MODEL_FILES, SIDECAR_NAME, POINT_STD_NAME, SURFACES_NAME)
WORK_PREFIX = ".colmap_refract-"  # of the temporary folders of `output_folder`
# The user's to put right, wherever in the block they turn up.
DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


@contextmanager
def output_folder(
    path: str | Path,
    *,
    input_path: str | Path | None,
    overwrite: bool,
    own_files: Collection[str] = MODEL_AND_COMPANIONS,
) -> Iterator[Path]:
    """A temporary folder whose files appear in `path` all together, and only if the block ends without an exception.

    A `path` that does not exist is made by one rename. In a folder that exists, what an earlier run wrote is moved
    aside before the new files are moved in, so that no reader ever finds a mixture, and deleted at last; until then
    whatever goes wrong puts it back. Whatever else is in the folder stays.

    Args:
        path: folder to be written; its parents are made as needed.
        input_path: folder of what is read, such as the model to be refined, which must not be altered; None if there is
            none to mistake it for.
        overwrite: whether a folder that is not empty may be written to.
        own_files: names that go when they are not written anew. By default a model's in both its forms, and what is
            written beside it: of one that stays beside the other, readers would take it or be confused.

    Yields:
        An empty folder on the same disk.

    Raises:
        RefractError: `path` is the input, is a file, is not empty without `overwrite`, has a folder in the place of a
            file, has files of another origin in its folder of surfaces, or cannot be written to. In the block: the
            disk is full.
    """
    path = Path(path)
    try:
        target = path.resolve()  # through a link, which stays
        _check_output(path, target, input_path, overwrite, own_files)
        missing = [parent for parent in target.parents if not parent.exists()]
    except (OSError, RuntimeError) as error:
        raise _cannot_write(path, error) from error
    exists = target.is_dir()
    # Beside or inside the target: the disk is the same, so that files need only be renamed.
    work = (target if exists else target.parent) / f"{WORK_PREFIX}{uuid4().hex[:12]}"
    new, old = work / "new", work / "old"
    done = False
    try:
        try:
            new.mkdir(parents=True)
        except OSError as error:
            raise _cannot_write(path, error) from error
        try:
            yield new
        except OSError as error:
            if error.errno in DISK_ERRORS or str(work) in str(error.filename):
                raise _cannot_write(path, error) from error
            raise
        try:
            _sync(new)
            if exists:
                _exchange(new, target, old, own_files)
            else:
                os.rename(new, target)
            done = True
            _sync_names(target.parent)
            _sync_names(target)
        except OSError as error:
            raise _cannot_write(path, error) from error
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if done:
            shutil.rmtree(old, ignore_errors=True)
        # Only what is empty: files that could not be put back are kept in `old`.
        for folder in [old, work, *([] if done else missing)]:
            with suppress(OSError):
                folder.rmdir()


def _check_output(
    path: Path, target: Path, input_path: str | Path | None, overwrite: bool, own_files: Collection[str]
) -> None:
    if input_path is not None:
        source = Path(input_path).resolve()
        if target == source or (target.exists() and source.exists() and target.samefile(source)):
            raise RefractError(f"the output folder {path} is the input; choose another, the input is never altered")
    if not target.exists():
        return
    if not target.is_dir():
        raise RefractError(f"the output {path} is a file; choose a folder")
    # What a killed run left does not count.
    if not overwrite and any(not inside.name.startswith(WORK_PREFIX) for inside in target.iterdir()):
        raise RefractError(
            f"the output folder {path} is not empty; choose another, or have what an earlier run wrote replaced "
            "(--overwrite 1)"
        )
    foreign = foreign_file(target) if SURFACES_NAME in own_files else None
    if foreign is not None:
        raise RefractError(
            f"{path / foreign.relative_to(target)} was not written by an earlier run, and the folder "
            f"{SURFACES_NAME} would be replaced; move it away"
        )


def _cannot_write(path: Path, error: Exception) -> RefractError:
    return RefractError(
        f"cannot write to {path}: {reason_of(error)}; choose another folder, nothing was changed in this one"
    )


def _exchange(new: Path, target: Path, old: Path, own_files: Collection[str]) -> None:
    """Move what is old in `target` to `old` and what is in `new` to `target`, or nothing at all."""
    entering = sorted(os.listdir(new))
    moves = [(target / name, old / name) for name in sorted({*entering, *own_files}) if os.path.lexists(target / name)]
    for occupied, _ in moves:
        if occupied.is_dir() and not (new / occupied.name).is_dir() and occupied.name != SURFACES_NAME:
            raise RefractError(f"{occupied} is a folder where a file is to be written; move it away")
    moves += [(new / name, target / name) for name in entering]
    old.mkdir()
    try:
        for source, destination in moves:
            os.replace(source, destination)
    except BaseException:
        for source, destination in reversed(moves):
            # What was moved is put back; what was not has its source still.
            if not os.path.lexists(source):
                os.replace(destination, source)
        raise


def _sync(folder: Path) -> None:
    """Have the disk confirm every file: some report only now that they are full."""
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb+") as file:
                os.fsync(file.fileno())
    _sync_names(folder)


def _sync_names(folder: Path) -> None:
    # Not every system lets a folder be opened; the files are safe already.
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
