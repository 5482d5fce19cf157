"""The photographs of a workspace: every file read once, so that none stops COLMAP an hour later."""

from __future__ import annotations

import hashlib
from pathlib import Path

from colmap_refract.errors import RefractError
from colmap_refract.photographs.images import common_size, image_size, list_images
from colmap_refract.reconstructor.record import Photograph, Record
from colmap_refract.reconstructor.watcher import Watcher

_STAGE = "Reading images"
_RECORD_EVERY = 200
"""Images; what was read before an interrupt need not be read again."""


def take_inventory(image_path: Path, record: Record, watcher: Watcher) -> dict[str, Photograph]:
    """The images in a folder by name, sorted; those that the record knows and that look the same are not read again.

    Raises:
        RefractError: there is none, only one, or one cannot be decoded.
    """
    names = list_images(image_path)
    if len(names) == 1:
        raise RefractError(f"{image_path} holds a single image, '{names[0]}'; give two or more of the same scene")
    known = record.photographs
    photographs: dict[str, Photograph] = {}
    fresh = 0
    for done, name in enumerate(names):
        path = image_path / name
        try:
            status = path.stat()
        except OSError as error:
            raise RefractError(f"the image {path} cannot be read ({error.strerror}); remove or replace it") from None
        before = known.get(name)
        if before is not None and (before.bytes, before.mtime_ns) == (status.st_size, status.st_mtime_ns):
            photographs[name] = before
            continue
        watcher.progress(_STAGE, done, len(names), "images")
        width, height = image_size(path)
        photographs[name] = Photograph(
            bytes=status.st_size, mtime_ns=status.st_mtime_ns, width=width, height=height, sha256=_sha256(path)
        )
        fresh += 1
        if fresh % _RECORD_EVERY == 0:
            record.photographs = {**known, **photographs}
            record.write()
    record.photographs = photographs
    if fresh or len(known) != len(photographs):
        record.write()
    return photographs


def by_size(photographs: dict[str, Photograph]) -> dict[tuple[int, int], list[str]]:
    """Names by (width, height), the size of most images first."""
    sizes: dict[tuple[int, int], list[str]] = {}
    for name, photograph in photographs.items():
        sizes.setdefault((photograph.width, photograph.height), []).append(name)
    return dict(sorted(sizes.items(), key=lambda item: -len(item[1])))


def only_size(photographs: dict[str, Photograph]) -> tuple[int, int]:
    """The one (width, height) of all images; raises RefractError where there are several."""
    return common_size(by_size(photographs))


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
