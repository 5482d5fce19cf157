"""A curved body under a swaying surface, from rendered frames to a mesh: the whole way of the package."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from colmap_refract.dense.reconstruction import DenseView
from colmap_refract.errors import RefractError
from colmap_refract.experiments import charts
from colmap_refract.experiments.body import BODY_DEPTH, swaying_tank
from colmap_refract.experiments.parallel import Say
from colmap_refract.experiments.results import Bound, Cloud, ExperimentResult, Fact, Picture, Run
from colmap_refract.interface import Array
from colmap_refract.optical_flow.options import FlowOptions
from colmap_refract.options import RefinerOptions
from colmap_refract.simulation.accuracy import align, align_to_best
from colmap_refract.simulation.judge import judge
from colmap_refract.simulation.session import Session, write_session
from colmap_refract.simulation.truth import CAMERAS_NAME

NAME, METHOD = "mannequin", "hard, from pictures"
SPARSE, DENSE, MESH = "sparse points", "dense points", "mesh"
TOLERANCE = 0.01
"""Of the body's depth: how near the mesh is to be, over `WANTED` of what is seen."""
WANTED = 0.95
_GAP = 0.012
"""Metres from a place to the nearest vertex beyond which there is no mesh there."""
_DESCRIBED = (
    METHOD,
    "this package, the whole way: `image_selector`, `flow_matcher`, `refiner`, then every second pixel of the "
    "reference frame by `dense_reconstructor` and a mesh by `poisson_mesher`",
    "the pictures alone",
)


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The mesh against the truth at places (rows, columns) over the bottom that the reference frame sees.

    Attributes:
        x, y: (columns,), (rows,) of the places, metres.
        true, found: z, not a number where the reference frame sees nothing, or there is no mesh.
        errors: of the mesh from the true surface along its normal, positive: too deep.
        colours: (rows, columns, 3) RGB of the pictures there.
    """

    x: Array
    y: Array
    true: Array
    found: Array
    errors: Array
    colours: NDArray[np.uint8]

    @property
    def seen(self) -> NDArray[np.bool_]:
        return np.isfinite(self.true)


@dataclass(frozen=True, kw_only=True)
class _Outcome:
    runs: list[Run]
    bound: Bound | None = None
    clouds: tuple[Cloud, ...] = ()
    surface: Surface | None = None
    photographs: tuple[NDArray[np.uint8], ...] = ()
    num_selected: int = 0


def run(
    seeds: Sequence[int], say: Say, *, num_frames: int = 240, num_images: int = 27, width: int = 480
) -> ExperimentResult:
    """The whole way for all seeds; `num_images` includes the reference, `width` is that of the frames, px."""
    began = perf_counter()
    outcomes = []
    for number, seed in enumerate(seeds, start=1):
        session = swaying_tank(seed, num_frames=num_frames, width=width)
        told = partial(_say_where, say, NAME if len(seeds) == 1 else f"{NAME}, {number} of {len(seeds)}")
        with tempfile.TemporaryDirectory(prefix="colmap_refract-") as folder:
            outcomes.append(_whole_way(session, Path(folder), seed, num_images, told))
    first = outcomes[0]
    limit = TOLERANCE * BODY_DEPTH
    facts = [Fact(text="Frames selected, the reference included", value=f"{first.num_selected} of {num_frames}")]
    parts = [float(np.mean(np.abs(s.errors[s.seen]) <= limit)) for o in outcomes if (s := o.surface) is not None]
    if parts:
        verdict = "reached" if np.median(parts) >= WANTED else "missed"
        facts.append(
            Fact(
                text=f"Mesh within {1e3 * limit:.1f} mm ({100 * TOLERANCE:g} % of the body's depth) of the truth, over "
                f"what the reference frame sees ({100 * WANTED:g} % wanted)",
                value=f"{100 * np.median(parts):.1f} %, {verdict}",
            )
        )
    return ExperimentResult(
        name=NAME,
        title="Mannequin",
        text=(
            f"A rounded body, {1e3 * BODY_DEPTH:g} mm deep, on the bottom of a tank under 0.4 m of water; the camera "
            "is fixed to the tank, 0.45 m above the water, whose surface is plane and tilts by 8 degrees (root mean "
            f"square) while the tank sways. {num_frames} rendered frames of {width} x {3 * width // 4} px, of which "
            f"{num_images - 1} and a reference are selected by their optical flow. The bound of the sparse points is "
            "that of their measured noise."
        ),
        view="side",
        outlier_limit=limit,
        scenarios=(SPARSE, DENSE, MESH),
        methods=(METHOD,),
        described=(_DESCRIBED,),
        runs=[run for outcome in outcomes for run in outcome.runs],
        bounds=[outcome.bound for outcome in outcomes if outcome.bound is not None],
        clouds=list(first.clouds),
        pictures=_pictures(first),
        facts=facts,
        seconds=perf_counter() - began,
    )


def _say_where(say: Say, where: str, text: str) -> None:
    say(f"{where}: {text}")


def _whole_way(session: Session, folder: Path, seed: int, num_images: int, say: Say) -> _Outcome:
    """Render, select, track, refine, make dense, mesh, and compare; what fails is said of all that follows."""
    runs: list[Run] = []
    began = perf_counter()
    bound: Bound | None = None
    clouds: list[Cloud] = []
    surface: Surface | None = None
    photographs: tuple[NDArray[np.uint8], ...] = ()
    num_selected = 0
    try:
        reference, num_selected, photographs = _selected(session, folder, num_images, say)
        model_path = _refined(folder, reference, say)
        sparse, bound = _judged(session, model_path, seed, perf_counter() - began)
        runs.append(sparse)
        began = perf_counter()
        view = _dense(folder, model_path, reference, say)
        found, true = view.points, _true_points(session, view)
        aligned, best = align_to_best(found, true)
        runs.append(_run(DENSE, seed, aligned, true, view.coverage, perf_counter() - began))
        some = slice(None, None, max(1, len(true) // 3000))
        clouds.append(Cloud(scenario=DENSE, method=METHOD, found=aligned[some], true=true[some]))
        began = perf_counter()
        vertices = align(found[best], true[best], _meshed(folder, view, say))
        surface = _compared(session, reference, vertices, view, align(found[best], true[best], found))
        there = surface.seen & np.isfinite(surface.errors)
        errors = np.abs(surface.errors[there])
        runs.append(
            Run(
                scenario=MESH, method=METHOD, seed=seed, rmse=float(np.sqrt(np.mean(errors**2))),
                median=float(np.median(errors)), outliers=float(np.mean(errors > TOLERANCE * BODY_DEPTH)),
                kept=float(there.sum() / surface.seen.sum()), seconds=perf_counter() - began,
            )
        )  # fmt: skip
    except RefractError as error:
        done = {run.scenario for run in runs}
        runs += [
            Run(scenario=what, method=METHOD, seed=seed, failure=str(error), seconds=perf_counter() - began)
            for what in (SPARSE, DENSE, MESH)
            if what not in done
        ]
    return _Outcome(
        runs=runs, bound=bound, clouds=tuple(clouds), surface=surface, photographs=photographs,
        num_selected=num_selected,
    )  # fmt: skip


def _selected(
    session: Session, folder: Path, num_images: int, say: Say
) -> tuple[str, int, tuple[NDArray[np.uint8], ...]]:
    """Render all, copy the selected into `chosen/`: the reference's name, their number, and three of them to show."""
    from colmap_refract.frame_selection.choice import select_frames
    from colmap_refract.frame_selection.options import SelectionOptions
    from colmap_refract.photographs.frames import ImageFolder
    from colmap_refract.photographs.images import read_rgb

    # A pixel's ray meets a texel of its own size: more rays cost time and change little.
    session = replace(session, options=replace(session.options, look=replace(session.options.look, subsamples=1)))
    write_session(session, folder, watch=lambda done, total: say(f"rendering frame {done} of {total}"))
    selection = select_frames(
        ImageFolder(folder / "images"), SelectionOptions(scenario="fixed_camera", num_images=num_images), watch=say
    )
    (folder / "chosen").mkdir()
    for frame in selection.chosen:
        shutil.copy2(folder / "images" / frame.name, folder / "chosen" / frame.name)
    shown = sorted(selection.chosen, key=lambda frame: frame.flow_length or 0.0)
    pictures = tuple(read_rgb(folder / "chosen" / frame.name) for frame in (shown[0], shown[-2], shown[-1]))
    return selection.reference.name, len(selection.chosen), pictures


def _refined(folder: Path, reference: str, say: Say) -> Path:
    """Tracks, a start and the refined model: its folder."""
    from colmap_refract.reconstructor.options import ReconstructorOptions
    from colmap_refract.reconstructor.pipeline import reconstruct
    from colmap_refract.reconstructor.watcher import Watcher

    class Telling(Watcher):
        def say(self, text: str) -> None:
            say(text)

    done = reconstruct(
        folder / "workspace",
        ReconstructorOptions(matcher="flow", Flow=FlowOptions()),
        RefinerOptions(scenario="fixed_camera", reference_image=reference, num_threads=1),
        image_path=folder / "chosen",
        camera_path=folder / CAMERAS_NAME,
        watcher=Telling(),
    )
    if done.refractive_path is None:
        raise RefractError("the frames gave no refined model")
    return done.refractive_path


def _judged(session: Session, model_path: Path, seed: int, seconds: float) -> tuple[Run, Bound]:
    """The sparse points, and the bound of their measured noise."""
    from colmap_refract.files.model_io import read_model

    found = judge(read_model(model_path), session.truth)
    run = Run(
        scenario=SPARSE, method=METHOD, seed=seed, rmse=found.rmse, median=found.median_error,
        outliers=float(np.mean(found.errors > TOLERANCE * BODY_DEPTH)),
        kept=found.num_points / (found.num_points + found.wrong_points), seconds=seconds,
    )  # fmt: skip
    return run, Bound(scenario=SPARSE, seed=seed, rmse=np.nan if found.bound is None else found.bound)


def _dense(folder: Path, model_path: Path, reference: str, say: Say) -> DenseView:
    from colmap_refract.dense.options import DenseOptions
    from colmap_refract.dense.reconstruction import reconstruct
    from colmap_refract.files.model_io import read_model
    from colmap_refract.files.sidecar import read_sidecar
    from colmap_refract.photographs.images import read_gray, read_rgb

    return reconstruct(
        read_model(model_path),
        read_sidecar(model_path),
        lambda name: read_gray(folder / "chosen" / name),
        lambda name: read_rgb(folder / "chosen" / name),
        DenseOptions(reference_image=reference, max_num_images=26),
        say=say,
    )[0]


def _true_points(session: Session, view: DenseView) -> Array:
    """What the pixels of dense points (n, 3) show."""
    row, column = np.nonzero(np.isfinite(view.depth))
    pixels = view.margin + view.step * np.column_stack([column, row]) + 0.5
    return session.truth.trace(view.name, pixels)


def _meshed(folder: Path, view: DenseView, say: Say) -> Array:
    """The vertices (n, 3) of the Poisson mesh."""
    from colmap_refract.dense.meshing import poisson_mesh
    from colmap_refract.dense.options import PoissonMeshingOptions
    from colmap_refract.files.point_cloud import read_points, write_point_cloud

    write_point_cloud(folder / "fused.ply", view.points, view.normals, view.colours)
    poisson_mesh(folder / "fused.ply", folder / "mesh.ply", PoissonMeshingOptions(), say=say)
    return read_points(folder / "mesh.ply")


def _run(what: str, seed: int, found: Array, true: Array, kept: float, seconds: float) -> Run:
    errors = np.linalg.norm(found - true, axis=1)
    return Run(
        scenario=what, method=METHOD, seed=seed, rmse=float(np.sqrt(np.mean(errors**2))),
        median=float(np.median(errors)), outliers=float(np.mean(errors > TOLERANCE * BODY_DEPTH)), kept=kept,
        seconds=seconds,
    )  # fmt: skip


def _compared(session: Session, reference: str, vertices: Array, view: DenseView, points: Array) -> Surface:
    """The mesh's height over the bottom, between its vertices, against the true one.

    Neither has overhangs. Places are those that the reference frame sees, but for a margin of the matching's window.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import KDTree

    truth = session.truth
    camera = truth.view(reference).camera
    sides = (camera.width, camera.height)
    column, row = np.meshgrid(*(np.arange(view.margin, side - view.margin, 2) + 0.5 for side in sides))
    shown = truth.trace(reference, np.column_stack([column.ravel(), row.ravel()]))
    shown = shown[np.isfinite(shown).all(axis=1)]
    low, high = shown[:, :2].min(axis=0), shown[:, :2].max(axis=0)
    # As dense as what was traced.
    spacing = float(np.sqrt(np.prod(high - low) / len(shown)))
    x, y = (np.arange(low[k], high[k], spacing) for k in range(2))
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    places = grid.reshape(-1, 2)
    seen = KDTree(shown[:, :2]).query(places)[0] < 1.5 * spacing
    true = np.where(seen, truth.terrain.height(places), np.nan)
    found = LinearNDInterpolator(vertices[:, :2], vertices[:, 2])(places)
    found[KDTree(vertices[:, :2]).query(places)[0] > _GAP] = np.nan
    slope = truth.terrain.gradient(places)
    errors = (found - true) / np.sqrt(1 + np.sum(slope**2, axis=1))
    colours = view.colours[KDTree(points[:, :2]).query(places)[1]]
    shape = grid.shape[:2]
    return Surface(
        x=x, y=y, true=true.reshape(shape), found=np.where(seen, found, np.nan).reshape(shape),
        errors=errors.reshape(shape), colours=colours.reshape(*shape, 3),
    )  # fmt: skip


def _pictures(first: _Outcome) -> list[Picture]:
    out = []
    if first.photographs:
        frames = np.concatenate(first.photographs, axis=1)
        out.append(
            Picture(
                name=f"{NAME}_photographs", image=frames,
                text="Mannequin: the reference frame, and two of those selected, the water tilted differently.",
            )
        )  # fmt: skip
    if first.surface is not None:
        s = first.surface
        out.append(
            Picture(
                name=f"{NAME}_mesh", image=charts.mesh_views(s.x, s.y, s.found, s.errors, s.colours),
                text="Mannequin: the mesh, textured and shaded, and its distance from the truth [mm]; the first seed.",
            )
        )  # fmt: skip
    return out
