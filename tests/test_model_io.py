"""Models survive reading and writing; damaged ones, and disks that are full, give one clear line and do no harm."""

from __future__ import annotations

import errno
import re
import shutil
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from conftest import error_of, snapshot

from colmap_refract.errors import RefractError
from colmap_refract.files.model_io import copy_model, read_model, write_model
from colmap_refract.files.output import output_folder
from colmap_refract.files.quiet import quiet_pycolmap

THREE = ("cameras", "images", "points3D")
FIVE = (*THREE, "rigs", "frames")


def synthesize() -> pycolmap.Reconstruction:
    """Two rigs of two cameras, three frames each, ten keypoints without a point in every image."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 2
    options.num_cameras_per_rig = 2
    options.num_frames_per_rig = 3
    options.num_points3D = 30
    return pycolmap.synthesize_dataset(options)


@pytest.fixture(scope="module")
def binary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("binary")
    synthesize().write_binary(folder)
    return folder


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory, binary: Path) -> Path:
    folder = tmp_path_factory.mktemp("text")
    pycolmap.Reconstruction(binary).write_text(folder)
    return folder


@pytest.fixture
def model(tmp_path: Path, binary: Path) -> Path:
    """A copy of the binary model, to be damaged."""
    return Path(shutil.copytree(binary, tmp_path / "model"))


@pytest.fixture
def text_model(tmp_path: Path, text: Path) -> Path:
    return Path(shutil.copytree(text, tmp_path / "text_model"))


def patch(file: Path, at: int, data: bytes) -> None:
    content = bytearray(file.read_bytes())
    content[at : at + len(data)] = data
    file.write_bytes(content)


def assert_same(a: pycolmap.Reconstruction, b: pycolmap.Reconstruction) -> None:
    assert set(a.cameras) == set(b.cameras) and set(a.images) == set(b.images) and set(a.points3D) == set(b.points3D)
    for i, camera in a.cameras.items():
        assert camera.model == b.cameras[i].model and np.array_equal(camera.params, b.cameras[i].params)
    for i, image in a.images.items():
        other = b.images[i]
        assert image.name == other.name and image.camera_id == other.camera_id
        assert np.abs(image.cam_from_world().matrix() - other.cam_from_world().matrix()).max() < 1e-12
        assert [p.point3D_id for p in image.points2D] == [p.point3D_id for p in other.points2D]
        assert np.array_equal([p.xy for p in image.points2D], [p.xy for p in other.points2D])
    for i, point in a.points3D.items():
        assert np.array_equal(point.xyz, b.points3D[i].xyz) and point.track.length() == b.points3D[i].track.length()


def test_reads_binary_and_text_alike(binary: Path, text: Path) -> None:
    reconstruction = read_model(str(binary))
    assert reconstruction.num_reg_images() == 12 and reconstruction.num_points3D() == 30
    assert_same(reconstruction, pycolmap.Reconstruction(binary))
    assert_same(reconstruction, read_model(text))


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_reads_colmap_3(tmp_path: Path, binary: Path, text: Path, suffix: str) -> None:
    for name in THREE:
        shutil.copy((binary if suffix == ".bin" else text) / (name + suffix), tmp_path)
    reconstruction = read_model(tmp_path)
    assert reconstruction.num_rigs() == 4 and reconstruction.num_frames() == 12
    expected = pycolmap.Reconstruction(binary)
    for i, image in reconstruction.images.items():
        assert np.allclose(image.cam_from_world().matrix(), expected.images[i].cam_from_world().matrix(), atol=1e-12)


def test_prefers_binary(model: Path) -> None:
    for name in THREE:
        (model / f"{name}.txt").write_text("not a model\n")
    assert read_model(model).num_reg_images() == 12


def test_reading_alters_nothing(model: Path) -> None:
    before = snapshot(model)
    read_model(model)
    assert snapshot(model) == before


def test_names_with_spaces_survive_in_text(tmp_path: Path) -> None:
    # pycolmap cuts them at the first space.
    reconstruction = synthesize()
    names = {1: "dive 1/left cam.png", 2: "dive 1/プール 2.png"}
    for i, name in names.items():
        reconstruction.images[i].name = name
    reconstruction.write_text(tmp_path)
    read = read_model(tmp_path)
    assert {i: read.images[i].name for i in names} == names


def test_path_with_any_characters(tmp_path: Path, binary: Path) -> None:
    folder = Path(shutil.copytree(binary, tmp_path / "プール é 1"))
    assert read_model(folder).num_reg_images() == 12


def test_says_what_is_missing(tmp_path: Path, model: Path) -> None:
    assert "does not exist" in error_of(lambda: read_model(tmp_path / "nowhere"))
    assert "is a file" in error_of(lambda: read_model(model / "cameras.bin"))
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "holds no COLMAP model" in error_of(lambda: read_model(empty))
    (model / "points3D.bin").unlink()
    message = error_of(lambda: read_model(model))
    assert "only cameras.bin, images.bin" in message and "add the missing files" in message


@pytest.mark.parametrize("inside", ["0", "sparse/0", "sparse"])
def test_hints_at_a_model_inside(tmp_path: Path, binary: Path, inside: str) -> None:
    shutil.copytree(binary, tmp_path / "project" / inside)
    message = error_of(lambda: read_model(tmp_path / "project"))
    assert message.endswith(f"did you mean {tmp_path / 'project' / inside}?")


def test_hints_at_a_refined_model_first(tmp_path: Path, binary: Path) -> None:
    for inside in ("sparse", "sparse_refractive"):
        shutil.copytree(binary, tmp_path / inside / "0")
    (tmp_path / "sparse_refractive" / "0" / "refraction.json").write_text("{}")
    message = error_of(lambda: read_model(tmp_path))
    refined, plain = (tmp_path / inside / "0" for inside in ("sparse_refractive", "sparse"))
    assert message.endswith(f"did you mean {refined} (refined) or {plain}?")


@pytest.mark.parametrize("name", ["rigs", "frames"])
def test_rigs_without_frames(model: Path, name: str) -> None:
    (model / f"{name}.bin").unlink()
    assert f"{name}.bin is missing" in error_of(lambda: read_model(model))


def test_unreadable_file(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path) -> bytes:
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    message = error_of(lambda: read_model(model))
    assert message == f"cannot read {model / 'cameras.bin'}: Permission denied"


@pytest.mark.parametrize("name", FIVE)
def test_every_truncation_of_a_binary_file_is_an_error(model: Path, name: str) -> None:
    file = model / f"{name}.bin"
    data = file.read_bytes()
    step = max(1, len(data) // 150)
    for size in [*range(0, len(data), step), len(data) - 1]:
        file.write_bytes(data[:size])
        assert f"{name}.bin" in error_of(lambda: read_model(model)), size
    file.write_bytes(data + b"\0")
    assert f"{name}.bin: 1 bytes follow" in error_of(lambda: read_model(model))


@pytest.mark.parametrize("name", FIVE)
@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_altered_bytes_give_a_model_or_an_error(
    tmp_path: Path, binary: Path, text: Path, name: str, suffix: str
) -> None:
    """That nothing else happens is all this shows: most bytes are of coordinates, and those cannot be checked."""
    folder = Path(shutil.copytree(binary if suffix == ".bin" else text, tmp_path / "altered"))
    file = folder / (name + suffix)
    data = file.read_bytes()
    rng = np.random.default_rng(0)
    read = 0
    for _ in range(150):
        content = bytearray(data)
        at = int(rng.integers(min(len(data), rng.choice([40, 400, 10**9]))))
        match rng.integers(4):
            case 0:
                content[at] ^= 1 << int(rng.integers(8))
            case 1:
                content[at] = int(rng.integers(256))
            case 2:
                content[at : at + 8] = rng.choice([b"\xff" * 8, b"\x01" * 8, b"        "])
            case _:
                del content[at:]
        file.write_bytes(content)
        try:
            reconstruction = read_model(folder)
        except RefractError:
            continue
        read += 1
        assert reconstruction.is_valid()
        assert all(np.isfinite(p.xyz).all() for p in reconstruction.points3D.values())
    assert read < 150


NAN = struct.pack("<d", np.nan)
INFINITE = struct.pack("<d", np.inf)
HUGE = struct.pack("<Q", 2**62)
FRAME, IMAGE, POINT = 8 + 8, 8, 8  # where the pose, the first image and the first point begin


@pytest.mark.parametrize(
    ("name", "at", "data", "expected"),
    [
        ("cameras", 0, HUGE, "ends inside entry 5"),
        ("cameras", 0, bytes(8), "bytes follow"),
        ("cameras", 12, struct.pack("<i", 77), "has the model 77, which pycolmap"),
        ("cameras", 16, bytes(8), "impossible image size"),
        ("cameras", 32, NAN, "camera 1 has a parameter that is not finite"),
        ("cameras", 32, struct.pack("<d", -1.0), "focal length that is not positive"),
        ("cameras", 8, struct.pack("<I", 2), "camera id occurs twice"),
        ("cameras", 8, struct.pack("<I", 9), "has camera 1, which is not in cameras.bin"),
        ("frames", FRAME, INFINITE, "frames.bin or rigs.bin: the pose of image"),
        ("frames", FRAME, bytes(32), "not a unit quaternion"),
        ("frames", 8 + 4, struct.pack("<I", 99), "rigs.bin or frames.bin is damaged or of another model"),
        ("frames", 8 + 64, b"\xff" * 4, "ends inside entry 1"),
        ("rigs", 12, b"\xff" * 4, "ends inside entry 1"),
        ("rigs", 8 + 24 + 1, NAN, "frames.bin or rigs.bin: the pose of image"),
        ("images", IMAGE, struct.pack("<I", 2), "image id occurs twice"),
        ("images", IMAGE + 60, struct.pack("<I", 9), "has camera 9, which is not in cameras.bin"),
        ("images", IMAGE + 64, b"\xe4", "name of image 1 is not UTF-8"),
        ("points3D", POINT, struct.pack("<Q", 2), "point id is invalid or occurs twice"),
        ("points3D", POINT + 8, NAN, "point 1 is not finite"),
        ("points3D", POINT + 43, HUGE, "ends inside entry 1 of 30"),
        ("points3D", POINT + 51, struct.pack("<I", 99), "of image 99, an image that does not exist"),
        ("points3D", POINT + 55, struct.pack("<I", 9999), "at keypoint 9999 of image 1, which does not exist"),
    ],
)
def test_damage_is_named(model: Path, name: str, at: int, data: bytes, expected: str) -> None:
    patch(model / f"{name}.bin", at, data)
    assert expected in error_of(lambda: read_model(model))


def keypoint_at(reconstruction: pycolmap.Reconstruction, point2D_idx: int) -> int:
    """Where a keypoint of the first image is in images.bin."""
    return IMAGE + 64 + len(reconstruction.images[1].name) + 1 + 8 + 24 * point2D_idx


def test_keypoints_and_tracks_must_agree(model: Path) -> None:
    reconstruction = pycolmap.Reconstruction(model)
    file = model / "images.bin"
    has_point = [p.has_point3D() for p in reconstruction.images[1].points2D]
    free, used = has_point.index(False), has_point.index(True)
    clean = file.read_bytes()

    for point3D_id in (999999, 7):
        patch(file, keypoint_at(reconstruction, free) + 16, struct.pack("<Q", point3D_id))
        assert f"belongs to point {point3D_id}, whose track in points3D.bin" in error_of(lambda: read_model(model))
    file.write_bytes(clean)
    patch(file, keypoint_at(reconstruction, used) + 16, b"\xff" * 8)
    assert "belongs to another point or none" in error_of(lambda: read_model(model))
    file.write_bytes(clean)
    patch(file, keypoint_at(reconstruction, used), NAN)
    assert f"keypoint {used} of image" in error_of(lambda: read_model(model))
    file.write_bytes(clean)
    patch(file, keypoint_at(reconstruction, free), NAN)
    assert read_model(model).num_reg_images() == 12, "a keypoint without a point is of no consequence"


def test_images_of_one_name(model: Path) -> None:
    reconstruction = pycolmap.Reconstruction(model)
    reconstruction.images[2].name = reconstruction.images[1].name
    reconstruction.write(model)
    assert "are both called" in error_of(lambda: read_model(model))


def test_nothing_registered_and_no_points(tmp_path: Path, model: Path) -> None:
    reconstruction = pycolmap.Reconstruction(model)
    reconstruction.delete_all_points2D_and_points3D()
    reconstruction.write(model)
    assert "no points" in error_of(lambda: read_model(model))
    for frame_id in reconstruction.reg_frame_ids():
        reconstruction.deregister_frame(frame_id)
    reconstruction.write(model)
    assert "no image is registered" in error_of(lambda: read_model(model))


def test_frame_with_an_image_that_is_gone(model: Path) -> None:
    reconstruction = pycolmap.Reconstruction(model)
    reconstruction.deregister_frame(6)
    frames = (model / "frames.bin").read_bytes()
    reconstruction.write(model)
    (model / "frames.bin").write_bytes(frames)
    assert re.search("image 1[12] in frame 6 does not exist", error_of(lambda: read_model(model)))


@pytest.mark.parametrize("name", THREE)
def test_truncated_text_is_an_error(text_model: Path, name: str) -> None:
    file = text_model / f"{name}.txt"
    data = file.read_bytes()
    # Behind the last space but one only digits can be lost, which nobody can see.
    whole = data.rstrip().rindex(b" ")
    for size in range(0, whole, max(1, whole // 100)):
        file.write_bytes(data[:size])
        message = error_of(lambda: read_model(text_model))
        assert f"{name}.txt" in message or "images.txt" in message, size


@pytest.mark.parametrize("value", ["nan", "inf", "1e400", "12abc"])
def test_numbers_in_text(text_model: Path, value: str) -> None:
    # pycolmap drops the keypoints from there on without a word.
    lines = (text_model / "images.txt").read_text().split("\n")
    lines[5] = value + lines[5][lines[5].index(" ") :]
    (text_model / "images.txt").write_text("\n".join(lines))
    assert "images.txt: line 6 has" in error_of(lambda: read_model(text_model))


def test_text_that_means_something_else_to_pycolmap(text_model: Path) -> None:
    # A number for Python, not for C++, which drops the keypoints from there on.
    lines = (text_model / "images.txt").read_text().split("\n")
    lines[5] += " 1_0 2 -1"
    (text_model / "images.txt").write_text("\n".join(lines))
    assert "reads only a part" in error_of(lambda: read_model(text_model))


def test_colmap_logs_nothing(model: Path, capfd: pytest.CaptureFixture[str]) -> None:
    level = pycolmap.logging.minloglevel
    test_frame_with_an_image_that_is_gone(model)
    with quiet_pycolmap():
        pycolmap.logging.error("unheard")
    pycolmap.logging.error("heard")
    assert pycolmap.logging.minloglevel == level
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and err.endswith("heard\n") and "unheard" not in err


def test_copy_shares_nothing(binary: Path) -> None:
    reconstruction = read_model(binary)
    copy = copy_model(reconstruction)
    assert_same(copy, reconstruction)
    image = copy.images[1]
    copy.cameras[image.camera_id].params = [1.0, 2.0, 3.0, 0.0]
    copy.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d()
    copy.points3D[1].xyz = np.zeros(3)
    image.points2D[0].xy = np.zeros(2)
    image.name = "other"
    copy.delete_point3D(2)
    assert image.camera is not None and list(image.camera.params) == [1, 2, 3, 0]
    assert (image.cam_from_world().translation == 0).all()
    assert_same(reconstruction, read_model(binary))


@pytest.mark.parametrize("form", ["binary", "text"])
def test_write_round_trip(tmp_path: Path, binary: Path, text: Path, form: str) -> None:
    reconstruction = read_model(binary if form == "binary" else text)
    write_model(reconstruction, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(f"{name}.bin" for name in FIVE)
    if form == "binary":
        assert snapshot(tmp_path) == snapshot(binary)
    assert_same(read_model(tmp_path), reconstruction)


def test_written_model_has_only_registered_images(tmp_path: Path, binary: Path) -> None:
    reconstruction = read_model(binary)
    reconstruction.deregister_frame(1)
    write_model(reconstruction, tmp_path)
    assert read_model(tmp_path).num_reg_images() == 10
    assert copy_model(reconstruction).num_images() == 12


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """The nearest to a full disk that needs no privileges."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [0, 100, 3000, 10000])
def test_full_disk_is_found_out(tmp_path: Path, binary: Path, size: int) -> None:
    # pycolmap itself says nothing.
    reconstruction = read_model(binary)
    output = tmp_path / "output"

    def write() -> None:
        with file_size_limit(size), output_folder(output, input_path=binary, overwrite=False) as folder:
            write_model(reconstruction, folder)

    assert "is the disk full?" in error_of(write)
    assert not list(tmp_path.iterdir())


def test_write_to_nowhere(tmp_path: Path, binary: Path) -> None:
    assert "cannot write" in error_of(lambda: write_model(read_model(binary), tmp_path / "none"))
