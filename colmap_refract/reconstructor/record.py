"""What has been done in a workspace: `colmap_refract.json`, written whole after every step.

    {"format": "colmap_refract_workspace", "version": 1, "database_mark": number or null,
     "photographs": {name: {"bytes", "mtime_ns", "width", "height", "sha256"}},
     "stages": {name: {"inputs": {...}, "output": text or null, "facts": {...}}}}

A stage is recorded when it begins, without `output`, and again when it is complete. `output` is a fingerprint of
what it left: a stage counts as done while its inputs are the same and what it left is still there.
"""

from __future__ import annotations

import errno
import json
import os
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from uuid import uuid4

from colmap_refract.errors import RefractError

RECORD_NAME = "colmap_refract.json"
FORMAT = "colmap_refract_workspace"
VERSION = 1


@dataclass(frozen=True, kw_only=True)
class Photograph:
    """An image file as it was last read."""

    bytes: int
    mtime_ns: int
    width: int
    height: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Step:
    """A stage that was begun.

    Attributes:
        inputs: what decides the outcome, as JSON.
        output: fingerprint of what the stage left; None while it is not complete.
        facts: what the report says of it later.
    """

    inputs: dict[str, Any]
    output: str | None = None
    facts: dict[str, Any] = field(default_factory=dict)


class Record:
    """The record of a workspace, in memory and on disk.

    Attributes:
        lost: why an existing record could not be used; then nothing is known of what is in the workspace.
    """

    def __init__(self, workspace: Path) -> None:
        self._path = workspace / RECORD_NAME
        self.lost = ""
        self.database_mark: int | None = None
        self.photographs: dict[str, Photograph] = {}
        self.stages: dict[str, Step] = {}
        if os.path.lexists(self._path):
            try:
                self._load(json.loads(self._path.read_text(encoding="utf-8")))
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                self.database_mark, self.photographs, self.stages = None, {}, {}
                self.lost = (
                    f"{self._path} cannot be read ({error}); what is in the workspace is taken as made elsewhere"
                )

    def exists(self) -> bool:
        """Whether there is a file."""
        return os.path.lexists(self._path)

    def remove(self) -> None:
        """Delete the file, if there is one."""
        with suppress(OSError):
            self._path.unlink()

    def begin(self, stage: str, inputs: dict[str, Any]) -> None:
        """Note that a stage is under way; whatever it had done before may be half replaced."""
        self.stages[stage] = Step(inputs=inputs)
        self.write()

    def complete(self, stage: str, output: str, facts: dict[str, Any]) -> None:
        """Note what a stage has left."""
        self.stages[stage] = Step(inputs=self.stages[stage].inputs, output=output, facts=facts)
        self.write()

    def write(self) -> None:
        """Replace the file.

        Raises:
            RefractError: it cannot be written.
        """
        document = {
            "format": FORMAT,
            "version": VERSION,
            "database_mark": self.database_mark,
            "photographs": {name: asdict(photograph) for name, photograph in self.photographs.items()},
            "stages": {name: asdict(step) for name, step in self.stages.items()},
        }
        beside = self._path.with_name(f".{RECORD_NAME}-{uuid4().hex[:12]}")
        try:
            try:
                with beside.open("w", encoding="utf-8") as file:
                    json.dump(document, file, indent=1)
                    file.flush()
                    os.fsync(file.fileno())
                os.replace(beside, self._path)
            finally:
                beside.unlink(missing_ok=True)
        except OSError as error:
            reason = "the disk is full" if error.errno == errno.ENOSPC else error.strerror
            raise RefractError(f"cannot write {self._path}: {reason}; make room there, and run it again") from error

    def _load(self, document: dict[str, Any]) -> None:
        if (document["format"], document["version"]) != (FORMAT, VERSION):
            raise ValueError(f"format {document['format']!r}, version {document['version']!r}")
        mark = document["database_mark"]
        self.database_mark = None if mark is None else int(mark)
        self.photographs = {str(k): Photograph(**v) for k, v in document["photographs"].items()}
        self.stages = {str(k): Step(**v) for k, v in document["stages"].items()}


def differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Names of what differs between the inputs of a stage then and now, dotted where they are nested."""
    # As read from a file: lists for tuples.
    now = json.loads(json.dumps(now))
    found = []
    for key in sorted({*before, *now}):
        a, b = before.get(key), now.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            found += [f"{key}.{inner}" for inner in differences(a, b)]
        elif a != b:
            found.append(key)
    return found


def in_words(difference: str) -> str:
    """What the user knows a difference by: an option by its name on the command line."""
    first, _, rest = difference.partition(".")
    if first == "images":
        return f"the image '{rest}'"
    if first in _IN_WORDS:
        return _IN_WORDS[first]
    if first == "pairing":
        return "the choice of pairs"
    if first in ("matching", "options") and rest:
        return in_words(rest)
    if first == "verification" and rest:
        return in_words(rest) if rest.partition(".")[0] in _IN_WORDS else f"--TwoViewGeometry.{rest}"
    return f"--{difference}"


_IN_WORDS = {
    "cameras": "the intrinsics",
    "detector": "--matcher",
    "dry_images": "the list of dry images",
    "features": "the features",
    "fixed_camera": "--scenario",
    "interface_groups": "the interface groups",
    "matches": "the matches",
    "model": "the model without refraction",
    "random_seed": "--random_seed",
}
