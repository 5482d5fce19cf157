"""The command line, `colmap-refract COMMAND`: COLMAP's spelling, one clear line when something is wrong."""

from __future__ import annotations

import functools
import logging
import operator
import os
import sys
from typing import Annotated, Any

import tyro

from colmap_refract import __version__
from colmap_refract.commands.automatic_reconstructor import AutomaticReconstructor
from colmap_refract.commands.camera_calibrator import CameraCalibrator
from colmap_refract.commands.dense_reconstructor import DenseReconstructor
from colmap_refract.commands.experiments import Experiments
from colmap_refract.commands.flow_matcher import FlowMatcher
from colmap_refract.commands.image_selector import ImageSelector
from colmap_refract.commands.initial_mapper import InitialMapper
from colmap_refract.commands.model_analyzer import ModelAnalyzer
from colmap_refract.commands.point_triangulator import PointTriangulator
from colmap_refract.commands.poisson_mesher import PoissonMesher
from colmap_refract.commands.refiner import Refiner
from colmap_refract.commands.simulator import Simulator
from colmap_refract.errors import RefractError

_INTERRUPTED = 130
_TRUE, _FALSE = ("1", "true"), ("0", "false")


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


_COMMANDS = {
    "automatic_reconstructor": AutomaticReconstructor,
    "camera_calibrator": CameraCalibrator,
    "dense_reconstructor": DenseReconstructor,
    "experiments": Experiments,
    "flow_matcher": FlowMatcher,
    "image_selector": ImageSelector,
    "initial_mapper": InitialMapper,
    "model_analyzer": ModelAnalyzer,
    "point_triangulator": PointTriangulator,
    "poisson_mesher": PoissonMesher,
    "refiner": Refiner,
    "simulator": Simulator,
}


def _union() -> Any:
    """The commands as what tyro takes for subcommands."""
    subcommands = (
        Annotated[command, tyro.conf.subcommand(name=name, prefix_name=False)] for name, command in _COMMANDS.items()
    )
    return functools.reduce(operator.or_, subcommands)


def main(arguments: list[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: those of the command line, `sys.argv[1:]` by default.

    Returns:
        Exit status: 0, 1 for an error that is the user's to mend, 130 for Ctrl-C. A wrong command line exits with 2.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
        print(f"colmap-refract {__version__}")
        return 0
    try:
        command = tyro.cli(
            _union(),
            prog="colmap-refract",
            description="Refraction-aware refinement of COLMAP models: scenes photographed through a plane interface.",
            args=arguments,
            use_underscores=True,
            config=(tyro.conf.FlagConversionOff,),
            registry=_registry(),
        )
        command.run()
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read the output wants no more of it, as `head` does. Python would complain once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except RefractError as error:
        print(f"ERROR: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as interrupt:
        print(f"\n{interrupt}" if interrupt.args else "\nInterrupted: nothing was written.", file=sys.stderr)
        return _INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
