"""Reading and writing COLMAP models, so that neither a damaged file nor a full disk does harm.

The files are walked first, against their size and against each other, and pycolmap reads only what it can
digest. Written files go through the same walk.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.files.binary_files import skip_frame, skip_rig, tables_from_binary, walk
from colmap_refract.files.cameras_file import cameras_from_binary, cameras_from_text
from colmap_refract.files.model_files import (
    MODEL_FILES,
    MODEL_NAMES,
    NO_POINT,
    RIG_NAMES,
    check_images,
    check_tracks,
    damaged,
    readable,
)
from colmap_refract.files.quiet import quiet_pycolmap
from colmap_refract.files.sidecar import SIDECAR_NAME
from colmap_refract.files.text_files import tables_from_text

if TYPE_CHECKING:
    import pycolmap

EXPECTED = "cameras, images and points3D, all as .bin or all as .txt"


@dataclass(frozen=True, kw_only=True)
class _Contents:
    """What pycolmap must find in the files; names and numbers of keypoints by `image_id`."""

    names: dict[int, str] = field(compare=False)  # pycolmap cuts a name in a text file at its first space
    num_keypoints: dict[int, int]
    num_points: int
    num_observations: int


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
    with readable(folder):
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


def copy_model(reconstruction: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A deep copy, images without a pose included: nothing done to one is seen in the other."""
    import pycolmap

    return pycolmap.Reconstruction(reconstruction)


def write_model(reconstruction: pycolmap.Reconstruction, folder: Path) -> None:
    """Write the five binary files of a model and verify that they are complete.

    As COLMAP does, only images with a pose are written.

    Args:
        folder: an existing folder, as `output_folder` yields it.

    Raises:
        RefractError: the files cannot be written, or not whole because the disk is full.
    """
    cameras, images, points, rigs, frames = (folder / f"{name}.bin" for name in MODEL_NAMES + RIG_NAMES)
    with quiet_pycolmap():
        try:
            reconstruction.write_binary(folder)
            # COLMAP does not look whether the disk took what it wrote.
            tables = tables_from_binary(images, points)
            written = (
                len(cameras_from_binary(cameras)),
                len(walk(rigs, skip_rig)[1]),
                len(walk(frames, skip_frame)[1]),
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
        patterns = ("*", "sparse_refractive/*", "sparse/*")
        inside = [p for pattern in patterns for p in sorted(folder.glob(pattern)) if _model_suffix(p)]
        if inside:
            shown = (f"{p}{' (refined)' if (p / SIDECAR_NAME).is_file() else ''}" for p in inside[:3])
            message += f"; did you mean {' or '.join(shown)}?"
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
        camera_ids = set(cameras_from_binary(cameras_file))
        tables = tables_from_binary(images_file, points_file)
        if rigs_file.is_file():
            walk(rigs_file, skip_rig)
            walk(frames_file, skip_frame)
    else:
        camera_ids = set(cameras_from_text(cameras_file))
        tables = tables_from_text(images_file, points_file)
    if not tables.image_ids:
        raise RefractError(f"{images_file}: no image is registered; give a model with at least one posed image")
    if not tables.points.size:
        raise RefractError(f"{points_file}: the model has no points; triangulate it first")
    check_images(tables, camera_ids, images_file)
    check_tracks(tables, images_file, points_file)
    return _Contents(
        names=dict(zip(tables.image_ids, tables.names, strict=True)),
        num_keypoints={image_id: len(k) for image_id, k in zip(tables.image_ids, tables.keypoints, strict=True)},
        num_points=len(tables.points),
        num_observations=sum(int((k["point3D_id"] != NO_POINT).sum()) for k in tables.keypoints),
    )


def _read_with_pycolmap(folder: Path, suffix: str) -> pycolmap.Reconstruction:
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    with quiet_pycolmap():
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
            raise damaged(file, f"the pose of {where} is not finite")
        # Six digits in a text file are still a rotation; an altered byte is not.
        if abs(np.linalg.norm(pose.rotation.quat) - 1) > 1e-3:
            raise damaged(file, f"the rotation of {where} is not a unit quaternion")


def _reason(error: Exception) -> str:
    """pycolmap's message as one short line, without the place in its source."""
    text = "".join(c if c.isprintable() else " " for c in str(error))
    return " ".join(re.sub(r"^\[\S+:\d+\] ", "", text).split())[:120]
