"""Databases for tests: a model's keypoints and matches as COLMAP would hold them, and as COLMAP 3 did."""

from __future__ import annotations

import itertools
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap

MAX_IMAGES = 2147483647
"""COLMAP's: a pair's id is the lower image id times this, plus the higher one."""


def write_database(
    path: Path,
    model: pycolmap.Reconstruction,
    *,
    wrong: float = 0.0,
    seed: int = 0,
    paired: Callable[[int, int], bool] = lambda i, j: True,
    with_rigs: bool = True,
) -> Path:
    """The keypoints and pairwise matches of a model's tracks.

    Args:
        wrong: part of each pair's matches that are exchanged among themselves.
        paired: whether two images are matched at all.
        with_rigs: also the model's rigs and frames.
    """
    rng = np.random.default_rng(seed)
    with closing(pycolmap.Database.open(path)) as database:
        for camera in model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        if with_rigs:
            for rig in model.rigs.values():
                database.write_rig(rig, use_rig_id=True)
            for frame in model.frames.values():
                database.write_frame(frame, use_frame_id=True)
        seen = {}
        for image_id, image in sorted(model.images.items()):
            bare = pycolmap.Image(image.name, camera_id=image.camera_id, image_id=image_id)
            if with_rigs:
                bare.frame_id = image.frame_id
            database.write_image(bare, use_image_id=True)
            points2D = list(image.points2D)
            database.write_keypoints(image_id, np.array([p.xy for p in points2D], dtype=np.float32))
            seen[image_id] = {p.point3D_id: k for k, p in enumerate(points2D) if p.has_point3D()}
        for i, j in itertools.combinations(seen, 2):
            common = sorted(set(seen[i]) & set(seen[j]))
            if not common or not paired(i, j):
                continue
            matches = np.array([(seen[i][p], seen[j][p]) for p in common], dtype=np.uint32)
            exchanged = np.flatnonzero(rng.random(len(matches)) < wrong)
            matches[exchanged, 1] = rng.permutation(matches[exchanged, 1])
            database.write_matches(i, j, matches)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED.value
            geometry.inlier_matches = matches
            database.write_two_view_geometry(i, j, geometry)
    return path


_COLMAP_3 = """
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, model INTEGER NOT NULL,
    width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER NOT NULL);
CREATE TABLE images (image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, name TEXT NOT NULL UNIQUE,
    camera_id INTEGER NOT NULL, {priors}
    CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < 2147483647),
    FOREIGN KEY(camera_id) REFERENCES cameras(camera_id));
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL,
    data BLOB, FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL,
    data BLOB, config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB);
CREATE UNIQUE INDEX index_name ON images(name);
"""
_PRIORS = "".join(f"prior_{name} REAL, " for name in ("qw", "qx", "qy", "qz", "tx", "ty", "tz"))


def write_colmap_3_database(path: Path, source: Path, *, priors: bool) -> Path:
    """What a database holds but for rigs and frames, in the tables of COLMAP 3; `priors`: of its earlier versions."""
    with closing(sqlite3.connect(path)) as old, closing(sqlite3.connect(source)) as new:
        old.executescript(_COLMAP_3.format(priors=_PRIORS if priors else ""))
        for table, columns in {
            "cameras": "camera_id, model, width, height, params, prior_focal_length",
            "images": "image_id, name, camera_id",
            "keypoints": "image_id, rows, cols, data",
            "matches": "pair_id, rows, cols, data",
            "two_view_geometries": "pair_id, rows, cols, data, config",
        }.items():
            rows = new.execute(f"SELECT {columns} FROM {table}").fetchall()
            old.executemany(f"INSERT INTO {table} ({columns}) VALUES ({', '.join('?' * len(rows[0]))})", rows)
        old.execute(f"PRAGMA user_version = {3900 if priors else 3110}")
        old.commit()
    return path
