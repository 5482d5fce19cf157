"""The files of a calibration: `cameras.txt` for COLMAP, `calibration.json` with what is known of it, `coverage.png`.

    {"format": "colmap_refract calibration", "version": 1,
     "camera": {"model", "width", "height", "params": {name: {"value", "std"}}, "covariance": [[...], ...]},
     "board": {...}, "noise_px", "correlation", "rms_error_px", "max_view_error_px",
     "views": {name: {"num_corners", "rms_error_px", "max_error_px", "kept", "reason"}},
     "coverage": {"area", "corner_gaps": {corner: share}, "tilt_deg", "distance_squares": [min, max],
                  "distance_m": [min, max] or null, "direction_std_px": {"median", "max"}},
     "warnings": [...], "advice": [...]}

A number that is not finite is null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from colmap_refract.calibration.boards import Board
from colmap_refract.calibration.calibration import Calibration
from colmap_refract.calibration.coverage import CORNER_NAMES, Coverage, Verdict
from colmap_refract.calibration.picture import draw_coverage
from colmap_refract.errors import RefractError
from colmap_refract.files.model_files import MODEL_FILES
from colmap_refract.files.output import WORK_PREFIX
from colmap_refract.files.sidecar import SIDECAR_NAME

FORMAT = "colmap_refract calibration"
CAMERAS_NAME, JSON_NAME, PICTURE_NAME = "cameras.txt", "calibration.json", "coverage.png"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A calibration and what is said of it.

    Attributes:
        board: that was seen.
        square_size: side of its squares, metres; None if it was not told.
        calibration: the camera.
        coverage: of the image.
        verdict: whether to trust it.
    """

    board: Board
    square_size: float | None
    calibration: Calibration
    coverage: Coverage
    verdict: Verdict

    @property
    def params(self) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of each parameter by COLMAP's name."""
        camera = self.calibration.camera
        names = [name.strip() for name in camera.params_info.split(",")]
        return dict(
            zip(names, zip(map(float, camera.params), map(float, self.calibration.std), strict=True), strict=True)
        )


def check_folder(path: Path, image_path: Path, *, overwrite: bool) -> None:
    """Raise a RefractError if a calibration has no place in a folder: among images, in a COLMAP model, among files of
    another kind, or in place of an earlier calibration without `overwrite`."""
    target, source = path.resolve(), image_path.resolve()
    if target != source and source in target.parents:
        raise RefractError(f"the output folder {path} is among the images; choose one outside of {image_path}")
    for name in (*MODEL_FILES, SIDECAR_NAME):
        if not name.startswith("cameras.") and (path / name).exists():
            raise RefractError(f"the output folder {path} holds a COLMAP model; choose another for the calibration")
    if target == source or not _is_used(target):
        return
    if not _is_calibration(target):
        raise RefractError(
            f"the output folder {path} is not empty, and what is in it is no earlier calibration; choose another"
        )
    if not overwrite:
        raise RefractError(
            f"the output folder {path} holds an earlier calibration; choose another, or have it replaced "
            "(--overwrite 1)"
        )


def _is_used(folder: Path) -> bool:
    """Whether there is anything in a folder but what a killed run left; what cannot be read is refused later."""
    try:
        return any(not inside.name.startswith(WORK_PREFIX) for inside in folder.iterdir())
    except OSError:
        return False


def _is_calibration(folder: Path) -> bool:
    try:
        return bool(json.loads((folder / JSON_NAME).read_text(encoding="utf-8"))["format"] == FORMAT)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def write_calibration(outcome: Outcome, folder: Path) -> None:
    """Write the three files to a folder.

    Raises:
        OSError: they cannot be written.
    """
    camera = outcome.calibration.camera
    params = " ".join(repr(float(value)) for value in camera.params)
    (folder / CAMERAS_NAME).write_text(
        "# Camera list with one line of data per camera:\n"
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        "# Number of cameras: 1\n"
        f"1 {camera.model.name} {camera.width} {camera.height} {params}\n",
        encoding="utf-8",
    )
    text = json.dumps(_plain(_contents(outcome)), indent=2, ensure_ascii=False, allow_nan=False)
    (folder / JSON_NAME).write_text(text + "\n", encoding="utf-8")
    # Not cv2.imwrite, which does not say that the disk is full.
    _, data = cv2.imencode(".png", draw_coverage(outcome.calibration, outcome.coverage))
    (folder / PICTURE_NAME).write_bytes(data.tobytes())


def _contents(outcome: Outcome) -> dict[str, Any]:
    calibration, coverage = outcome.calibration, outcome.coverage
    camera, side = calibration.camera, outcome.square_size
    return {
        "format": FORMAT,
        "version": 1,
        "camera": {
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "params": {name: {"value": value, "std": std} for name, (value, std) in outcome.params.items()},
            "covariance": calibration.covariance,
        },
        "board": {**asdict(outcome.board), "square_size_m": side},
        "noise_px": calibration.noise,
        "correlation": calibration.correlation,
        "rms_error_px": calibration.rms_error,
        "max_view_error_px": calibration.max_view_error,
        "views": {
            fit.view.name: {
                "num_corners": len(fit.view.corner_idxs),
                "rms_error_px": fit.rms_error,
                "max_error_px": float(fit.errors.max()) if len(fit.errors) else None,
                "kept": not fit.dropped,
                "reason": fit.dropped or None,
            }
            for fit in calibration.views
        },
        "coverage": {
            "area": coverage.area,
            "corner_gaps": dict(zip(CORNER_NAMES, coverage.corner_gaps, strict=True)),
            "tilt_deg": coverage.tilt,
            "distance_squares": coverage.distances,
            "distance_m": [side * distance for distance in coverage.distances] if side else None,
            "direction_std_px": {"median": np.median(coverage.image_std), "max": np.max(coverage.image_std)},
        },
        "warnings": outcome.verdict.warnings,
        "advice": outcome.verdict.advice,
    }


def _plain(value: Any) -> Any:
    """What JSON knows."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    if isinstance(value, float):  # numpy's, too
        return float(value) if math.isfinite(value) else None
    return value
