"""Frames are warped here by known fields, blurred and blackened, so that it is known which should be chosen.

A texture that moves as a whole stands for what is seen through a surface; whether the chosen frames make a good
reconstruction is not shown here.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import error_of, snapshot
from numpy.typing import NDArray

from colmap_refract.commands.image_selector import ImageSelector
from colmap_refract.frame_selection import choice
from colmap_refract.frame_selection.choice import select_frames
from colmap_refract.frame_selection.options import SelectionOptions
from colmap_refract.frame_selection.report import report, to_json
from colmap_refract.frame_selection.selection import Selection
from colmap_refract.photographs.frames import ImageFolder
from colmap_refract.photographs.images import read_gray
from colmap_refract.photographs.video import Video

WIDTH, HEIGHT = 240, 180
MARGIN = 50
NUM_FRAMES = 32
BLURRED, BLACK, STRANGE = {4, 13, 29}, {7, 20}, {27}
"""Frames that must not be chosen: blurred, black, or of something else."""
NOISE = 2.0  # grey values


def texture(rng: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
    """Random grey values on all scales, as natural pictures have."""
    total = np.zeros((height, width))
    for sigma in (1, 2, 4, 8, 16, 32):
        layer = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), sigma)
        total += np.sqrt(sigma) * layer / layer.std()
    return np.asarray(128 + 45 * total / total.std(), np.float32)


def spoil(rng: np.random.Generator, image: NDArray[np.float32], index: int) -> NDArray[np.uint8]:
    if index in BLURRED:
        image = cv2.GaussianBlur(image, (0, 0), 3)
    if index in BLACK:
        image = np.zeros_like(image)
    if index in STRANGE:
        image = texture(rng, HEIGHT, WIDTH)
    # The light varies as well.
    image = image * rng.uniform(0.85, 1) + NOISE * rng.normal(size=image.shape)
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


@dataclass(frozen=True, eq=False)
class Sequence:
    """Frames in a folder, and what moves them."""

    folder: Path
    frames: list[NDArray[np.uint8]]
    fields: NDArray[np.float64]
    """(K, 2, 3): flow at (x, y) is `field @ (x, y, 1)`, where x and y are -1 to 1 over the picture; pixels."""

    @property
    def good(self) -> list[int]:
        return sorted(set(range(len(self.frames))) - BLURRED - BLACK - STRANGE)

    def differences(self) -> NDArray[np.float64]:
        """(K, K), root mean squares over the picture of the differences of flows, pixels."""
        difference = self.fields[:, None] - self.fields[None]
        return np.sqrt((difference**2 * [1 / 3, 1 / 3, 1]).sum(axis=(2, 3)))

    def flow(self, index: int, reference: int) -> NDArray[np.float64]:
        """(2,), from the centre of the reference to the same place of the scene in another frame, pixels.

        A field is given where its frame has the place; the places in two frames, p and q, have p - field_r(p) =
        q - field_k(q) in common.
        """
        half = np.array([WIDTH, HEIGHT]) / 2
        field, shift = self.fields[index], self.fields[index][:, 2] - self.fields[reference][:, 2]
        return np.asarray(np.linalg.solve(np.eye(2) - field[:, :2] / half, shift))


def write(folder: Path, frames: list[NDArray[np.uint8]]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(frames):
        (folder / name_of(k)).write_bytes(cv2.imencode(".png", frame)[1].tobytes())


def name_of(index: int) -> str:
    return f"{index:03d}.png"


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Tests run beside each other."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


@pytest.fixture(scope="module")
def fixed(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """A surface that tilts and rises at random in front of a camera on a tripod: shifts and affine changes."""
    rng = np.random.default_rng(1)
    scene = texture(rng, HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN)
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    place = np.stack([2 * x / WIDTH - 1, 2 * y / HEIGHT - 1, np.ones_like(x)], axis=-1)
    fields = rng.normal(size=(NUM_FRAMES, 2, 3)) * [1.5, 1.5, 6]
    frames = []
    for k, field in enumerate(fields):
        flow = place @ field.T
        source = np.stack([x, y], axis=-1) + MARGIN - flow
        frames.append(spoil(rng, cv2.remap(scene, source.astype(np.float32), None, cv2.INTER_CUBIC), k))
    folder = tmp_path_factory.mktemp("fixed")
    write(folder, frames)
    return Sequence(folder, frames, fields)


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """A camera that passes over a plane, slowly, not at all, and then fast."""
    rng = np.random.default_rng(2)
    speeds = np.repeat([5, 0, 10], [12, 7, NUM_FRAMES - 19])
    way = np.cumsum(speeds)
    scene = texture(rng, HEIGHT, WIDTH + int(way[-1]))
    frames = [spoil(rng, scene[:, w : w + WIDTH], k) for k, w in enumerate(way)]
    folder = tmp_path_factory.mktemp("moving")
    write(folder, frames)
    fields = np.zeros((NUM_FRAMES, 2, 3))
    fields[:, 0, 2] = -way
    return Sequence(folder, frames, fields)


@cache
def select(sequence: Sequence, **options: Any) -> Selection:
    """Made once for each set of options; tests must not alter it."""
    return select_frames(ImageFolder(sequence.folder), SelectionOptions(**options))


def indices(selection: Selection) -> list[int]:
    return [frame.index for frame in selection.chosen]


# --- a fixed camera


def separation(sequence: Sequence, chosen: list[int]) -> float:
    """Distance of the two nearest of the chosen frames, pixels."""
    between = sequence.differences()[np.ix_(chosen, chosen)]
    return float(between[~np.eye(len(chosen), dtype=bool)].min())


def gap(sequence: Sequence, chosen: list[int]) -> float:
    """Largest distance of a usable frame from the nearest chosen one, pixels."""
    return float(sequence.differences()[np.ix_(sequence.good, chosen)].min(axis=1).max())


def test_bad_frames_are_named_and_left_out(fixed: Sequence) -> None:
    selection = select(fixed, scenario="fixed_camera", num_images=NUM_FRAMES)
    verdicts = {frame.index: frame.verdict for frame in selection.frames}
    assert {k for k, verdict in verdicts.items() if verdict == "blurred"} == BLURRED
    assert {k for k, verdict in verdicts.items() if verdict == "few features"} == BLACK
    assert {k for k, verdict in verdicts.items() if verdict == "lost track"} == STRANGE
    # All others are usable and differ; fewer than asked for.
    assert indices(selection) == fixed.good
    assert len(selection.warnings) == 1 and f"only {len(fixed.good)} of the {NUM_FRAMES}" in selection.warnings[0]


def test_flow_is_that_of_the_truth(fixed: Sequence) -> None:
    selection = select(fixed, scenario="fixed_camera")
    reference = selection.reference.index
    seen = [frame for frame in selection.frames if frame.flow is not None]
    assert len(seen) == len(fixed.good)
    for frame in seen:
        # A tenth of a pixel is what tracking is good to. If the light were not made even, errors would be of a pixel.
        np.testing.assert_allclose(frame.flow, fixed.flow(frame.index, reference), atol=0.1)
        assert frame.flow_residual is not None and frame.flow_residual < 0.2
        assert frame.tracked_fraction is not None and frame.tracked_fraction > 0.4
    assert max(np.linalg.norm(fixed.flow(k, reference)) for k in fixed.good) > 10


def test_reference_is_in_the_middle(fixed: Sequence) -> None:
    selection = select(fixed, scenario="fixed_camera", num_images=6)
    means = fixed.differences()[np.ix_(fixed.good, fixed.good)].mean(axis=1)
    # Fields of several frames are compared as if they were of one, which is right to a few per cent.
    assert means[fixed.good.index(selection.reference.index)] < 1.05 * means.min() < 0.9 * np.median(means)
    assert selection.reference in selection.chosen


@pytest.mark.parametrize("count", [5, 10])
def test_chosen_frames_spread_better_than_chance(fixed: Sequence, count: int) -> None:
    chosen = indices(select(fixed, scenario="fixed_camera", num_images=count))
    assert len(chosen) == count and set(chosen) <= set(fixed.good)
    rng = np.random.default_rng(0)
    draws = [list(rng.choice(fixed.good, count, replace=False)) for _ in range(200)]
    # Better than nineteen in twenty draws in keeping apart, and than most in leaving no frame far away.
    assert separation(fixed, chosen) > np.percentile([separation(fixed, draw) for draw in draws], 95)
    assert gap(fixed, chosen) < np.percentile([gap(fixed, draw) for draw in draws], 50)


def test_reference_can_be_given(fixed: Sequence) -> None:
    selection = select(fixed, scenario="fixed_camera", num_images=4, reference_image=name_of(10))
    assert selection.reference.index == 10 and len(selection.chosen) == 4
    assert selection.reference.flow == (0, 0)
    bad = select(fixed, scenario="fixed_camera", num_images=4, reference_image=name_of(4))
    assert bad.reference.index == 4
    assert any(name_of(4) in warning and "blurred" in warning for warning in bad.warnings)
    message = error_of(lambda: select(fixed, scenario="fixed_camera", reference_image="nobody.png"))
    assert "nobody.png" in message


def test_moving_camera_is_noticed_by_a_fixed_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    write(tmp_path, [spoil(rng, texture(rng, HEIGHT, WIDTH), 0) for _ in range(5)])
    options = SelectionOptions(scenario="fixed_camera")
    assert "lost track" in error_of(lambda: select_frames(ImageFolder(tmp_path), options))


def test_copies_of_a_frame_are_not_chosen_twice(tmp_path: Path, fixed: Sequence) -> None:
    few = [fixed.frames[k] for k in fixed.good[:4]]
    write(tmp_path, [*few, *few, *few])
    selection = select_frames(ImageFolder(tmp_path), SelectionOptions(scenario="fixed_camera"))
    assert len(selection.chosen) == 4
    assert {k % 4 for k in indices(selection)} == {0, 1, 2, 3}
    assert "too similar" in selection.warnings[0]


# --- a moving camera


@pytest.mark.parametrize("scenario", ["static_interface", "moving_interface", "camera_housing"])
def test_spacing_is_even(moving: Sequence, scenario: str) -> None:
    count = 9
    selection = select(moving, scenario=scenario, num_images=count)
    chosen = indices(selection)
    assert len(chosen) == count and set(chosen) <= set(moving.good)
    way = -moving.fields[:, 0, 2]
    step = (way[-1] - way[0]) / (count - 1)
    steps = np.diff(way[chosen])
    # Each frame is at most 0.3 of a step off its place, or half a step where bad ones are in the way.
    assert steps.min() > 0.4 * step and steps.max() < 1.6 * step
    assert steps.std() < 0.25 * step
    # Evenly in time would be a different choice.
    in_time = np.diff(way[np.linspace(0, NUM_FRAMES - 1, count).astype(int)])
    assert in_time.std() > 2 * steps.std()


def test_path_is_that_of_the_truth(moving: Sequence) -> None:
    selection = select(moving, scenario="static_interface")
    way = -moving.fields[:, 0, 2]
    for frame in selection.frames:
        if frame.flow_length is None:
            assert frame.index in BLURRED | BLACK | STRANGE
        else:
            assert abs(frame.flow_length - (way[frame.index] - way[0])) < 0.01 * way[-1]
    lost = {frame.index for frame in selection.frames if frame.verdict == "lost track"}
    assert lost == STRANGE


def test_neighbours_differ(moving: Sequence) -> None:
    """The camera rests for eight frames, of which one at most is wanted, however many are asked for."""
    selection = select(moving, scenario="static_interface", num_images=NUM_FRAMES)
    resting = [k for k in indices(selection) if 11 <= k < 19]
    assert len(resting) <= 1
    assert "too similar" in selection.warnings[0]


def test_reference_of_a_moving_camera(moving: Sequence) -> None:
    selection = select(moving, scenario="static_interface", num_images=8)
    assert selection.reference.num_features == max(frame.num_features for frame in selection.chosen)
    for given in (11, 17):
        selection = select(moving, scenario="static_interface", num_images=8, reference_image=name_of(given))
        assert selection.reference.index == given and len(selection.chosen) == 8


def test_useless_reference_is_taken_with_a_warning(moving: Sequence) -> None:
    for given in (7, 27):
        assert given in BLACK | STRANGE
        selection = select(moving, scenario="static_interface", num_images=8, reference_image=name_of(given))
        assert selection.reference.index == given and given in indices(selection)
        assert any(name_of(given) in warning for warning in selection.warnings)
        json.loads(to_json(selection))
        assert name_of(given) in report(selection)


def test_few_images_over_a_long_way_are_warned_of(moving: Sequence) -> None:
    few = select(moving, scenario="static_interface", num_images=3)
    assert any("overlap" in w and "would do (num_images)" in w for w in few.warnings)
    assert not any("overlap" in w for w in select(moving, scenario="static_interface", num_images=9).warnings)
    # Frames in between are needed, if not for the number that was asked for.
    verdicts = {frame.verdict for frame in few.frames}
    assert "not needed" in verdicts and "Left out, not needed" in report(few)


def test_no_more_images_are_advised_than_there_are(tmp_path: Path, moving: Sequence) -> None:
    sparse = [k for k in moving.good if k % 8 == 0]
    write(tmp_path, [moving.frames[k] for k in sparse])
    for count, words in ((2, f"take all {len(sparse)} "), (len(sparse), "photograph more in between")):
        selection = select_frames(
            ImageFolder(tmp_path), SelectionOptions(scenario="static_interface", num_images=count)
        )
        (warning,) = (warning for warning in selection.warnings if "overlap" in warning)
        assert words in warning and "would do (num_images)" not in warning


def test_a_cut_is_warned_of(tmp_path: Path, moving: Sequence) -> None:
    rng = np.random.default_rng(5)
    other = texture(rng, HEIGHT, WIDTH + 60)
    second = [spoil(rng, other[:, 6 * k : 6 * k + WIDTH], 0) for k in range(8)]
    write(tmp_path, [*(moving.frames[k] for k in (21, 22, 23, 24, 25, 26, 28)), *second])
    selection = select_frames(ImageFolder(tmp_path), SelectionOptions(scenario="static_interface", num_images=6))
    assert any("no flow" in warning and name_of(7) in warning for warning in selection.warnings)
    assert min(indices(selection)) < 7 <= max(indices(selection))


def test_photographs_far_apart_are_matched(tmp_path: Path) -> None:
    """Neighbours share three quarters of the picture: too far to be tracked by pyramids, near enough for features."""
    rng = np.random.default_rng(3)
    step, count = WIDTH // 4, 6
    scene = texture(rng, HEIGHT, WIDTH + step * count)
    write(tmp_path, [spoil(rng, scene[:, step * k : step * k + WIDTH], 0) for k in range(count)])
    selection = select_frames(ImageFolder(tmp_path), SelectionOptions(scenario="static_interface"))
    assert indices(selection) == list(range(count))
    lengths = [frame.flow_length for frame in selection.frames]
    np.testing.assert_allclose(lengths, step * np.arange(count), atol=2)


# --- folders and videos


@pytest.mark.parametrize("scenario", ["fixed_camera", "static_interface"])
def test_video_gives_the_choice_of_the_folder(tmp_path: Path, fixed: Sequence, moving: Sequence, scenario: str) -> None:
    """The folder holds the video's decoded frames, for its codec's losses would be enough for another choice."""
    sequence = fixed if scenario == "fixed_camera" else moving
    path, folder = tmp_path / "video.avi", tmp_path / "frames"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (WIDTH, HEIGHT))
    for frame in sequence.frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    write(folder, [frame.gray for frame in Video(path).frames()])
    options = SelectionOptions(scenario=scenario, num_images=8)  # type: ignore[arg-type]
    of_video, of_folder = select_frames(Video(path), options), select_frames(ImageFolder(folder), options)
    assert indices(of_video) == indices(of_folder)
    assert of_video.reference.index == of_folder.reference.index
    assert set(indices(of_video)) <= set(sequence.good)
    assert of_video.chosen[-1].time == pytest.approx(of_video.chosen[-1].index / 25)


def test_large_frames_are_looked_at_in_small(tmp_path: Path, fixed: Sequence) -> None:
    """Three times as large: the same choice, lengths in pixels of the original."""
    some = fixed.good[:6]
    write(tmp_path / "small", [fixed.frames[k] for k in some])
    large = [cv2.resize(fixed.frames[k], None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC) for k in some]
    write(tmp_path / "large", large)
    options = SelectionOptions(scenario="fixed_camera", num_images=4)
    small, large_ = (select_frames(ImageFolder(tmp_path / name), options) for name in ("small", "large"))
    assert large_.image_size == (3 * WIDTH, 3 * HEIGHT)
    assert large_.reference.index == small.reference.index
    for a, b in zip(small.frames, large_.frames, strict=True):
        assert a.flow is not None and b.flow is not None
        np.testing.assert_allclose(b.flow, 3 * np.array(a.flow), atol=0.5)


def test_step(fixed: Sequence) -> None:
    selection = select(fixed, scenario="fixed_camera", num_images=4, frame_step=3)
    assert [frame.index for frame in selection.frames] == list(range(0, NUM_FRAMES, 3))


def test_only_so_many_frames_are_looked_at_by_default(fixed: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choice, "_MOST_FRAMES", 10)
    options = SelectionOptions(scenario="fixed_camera", num_images=3)
    selection = choice.select_frames(ImageFolder(fixed.folder), options)
    assert [frame.index for frame in selection.frames] == list(range(0, NUM_FRAMES, 4))
    assert selection.frame_step == 4


# --- the command


def command(**options: Any) -> ImageSelector:
    own = {k: options.pop(k) for k in list(options) if k in SelectionOptions.__dataclass_fields__}
    return ImageSelector(options=SelectionOptions(**{"scenario": "fixed_camera", "num_images": 5, **own}), **options)


@pytest.fixture
def few(tmp_path: Path, fixed: Sequence) -> Path:
    """Ten frames, one of them black, in two folders with letters that ASCII lacks."""
    folder = tmp_path / "Bilder"
    for k in range(10):
        name = f"{'a é' if k % 2 else 'b'}/{name_of(k)}"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(fixed.folder / name_of(k), folder / name)
    return folder


def test_files(tmp_path: Path, few: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = snapshot(few)
    command(image_path=few, output_path=tmp_path / "out").run()
    assert snapshot(few) == before
    written = snapshot(tmp_path / "out")
    names = written.pop("image_list.txt").decode().splitlines()
    assert len(names) == 5 and names == sorted(names)
    figures = json.loads(written.pop("selection.json"))
    assert figures["chosen"] == names and figures["reference"] in names
    assert [frame["name"] for frame in figures["frames"]] == sorted(before)
    assert {frame["name"] for frame in figures["frames"] if frame["verdict"] in ("chosen", "reference")} == set(names)
    assert all(frame["reason"] for frame in figures["frames"])
    drawing = cv2.imdecode(np.frombuffer(written.pop("selection.png"), np.uint8), cv2.IMREAD_COLOR)
    assert drawing is not None and drawing.std() > 0
    # Copies, bit by bit.
    assert written == {f"images/{name}": before[name] for name in names}
    text = capsys.readouterr().out
    assert "Traceback" not in text
    for words in [*names, "Reference:", "px of flow", "few features", "blurred", "not needed"]:
        assert words in text


def test_report_alone(tmp_path: Path, few: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = snapshot(tmp_path)
    command(image_path=few, scenario="static_interface").run()
    assert snapshot(tmp_path) == before
    assert "Flow between neighbours:" in capsys.readouterr().out


@pytest.mark.parametrize("frame_format", ["png", "jpg"])
def test_frames_of_a_video(tmp_path: Path, fixed: Sequence, frame_format: Any) -> None:
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (WIDTH, HEIGHT))
    for frame in fixed.frames[:12]:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    out = tmp_path / "out"
    command(video_path=path, output_path=out, start_time=0.25, frame_format=frame_format).run()
    names = (out / "image_list.txt").read_text().splitlines()
    assert len(names) == 5
    for name in names:
        index = int(name.removeprefix("frame_").removesuffix(f".{frame_format}"))
        assert 3 <= index < 12 and index not in BLURRED | BLACK
        written = read_gray(out / "images" / name).astype(float)
        # Two compressions; other frames differ by their noise alone by more.
        assert np.abs(written - np.mean(written) - fixed.frames[index] + np.mean(fixed.frames[index])).mean() < 4


def test_overwriting(tmp_path: Path, few: Path) -> None:
    out = tmp_path / "out"
    command(image_path=few, output_path=out, num_images=5).run()
    first = snapshot(out)
    assert "--overwrite" in error_of(command(image_path=few, output_path=out).run)
    (out / "database.db").write_bytes(b"the user's")
    command(image_path=few, output_path=out, num_images=3, overwrite=True).run()
    second = snapshot(out)
    assert second.pop("database.db") == b"the user's"
    images = {name for name in second if name.startswith("images/")}
    assert len(images) == 3 and len([name for name in first if name.startswith("images/")]) == 5
    assert set(second) - images == {"image_list.txt", "selection.json", "selection.png"}
    assert [p.name for p in out.iterdir() if p.name.startswith(".")] == []


@pytest.mark.parametrize("name", ["images/mine.jpg", "image_list.txt", "selection.json", "selection.png/x"])
def test_what_is_not_ours_is_not_overwritten(tmp_path: Path, few: Path, name: str) -> None:
    out = tmp_path / "out"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text("the user's")
    before = snapshot(tmp_path)
    assert name.split("/")[0] in error_of(command(image_path=few, output_path=out, overwrite=True).run)
    assert snapshot(tmp_path) == before


def test_a_foreign_image_among_ours_is_kept(tmp_path: Path, few: Path) -> None:
    out = tmp_path / "out"
    command(image_path=few, output_path=out).run()
    (out / "images" / "mine.jpg").write_text("the user's")
    before = snapshot(tmp_path)
    assert "mine.jpg" in error_of(command(image_path=few, output_path=out, overwrite=True).run)
    assert snapshot(tmp_path) == before


def test_input_is_never_in_the_output(tmp_path: Path, few: Path) -> None:
    workspace = tmp_path / "workspace"
    shutil.copytree(few, workspace / "images")
    before = snapshot(workspace)
    for out in (workspace, workspace / "images", workspace / "images" / "chosen"):
        error_of(command(image_path=workspace / "images", output_path=out, overwrite=True).run)
    error_of(command(image_path=workspace / "images" / "b", output_path=workspace, overwrite=True).run)
    assert snapshot(workspace) == before


@pytest.mark.parametrize("exists", [True, False])
@pytest.mark.parametrize("stop", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_nothing_is_half_written(
    tmp_path: Path, few: Path, monkeypatch: pytest.MonkeyPatch, stop: BaseException, exists: bool
) -> None:
    out = tmp_path / "out"
    if exists:
        command(image_path=few, output_path=out).run()
    before = snapshot(tmp_path)
    copyfile, copied = shutil.copyfile, []

    def copy_two(source: Path, destination: Path) -> None:
        if len(copied) == 2:
            raise stop
        copied.append(source)
        copyfile(source, destination)

    monkeypatch.setattr(shutil, "copyfile", copy_two)
    run = command(image_path=few, output_path=out, overwrite=exists, num_images=4).run
    if isinstance(stop, OSError):
        assert "No space left" in error_of(run)
    else:
        with pytest.raises(KeyboardInterrupt):
            run()
    assert len(copied) == 2
    assert snapshot(tmp_path) == before
    assert out.exists() == exists


@pytest.mark.parametrize("call", range(8))
def test_a_failing_exchange_puts_everything_back(
    tmp_path: Path, few: Path, monkeypatch: pytest.MonkeyPatch, call: int
) -> None:
    """Four files are moved aside and four in; whichever fails."""
    out = tmp_path / "out"
    command(image_path=few, output_path=out).run()
    before = snapshot(tmp_path)
    replace, calls = os.replace, []

    def fail_once(source: Path, destination: Path) -> None:
        inside = Path(source).parent == out or Path(destination).parent == out
        if inside and Path(source).name in ("images", "image_list.txt", "selection.json", "selection.png"):
            calls.append(source)
            if len(calls) == call + 1:
                raise OSError(errno.EIO, "Input/output error")
        replace(source, destination)

    monkeypatch.setattr(os, "replace", fail_once)
    assert "Input/output" in error_of(command(image_path=few, output_path=out, overwrite=True, num_images=3).run)
    assert len(calls) > call
    assert snapshot(tmp_path) == before
    assert {p.name for p in out.iterdir()} == {"images", "image_list.txt", "selection.json", "selection.png"}


def test_bad_input(tmp_path: Path, few: Path, fixed: Sequence) -> None:
    out = tmp_path / "out"

    def refused(**options: Any) -> str:
        before = snapshot(tmp_path)
        message = error_of(lambda: command(output_path=out, **options).run())
        assert snapshot(tmp_path) == before and not out.exists()
        return message

    assert "--image_path" in refused()
    assert "--image_path" in refused(image_path=few, video_path=few)
    assert "images have no time" in refused(image_path=few, end_time=3.0)
    assert "no folder" in refused(image_path=tmp_path / "missing")
    assert "num_images" in refused(image_path=few, num_images=1)
    assert "min_num_features" in refused(image_path=few, min_num_features=0)
    assert "frame_step" in refused(image_path=few, frame_step=0)
    assert "one frame only" in refused(image_path=few, frame_step=20)
    assert "100000 features" in refused(image_path=few, min_num_features=100000)
    (tmp_path / "video.mp4").write_bytes(b"no video")
    assert "video.mp4" in refused(video_path=tmp_path / "video.mp4")
    black = tmp_path / "black"
    write(black, [np.zeros((HEIGHT, WIDTH), np.uint8)] * 3)
    for scenario in ("fixed_camera", "static_interface"):
        assert "features" in refused(image_path=black, scenario=scenario)
    assert "lost track" in refused(image_path=few, reference_image=f"a é/{name_of(7)}")
    still = tmp_path / "still"
    write(still, [fixed.frames[0]] * 3)
    for scenario in ("fixed_camera", "static_interface"):
        assert "2 too similar" in refused(image_path=still, scenario=scenario)
    (few / "b" / "bad.png").write_bytes(b"no image")
    assert "bad.png" in refused(image_path=few)
    write(few / "b", [np.zeros((HEIGHT, WIDTH + 1), np.uint8)])
    (few / "b" / "bad.png").unlink()
    assert "one size" in refused(image_path=few)


def test_an_output_that_is_a_file(tmp_path: Path, few: Path) -> None:
    (tmp_path / "out").write_text("the user's")
    assert "is a file" in error_of(command(image_path=few, output_path=tmp_path / "out", overwrite=True).run)
    assert (tmp_path / "out").read_text() == "the user's"
