"""The README's figure: height errors of a simulated pool, with refraction ignored and after the refinement.

    python benchmarks/figure.py

Writes `results/figure.svg`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colmap_refract import RefinerOptions, refine
from colmap_refract.simulation import SceneOptions, ignore_refraction, point_rmse, simulate
from colmap_refract.simulation.accuracy import align

_WIDTH, _HEIGHT, _MARGIN = 820, 250, 50
_COLORS = {"refraction ignored": "#c0504d", "colmap_refract": "#1f77b4"}


def main() -> None:
    capture = simulate(SceneOptions(scenario="static_interface", num_images=18, num_points=600, seed=2))
    start = ignore_refraction(capture)
    result = refine(start, RefinerOptions(scenario="static_interface"))
    series = {"refraction ignored": start, "colmap_refract": result.reconstruction}
    ids = sorted(result.reconstruction.point3D_ids())
    truth = np.array([capture.reconstruction.point3D(i).xyz for i in ids])
    across = truth[:, 0] - truth[:, 0].mean()
    errors = {}
    for name, model in series.items():
        points = np.array([model.point3D(i).xyz for i in ids])
        errors[name] = 1e3 * (align(points, truth, points) - truth)[:, 2]
    reach = 1.05 * max(np.abs(e).max() for e in errors.values())
    half = 1.02 * np.abs(across).max()

    def x_of(value: float) -> float:
        return _MARGIN + (value + half) / (2 * half) * (_WIDTH - 1.5 * _MARGIN)

    def y_of(value: float) -> float:
        return (_HEIGHT - 40) * (0.5 - 0.5 * value / reach) + 8

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{_HEIGHT}" font-family="sans-serif" '
        f'font-size="12"><rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>'
    ]
    step = 10.0 ** np.floor(np.log10(reach))
    for tick in np.arange(-np.floor(reach / step), np.floor(reach / step) + 1) * step:
        parts.append(
            f'<line x1="{_MARGIN}" x2="{_WIDTH - _MARGIN / 2}" y1="{y_of(tick):.1f}" y2="{y_of(tick):.1f}" '
            f'stroke="#ddd"/><text x="{_MARGIN - 6}" y="{y_of(tick) + 4:.1f}" text-anchor="end">{tick:.0f}</text>'
        )
    for name, error in errors.items():
        dots = "".join(
            f'<circle cx="{x_of(x):.1f}" cy="{y_of(e):.1f}" r="1.8"/>' for x, e in zip(across, error, strict=True)
        )
        parts.append(f'<g fill="{_COLORS[name]}" fill-opacity="0.7">{dots}</g>')
    for k, (name, model) in enumerate(series.items()):
        rmse = 1e3 * point_rmse(model, capture)
        parts.append(
            f'<text x="{_MARGIN + 20 + 330 * k}" y="{_HEIGHT - 8}" fill="{_COLORS[name]}">'
            f"&#9679; {name}: {rmse:.1f} mm rms</text>"
        )
    parts.append(
        f'<text x="{_WIDTH - 20}" y="{_HEIGHT - 8}" text-anchor="end">height error [mm] across the pool</text>'
    )
    path = Path(__file__).parent / "results" / "figure.svg"
    path.parent.mkdir(exist_ok=True)
    path.write_text("".join(parts) + "</svg>\n", encoding="utf-8")
    print(f"Written to {path}")


if __name__ == "__main__":
    main()
