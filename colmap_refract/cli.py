"""The command line, `colmap-refract COMMAND`: COLMAP's spelling, one clear line when something is wrong.

Whatever takes time to import is imported inside the commands, so that `--help` answers at once.
"""

from __future__ import annotations

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from colmap_refract.errors import RefractError
from colmap_refract.options import ImageNotes, RefinerOptions

if TYPE_CHECKING:
    from colmap_refract.adjustment import Progress

_INTERRUPTED = 130
_TRUE, _FALSE = ("1", "true"), ("0", "false")


@dataclass(frozen=True, kw_only=True)
class Refiner:
    """Refine a COLMAP model that was photographed through a plane interface.

    Writes a COLMAP model and, beside it, refraction.json with the interfaces.
    """

    input_path: Path
    """Folder of the COLMAP model, binary or text."""
    output_path: Path
    """Folder to write the refined model to."""
    options: Annotated[RefinerOptions, tyro.conf.arg(name="")]
    camera_path: Path | None = None
    """COLMAP cameras file (.bin or .txt) with intrinsics calibrated in air, in place of the model's."""
    interface_group_path: Path | None = None
    """Text file with lines `IMAGE_NAME GROUP`: the images of a group share one interface."""
    dry_image_list_path: Path | None = None
    """Text file with the name of an image per line that was taken without an interface."""
    overwrite: bool = False
    """Replace a model that is at output_path."""

    def run(self) -> None:
        """Read, refine, write, report."""
        from colmap_refract.cameras_file import read_cameras
        from colmap_refract.model_io import read_model, write_model
        from colmap_refract.output import output_folder
        from colmap_refract.report import report
        from colmap_refract.sidecar import SIDECAR_NAME, write_sidecar

        with output_folder(self.output_path, input_path=self.input_path, overwrite=self.overwrite) as folder:
            model = read_model(self.input_path)
            cameras = read_cameras(self.camera_path) if self.camera_path is not None else None
            notes = ImageNotes(
                interface_groups=_read_groups(self.interface_group_path),
                dry_images=frozenset(_read_names(self.dry_image_list_path)),
            )
            from colmap_refract.refinement import refine

            with ProgressLine() as line:
                result = refine(model, self.options, notes=notes, cameras=cameras, watch=line.show)
            write_model(result.reconstruction, folder)
            write_sidecar(result.sidecar, folder / SIDECAR_NAME)
        print(report(result.sidecar))
        print(f"\nWritten to {self.output_path}")


@dataclass(frozen=True, kw_only=True)
class ModelAnalyzer:
    """Print the report of a model that the refiner wrote earlier."""

    path: Path
    """Folder of the model, with its refraction.json."""

    def run(self) -> None:
        """Read and report."""
        from colmap_refract.model_io import read_model
        from colmap_refract.report import report
        from colmap_refract.sidecar import read_sidecar

        model = read_model(self.path)
        sidecar = read_sidecar(self.path)
        unknown = sorted(set(sidecar.images) - {image.name for image in model.images.values()})
        if unknown:
            raise RefractError(f"{self.path}: refraction.json speaks of image '{unknown[0]}', which the model lacks")
        print(report(sidecar))


class ProgressLine:
    """One line on standard error that is written over while a solve runs; silent when nobody watches."""

    def __init__(self) -> None:
        self._shown = sys.stderr.isatty()
        self._length = 0

    def __enter__(self) -> ProgressLine:
        self._write("Reading ...")
        return self

    def __exit__(self, *_: object) -> None:
        self._write("")
        if self._shown:
            sys.stderr.write("\r")
            sys.stderr.flush()

    def show(self, stage: str, progress: Progress) -> None:
        """Called by the solver after every iteration."""
        self._write(
            f"{stage}: iteration {progress.iteration}, error {progress.rms:.4g} px (rms), "
            f"gradient {progress.gradient_max_norm:.2g}"
        )

    def _write(self, text: str) -> None:
        if self._shown:
            sys.stderr.write("\r" + text[:118].ljust(self._length))
            sys.stderr.flush()
            self._length = len(text[:118])


def _read_lines(path: Path) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RefractError(f"{path} cannot be read ({error}); give a text file") from None
    return [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def _read_names(path: Path | None) -> list[str]:
    return [] if path is None else _read_lines(path)


def _read_groups(path: Path | None) -> dict[str, str]:
    groups: dict[str, str] = {}
    for line in [] if path is None else _read_lines(path):
        name, _, group = line.rpartition(" ")
        name = name.strip()
        if not name:
            raise RefractError(f"{path}: '{line}' is not a line `IMAGE_NAME GROUP`")
        if groups.get(name, group) != group:
            raise RefractError(f"{path}: image '{name}' is in two groups, '{groups[name]}' and '{group}'")
        groups[name] = group
    return groups


def _registry() -> Any:
    """Booleans are given as COLMAP's are: `--overwrite 1`."""
    registry = tyro.constructors.ConstructorRegistry()

    def parse(words: list[str]) -> bool:
        word = words[0].lower()
        if word not in _TRUE + _FALSE:
            raise ValueError(f"'{words[0]}' is neither 0 nor 1")
        return word in _TRUE

    @registry.primitive_rule
    def boolean(info: tyro.constructors.PrimitiveTypeInfo) -> Any:
        if info.type is not bool:
            return None
        return tyro.constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="{0,1}",
            instance_from_str=parse,
            is_instance=lambda instance: isinstance(instance, bool),
            str_from_instance=lambda instance: ["1" if instance else "0"],
        )

    return registry


Command = (
    Annotated[Refiner, tyro.conf.subcommand(name="refiner", prefix_name=False)]
    | Annotated[ModelAnalyzer, tyro.conf.subcommand(name="model_analyzer", prefix_name=False)]
)


def main(arguments: list[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: those of the command line, `sys.argv[1:]` by default.

    Returns:
        Exit status: 0, 1 for an error that is the user's to mend, 130 for Ctrl-C. A wrong command line exits with 2.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        command = tyro.cli(
            Command,
            prog="colmap-refract",
            description="Refraction-aware refinement of COLMAP models: scenes photographed through a plane interface.",
            args=arguments,
            use_underscores=True,
            config=(tyro.conf.FlagConversionOff,),
            registry=_registry(),
        )
        command.run()
    except RefractError as error:
        print(f"ERROR: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nInterrupted: nothing was written.", file=sys.stderr)
        return _INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
