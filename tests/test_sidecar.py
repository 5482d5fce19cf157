"""The sidecar comes back as it was written, and a wrong one says what is wrong."""

from __future__ import annotations

import dataclasses
import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import error_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from colmap_refract.files.sidecar import ImageInterface, Sidecar, WorldPlane, read_sidecar, write_sidecar
from colmap_refract.interface import Layers, tangent_basis
from colmap_refract.water_surface import WaterSurface

finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=5e-324, allow_infinity=False, allow_nan=False)
# Half a surrogate pair too: that is what Python makes of a file name that is not UTF-8.
names = st.text(st.characters(), max_size=20)


@st.composite
def units(draw: st.DrawFn) -> tuple[float, float, float]:
    vector = np.array([draw(st.floats(-1, 1)) for _ in range(3)])
    length = np.linalg.norm(vector)
    unit = vector / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])
    return float(unit[0]), float(unit[1]), float(unit[2])


@st.composite
def surfaces_over(draw: st.DrawFn, normal: tuple[float, float, float]) -> WaterSurface:
    nx, ny = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    x, y = (np.sort(draw(st.lists(finite, min_size=n, max_size=n, unique=True))) for n in (nx, ny))
    return WaterSurface(
        axes=tangent_basis(np.array(normal)),
        x=x + 0.0,  # 0.0 and -0.0 are not unique
        y=y + 0.0,
        heights=np.array(draw(st.lists(finite, min_size=nx * ny, max_size=nx * ny))).reshape(ny, nx),
        correlation_length=draw(positive),
        slope_deviation=draw(st.none() | st.floats(0, 1e300)),
    )


@st.composite
def planes_and_surfaces(draw: st.DrawFn) -> ImageInterface:
    plain = draw(planes)
    assert plain.normal_in_cam is not None
    return dataclasses.replace(plain, surface=draw(surfaces_over(plain.normal_in_cam)))


planes = st.builds(
    ImageInterface,
    image_id=st.integers(0, 2**32 - 2),
    normal_in_cam=units(),
    distance=positive,
    group=st.none() | names,
    normal_std_deg=st.none() | finite,
    distance_std=st.none() | finite,
)
wet = planes | planes_and_surfaces()
dry = st.builds(ImageInterface, image_id=st.integers(0, 2**32 - 2))
layers = st.integers(0, 3).flatmap(
    lambda n: st.builds(
        Layers,
        thickness=st.tuples(*[st.floats(0, 1e300)] * n),
        index=st.tuples(*[positive] * (n + 1)),
    )
)
values = st.recursive(st.none() | st.booleans() | st.integers() | finite | names, st.lists, max_leaves=5)
sidecars = st.builds(
    Sidecar,
    scenario=names,
    layers=layers,
    images=st.dictionaries(names, wet | dry, max_size=4),
    world_planes=st.dictionaries(names, st.builds(WorldPlane, normal_in_world=units(), offset=finite), max_size=2),
    units=st.dictionaries(names, names, max_size=2),
    options=st.dictionaries(names, values, max_size=3),
    solver=st.dictionaries(names, values, max_size=3),
    statistics=st.dictionaries(names, values, max_size=3),
)


@given(sidecar=sidecars)
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_round_trip_is_exact(tmp_path: Path, sidecar: Sidecar) -> None:
    file = tmp_path / "refraction.json"
    write_sidecar(sidecar, file)
    assert read_sidecar(file) == sidecar
    assert repr(read_sidecar(tmp_path)) == repr(sidecar), "-0.0 == 0.0, but not here"


def example() -> Sidecar:
    return Sidecar(
        scenario="moving_interface",
        layers=Layers(thickness=(0.01,), index=(1.49, 1.333)),
        images={
            "dive 1/プール.png": ImageInterface(
                image_id=1,
                normal_in_cam=(0.0, 0.6, 0.8),
                distance=0.5,
                group="tank",
                normal_std_deg=0.1,
                distance_std=0.01,
            ),
            "dry.png": ImageInterface(image_id=2),
        },
        world_planes={"tank": WorldPlane(normal_in_world=(0.0, 0.0, 1.0), offset=-2.0)},
        units={"length": "metre"},
        solver={"converged": True},
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "refraction.json"
    write_sidecar(example(), path)
    return path


def test_format(file: Path) -> None:
    assert "プール" in file.read_text(encoding="utf-8")
    root = json.loads(file.read_text(encoding="utf-8"))
    assert root["format"] == "colmap_refract" and root["version"] == 1
    assert root["layers"] == [
        {"thickness": 0.01, "refractive_index": 1.49},
        {"thickness": None, "refractive_index": 1.333},
    ]
    assert root["images"]["dry.png"] == {
        "image_id": 2,
        "normal_in_cam": None,
        "distance": None,
        "group": None,
        "normal_std_deg": None,
        "distance_std": None,
    }
    assert root["world_planes"] == {"tank": {"normal_in_world": [0.0, 0.0, 1.0], "offset": -2.0}}


def test_what_json_cannot_hold(tmp_path: Path) -> None:
    interface: Any = {"image_id": np.int64(1), "normal_in_cam": np.array([0.0, 0.0, 1.0]), "distance": np.float64(2)}
    sidecar = Sidecar(
        scenario="static_interface",
        layers=Layers(),
        images={"a": ImageInterface(**interface, distance_std=math.nan)},
        options={"path": Path("a/b"), "tuple": (1, math.inf), 3: np.arange(2)},  # type: ignore[dict-item]
        statistics={
            "rms": np.float32(0.5),
            "cov": np.array([[1.0, np.nan]]),
            "flag": np.bool_(True),
            "layers": Layers(),
        },
    )
    write_sidecar(sidecar, tmp_path / "s.json")
    text = (tmp_path / "s.json").read_text()
    assert "NaN" not in text and "Infinity" not in text
    read = read_sidecar(tmp_path / "s.json")
    assert read.images["a"] == ImageInterface(image_id=1, normal_in_cam=(0.0, 0.0, 1.0), distance=2.0)
    assert read.options == {"path": "a/b", "tuple": [1, None], "3": [0, 1]}
    assert read.statistics == {
        "rms": 0.5,
        "cov": [[1.0, None]],
        "flag": True,
        "layers": {"thickness": [], "index": [1.333]},
    }


def edited(file: Path, *keys: Any, value: Any = None, remove: bool = False) -> Path:
    """The example with one value replaced or removed."""
    root = json.loads(file.read_text(encoding="utf-8"))
    parent = root
    for key in keys[:-1]:
        parent = parent[key]
    if remove:
        del parent[keys[-1]]
    else:
        parent[keys[-1]] = value
    file.write_text(json.dumps(root), encoding="utf-8")
    return file


def test_no_such_file(tmp_path: Path) -> None:
    assert "refraction.json does not exist" in error_of(lambda: read_sidecar(tmp_path))
    assert "does not exist" in error_of(lambda: read_sidecar(tmp_path / "a" / "b.json"))


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100000, b'{"format": NaN}', b"\0"])
def test_not_json(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    assert "not valid JSON" in error_of(lambda: read_sidecar(file))


@pytest.mark.parametrize("content", [b"1", b"[]", b"{}", b'{"format": "other", "version": 1}'])
def test_other_json(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    assert "not a sidecar of this package" in error_of(lambda: read_sidecar(file))


def test_versions(file: Path) -> None:
    message = error_of(lambda: read_sidecar(edited(file, "version", value=3)))
    assert "newer" in message and "update colmap_refract" in message
    for version in (0, -1, "1", 1.5, True, None):
        assert "not a format version" in error_of(partial(read_sidecar, edited(file, "version", value=version)))


@pytest.mark.parametrize(
    "keys",
    [
        ("scenario",),
        ("layers",),
        ("images",),
        ("world_planes",),
        ("units",),
        ("options",),
        ("solver",),
        ("statistics",),
        ("layers", 0, "thickness"),
        ("layers", 1, "refractive_index"),
        ("images", "dry.png", "image_id"),
        ("images", "dry.png", "normal_in_cam"),
        ("images", "dry.png", "distance"),
        ("world_planes", "tank", "normal_in_world"),
        ("world_planes", "tank", "offset"),
    ],
)
def test_missing_keys(file: Path, keys: tuple[Any, ...]) -> None:
    assert f'"{keys[-1]}" is missing' in error_of(lambda: read_sidecar(edited(file, *keys, remove=True)))


WET = ("images", "dive 1/プール.png")


@pytest.mark.parametrize(
    ("keys", "value", "expected"),
    [
        ((*WET, "normal_in_cam"), [0, 0.6, 0.9], "not a unit vector"),
        ((*WET, "normal_in_cam"), [0, 0, 0], "not a unit vector"),
        ((*WET, "normal_in_cam"), [0, 1], "not a list of three numbers"),
        ((*WET, "normal_in_cam"), [0, "0", 1], "not a finite number"),
        ((*WET, "normal_in_cam"), None, "only one of"),
        ((*WET, "distance"), 0, "distance 0 is not positive"),
        ((*WET, "distance"), -1.5, "not positive"),
        ((*WET, "distance"), 10**400, "not a finite number"),
        ((*WET, "distance"), True, "not a finite number"),
        ((*WET, "distance"), "1", "not a finite number"),
        ((*WET, "distance"), None, "only one of"),
        ((*WET, "image_id"), 1.0, "not an integer"),
        ((*WET, "group"), 3, "not text"),
        (("images",), [], "not a JSON object"),
        (("images", "dry.png"), None, "not a JSON object"),
        (("layers",), [], "not a list of layers"),
        (("layers",), {}, "not a list of layers"),
        (("layers", 0), 1, "not a JSON object"),
        (("layers", 0, "thickness"), None, "must be null in the last layer"),
        (("layers", 0, "thickness"), -1, "negative"),
        (("layers", 1, "thickness"), 1, "must be null in the last layer"),
        (("layers", 1, "refractive_index"), 0, "not positive"),
        (("world_planes", "tank", "normal_in_world"), [0, 0, 2], "not a unit vector"),
        (("world_planes", "tank", "offset"), None, "not a finite number"),
        (("scenario",), 1, "not text"),
        (("solver",), 1, "not a JSON object"),
    ],
)
def test_impossible_values(file: Path, keys: tuple[Any, ...], value: Any, expected: str) -> None:
    message = error_of(lambda: read_sidecar(edited(file, *keys, value=value)))
    assert message.startswith(f'{file}: "{keys[0]}"') and expected in message


SURFACE = WaterSurface(
    axes=np.array([[1.0, 0.0], [0.0, 0.8], [0.0, -0.6]]),
    x=np.array([0.1, 0.2, 0.4]),
    y=np.array([-1.0, 1.0]),
    heights=np.array([[0.01, 1 / 3, -0.02], [0.0, 1e-300, -0.5]]),
    correlation_length=0.7,
    slope_deviation=0.05,
)


@pytest.fixture
def wavy(tmp_path: Path) -> Path:
    sidecar, name = example(), WET[1]
    images = {**sidecar.images, name: dataclasses.replace(sidecar.images[name], surface=SURFACE)}
    path = tmp_path / "refraction.json"
    write_sidecar(dataclasses.replace(sidecar, images=images), path)
    return path


def test_format_of_a_surface(wavy: Path) -> None:
    root = json.loads(wavy.read_text(encoding="utf-8"))
    assert root["version"] == 2, "a reader of version 1 would take it for a plane"
    assert root["images"][WET[1]]["surface"] == {
        "axes": [[1.0, 0.0], [0.0, 0.8], [0.0, -0.6]],
        "x": [0.1, 0.2, 0.4],
        "y": [-1.0, 1.0],
        "heights": [[0.01, 1 / 3, -0.02], [0.0, 1e-300, -0.5]],
        "correlation_length": 0.7,
        "slope_deviation": 0.05,
    }
    assert "surface" not in root["images"]["dry.png"]
    surface = read_sidecar(wavy).images[WET[1]].surface
    assert surface == SURFACE
    edited(wavy, *WET, "surface", "slope_deviation", remove=True)
    assert read_sidecar(wavy).images[WET[1]].surface == dataclasses.replace(SURFACE, slope_deviation=None)


def test_flat_ones_are_what_they_were(file: Path) -> None:
    """Readers of version 1 read them, and what such a writer wrote is read."""
    root = json.loads(file.read_text(encoding="utf-8"))
    assert root["version"] == 1
    assert all("surface" not in image for image in root["images"].values())
    edited(file, "version", value=2)
    assert read_sidecar(file) == example()


@pytest.mark.parametrize(
    ("keys", "value", "expected"),
    [
        ((), 3, "not a JSON object"),
        (("axes",), [[1, 0], [0, 1]], "not two orthonormal"),
        (("axes",), [[1, 0], [0, 1], [0]], "equally long"),
        (("axes",), [[1, 0], [0, 0.6], [0, 0.8]], "do not lie along its plane"),
        (("x",), [0.1, 0.4, 0.2], "increasing"),
        (("x",), [0.1, 0.2], "shape (2, 3), its nodes (2, 2)"),
        (("x",), 1, "not a list"),
        (("y", 0), "a", "not a finite number"),
        (("heights",), [], "equally long"),
        (("heights", 0), [], "equally long"),
        (("heights", 0, 1), None, "not a finite number"),
        (("correlation_length",), 0, "not positive"),
        (("slope_deviation",), -0.1, "negative"),
    ],
)
def test_impossible_surfaces(wavy: Path, keys: tuple[Any, ...], value: Any, expected: str) -> None:
    message = error_of(lambda: read_sidecar(edited(wavy, *WET, "surface", *keys, value=value)))
    assert message.startswith(f'{wavy}: "images"') and expected in message


def test_surface_without_a_plane(wavy: Path) -> None:
    for key in ("normal_in_cam", "distance"):
        edited(wavy, *WET, key, value=None)
    assert "without its plane" in error_of(lambda: read_sidecar(wavy))


@pytest.mark.parametrize("key", ["axes", "x", "y", "heights", "correlation_length"])
def test_incomplete_surfaces(wavy: Path, key: str) -> None:
    assert f'"{key}" is missing' in error_of(lambda: read_sidecar(edited(wavy, *WET, "surface", key, remove=True)))


def test_infinite_literal(file: Path) -> None:
    file.write_text(file.read_text(encoding="utf-8").replace("0.5", "1e999"), encoding="utf-8")
    assert "not a finite number" in error_of(lambda: read_sidecar(file))


def test_unknown_and_optional_keys(file: Path) -> None:
    edited(file, "future", value={"x": 1})
    edited(file, *WET, "future", value=1)
    edited(file, "images", "dry.png", "group", remove=True)
    assert read_sidecar(file) == example()


def test_hand_made_file_may_begin_with_a_mark(file: Path) -> None:
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert read_sidecar(file) == example()
