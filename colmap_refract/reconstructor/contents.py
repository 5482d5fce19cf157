"""What is in a COLMAP database and in folders of models: counts for the report, fingerprints for the record."""

from __future__ import annotations

import hashlib
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.files.output import WORK_PREFIX
from colmap_refract.mapping.database import check_database, read_only

if TYPE_CHECKING:
    import pycolmap

NUM_KEYPOINTS = "SELECT COUNT(*) FROM keypoints"
NUM_PAIRS = "SELECT COUNT(*) FROM two_view_geometries"


@dataclass(frozen=True, kw_only=True)
class Contents:
    """A database at a glance.

    Attributes:
        mark: SQLite's `application_id`, by which a database of ours is known again; 0 in COLMAP's own.
        image_id, image_camera: by name, id of the image and of its camera.
        num_keypoints: by name, of images that have gone through extraction.
        camera_size: by camera id, (width, height).
        cameras: what `camera_key` says of every camera, by its id as text.
        num_pairs, num_verified_pairs, num_inlier_matches: pairs that were tried; those with verified matches; these.
        features, matches: fingerprints of images with keypoints, and of matches.
    """

    mark: int
    image_id: dict[str, int]
    image_camera: dict[str, int]
    num_keypoints: dict[str, int]
    camera_size: dict[int, tuple[int, int]]
    cameras: dict[str, list[Any]]
    num_pairs: int
    num_verified_pairs: int
    num_inlier_matches: int
    features: str
    matches: str


def read_contents(path: Path) -> Contents:
    """Look through a database that nobody in this process has open in COLMAP; it is not altered.

    Raises:
        RefractError: it cannot be read, or it is none of COLMAP's.
    """
    check_database(path)
    try:
        with closing(read_only(path)) as database:
            return _contents(database)
    except sqlite3.Error as error:
        raise RefractError(f"{path} cannot be read ({error}); copy it again, or move it away to begin anew") from None


def _contents(database: sqlite3.Connection) -> Contents:
    features, matches = hashlib.blake2b(digest_size=16), hashlib.blake2b(digest_size=16)
    image_id, image_camera, num_keypoints = {}, {}, {}
    rows = database.execute(
        "SELECT name, images.image_id, camera_id, rows, data FROM images LEFT JOIN keypoints USING (image_id) "
        "ORDER BY name"
    )
    for name, number, camera_id, count, data in rows:
        image_id[name], image_camera[name] = number, camera_id
        if count is not None:
            num_keypoints[name] = count
        features.update(repr((name, number, camera_id, count)).encode() + (data or b""))
    camera_size, cameras = {}, {}
    for camera_id, model, width, height, params, prior in database.execute(
        "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras ORDER BY camera_id"
    ):
        camera_size[camera_id] = (width, height)
        cameras[str(camera_id)] = [model, width, height, bool(prior), *np.frombuffer(params).tolist()]
    num_pairs = num_verified_pairs = num_inlier_matches = 0
    for pair_id, count, config, data in database.execute(
        "SELECT pair_id, rows, config, data FROM two_view_geometries ORDER BY pair_id"
    ):
        num_pairs += 1
        num_verified_pairs += count > 0
        num_inlier_matches += count
        matches.update(repr((pair_id, count, config)).encode() + (data or b""))
    for row in database.execute("SELECT pair_id, rows FROM matches ORDER BY pair_id"):
        matches.update(repr(row).encode())
    return Contents(
        mark=database.execute("PRAGMA application_id").fetchone()[0],
        image_id=image_id,
        image_camera=image_camera,
        num_keypoints=num_keypoints,
        camera_size=camera_size,
        cameras=cameras,
        num_pairs=num_pairs,
        num_verified_pairs=num_verified_pairs,
        num_inlier_matches=num_inlier_matches,
        features=features.hexdigest(),
        matches=matches.hexdigest(),
    )


def camera_key(camera: pycolmap.Camera) -> list[Any]:
    """All that a camera is but its id, as JSON."""
    params = [float(value) for value in camera.params]
    return [int(camera.model), camera.width, camera.height, camera.has_prior_focal_length, *params]


def count_rows(path: Path, query: str) -> int | None:
    """Result of a query while another process writes the database; None if it cannot be had just now."""
    try:
        # COLMAP waits for nobody: a connection that could write might lock a database that it is about to open.
        with closing(read_only(path)) as database:
            return int(database.execute(query).fetchone()[0])
    except sqlite3.Error:
        return None


def fingerprint(folder: Path) -> str:
    """Of all files in a folder and below it, names and contents, but not of what a killed run left; '' for none."""
    digest = hashlib.blake2b(digest_size=16)
    everything = folder.rglob("*") if folder.is_dir() else []
    files = sorted(path for path in everything if path.is_file() and not _of_killed_run(path.relative_to(folder)))
    try:
        for path in files:
            digest.update(repr((path.relative_to(folder).as_posix(), path.stat().st_size)).encode())
            with path.open("rb") as file:
                digest.update(hashlib.file_digest(file, "blake2b").digest())
    except OSError as error:
        raise RefractError(f"{folder} cannot be read ({error.strerror}); give back the right to read it") from None
    return digest.hexdigest() if files else ""


def _of_killed_run(path: Path) -> bool:
    return any(part.startswith(WORK_PREFIX) for part in path.parts)
