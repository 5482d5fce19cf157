"""A COLMAP database as arrays, and tracks written into one."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.files.quiet import quiet_pycolmap
from colmap_refract.interface import Array

if TYPE_CHECKING:
    import pycolmap

Index = NDArray[np.int64]

_TABLES = {"cameras", "images", "keypoints", "matches"}
"""What every COLMAP database has had from the first on."""


@dataclass(frozen=True, kw_only=True)
class Correspondences:
    """Keypoints of I images by C cameras, and matches of E image pairs.

    Attributes:
        image_ids, image_names: (I,) COLMAP's, ascending by id.
        image_camera: (I,) index into `camera_ids` and `cameras`.
        camera_ids: (C,).
        keypoints: per image (n, 2) float, px, COLMAP's pixel origin; the row is the `point2D_idx`.
        pairs: (E, 2) indices of images (not ids), the first with the lower id.
        matches: per pair (m, 2) `point2D_idx` in the first and in the second image.
    """

    image_ids: Index
    image_names: list[str]
    image_camera: Index
    camera_ids: Index
    cameras: list[pycolmap.Camera]
    keypoints: list[Array]
    pairs: Index
    matches: list[Index]

    @property
    def first_keypoint(self) -> Index:
        """(I + 1,) where the keypoints of each image begin when those of all images are counted through."""
        return np.concatenate([[0], np.cumsum([len(points) for points in self.keypoints])])


@contextmanager
def open_database(path: str | Path) -> Iterator[pycolmap.Database]:
    """An existing COLMAP database, as COLMAP itself opens it.

    COLMAP brings a database of an older version up to date when it opens it; nothing else is altered.

    Raises:
        RefractError: there is none at the path, or it is none of COLMAP's.
    """
    import pycolmap

    path = Path(path)
    check_database(path)
    try:
        with quiet_pycolmap():
            database = pycolmap.Database.open(path)
    except RuntimeError:
        raise RefractError(f"{path} cannot be opened as a COLMAP database: check that it can be written to") from None
    try:
        yield database
    finally:
        database.close()


@contextmanager
def read_database(path: str | Path, *, without: Collection[str] = ("descriptors",)) -> Iterator[pycolmap.Database]:
    """A temporary copy of a COLMAP database, which itself stays as it is, byte for byte.

    COLMAP alters every database that it opens: it brings it up to date, and turns on write-ahead logging.

    Args:
        path: the database.
        without: tables that are empty in the copy; the descriptors are the bulk.

    Raises:
        RefractError: there is none at the path, it is none of COLMAP's, or there is no room for the copy.
    """
    path = Path(path)
    check_database(path)
    with TemporaryDirectory(prefix="colmap_refract-") as folder:
        copy = Path(folder) / "database.db"
        copy_database(path, copy, without=without)
        with open_database(copy) as database:
            yield database


def read_only(path: Path) -> sqlite3.Connection:
    """A database in SQLite, to be read by this process alone; no files appear beside one that nobody is writing to."""
    return sqlite3.connect(_read_only_uri(path), uri=True)


def _read_only_uri(path: Path) -> str:
    path = path.resolve()
    # Of a database with write-ahead logging, SQLite leaves files for sharing behind if it may not write. They are
    # there while somebody else writes. Where they cannot be put beside a database, nobody can be writing to it.
    written = any(os.path.exists(f"{path}{suffix}") for suffix in ("-wal", "-journal"))
    shared = written and os.access(path.parent, os.W_OK)
    return f"{path.as_uri()}?{'mode=ro' if shared else 'immutable=1'}"


def copy_database(source: Path, copy: Path, *, without: Collection[str] = ("descriptors",)) -> None:
    """Copy a database to where none is; see `read_database`."""
    try:
        with closing(sqlite3.connect(copy.absolute().as_uri(), uri=True)) as connection:
            connection.execute("ATTACH ? AS source", (_read_only_uri(source),))
            tables = connection.execute(
                "SELECT name, sql FROM source.sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
            ).fetchall()
            for name, sql in tables:
                connection.execute(sql)
                if name not in without:
                    connection.execute(f'INSERT INTO main."{name}" SELECT * FROM source."{name}"')
            version = int(connection.execute("PRAGMA source.user_version").fetchone()[0])
            connection.execute(f"PRAGMA main.user_version = {version}")
            connection.commit()
    except (sqlite3.Error, OSError) as error:
        raise RefractError(
            f"{source} cannot be copied to {copy.parent} to be read ({error}); make room there"
        ) from None


def check_database(path: Path) -> None:
    """Raise RefractError unless there is a COLMAP database at the path; it is not altered."""
    if not os.path.lexists(path):
        raise RefractError(f"{path} does not exist: give the database.db of a COLMAP project")
    if not path.is_file():
        raise RefractError(f"{path} is no database file: give the database.db of a COLMAP project")
    try:
        with closing(read_only(path)) as connection:
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    except sqlite3.Error as error:
        raise RefractError(f"{path} cannot be read as a database ({error}); copy it again, or make a new one") from None
    if not tables >= _TABLES:
        missing = ", ".join(sorted(_TABLES - tables))
        raise RefractError(f"{path} is no COLMAP database, it has no table {missing}: give a COLMAP project's")


def read_correspondences(path: str | Path, *, verified: bool = True) -> Correspondences:
    """Keypoints and matches of a database.

    Args:
        path: a COLMAP database.
        verified: take the matches that passed the (refraction-ignoring) geometric verification; otherwise all.

    Raises:
        RefractError: no database, no images or keypoints in it, or matches of keypoints that it does not have.
    """
    with read_database(path) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.image_id)
        cameras = sorted(database.read_all_cameras(), key=lambda camera: camera.camera_id)
        if not images:
            raise RefractError(f"{path} holds no images: extract features first")
        keypoints = [np.asarray(database.read_keypoints(image.image_id), dtype=np.float64) for image in images]
        image_ids = np.array([image.image_id for image in images], dtype=np.int64)
        pairs, matches = _read_matches(database, image_ids, verified)
    keypoints = [points[:, :2] if points.size else np.zeros((0, 2)) for points in keypoints]
    if not any(len(points) for points in keypoints):
        raise RefractError(f"{path} holds no keypoints: extract features first")
    for (first, second), pair in zip(pairs, matches, strict=True):
        if (pair >= [len(keypoints[first]), len(keypoints[second])]).any():
            raise RefractError(
                f"{path} matches keypoints of {images[first].name} and {images[second].name} that it does not have; "
                "extract and match again"
            )
    camera_ids = np.array([camera.camera_id for camera in cameras], dtype=np.int64)
    return Correspondences(
        image_ids=image_ids,
        image_names=[image.name for image in images],
        image_camera=np.searchsorted(camera_ids, [image.camera_id for image in images]),
        camera_ids=camera_ids,
        cameras=cameras,
        keypoints=keypoints,
        pairs=pairs,
        matches=matches,
    )


def _read_matches(database: pycolmap.Database, image_ids: Index, verified: bool) -> tuple[Index, list[Index]]:
    import pycolmap

    if verified:
        pair_ids, geometries = database.read_two_view_geometries()
        found = [np.asarray(geometry.inlier_matches) for geometry in geometries]
    else:
        pair_ids, found = database.read_all_matches()
    pairs, matches = [], []
    for pair_id, pair in zip(pair_ids, found, strict=True):
        ids = pycolmap.pair_id_to_image_pair(pair_id)
        if len(pair) and np.isin(ids, image_ids).all():
            pairs.append(np.searchsorted(image_ids, ids))
            matches.append(np.asarray(pair, dtype=np.int64).reshape(-1, 2))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2), matches


def write_tracks(
    path: str | Path, keypoints: Mapping[str, Array], matches: Mapping[tuple[str, str], NDArray[np.integer]]
) -> None:
    """Put keypoints and verified matches, such as those of optical flow, into a database that holds images only.

    Args:
        path: a database with the images and their cameras, but with no keypoints of them yet.
        keypoints: per image name (n, 2) px, COLMAP's pixel origin.
        matches: per pair of names (m, 2) `point2D_idx`; they count as geometrically verified.

    Raises:
        RefractError: an image that the database does not hold, or one that has keypoints already.
    """
    import pycolmap

    with open_database(path) as database:
        image_id = {image.name: image.image_id for image in database.read_all_images()}
        for name in keypoints:
            if name not in image_id:
                raise RefractError(f"{path} does not hold image '{name}': import the images first")
            if database.exists_keypoints(image_id[name]):
                raise RefractError(
                    f"{path} has keypoints of '{name}' already, which others would be mixed up with; use a new database"
                )
        with pycolmap.DatabaseTransaction(database):
            for name, points in keypoints.items():
                database.write_keypoints(image_id[name], np.asarray(points, dtype=np.float32))
            for (first, second), pair in matches.items():
                ids = image_id[first], image_id[second]
                rows = np.ascontiguousarray(pair, dtype=np.uint32)
                database.write_matches(*ids, rows)
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED.value
                geometry.inlier_matches = rows
                database.write_two_view_geometry(*ids, geometry)
