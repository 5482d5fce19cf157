"""`flow_matcher`: a COLMAP database from the frames of a fixed camera, by tracking in place of matching."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from colmap_refract.commands.progress import ProgressLine
from colmap_refract.optical_flow.options import FlowOptions

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class FlowMatcher:
    """Track the frames of a fixed camera against one of them, and write a new COLMAP database.

    Frames that are blurred by waves can be tracked where features no longer match. Matches are those of the
    reference frame with every other frame, and count as verified.
    """

    database_path: Path
    """COLMAP database to write. Nothing may be there yet."""
    image_path: Path
    """Folder of the frames, all of one size."""
    options: Annotated[FlowOptions, tyro.conf.arg(name="")]
    camera_path: Path | None = None
    """COLMAP cameras file (.bin or .txt) with the camera's intrinsics, calibrated in air."""
    reference_image: str = ""
    """Name of the frame that the others are tracked against. By default the one that they differ least from."""

    def run(self) -> None:
        """Look, track, write, report."""
        from colmap_refract.files.cameras_file import read_cameras
        from colmap_refract.mapping.flow_database import calibrated_camera, check_new_database, create_flow_database
        from colmap_refract.optical_flow.reference import check_names, choose_reference
        from colmap_refract.optical_flow.report import flow_report, lost_warning
        from colmap_refract.optical_flow.tracking import track_against_reference
        from colmap_refract.photographs.images import Gray, image_size, list_images, read_gray

        def read(name: str) -> Gray:
            return read_gray(self.image_path / name)

        check_new_database(self.database_path)
        names = list_images(self.image_path)
        check_names(names, self.reference_image or None)
        camera = None
        if self.camera_path is not None:
            camera = calibrated_camera(read_cameras(self.camera_path), image_size(self.image_path / names[0]))
        with ProgressLine() as line:
            reference = self.reference_image or choose_reference(read, names, watch=line.say)
            tracks = track_against_reference(read, names, reference, self.options, watch=line.say)
            line.say("Writing ...")
            create_flow_database(self.database_path, self.image_path, names, camera, tracks)
        if camera is None:
            logger.warning("the intrinsics are COLMAP's guess; calibrate the camera in air and give camera_path")
        if warning := lost_warning(tracks):
            logger.warning(warning)
        print(flow_report(tracks))
        print(f"\nWritten to {self.database_path}")
