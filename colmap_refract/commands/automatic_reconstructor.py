"""`automatic_reconstructor`: photographs in, a model that knows of refraction out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from colmap_refract.commands.lists import read_groups, read_names
from colmap_refract.commands.progress import ProgressLine
from colmap_refract.errors import RefractError
from colmap_refract.options import ImageNotes, RefinerRequest
from colmap_refract.reconstructor.options import ReconstructorOptions
from colmap_refract.reconstructor.watcher import Watcher

if TYPE_CHECKING:
    from colmap_refract.estimator.adjustment import Progress


@dataclass(frozen=True, kw_only=True)
class AutomaticReconstructor:
    """Reconstruct a scene from photographs that were taken through a plane interface.

    Extracts features, matches them, maps the images with the intrinsics held, and refines the model with refraction.
    The workspace is laid out as COLMAP's: database.db, sparse/0 (without refraction), and sparse_refractive/0 with
    refraction.json. A run that was stopped goes on where it stopped, and one with other options does again only what
    they change.
    """

    workspace_path: Path
    """Folder to work in; made if it does not exist."""
    options: Annotated[ReconstructorOptions, tyro.conf.arg(name="")]
    refiner: Annotated[RefinerRequest, tyro.conf.arg(name="")]
    image_path: Path | None = None
    """Folder of the photographs. By default `images` in the workspace."""
    database_path: Path | None = None
    """COLMAP database, used if it exists. By default `database.db` in the workspace."""
    camera_path: Path | None = None
    """COLMAP cameras file (.bin or .txt) with intrinsics calibrated in air."""
    interface_group_path: Path | None = None
    """Text file with lines `IMAGE_NAME GROUP`: the images of a group share one interface."""
    dry_image_list_path: Path | None = None
    """Text file with the name of an image per line that was taken without an interface."""

    def run(self) -> None:
        """Reconstruct and report."""
        from colmap_refract.reconstructor.pipeline import reconstruct
        from colmap_refract.refiner.report import report

        if self.refiner.scenario == "auto":
            # Images of a camera that stands still are mapped in another way, so the mapping would have to wait for it.
            raise RefractError(
                "automatic_reconstructor takes no scenario auto: name it; or map with --scenario moving_interface "
                f"--refine 0, then choose with refiner --scenario auto --input_path {self.workspace_path / 'sparse/0'}"
            )
        notes = ImageNotes(
            interface_groups=read_groups(self.interface_group_path),
            dry_images=frozenset(read_names(self.dry_image_list_path)),
        )
        try:
            with ProgressLine() as line:
                result = reconstruct(
                    self.workspace_path,
                    self.options,
                    self.refiner.with_scenario(self.refiner.scenario),
                    image_path=self.image_path,
                    database_path=self.database_path,
                    camera_path=self.camera_path,
                    notes=notes,
                    watcher=_Terminal(line),
                )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"Interrupted: what is done is kept in {self.workspace_path}, the same command goes on from there."
            ) from None
        if result.sidecar is not None:
            print(f"\n{report(result.sidecar)}")
        print(f"\nWithout refraction: {result.sparse_path}")
        if result.refractive_path is not None:
            print(f"Written to {result.refractive_path}")


class _Terminal(Watcher):
    """What is done as lines on standard output, what is under way on the line of progress."""

    def __init__(self, line: ProgressLine) -> None:
        self._line = line

    def progress(self, stage: str, done: int, total: int | None, unit: str) -> None:
        of = f" of {total}" if total is not None else ""
        self._line.say(f"{stage}: {done}{of} {unit}")

    def say(self, text: str) -> None:
        self._line.say(text)

    def solving(self, stage: str, progress: Progress) -> None:
        self._line.show(stage, progress)

    def report(self, label: str, text: str) -> None:
        self._line.print(f"{label + ':':18s}{text}")

    def warn(self, line: str) -> None:
        self.report("WARNING", line)
