"""What came of dense matching, for people to read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from colmap_refract.dense.options import DenseOptions
from colmap_refract.dense.reconstruction import DenseView

_WIDTH = 78


def report(views: Sequence[DenseView], options: DenseOptions, min_tri_angle: float) -> str:
    """Lines of text with units, without a final newline.

    Args:
        views: of `reconstruct`; at least one has points.
        options: that they were made with.
        min_tri_angle: the limit that was used, degrees.
    """
    errors, angles, num_views = (
        np.concatenate([getattr(view, name) for view in views]) for name in ("errors", "angles", "num_views")
    )
    lines = ["=" * _WIDTH, "Dense points", "=" * _WIDTH]
    lines += [
        _row("Points", f"{len(errors)}"),
        _row("Reprojection error", f"{np.median(errors):.3g} px (median)"),
        _row("Images that see a point", f"{np.median(num_views):.3g} (median)"),
        _row("Angle between its rays", f"{np.median(angles):.3g} deg (median)"),
    ]
    for view in views:
        removed = {
            f"matched in fewer than {options.min_num_views} images": view.num_unmatched,
            f"fit fewer within {options.max_reproj_error:g} px": view.num_large_error,
            f"rays meet below {min_tri_angle:g} deg": view.num_small_angle,
            f"depth more than {100 * options.max_depth_error:g} % off its neighbours', or alone": view.num_far_off,
        }
        lines += [
            "",
            _row("Reference", f"{view.name}, with {len(view.neighbours)} others"),
            _row("Grid", f"{view.num_nodes} nodes, a step of {view.step} px"),
        ]
        if view.num_covered:
            lines.append(_row("Covered by earlier references", f"{view.num_covered} nodes"))
        lines.append(_row("Points", f"{len(view.points)}, {100 * view.coverage:.1f} % of the grid covered"))
        lines += [
            _row("  without" if k == 0 else "", f"{count}: {why}") for k, (why, count) in enumerate(removed.items())
        ]
    return "\n".join(lines)


def _row(label: str, value: str) -> str:
    return f"{label + ':' if label.strip() else '':34s}{value}"
