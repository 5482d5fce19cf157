"""Height maps, meshes and their overview: what they show is the surface, and they come and go with their model.

What this does not prove: that MeshLab and CloudCompare open the meshes; COLMAP's own reader does.
"""

from __future__ import annotations

import os
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import error_of, snapshot
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_refract.files.output import output_folder
from colmap_refract.files.sidecar import ImageInterface, Sidecar, write_sidecar
from colmap_refract.files.surface_files import foreign_file, surface_stems
from colmap_refract.files.surface_picture import color_of
from colmap_refract.files.surfaces import write_surfaces
from colmap_refract.interface import Array, Layers, tangent_basis
from colmap_refract.water_surface import WaterSurface, sampled

NAMES = ["pool.jpg", "dive 1/プール.png", "dive 1/b/ä.png", "flat.jpg"]
WIDTH, HEIGHT = 640, 400
DISTANCE = 1.5
ROTATION = Rotation.from_rotvec([0.2, -0.1, 2.0])
TRANSLATION = np.array([0.3, -0.2, 0.4])
NORMAL = np.array([0.1, -0.2, 0.5]) / np.sqrt(0.3)
AXES = tangent_basis(NORMAL)


def wave(places: Array) -> Array:
    """Height of the surface, positive towards the water."""
    return np.asarray(0.04 * np.sin(3.0 * places[:, 0] + 2.0 * places[:, 1] + 0.3))


def surface(reach: float) -> WaterSurface:
    places = np.array([[-reach, -reach], [reach, reach]])
    return sampled(wave, places, axes=AXES, correlation_length=0.4)


def model_and_sidecar(
    names: list[str], *, reach: float = 3.0, factor: float = 1.0
) -> tuple[pycolmap.Reconstruction, Sidecar]:
    """Images of one pose over one surface, the last of them over a flat one."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="OPENCV", width=WIDTH, height=HEIGHT, params=[600, 620, 310, 205, -0.1, 0.02, 0.001, 0.0]
    )
    model.add_camera_with_trivial_rig(camera)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(ROTATION.as_matrix()), TRANSLATION)
    images = {}
    for image_id, name in enumerate(names, start=1):
        model.add_image_with_trivial_frame(pycolmap.Image(image_id=image_id, camera_id=1, name=name), pose)
        wavy = surface(reach)
        wavy = replace(wavy, heights=factor * wavy.heights)
        images[name] = ImageInterface(
            image_id=image_id,
            normal_in_cam=tuple(NORMAL.tolist()),
            distance=DISTANCE,
            surface=wavy if name != names[-1] else None,
        )
    units = {"distance": "metre"}
    return model, Sidecar(scenario="moving_interface", layers=Layers(), images=images, units=units)


def read_tiff(path: Path) -> NDArray[np.float32]:
    # Not cv2.imread, which reads no other names than ASCII's everywhere.
    return cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)


def read_ply(path: Path) -> tuple[Array, NDArray[np.uint8], Array, NDArray[np.int32]]:
    """Vertices, colours, heights and triangles, record by record as the header says."""
    head, _, data = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    letters = {"double": "d", "float": "f", "uchar": "B"}
    properties = [line.split() for line in lines if line.startswith("property")]
    assert [words[-1] for words in properties[:-1]] == ["x", "y", "z", "red", "green", "blue", "height"]
    assert properties[-1] == ["property", "list", "uchar", "int", "vertex_indices"]
    record = struct.Struct("<" + "".join(letters[words[1]] for words in properties[:-1]))
    end = counts["vertex"] * record.size
    vertices = np.array(list(record.iter_unpack(data[:end])), dtype=float)
    faces = np.array(list(struct.Struct("<B3i").iter_unpack(data[end:])))
    assert len(vertices) == counts["vertex"] and len(faces) == counts["face"] and (faces[:, 0] == 3).all()
    return vertices[:, :3], vertices[:, 3:6].astype(np.uint8), vertices[:, 6], faces[:, 1:]


def in_camera(points: Array) -> Array:
    return np.asarray(points @ ROTATION.as_matrix().T + TRANSLATION)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("model")
    write_surfaces(folder, *model_and_sidecar(NAMES))
    return folder / "surfaces"


def test_files(written: Path) -> None:
    expected = {f"{name}{suffix}" for name in NAMES[:-1] for suffix in (".tif", ".ply")} | {"overview.png"}
    assert {path.relative_to(written).as_posix() for path in written.rglob("*") if path.is_file()} == expected


def test_height_maps_are_what_the_image_sees(written: Path) -> None:
    """Rays through the middles of the map's pixels, followed to a known wave by bisection."""
    for name in NAMES[:-1]:
        heights = read_tiff(written / f"{name}.tif")
        assert heights.dtype == np.float32 and heights.shape == (160, 256)
    assert np.isfinite(heights).all()
    camera = model_and_sidecar(NAMES)[0].camera(1)
    rng = np.random.default_rng(0)
    for i, j in zip(rng.integers(0, 160, 100), rng.integers(0, 256, 100), strict=True):
        ray = np.append(camera.cam_from_img(np.array([2.5 * (j + 0.5), 2.5 * (i + 0.5)])), 1.0)
        low, high = 1.0, 2.0
        for _ in range(60):
            middle = (low + high) / 2
            place = middle * DISTANCE * ray / (ray @ NORMAL)
            beyond = place @ NORMAL - DISTANCE > wave(place[None] @ AXES)[0]
            low, high = (low, middle) if beyond else (middle, high)
            if middle == 1.5:
                low = 0.5 if beyond else low
        place = high * DISTANCE * ray / (ray @ NORMAL)
        # The nodes leave a ten-thousandth of the wave's height open; a sign or a shift by a pixel would be far more.
        assert heights[i, j] == pytest.approx(wave(place[None] @ AXES)[0], abs=1e-5)


def test_height_maps_end_where_the_nodes_do(tmp_path: Path) -> None:
    model, sidecar = model_and_sidecar(["a.png", "flat.png"], reach=0.05)
    write_surfaces(tmp_path, model, sidecar)
    heights = read_tiff(tmp_path / "surfaces" / "a.png.tif")
    wavy = sidecar.images["a.png"].surface
    assert wavy is not None
    columns, rows = np.meshgrid(np.arange(256), np.arange(160))
    ray = model.camera(1).cam_ray_from_img(2.5 * (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5))
    # Where rays meet the plane; they meet the surface no more than its height of 0.04 beside it.
    places = (DISTANCE / (ray @ NORMAL))[:, None] * ray @ AXES
    beyond = np.maximum(places - [wavy.x[-1], wavy.y[-1]], [wavy.x[0], wavy.y[0]] - places).max(axis=1)
    inside, outside = (beyond < -0.05).reshape(160, 256), (beyond > 0.05).reshape(160, 256)
    assert inside.mean() > 0.05 and outside.mean() > 0.2
    assert np.isfinite(heights[inside]).all() and np.isnan(heights[outside]).all()
    vertices, _, _, faces = read_ply(tmp_path / "surfaces" / "a.png.ply")
    assert len(vertices) < 0.9 * 128 * 80 and faces.max() < len(vertices) and len(faces) > len(vertices)
    edges = vertices[faces] - vertices[faces[:, [1, 2, 0]]]
    assert np.linalg.norm(edges, axis=2).max() < 0.1, "no triangle reaches across what is not seen"


def test_small_images_are_not_blown_up(tmp_path: Path) -> None:
    model, sidecar = model_and_sidecar(["a.png", "flat.png"])
    model.camera(1).rescale(0.2)
    write_surfaces(tmp_path, model, sidecar)
    assert read_tiff(tmp_path / "surfaces" / "a.png.tif").shape == (80, 128)


def test_meshes_are_the_surface_in_the_world(written: Path) -> None:
    vertices, colors, heights, faces = read_ply(written / f"{NAMES[1]}.ply")
    assert len(vertices) == 128 * 80 and len(faces) == 2 * 127 * 79
    points = in_camera(vertices)
    expected = wave(points @ AXES)
    assert points @ NORMAL - DISTANCE == pytest.approx(expected, abs=1e-5)
    assert heights == pytest.approx(expected, abs=1e-5)
    assert np.ptp(heights) > 0.07
    # Every vertex but for those of the corners' far sides is in three triangles or more, and every one in some.
    assert np.bincount(faces.ravel(), minlength=len(vertices)).min() >= 1
    a, b, c = (points[faces[:, k]] for k in range(3))
    outwards = np.cross(b - a, c - a)
    assert (np.einsum("ni,ni->n", outwards, a) < 0).all(), "counter-clockwise as seen from the camera"
    # Together they cover what the rays do: no gaps and no overlap. A curved surface is a little larger.
    flat = 0.5 * (outwards @ NORMAL).sum()
    corner = points.reshape(80, 128, 3)
    rim = np.concatenate([corner[0], corner[1:, -1], corner[-1, -2::-1], corner[-2:0:-1, 0]]) @ AXES
    x, y = rim.T
    area = 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
    assert abs(flat) == pytest.approx(abs(area), rel=1e-9)
    # Red is towards the camera.
    assert (colors[heights < -0.03, 0] > colors[heights < -0.03, 2]).all() and (heights < -0.03).any()
    assert (colors[heights > 0.03, 2] > colors[heights > 0.03, 0]).all() and (heights > 0.03).any()


def test_colmap_reads_the_vertices(written: Path, tmp_path: Path) -> None:
    path = written / f"{NAMES[0]}.ply"
    cloud = pycolmap.Reconstruction()
    cloud.import_PLY(path)
    vertices, colors, *_ = read_ply(path)
    read = np.array([cloud.point3D(point3D_id).xyz for point3D_id in sorted(cloud.point3D_ids())])
    assert read == pytest.approx(vertices, abs=1e-6)
    assert (cloud.point3D(1).color == colors[0]).all()


def test_colors_are_the_same_in_all_files(tmp_path: Path) -> None:
    """A surface of half the height is paler."""
    model, sidecar = model_and_sidecar(["a.png", "b.png", "flat.png"])
    half = model_and_sidecar(["a.png", "b.png", "flat.png"], factor=0.5)[1]
    write_surfaces(tmp_path, model, replace(sidecar, images={**sidecar.images, "b.png": half.images["b.png"]}))
    _, high, height_a, _ = read_ply(tmp_path / "surfaces" / "a.png.ply")
    _, low, height_b, _ = read_ply(tmp_path / "surfaces" / "b.png.ply")
    together = np.argsort(np.concatenate([height_a, height_b]))
    blue_less_red = np.concatenate([high, low]).astype(int) @ [-1, 0, 1]
    # Towards its ends the scale grows darker; that far it goes from red to blue, but for the rounding of channels.
    middle = np.abs(np.concatenate([height_a, height_b])[together]) < 0.019
    shown = blue_less_red[together][middle]
    assert (np.maximum.accumulate(shown) - shown).max() <= 2 and np.ptp(shown) > 200
    assert middle.sum() > 1000


def test_color_scale() -> None:
    colors = color_of(np.array([-9.0, -1.0, -0.2, 0.0, 0.2, 1.0, 9.0, np.nan]), 1.0).astype(int)
    assert (colors[0] == colors[1]).all() and (colors[-2] == colors[-3]).all()
    assert np.ptp(colors[3]) == 0 and colors[3].min() > 240, "white"
    assert np.ptp(colors[-1]) == 0 and colors[-1].max() < 200, "grey"
    assert colors[2, 0] > colors[2, 2] and colors[4, 0] < colors[4, 2]


@pytest.mark.parametrize("count", [2, 3, 40])
def test_overview(tmp_path: Path, count: int) -> None:
    names = [f"{'folder/' * (k % 3)}{k}" for k in range(count)]
    model, sidecar = model_and_sidecar(names)
    model.camera(1).rescale(0.1)
    write_surfaces(tmp_path, model, sidecar)
    page = cv2.imread(str(tmp_path / "surfaces" / "overview.png"))
    assert page is not None and 300 < page.shape[0] < 3000 and 500 < page.shape[1] < 3000
    colored = (np.ptp(page, axis=2) > 60).mean()
    assert 0.02 < colored < 0.9


def test_without_surfaces_there_is_nothing(tmp_path: Path) -> None:
    model, sidecar = model_and_sidecar(["flat.png"])
    write_surfaces(tmp_path, model, sidecar)
    assert not list(tmp_path.iterdir())


def test_surface_without_waves(tmp_path: Path) -> None:
    write_surfaces(tmp_path, *model_and_sidecar(["a.png", "flat.png"], factor=0.0))
    assert np.abs(read_tiff(tmp_path / "surfaces" / "a.png.tif")).max() < 1e-15


STRANGE = [
    "../a.png",
    "/b.png",
    "c//d.png",
    "./e.png",
    "x/../f.png",
    "g.tif/h.png",
    "g",
    "overview.png/i.png",
    "\udcff",
]


def test_names_that_are_no_paths_stay_in_the_folder(tmp_path: Path) -> None:
    """Nothing is written outside of the folder or over something else, and all are known again as our own."""
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    names = [*STRANGE, "flat.png"]
    stems = surface_stems(names)
    assert len(set(stems.values())) == len(names)
    assert {name for name, stem in stems.items() if name == stem} == {"g", "\udcff", "flat.png"}
    model, sidecar = model_and_sidecar([name for name in names if name != "\udcff"])
    write_surfaces(folder, model, sidecar)
    write_sidecar(sidecar, folder / "refraction.json")
    files = snapshot(tmp_path)
    assert len(files) == 2 * (len(STRANGE) - 1) + 2 and all(name.startswith("a/b/") for name in files)
    assert foreign_file(folder) is None
    assert surface_stems(["\ud800"]) == {"\ud800": "%ED%A0%80"}, "half a pair has no file name"


def output(path: Path, *, flat: bool = False) -> None:
    model, sidecar = model_and_sidecar(["flat.png"] if flat else ["dive 1/a.png", "flat.png"])
    with output_folder(path, input_path=None, overwrite=True) as folder:
        (folder / "cameras.bin").write_bytes(b"new")
        write_sidecar(sidecar, folder / "refraction.json")
        write_surfaces(folder, model, sidecar)


def test_surfaces_come_and_go_with_their_model(tmp_path: Path) -> None:
    path = tmp_path / "model"
    path.mkdir()
    (path / "notes.txt").write_text("mine")
    output(path)
    wavy = {"surfaces/dive 1/a.png.tif", "surfaces/dive 1/a.png.ply", "surfaces/overview.png"}
    assert snapshot(path).keys() == {"cameras.bin", "refraction.json", "notes.txt", *wavy}
    (path / "surfaces" / ".DS_Store").write_bytes(b"a file manager's")
    output(path)
    assert snapshot(path).keys() == {"cameras.bin", "refraction.json", "notes.txt", *wavy}
    output(path, flat=True)
    assert snapshot(path).keys() == {"cameras.bin", "refraction.json", "notes.txt"}
    assert not (path / "surfaces").exists()


@pytest.mark.parametrize("foreign", ["surfaces/mine.tif", "surfaces/dive 1/b/mine.txt"])
def test_what_others_put_among_them_is_not_lost(tmp_path: Path, foreign: str) -> None:
    output(tmp_path)
    (tmp_path / foreign).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / foreign).write_text("mine")
    before = snapshot(tmp_path)
    for flat in (False, True):
        message = error_of(lambda flat=flat: output(tmp_path, flat=flat))  # type: ignore[misc]
        assert foreign in message and "was not written by an earlier run" in message
        assert snapshot(tmp_path) == before
    (tmp_path / "refraction.json").unlink()
    assert "was not written by an earlier run" in error_of(lambda: output(tmp_path))


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_a_link_in_their_place_is_not_followed(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    path = tmp_path / "model"
    path.mkdir()
    (path / "surfaces").symlink_to(elsewhere, target_is_directory=True)
    assert "surfaces was not written" in error_of(lambda: output(path))
    assert (path / "surfaces").is_symlink() and not list(elsewhere.iterdir())
