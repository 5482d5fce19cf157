"""`refiner`: a COLMAP model that ignored refraction in, one that does not out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from colmap_refract.commands.lists import read_groups, read_names
from colmap_refract.commands.progress import ProgressLine
from colmap_refract.options import ImageNotes, RefinerRequest


@dataclass(frozen=True, kw_only=True)
class Refiner:
    """Refine a COLMAP model that was photographed through a plane interface.

    Writes a COLMAP model and, beside it, refraction.json with the interfaces; with interface_shape soft
    also a folder of surfaces, as height maps and meshes.
    """

    input_path: Path
    """Folder of the COLMAP model, binary or text."""
    output_path: Path
    """Folder to write the refined model to."""
    options: Annotated[RefinerRequest, tyro.conf.arg(name="")]
    camera_path: Path | None = None
    """COLMAP cameras file (.bin or .txt) with intrinsics calibrated in air, in place of the model's."""
    interface_group_path: Path | None = None
    """Text file with lines `IMAGE_NAME GROUP`: the images of a group share one interface."""
    dry_image_list_path: Path | None = None
    """Text file with the name of an image per line that was taken without an interface."""
    database_path: Path | None = None
    """COLMAP database of the model, to get back the tracks that refraction cost.
    They are merged, completed and triangulated from all its matches with refracted rays, and the
    model is refined again."""
    overwrite: bool = False
    """Replace a model that is at output_path."""

    def run(self) -> None:
        """Read, refine, write, report."""
        from colmap_refract.files.cameras_file import read_cameras
        from colmap_refract.files.model_io import read_model, write_model
        from colmap_refract.files.output import output_folder
        from colmap_refract.files.sidecar import SIDECAR_NAME, write_sidecar
        from colmap_refract.files.surfaces import write_surfaces
        from colmap_refract.refiner.comparison import table
        from colmap_refract.refiner.report import report
        from colmap_refract.refiner.scenario_choice import choose_scenario

        with output_folder(self.output_path, input_path=self.input_path, overwrite=self.overwrite) as folder:
            model = read_model(self.input_path)
            cameras = read_cameras(self.camera_path) if self.camera_path is not None else None
            notes = ImageNotes(
                interface_groups=read_groups(self.interface_group_path),
                dry_images=frozenset(read_names(self.dry_image_list_path)),
            )
            comparison = None
            with ProgressLine() as line:
                scenario = self.options.scenario
                if scenario == "auto" or self.options.interface_shape == "auto":
                    comparison = choose_scenario(model, self.options, notes=notes, cameras=cameras, watch=line.show)
                    line.print(f"{table(comparison)}\n")
                    options = comparison.chosen.options
                else:
                    options = self.options.with_scenario(scenario)
                if self.database_path is None:
                    from colmap_refract.refiner.refinement import refine

                    result = refine(model, options, notes=notes, cameras=cameras, watch=line.show)
                else:
                    from colmap_refract.mapping.database import read_correspondences
                    from colmap_refract.mapping.retriangulation import refine_with_database

                    matches = read_correspondences(self.database_path, verified=False)
                    result = refine_with_database(
                        model, options, matches, notes=notes, cameras=cameras, watch=line.show
                    )
            if comparison is not None:
                result.sidecar.statistics["comparison"] = comparison.as_dict()
            write_model(result.reconstruction, folder)
            write_sidecar(result.sidecar, folder / SIDECAR_NAME)
            with ProgressLine() as line:
                write_surfaces(
                    folder,
                    result.reconstruction,
                    result.sidecar,
                    lambda done, all_: line.say(f"Surfaces: {done} of {all_}"),
                )
        print(report(result.sidecar))
        print(f"\nWritten to {self.output_path}")
