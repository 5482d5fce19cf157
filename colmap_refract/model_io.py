"""Reading and writing COLMAP models, so that neither a damaged file nor a full disk does harm.

pycolmap trusts its files: what is cut off or altered it reads as whatever was in memory, or loops until the
memory is full. So the files are walked here first (`_Tables`), against their size and against
each other, and pycolmap reads only what it can digest. Written files go through the same walk.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.sidecar import SIDECAR_NAME

if TYPE_CHECKING:
    import pycolmap

MODEL_NAMES = ("cameras", "images", "points3D")
RIG_NAMES = ("rigs", "frames")  # since COLMAP 4
MODEL_FILES = tuple(name + suffix for name in MODEL_NAMES + RIG_NAMES for suffix in (".bin", ".txt"))

# What a folder that we write to must not keep of an earlier run.
OWN_FILES = (*MODEL_FILES, SIDECAR_NAME)
WORK_PREFIX = ".colmap_refract-"  # of the temporary folders of `output_folder`
# The user's to put right, wherever in the block they turn up.
DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}

NO_ID = 2**32 - 1  # COLMAP's invalid camera_id and image_id
NO_POINT = np.uint64(2**64 - 1)  # COLMAP's invalid point3D_id
POSE_SIZE = 7 * 8

# Records of the binary files, packed and little-endian.
CAMERA = struct.Struct("<IiQQ")
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point3D_id", "<u8")])
POINT = np.dtype([("point3D_id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
TRACK_ELEMENT = np.dtype([("image_id", "<u4"), ("point2D_idx", "<u4")])

EXPECTED = "cameras, images and points3D, all as .bin or all as .txt"


@dataclass(frozen=True, kw_only=True)
class _Contents:
    """What pycolmap must find in the files; names and numbers of keypoints by `image_id`."""

    names: dict[int, str] = field(compare=False)  # pycolmap cuts a name in a text file at its first space
    num_keypoints: dict[int, int]
    num_points: int
    num_observations: int


@dataclass(frozen=True, kw_only=True)
class _Tables:
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


# ----------------------------------------------------------------------------- reading


def read_model(path: str | Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model, binary or text, of COLMAP 3 (no rigs and frames) or 4.

    Where a folder holds both forms the binary one is read, as COLMAP does.

    Args:
        path: folder with the files of the model.

    Returns:
        A model with at least one registered image and one point, finite throughout, every
        rotation a unit quaternion, and every reference between cameras, images and points valid both ways.

    Raises:
        RefractError: there is no such model, it cannot be read, or it is damaged or empty.
    """
    folder = Path(path)
    with _readable(folder):
        suffix = _find_model(folder)
        contents = _check_files(folder, suffix)
    reconstruction = _read_with_pycolmap(folder, suffix)
    # pycolmap drops what it cannot parse in a text file, and says nothing.
    found = _Contents(
        names={},
        num_keypoints={image.image_id: image.num_points2D() for image in reconstruction.images.values()},
        num_points=reconstruction.num_points3D(),
        num_observations=reconstruction.compute_num_observations(),
    )
    if found != contents:
        raise RefractError(f"{folder}: pycolmap reads only a part of the {suffix} files; write them with COLMAP")
    if suffix == ".txt":
        for image in reconstruction.images.values():
            image.name = contents.names[image.image_id]
    _check_poses(reconstruction, folder, suffix)
    return reconstruction


def read_cameras(path: str | Path) -> dict[int, pycolmap.Camera]:
    """Read the cameras of a COLMAP cameras file, such as intrinsics that were calibrated in air.

    Args:
        path: a `.bin` or `.txt` file in COLMAP's format, or a folder with `cameras.bin` or `cameras.txt`.

    Returns:
        The cameras by `camera_id`; at least one.

    Raises:
        RefractError: there is no such file, or it is damaged or empty.
    """
    file = Path(path)
    with _readable(file):
        if not file.exists():
            raise RefractError(f"{file} does not exist; give a COLMAP cameras file (.bin or .txt) or its folder")
        if file.is_dir():
            candidates = [file / "cameras.bin", file / "cameras.txt"]
            found = [candidate for candidate in candidates if candidate.is_file()]
            if not found:
                raise RefractError(f"{file} holds neither cameras.bin nor cameras.txt; give a COLMAP cameras file")
            file = found[0]
        return _cameras_from_binary(file) if file.suffix == ".bin" else _cameras_from_text(file)


def copy_model(reconstruction: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A deep copy, images without a pose included: nothing done to one is seen in the other."""
    import pycolmap

    return pycolmap.Reconstruction(reconstruction)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RefractError(f"cannot read {error.filename or path}: {error.strerror}") from error


def _damaged(file: Path, what: str) -> RefractError:
    return RefractError(f"{file}: {what}; the file is damaged or incomplete, copy it again from where it was made")


def _model_suffix(folder: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((folder / (name + suffix)).is_file() for name in MODEL_NAMES):
            return suffix
    return None


def _find_model(folder: Path) -> str:
    """The suffix of the model's files in `folder`, or an error that says where a model may be."""
    if not folder.exists():
        raise RefractError(f"{folder} does not exist; give the folder of a COLMAP model ({EXPECTED})")
    if not folder.is_dir():
        raise RefractError(f"{folder} is a file; give the folder of a COLMAP model ({EXPECTED})")
    suffix = _model_suffix(folder)
    if suffix is None:
        message = f"{folder} holds no COLMAP model ({EXPECTED})"
        found = [name for name in MODEL_FILES if (folder / name).is_file()]
        if found:
            raise RefractError(f"{message}, only {', '.join(found)}; add the missing files")
        inside = [p for pattern in ("*", "sparse/*") for p in sorted(folder.glob(pattern)) if _model_suffix(p)]
        if inside:
            message += f"; did you mean {' or '.join(map(str, inside[:3]))}?"
        else:
            message += "; give the folder that COLMAP's mapper wrote, such as sparse/0"
        raise RefractError(message)
    rigs, frames = (folder / (name + suffix) for name in RIG_NAMES)
    if rigs.is_file() != frames.is_file():
        there, missing = (rigs, frames) if rigs.is_file() else (frames, rigs)
        raise RefractError(f"{missing} is missing beside {there.name}; add it, or remove {there.name} if not needed")
    return suffix


def _check_files(folder: Path, suffix: str) -> _Contents:
    """Raise unless the files are whole and fit together; say what pycolmap must find in them."""
    cameras_file, images_file, points_file, rigs_file, frames_file = (
        folder / (name + suffix) for name in MODEL_NAMES + RIG_NAMES
    )
    if suffix == ".bin":
        camera_ids = set(_cameras_from_binary(cameras_file))
        tables = _tables_from_binary(images_file, points_file)
        if rigs_file.is_file():
            _walk(rigs_file, _skip_rig)
            _walk(frames_file, _skip_frame)
    else:
        camera_ids = set(_cameras_from_text(cameras_file))
        tables = _tables_from_text(images_file, points_file)
    if not tables.image_ids:
        raise RefractError(f"{images_file}: no image is registered; give a model with at least one posed image")
    if not tables.points.size:
        raise RefractError(f"{points_file}: the model has no points; triangulate it first")
    _check_images(tables, camera_ids, images_file)
    _check_tracks(tables, images_file, points_file)
    return _Contents(
        names=dict(zip(tables.image_ids, tables.names, strict=True)),
        num_keypoints={image_id: len(k) for image_id, k in zip(tables.image_ids, tables.keypoints, strict=True)},
        num_points=len(tables.points),
        num_observations=sum(int((k["point3D_id"] != NO_POINT).sum()) for k in tables.keypoints),
    )


def _check_images(tables: _Tables, camera_ids: set[int], file: Path) -> None:
    if len(set(tables.image_ids)) != len(tables.image_ids):
        raise _damaged(file, "an image id occurs twice")
    seen: dict[str, int] = {}
    for image_id, camera_id, name, keypoints in zip(
        tables.image_ids, tables.camera_ids, tables.names, tables.keypoints, strict=True
    ):
        if not 0 <= image_id < NO_ID:
            raise _damaged(file, f"image {name!r} has no valid id")
        if not name:
            raise _damaged(file, f"image {image_id} has no name")
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
            raise _damaged(file, f"keypoint {bad.argmax()} of image {name!r} is not finite")


def _check_tracks(tables: _Tables, images_file: Path, points_file: Path) -> None:
    """Every element of a track names a keypoint that names the point, and every keypoint with a point is in its track.

    pycolmap looks at the first only, and a keypoint with a point that does not exist is found much later.
    """
    points, tracks = tables.points, tables.tracks
    bad = ~np.isfinite(points["xyz"]).all(axis=1)
    if bad.any():
        raise _damaged(points_file, f"point {points['point3D_id'][bad.argmax()]} is not finite")
    if len(np.unique(points["point3D_id"])) != len(points) or NO_POINT in points["point3D_id"]:
        raise _damaged(points_file, "a point id is invalid or occurs twice")

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


def _read_with_pycolmap(folder: Path, suffix: str) -> pycolmap.Reconstruction:
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    with _quiet_pycolmap():
        try:
            (reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text)(folder)
            reconstruction.reg_image_ids()  # fails where a frame lists an image that does not exist
        except Exception as error:
            # The others have been checked.
            likely = f"rigs{suffix} or frames{suffix}" if (folder / f"rigs{suffix}").is_file() else "one of its files"
            raise RefractError(
                f"{folder}: COLMAP cannot read the model ({_reason(error)}); {likely} is damaged or of another model"
            ) from error
    return reconstruction


def _check_poses(reconstruction: pycolmap.Reconstruction, folder: Path, suffix: str) -> None:
    file = folder / f"frames{suffix}"
    file = file.with_name(f"{file.name} or rigs{suffix}") if file.is_file() else file.with_stem("images")
    for image in reconstruction.images.values():
        where = f"image {image.name!r}"
        try:
            pose = image.cam_from_world()
        except Exception as error:
            raise RefractError(
                f"{file}: {where} has no pose ({_reason(error)}); give every camera of the rig a pose"
            ) from error
        if not (np.isfinite(pose.rotation.quat).all() and np.isfinite(pose.translation).all()):
            raise _damaged(file, f"the pose of {where} is not finite")
        # Six digits in a text file are still a rotation; an altered byte is not.
        if abs(np.linalg.norm(pose.rotation.quat) - 1) > 1e-3:
            raise _damaged(file, f"the rotation of {where} is not a unit quaternion")


def _reason(error: Exception) -> str:
    """pycolmap's message as one short line, without the place in its source."""
    text = "".join(c if c.isprintable() else " " for c in str(error))
    return " ".join(re.sub(r"^\[\S+:\d+\] ", "", text).split())[:120]


@contextmanager
def _quiet_pycolmap() -> Iterator[None]:
    """Keep COLMAP's log off the user's terminal; what matters comes as an exception."""
    from pycolmap import logging

    level = logging.minloglevel
    logging.minloglevel = logging.FATAL.value
    try:
        yield
    finally:
        logging.minloglevel = level


# ----------------------------------------------------------------------------- cameras


def _make_camera(
    file: Path, camera_id: int, model: pycolmap.CameraModelId, width: int, height: int, params: list[float]
) -> pycolmap.Camera:
    import pycolmap

    where = f"camera {camera_id}"
    if not 0 <= camera_id < NO_ID:
        raise _damaged(file, f"{where} is no valid id")
    if not (0 < width < 2**31 and 0 < height < 2**31):
        raise _damaged(file, f"{where} has an impossible image size, {width} x {height}")
    camera = pycolmap.Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)
    if not camera.verify_params():
        raise _damaged(file, f"{where} has {len(params)} parameters, {model.name} needs {camera.params_info}")
    if not np.isfinite(camera.params).all():
        raise _damaged(file, f"{where} has a parameter that is not finite")
    if any(camera.params[i] <= 0 for i in camera.focal_length_idxs()):
        raise _damaged(file, f"{where} has a focal length that is not positive")
    return camera


def _by_id(file: Path, cameras: list[pycolmap.Camera]) -> dict[int, pycolmap.Camera]:
    if not cameras:
        raise RefractError(f"{file}: there is no camera in the file; give one with at least one camera")
    by_id = {camera.camera_id: camera for camera in cameras}
    if len(by_id) != len(cameras):
        raise _damaged(file, "a camera id occurs twice")
    return by_id


def _unknown_model(file: Path, camera_id: int, model: object) -> RefractError:
    import pycolmap

    return RefractError(
        f"{file}: camera {camera_id} has the model {model!r}, which pycolmap {pycolmap.__version__} does not know; "
        "update pycolmap, or copy the file again if it is damaged"
    )


def _cameras_from_binary(file: Path) -> dict[int, pycolmap.Camera]:
    import pycolmap

    models = {int(model): model for model in pycolmap.CameraModelId.__members__.values() if int(model) >= 0}
    cameras = []

    def camera_at(data: bytes, at: int) -> int:
        camera_id, model_id, width, height = CAMERA.unpack_from(data, at)
        if model_id not in models:
            raise _unknown_model(file, camera_id, model_id)
        count = len(pycolmap.Camera.create_from_model_id(1, models[model_id], 1.0, 1, 1).params)
        params = list(struct.unpack_from(f"<{count}d", data, at + CAMERA.size))
        cameras.append(_make_camera(file, camera_id, models[model_id], width, height, params))
        return at + CAMERA.size + 8 * count

    _walk(file, camera_at)
    return _by_id(file, cameras)


def _cameras_from_text(file: Path) -> dict[int, pycolmap.Camera]:
    import pycolmap

    models = {name: model for name, model in pycolmap.CameraModelId.__members__.items() if int(model) >= 0}
    cameras = []
    for number, line in _lines(file):
        if _is_comment(line):
            continue
        try:
            camera_id, model, width, height, *params = line.split()
            numbers = int(camera_id), int(width), int(height), [float(p) for p in params]
        except ValueError:
            raise _damaged(file, f"line {number} is not 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS...'") from None
        if model not in models:
            raise _unknown_model(file, numbers[0], model)
        cameras.append(_make_camera(file, numbers[0], models[model], *numbers[1:]))
    return _by_id(file, cameras)


# ----------------------------------------------------------------------------- walking the files


def _walk(file: Path, skip: Callable[[bytes, int], int]) -> tuple[bytes, NDArray[np.int64]]:
    """Step through the records of a binary file, which begins with their number and ends with the last.

    Args:
        skip: from the data and the place where a record begins to the place behind it; it may raise
            `struct.error` at the end of the data, and need not look whether the result is beyond it.

    Returns:
        The data, and where each record begins.
    """
    data = file.read_bytes()
    if len(data) < 8:
        raise _damaged(file, "it ends before its first entry")
    (count,) = struct.unpack_from("<Q", data)
    at, starts = 8, []
    for record in range(count):
        starts.append(at)
        try:
            at = skip(data, at)
        except struct.error:
            at = len(data) + 1
        if at > len(data):
            raise _damaged(file, f"it ends inside entry {record + 1} of {count}")
    if at != len(data):
        raise _damaged(file, f"{len(data) - at} bytes follow the last of its {count} entries")
    return data, np.array(starts, dtype=np.int64)


def _skip_rig(data: bytes, at: int) -> int:
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


def _skip_frame(data: bytes, at: int) -> int:
    (num_data_ids,) = struct.unpack_from("<I", data, at + 8 + POSE_SIZE)
    return at + 8 + POSE_SIZE + 4 + 16 * int(num_data_ids)


def _tables_from_binary(images_file: Path, points_file: Path) -> _Tables:
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
    _walk(images_file, image_at)
    data, starts = _walk(points_file, point_at)
    points = _gather(data, starts, POINT)
    lengths = points["length"].astype(np.int64)
    # Where each track begins, less what the tracks before it take: one arange runs through all of them.
    begins = starts + POINT.itemsize - TRACK_ELEMENT.itemsize * (np.cumsum(lengths) - lengths)
    places = np.repeat(begins, lengths) + TRACK_ELEMENT.itemsize * np.arange(lengths.sum())
    return _Tables(
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


def _tables_from_text(images_file: Path, points_file: Path) -> _Tables:
    image_ids, camera_ids, names, keypoints = [], [], [], []
    lines = _lines(images_file)
    for number, line in lines:
        if _is_comment(line):
            continue
        fields = line.strip(" \t\r").split(maxsplit=9)
        head = _numbers(images_file, number, fields[:9])
        if len(fields) < 10:
            raise _damaged(images_file, f"line {number} is not 'IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME'")
        number, line = next(lines, (number + 1, ""))
        values = _numbers(images_file, number, line.split())
        if values.size % 3:
            raise _damaged(images_file, f"line {number} is not a list of X Y POINT3D_ID")
        image_ids.append(int(head[0]))
        camera_ids.append(int(head[8]))
        names.append(fields[9])
        image_keypoints = np.empty(values.size // 3, KEYPOINT)
        image_keypoints["xy"] = values.reshape(-1, 3)[:, :2]
        image_keypoints["point3D_id"] = _to_point3D_ids(values[2::3])
        keypoints.append(image_keypoints)

    heads, tracks = [np.empty((0, 8))], [np.empty((0, 2))]
    for number, line in _lines(points_file):
        if _is_comment(line):
            continue
        values = _numbers(points_file, number, line.split())
        if values.size < 8 or values.size % 2:
            raise _damaged(points_file, f"line {number} is not 'POINT3D_ID X Y Z R G B ERROR TRACK...'")
        heads.append(values[None, :8])
        tracks.append(values[8:].reshape(-1, 2))
    head_array, track_array = np.concatenate(heads), np.concatenate(tracks)
    points = np.zeros(len(head_array), POINT)
    points["point3D_id"] = _to_point3D_ids(head_array[:, 0])
    points["xyz"] = head_array[:, 1:4]
    points["length"] = [len(track) for track in tracks[1:]]
    elements = np.empty(len(track_array), TRACK_ELEMENT)
    elements["image_id"], elements["point2D_idx"] = np.clip(track_array.T, 0, NO_ID)
    return _Tables(
        image_ids=image_ids, camera_ids=camera_ids, names=names, keypoints=keypoints, points=points, tracks=elements
    )


def _to_point3D_ids(values: NDArray[np.float64]) -> NDArray[np.uint64]:
    """-1 becomes `NO_POINT`; what else is out of range becomes ids that no point has."""
    return np.clip(values, -2, 2**62).astype(np.int64).astype(np.uint64)


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file, numbered from 1; a last line without an end is one."""
    try:
        lines = file.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError:
        raise _damaged(file, "it is not UTF-8 text") from None
    return enumerate(lines[:-1] if not lines[-1] else lines, 1)


def _is_comment(line: str) -> bool:
    line = line.strip()
    return not line or line.startswith("#")


def _numbers(file: Path, number: int, fields: list[str]) -> NDArray[np.float64]:
    """Finite numbers only: pycolmap takes nan or inf for the end of the line and drops what follows."""
    try:
        values = np.array(fields, dtype=np.float64)
    except ValueError:
        raise _damaged(file, f"line {number} has something that is not a number") from None
    if not np.isfinite(values).all():
        raise _damaged(file, f"line {number} has a number that is not finite")
    return values


# ----------------------------------------------------------------------------- writing


def write_model(reconstruction: pycolmap.Reconstruction, folder: Path) -> None:
    """Write the five binary files of a model and verify that they are complete.

    As COLMAP does, only images with a pose are written.

    Args:
        folder: an existing folder, as `output_folder` yields it.

    Raises:
        RefractError: the files cannot be written, or not whole because the disk is full.
    """
    cameras, images, points, rigs, frames = (folder / f"{name}.bin" for name in MODEL_NAMES + RIG_NAMES)
    with _quiet_pycolmap():
        try:
            reconstruction.write_binary(folder)
            # COLMAP does not look whether the disk took what it wrote.
            tables = _tables_from_binary(images, points)
            written = (
                len(_cameras_from_binary(cameras)),
                len(_walk(rigs, _skip_rig)[1]),
                len(_walk(frames, _skip_frame)[1]),
                len(tables.image_ids),
                len(tables.points),
            )
        except RefractError as error:
            raise RefractError(f"cannot write the model: a file in {folder} is cut off; is the disk full?") from error
        except Exception as error:
            raise RefractError(f"cannot write the model to {folder}: {_reason(error)}") from error
    if written != (
        reconstruction.num_cameras(),
        reconstruction.num_rigs(),
        reconstruction.num_reg_frames(),
        reconstruction.num_reg_images(),
        reconstruction.num_points3D(),
    ):
        raise RefractError(f"cannot write the model: a file in {folder} lacks entries; is the disk full?")


@contextmanager
def output_folder(path: str | Path, *, input_path: str | Path | None, overwrite: bool) -> Iterator[Path]:
    """A temporary folder whose files appear in `path` all together, and only if the block ends without an exception.

    A `path` that does not exist is made by one rename. In a folder that exists, the files of the old model are moved
    aside before the new ones are moved in, so that no reader ever finds a mixture, and deleted at last;
    until then whatever goes wrong puts them back. Files that are not of a model stay where they are; a model in
    the other form (`.txt`) goes, for readers would take it or be confused.

    Args:
        path: folder to be written; its parents are made as needed.
        input_path: folder of the model that is being refined, which must not be altered.
        overwrite: whether a folder that is not empty may be written to.

    Yields:
        An empty folder on the same disk.

    Raises:
        RefractError: `path` is the input, is a file, is not empty without `overwrite`, or cannot be written to. In
            the block: the disk is full.
    """
    path = Path(path)
    try:
        target = path.resolve()  # through a link, which stays
        _check_output(path, target, input_path, overwrite)
        missing = [parent for parent in target.parents if not parent.exists()]
    except (OSError, RuntimeError) as error:
        raise _cannot_write(path, error) from error
    exists = target.is_dir()
    # Beside or inside the target: the disk is the same, so that files need only be renamed.
    work = (target if exists else target.parent) / f"{WORK_PREFIX}{uuid4().hex[:12]}"
    new, old = work / "new", work / "old"
    done = False
    try:
        try:
            new.mkdir(parents=True)
        except OSError as error:
            raise _cannot_write(path, error) from error
        try:
            yield new
        except OSError as error:
            if error.errno in DISK_ERRORS or str(work) in str(error.filename):
                raise _cannot_write(path, error) from error
            raise
        try:
            _sync(new)
            if exists:
                _exchange(new, target, old)
            else:
                os.rename(new, target)
            done = True
            _sync_names(target.parent)
            _sync_names(target)
        except OSError as error:
            raise _cannot_write(path, error) from error
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if done:
            shutil.rmtree(old, ignore_errors=True)
        # Only what is empty: files that could not be put back are kept in `old`.
        for folder in [old, work, *([] if done else missing)]:
            with suppress(OSError):
                folder.rmdir()


def _check_output(path: Path, target: Path, input_path: str | Path | None, overwrite: bool) -> None:
    if input_path is not None:
        source = Path(input_path).resolve()
        if target == source or (target.exists() and source.exists() and target.samefile(source)):
            raise RefractError(f"the output folder {path} is the input; choose another, the input is never altered")
    if not target.exists():
        return
    if not target.is_dir():
        raise RefractError(f"the output {path} is a file; choose a folder")
    # What a killed run left does not count.
    if not overwrite and any(not inside.name.startswith(WORK_PREFIX) for inside in target.iterdir()):
        raise RefractError(
            f"the output folder {path} is not empty; choose another, or have the model in it overwritten (--overwrite)"
        )


def _cannot_write(path: Path, error: Exception) -> RefractError:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return RefractError(f"cannot write to {path}: {reason}; choose another folder, nothing was changed in this one")


def _exchange(new: Path, target: Path, old: Path) -> None:
    """Move the files of an old model in `target` to `old` and those in `new` to `target`, or nothing at all."""
    entering = sorted(os.listdir(new))
    moves = [(target / name, old / name) for name in sorted({*entering, *OWN_FILES}) if os.path.lexists(target / name)]
    for occupied, _ in moves:
        if occupied.is_dir():
            raise RefractError(f"{occupied} is a folder where a file is to be written; move it away")
    moves += [(new / name, target / name) for name in entering]
    old.mkdir()
    try:
        for source, destination in moves:
            os.replace(source, destination)
    except BaseException:
        for source, destination in reversed(moves):
            # What was moved is put back; what was not has its source still.
            if not os.path.lexists(source):
                os.replace(destination, source)
        raise


def _sync(folder: Path) -> None:
    """Have the disk confirm every file: some report only now that they are full."""
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb+") as file:
                os.fsync(file.fileno())
    _sync_names(folder)


def _sync_names(folder: Path) -> None:
    # Not every system lets a folder be opened; the files are safe already.
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
