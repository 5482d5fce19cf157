"""Reading a model's text files strictly: pycolmap drops what it cannot parse in them, and says nothing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_refract.files.model_files import KEYPOINT, NO_ID, POINT, TRACK_ELEMENT, Tables, damaged


def tables_from_text(images_file: Path, points_file: Path) -> Tables:
    """What `images.txt` and `points3D.txt` hold, or an error with the line that does not parse."""
    image_ids, camera_ids, names, keypoints = [], [], [], []
    lines = lines_of(images_file)
    for number, line in lines:
        if is_comment(line):
            continue
        fields = line.strip(" \t\r").split(maxsplit=9)
        head = _numbers(images_file, number, fields[:9])
        if len(fields) < 10:
            raise damaged(images_file, f"line {number} is not 'IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME'")
        number, line = next(lines, (number + 1, ""))
        values = _numbers(images_file, number, line.split())
        if values.size % 3:
            raise damaged(images_file, f"line {number} is not a list of X Y POINT3D_ID")
        image_ids.append(int(head[0]))
        camera_ids.append(int(head[8]))
        names.append(fields[9])
        image_keypoints = np.empty(values.size // 3, KEYPOINT)
        image_keypoints["xy"] = values.reshape(-1, 3)[:, :2]
        image_keypoints["point3D_id"] = _to_point3D_ids(values[2::3])
        keypoints.append(image_keypoints)

    heads, tracks = [np.empty((0, 8))], [np.empty((0, 2))]
    for number, line in lines_of(points_file):
        if is_comment(line):
            continue
        values = _numbers(points_file, number, line.split())
        if values.size < 8 or values.size % 2:
            raise damaged(points_file, f"line {number} is not 'POINT3D_ID X Y Z R G B ERROR TRACK...'")
        heads.append(values[None, :8])
        tracks.append(values[8:].reshape(-1, 2))
    head_array, track_array = np.concatenate(heads), np.concatenate(tracks)
    points = np.zeros(len(head_array), POINT)
    points["point3D_id"] = _to_point3D_ids(head_array[:, 0])
    points["xyz"] = head_array[:, 1:4]
    points["length"] = [len(track) for track in tracks[1:]]
    elements = np.empty(len(track_array), TRACK_ELEMENT)
    elements["image_id"], elements["point2D_idx"] = np.clip(track_array.T, 0, NO_ID)
    return Tables(
        image_ids=image_ids, camera_ids=camera_ids, names=names, keypoints=keypoints, points=points, tracks=elements
    )


def _to_point3D_ids(values: NDArray[np.float64]) -> NDArray[np.uint64]:
    """-1 becomes `NO_POINT`; what else is out of range becomes ids that no point has."""
    return np.clip(values, -2, 2**62).astype(np.int64).astype(np.uint64)


def lines_of(file: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file, numbered from 1; a last line without an end is one."""
    try:
        lines = file.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError:
        raise damaged(file, "it is not UTF-8 text") from None
    return enumerate(lines[:-1] if not lines[-1] else lines, 1)


def is_comment(line: str) -> bool:
    """Whether COLMAP passes over a line between two entries."""
    line = line.strip()
    return not line or line.startswith("#")


def _numbers(file: Path, number: int, fields: list[str]) -> NDArray[np.float64]:
    """Finite numbers only: pycolmap takes nan or inf for the end of the line and drops what follows."""
    try:
        values = np.array(fields, dtype=np.float64)
    except ValueError:
        raise damaged(file, f"line {number} has something that is not a number") from None
    if not np.isfinite(values).all():
        raise damaged(file, f"line {number} has a number that is not finite")
    return values
