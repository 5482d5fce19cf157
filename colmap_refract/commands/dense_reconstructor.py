"""`dense_reconstructor`: dense, coloured points of a refined model and its images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from colmap_refract.commands.progress import ProgressLine
from colmap_refract.dense.options import DenseOptions
from colmap_refract.errors import RefractError

_FUSED_NAME, _DEPTH_MAPS_NAME, _REPORT_NAME = "fused.ply", "depth_maps.png", "dense_report.txt"


@dataclass(frozen=True, kw_only=True)
class DenseReconstructor:
    """Match a reference image densely with its neighbours, and triangulate the matches with refracted rays.

    Writes fused.ply, as COLMAP's: points with normals and colors; depth_maps.png, to look at; and
    dense_report.txt. What the reference image does not show is not there: give more references.
    """

    input_path: Path
    """Folder of the refined model, with its refraction.json."""
    image_path: Path
    """Folder of the images."""
    output_path: Path
    """Folder to write to."""
    options: Annotated[DenseOptions, tyro.conf.arg(name="")]
    sidecar_path: Path | None = None
    """The refraction.json with interfaces and media, or its folder. By default the one in input_path."""
    overwrite: bool = False
    """Replace dense points that are at output_path."""

    def run(self) -> None:
        """Read, match, triangulate, write, report."""
        import numpy as np

        from colmap_refract.dense.picture import depth_page
        from colmap_refract.dense.reconstruction import reconstruct
        from colmap_refract.dense.report import report
        from colmap_refract.files.model_io import read_model
        from colmap_refract.files.output import output_folder
        from colmap_refract.files.point_cloud import write_point_cloud
        from colmap_refract.files.sidecar import SIDECAR_NAME, read_sidecar
        from colmap_refract.photographs.images import read_gray, read_rgb

        own_files = (_FUSED_NAME, _DEPTH_MAPS_NAME, _REPORT_NAME)
        with output_folder(
            self.output_path, input_path=self.input_path, overwrite=self.overwrite, own_files=own_files
        ) as folder:
            model = read_model(self.input_path)
            if self.sidecar_path is None and not (self.input_path / SIDECAR_NAME).is_file():
                raise RefractError(
                    f"{self.input_path} has no {SIDECAR_NAME}, so its interfaces are not known: give a model that the "
                    "refiner wrote, or the file (--sidecar_path)"
                )
            if not self.image_path.is_dir():
                raise RefractError(f"there is no folder {self.image_path}; give the folder that holds the images")
            sidecar = read_sidecar(self.sidecar_path or self.input_path)
            with ProgressLine() as line:
                views = reconstruct(
                    model,
                    sidecar,
                    lambda name: read_gray(self.image_path / name),
                    lambda name: read_rgb(self.image_path / name),
                    self.options,
                    say=line.say,
                )
                line.say("Writing ...")
                points, normals, colours = (
                    np.concatenate([getattr(view, part) for view in views]) for part in ("points", "normals", "colours")
                )
                write_point_cloud(folder / _FUSED_NAME, points, normals, colours)
                unit = "m" if sidecar.units.get("distance") == "metre" else "model units"
                (folder / _DEPTH_MAPS_NAME).write_bytes(depth_page(views, unit))
                text = report(views, self.options, self.options.min_angle(sidecar.scenario))
                (folder / _REPORT_NAME).write_text(text + "\n", encoding="utf-8")
        print(text)
        print(f"\nWritten to {self.output_path}")
