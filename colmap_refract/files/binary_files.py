"""Walking a model's binary files, against their size, without pycolmap."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.files.model_files import KEYPOINT, POINT, TRACK_ELEMENT, Tables, damaged

POSE_SIZE = 7 * 8


def walk(file: Path, skip: Callable[[bytes, int], int]) -> tuple[bytes, NDArray[np.int64]]:
    """Step through the records of a binary file, which begins with their number and ends with the last.

    Args:
        skip: from the data and the place where a record begins to the place behind it; it may raise
            `struct.error` at the end of the data, and need not look whether the result is beyond it.

    Returns:
        The data, and where each record begins.
    """
    data = file.read_bytes()
    if len(data) < 8:
        raise damaged(file, "it ends before its first entry")
    (count,) = struct.unpack_from("<Q", data)
    at, starts = 8, []
    for record in range(count):
        starts.append(at)
        try:
            at = skip(data, at)
        except struct.error:
            at = len(data) + 1
        if at > len(data):
            raise damaged(file, f"it ends inside entry {record + 1} of {count}")
    if at != len(data):
        raise damaged(file, f"{len(data) - at} bytes follow the last of its {count} entries")
    return data, np.array(starts, dtype=np.int64)


def skip_rig(data: bytes, at: int) -> int:
    """For `walk`: from where a rig begins in `rigs.bin` to the next."""
    _, num_sensors = struct.unpack_from("<II", data, at)
    at += 8
    for sensor in range(num_sensors):
        at += 8  # type and id; the first is the reference
        if sensor > 0:
            has_pose = struct.unpack_from("<B", data, at)[0]
            at += 1 + (POSE_SIZE if has_pose else 0)
        if at > len(data):
            break
    return at


def skip_frame(data: bytes, at: int) -> int:
    """For `walk`: from where a frame begins in `frames.bin` to the next."""
    (num_data_ids,) = struct.unpack_from("<I", data, at + 8 + POSE_SIZE)
    return at + 8 + POSE_SIZE + 4 + 16 * int(num_data_ids)


def tables_from_binary(images_file: Path, points_file: Path) -> Tables:
    """What `images.bin` and `points3D.bin` hold, or an error where one is cut off."""
    image_ids, camera_ids, names, keypoints = [], [], [], []

    def image_at(data: bytes, at: int) -> int:
        (image_id,) = struct.unpack_from("<I", data, at)
        (camera_id,) = struct.unpack_from("<I", data, at + 4 + POSE_SIZE)
        begin = at + 8 + POSE_SIZE
        end = data.find(b"\0", begin)
        (count,) = struct.unpack_from("<Q", data, end + 1 if end >= 0 else len(data))
        after = end + 9 + KEYPOINT.itemsize * int(count)
        if after <= len(data):
            image_ids.append(image_id)
            camera_ids.append(camera_id)
            names.append(_decode(images_file, image_id, data[begin:end]))
            keypoints.append(np.frombuffer(data, KEYPOINT, count, end + 9))
        return after

    def point_at(data: bytes, at: int) -> int:
        (length,) = length_of.unpack_from(data, at + POINT.itemsize - 8)
        return at + POINT.itemsize + TRACK_ELEMENT.itemsize * int(length)

    length_of = struct.Struct("<Q")
    walk(images_file, image_at)
    data, starts = walk(points_file, point_at)
    points = _gather(data, starts, POINT)
    lengths = points["length"].astype(np.int64)
    # Where each track begins, less what the tracks before it take: one arange runs through all of them.
    begins = starts + POINT.itemsize - TRACK_ELEMENT.itemsize * (np.cumsum(lengths) - lengths)
    places = np.repeat(begins, lengths) + TRACK_ELEMENT.itemsize * np.arange(lengths.sum())
    return Tables(
        image_ids=image_ids,
        camera_ids=camera_ids,
        names=names,
        keypoints=keypoints,
        points=points,
        tracks=_gather(data, places, TRACK_ELEMENT),
    )


def _gather(data: bytes, places: NDArray[np.int64], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The records that begin at `places`, read through a view that has a record begin at every byte."""
    if not places.size:
        return np.empty(0, dtype)
    view: NDArray[Any] = np.ndarray(len(data) - dtype.itemsize + 1, dtype, data, strides=(1,))
    return view[places]


def _decode(file: Path, image_id: int, name: bytes) -> str:
    try:
        return name.decode()
    except UnicodeDecodeError:
        raise RefractError(
            f"{file}: the name of image {image_id} is not UTF-8 ({name!r}); rename the image, or copy the file again "
            "if it is damaged"
        ) from None
