"""`camera_calibrator`: pictures of a board in air in, a camera with its uncertainty out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from colmap_refract.commands.progress import ProgressLine
from colmap_refract.errors import RefractError


@dataclass(frozen=True, kw_only=True)
class CameraCalibrator:
    """Calibrate a camera in air from pictures of a chessboard or a ChArUco board.

    Take 10 to 20 sharp pictures with focus and zoom as they will be under water: the board in every part of the image,
    tilted by 20 to 40 degrees to different sides. Writes cameras.txt, a COLMAP cameras file, calibration.json with the
    errors of the views and the standard deviations, and coverage.png.
    """

    image_path: Path
    """Folder of the pictures, all by one camera."""
    output_path: Path
    """Folder to write the calibration to; the refiner takes it as camera_path."""
    board: Literal["chessboard", "charuco"]
    """Kind of the board: chessboard (must be seen as a whole, with a white rim) or charuco (may be seen in part)."""
    num_columns: int
    """Squares along a row of the board. Squares are counted, not inner corners."""
    num_rows: int
    """Squares along a column of the board. Squares are counted, not inner corners."""
    square_size: float | None = None
    """Side of a square, metres. Only for the distances in the report."""
    marker_size: float | None = None
    """Side of a marker of a charuco board, metres; needs square_size. By default three quarters of a square."""
    dictionary: str | None = None
    """ArUco dictionary of a charuco board, e.g. DICT_5X5_100."""
    camera_model: Literal[
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
        "FULL_OPENCV",
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
        "OPENCV_FISHEYE",
    ] = "OPENCV"
    """COLMAP's camera model. SIMPLE_RADIAL for few views, OPENCV_FISHEYE for more than about 120 degrees."""
    max_view_error: float | None = None
    """Views with a larger reprojection error (rms), px, are dropped.
    By default three times the median of the views, and no less than 0.2."""
    overwrite: bool = False
    """Replace a calibration that is at output_path."""

    def run(self) -> None:
        """Look for the board, calibrate, write, report."""
        for name, value in (("square_size", self.square_size), ("marker_size", self.marker_size)):
            if value is not None and not 0 < value < float("inf"):
                raise RefractError(f"{name} {value:g} is not positive; give metres")
        if self.max_view_error is not None and not self.max_view_error > 0:
            raise RefractError(
                f"max_view_error {self.max_view_error:g} px is not positive; leave it out for the default"
            )
        for name, given in (("marker_size", self.marker_size), ("dictionary", self.dictionary)):
            if given is not None and self.board == "chessboard":
                raise RefractError(f"{name} is of a charuco board; leave it out, or give --board charuco")
        if self.marker_size is not None and self.square_size is None:
            raise RefractError("marker_size needs square_size beside it")

        from colmap_refract.calibration.boards import Board
        from colmap_refract.calibration.calibration import calibrate
        from colmap_refract.calibration.coverage import judge, measure_coverage
        from colmap_refract.calibration.output import Outcome, check_folder, write_calibration
        from colmap_refract.calibration.report import report
        from colmap_refract.calibration.search import find_boards
        from colmap_refract.files.output import output_folder

        board = Board(
            kind=self.board,
            num_columns=self.num_columns,
            num_rows=self.num_rows,
            marker_size=self.marker_size / self.square_size if self.marker_size and self.square_size else None,
            dictionary=self.dictionary,
        )
        check_folder(self.output_path, self.image_path, overwrite=self.overwrite)
        with (
            output_folder(self.output_path, input_path=self.image_path, overwrite=self.overwrite) as folder,
            ProgressLine() as line,
        ):
            views, size = find_boards(self.image_path, board, line.say)
            line.say("Calibrating ...")
            calibration = calibrate(board.corners, views, size, self.camera_model, self.max_view_error)
            coverage = measure_coverage(calibration, board.corners)
            outcome = Outcome(
                board=board,
                square_size=self.square_size,
                calibration=calibration,
                coverage=coverage,
                verdict=judge(calibration, coverage),
            )
            write_calibration(outcome, folder)
        print(report(outcome))
        print(f"\nWritten to {self.output_path}")
