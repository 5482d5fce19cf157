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

import numpy as np

from colmap_refract.errors import RefractError, reason_of
from colmap_refract.files.quiet import quiet_pycolmap
from colmap_refract.interface import Array
from colmap_refract.mapping.database import read_only
from colmap_refract.photographs.images import Gray, read_gray
from colmap_refract.reconstructor.calibration import Assignment
from colmap_refract.reconstructor.contents import Contents, camera_key
from colmap_refract.reconstructor.record import Photograph
from colmap_refract.reconstructor.workspace import Workspace

if TYPE_CHECKING:
    import pycolmap

FEATURES, MATCHES = "features", "matches"
"""The stages that fill it, as the record calls them."""

_LEAST_KEYPOINTS = 30
_PART = 1024
"""Pixels: side of the part of a picture that is looked at."""
_BESIDE = 12
"""Pixels: far from a keypoint, yet in surroundings like its own."""
_NEAR, _COLMAP_SIDE = 1.5, 3200
"""Pixels."""
_FOUND_AGAIN = 0.15
"""Part of the keypoints, over what is found by chance."""
_MORE_STRUCTURE = 0.6
"""Part of the keypoints; half by chance."""


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


def check_keypoints(workspace: Workspace, contents: Contents) -> None:
    """Warn where the keypoints of a database made elsewhere are not those of the pictures of the same names.

    Two images are looked at. Whatever found the keypoints: SIFT finds many of them again, or they lie where the
    picture has more structure than a little beside them.
    """
    names = [name for name, count in contents.num_keypoints.items() if count >= _LEAST_KEYPOINTS]
    for name in sorted({names[0], names[len(names) // 2]} if names else ()):
        with closing(read_only(workspace.database_path)) as connection:
            (count, columns, data) = connection.execute(
                "SELECT rows, cols, data FROM keypoints WHERE image_id = ?", (contents.image_id[name],)
            ).fetchone()
        keypoints = np.frombuffer(data, dtype=np.float32).reshape(count, columns)[:, :2].astype(np.float64)
        if not _belong(keypoints, read_gray(workspace.image_path / name)):
            workspace.watcher.warn(
                f"the keypoints of '{name}' do not look like those of the picture: is {workspace.database_path} the "
                "database of these images?"
            )
            return


def _belong(keypoints: Array, gray: Gray) -> bool:
    """Whether keypoints (n, 2), COLMAP's pixels, have to do with grey values (H, W)."""
    import pycolmap
    from scipy.ndimage import gaussian_filter, maximum_filter
    from scipy.spatial import cKDTree

    height, width = gray.shape
    corner = np.clip(np.median(keypoints, axis=0) - _PART / 2, 0, np.maximum([width - _PART, height - _PART], 0))
    left, top = corner.astype(int)
    part = np.ascontiguousarray(gray[top : top + _PART, left : left + _PART])
    size = np.array(part.shape[::-1])
    places = keypoints - [left, top]
    places = places[((places > _BESIDE) & (places < size - _BESIDE)).all(axis=1)]
    if len(places) < _LEAST_KEYPOINTS:
        return True  # too few to tell
    beside = [places + step for step in _BESIDE * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])]
    with quiet_pycolmap():
        extractor = pycolmap.FeatureExtractor.create(device=pycolmap.Device.cpu)
        found = np.array([(point.x, point.y) for point in extractor.extract_from_uint8_array(part)[0]])
    if len(found):
        tree = cKDTree(found)
        near = max(_NEAR, _NEAR * max(gray.shape) / _COLMAP_SIDE)  # COLMAP reduces larger pictures
        again, by_chance = (float(np.mean(tree.query(where)[0] < near)) for where in (places, np.concatenate(beside)))
        if again - by_chance > _FOUND_AGAIN:
            return True
    across, down = np.gradient(gaussian_filter(part.astype(np.float32), 1.0), axis=(1, 0))
    xx, xy, yy = (gaussian_filter(product, 2.0) for product in (across * across, across * down, down * down))
    # The smaller eigenvalue of the structure tensor.
    structure = maximum_filter((xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2), size=3)

    def at(where: Array) -> Array:
        x, y = np.floor(where).astype(int).T  # COLMAP's pixels: the first one's centre is (0.5, 0.5)
        return np.asarray(structure[y, x])

    here = at(places)
    more = np.mean([np.mean(here > at(where)) for where in beside])
    return bool(more > _MORE_STRUCTURE)


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
