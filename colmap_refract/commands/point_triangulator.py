"""`point_triangulator`: the points of a model triangulated anew, through waves about its known interfaces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from colmap_refract.commands.progress import ProgressLine
from colmap_refract.errors import RefractError
from colmap_refract.triangulator.options import TriangulatorOptions


@dataclass(frozen=True, kw_only=True)
class PointTriangulator:
    """Triangulate the points of a refined model anew, through waves of a known slope deviation.

    Poses and mean planes stay. Each observation is weighted by what a random slope does to it at its depth, and each
    point gets a standard deviation. Writes the model with its refraction.json, and point_std.csv.
    """

    input_path: Path
    """Folder of the COLMAP model, binary or text."""
    output_path: Path
    """Folder to write the model to."""
    options: Annotated[TriangulatorOptions, tyro.conf.arg(name="")]
    sidecar_path: Path | None = None
    """The refraction.json with interfaces and media, or its folder. By default the one in input_path."""
    overwrite: bool = False
    """Replace a model that is at output_path."""

    def run(self) -> None:
        """Read, triangulate, write, report."""
        from colmap_refract.files.model_io import read_model, write_model
        from colmap_refract.files.output import POINT_STD_NAME, output_folder
        from colmap_refract.files.sidecar import SIDECAR_NAME, read_sidecar, write_sidecar
        from colmap_refract.triangulator.report import report, write_point_std
        from colmap_refract.triangulator.triangulation import triangulate_points

        with output_folder(self.output_path, input_path=self.input_path, overwrite=self.overwrite) as folder:
            model = read_model(self.input_path)
            if self.sidecar_path is None and not (self.input_path / SIDECAR_NAME).is_file():
                raise RefractError(
                    f"{self.input_path} has no {SIDECAR_NAME}, so its interfaces are not known: give a model that the "
                    "refiner wrote, or the file (--sidecar_path)"
                )
            sidecar = read_sidecar(self.sidecar_path or self.input_path)
            with ProgressLine() as line:
                result = triangulate_points(model, sidecar, self.options, say=line.say)
            write_model(result.reconstruction, folder)
            write_sidecar(result.sidecar, folder / SIDECAR_NAME)
            write_point_std(result, folder / POINT_STD_NAME)
        print(report(result, self.options))
        print(f"\nWritten to {self.output_path}")
