"""Databases for tests, as COLMAP 3 wrote them."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

MAX_IMAGES = 2147483647
"""COLMAP's: a pair's id is the lower image id times this, plus the higher one."""


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
