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
    {"interface", "model_files"},
    {"options", "rotation", "optics", "sidecar", "text_files", "binary_files"},
    {"elimination", "alignment", "cameras_file", "output", "report"},
    {"scenario", "model_io"},
    {"observations", "triangulation"},
    {"start", "chunk"},
    {"adjustment"},
    {"filtering", "uncertainty", "arrangement"},
    {"continuation", "advice"},
    {"selection"},
    {"outcome"},
    {"refinement"},
    {"__init__"},
    {"cli"},
]
"""A module imports from earlier layers only."""

SIMULATION_IMPORTS = {"errors", "interface", "options", "simulation"}
"""The simulation stands beside the layers: with the solver's optics, an error there would be in the truth, too."""

LIBRARIES = {
    "numba": {"optics", "elimination", "triangulation"},
    "pyceres": {"adjustment"},
    "pycolmap": {
        "observations", "cameras_file", "model_io", "simulation", "refinement", "outcome", "cli",
    },
    "tyro": {"cli"},
    "cv2": set(),
}  # fmt: skip
"""Who may import a library at run time. For type checkers alone, everybody may."""

HEAVY = ("numba", "pycolmap", "pyceres", "scipy", "cv2")

SOURCES = sorted(PACKAGE.rglob("*.py"))


def module_of(path: Path) -> str:
    """`optics` of `optics.py`, and `simulation` of every file in that folder."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


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


def own_imports(path: Path) -> set[str]:
    """Modules of the package that a file imports; `__init__` for what it takes from the package itself."""
    modules = {module_of(source) for source in SOURCES}
    own = {name.split(".")[1] for name in imported(path, run_time_only=False) if name.startswith("colmap_refract.")}
    return {name if name in modules else "__init__" for name in own}


def test_every_module_has_its_layer() -> None:
    placed = [module for layer in LAYERS for module in layer]
    assert len(placed) == len(set(placed))
    assert {module_of(path) for path in SOURCES} <= {*placed, "simulation"}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_to_earlier_layers(path: Path) -> None:
    module = module_of(path)
    if module == "simulation":
        allowed = SIMULATION_IMPORTS
    else:
        place = next(k for k, layer in enumerate(LAYERS) if module in layer)
        allowed = set().union(*LAYERS[:place])
    assert own_imports(path) <= allowed


@pytest.mark.parametrize("library", LIBRARIES)
def test_large_libraries_have_few_doors(library: str) -> None:
    users = {
        module_of(path)
        for path in SOURCES
        if any(name.split(".")[0] == library for name in imported(path, run_time_only=True))
    }
    assert users <= LIBRARIES[library]
    # If nobody uses it any more, the package need not depend on it.
    assert users or not LIBRARIES[library]


def test_only_tests_know_the_simulation() -> None:
    users = {module_of(path) for path in SOURCES if "simulation" in own_imports(path)}
    assert users <= {"simulation"}


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
