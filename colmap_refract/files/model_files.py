"""What a COLMAP model's files hold: their names, their records, and what has to fit together in them.

pycolmap trusts its files: what is cut off or altered it reads as whatever was in memory, or loops until the
memory is full. So `binary_files` and `text_files` walk them first and put what they find in `Tables`, which are
checked here.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError

MODEL_NAMES = ("cameras", "images", "points3D")
RIG_NAMES = ("rigs", "frames")  # since COLMAP 4
MODEL_FILES = tuple(name + suffix for name in MODEL_NAMES + RIG_NAMES for suffix in (".bin", ".txt"))

NO_ID = 2**32 - 1  # COLMAP's invalid camera_id and image_id
NO_POINT = np.uint64(2**64 - 1)  # COLMAP's invalid point3D_id

# Records of the binary files, packed and little-endian.
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point3D_id", "<u8")])
POINT = np.dtype([("point3D_id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
TRACK_ELEMENT = np.dtype([("image_id", "<u4"), ("point2D_idx", "<u4")])


@dataclass(frozen=True, kw_only=True)
class Tables:
    """What has to fit together in images and points3D.

    Attributes:
        image_ids, camera_ids, names: one entry per image.
        keypoints: one array of `KEYPOINT` per image.
        points: array of `POINT`.
        tracks: array of `TRACK_ELEMENT`, the tracks of all points in the order of `points`.
    """

    image_ids: list[int]
    camera_ids: list[int]
    names: list[str]
    keypoints: list[NDArray[Any]]
    points: NDArray[Any]
    tracks: NDArray[Any]


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn what the system says of a file that cannot be read into the package's own error."""
    try:
        yield
    except OSError as error:
        raise RefractError(f"cannot read {error.filename or path}: {error.strerror}") from error


def damaged(file: Path, what: str) -> RefractError:
    """The error of a file with something in it that COLMAP never writes."""
    return RefractError(f"{file}: {what}; the file is damaged or incomplete, copy it again from where it was made")


def check_images(tables: Tables, camera_ids: set[int], file: Path) -> None:
    """Raise unless ids, names and cameras of the images and the observed keypoints can be a model's."""
    if len(set(tables.image_ids)) != len(tables.image_ids):
        raise damaged(file, "an image id occurs twice")
    seen: dict[str, int] = {}
    for image_id, camera_id, name, keypoints in zip(
        tables.image_ids, tables.camera_ids, tables.names, tables.keypoints, strict=True
    ):
        if not 0 <= image_id < NO_ID:
            raise damaged(file, f"image {name!r} has no valid id")
        if not name:
            raise damaged(file, f"image {image_id} has no name")
        if name in seen:
            raise RefractError(f"{file}: images {seen[name]} and {image_id} are both called {name!r}; rename one")
        if camera_id not in camera_ids:
            raise RefractError(
                f"{file}: image {name!r} has camera {camera_id}, which is not in {file.with_stem('cameras').name}; "
                "give files of one model"
            )
        seen[name] = image_id
        bad = (keypoints["point3D_id"] != NO_POINT) & ~np.isfinite(keypoints["xy"]).all(axis=1)
        if bad.any():
            raise damaged(file, f"keypoint {bad.argmax()} of image {name!r} is not finite")


def check_tracks(tables: Tables, images_file: Path, points_file: Path) -> None:
    """Every element of a track names a keypoint that names the point, and every keypoint with a point is in its track.

    pycolmap looks at the first only, and a keypoint with a point that does not exist is found much later.
    """
    points, tracks = tables.points, tables.tracks
    bad = ~np.isfinite(points["xyz"]).all(axis=1)
    if bad.any():
        raise damaged(points_file, f"point {points['point3D_id'][bad.argmax()]} is not finite")
    if len(np.unique(points["point3D_id"])) != len(points) or NO_POINT in points["point3D_id"]:
        raise damaged(points_file, "a point id is invalid or occurs twice")

    image_ids = np.array(tables.image_ids)
    order = np.argsort(image_ids)
    num_keypoints = np.array([len(k) for k in tables.keypoints])
    first = np.concatenate([[0], np.cumsum(num_keypoints)[:-1]])
    point3D_ids = np.concatenate([k["point3D_id"] for k in tables.keypoints])
    owner = np.repeat(points["point3D_id"], points["length"].astype(np.int64))  # of each element of `tracks`

    def fail(element: int, what: str) -> RefractError:
        image_id, point2D_idx = tracks[element]
        return RefractError(
            f"{points_file}: point {owner[element]} is seen at keypoint {point2D_idx} of image {image_id}, {what}; "
            f"{points_file.name} and {images_file.name} are damaged or not of one model"
        )

    at = np.searchsorted(image_ids[order], tracks["image_id"])
    image = order[np.minimum(at, len(order) - 1)]
    bad = image_ids[image] != tracks["image_id"]
    if bad.any():
        raise fail(int(bad.argmax()), "an image that does not exist")
    bad = tracks["point2D_idx"] >= num_keypoints[image]
    if bad.any():
        raise fail(int(bad.argmax()), "which does not exist")
    observed = first[image] + tracks["point2D_idx"]
    bad = point3D_ids[observed] != owner
    if bad.any():
        raise fail(int(bad.argmax()), "which belongs to another point or none")

    bad = point3D_ids != NO_POINT
    bad[observed] = False
    if bad.any():
        stray = int(bad.argmax())
        name = tables.names[int(np.searchsorted(first, stray, side="right")) - 1]
        raise RefractError(
            f"{images_file}: a keypoint of image {name!r} belongs to point {point3D_ids[stray]}, whose track in "
            f"{points_file.name} does not have it; the files are damaged or not of one model"
        )
