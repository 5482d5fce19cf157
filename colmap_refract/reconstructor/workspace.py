"""The folder that a reconstruction lives in, laid out as COLMAP's own."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

from colmap_refract.errors import RefractError
from colmap_refract.files.output import WORK_PREFIX
from colmap_refract.reconstructor.record import Record, Step, differences
from colmap_refract.reconstructor.watcher import Watcher


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """Where things are, and what is known of them.

    Attributes:
        path: the folder.
        database_path: usually `database.db` in it.
        image_path: folder of the photographs.
        record: what was done.
        watcher: who is told.
    """

    path: Path
    database_path: Path
    image_path: Path
    record: Record
    watcher: Watcher

    @property
    def sparse_path(self) -> Path:
        """COLMAP's models, 0, 1, ..., which ignore refraction."""
        return self.path / "sparse"

    @property
    def refractive_path(self) -> Path:
        """The refined model."""
        return self.path / "sparse_refractive" / "0"

    @property
    def log_path(self) -> Path:
        """What COLMAP logs."""
        return self.path / "log.txt"

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """A folder on the workspace's disk, for the length of a block."""
        folder = self.path / f"{WORK_PREFIX}{uuid4().hex[:12]}"
        try:
            try:
                folder.mkdir(parents=True)
            except OSError as error:
                raise RefractError(f"cannot write to {self.path}: {error.strerror}; give another workspace") from error
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """The workspace for this process alone; what a killed run left half-made is removed.

        Folders and a record that were made here go again if the block fails before any stage has begun.

        Raises:
            RefractError: it is a file, cannot be made, or another process is at work in it.
        """
        if self.path.exists() and not self.path.is_dir():
            raise RefractError(f"{self.path} is a file; give a folder")
        made = [folder for folder in (self.path, *self.path.absolute().parents) if not folder.exists()]
        known = self.record.exists()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            handle = os.open(self.path, os.O_RDONLY)
        except PermissionError as error:
            if os.name != "nt":
                raise RefractError(f"cannot write to {self.path}: {error.strerror}; give another workspace") from error
            handle = -1  # folders cannot be opened there, nor locked
        except OSError as error:
            raise RefractError(f"cannot write to {self.path}: {error.strerror}; give another workspace") from error
        try:
            if handle >= 0:
                _lock(handle, self.path)
            for left in self.path.glob(f"{WORK_PREFIX}*"):
                shutil.rmtree(left, ignore_errors=True)
            try:
                yield
            except BaseException as error:
                # What was read before an interrupt is of use to the next run.
                if isinstance(error, Exception) and not known:
                    self._forget()
                for folder in made:  # only what is empty
                    with suppress(OSError):
                        folder.rmdir()
                raise
        finally:
            if handle >= 0:
                os.close(handle)

    def _forget(self) -> None:
        """Remove the record, if no stage has begun, and a log without a word."""
        if self.record.stages or self.record.database_mark is not None:
            return
        self.record.remove()
        with suppress(OSError):
            if not self.log_path.stat().st_size:
                self.log_path.unlink()

    def changes(self, stage: str, inputs: dict[str, Any]) -> list[str] | None:
        """What differs in the inputs of a stage since it was begun; None if it never was."""
        step = self.record.stages.get(stage)
        return None if step is None else differences(step.inputs, inputs)

    def done(self, stage: str, inputs: dict[str, Any], output: str) -> Step | None:
        """The stage's record if it is complete, of the same inputs, and what it left is there still."""
        step = self.record.stages.get(stage)
        if step is None or step.output is None or step.output != output or self.changes(stage, inputs):
            return None
        return step


def _lock(handle: int, path: Path) -> None:
    try:
        import fcntl
    except ImportError:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RefractError(
            f"another reconstruction is at work in {path}; wait for it, or give another workspace"
        ) from None
    except OSError:
        return  # not every network disk locks


def replace_folder(new: Path, target: Path, aside: Path) -> None:
    """Put a folder in the place of another, which goes to `aside`; whatever goes wrong, the old one is back."""
    moved = False
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            os.rename(target, aside)
            moved = True
        os.rename(new, target)
    except BaseException as error:
        if moved and not target.exists():
            os.rename(aside, target)
        if isinstance(error, OSError):
            raise RefractError(f"cannot write {target}: {error.strerror}; make room there, and run it again") from error
        raise
