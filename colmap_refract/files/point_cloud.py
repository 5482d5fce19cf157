"""Point clouds with normals and colours as COLMAP's `fused.ply`, and what such a file holds before it is used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError, reason_of
from colmap_refract.interface import Array

_VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in ("red", "green", "blue")]
)
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_LONGEST_HEADER = 1 << 16
_FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_HINT = "give the fused.ply of dense_reconstructor, or of COLMAP"


def write_point_cloud(path: Path, points: Array, normals: Array, colours: NDArray[np.uint8]) -> None:
    """Write points as PLY: binary, little-endian, x y z nx ny nz red green blue.

    Args:
        path: the file to be written.
        points, normals: (n, 3). colours: (n, 3) RGB.
    """
    vertices = np.empty(len(points), _VERTEX)
    for values, names in ((points, "x y z"), (normals, "nx ny nz"), (colours, "red green blue")):
        for k, name in enumerate(names.split()):
            vertices[name] = values[:, k]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {'uchar' if _VERTEX[name] == 'u1' else 'float'} {name}" for name in _VERTEX.names or ()]
    with path.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        vertices.tofile(file)


def read_point_cloud(path: Path) -> tuple[Array, Array]:
    """Points and normals of a PLY file, binary or text, whatever else its vertices have.

    Returns:
        points, normals: (n, 3) each.

    Raises:
        RefractError: there is no such file, it cannot be read, is no PLY file or cut off, or has no normals.
    """
    points, normals = np.split(_read(path, ("x", "y", "z", "nx", "ny", "nz")), 2, axis=1)
    return points, normals


def read_points(path: Path) -> Array:
    """Points (n, 3) of a PLY file, such as the vertices of a mesh, binary or text.

    Raises:
        RefractError: there is no such file, it cannot be read, is no PLY file or cut off.
    """
    return _read(path, ("x", "y", "z"))


def _read(path: Path, wanted: tuple[str, ...]) -> Array:
    """Properties (n, k) of a PLY file's vertices."""
    if not path.exists():
        raise RefractError(f"there is no file {path}; {_HINT}")
    if path.is_dir():
        raise RefractError(f"{path} is a folder; {_HINT}")
    try:
        with path.open("rb") as file:
            head = file.read(_LONGEST_HEADER)
            form, count, names, types, size = _parse(head, path)
            lacking = [name for name in wanted if name not in names]
            if lacking:
                what = "normals" if lacking[0].startswith("n") else "coordinates"
                raise RefractError(f"the points of {path} have no {what} ({', '.join(lacking)}); {_HINT}")
            file.seek(size)
            if form == "ascii":
                rows = [line.split() for _, line in zip(range(count), file, strict=False)]
                table = np.array([row[: len(names)] for row in rows], dtype=np.float64).reshape(-1, len(names))
                columns = {name: table[:, k] for k, name in enumerate(names)}
                complete = len(table) == count
            else:
                dtype = np.dtype([(name, _FORMATS[form] + kind) for name, kind in zip(names, types, strict=True)])
                complete = path.stat().st_size - size >= count * dtype.itemsize
                vertices = np.fromfile(file, dtype, count if complete else 0)
                columns = {name: vertices[name] for name in names}
    except OSError as error:
        raise RefractError(f"{path} cannot be read ({reason_of(error)}); {_HINT}") from None
    except ValueError:
        raise RefractError(f"{path} is not a PLY file of points, or it is damaged; {_HINT}") from None
    if not complete:
        raise RefractError(f"{path} is cut off: it ends before its {count} points do; write it again")
    return np.column_stack([columns[name] for name in wanted]).astype(np.float64)


def num_vertices(path: Path) -> int:
    """Number of vertices that the header of a PLY file states; 0 if it is none.

    Raises:
        OSError: it cannot be opened.
    """
    with path.open("rb") as file:
        try:
            return _parse(file.read(_LONGEST_HEADER), path)[1]
        except (RefractError, ValueError):
            return 0


def _parse(head: bytes, path: Path) -> tuple[str, int, list[str], list[str], int]:
    """Format, number of vertices, names and types of their properties, and length of the header."""
    end = head.find(b"end_header")
    newline = head.find(b"\n", end)
    lines = head[:end].decode("ascii", "replace").split("\n")
    if not head.startswith(b"ply") or end < 0 or newline < 0:
        raise RefractError(f"{path} is not a PLY file; {_HINT}")
    form, count, element = "", -1, ""
    names: list[str] = []
    types: list[str] = []
    for line in lines:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            if count < 0 and words[1] != "vertex":
                raise ValueError("the vertices do not come first")
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES:
                raise ValueError("a vertex property is no number")
            types.append(_TYPES[words[1]])
            names.append(words[2])
    if count < 0 or form not in ("ascii", *_FORMATS):
        raise ValueError("no vertices, or an unknown format")
    return form, count, names, types, newline + 1
