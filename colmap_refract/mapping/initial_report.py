"""What was found of start values, in words and numbers for a terminal."""

from __future__ import annotations

from colmap_refract.mapping.initial import InitialModel

_WIDTH = 78
_MOST_PAIRS = 8


def report(initial: InitialModel) -> str:
    """The report of start values: lines of text with units, without a final newline."""
    model = initial.reconstruction
    lines = ["=" * _WIDTH, "Start values, refraction ignored", "=" * _WIDTH]
    lines += [
        _row("Images", f"{model.num_images()} ({model.num_reg_images()} registered)"),
        _row("Reference image", initial.reference_image),
        _row("Points", str(model.num_points3D())),
        _row("Observations", str(model.compute_num_observations())),
        _row("Mean reprojection error", f"{model.compute_mean_reprojection_error():.3g} px without refraction"),
    ]
    if initial.reliability is not None:
        relief = f"a relief about one depth, reliability {initial.reliability:.2f} (1: two halves of the images agree)"
        lines.append(_row("Depths", relief if initial.reliability else "one for all points: no relief stands out"))
    lines += ["", f"{'Pairs of images averaged':44s}{'points':>10s}{'angle [deg]':>15s}", "-" * _WIDTH]
    lines += [
        f"{f'{pair.first}, {pair.second}':44s}{pair.num_points:10d}{pair.angle_deg:15.3g}"
        for pair in initial.pairs[:_MOST_PAIRS]
    ]
    if len(initial.pairs) > _MOST_PAIRS:
        lines.append(f"... and {len(initial.pairs) - _MOST_PAIRS} more")
    if initial.warnings:
        lines += ["", *(f"WARNING: {sentence}" for sentence in initial.warnings)]
    return "\n".join(lines)


def _row(label: str, value: str) -> str:
    return f"{label + ':':34s}{value}"
