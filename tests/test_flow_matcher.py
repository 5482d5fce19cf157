"""From a folder of frames to a COLMAP database, which COLMAP itself then reads; and what must not be left behind.

The accuracy of the tracks is shown in test_flow.py.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from colmap_refract.commands.flow_matcher import FlowMatcher
from colmap_refract.errors import RefractError
from colmap_refract.mapping import flow_database
from colmap_refract.mapping.database import read_correspondences
from colmap_refract.mapping.flow_database import create_flow_database
from colmap_refract.mapping.tracks import build_tracks
from colmap_refract.optical_flow.frame import FrameFlow
from colmap_refract.optical_flow.options import FlowOptions
from colmap_refract.optical_flow.report import lost_warning
from colmap_refract.optical_flow.tracking import FlowTracks

WIDTH, HEIGHT = 240, 180
SHIFTS = {"a/left.png": (-7, 2), "a/middle.png": (0, 0), "b/right.png": (6, 3), "b/right2.png": (9, -4)}
"""Whole pixels, by which the picture is moved in each frame, exactly."""
STRANGE = "b/strange.png"
OPTIONS = FlowOptions(max_num_points=300)


def texture(seed: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    shape = (HEIGHT + 60, WIDTH + 60)
    layers = [cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma) for sigma in (1.2, 3, 8)]
    return np.asarray(128 + 20 * sum(layer / layer.std() for layer in layers))


@pytest.fixture(scope="module")
def image_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(5)
    for name, (x, y) in {**SHIFTS, STRANGE: (0, 0)}.items():
        picture = texture(2 if name == STRANGE else 1)[30 - y : 30 - y + HEIGHT, 30 - x : 30 - x + WIDTH]
        (folder / name).parent.mkdir(exist_ok=True)
        noisy = picture + rng.normal(0, 1, picture.shape)
        cv2.imwrite(str(folder / name), np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return folder


PARAMS = [251.3, 250.1, 121.2, 88.8, 0.012, -0.003, 0.0004, -0.0001]


def write_camera(path: Path, width: int = WIDTH, copies: int = 1) -> Path:
    lines = [f"{k + 7} OPENCV {width} {HEIGHT} {' '.join(map(str, PARAMS))}" for k in range(copies)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def database_path(image_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("project")
    command = FlowMatcher(
        database_path=folder / "database.db",
        image_path=image_path,
        options=OPTIONS,
        camera_path=write_camera(folder / "cameras.txt"),
        reference_image="a/middle.png",
    )
    command.run()
    assert sorted(os.listdir(folder)) == ["cameras.txt", "database.db"]
    return command.database_path


def test_colmap_finds_its_own_tables(database_path: Path) -> None:
    with pycolmap.Database.open(database_path) as database:
        (camera,) = database.read_all_cameras()
        images, frames, rigs = database.read_all_images(), database.read_all_frames(), database.read_all_rigs()
        assert camera.model == pycolmap.CameraModelId.OPENCV
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert camera.params.tolist() == PARAMS
        assert camera.has_prior_focal_length
        assert sorted(image.name for image in images) == sorted([*SHIFTS, STRANGE])
        assert {image.camera_id for image in images} == {camera.camera_id}
        assert len(rigs) == 1 and len(frames) == len(images)
        lost = next(image.image_id for image in images if image.name == STRANGE)
        assert database.num_keypoints_for_image(lost) == 0
        assert database.num_matched_image_pairs() == len(SHIFTS) - 1
        # What COLMAP's mapper begins with: the images that verified matches join.
        cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
        assert len(cache.images) == len(SHIFTS)


def test_the_database_holds_where_the_points_went(database_path: Path) -> None:
    found = read_correspondences(database_path)
    assert len(found.pairs) == len(SHIFTS) - 1
    for (i, j), pairs in zip(found.pairs, found.matches, strict=True):
        moved = found.keypoints[j][pairs[:, 1]] - found.keypoints[i][pairs[:, 0]]
        expected = np.subtract(SHIFTS[found.image_names[j]], SHIFTS[found.image_names[i]])
        # One grey value of noise makes a few hundredths of a pixel.
        assert np.sqrt(((moved - expected) ** 2).sum(axis=1).mean()) < 0.06
        assert len(pairs) > 150
    # Corners are centres of pixels, whose coordinates end in a half in COLMAP's frame.
    reference = found.keypoints[found.image_names.index("a/middle.png")]
    assert np.array_equal(reference % 1, np.full_like(reference, 0.5))


def test_tracks_go_through_the_reference(database_path: Path) -> None:
    found = read_correspondences(database_path)
    tracks = build_tracks(found)
    lengths = np.diff(tracks.start)
    assert len(lengths) == len(found.keypoints[found.image_names.index("a/middle.png")])
    assert (lengths == len(SHIFTS)).sum() > 100
    assert len(tracks.image) == sum(len(points) for points in found.keypoints)


@pytest.mark.parametrize("method", ["dense", "features"])
def test_defaults_choose_a_reference_and_warn_of_the_camera(
    method: str, image_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    options = FlowOptions(method=method, max_num_points=200)  # type: ignore[arg-type]
    FlowMatcher(database_path=tmp_path / "new.db", image_path=image_path, options=options).run()
    printed = capsys.readouterr().out
    assert "4, 1 of them lost" in printed
    assert f"Lost, without keypoints in the database: {STRANGE}" in printed
    assert printed.count(" / 200") == 4
    assert "calibrate the camera" in caplog.text
    with pycolmap.Database.open(tmp_path / "new.db") as database:
        (camera,) = database.read_all_cameras()
        assert not camera.has_prior_focal_length
        assert camera.focal_length == pytest.approx(1.2 * WIDTH)


def test_frames_that_show_something_else_are_warned_of() -> None:
    lost = FrameFlow(num_points=9, num_tracks=0, length=np.nan, error=np.nan, correlation=np.nan)
    for num_lost, warns in [(0, False), (1, False), (2, True)]:
        tracks = some_tracks()
        frames = {**tracks.frames, **{f"{k}.png": lost for k in range(num_lost)}}
        warning = lost_warning(dataclasses.replace(tracks, frames=frames))
        assert bool(warning) == warns
        assert not warns or f"{num_lost} of {num_lost + 1}" in warning


def command(database_path: Path, image_path: Path, **more: object) -> FlowMatcher:
    return FlowMatcher(database_path=database_path, image_path=image_path, options=OPTIONS, **more)  # type: ignore[arg-type]


def test_bad_input_leaves_nothing(image_path: Path, tmp_path: Path) -> None:
    def complains(match: str, **more: object) -> None:
        arguments = {"database_path": tmp_path / "out" / "new.db", "image_path": image_path, **more}
        with pytest.raises(RefractError, match=match) as caught:
            command(**arguments).run()  # type: ignore[arg-type]
        assert "\n" not in str(caught.value)
        assert os.listdir(tmp_path / "out") == []

    (tmp_path / "out").mkdir()
    complains("no image 'a/midle.png'.*'a/middle.png'", reference_image="a/midle.png")
    complains("calibrated for 320 x 180 .* 240 x 180", camera_path=write_camera(tmp_path / "wide.txt", width=320))
    complains("holds 2 cameras", camera_path=write_camera(tmp_path / "two.txt", copies=2))
    complains("does not exist", camera_path=tmp_path / "none.txt")
    complains("no folder", image_path=tmp_path / "nowhere")
    complains("there is no folder .*missing", database_path=tmp_path / "missing" / "new.db")
    complains("nothing could be tracked", reference_image=STRANGE)
    (tmp_path / "empty").mkdir()
    complains("holds no image", image_path=tmp_path / "empty")

    few = tmp_path / "few"
    few.mkdir()
    first = cv2.imread(str(image_path / "a/middle.png"))
    cv2.imwrite(str(few / "1.png"), first)
    complains("one frame only", image_path=few)
    (few / "2.png").write_bytes(b"no picture")
    complains("2.png cannot be decoded", image_path=few)
    cv2.imwrite(str(few / "2.png"), first[:100])
    complains("size.* 240 x 180 .*240 x 100", image_path=few)
    complains("size.* 240 x 180 .*240 x 100", image_path=few, reference_image="1.png")
    cv2.imwrite(str(few / "2.png"), first)
    cv2.imwrite(str(few / "1.png"), np.full_like(first, 100))
    complains("0 corners", image_path=few, reference_image="1.png")


def test_an_existing_file_is_not_touched(image_path: Path, tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    path.write_bytes(b"precious")
    with pytest.raises(RefractError, match="exists already"):
        command(path, image_path).run()
    assert path.read_bytes() == b"precious"
    assert os.listdir(tmp_path) == ["database.db"]


def some_tracks() -> FlowTracks:
    points = np.random.default_rng(0).uniform(10, 170, (4000, 2))
    pairs = np.tile(np.arange(len(points))[:, None], 2)
    flow = FrameFlow(num_points=4000, num_tracks=4000, length=1.0, error=0.1, correlation=1.0)
    first, second = "a/middle.png", "a/left.png"
    return FlowTracks(
        reference=first,
        keypoints={first: points, second: points},
        matches={(first, second): pairs},
        frames={second: flow},
    )


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, OSError(28, "No space left on device")])
def test_what_is_interrupted_leaves_nothing(
    error: type[BaseException] | OSError, image_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(flow_database, "write_tracks", fails)
    expected = RefractError if isinstance(error, OSError) else error
    with pytest.raises(expected):
        create_flow_database(tmp_path / "new.db", image_path, list(SHIFTS), None, some_tracks())
    assert os.listdir(tmp_path) == []


def test_a_full_disk_is_found_out_before(image_path: Path, tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk. Without the check, pycolmap would end the process."""
    pytest.importorskip("resource")
    code = f"""
import resource, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from test_flow_matcher import SHIFTS, create_flow_database, some_tracks
from colmap_refract.errors import RefractError
resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000))
try:
    create_flow_database(Path({str(tmp_path)!r}) / "new.db", Path({str(image_path)!r}), list(SHIFTS), None,
                         some_tracks())
except RefractError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"cannot write {tmp_path / 'new.db'}: File too large")
    assert os.listdir(tmp_path) == []


def test_enough_space_is_asked_for(image_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As much as the database and its journal take together when both are at their largest."""
    sizes = []
    write = flow_database.write_tracks

    def watched(path: Path, *rest: object) -> None:
        write(path, *rest)  # type: ignore[arg-type]
        sizes.append(sum(file.stat().st_size for file in tmp_path.iterdir()))

    reserved = []
    truncate = os.truncate

    def measured(path: Path, length: int) -> None:
        reserved.append(path.stat().st_size)
        truncate(path, length)

    monkeypatch.setattr(flow_database, "write_tracks", watched)
    monkeypatch.setattr(flow_database.os, "truncate", measured)
    create_flow_database(tmp_path / "new.db", image_path, list(SHIFTS), None, some_tracks())
    assert os.listdir(tmp_path) == ["new.db"]
    assert 0 < sizes[0] <= reserved[0]


def test_an_image_that_colmap_cannot_read(image_path: Path, tmp_path: Path) -> None:
    with pytest.raises(RefractError, match="COLMAP cannot read the image .*gone.png"):
        create_flow_database(tmp_path / "new.db", image_path, [*SHIFTS, "gone.png"], None, some_tracks())
    assert os.listdir(tmp_path) == []
