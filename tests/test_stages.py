"""The parts of the pipeline: its record, calibrations, options, COLMAP's process, and databases made elsewhere.

No pixels here: databases are written from simulated captures, and the image files are blank. What features and matches
of real pictures do is not shown.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import signal
import sqlite3
from contextlib import closing
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import Scenes

from colmap_refract.errors import RefractError
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.reconstructor import colmap_options, colmap_process, features, flow, matches, models
from colmap_refract.reconstructor.calibration import assign_cameras, fitted_camera
from colmap_refract.reconstructor.colmap_process import run_colmap
from colmap_refract.reconstructor.contents import fingerprint, read_contents
from colmap_refract.reconstructor.options import MapperOptions, ReconstructorOptions, TwoViewGeometryOptions
from colmap_refract.reconstructor.pipeline import Reconstructed, reconstruct
from colmap_refract.reconstructor.record import RECORD_NAME, Photograph, Record, differences, in_words
from colmap_refract.reconstructor.watcher import Watcher
from colmap_refract.reconstructor.workspace import Workspace, replace_folder
from colmap_refract.reconstructor.workspace_database import put_database
from colmap_refract.simulation import Capture

SIZE = (400, 300)
TABLES = ("cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries")


class Told(Watcher):
    """Keeps what it is told; raises what it is asked to at the first word of a stage."""

    def __init__(self, interrupt_at: str = "") -> None:
        self.lines: list[str] = []
        self.stages: list[str] = []
        self._interrupt_at = interrupt_at

    def progress(self, stage: str, done: int, total: int | None, unit: str) -> None:
        self.stages.append(stage)
        if stage == self._interrupt_at:
            raise KeyboardInterrupt

    def solving(self, stage: str, progress: object) -> None:
        if self._interrupt_at == "Refining":
            raise KeyboardInterrupt

    def report(self, label: str, text: str) -> None:
        self.lines.append(f"{label}: {text}")

    def warn(self, line: str) -> None:
        self.lines.append(f"WARNING: {line}")

    def said(self, label: str) -> str:
        return next(line for line in self.lines if line.startswith(label))


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What COLMAP is asked to do."""
    made: list[str] = []

    def counted(function: str, *arguments: Any, **more: Any) -> None:
        made.append(function)
        run_colmap(function, *arguments, **more)

    for module in (features, matches, models):
        monkeypatch.setattr(module, "run_colmap", counted)
    return made


@pytest.fixture(scope="session")
def capture(scenes: Scenes) -> Capture:
    size = {"width": SIZE[0], "height": SIZE[1], "focal_length": 300.0}
    return scenes("static_interface", num_images=6, num_points=250, camera_model="PINHOLE", **size).capture


def write_database(path: Path, capture: Capture) -> None:
    """Keypoints, and verified matches of all pairs of images, as COLMAP 4 keeps them."""
    model = capture.reconstruction
    with pycolmap.Database.open(path) as database:
        for camera in model.cameras.values():
            camera.has_prior_focal_length = True
            database.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            database.write_rig(rig, use_rig_id=True)
        images = [image for _, image in sorted(model.images.items())]
        for image in images:
            frame = pycolmap.Frame(frame_id=image.frame_id, rig_id=model.frames[image.frame_id].rig_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(image.image_id, np.array([p.xy for p in image.points2D], dtype=np.float32))
        for a, b in combinations(images, 2):
            seen = {p.point3D_id: k for k, p in enumerate(a.points2D) if p.has_point3D()}
            pairs = [(seen[p.point3D_id], k) for k, p in enumerate(b.points2D) if p.point3D_id in seen]
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED.value
            geometry.inlier_matches = np.array(pairs, dtype=np.uint32)
            database.write_matches(a.image_id, b.image_id, geometry.inlier_matches)
            database.write_two_view_geometry(a.image_id, b.image_id, geometry)


def write_blank(path: Path, size: tuple[int, int] = SIZE, value: int = 128) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((size[1], size[0]), value, np.uint8))


@pytest.fixture(scope="session")
def made_elsewhere(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with a database that COLMAP might have made, and blank images of its names."""
    workspace = tmp_path_factory.mktemp("elsewhere")
    for image in capture.reconstruction.images.values():
        write_blank(workspace / "images" / image.name)
    write_database(workspace / "database.db", capture)
    return workspace


@pytest.fixture
def workspace(made_elsewhere: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made_elsewhere, tmp_path / "workspace"))


@pytest.fixture
def camera_path(capture: Capture, tmp_path: Path) -> Path:
    path = tmp_path / "calibration" / "cameras.txt"
    path.parent.mkdir()
    (camera,) = capture.reconstruction.cameras.values()
    params = " ".join(map(repr, map(float, camera.params)))
    path.write_text(f"1 PINHOLE {camera.width} {camera.height} {params}\n")
    return path


def run(
    workspace: Path, watcher: Watcher | None = None, *, camera_path: Path | None = None, **options: Any
) -> Reconstructed:
    refiner = RefinerOptions(scenario=options.pop("scenario", "static_interface"), num_threads=1)
    return reconstruct(workspace, ReconstructorOptions(**options), refiner, camera_path=camera_path, watcher=watcher)


def tables(path: Path) -> dict[str, list[Any]]:
    with closing(sqlite3.connect(path)) as database:
        return {name: database.execute(f"SELECT * FROM {name} ORDER BY 1").fetchall() for name in TABLES}


def files(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Time of change and contents of every file."""
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): (p.stat().st_mtime_ns, p.read_bytes()) for p in found}


# --- The record ------------------------------------------------------------------------------------------------------


def test_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    record = Record(tmp_path)
    record.database_mark = 7
    record.photographs = {"a b.png": Photograph(bytes=1, mtime_ns=2, width=3, height=4, sha256="5")}
    record.begin("features", {"images": {"a b.png": "5"}, "list": [1, 2.5, None]})
    record.complete("features", "left", {"elsewhere": False})
    record.begin("matches", {})
    again = Record(tmp_path)
    assert (again.database_mark, again.photographs, again.stages) == (7, record.photographs, record.stages)
    assert again.stages["features"].output == "left" and again.stages["matches"].output is None
    assert [path.name for path in tmp_path.iterdir()] == [RECORD_NAME] and not again.lost


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"format": "another", "version": 1}', "\xff"])
def test_damaged_record_is_nothing_known(tmp_path: Path, text: str) -> None:
    (tmp_path / RECORD_NAME).write_text(text, encoding="latin-1")
    record = Record(tmp_path)
    assert RECORD_NAME in record.lost and "\n" not in record.lost
    assert not record.stages and record.database_mark is None


def test_record_survives_a_disk_that_takes_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = Record(tmp_path)
    record.begin("features", {})
    before = (tmp_path / RECORD_NAME).read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RefractError, match="disk is full"):
        record.begin("matches", {})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {RECORD_NAME: before}


@pytest.mark.parametrize(
    ("difference", "words"),
    [
        ("images.a/b.c.png", "the image 'a/b.c.png'"),
        ("SiftExtraction.peak_threshold", "--SiftExtraction.peak_threshold"),
        ("matching.matcher", "--matcher"),
        ("matching.SiftMatching.max_ratio", "--SiftMatching.max_ratio"),
        ("matching.pairing.overlap", "the choice of pairs"),
        ("verification.max_error", "--TwoViewGeometry.max_error"),
        ("verification.random_seed", "--random_seed"),
        ("verification.cameras.1", "the intrinsics"),
        ("options.BundleAdjustment.max_num_iterations", "--BundleAdjustment.max_num_iterations"),
        ("interface_groups.f00_0.png", "the interface groups"),
    ],
)
def test_differences_are_said_as_the_user_knows_them(difference: str, words: str) -> None:
    assert in_words(difference) == words


def test_differences_are_named() -> None:
    before = json.loads(json.dumps({"same": (1, 2), "nested": {"a": 1, "b": 2}, "gone": 0}))
    now = {"same": (1, 2), "nested": {"a": 1, "b": 3}, "new": None, "other": 1}
    assert differences(before, now) == ["gone", "nested.b", "other"]
    assert differences(before, before) == []


# --- Calibrations ----------------------------------------------------------------------------------------------------

MODELS = {
    "PINHOLE": [310.0, 312.0, 203.0, 149.0],
    "OPENCV": [310.0, 312.0, 203.0, 149.0, -0.1, 0.02, 0.001, -0.002],
    "SIMPLE_RADIAL": [310.0, 203.0, 149.0, -0.05],
    "OPENCV_FISHEYE": [310.0, 312.0, 203.0, 149.0, 0.02, -0.01, 0.003, 0.0],
}


def camera_of(model: str = "PINHOLE", size: tuple[int, int] = SIZE, camera_id: int = 1) -> pycolmap.Camera:
    scale = size[0] / SIZE[0]
    camera = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=MODELS[model], camera_id=camera_id)
    if scale != 1:
        camera.rescale(*size)
    return camera


@pytest.mark.parametrize("model", MODELS)
def test_rescaled_camera_sees_the_same_scaled(model: str) -> None:
    camera = camera_of(model)
    fitted, remark = fitted_camera(camera, (1000, 750))
    points = np.array([[0.1, -0.2, 1.0], [0.4, 0.3, 1.2], [-0.3, 0.1, 0.8]])
    # Exactly: pixels are lengths on the sensor, whose corner is (0, 0) at every size.
    np.testing.assert_allclose(fitted.img_from_cam(points), 2.5 * np.array(camera.img_from_cam(points)), rtol=1e-12)
    assert "400 x 300" in remark and "1000 x 750" in remark
    assert fitted.has_prior_focal_length and (fitted.width, fitted.height) == (1000, 750)
    assert (camera.width, camera.height) == SIZE  # what was given is left as it was


@pytest.mark.parametrize("size", [SIZE, (800, 600), (801, 600), (800, 602)])
def test_shapes_that_fit(size: tuple[int, int]) -> None:
    fitted, remark = fitted_camera(camera_of(), size)
    assert (fitted.width, fitted.height) == size and bool(remark) == (size != SIZE)


@pytest.mark.parametrize("size", [(800, 610), (640, 360), (300, 400), (790, 600)])
def test_shapes_that_do_not_fit(size: tuple[int, int]) -> None:
    with pytest.raises(RefractError, match=f"{size[0]} x {size[1]}.*400 x 300") as caught:
        fitted_camera(camera_of(), size)
    assert ("turn the images" in str(caught.value)) == (size == (300, 400))


def photographs_of(sizes: dict[str, tuple[int, int]]) -> dict[str, Photograph]:
    return {
        name: Photograph(bytes=1, mtime_ns=1, width=width, height=height, sha256=name)
        for name, (width, height) in sizes.items()
    }


def test_several_cameras_are_told_apart_by_image_size() -> None:
    photographs = photographs_of({"a.png": SIZE, "b.png": (640, 480), "c.png": SIZE})
    cameras = {4: camera_of(size=(640, 480), camera_id=4), 9: camera_of(camera_id=9)}
    assignment = assign_cameras(photographs, Path("images"), cameras, Path("cameras.txt"))
    assert {name: camera.width for name, camera in assignment.camera_of.items()} == {
        "a.png": 400,
        "b.png": 640,
        "c.png": 400,
    }
    with pytest.raises(RefractError, match="'d.png' has 500 x 300.*cameras.txt"):
        assign_cameras(
            {**photographs, **photographs_of({"d.png": (500, 300)})}, Path("images"), cameras, Path("cameras.txt")
        )


def test_several_cameras_of_one_size_take_a_folder_each() -> None:
    photographs = photographs_of({"left/1.png": SIZE, "left/2.png": SIZE, "right/1.png": (800, 600)})
    cameras = {1: camera_of(camera_id=1), 2: camera_of("OPENCV", camera_id=2)}
    assignment = assign_cameras(photographs, Path("images"), cameras, Path("cameras.txt"))
    models = {name: camera.model.name for name, camera in assignment.camera_of.items()}
    assert models == {"left/1.png": "PINHOLE", "left/2.png": "PINHOLE", "right/1.png": "OPENCV"}
    assert assignment.camera_of["right/1.png"].width == 800 and "rescaled" in assignment.remarks[1]
    with pytest.raises(RefractError, match="cannot be told apart.*folder"):
        assign_cameras(photographs_of({"1.png": SIZE, "2.png": SIZE}), Path("images"), cameras, Path("cameras.txt"))


def test_images_of_two_sizes_need_two_cameras() -> None:
    photographs = photographs_of({"a.png": SIZE, "b.png": (300, 400)})
    for cameras in (None, {1: camera_of()}):
        with pytest.raises(RefractError, match="400 x 300.*300 x 400"):
            assign_cameras(photographs, Path("images"), cameras, Path("cameras.txt"))


# --- Options ---------------------------------------------------------------------------------------------------------


def colmap_objects(options: ReconstructorOptions) -> dict[str, Any]:
    pipeline = colmap_options.mapping_options(options, 1, 0)
    return {
        "extraction": colmap_options.extraction_options(options, 1).todict(),
        "matching": colmap_options.matching_options(options, 1).todict(),
        "pairing": colmap_options.pairing_options(options, 1).todict(),
        "verification": colmap_options.verification_options(options, 0).todict(),
        "mapping": pipeline.todict(),
    }


def flat(nested: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(nested, dict):
        return {prefix: nested}
    return {key: value for name, inner in nested.items() for key, value in flat(inner, f"{prefix}.{name}").items()}


GROUPS = [f.name for f in dataclasses.fields(ReconstructorOptions) if f.name[0].isupper() and f.name != "Flow"]


@pytest.mark.parametrize("group", GROUPS)
def test_every_option_reaches_colmap(group: str) -> None:
    """Each changes exactly one value of pycolmap's objects, and to what was given."""
    matcher: Any = "sequential" if group == "SequentialPairing" else "exhaustive"
    plain = ReconstructorOptions(matcher=matcher)
    before = flat(colmap_objects(plain))
    for field in dataclasses.fields(getattr(plain, group)):
        if field.name == "use_gpu" and not pycolmap.has_cuda:
            continue  # refused
        (known,) = {
            value
            for key, value in before.items()
            if key.split(".")[-1] == field.name.removeprefix("tri_" if group == "Mapper" else "")
            and (".triangulation." in key) == field.name.startswith("tri_")
            and (group != "TwoViewGeometry" or "verification" in key)
            and (group != "Mapper" or "mapping" in key)
        }
        value: Any
        if isinstance(known, bool):
            value = not known
        elif isinstance(known, int):
            value = max(known, 0) + 1
        elif isinstance(known, float):
            value = known * 0.5
        else:
            value = Path("some/tree.bin")
        changed = {field.name: value}
        if field.name.startswith("init_image_id"):
            changed = {"init_image_id1": 3, "init_image_id2": 4}
        options = dataclasses.replace(plain, **{group: dataclasses.replace(getattr(plain, group), **changed)})
        after = flat(colmap_objects(options))
        moved = {key: value for key, value in after.items() if value != before[key]}
        assert len(moved) == len(changed) and set(moved.values()) == set(changed.values()), field.name


def test_intrinsics_are_held() -> None:
    values = flat(colmap_options.mapping_options(ReconstructorOptions(), 1, 0).todict())
    held = [value for key, value in values.items() if "refine_" in key and "sensor" not in key and "max" not in key]
    assert len(held) >= 5 and not any(held)


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        ("SiftExtraction", "max_num_features", -5),
        ("SiftMatching", "max_ratio", -1.0),
        ("SequentialPairing", "overlap", -1),
        ("TwoViewGeometry", "max_error", -2.0),
        ("Mapper", "filter_max_reproj_error", -1.0),
        ("Mapper", "tri_min_angle", -1.0),
    ],
)
def test_values_that_colmap_refuses_are_named(group: str, name: str, value: float) -> None:
    options = ReconstructorOptions(matcher="sequential")
    options = dataclasses.replace(options, **{group: dataclasses.replace(getattr(options, group), **{name: value})})
    with pytest.raises(RefractError, match=name.removeprefix("tri_")):
        colmap_options.check_options(options)


# --- COLMAP's process ------------------------------------------------------------------------------------------------


def process_ids() -> set[int]:
    """Of the children of this process."""
    path = Path(f"/proc/self/task/{os.getpid()}/children")
    return set(map(int, path.read_text().split()))


def test_failure_in_colmap_is_one_line(tmp_path: Path) -> None:
    arguments = {"database_path": tmp_path / "none.db", "image_path": tmp_path, "output_path": tmp_path / "out"}
    with pytest.raises(RefractError, match="COLMAP's mapping failed: .") as caught:
        run_colmap("map", {**arguments, "options": None}, log_path=tmp_path / "log.txt", what="mapping")
    assert "\n" not in str(caught.value) and "Traceback" not in str(caught.value)


@pytest.fixture
def import_again(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Arguments of a job that loads pycolmap, and so lasts for several polls, and changes nothing."""
    monkeypatch.setattr(colmap_process, "_POLL_SECONDS", 0.01)
    groups = [(["frame_0001.jpg"], None, 1)]
    return {"database_path": workspace / "database.db", "image_path": workspace / "images", "groups": groups}


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="children are listed by Linux")
def test_killed_process_is_one_line(import_again: dict[str, Any], tmp_path: Path) -> None:
    """As by a system that is out of memory."""
    before = process_ids()

    def kill() -> None:
        for child in process_ids() - before:
            os.kill(child, signal.SIGKILL)

    with pytest.raises(RefractError, match="SIGKILL.*memory"):
        run_colmap("add_images", import_again, log_path=tmp_path / "log.txt", what="import", poll=kill)


def test_disk_without_room_is_named_whatever_colmap_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A made-up answer of the system; a full disk is not tried."""
    arguments = {"database_path": tmp_path / "none.db", "image_path": tmp_path, "output_path": tmp_path / "out"}
    usage = shutil.disk_usage(tmp_path)
    for free, full in [(1 << 30, False), (4096, True)]:
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: usage._replace(free=free))
        with pytest.raises(RefractError) as caught:
            run_colmap("map", {**arguments, "options": None}, log_path=tmp_path / "log.txt", what="mapping")
        assert ("the disk is full" in str(caught.value)) == full


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="children are listed by Linux")
def test_process_does_not_outlive_an_interrupt(import_again: dict[str, Any], tmp_path: Path) -> None:
    before = process_ids()
    seen: set[int] = set()

    def interrupt() -> None:
        seen.update(process_ids() - before)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_colmap("add_images", import_again, log_path=tmp_path / "log.txt", what="import", poll=interrupt)
    assert seen and process_ids() == before


# --- The workspace ---------------------------------------------------------------------------------------------------


def make_workspace(path: Path) -> Workspace:
    return Workspace(
        path=path,
        database_path=path / "database.db",
        image_path=path / "images",
        record=Record(path),
        watcher=Watcher(),
    )


def test_one_at_a_time_and_what_a_killed_run_left_is_removed(tmp_path: Path) -> None:
    left = tmp_path / "w" / ".colmap_refract-0123"
    left.mkdir(parents=True)
    (left / "database.db").write_bytes(b"half")
    first, second = make_workspace(tmp_path / "w"), make_workspace(tmp_path / "w")
    with first.locked():
        assert not left.exists()
        with pytest.raises(RefractError, match="another reconstruction"), second.locked():
            pass
    with second.locked():
        pass


def test_workspace_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "w").write_text("")
    with pytest.raises(RefractError, match="w is a file; give a folder"), make_workspace(tmp_path / "w").locked():
        pass


def test_what_fails_before_anything_is_done_leaves_nothing(tmp_path: Path) -> None:
    def fail(path: Path, error: BaseException, *, begin: bool = False) -> None:
        workspace = make_workspace(path)
        with pytest.raises(type(error)), workspace.locked():
            workspace.record.photographs = {"a": Photograph(bytes=1, mtime_ns=2, width=3, height=4, sha256="5")}
            workspace.record.write()
            workspace.log_path.touch()
            if begin:
                workspace.record.begin("features", {})
            raise error

    fail(tmp_path / "new" / "w", RefractError(""))
    assert not list(tmp_path.iterdir())
    mine = tmp_path / "w" / "images" / "a.png"
    write_blank(mine)
    fail(tmp_path / "w", RefractError(""))
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [mine]
    fail(tmp_path / "begun", RefractError(""), begin=True)
    fail(tmp_path / "interrupted", KeyboardInterrupt())
    for name in ("begun", "interrupted"):
        assert (tmp_path / name / RECORD_NAME).exists()
        fail(tmp_path / name, RefractError(""))  # of an earlier run
        assert (tmp_path / name / RECORD_NAME).exists()


def test_folder_is_replaced_or_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("new", "target"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text(name)
    rename = os.rename

    def fail_on_new(source: Any, target: Any) -> None:
        if Path(source).name == "new":
            raise OSError(28, "No space left on device")
        rename(source, target)

    monkeypatch.setattr(os, "rename", fail_on_new)
    with pytest.raises(RefractError, match="No space left"):
        replace_folder(tmp_path / "new", tmp_path / "target", tmp_path / "old")
    assert (tmp_path / "target" / "file").read_text() == "target"
    monkeypatch.undo()
    replace_folder(tmp_path / "new", tmp_path / "target", tmp_path / "old")
    assert (tmp_path / "target" / "file").read_text() == "new"


def test_fingerprint_of_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    assert fingerprint(folder) == ""
    (folder / "0").mkdir(parents=True)
    assert fingerprint(folder) == ""
    (folder / "0" / "a").write_text("1")
    first = fingerprint(folder)
    (folder / "0" / "b").write_text("")
    assert fingerprint(folder) not in ("", first)
    (folder / "0" / "b").rename(folder / ".colmap_refract-9")
    assert fingerprint(folder) == first
    (folder / "0" / "a").rename(folder / "0" / "c")
    assert fingerprint(folder) != first


# --- Databases made elsewhere ----------------------------------------------------------------------------------------


def change(path: Path, statement: str) -> None:
    with closing(sqlite3.connect(path)) as database:
        database.execute(statement)
        database.commit()


def test_contents_are_counted_and_change_with_what_they_stand_for(workspace: Path, capture: Capture) -> None:
    path = workspace / "database.db"
    before = {p.name: p.read_bytes() for p in workspace.iterdir() if p.is_file()}
    contents = read_contents(path)
    assert {p.name: p.read_bytes() for p in workspace.iterdir() if p.is_file()} == before
    images = capture.reconstruction.images.values()
    assert contents.num_keypoints == {image.name: image.num_points2D() for image in images}
    assert (contents.num_pairs, contents.num_verified_pairs, contents.mark) == (15, 15, 0)
    change(path, "UPDATE keypoints SET data = zeroblob(length(data)) WHERE image_id = 2")
    moved = read_contents(path)
    assert moved.features != contents.features and moved.matches == contents.matches
    change(path, "DELETE FROM matches WHERE pair_id = (SELECT MIN(pair_id) FROM matches)")
    fewer = read_contents(path)
    assert fewer.features == moved.features and fewer.matches != moved.matches


@pytest.mark.parametrize(("mode", "calibrated"), [("delete", True), ("wal", False)])
def test_database_made_elsewhere_is_used_and_not_altered(
    workspace: Path, calls: list[str], camera_path: Path, capture: Capture, mode: str, calibrated: bool
) -> None:
    with closing(sqlite3.connect(workspace / "database.db")) as database:
        assert database.execute(f"PRAGMA journal_mode = {mode}").fetchone() == (mode,)
    before = (workspace / "database.db").read_bytes()
    watcher = Told()
    with contextlib.chdir(workspace.parent):  # as most users call it: with a relative path
        run(Path(workspace.name), Told(), camera_path=camera_path if calibrated else None, refine=False)
    shutil.rmtree(workspace / "sparse")
    calls.clear()
    result = run(workspace, watcher, camera_path=camera_path if calibrated else None)
    assert calls == ["map"]
    assert (workspace / "database.db").read_bytes() == before
    assert "made elsewhere, used as it is" in watcher.said("Features")
    assert "made elsewhere, used as they are" in watcher.said("Matches")
    assert "6 of 6 images registered" in watcher.said("Model")
    assert result.sidecar is not None and result.sidecar.solver["converged"]
    assert sorted(path.name for path in workspace.iterdir()) == [
        RECORD_NAME,
        "database.db",
        "images",
        "log.txt",
        "sparse",
        "sparse_refractive",
    ]
    # The true plane, in the camera's frame, which no choice of the world's frame changes.
    for image in capture.reconstruction.images.values():
        found = result.sidecar.images[image.name]
        assert found.normal_in_cam is not None and found.normal_std_deg is not None
        angle = np.degrees(np.arccos(np.clip(np.dot(found.normal_in_cam, capture.planes[image.image_id][0]), -1, 1)))
        assert angle < 5 * found.normal_std_deg < 10

    # Again, with other options of matching: still as it is; and nothing is done twice.
    left, watcher = files(workspace), Told()
    calls.clear()
    run(
        workspace,
        watcher,
        camera_path=camera_path if calibrated else None,
        TwoViewGeometry=TwoViewGeometryOptions(max_error=2.0),
    )
    assert calls == [] and "taken over" in watcher.said("Refinement")
    assert {k: v for k, v in files(workspace).items() if k != RECORD_NAME} == {
        k: v for k, v in left.items() if k != RECORD_NAME
    }


def test_other_intrinsics_reach_the_mapper_but_not_a_database_made_elsewhere(
    workspace: Path, camera_path: Path
) -> None:
    change(workspace / "database.db", "UPDATE cameras SET prior_focal_length = 0")
    with pycolmap.Database.open(workspace / "database.db") as database:
        camera = database.read_camera(1)
        true_focal_length = camera.mean_focal_length()
        camera.focal_length_x = camera.focal_length_y = 1.2 * true_focal_length
        database.update_camera(camera)
    before = tables(workspace / "database.db")
    result = run(workspace, camera_path=camera_path, refine=False)
    assert tables(workspace / "database.db") == before
    (mapped,) = pycolmap.Reconstruction(result.sparse_path).cameras.values()
    assert mapped.mean_focal_length() == true_focal_length
    # Without the calibration the database's own camera is held.
    watcher = Told()
    result = run(workspace, watcher, refine=False)
    assert "the intrinsics are the database's" in watcher.said("WARNING")
    (mapped,) = pycolmap.Reconstruction(result.sparse_path).cameras.values()
    assert mapped.mean_focal_length() == pytest.approx(1.2 * true_focal_length, rel=1e-12)


def test_a_camera_per_image_in_the_database(workspace: Path, camera_path: Path, capture: Capture) -> None:
    """As COLMAP imports images by default; the one calibrated camera stands for all of them."""
    (workspace / "database.db").unlink()
    write_database(workspace / "database.db", capture)
    with closing(sqlite3.connect(workspace / "database.db")) as database:
        for table in ("rigs", "frames", "frame_data"):
            database.execute(f"DELETE FROM {table}")  # COLMAP makes them anew, one of each per image
        for k in range(2, 7):
            database.execute(
                "INSERT INTO cameras SELECT ?, model, width, height, zeroblob(length(params)), 0 FROM cameras "
                "WHERE camera_id = 1",
                [k],
            )
            database.execute("UPDATE images SET camera_id = ? WHERE image_id = ?", [k, k])
        database.commit()
    with pycolmap.Database.open(workspace / "database.db") as database:
        for k in range(2, 7):
            camera = camera_of(camera_id=k)
            database.update_camera(camera)
    result = run(workspace, camera_path=camera_path)
    (true,) = capture.reconstruction.cameras.values()
    assert result.refractive_path is not None
    for path in (result.sparse_path, result.refractive_path):
        model = pycolmap.Reconstruction(path)
        assert sorted(model.cameras) == [1, 2, 3, 4, 5, 6]
        assert all(np.array_equal(camera.params, true.params) for camera in model.cameras.values())


def test_database_of_colmap_3(workspace: Path) -> None:
    """Without rigs, frames and their tables, as version 3.11 leaves it; COLMAP itself adds those."""
    path = workspace / "database.db"
    with closing(sqlite3.connect(path)) as database:
        known = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        added = known & {"rigs", "rig_sensors", "frames", "frame_data"}
        assert len(added) == 4
        for name in added:
            database.execute(f"DROP TABLE {name}")
        database.execute("PRAGMA user_version = 3110")
        database.commit()
    before = tables(path)
    result = run(workspace, refine=False)
    assert pycolmap.Reconstruction(result.sparse_path).num_reg_images() == 6
    assert tables(path) == before


def test_database_of_other_images(workspace: Path, calls: list[str]) -> None:
    (workspace / "images" / "frame_0002.jpg").unlink()
    before = tables(workspace / "database.db")
    with pytest.raises(RefractError, match="holds image 'frame_0002.jpg' that the image folder lacks"):
        run(workspace)
    write_blank(workspace / "images" / "frame_0002.jpg", (SIZE[0] * 2, SIZE[1] * 2))
    with pytest.raises(RefractError, match="'frame_0002.jpg' has 800 x 600 pixels, 400 x 300 in"):
        run(workspace)
    for image in (workspace / "images").iterdir():
        write_blank(image, (SIZE[0] * 2, SIZE[1] * 2))
    with pytest.raises(RefractError, match="'frame_0001.jpg' has 800 x 600 pixels, 400 x 300 in"):
        run(workspace)
    assert tables(workspace / "database.db") == before and calls == []


@pytest.mark.parametrize("content", [b"no database", b""])
def test_file_that_is_no_database(workspace: Path, content: bytes) -> None:
    (workspace / "database.db").write_bytes(content)
    with pytest.raises(RefractError, match="database.db .*database"):
        run(workspace)
    assert (workspace / "database.db").read_bytes() == content


# --- Models ----------------------------------------------------------------------------------------------------------


def test_model_made_elsewhere_is_taken_as_it_is(workspace: Path, calls: list[str]) -> None:
    shutil.rmtree(run(workspace, refine=False).sparse_path.parent / "0" / "nothing", ignore_errors=True)
    (workspace / RECORD_NAME).unlink()
    before, watcher = files(workspace / "sparse"), Told()
    calls.clear()
    run(workspace, watcher, refine=False)
    run(workspace, watcher, refine=False, Mapper=MapperOptions(filter_max_reproj_error=2.0))
    assert calls == [] and files(workspace / "sparse") == before
    assert "made elsewhere, taken as it is" in watcher.said("Model")
    change(workspace / "database.db", "UPDATE keypoints SET rows = rows - 1, data = substr(data, 1, length(data) - 8)")
    with pytest.raises(RefractError, match="made elsewhere and is not of this database"):
        run(workspace, refine=False)
    assert files(workspace / "sparse") == before


def test_other_options_of_the_mapper_map_anew(workspace: Path, calls: list[str]) -> None:
    run(workspace, refine=False)
    first = files(workspace / "sparse")
    watcher = Told()
    run(workspace, watcher, refine=False, Mapper=MapperOptions(filter_max_reproj_error=0.5))
    assert calls == ["map", "map"]
    assert files(workspace / "sparse") != first
    assert "mapped anew, since --Mapper.filter_max_reproj_error changed" in watcher.said("Model")
    # A model that somebody has worked on since is somebody else's.
    (workspace / "sparse" / "0" / "notes.txt").write_text("mine")
    run(workspace, watcher, refine=False)
    assert calls == ["map", "map"] and (workspace / "sparse" / "0" / "notes.txt").read_text() == "mine"


def test_model_in_parts(scenes: Scenes, tmp_path: Path) -> None:
    """Two groups of images without a match between them: the larger is refined, the other named and kept."""
    size = {"width": SIZE[0], "height": SIZE[1], "focal_length": 300.0}
    capture = scenes("static_interface", num_images=8, num_points=250, camera_model="PINHOLE", **size).capture
    names = sorted(image.name for image in capture.reconstruction.images.values())
    apart = set(names[:3])
    for name in names:
        write_blank(tmp_path / "images" / name)
    write_database(tmp_path / "database.db", capture)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        for a in apart:
            for b in set(names) - apart:
                database.delete_two_view_geometry(ids[a], ids[b])
    watcher = Told()
    result = run(tmp_path, watcher, refine=False, Mapper=MapperOptions(min_model_size=2))
    assert {image.name for image in pycolmap.Reconstruction(result.sparse_path).images.values()} == set(names) - apart
    assert "5 of 8 images registered" in watcher.said("Model")
    assert all(name in watcher.said("Not registered") for name in apart)
    assert "3 images" in watcher.said("Model 1, apart")
    assert pycolmap.Reconstruction(tmp_path / "sparse" / "1").num_reg_images() == 3


def test_no_model(workspace: Path) -> None:
    """Too few matches in every pair, at random."""
    rng = np.random.default_rng(0)
    with pycolmap.Database.open(workspace / "database.db") as database:
        for image in database.read_all_images():
            count = database.num_keypoints_for_image(image.image_id)
            database.update_keypoints(image.image_id, (rng.random((count, 2)) * SIZE).astype(np.float32))
        for pair_id in database.read_two_view_geometries()[0]:
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            geometry = database.read_two_view_geometry(*ids)
            geometry.inlier_matches = rng.permutation(geometry.inlier_matches)[:10]
            database.update_two_view_geometry(*ids, geometry)
    before = tables(workspace / "database.db")
    with pytest.raises(RefractError, match="the mapper finds no model.*--scenario fixed_camera"):
        run(workspace)
    assert not (workspace / "sparse").exists() and tables(workspace / "database.db") == before
    assert not list(workspace.glob(".colmap_refract-*"))


def test_fixed_camera_starts_from_pairs(scenes: Scenes, tmp_path: Path, calls: list[str]) -> None:
    size = {"width": SIZE[0], "height": SIZE[1], "focal_length": 300.0, "pixel_noise": 0.05}
    capture = scenes("fixed_camera", num_images=8, num_points=200, camera_model="PINHOLE", **size).capture
    for image in capture.reconstruction.images.values():
        write_blank(tmp_path / "images" / image.name)
    write_database(tmp_path / "database.db", capture)
    watcher = Told()
    result = run(tmp_path, watcher, scenario="fixed_camera")
    assert calls == []
    assert "8 of 8 images registered" in watcher.said("Model") and "start values" in watcher.said("Model")
    assert result.sidecar is not None
    model = pycolmap.Reconstruction(result.sparse_path)
    poses = [image.cam_from_world().matrix() for image in model.images.values()]
    assert np.ptp(poses, axis=0).max() == 0


# --- The refined model -----------------------------------------------------------------------------------------------


def test_refined_model_is_ours_to_replace_and_no_other(workspace: Path, calls: list[str]) -> None:
    target = workspace / "sparse_refractive" / "0"
    target.mkdir(parents=True)
    (target / "cameras.bin").write_bytes(b"somebody's")
    with pytest.raises(RefractError, match="holds files that were not written here"):
        run(workspace)
    assert calls == [] and (target / "cameras.bin").read_bytes() == b"somebody's"  # said before the work, not after
    shutil.rmtree(target)

    run(workspace, complete_tracks=False)
    first, watcher = files(target), Told()
    refiner = RefinerOptions(scenario="static_interface", num_threads=1, refractive_index=1.34)
    reconstruct(workspace, ReconstructorOptions(complete_tracks=False), refiner, watcher=watcher)
    assert calls == ["map"]
    assert "done anew, since --refractive_index changed" in watcher.said("Refinement")
    assert set(files(target)) == set(first) and files(target) != first


def test_refined_model_of_an_earlier_run_is_named(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = workspace / "sparse_refractive" / "0"
    run(workspace, complete_tracks=False)
    before, watcher = files(target), Told()
    run(workspace, watcher, refine=False)
    assert f"{target} is of an earlier run, of this model, and still there" in watcher.said("WARNING: /")

    def fail(*_: object) -> None:
        raise RefractError("no point is left")

    monkeypatch.setattr("colmap_refract.reconstructor.refined._refine", fail)
    watcher = Told()
    refiner = RefinerOptions(scenario="static_interface", num_threads=1, refractive_index=1.34)
    with pytest.raises(RefractError, match="no point is left"):
        reconstruct(workspace, ReconstructorOptions(complete_tracks=False), refiner, watcher=watcher)
    assert "of an earlier run (--refractive_index has changed since), and still there" in watcher.said("WARNING: /")
    assert files(target) == before


def test_interrupts_leave_what_was_done(workspace: Path, calls: list[str]) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(workspace, Told("Mapping"))
    assert not (workspace / "sparse").exists() and not list(workspace.glob(".colmap_refract-*"))
    with pytest.raises(KeyboardInterrupt):
        run(workspace, Told("Refining"))
    assert calls == ["map"]
    assert not (workspace / "sparse_refractive" / "0").exists() and not list(workspace.rglob(".colmap_refract-*"))
    watcher = Told()
    run(workspace, watcher)
    assert calls == ["map"] and "taken over" in watcher.said("Model")


@pytest.mark.parametrize(
    "notes", [ImageNotes(dry_images=frozenset({"none.jpg"})), ImageNotes(interface_groups={"none.jpg": "a"})]
)
def test_notes_about_other_images_are_said_at_once(workspace: Path, calls: list[str], notes: ImageNotes) -> None:
    refiner = RefinerOptions(scenario="moving_interface")
    with pytest.raises(RefractError, match="'none.jpg'.*not among the images"):
        reconstruct(workspace, ReconstructorOptions(), refiner, notes=notes)
    assert calls == []


# --- Flow ------------------------------------------------------------------------------------------------------------


def test_flow_needs_a_camera_that_stands_still(tmp_path: Path) -> None:
    with pytest.raises(RefractError, match="fixed_camera"):
        run(tmp_path / "none", matcher="flow")
    assert not (tmp_path / "none").exists()


def test_flow_is_tracked_once(
    workspace: Path, monkeypatch: pytest.MonkeyPatch, calls: list[str], scenes: Scenes
) -> None:
    """The tracker is replaced by what it would leave: this shows when it is asked, not what it finds."""
    size = {"width": SIZE[0], "height": SIZE[1], "focal_length": 300.0, "pixel_noise": 0.05}
    capture = scenes("fixed_camera", num_images=6, num_points=200, camera_model="PINHOLE", **size).capture
    (workspace / "database.db").unlink()
    tracked: list[str] = []

    def track(workspace: Workspace, photographs: Any, assignment: Any, options: Any, reference: str) -> str:
        tracked.append(reference)
        with workspace.scratch() as scratch:
            write_database(scratch / "database.db", capture)
            put_database(workspace, scratch / "database.db")
        return "frame_0002.jpg"

    monkeypatch.setattr(flow, "_track", track)
    for _ in range(2):
        watcher = Told()
        run(workspace, watcher, scenario="fixed_camera", matcher="flow", refine=False)
        assert "the reference, frame_0002.jpg" in watcher.said("Matches")
    assert tracked == [""] and calls == []
    write_blank(workspace / "images" / "frame_0003.jpg", value=90)
    watcher = Told()
    run(workspace, watcher, scenario="fixed_camera", matcher="flow", refine=False)
    assert tracked == ["", ""] and "the image 'frame_0003.jpg' changed" in watcher.said("Matches")
