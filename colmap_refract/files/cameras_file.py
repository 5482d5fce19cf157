"""The cameras of a COLMAP cameras file, every parameter looked at before it is believed."""

from __future__ import annotations

import copy
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.files.binary_files import walk
from colmap_refract.files.model_files import NO_ID, damaged, readable
from colmap_refract.files.text_files import is_comment, lines_of

if TYPE_CHECKING:
    import pycolmap

MAX_ASPECT_CHANGE = 0.005
"""Relative; more is a crop or another sensor mode, of which the principal point is not known."""
CAMERA = struct.Struct("<IiQQ")  # the fixed part of a camera's record


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
    with readable(file):
        if not file.exists():
            raise RefractError(f"{file} does not exist; give a COLMAP cameras file (.bin or .txt) or its folder")
        if file.is_dir():
            candidates = [file / "cameras.bin", file / "cameras.txt"]
            found = [candidate for candidate in candidates if candidate.is_file()]
            if not found:
                raise RefractError(f"{file} holds neither cameras.bin nor cameras.txt; give a COLMAP cameras file")
            file = found[0]
        return cameras_from_binary(file) if file.suffix == ".bin" else cameras_from_text(file)


def fit_to_size(camera: pycolmap.Camera, width: int, height: int) -> pycolmap.Camera:
    """A copy of calibrated intrinsics for images of another size; the flag says that they are known.

    Focal lengths and principal point go with the width and the height; distortion parameters act on directions
    and stay.

    Raises:
        RefractError: the images have another shape than those of the calibration.
    """
    fitted = copy.deepcopy(camera)
    fitted.has_prior_focal_length = True
    if (camera.width, camera.height) == (width, height):
        return fitted

    def like(known_width: int, known_height: int) -> bool:
        return abs(width * known_height / (height * known_width) - 1) <= MAX_ASPECT_CHANGE

    if not like(camera.width, camera.height):
        turned = like(camera.height, camera.width)
        hint = (
            "turn the images as the camera took them" if turned else "calibrate with uncropped images of the same mode"
        )
        raise RefractError(
            f"the images have {width} x {height} pixels, the calibration is for {camera.width} x {camera.height}, "
            f"another shape; {hint}"
        )
    fitted.rescale(width, height)
    return fitted


def known_camera(camera: pycolmap.Camera, cameras: Mapping[int, pycolmap.Camera], user: str) -> pycolmap.Camera:
    """Which of the given intrinsics are a camera's: those of its id; a single one stands for all, whatever its id.

    Args:
        camera: of the model or the database.
        cameras: given intrinsics by camera id.
        user: who uses the camera, for the message: 'the model'.

    Raises:
        RefractError: they have no such camera.
    """
    known = next(iter(cameras.values())) if len(cameras) == 1 else cameras.get(camera.camera_id)
    if known is None:
        raise RefractError(
            f"the given intrinsics have no camera {camera.camera_id}, which {user} uses; they have "
            f"{', '.join(str(i) for i in sorted(cameras))}"
        )
    return known


def cameras_from_binary(file: Path) -> dict[int, pycolmap.Camera]:
    """The cameras of a `.bin` file by `camera_id`; at least one."""
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

    walk(file, camera_at)
    return _by_id(file, cameras)


def cameras_from_text(file: Path) -> dict[int, pycolmap.Camera]:
    """The cameras of a `.txt` file by `camera_id`; at least one."""
    import pycolmap

    models = {name: model for name, model in pycolmap.CameraModelId.__members__.items() if int(model) >= 0}
    cameras = []
    for number, line in lines_of(file):
        if is_comment(line):
            continue
        try:
            camera_id, model, width, height, *params = line.split()
            numbers = int(camera_id), int(width), int(height), [float(p) for p in params]
        except ValueError:
            raise damaged(file, f"line {number} is not 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS...'") from None
        if model not in models:
            raise _unknown_model(file, numbers[0], model)
        cameras.append(_make_camera(file, numbers[0], models[model], *numbers[1:]))
    return _by_id(file, cameras)


def _make_camera(
    file: Path, camera_id: int, model: pycolmap.CameraModelId, width: int, height: int, params: list[float]
) -> pycolmap.Camera:
    import pycolmap

    where = f"camera {camera_id}"
    if not 0 <= camera_id < NO_ID:
        raise damaged(file, f"{where} is no valid id")
    if not (0 < width < 2**31 and 0 < height < 2**31):
        raise damaged(file, f"{where} has an impossible image size, {width} x {height}")
    camera = pycolmap.Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)
    if not camera.verify_params():
        raise damaged(file, f"{where} has {len(params)} parameters, {model.name} needs {camera.params_info}")
    if not np.isfinite(camera.params).all():
        raise damaged(file, f"{where} has a parameter that is not finite")
    if any(camera.params[i] <= 0 for i in camera.focal_length_idxs()):
        raise damaged(file, f"{where} has a focal length that is not positive")
    return camera


def _by_id(file: Path, cameras: list[pycolmap.Camera]) -> dict[int, pycolmap.Camera]:
    if not cameras:
        raise RefractError(f"{file}: there is no camera in the file; give one with at least one camera")
    by_id = {camera.camera_id: camera for camera in cameras}
    if len(by_id) != len(cameras):
        raise damaged(file, "a camera id occurs twice")
    return by_id


def _unknown_model(file: Path, camera_id: int, model: object) -> RefractError:
    import pycolmap

    return RefractError(
        f"{file}: camera {camera_id} has the model {model!r}, which pycolmap {pycolmap.__version__} does not know; "
        "update pycolmap, or copy the file again if it is damaged"
    )
