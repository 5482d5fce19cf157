"""What was done, in words and numbers for a terminal; all from the sidecar, so that it can be said again later."""

from __future__ import annotations

from typing import Any

import numpy as np

from colmap_refract.files.sidecar import ImageInterface, Sidecar

_WIDTH = 78
_MOST_ROWS = 20
_PLACES = {"pixels": "the images", "scene": "the scene"}


def report(sidecar: Sidecar) -> str:
    """The report of a refinement.

    Args:
        sidecar: as written beside the model.

    Returns:
        Lines of text with units, without a final newline.
    """
    lines = [_rule(), f"Refractive refinement, {sidecar.scenario}", _rule()]
    lines += _model(sidecar)
    lines += ["", *_interfaces(sidecar)]
    lines += _waves(sidecar)
    lines += ["", *_solver(sidecar)]
    warnings = sidecar.solver.get("warnings") or []
    if warnings:
        lines += ["", *(f"WARNING: {sentence}" for sentence in warnings)]
    return "\n".join(lines)


def _rule() -> str:
    return "=" * _WIDTH


def _row(label: str, value: str) -> str:
    return f"{label + ':':34s}{value}"


def _model(sidecar: Sidecar) -> list[str]:
    s = sidecar.statistics
    before, after = s.get("num_observations_before"), s.get("num_observations")
    filtered = [
        (s.get("num_filtered_large_error"), "observations with a large error"),
        (s.get("num_filtered_small_angle"), "points with a small angle"),
        (s.get("num_dissolved_points3D"), "points left with too few observations"),
        (s.get("num_unusable_observations"), "observations that no two images could use"),
    ]
    removed = ", ".join(f"{count} {what}" for count, what in filtered if count) or "nothing"
    lines = [
        _row("Images", f"{s.get('num_images')} ({s.get('num_reg_images')} registered)"),
        _row("Points", f"{s.get('num_points3D_before')} before, {s.get('num_points3D')} after"),
        _row("Observations", f"{before} before, {after} after"),
        _row("Filtered", removed),
    ]
    gained = [
        (s.get("num_completed_observations"), "observations added"),
        (s.get("num_merged_points3D"), "points merged into others"),
        (s.get("num_created_points3D"), "points created"),
    ]
    if any(count is not None for count, _ in gained):
        lines.append(
            _row("From the database", ", ".join(f"{count} {what}" for count, what in gained if count) or "nothing")
        )
    if s.get("num_dry_observations"):
        lines.append(_row("Observations of dry points", str(s["num_dry_observations"])))
    lines += [
        _row("Mean reprojection error", _errors(s, "mean")),
        _row("Median reprojection error", _errors(s, "median")),
        _row("Keypoint noise, 1 sigma per axis", f"{_number(s.get('noise'))} px" + _how_known(s)),
    ]
    if s.get("median_point_std") is not None:
        deviation = f"{_number(s['median_point_std'])} {_unit(sidecar)} (median, cameras and interfaces held)"
        lines.append(_row("Points, 1 sigma, worst axis", deviation))
    reference = s.get("reference")
    if reference:
        lines += [
            _row(
                "Reference image", f"{reference.get('image')}, errors in {_PLACES.get(reference.get('residual'), '?')}"
            ),
            _row("Points it sees, adjusted", str(reference.get("num_points_adjusted"))),
            _row("Other points, placed afterwards", str(reference.get("num_points_placed"))),
        ]
    return lines


def _unit(sidecar: Sidecar) -> str:
    """Of lengths in the model."""
    return "m" if sidecar.units.get("distance") == "metre" else "model units"


def _how_known(statistics: dict[str, Any]) -> str:
    return " (given)" if (statistics.get("waves") or {}).get("num_normals") else ""


def _errors(statistics: dict[str, Any], kind: str) -> str:
    pinhole = _number(statistics.get(f"{kind}_pinhole_error_before"))
    return f"{pinhole} px without refraction, {_number(statistics.get(f'{kind}_reprojection_error'))} px with it"


def _interfaces(sidecar: Sidecar) -> list[str]:
    """A row per interface: the group's images share it."""
    groups: dict[str, list[ImageInterface]] = {}
    num_dry = 0
    for name, image in sidecar.images.items():
        if image.distance is None:
            num_dry += 1
        else:
            groups.setdefault(image.group or name, []).append(image)
    unit = _unit(sidecar)
    head = f"{'Interface':28s}{'images':>7s}  {'distance [' + unit + ']':28s}tilt [deg]"
    lines = [head, "-" * _WIDTH]
    for group, images in list(groups.items())[:_MOST_ROWS]:
        distances = np.array([image.distance for image in images])
        tilt = np.degrees(np.arccos(np.clip([(image.normal_in_cam or (0, 0, 1))[2] for image in images], -1.0, 1.0)))
        lines.append(
            f"{_short(group, 27):28s}{len(images):7d}  {_range(distances, images[0].distance_std):28s}"
            f"{_range(tilt, images[0].normal_std_deg):20s}".rstrip()
        )
    if len(groups) > _MOST_ROWS:
        lines.append(f"... and {len(groups) - _MOST_ROWS} more, see refraction.json")
    if num_dry:
        lines.append(f"{num_dry} images without an interface")
    media = ", ".join(
        f"{_number(t)} {unit} of index {mu:.4g}"
        for t, mu in zip(sidecar.layers.thickness, sidecar.layers.index, strict=False)
    )
    index = f"{sidecar.layers.refractive_index:.5g}"
    deviation = sidecar.solver.get("refractive_index_std")
    lines.append(_row("Refractive index", index + (f" +- {_number(deviation)}" if deviation else " (held)")))
    if media:
        lines.append(_row("Walls", media))
    if unit == "m":
        lines.append(_row("Size", "metres, from interface_distance" + _scale_worth(sidecar)))
    return lines


def _waves(sidecar: Sidecar) -> list[str]:
    waves = sidecar.statistics.get("waves")
    if not waves:
        return []
    unit = _unit(sidecar)
    if waves.get("num_normals"):
        return [
            _row("Waves", f"{waves['num_normals']} normals, one per observation; the planes are their means"),
            _row("Waves, slope about them (rms)", f"{_number(waves.get('slope_deviation_deg'))} deg"),
            _row(
                "Smoothness, lambda", f"{_number(waves.get('smoothness'))} within {_number(waves.get('radius_px'))} px"
            ),
        ]
    lines = [
        _row("Waves, slope (rms)", f"{_number(waves.get('slope_deviation_deg'))} deg"),
        _row(
            "Waves, dominant wavelength",
            f"about {_number(waves['wavelength'], 2)} {unit}" if "wavelength" in waves else "too short to be resolved",
        ),
        _row("Slopes that the surfaces take", f"{100 * waves.get('explained', 0.0):.4g} % of their variance"),
    ]
    if "level_tilt_deg" in waves:
        tilt, lift = _number(waves["level_tilt_deg"]), _number(waves.get("level_lift"))
        lines.append(_row("Planes about the mean level", f"tilt {tilt} deg, height {lift} of the distance (1 sigma)"))
    return lines


def _scale_worth(sidecar: Sidecar) -> str:
    """`sigma(scale) / scale = sigma(d) / d`: what a metric result is worth."""
    image = sidecar.images.get(str(sidecar.solver.get("reference_image")))
    if image is None or not image.distance or not image.distance_std:
        return ""
    return f", good to {100 * image.distance_std / image.distance:.2g} %"


def _solver(sidecar: Sidecar) -> list[str]:
    solver = sidecar.solver
    converged = "converged" if solver.get("converged") else "DID NOT CONVERGE"
    loss = f"{solver.get('loss_function_type')} ({_number(solver.get('loss_function_scale'))} px)"
    in_scene = (sidecar.statistics.get("reference") or {}).get("residual") == "scene"
    unit = "px^2" if not in_scene else "m^2" if sidecar.units.get("distance") == "metre" else "model units^2"
    lines = [
        _row("Solver", f"{converged} after {solver.get('num_iterations')} iterations"),
        _row("Termination", str(solver.get("message", "")).strip()),
        _row("Cost", f"{_number(solver.get('cost'), 6)} {unit}, loss {loss}"),
        _row("Gradient (largest entry)", f"{_number(solver.get('gradient_max_norm'))} {unit} per unit"),
    ]
    decrement = solver.get("newton_decrement")
    if decrement is not None and np.isfinite(decrement):
        lines.append(_row("Still to gain by Newton's method", f"{_number(decrement)} of the cost"))
    return lines


def _range(values: Any, deviation: float | None) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    text = _number(low, 4) if high - low <= 1e-3 * max(abs(high), 1e-12) else f"{_number(low, 4)} to {_number(high, 4)}"
    return text + (f" +- {_number(deviation, 2)}" if deviation is not None else "")


def _number(value: Any, digits: int = 3) -> str:
    return "?" if value is None else f"{value:.{digits}g}"


def _short(text: str, length: int) -> str:
    return text if len(text) <= length else "..." + text[-(length - 3) :]
