"""What a calibration found and what it is worth, in words and numbers for a terminal."""

from __future__ import annotations

import numpy as np

from colmap_refract.calibration.calibration import ViewFit
from colmap_refract.calibration.coverage import CORNER_NAMES
from colmap_refract.calibration.output import JSON_NAME, Outcome

_WIDTH = 78
_MOST_ROWS = 40


def report(outcome: Outcome) -> str:
    """The report of a calibration: lines of text with units, without a final newline."""
    title = f"Camera calibration, {outcome.calibration.camera.model.name}"
    lines = ["=" * _WIDTH, title, "=" * _WIDTH]
    lines += _summary(outcome)
    lines += ["", *_params(outcome)]
    lines += ["", *_views(outcome)]
    lines += ["", *_worth(outcome)]
    verdict = outcome.verdict
    if verdict.warnings:
        lines += ["", "Not to be trusted as it is:", *(f"WARNING: {sentence}" for sentence in verdict.warnings)]
    if verdict.advice:
        lines += ["", "What would make it better:", *(f"- {sentence}" for sentence in verdict.advice)]
    return "\n".join(lines)


def _row(label: str, value: str) -> str:
    return f"{label + ':':34s}{value}"


def _summary(outcome: Outcome) -> list[str]:
    calibration = outcome.calibration
    camera, kept = calibration.camera, calibration.kept
    found = sum(len(fit.view.corner_idxs) > 0 for fit in calibration.views)
    side = f", squares of {1000 * outcome.square_size:.4g} mm" if outcome.square_size else ""
    largest = max(float(fit.errors.max()) for fit in kept)
    return [
        _row("Board", f"{outcome.board}{side}"),
        _row("Images", f"{len(calibration.views)} of {camera.width} x {camera.height} px"),
        _row("Views of the board", f"{found}, {len(kept)} of them used"),
        _row("Corners", f"{sum(len(fit.errors) for fit in kept)}"),
        _row("Reprojection error", f"{calibration.rms_error:.3g} px (rms), largest {largest:.3g} px"),
        _row("Corner noise (1 sigma, per axis)", f"{calibration.noise:.3g} px"),
        _row("Correlation of neighbours", f"{calibration.correlation:.2f} (0 for independent errors)"),
    ]


def _params(outcome: Outcome) -> list[str]:
    camera = outcome.calibration.camera
    in_pixels = {*camera.focal_length_idxs(), *camera.principal_point_idxs()}
    lines = [f"{'Parameter':12s}{'value':>16s}    1 sigma", "-" * _WIDTH]
    for index, (name, (value, std)) in enumerate(outcome.params.items()):
        unit = " px" if index in in_pixels else ""
        places = int(np.clip(1 - np.floor(np.log10(std)), 1, 9)) if 0 < std < np.inf else 6
        lines.append(f"{name:12s}{value:16.{places}f} +- {std:.2g}{unit}")
    return lines


def _views(outcome: Outcome) -> list[str]:
    views = outcome.calibration.views
    lines = [f"{'View':34s}{'corners':>8s}{'rms [px]':>10s}{'largest [px]':>14s}", "-" * _WIDTH]
    for fit in views[:_MOST_ROWS]:
        lines.append(f"{_short(fit.view.name, 33):34s}{len(fit.view.corner_idxs):8d}{_errors(fit)}")
        if fit.dropped:
            lines.append(f"    not used: {fit.dropped}")
    if len(views) > _MOST_ROWS:
        lines.append(f"... and {len(views) - _MOST_ROWS} more, see {JSON_NAME}")
    return lines


def _errors(fit: ViewFit) -> str:
    if not len(fit.errors) or not np.isfinite(fit.rms_error):
        return f"{'-':>10s}{'-':>14s}"
    return f"{fit.rms_error:10.3g}{fit.errors.max():14.3g}"


def _worth(outcome: Outcome) -> list[str]:
    coverage = outcome.coverage
    side, (near, far) = outcome.square_size, coverage.distances
    metres = f" ({side * near:.3g} to {side * far:.3g} m)" if side else ""
    gap, corner = max(zip(coverage.corner_gaps.tolist(), CORNER_NAMES, strict=True))
    median, worst = float(np.median(coverage.image_std)), float(np.max(coverage.image_std))
    at_worst = f"{worst:.2g} px at worst" if np.isfinite(worst) else "in parts to nothing"
    return [
        _row("Image covered by the board", f"{100 * coverage.area:.0f} %"),
        _row("Least covered corner", f"{corner}, a gap of {100 * gap:.0f} % of half the diagonal"),
        _row("Directions of the board", f"up to {coverage.tilt:.0f} degrees apart"),
        _row("Distance of the board", f"{near:.3g} to {far:.3g} squares{metres}"),
        _row("Directions seen (1 sigma)", f"good to {median:.2g} px (median over the image), {at_worst}"),
    ]


def _short(text: str, length: int) -> str:
    return text if len(text) <= length else "..." + text[-(length - 3) :]
