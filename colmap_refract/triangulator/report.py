"""What was triangulated: words and numbers for a terminal, and a table of the points' standard deviations."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colmap_refract.interface import Array
from colmap_refract.triangulator.options import TriangulatorOptions
from colmap_refract.triangulator.outcome import Triangulation

_COLUMNS = "point3D_id,x,y,z,std_x,std_y,std_z,std,num_observations,reprojection_error"
_WIDTH = 78


def report(triangulation: Triangulation, options: TriangulatorOptions) -> str:
    """Lines of text with units, without a final newline."""
    s = triangulation.sidecar.statistics
    unit = "m" if triangulation.sidecar.units.get("distance") == "metre" else "model units"
    removed = [
        (s["num_filtered_large_error"], "observations with a large error"),
        (s["num_filtered_small_angle"], "points with a small angle"),
        (s["num_dissolved_points3D"], "points left with too few observations"),
    ]
    lines = ["=" * _WIDTH, "Triangulation through waves", "=" * _WIDTH]
    lines += [
        _row("Waves, root mean square slope", f"{options.slope_deviation_deg:g} deg"),
        _row("Keypoint noise, 1 sigma per axis", f"{options.pixel_noise:g} px"),
        _row("Points", f"{s['num_points3D_before']} before, {s['num_points3D']} after"),
        _row("Observations", f"{s['num_observations_before']} before, {s['num_observations']} after"),
        _row("Filtered", ", ".join(f"{count} {what}" for count, what in removed if count) or "nothing"),
    ]
    if s["num_dry_observations"]:
        lines.append(_row("Observations of dry points", str(s["num_dry_observations"])))
    lines += [
        _row(
            "Reprojection error, with waves",
            f"{s['mean_reprojection_error']:.3g} px mean, {s['median_reprojection_error']:.3g} px median",
        ),
        _row("Errors over those expected", f"{triangulation.error_scale:.3g} (1 if slope and noise are as given)"),
        "",
        f"{f'Standard deviation [{unit}]':34s}{'median':>12s}{'best 10 %':>14s}{'worst 10 %':>14s}",
        "-" * _WIDTH,
        _quantiles("along the view", triangulation.std_along),
        _quantiles("across the view, per axis", triangulation.std_across),
        _quantiles("all three axes together", triangulation.std),
    ]
    if triangulation.warnings:
        lines += ["", *(f"WARNING: {sentence}" for sentence in triangulation.warnings)]
    return "\n".join(lines)


def write_point_std(triangulation: Triangulation, path: Path) -> None:
    """A line per point, by id: position and standard deviations in model units, mean reprojection error in px.

    `std` is the root of the covariance's trace; `inf` where no parallax tells the depth.
    """
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(_COLUMNS + "\n")
        rows = zip(
            triangulation.point3D_ids.tolist(),
            triangulation.points.tolist(),
            triangulation.std_per_axis.tolist(),
            triangulation.std.tolist(),
            triangulation.num_observations.tolist(),
            triangulation.reprojection_error.tolist(),
            strict=True,
        )
        for point3D_id, xyz, per_axis, std, count, error in rows:
            position = ",".join(repr(value) for value in xyz)
            deviations = ",".join(f"{value:.6g}" for value in (*per_axis, std))
            file.write(f"{point3D_id},{position},{deviations},{count},{error:.6g}\n")


def _row(label: str, value: str) -> str:
    return f"{label + ':':34s}{value}"


def _quantiles(label: str, values: Array) -> str:
    # Of infinite values there is no interpolation.
    best, median, worst = np.quantile(values, [0.1, 0.5, 0.9], method="nearest")
    return f"{label:34s}{median:12.3g}{best:14.3g}{worst:14.3g}"
