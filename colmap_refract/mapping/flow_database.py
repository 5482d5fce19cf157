"""A COLMAP database of tracks that were found by optical flow: what feature extraction and matching would leave."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

from colmap_refract.errors import RefractError, reason_of
from colmap_refract.files.output import WORK_PREFIX
from colmap_refract.files.quiet import quiet_pycolmap
from colmap_refract.mapping.database import open_database, write_tracks

if TYPE_CHECKING:
    import pycolmap

    from colmap_refract.optical_flow.tracking import FlowTracks

_SIDE_FILES = ("", "-journal", "-wal", "-shm")
"""What SQLite may keep beside a database, and itself."""
# More than a database and its journal take at their largest.
_BYTES_PER_VALUE, _BYTES_PER_IMAGE, _BYTES_EMPTY = 10, 4096, 1 << 20


def check_new_database(path: Path) -> None:
    """Raise RefractError where there is something at the path, or no folder to put a database into."""
    if os.path.lexists(path):
        raise RefractError(f"{path} exists already; choose another database_path, or delete it first")
    if not path.absolute().parent.is_dir():
        raise RefractError(f"there is no folder {path.absolute().parent} for the database; make it first")


def calibrated_camera(cameras: dict[int, pycolmap.Camera], image_size: tuple[int, int]) -> pycolmap.Camera:
    """The one camera of a cameras file, if it is of images of that size (width, height).

    Raises:
        RefractError: there are several, or it is of another size.
    """
    if len(cameras) != 1:
        raise RefractError(f"the cameras file holds {len(cameras)} cameras, but one took all images; give that alone")
    (camera,) = cameras.values()
    if (camera.width, camera.height) != image_size:
        raise RefractError(
            f"the camera is calibrated for {camera.width} x {camera.height} pixels, but the images have "
            f"{image_size[0]} x {image_size[1]}; give images of that size, or the calibration of this one"
        )
    return camera


def create_flow_database(
    database_path: str | Path,
    image_path: str | Path,
    names: Sequence[str],
    camera: pycolmap.Camera | None,
    tracks: FlowTracks,
) -> None:
    """Write a new database: images, one camera, rig and frames as COLMAP imports them, keypoints and matches.

    It appears whole or not at all.

    Args:
        database_path: where nothing is yet.
        image_path: folder of the images.
        names: of all images, relative to the folder; those without tracks are in the database, too.
        camera: calibrated in air; it then counts as known beforehand. Otherwise COLMAP's guess, from EXIF or the
            size of the images.
        tracks: of `optical_flow.tracking`; the matches count as verified.

    Raises:
        RefractError: there is something at the path, it cannot be written to, or COLMAP cannot read an image.
    """
    path = Path(database_path)
    check_new_database(path)
    values = sum(points.size for points in tracks.keypoints.values()) + sum(m.size for m in tracks.matches.values()) * 2
    with _appearing(path, num_bytes=_BYTES_PER_VALUE * values + _BYTES_PER_IMAGE * len(names) + _BYTES_EMPTY) as new:
        _import_images(new, Path(image_path), names, camera)
        write_tracks(new, tracks.keypoints, tracks.matches)


@contextmanager
def _appearing(path: Path, *, num_bytes: int) -> Iterator[Path]:
    """The path of a temporary database, which is moved to `path` if the block ends without an exception."""
    new = path.absolute().parent / f"{WORK_PREFIX}{uuid4().hex[:12]}.db"
    try:
        # pycolmap ends the process when the disk is full at the end of a transaction, so that is found out before.
        with new.open("xb") as file:
            file.write(bytes(num_bytes))
            os.fsync(file.fileno())
        os.truncate(new, 0)
        with quiet_pycolmap():
            yield new
        with closing(sqlite3.connect(new)) as connection:
            connection.execute("PRAGMA journal_mode = DELETE")  # which brings all that was written into the one file
        with new.open("rb+") as file:
            os.fsync(file.fileno())
        check_new_database(path)
        os.rename(new, path)
    except (OSError, sqlite3.Error) as error:
        raise RefractError(f"cannot write {path}: {reason_of(error)}; choose another database_path") from error
    finally:
        for side in _SIDE_FILES:
            with suppress(OSError):
                os.unlink(f"{new}{side}")


def _import_images(path: Path, image_path: Path, names: Sequence[str], camera: pycolmap.Camera | None) -> None:
    import pycolmap

    try:
        pycolmap.Database.open(path).close()
        pycolmap.import_images(path, image_path, pycolmap.CameraMode.SINGLE, list(names))
    except (RuntimeError, ValueError) as error:
        raise RefractError(f"COLMAP cannot import the images of {image_path} ({error}); look at them") from None
    with open_database(path) as database:
        imported = {image.name for image in database.read_all_images()}
        missing = [name for name in names if name not in imported]
        if missing:
            raise RefractError(f"COLMAP cannot read the image {image_path / missing[0]}; convert it to PNG or JPEG")
        if camera is not None:
            (guess,) = database.read_all_cameras()
            known = pycolmap.Camera(camera.todict())
            known.camera_id = guess.camera_id
            known.has_prior_focal_length = True
            database.update_camera(known)
