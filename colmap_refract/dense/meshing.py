"""A mesh through oriented points: COLMAP's Poisson surface reconstruction, asked only what it survives.

PoissonRecon takes the process with it if a file is damaged or has no points, writes an empty file if there are no
normals, and cuts everything away if `trim` is above the depth that the points are dense enough for.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_refract.dense.options import PoissonMeshingOptions
from colmap_refract.errors import RefractError, reason_of
from colmap_refract.files.output import WORK_PREFIX
from colmap_refract.files.point_cloud import num_vertices, read_point_cloud
from colmap_refract.interface import Array
from colmap_refract.reconstructor.colmap_process import run_colmap

_LEAST_POINTS = 10
_NEIGHBOURS = 9  # nearest, that tell how close points are
_SAMPLE = 20_000
_CUBE = 1.1  # side of PoissonRecon's cube over the longest side of the points
_FINER = 1  # levels of the tree beyond the points' spacing
_COARSER = 1.5  # levels below it, where a mesh is no longer near points
_DEPTHS = (6, 13)  # that are chosen from; COLMAP's default is the last


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """What was made: of how many points, with which depth and trim, and its vertices."""

    num_points: int
    depth: int
    trim: float
    num_vertices: int


def poisson_mesh(
    input_path: Path,
    output_path: Path,
    options: PoissonMeshingOptions,
    *,
    overwrite: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> Mesh:
    """Mesh the points of a PLY file.

    Args:
        input_path: PLY with normals. output_path: PLY to be written, whole or not at all.
        options: how.
        overwrite: whether a file at output_path may be replaced.
        say: told in a few words what is being done.

    Raises:
        RefractError: a file that is not there, not readable, not a PLY file with normals, or with too few points; an
            output that is there already or cannot be written; or meshing failed or left nothing.
    """
    _check_output(input_path, output_path, overwrite)
    points, normals = read_point_cloud(input_path)
    sound = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1) & normals.any(axis=1)
    if len(points) < _LEAST_POINTS:
        raise RefractError(f"{input_path} has {len(points)} points, {_LEAST_POINTS} are needed; give a denser cloud")
    if not sound.all():
        raise RefractError(
            f"{int((~sound).sum())} of the {len(points)} points of {input_path} have no normal or are no numbers; "
            "remove them"
        )
    level = _level(points)
    if not math.isfinite(level):
        raise RefractError(f"the points of {input_path} are all at one place; give the points of a surface")
    depth = options.depth or int(np.clip(math.ceil(level) + _FINER, *_DEPTHS))
    trim = options.trim if options.trim is not None else max(0.0, round(level - _COARSER, 1))
    say(f"Meshing {len(points)} points ...")
    work = None
    missing = [parent for parent in output_path.resolve().parents if not parent.exists()]
    try:
        output_path.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=WORK_PREFIX, dir=output_path.parent))
        mesh, log = work / "mesh.ply", work / "colmap.log"
        arguments = {
            "input_path": input_path.resolve(),
            "output_path": mesh.resolve(),
            "options": {
                "point_weight": options.point_weight, "depth": depth, "color": options.color, "trim": trim,
                "num_threads": options.num_threads,
            },
        }  # fmt: skip
        run_colmap("mesh", arguments, log_path=log, what="Poisson meshing")
        count = num_vertices(mesh)
        if not count:
            raise RefractError(
                f"nothing is left of the mesh at trim {trim:g}: the points are dense enough for about {level:.1f}; "
                "give a smaller --PoissonMeshing.trim, 0 to keep all"
            )
        os.replace(mesh, output_path)
    except OSError as error:
        raise RefractError(f"cannot write {output_path} ({reason_of(error)}); choose another place") from None
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)
        if not output_path.exists():
            for folder in missing:
                with suppress(OSError):
                    folder.rmdir()
    return Mesh(num_points=len(points), depth=depth, trim=trim, num_vertices=count)


def _check_output(input_path: Path, output_path: Path, overwrite: bool) -> None:
    if output_path.is_dir():
        raise RefractError(f"the output {output_path} is a folder; give the name of a file, such as meshed-poisson.ply")
    if output_path.exists():
        if input_path.exists() and output_path.samefile(input_path):
            raise RefractError(f"the output {output_path} is the input; choose another, the input is never altered")
        if not overwrite:
            raise RefractError(f"{output_path} exists already; choose another, or have it replaced (--overwrite 1)")


def _level(points: Array) -> float:
    """The depth of the tree at which a cell is about as wide as points are apart; infinite if they are at one place."""
    from scipy.spatial import KDTree

    few = points[:: -(-len(points) // _SAMPLE)]
    reach = KDTree(points).query(few, k=[_NEIGHBOURS])[0][:, 0]
    # So many on a disc of that radius: the side of the square that each has for itself.
    spacing = float(np.median(reach)) * math.sqrt(math.pi / _NEIGHBOURS)
    width = _CUBE * float(np.ptp(points, axis=0).max())
    return math.log2(width / spacing) if width > 0 and spacing > 0 else math.inf
