"""Charts of an experiment: errors as bars, errors over the board, clouds from the side."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.experiments.results import Case, Cloud, ExperimentResult
from colmap_refract.interface import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = ("#4477aa", "#ccbb44", "#aa3377", "#ee99bb", "#999999", "#228833", "#66ccee", "#ee7733", "#cc3311")
"""Distinguishable with any colour vision (after Tol); bars have their numbers beside them as well."""
_INK = "#333333"
_METADATA: dict[str, Any] = {"svg": {"Date": None}, "png": {"Software": None}}
"""Without what changes from day to day."""


def check_matplotlib() -> None:
    """Raises RefractError if there is no matplotlib."""
    from importlib.util import find_spec

    if find_spec("matplotlib") is None:
        raise RefractError('the charts need matplotlib: pip install "colmap-refract[experiments]"')


def bars(result: ExperimentResult) -> bytes:
    """RMSE of every method in every scenario, SVG: median, least and largest over the seeds, and the noise bound."""
    rows = [(scenario, method) for scenario in result.scenarios for method in result.methods]
    rows = [row for row in rows if result.of(Case(scenario=row[0], method=row[1]))]
    height = 0.9 + 0.27 * (len(rows) + len(result.scenarios))
    figure = _figure(8.0, height)
    axes = figure.add_subplot()
    place, ticks, labels, far = 0.0, [], [], []
    values = [1e3 * result.values(Case(scenario=scenario, method=method)) for scenario, method in rows]
    everything = np.concatenate([np.concatenate(values), *([1e3 * result.bound(s)] for s in result.scenarios)])
    everything = everything[np.isfinite(everything)]
    least, largest = (0.5 * everything.min(), 2.5 * everything.max()) if len(everything) else (0.1, 1.0)
    for scenario in result.scenarios:
        ticks.append(place)
        labels.append(scenario)
        far.append(True)
        top = place + 0.5
        for (own, method), found in zip(rows, values, strict=True):
            if own != scenario:
                continue
            place += 1
            ticks.append(place)
            labels.append(method)
            far.append(False)
            if not len(found):
                axes.text(least * 1.05, place, "fails", va="center", fontsize=8, color=_INK)
                continue
            median = float(np.median(found))
            axes.barh(place, median - least, left=least, height=0.7, color=_colour(result, method))
            axes.plot([found.min(), found.max()], [place, place], color=_INK, lw=1.2)
            axes.text(1.05 * found.max(), place, f"{median:.3g}", va="center", fontsize=8, color=_INK)
        bound = 1e3 * result.bound(scenario)
        if np.isfinite(bound):
            axes.plot([bound, bound], [top, place + 0.5], color="black", ls="--", lw=1.2)
        place += 1.4
    axes.set_xscale("log")
    axes.set_xlim(least, largest)
    axes.set_ylim(place - 0.7, -0.6)
    axes.set_yticks(ticks, labels, fontsize=9)
    for label, title in zip(axes.get_yticklabels(), far, strict=True):
        label.set_fontweight("bold" if title else "normal")
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel("RMSE of the points [mm], logarithmic; line: least to largest over the seeds; dashed: noise bound")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.grid(axis="x", color="#dddddd", lw=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    return _written(figure, "svg")


def clouds(result: ExperimentResult) -> bytes | None:
    """The points of the first seed, PNG: errors over the board (plan), or found and true points (side)."""
    if not result.clouds:
        return None
    return _error_maps(result) if result.view == "plan" else _side_views(result)


def _error_maps(result: ExperimentResult) -> bytes:
    """Depth errors over the board."""
    from matplotlib.colors import SymLogNorm

    figure, panels = _panels(result, 2.3, 2.0)
    deepest = max(float(np.abs(1e3 * _depth_error(cloud)).max()) for cloud in result.clouds)
    scale = SymLogNorm(linthresh=min(1.0, 0.5 * deepest), vmin=-deepest, vmax=deepest)
    dots: Any = None
    for (scenario, method), axes in panels.items():
        cloud = _cloud(result, scenario, method)
        if cloud is None:
            continue
        x, y = 1e3 * cloud.true[:, :2].T
        depth = 1e3 * _depth_error(cloud)
        dots = axes.scatter(x, y, c=depth, cmap="RdBu_r", norm=scale, s=14, edgecolors=_INK, linewidths=0.2)
        axes.set_aspect("equal")
    figure.supxlabel("x [mm]", fontsize=9)
    figure.supylabel("y [mm]", fontsize=9)
    bar = figure.colorbar(dots, ax=list(panels.values()), shrink=0.8)
    bar.set_label("depth error (positive: too deep) [mm]", fontsize=9)
    return _written(figure, "png")


def _side_views(result: ExperimentResult) -> bytes:
    """Found points over true ones, seen along the y axis."""
    figure, panels = _panels(result, 3.0, 2.3)
    low = np.min([cloud.true.min(axis=0) for cloud in result.clouds], axis=0)
    high = np.max([cloud.true.max(axis=0) for cloud in result.clouds], axis=0)
    margin = 0.15 * (high - low)
    for (scenario, method), axes in panels.items():
        cloud = _cloud(result, scenario, method)
        axes.set_xlim(low[0] - margin[0], high[0] + margin[0])
        axes.set_ylim(high[2] + margin[2], low[2] - margin[2])
        if cloud is None:
            continue
        axes.scatter(cloud.true[:, 0], cloud.true[:, 2], s=5, color="#bbbbbb", label="true")
        axes.scatter(cloud.found[:, 0], cloud.found[:, 2], s=3, color="#cc3311", label="found")
    figure.supxlabel("x [m]", fontsize=9)
    figure.supylabel("depth below the camera [m]", fontsize=9)
    handles, labels = next(iter(panels.values())).get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=8, markerscale=2)
    return _written(figure, "png")


def _panels(result: ExperimentResult, width: float, height: float) -> tuple[Figure, dict[tuple[str, str], Any]]:
    """A panel per scenario and method that has a cloud: a row per scenario, at most five beside each other."""
    shown = [(s, m) for s in result.scenarios for m in result.methods if _cloud(result, s, m) is not None]
    columns = min(5, max(sum(s == scenario for s, _ in shown) for scenario in result.scenarios))
    places, row = {}, 0
    for scenario in result.scenarios:
        own = [pair for pair in shown if pair[0] == scenario]
        for k, pair in enumerate(own):
            places[pair] = (row + k // columns, k % columns)
        row += -(-len(own) // columns)
    figure = _figure(width * columns + 1.2, height * row + 0.6)
    grid = figure.add_gridspec(row, columns)
    panels = {}
    for pair, (i, j) in places.items():
        axes = figure.add_subplot(grid[i, j])
        axes.set_title(f"{pair[0]}\n{pair[1]}", fontsize=8)
        axes.tick_params(labelsize=7)
        panels[pair] = axes
    return figure, panels


def _cloud(result: ExperimentResult, scenario: str, method: str) -> Cloud | None:
    return next((c for c in result.clouds if (c.scenario, c.method) == (scenario, method)), None)


def _depth_error(cloud: Cloud) -> Array:
    """(P,) metres."""
    return np.asarray(cloud.found[:, 2] - cloud.true[:, 2])


def _colour(result: ExperimentResult, method: str) -> str:
    return _COLOURS[result.methods.index(method) % len(_COLOURS)]


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _written(figure: Figure, form: str) -> bytes:
    """The picture's file; the same bytes for the same figure."""
    import matplotlib

    file = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "colmap_refract", "svg.fonttype": "path"}):
        figure.savefig(file, format=form, dpi=110, metadata=_METADATA[form])
    return file.getvalue()


def png(image: NDArray[np.uint8]) -> bytes:
    """An RGB picture (H, W, 3) as a file."""
    from matplotlib.image import imsave

    file = io.BytesIO()
    imsave(file, image, format="png", metadata=_METADATA["png"])
    return file.getvalue()


def mesh_views(x: Array, y: Array, found: Array, errors: Array, colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A surface from above at an angle, textured and shaded, and its errors in plan, as a picture (H, W, 3).

    Args:
        x: (columns,), y: (rows,), found: (rows, columns) z, metres, not a number where there is no surface.
        errors: (rows, columns) metres.
        colours: (rows, columns, 3) RGB.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LightSource
    from matplotlib.ticker import MaxNLocator

    figure = _figure(13.0, 4.2)
    canvas = FigureCanvasAgg(figure)
    coarse = max(1, round(max(found.shape) / 140))
    part = np.s_[::coarse, ::coarse]
    height = -found[part]
    level = np.nan_to_num(height, nan=float(np.nanmin(height)))
    shade = LightSource(azdeg=315, altdeg=45).shade_rgb(
        np.full((*level.shape, 3), 0.8), level, dx=float(x[1] - x[0]) * coarse, dy=float(y[1] - y[0]) * coarse
    )
    across, along = np.meshgrid(x[::coarse], y[::coarse])
    for k, (title, faces) in enumerate((("Textured", colours[part] / 255.0), ("Shaded", shade)), start=1):
        axes: Any = figure.add_subplot(1, 3, k, projection="3d")
        axes.plot_surface(across, along, height, facecolors=faces, rstride=1, cstride=1, shade=False, antialiased=False)
        axes.set_box_aspect((float(np.ptp(x)), float(np.ptp(y)), float(np.nanmax(height) - np.nanmin(height))))
        axes.view_init(elev=40, azim=-60)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("x [m]", fontsize=8)
        axes.set_ylabel("y [m]", fontsize=8)
        axes.set_zlabel("z [m]", fontsize=8)
        axes.zaxis.set_major_locator(MaxNLocator(3))
        axes.tick_params(labelsize=6)
    axes = figure.add_subplot(1, 3, 3)
    largest = max(1e-6, float(np.nanquantile(np.abs(1e3 * errors), 0.99)))
    image = axes.pcolormesh(x, y, 1e3 * errors, cmap="RdBu_r", vmin=-largest, vmax=largest, rasterized=True)
    axes.set_aspect("equal")
    axes.set_title("Distance from the true surface", fontsize=10)
    axes.set_xlabel("x [m]", fontsize=8)
    axes.set_ylabel("y [m]", fontsize=8)
    axes.tick_params(labelsize=7)
    figure.colorbar(image, ax=axes, shrink=0.7).set_label("positive: too deep [mm]", fontsize=8)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()  # type: ignore[no-untyped-call]
