"""Which camera took which image: calibrated intrinsics dealt out to the images, rescaled where that is sound."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Literal

from colmap_refract.errors import RefractError
from colmap_refract.files.cameras_file import fit_to_size
from colmap_refract.files.quiet import quiet_pycolmap
from colmap_refract.reconstructor.inventory import by_size, only_size
from colmap_refract.reconstructor.record import Photograph

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class CameraGroup:
    """Images of one camera.

    Attributes:
        names: of the images.
        camera: intrinsics for their size.
    """

    names: list[str]
    camera: pycolmap.Camera


@dataclass(frozen=True, kw_only=True)
class Assignment:
    """Every image in one group.

    Attributes:
        groups: images by camera.
        scheme: what told the cameras apart.
        calibrated: whether the intrinsics were given; otherwise they are COLMAP's guess.
        remarks: what the user should know of how the cameras were dealt out.
    """

    groups: list[CameraGroup]
    scheme: Literal["single", "size", "folder"] = "single"
    calibrated: bool = True
    remarks: list[str] = field(default_factory=list)

    @property
    def camera_of(self) -> dict[str, pycolmap.Camera]:
        """By image name."""
        return {name: group.camera for group in self.groups for name in group.names}


def assign_cameras(
    photographs: Mapping[str, Photograph],
    image_path: Path,
    cameras: Mapping[int, pycolmap.Camera] | None,
    source: Path | None,
    *,
    known: bool = False,
) -> Assignment:
    """Deal out calibrated cameras.

    One camera is that of all images. Several are told apart by their image size, or, where sizes are the same, one is
    given to each folder of images, in the order of the cameras' ids and of the folders' names.

    Args:
        photographs: by name.
        image_path: their folder.
        cameras: calibrated in air, by id; None if there are none.
        source: file they come from, for messages.
        known: whether there is a database that may know better than a guess, also of images of several sizes.

    Raises:
        RefractError: images of several sizes without a camera for each, a calibration for another shape of image, or
            cameras that cannot be told apart.
    """
    photographs = dict(photographs)
    if cameras is None:
        if not known:
            only_size(photographs)
        sizes = by_size(photographs)
        groups = [CameraGroup(names=names, camera=_guess(image_path / names[0])) for names in sizes.values()]
        return Assignment(groups=groups, scheme="size" if len(groups) > 1 else "single", calibrated=False)
    if len(cameras) == 1:
        size = only_size(photographs)
        camera, remark = fitted_camera(next(iter(cameras.values())), size)
        group = CameraGroup(names=list(photographs), camera=camera)
        return Assignment(groups=[group], remarks=[remark] if remark else [])
    sizes = by_size(photographs)
    by_camera_size: dict[tuple[int, int], list[pycolmap.Camera]] = {}
    for _, camera in sorted(cameras.items()):
        by_camera_size.setdefault((camera.width, camera.height), []).append(camera)
    if all(len(same) == 1 for same in by_camera_size.values()):
        for (width, height), names in sizes.items():
            if (width, height) not in by_camera_size:
                theirs = ", ".join(f"{w} x {h}" for w, h in by_camera_size)
                raise RefractError(
                    f"'{names[0]}' has {width} x {height} pixels, the cameras of {source} are for {theirs}; "
                    "give the camera that took it"
                )
        groups = [CameraGroup(names=names, camera=by_camera_size[size][0]) for size, names in sizes.items()]
        said = ", ".join(f"{len(group.names)} of {group.camera.width} x {group.camera.height}" for group in groups)
        return Assignment(groups=groups, scheme="size", remarks=[f"cameras by image size: {said}"])
    folders: dict[str, list[str]] = {}
    for name in photographs:
        folders.setdefault(PurePosixPath(name).parent.as_posix(), []).append(name)
    if len(folders) != len(cameras):
        raise RefractError(
            f"the {len(cameras)} cameras of {source} cannot be told apart by image size, and the images are in "
            f"{len(folders)} folder{'s' if len(folders) > 1 else ''}; put the images of each camera into a folder of "
            "their own"
        )
    groups, remarks = [], []
    for (folder, names), (camera_id, camera) in zip(sorted(folders.items()), sorted(cameras.items()), strict=True):
        fitted, remark = fitted_camera(camera, only_size({name: photographs[name] for name in names}))
        groups.append(CameraGroup(names=names, camera=fitted))
        remarks.append(f"folder {folder} taken by camera {camera_id}" + (f" ({remark})" if remark else ""))
    return Assignment(groups=groups, scheme="folder", remarks=remarks)


def fitted_camera(camera: pycolmap.Camera, size: tuple[int, int]) -> tuple[pycolmap.Camera, str]:
    """The camera for images of a size, and what has been done to it ('' for nothing)."""
    known = (int(camera.width), int(camera.height))
    if known == size:
        return fit_to_size(camera, *size), ""
    fitted = fit_to_size(camera, *size)
    return fitted, f"calibration rescaled from {known[0]} x {known[1]} to {size[0]} x {size[1]} pixels"


def _guess(path: Path) -> pycolmap.Camera:
    """COLMAP's guess of the camera that took an image: the focal length from EXIF, or 1.2 times the longer side."""
    import pycolmap

    try:
        with quiet_pycolmap():
            return pycolmap.infer_camera_from_image(path)
    except (RuntimeError, ValueError):
        raise RefractError(f"COLMAP cannot read the image {path}; remove or replace it") from None
