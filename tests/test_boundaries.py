"""Which module may import what: the direction of dependencies, and the few places for each large library.

Read from the source, so imports inside functions count as well.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import colmap_refract

PACKAGE = Path(colmap_refract.__file__).parent

LAYERS = [
    {"errors"},
    {"interface", "machine"},
    {"options", "water_surface"},
    {"files.model_files", "files.quiet"},
    {"files.text_files", "files.binary_files", "files.sidecar"},
    {"files.surface_files", "files.surface_picture"},
    {"files.cameras_file", "files.output", "files.point_cloud", "files.surfaces"},
    {"files.model_io"},
    {"estimator.rotation", "estimator.optics"},
    {"estimator.robust"},
    {"estimator.neighbours", "estimator.back_projection", "estimator.observed", "estimator.wavy_projection"},
    {"estimator.on_ray", "estimator.scene_residual", "estimator.correlation", "estimator.banded"},
    {"estimator.elimination"},
    {"estimator.assembly"},
    {"estimator.random_slopes"},
    {"estimator.scenario"},
    {"estimator.surface", "estimator.random_surface"},
    {"estimator.triangulation", "estimator.chunk"},
    {"estimator.priors", "estimator.printed_unknowns", "estimator.own_slopes"},
    {"estimator.printed_terms", "estimator.whole"},
    {"estimator.levenberg"},
    {"estimator.adjustment"},
    {"estimator.soft_as_printed", "estimator.reference_rays"},
    {"refiner.observations", "refiner.alignment", "refiner.normal_equations", "refiner.report", "refiner.diagnosis"},
    {"refiner.start"},
    {"refiner.filtering", "refiner.uncertainty", "refiner.arrangement"},
    {"refiner.averaging"},
    {"refiner.continuation", "refiner.advice"},
    {"refiner.waves", "refiner.selection"},
    {"refiner.wave_statistics"},
    {"refiner.soft", "refiner.solution"},
    {"refiner.outcome", "refiner.wave_output", "refiner.plane_solution"},
    {"refiner.soft_solution", "refiner.reference_solution", "refiner.own_normals"},
    {"refiner.printed_solution"},
    {"refiner.refinement"},
    {"refiner.held_out"},
    {"refiner.comparison"},
    {"refiner.scenario_choice"},
    {"__init__"},
    {"photographs.silence", "frame_selection.options"},
    {"photographs.images"},
    {"photographs.frames", "frame_selection.selection", "frame_selection.quality", "frame_selection.sparse_flow"},
    {
        "photographs.video", "frame_selection.fixed_camera", "frame_selection.looking",
        "frame_selection.moving_camera",
    },
    {"frame_selection.report", "frame_selection.plot"},
    {"frame_selection.choice", "frame_selection.output"},
    {"optical_flow.options"},
    {"optical_flow.pictures", "optical_flow.field"},
    {"optical_flow.estimate"},
    {"optical_flow.frame", "optical_flow.reference"},
    {"optical_flow.tracking"},
    {"optical_flow.report"},
    {"calibration.boards"},
    {"calibration.adjustment", "calibration.search"},
    {"calibration.calibration", "calibration.precision"},
    {"calibration.coverage"},
    {"calibration.picture"},
    {"calibration.output"},
    {"calibration.report"},
    {"mapping.database", "mapping.known_views"},
    {"triangulator.options"},
    {"triangulator.outcome"},
    {"triangulator.triangulation", "triangulator.report"},
    {"mapping.completion", "mapping.flow_database", "mapping.tracks"},
    {"mapping.retriangulation"},
    {"mapping.model_from_database", "mapping.pairs", "mapping.dry_adjustment"},
    {"mapping.clouds", "mapping.registration"},
    {"mapping.fixed_camera", "mapping.moving_camera"},
    {"mapping.initial"},
    {"mapping.initial_report"},
    {"comparators.keypoints", "comparators.level_water"},
    {"comparators.turbulence"},
    {"comparators.depth_from_refraction", "comparators.depth_from_turbulence"},
    {"comparators.methods"},
    {"reconstructor.options", "reconstructor.record", "reconstructor.watcher"},
    {
        "reconstructor.colmap_options", "reconstructor.colmap_process", "reconstructor.contents",
        "reconstructor.inventory", "reconstructor.workspace",
    },
    {"reconstructor.calibration"},
    {"reconstructor.workspace_database"},
    {"reconstructor.features", "reconstructor.flow", "reconstructor.matches", "reconstructor.models"},
    {"reconstructor.refined"},
    {"reconstructor.pipeline"},
    {"dense.options", "dense.known_images", "dense.grid", "dense.neighbourhood"},
    {"dense.choice", "dense.matching", "dense.triangulation", "dense.meshing"},
    {"dense.reconstruction"},
    {"dense.picture", "dense.report"},
    {
        "simulation.least_path", "simulation.surface", "simulation.ray_tracing", "simulation.stones",
        "simulation.point_elimination",
    },
    {"simulation.waves", "simulation.wave_path"},
    {"simulation.scene"},
    {
        "simulation.capture", "simulation.database", "simulation.precision", "simulation.terrain", "simulation.texture",
        "simulation.painting",
    },
    {"simulation.accuracy", "simulation.view"},
    {"simulation.rendering", "simulation.truth", "simulation.bayesian"},
    {"simulation.session", "simulation.judge"},
    {"simulation.plan"},
    {"simulation.plan_report"},
    {"simulation"},
    {"experiments.scenes", "experiments.results", "experiments.parallel"},
    {"experiments.methods", "experiments.charts"},
    {"experiments.measure", "experiments.tables"},
    {"experiments.flat", "experiments.wavy", "experiments.brick", "experiments.pool", "experiments.page"},
    {"experiments.body"},
    {"experiments.mannequin"},
    {"experiments.run"},
    {"commands.lists", "commands.progress"},
    {
        "commands.automatic_reconstructor", "commands.camera_calibrator", "commands.dense_reconstructor",
        "commands.experiments", "commands.flow_matcher", "commands.image_selector", "commands.initial_mapper",
        "commands.model_analyzer", "commands.point_triangulator", "commands.poisson_mesher", "commands.refiner",
        "commands.simulator",
    },
    {"cli"},
    {"__main__"},
]  # fmt: skip
"""A module imports from earlier layers only."""

SIMULATION_IMPORTS = {"errors", "interface", "machine", "options", "simulation"}
"""The simulation stands beside the layers: with the solver's optics, an error there would be in the truth, too."""

LIBRARIES = {
    "numba": {"estimator", "simulation.ray_tracing", "simulation.painting", "simulation.stones"},
    "pyceres": {"estimator.adjustment", "estimator.printed_terms", "estimator.soft_as_printed"},
    "pycolmap": {
        "files", "refiner.observations", "refiner.refinement", "refiner.outcome", "calibration", "mapping",
        "comparators", "reconstructor", "simulation", "commands.simulator",
    },
    "matplotlib": {"experiments.charts"},
    "tyro": {"cli", "commands"},
    "cv2": {"files.surface_picture", "photographs", "frame_selection", "optical_flow", "calibration", "dense"},
}  # fmt: skip
"""Which modules, or whole folders, may import a library at run time. For type checkers alone, everybody may."""

HEAVY = ("numba", "pycolmap", "pyceres", "scipy", "cv2", "matplotlib")

SOURCES = sorted(PACKAGE.rglob("*.py"))


def module_of(path: Path) -> str:
    """`estimator.optics` of `estimator/optics.py`; `__init__` and `simulation` of those folders' `__init__.py`."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)


def imports(tree: ast.AST, run_time_only: bool) -> Iterator[str]:
    """Full names of what is imported, `a.b.c` for `from a.b import c`."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif run_time_only and isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from imports(ast.Module(body=node.orelse, type_ignores=[]), run_time_only)
        else:
            yield from imports(node, run_time_only)


def imported(path: Path, run_time_only: bool) -> set[str]:
    return set(imports(ast.parse(path.read_text(encoding="utf-8")), run_time_only))


MODULES = {module_of(source) for source in SOURCES}


def own_imports(path: Path) -> set[str]:
    """Modules of the package that a file imports; `__init__` for what it takes from the package itself."""
    own = set()
    for name in imported(path, run_time_only=False):
        if name.startswith("colmap_refract."):
            inside = name.removeprefix("colmap_refract.")
            module = inside if inside in MODULES else inside.rpartition(".")[0]
            own.add(module if module in MODULES else "__init__")
    return own


def folder(module: str) -> str:
    return module.partition(".")[0]


def test_every_module_has_its_layer() -> None:
    placed = [module for layer in LAYERS for module in layer]
    assert len(placed) == len(set(placed))
    bare = {module_of(path) for path in SOURCES if path.name == "__init__.py" and not own_imports(path)}
    assert MODULES - bare == set(placed)


@pytest.mark.parametrize("path", SOURCES, ids=module_of)
def test_imports_point_to_earlier_layers(path: Path) -> None:
    module = module_of(path)
    place = next((k for k, layer in enumerate(LAYERS) if module in layer), 0)
    allowed: set[str] = set().union(*LAYERS[:place])
    if folder(module) == "simulation":
        allowed = {name for name in allowed if folder(name) in SIMULATION_IMPORTS}
    assert own_imports(path) <= allowed


@pytest.mark.parametrize("library", LIBRARIES)
def test_large_libraries_have_few_doors(library: str) -> None:
    users = {
        module_of(path)
        for path in SOURCES
        if any(name.split(".")[0] == library for name in imported(path, run_time_only=True))
    }
    doors = LIBRARIES[library]
    assert {user for user in users if user not in doors and folder(user) not in doors} == set()
    # If nobody uses it any more, the package need not depend on it.
    assert users or not doors


def test_only_experiments_commands_and_tests_know_the_simulation() -> None:
    users = {folder(module_of(path)) for path in SOURCES if "simulation" in map(folder, own_imports(path))}
    assert users <= {"simulation", "experiments", "commands"}


@pytest.mark.parametrize("module", ["colmap_refract", "colmap_refract.cli"])
def test_what_takes_time_is_imported_late(module: str) -> None:
    """`colmap-refract --help` and `import colmap_refract` load none of the large libraries."""
    code = f"import sys, {module}; print(*sorted({set(HEAVY)} & set(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert loaded.split() == []


def test_the_parser_of_imports_sees_them_all() -> None:
    source = """
from __future__ import annotations
from typing import TYPE_CHECKING
import a.b
if TYPE_CHECKING:
    import c
else:
    import d
def f():
    from e.f import g as h
    with open(h) as file:
        import i, j
"""
    names = {"__future__.annotations", "typing.TYPE_CHECKING", "a.b", "d", "e.f.g", "i", "j"}
    assert set(imports(ast.parse(source), run_time_only=True)) == names
    assert set(imports(ast.parse(source), run_time_only=False)) == {*names, "c"}
