"""Image files and videos, written here by OpenCV or byte by byte: what is read is what was stored."""

from __future__ import annotations

import os
import re
import struct
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import error_of
from numpy.typing import NDArray

from colmap_refract.photographs.frames import ImageFolder
from colmap_refract.photographs.images import (
    IMAGE_SUFFIXES,
    check_images,
    common_size,
    image_size,
    list_images,
    read_gray,
)
from colmap_refract.photographs.silence import silence
from colmap_refract.photographs.video import Video

WIDTH, HEIGHT = 64, 48
LOSSLESS = IMAGE_SUFFIXES - {".jpg", ".jpeg", ".jpe", ".webp"}
JPEG_ERROR = 12
"""Grey values, for a smooth picture at OpenCV's default quality; two unlike pictures differ by about a hundred."""
ROUNDING = 1
"""Grey values, of the weights of the channels: decoders have them with different numbers of bits."""


def picture(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """A smooth random colour picture, BGR, each channel over all of 0 to 255."""
    noise = np.random.default_rng(seed).normal(size=(height, width, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 4)
    low, high = smooth.min(axis=(0, 1)), smooth.max(axis=(0, 1))
    return np.asarray(np.rint(255 * (smooth - low) / (high - low)), np.uint8)


def grey_of(bgr: NDArray[np.uint8]) -> NDArray[np.float64]:
    return cv2.cvtColor(np.ascontiguousarray(bgr), cv2.COLOR_BGR2GRAY).astype(float)


def write(path: Path, image: NDArray[np.generic]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = ".jpg" if path.suffix.lower() == ".jpe" else path.suffix
    path.write_bytes(cv2.imencode(suffix, image)[1].tobytes())


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    """The JPEG with an EXIF segment that asks for a rotation."""
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    exif = b"Exif\0\0" + b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", 1) + entry + struct.pack("<I", 0)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


def write_video(path: Path, frames: list[NDArray[np.uint8]], fps: float = 10.0, codec: str = "MJPG") -> None:
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()


def levels(count: int) -> list[NDArray[np.uint8]]:
    """Frames that are each of one grey value, ten more than that of the frame before."""
    return [np.full((HEIGHT, WIDTH, 3), 10 * k, np.uint8) for k in range(count)]


def test_list_is_sorted_recursive_and_of_images_only(tmp_path: Path) -> None:
    for name in ["b.PNG", "a.jpg", "sub/deep/é ü.tiff", "sub/c.bmp"]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    for name in [".hidden.png", ".cache/d.png", "notes.txt", "model.bin"]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "folder.png").mkdir()
    assert list_images(tmp_path) == ["a.jpg", "b.PNG", "sub/c.bmp", "sub/deep/é ü.tiff"]


def test_list_without_images(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    assert "no image" in error_of(lambda: list_images(tmp_path))
    assert "is a file" in error_of(lambda: list_images(tmp_path / "notes.txt"))
    assert "no folder" in error_of(lambda: list_images(tmp_path / "missing"))


@pytest.mark.parametrize("suffix", sorted(IMAGE_SUFFIXES))
def test_every_format_is_read(tmp_path: Path, suffix: str) -> None:
    path, bgr = tmp_path / f"image{suffix}", picture()
    write(path, cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY) if suffix == ".pgm" else bgr)
    gray = read_gray(path)
    assert gray.dtype == np.uint8
    assert image_size(path) == (WIDTH, HEIGHT) == gray.shape[::-1]
    assert np.abs(gray - grey_of(bgr)).max() <= (ROUNDING if suffix in LOSSLESS else JPEG_ERROR)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp"])
def test_pixels_are_those_that_colmap_reads(tmp_path: Path, suffix: str) -> None:
    """WebP is left out: pycolmap's build may lack it."""
    path = tmp_path / f"image{suffix}"
    write(path, picture())
    bitmap = pycolmap.Bitmap.read(path, as_rgb=True)
    assert bitmap is not None
    # Two decoders of JPEG differ in the rounding and in how they interpolate colour.
    errors = np.abs(read_gray(path) - grey_of(bitmap.to_array()[..., ::-1]))
    assert errors.mean() <= 2 if suffix == ".jpg" else errors.max() <= ROUNDING


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_orientation_is_ignored(tmp_path: Path, orientation: int) -> None:
    plain, turned, bgr = tmp_path / "plain.jpg", tmp_path / "turned.jpg", picture()
    write(plain, bgr)
    turned.write_bytes(with_orientation(plain.read_bytes(), orientation))
    # The segment is one that OpenCV obeys if it may.
    assert not np.array_equal(cv2.imread(str(turned)), cv2.imread(str(plain)))
    assert image_size(turned) == (WIDTH, HEIGHT)
    assert np.array_equal(read_gray(turned), read_gray(plain))


def test_names_of_any_letters(tmp_path: Path) -> None:
    path = tmp_path / "Ünterwasser 水.png"
    write(path, picture())
    assert np.abs(read_gray(path) - grey_of(picture())).max() <= ROUNDING
    assert list_images(tmp_path) == [path.name]


@pytest.mark.parametrize(("suffix", "kind"), [(".png", np.uint16), (".tif", np.uint16), (".tif", np.float32)])
def test_deep_images_are_scaled(tmp_path: Path, suffix: str, kind: type) -> None:
    path, gray = tmp_path / f"deep{suffix}", picture()[..., 0]
    write(path, (gray.astype(np.uint16) * 257) if kind is np.uint16 else gray.astype(np.float32) / 255)
    assert gray.min() == 0 and gray.max() == 255
    assert np.array_equal(read_gray(path), gray)


def test_transparency_is_dropped(tmp_path: Path) -> None:
    path, bgr = tmp_path / "a.png", picture()
    write(path, np.dstack([bgr, np.zeros_like(bgr[..., 0])]))
    assert np.abs(read_gray(path) - grey_of(bgr)).max() <= ROUNDING


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".tif"])
@pytest.mark.parametrize("damage", ["empty", "text", "half"])
def test_unreadable_files_are_named(tmp_path: Path, suffix: str, damage: str) -> None:
    path = tmp_path / f"bad{suffix}"
    write(path, picture())
    data = path.read_bytes()
    path.write_bytes({"empty": b"", "text": b"this is no image", "half": data[: len(data) // 2]}[damage])
    for read in (read_gray, image_size):
        assert str(path) in error_of(lambda read=read: read(path))
    missing = tmp_path / f"missing{suffix}"
    assert str(missing) in error_of(lambda: read_gray(missing))
    assert str(tmp_path) in error_of(lambda: read_gray(tmp_path))


def test_sizes(tmp_path: Path) -> None:
    sizes = {"a.png": (40, 30), "b.png": (30, 40), "c.png": (40, 30)}
    for name, (width, height) in sizes.items():
        write(tmp_path / name, picture(0, width, height))
    by_size = check_images(tmp_path, list(sizes))
    assert by_size == {(40, 30): ["a.png", "c.png"], (30, 40): ["b.png"]}
    message = error_of(lambda: common_size(by_size))
    assert "'a.png'" in message and "'b.png'" in message and "40 x 30" in message and "30 x 40" in message
    assert common_size(check_images(tmp_path, ["c.png"])) == (40, 30)
    error_of(lambda: common_size({}))


def test_folder_gives_every_nth(tmp_path: Path) -> None:
    for k, frame in enumerate(levels(7)):
        write(tmp_path / f"{k}.png", frame)
    folder = ImageFolder(tmp_path)
    assert folder.count() == 7
    frames = list(folder.frames(3))
    assert [(f.index, f.name, f.time, int(f.gray[0, 0])) for f in frames] == [
        (0, "0.png", None, 0),
        (3, "3.png", None, 30),
        (6, "6.png", None, 60),
    ]


@pytest.mark.parametrize("suffix", [".avi", ".mkv"])
def test_video_frames_are_the_right_ones(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"vidéo{suffix}"
    write_video(path, levels(20), fps=10)
    video = Video(path)
    frames = list(video.frames(3))
    assert video.count() == 20
    assert [frame.index for frame in frames] == list(range(0, 20, 3))
    for frame in frames:
        assert frame.gray.shape == (HEIGHT, WIDTH)
        assert frame.time == pytest.approx(frame.index / 10, abs=0.002)  # Matroska counts milliseconds
        assert abs(frame.gray.mean() - 10 * frame.index) < 3  # codecs round; frames are ten apart


def test_stretch_of_a_video(tmp_path: Path) -> None:
    path = tmp_path / "video.avi"
    write_video(path, levels(20), fps=10)
    video = Video(path, start_time=0.45, end_time=1.25)
    frames = list(video.frames(2))
    assert [frame.index for frame in frames] == [5, 7, 9, 11]
    assert abs(video.count() - 8) <= 1
    assert [frame.index for frame in Video(path, start_time=1.75).frames(1)] == [18, 19]
    assert "no frame" in error_of(lambda: list(Video(path, start_time=5).frames()))
    for start, end in [(-1.0, None), (2.0, 1.0), (1.0, 1.0)]:
        error_of(lambda start=start, end=end: Video(path, start_time=start, end_time=end))


@pytest.mark.parametrize("frame_format", ["png", "jpg"])
def test_written_frames_are_those_that_were_seen(tmp_path: Path, frame_format: str) -> None:
    path = tmp_path / "video.avi"
    write_video(path, levels(12))
    video = Video(path, frame_format=frame_format)  # type: ignore[arg-type]
    seen = {frame.index: frame for frame in video.frames()}
    video.write([3, 11], tmp_path)
    assert sorted(p.name for p in tmp_path.glob("frame*")) == [f"frame_0000{k}.{frame_format}" for k in ("03", "11")]
    for index in (3, 11):
        error = np.abs(read_gray(tmp_path / seen[index].name) - seen[index].gray.astype(float)).max()
        assert error <= (0 if frame_format == "png" else 3)


def test_rotation_of_a_video_is_ignored(tmp_path: Path) -> None:
    """The track header's matrix is turned by 90 degrees, as telephones do it."""
    path = tmp_path / "video.mp4"
    write_video(path, [picture(k) for k in range(10)], codec="mp4v")
    data = bytearray(path.read_bytes())
    one = struct.pack(">i", 1 << 16)
    upright = one + bytes(12) + one + bytes(12) + struct.pack(">i", 1 << 30)
    turned = bytes(4) + one + bytes(4) + struct.pack(">i", -(1 << 16)) + bytes(16) + struct.pack(">i", 1 << 30)
    place = data.index(upright, data.index(b"tkhd"))
    data[place : place + len(upright)] = turned
    path.write_bytes(data)
    capture = cv2.VideoCapture(str(path))
    rotated = capture.get(cv2.CAP_PROP_FRAME_WIDTH) == HEIGHT
    capture.release()
    assert rotated, "OpenCV turns this file unless it is told not to"
    assert next(iter(Video(path).frames())).gray.shape == (HEIGHT, WIDTH)


@pytest.mark.parametrize("damage", ["empty", "text", "missing", "folder"])
def test_what_is_no_video(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "video.mp4"
    if damage == "folder":
        path.mkdir()
    elif damage != "missing":
        path.write_bytes(b"" if damage == "empty" else b"this is no video " * 100)
    for call in (lambda: Video(path).count(), lambda: list(Video(path).frames())):
        assert str(path) in error_of(call)


@pytest.mark.parametrize("suffix", [".avi", ".mkv"])
def test_video_that_breaks_off(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]) -> None:
    """What is before the break can be used by an end before it, as the message says."""
    path = tmp_path / f"video{suffix}"
    write_video(path, [picture(k) for k in range(40)])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    message = error_of(lambda: list(Video(path).frames(5)))
    assert "breaks off" in message
    assert capfd.readouterr().err == ""
    # With a start after the break, or only a few frames before it, there is nothing to use.
    assert "--end_time" not in error_of(lambda: list(Video(path, start_time=3.5).frames()))
    (tmp_path / f"short{suffix}").write_bytes(data[: len(data) // 5])
    few = error_of(lambda: list(Video(tmp_path / f"short{suffix}").frames()))
    assert re.search(r"after \d of 40 frames", few) and "--end_time" not in few and "convert it" in few
    end = float(message.split("--end_time ")[1])
    assert 1.0 < end < 3.0
    assert len(list(Video(path, end_time=end).frames())) == pytest.approx(10 * end, abs=1.5)


def test_decoders_say_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What they think of damaged files would come between the lines of a report."""
    video = tmp_path / "video.avi"
    write_video(video, [picture(k) for k in range(20)])
    data = bytearray(video.read_bytes())
    noise = np.random.default_rng(0).integers(0, 256, len(data) // 2, dtype=np.uint8).tobytes()
    video.write_bytes(data[: len(data) // 3] + noise + data[len(data) // 3 + len(noise) :])
    for suffix in (".jpg", ".png"):
        image = cv2.imencode(suffix, picture())[1].tobytes()
        # Zeros before the end: libjpeg complains and goes on. A piece that is missing: libpng complains and stops.
        spoiled = image[:-2] + bytes(50) + image[-2:] if suffix == ".jpg" else image[: len(image) // 2]
        (tmp_path / f"image{suffix}").write_bytes(spoiled)
    capfd.readouterr()
    for path in (tmp_path / "image.jpg", tmp_path / "image.png"):
        cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert "JPEG" in (said := capfd.readouterr().err) and "PNG" in said, "there is something to be silenced"
    assert read_gray(tmp_path / "image.jpg").shape == (HEIGHT, WIDTH)
    error_of(lambda: read_gray(tmp_path / "image.png"))
    error_of(lambda: list(Video(video).frames()))
    assert capfd.readouterr().err == ""
    os.write(2, b"heard")
    assert capfd.readouterr().err == "heard"


def test_silence_ends_with_the_last_block(capfd: pytest.CaptureFixture[str]) -> None:
    """Blocks that overlap, as those of threads do, leave by any order and by exceptions."""
    before = len(os.listdir("/dev/fd")) if os.path.isdir("/dev/fd") else 0
    first, second = silence(), silence()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    os.write(2, b"unheard")
    second.__exit__(None, None, None)
    os.write(2, b"one ")
    with pytest.raises(KeyboardInterrupt), silence():
        raise KeyboardInterrupt
    os.write(2, b"two")
    assert capfd.readouterr().err == "one two"
    assert (len(os.listdir("/dev/fd")) if os.path.isdir("/dev/fd") else 0) == before


def test_folder_that_may_not_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if sys.platform == "win32":
        pytest.skip("of POSIX permissions")

    def forbidden(_: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", forbidden)
    assert "Permission denied" in error_of(lambda: list_images(tmp_path))
