"""`refraction.json`: what a COLMAP model cannot hold, beside the model.

    {"format": "colmap_refract", "version": 1, "scenario": ...,
     "layers": [{"thickness": number, or null for the water, "refractive_index": number}, ...],
     "images": {name: {"image_id", "normal_in_cam", "distance", "group", "normal_std_deg", "distance_std", "surface"}},
     "world_planes": {group: {"normal_in_world", "offset"}},
     "units": {...}, "options": {...}, "solver": {...}, "statistics": {...}}

An image without an interface is listed with `normal_in_cam` and `distance` null. Lengths are in model units.

`surface` is there where an image's interface is not flat:

    {"axes": [[e1x, e2x], [e1y, e2y], [e1z, e2z]], "x": [...], "y": [...], "heights": [[...], ...],
     "correlation_length", "slope_deviation"}

as `colmap_refract.water_surface` has them: `heights[j][i]`, at the node `(x[i], y[j])` along the axes of the camera's
frame, counts along `normal_in_cam`. The version is then 2, and 1 where all surfaces are flat: readers of version 1
pass over keys that they do not know, and would take a wavy surface for a plane.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers
from colmap_refract.water_surface import WaterSurface

SIDECAR_NAME = "refraction.json"
FORMAT = "colmap_refract"
VERSION = 2
_VERSION_OF_PLANES = 1
_MOST_TILT = 0.5
"""Of a surface's axes against its plane, a sine. Planes may have moved a little since the axes were laid."""

Vector = tuple[float, float, float]
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class ImageInterface:
    """The interface in front of one image; `normal_in_cam` and `distance` are None where there is none.

    Attributes:
        image_id: of the COLMAP model.
        normal_in_cam: unit, from the camera into the water.
        distance: from the projection centre to the plane along the normal, > 0, model units.
        group: name of the interface that the image shares with others.
        normal_std_deg: standard deviation of the normal's direction, degrees.
        distance_std: standard deviation of the distance, model units.
        surface: over the plane, model units; None where it is flat.
    """

    image_id: int
    normal_in_cam: Vector | None = None
    distance: float | None = None
    group: str | None = None
    normal_std_deg: float | None = None
    distance_std: float | None = None
    surface: WaterSurface | None = None

    def __post_init__(self) -> None:
        if (self.normal_in_cam is None) != (self.distance is None):
            raise RefractError("only one of normal_in_cam and distance is given; give both, or none for a dry image")
        if self.normal_in_cam is not None:
            _check_unit(self.normal_in_cam, "normal_in_cam")
        if self.distance is not None and not (math.isfinite(self.distance) and self.distance > 0):
            raise RefractError(f"distance {self.distance:g} is not positive; it is from the camera to the plane")
        if self.surface is not None:
            if self.normal_in_cam is None:
                raise RefractError("a surface is given without its plane; give normal_in_cam and distance, too")
            if np.abs(self.normal_in_cam @ self.surface.axes).max() > _MOST_TILT:
                raise RefractError("the axes of a surface do not lie along its plane; they are in the camera's frame")


@dataclass(frozen=True, kw_only=True)
class WorldPlane:
    """The plane `normal_in_world . x = offset`, the normal unit and into the water, the offset in model units."""

    normal_in_world: Vector
    offset: float

    def __post_init__(self) -> None:
        _check_unit(self.normal_in_world, "normal_in_world")
        if not math.isfinite(self.offset):
            raise RefractError(f"offset {self.offset:g} is not a finite number")


@dataclass(frozen=True, kw_only=True)
class Sidecar:
    """The contents of `refraction.json`: images by name, planes of the world by group."""

    scenario: str
    layers: Layers
    images: dict[str, ImageInterface]
    world_planes: dict[str, WorldPlane] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    solver: dict[str, Any] = field(default_factory=dict)
    statistics: dict[str, Any] = field(default_factory=dict)


def write_sidecar(sidecar: Sidecar, path: str | Path) -> None:
    """Write `refraction.json`; every float comes back the same, and what is not finite comes back as None.

    Args:
        path: the file to be written.
    """
    layers = sidecar.layers
    wavy = any(image.surface is not None for image in sidecar.images.values())
    document: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION if wavy else _VERSION_OF_PLANES,
        "scenario": sidecar.scenario,
        "layers": [
            {"thickness": thickness, "refractive_index": index}
            for thickness, index in zip([*layers.thickness, None], layers.index, strict=True)
        ],
        **{
            part.name: _plain(getattr(sidecar, part.name))
            for part in dataclasses.fields(sidecar)
            if part.name not in ("scenario", "layers")
        },
    }
    for image in document["images"].values():
        if image["surface"] is None:
            del image["surface"]
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    # Half a surrogate pair has no UTF-8, and its backslash form is just how JSON escapes it.
    Path(path).write_bytes(text.encode("utf-8", "backslashreplace"))


def read_sidecar(path: str | Path) -> Sidecar:
    """Read `refraction.json`; keys that are not known are passed over.

    Args:
        path: the file, or the folder that holds it.

    Raises:
        RefractError: there is no such file, or it is not a sidecar of this version, or something in it is missing
            or impossible.
    """
    file = Path(path)
    if file.is_dir():
        file /= SIDECAR_NAME
    try:
        root = json.loads(file.read_bytes().decode("utf-8-sig"), parse_constant=_no_constant)
    except FileNotFoundError:
        raise RefractError(f"{file} does not exist; it is written beside a model that was refined") from None
    except OSError as error:
        raise RefractError(f"cannot read {file}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise RefractError(f"{file}: not valid JSON ({error}); write it again") from None
    if not isinstance(root, dict) or root.get("format") != FORMAT:
        raise RefractError(f'{file}: not a sidecar of this package ("format" is not "{FORMAT}"); give {SIDECAR_NAME}')
    version = root.get("version")
    if type(version) is not int or version < 1:
        raise RefractError(f"{file}: version {version!r} is not a format version; write it again")
    if version > VERSION:
        raise RefractError(
            f"{file}: format version {version} is newer than this package reads ({VERSION}); update colmap_refract"
        )
    with _within(str(file)):
        return Sidecar(
            scenario=_get(root, "scenario", _text),
            layers=_get(root, "layers", _layers),
            images=_get(root, "images", _by_name(_image_interface)),
            world_planes=_get(root, "world_planes", _by_name(_world_plane)),
            units=_get(root, "units", _by_name(_text)),
            options=_get(root, "options", _object),
            solver=_get(root, "solver", _object),
            statistics=_get(root, "statistics", _object),
        )


def _plain(value: Any) -> Any:
    """`value` in the types of JSON: no NaN, no numpy, no dataclass, no path."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {part.name: _plain(getattr(value, part.name)) for part in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def _check_unit(vector: Vector, name: str) -> None:
    if not (len(vector) == 3 and abs(math.hypot(*vector) - 1) < 1e-6):
        raise RefractError(f"{name} {list(map(float, vector))} is not a unit vector of three numbers; normalise it")


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a JSON number")


# The functions below take a parsed value to what it stands for, or raise ValueError or RefractError.


@contextmanager
def _within(place: str) -> Iterator[None]:
    """Say in errors where they arose."""
    try:
        yield
    except (ValueError, RefractError) as error:
        raise RefractError(f"{place}: {error}") from None


def _get(parent: dict[str, Any], key: str, parse: Callable[[Any], T]) -> T:
    if key not in parent:
        raise ValueError(f'"{key}" is missing; write the file again')
    with _within(f'"{key}"'):
        return parse(parent[key])


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError("not a JSON object")
    return value


def _by_name(parse: Callable[[Any], T]) -> Callable[[Any], dict[str, T]]:
    return lambda value: {name: _get(value, name, parse) for name in _object(value)}


def _optional(parse: Callable[[Any], T]) -> Callable[[Any], T | None]:
    return lambda value: None if value is None else parse(value)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r} is not text")
    return value


def _integer(value: Any) -> int:
    if type(value) is not int:
        raise ValueError(f"{value!r} is not an integer")
    return value


def _number(value: Any) -> float:
    # 1e999 is valid JSON and infinite; an integer of 400 digits is no float at all.
    if type(value) not in (int, float) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{value!r} is not a finite number")
    return float(value)


def _vector(value: Any) -> Vector:
    if not (isinstance(value, list) and len(value) == 3):
        raise ValueError(f"{value!r} is not a list of three numbers")
    return _number(value[0]), _number(value[1]), _number(value[2])


def _layers(value: Any) -> Layers:
    if not (isinstance(value, list) and value):
        raise ValueError("not a list of layers")
    thickness = [_get(_object(layer), "thickness", _optional(_number)) for layer in value]
    index = [_get(layer, "refractive_index", _number) for layer in value]
    walls = [h for h in thickness[:-1] if h is not None]
    if thickness[-1] is not None or len(walls) != len(value) - 1:
        raise ValueError("the thickness must be null in the last layer, the water, and only there")
    return Layers(thickness=tuple(walls), index=tuple(index))


def _image_interface(value: Any) -> ImageInterface:
    entry = {"group": None, "normal_std_deg": None, "distance_std": None, "surface": None, **_object(value)}
    return ImageInterface(
        image_id=_get(entry, "image_id", _integer),
        normal_in_cam=_get(entry, "normal_in_cam", _optional(_vector)),
        distance=_get(entry, "distance", _optional(_number)),
        group=_get(entry, "group", _optional(_text)),
        normal_std_deg=_get(entry, "normal_std_deg", _optional(_number)),
        distance_std=_get(entry, "distance_std", _optional(_number)),
        surface=_get(entry, "surface", _optional(_surface)),
    )


def _surface(value: Any) -> WaterSurface:
    entry = {"slope_deviation": None, **_object(value)}
    return WaterSurface(
        axes=_get(entry, "axes", _matrix),
        x=_get(entry, "x", _numbers),
        y=_get(entry, "y", _numbers),
        heights=_get(entry, "heights", _matrix),
        correlation_length=_get(entry, "correlation_length", _number),
        slope_deviation=_get(entry, "slope_deviation", _optional(_number)),
    )


def _numbers(value: Any) -> Array:
    if not isinstance(value, list):
        raise ValueError("not a list of numbers")
    return np.array([_number(item) for item in value], dtype=np.float64)


def _matrix(value: Any) -> Array:
    rows = [_numbers(row) for row in value] if isinstance(value, list) else []
    if not rows or len({len(row) for row in rows}) > 1:
        raise ValueError("not a list of equally long lists of numbers")
    return np.array(rows)


def _world_plane(value: Any) -> WorldPlane:
    return WorldPlane(
        normal_in_world=_get(_object(value), "normal_in_world", _vector),
        offset=_get(value, "offset", _number),
    )
