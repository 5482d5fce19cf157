"""The database of a workspace: what is ours may be replaced, what was made elsewhere is added to only."""

from __future__ import annotations

import copy
import secrets
import shutil
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_refract.errors import RefractError, reason_of
from colmap_refract.reconstructor.calibration import Assignment
from colmap_refract.reconstructor.contents import Contents, camera_key
from colmap_refract.reconstructor.record import Photograph
from colmap_refract.reconstructor.workspace import Workspace

if TYPE_CHECKING:
    import pycolmap

FEATURES, MATCHES = "features", "matches"
"""The stages that fill it, as the record calls them."""


@dataclass(frozen=True, kw_only=True)
class Database:
    """The database of a workspace.

    Attributes:
        contents: what is in it now.
        ours: whether it was made here; others are added to, never altered or replaced.
        cameras: those of the calibration that differ from the database's, by camera id.
    """

    contents: Contents
    ours: bool
    cameras: Mapping[int, pycolmap.Camera] = field(default_factory=dict)


def check_images(path: Path, contents: Contents, photographs: Mapping[str, Photograph]) -> None:
    """Raise RefractError where a database made elsewhere is of other images."""
    strangers = [name for name in contents.image_id if name not in photographs]
    if strangers:
        others = f" and {len(strangers) - 1} more images" if len(strangers) > 1 else ""
        raise RefractError(
            f"{path} holds image '{strangers[0]}'{others} that the image folder lacks; give its own images, or move "
            "the database away"
        )
    for name, camera_id in contents.image_camera.items():
        size = contents.camera_size.get(camera_id)
        photograph = photographs[name]
        if size is not None and size != (photograph.width, photograph.height):
            raise RefractError(
                f"'{name}' has {photograph.width} x {photograph.height} pixels, {size[0]} x {size[1]} in {path}; give "
                "the images it was made from, or move the database away"
            )


def other_cameras(path: Path, contents: Contents, assignment: Assignment) -> dict[int, pycolmap.Camera]:
    """Calibrated cameras, by id in the database, that are not what the database says."""
    if not assignment.calibrated:
        return {}
    known = assignment.camera_of
    wanted: dict[int, pycolmap.Camera] = {}
    for name, camera_id in contents.image_camera.items():
        camera = known[name]
        if wanted.setdefault(camera_id, camera) is not camera:
            raise RefractError(f"{path} has one camera for images that different calibrated cameras took; match again")
    others = {}
    for camera_id, camera in wanted.items():
        if camera_key(camera) != contents.cameras.get(str(camera_id)):
            others[camera_id] = copy.deepcopy(camera)
            others[camera_id].camera_id = camera_id
    return others


def warn_of_intrinsics(workspace: Workspace, assignment: Assignment, *, ours: bool) -> None:
    """Say what intrinsics there are where none were given."""
    if assignment.calibrated:
        return
    camera = assignment.groups[0].camera
    source = "from EXIF" if camera.has_prior_focal_length else "1.2 times the longer side"
    workspace.watcher.warn(
        f"no --camera_path: the focal length is a guess ({camera.mean_focal_length():.0f} px, {source}), and depths "
        "are only as good as that; calibrate the camera in air"
        if ours
        else "no --camera_path: the intrinsics are the database's, and have to be from air"
    )


def put_database(workspace: Workspace, new: Path) -> None:
    """Put a database in the place of the workspace's, with a mark to know it by; nothing done with the old one counts.

    Raises:
        RefractError: it cannot be put there.
    """
    record, path = workspace.record, workspace.database_path
    mark = secrets.randbelow(2**31 - 1) + 1
    try:
        with closing(sqlite3.connect(new)) as connection:
            connection.execute(f"PRAGMA application_id = {mark:d}")
        for suffix in ("-wal", "-shm"):  # of a database that was interrupted: they would be read with the new one
            Path(f"{path}{suffix}").unlink(missing_ok=True)
        shutil.move(new, path)
    except (OSError, sqlite3.Error) as error:
        raise RefractError(
            f"cannot write {path}: {reason_of(error)}; make room, or give another database_path"
        ) from error
    record.database_mark = mark
    record.stages.pop(FEATURES, None)
    record.stages.pop(MATCHES, None)
    record.write()
