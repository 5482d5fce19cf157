"""`initial_mapper`: a COLMAP database in, a model to start refining from out, without COLMAP's mapper."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from colmap_refract.commands.progress import ProgressLine
from colmap_refract.errors import RefractError
from colmap_refract.options import Scenario


@dataclass(frozen=True, kw_only=True)
class InitialMapper:
    """Make a model to start refining from out of a database with matches, where COLMAP's mapper finds none.

    Essential matrices of image pairs give clouds of points, which are averaged; poses follow from those.
    Refraction is ignored: the model is for the refiner to improve.
    """

    database_path: Path
    """COLMAP database with keypoints and verified matches."""
    output_path: Path
    """Folder to write the model to."""
    scenario: Scenario
    """What is shared (see refiner). With fixed_camera all images get one pose."""
    camera_path: Path | None = None
    """COLMAP cameras file (.bin or .txt) with intrinsics calibrated in air, in place of the database's."""
    reference_image: str = ""
    """Name of the image that the clouds are averaged in. By default the one that shares most with the others."""
    num_threads: int = -1
    """Of the adjustments; -1: as many as there are cores."""
    random_seed: int = 0
    """Of the samples that matches are drawn in."""
    overwrite: bool = False
    """Replace a model that is at output_path."""

    def run(self) -> None:
        """Read, map, write, report."""
        from colmap_refract.files.cameras_file import read_cameras
        from colmap_refract.files.model_io import write_model
        from colmap_refract.files.output import output_folder
        from colmap_refract.mapping.initial import initial_model_from_database
        from colmap_refract.mapping.initial_report import report

        if self.random_seed < 0:
            raise RefractError(f"random_seed {self.random_seed}: give a number from 0 on")
        with output_folder(self.output_path, input_path=None, overwrite=self.overwrite) as folder:
            cameras = read_cameras(self.camera_path) if self.camera_path is not None else None
            with ProgressLine() as line:
                result = initial_model_from_database(
                    self.database_path,
                    scenario=self.scenario,
                    cameras=cameras,
                    reference=self.reference_image or None,
                    random_seed=self.random_seed,
                    num_threads=self.num_threads,
                    watch=lambda done, total: line.say(f"Registering: {done} of {total} images"),
                )
            write_model(result.reconstruction, folder)
        print(report(result))
        print(f"\nWritten to {self.output_path}; next:\n{self._next()}")

    def _next(self) -> str:
        """The command that refines the model, to be pasted into a shell."""
        refined = self.output_path.absolute().with_name(f"{self.output_path.absolute().name}_refined")
        if not self.output_path.is_absolute():
            refined = self.output_path.parent / refined.name
        arguments: dict[str, object] = {
            "input_path": self.output_path,
            "output_path": refined,
            "scenario": self.scenario,
            "database_path": self.database_path,
        }
        if self.reference_image:
            arguments["reference_image"] = self.reference_image
        options = (f"--{name} {shlex.quote(str(value))}" for name, value in arguments.items())
        return " ".join(["colmap-refract refiner", *options])
