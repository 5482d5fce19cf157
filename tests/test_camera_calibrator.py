"""`camera_calibrator` from pictures to files: rendered photographs of boards, whose camera is known.

The renderer goes from each part of a pixel along COLMAP's ray to the board, so that where a pixel's centre lies is
COLMAP's convention, not OpenCV's. What it does not show: how real lenses, lamps and paper differ from it.
"""

from __future__ import annotations

import errno
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_refract.calibration.boards import Board, describe_board, find_board
from colmap_refract.calibration.search import find_boards
from colmap_refract.commands.camera_calibrator import CameraCalibrator
from colmap_refract.errors import RefractError
from colmap_refract.files.cameras_file import read_cameras
from colmap_refract.interface import Array

Picture = NDArray[np.uint8]
Texture = Callable[[Array, Array], Array]

COLUMNS, ROWS = 9, 7
DICTIONARY = "DICT_5X5_100"
SIZE = (480, 360)
PARTS = 2  # of a pixel, each way
GREY = 120.0
TRUTH = {
    "OPENCV": [392.0, 389.0, 244.3, 176.2, -0.21, 0.06, 0.0012, -0.0008],
    "OPENCV_FISHEYE": [205.0, 206.0, 242.3, 177.7, -0.02, 0.004, 0.0, 0.0],
}


# Three views of a lens that this model does not quite fit.
FEW: dict[str, object] = {"camera_model": "SIMPLE_RADIAL", "max_view_error": 2.0}


def camera_of(model: str) -> pycolmap.Camera:
    return pycolmap.Camera(camera_id=1, model=model, width=SIZE[0], height=SIZE[1], params=TRUTH[model])


def chessboard(x: Array, y: Array, columns: int = COLUMNS, rows: int = ROWS) -> Array:
    """Grey of a chessboard at places in squares, with a white rim a square wide."""
    black = ((np.floor(x) + np.floor(y)) % 2 == 0) & (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
    paper = (x > -1) & (y > -1) & (x < columns + 1) & (y < rows + 1)
    return np.where(black, 30.0, np.where(paper, 225.0, GREY))


def smaller_board(x: Array, y: Array) -> Array:
    """A square less each way, as somebody has it who takes inner corners for squares."""
    return chessboard(x, y, COLUMNS - 1, ROWS - 1)


def charuco() -> Texture:
    """The same with markers, drawn by OpenCV."""
    fine = 80
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    board = cv2.aruco.CharucoBoard((COLUMNS, ROWS), 1.0, 0.75, dictionary)
    drawn = 30 + 195 / 255 * board.generateImage((COLUMNS * fine, ROWS * fine), marginSize=0).astype(float)

    def texture(x: Array, y: Array) -> Array:
        inside = (x >= 0) & (y >= 0) & (x < COLUMNS) & (y < ROWS)
        row = np.clip(y * fine, 0, ROWS * fine - 1).astype(int)
        column = np.clip(x * fine, 0, COLUMNS * fine - 1).astype(int)
        return np.where(inside, drawn[row, column], GREY)

    return texture


class Renderer:
    """Photographs of a plane by one camera."""

    def __init__(self, camera: pycolmap.Camera) -> None:
        self.camera = camera
        across, down = ((np.arange(PARTS * length) + 0.5) / PARTS for length in SIZE)
        self._rays = camera.cam_ray_from_img(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))

    def __call__(self, texture: Texture, rotation: Array, translation: Array, rng: np.random.Generator) -> Picture:
        """With noise of two grey values, for a pose `cam_from_board`."""
        hit = self._rays @ np.linalg.inv(np.column_stack([rotation[:, :2], translation])).T
        front = hit[:, 2] > 1e-6
        x, y = (hit[:, axis] / np.where(front, hit[:, 2], 1.0) for axis in (0, 1))
        parts = np.where(front, texture(x, y), GREY)
        grey = parts.reshape(SIZE[1], PARTS, SIZE[0], PARTS).mean(axis=(1, 3))
        blurred = cv2.GaussianBlur(grey, (0, 0), 0.9)
        return np.clip(np.rint(blurred + 2 * rng.normal(size=grey.shape)), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Photographs:
    """A folder of photographs and the camera that they were taken with."""

    folder: Path
    camera: pycolmap.Camera


def photograph(folder: Path, model: str, texture: Texture, whole: bool, count: int) -> Photographs:
    """Photographs of a board that is tilted by up to some 40 degrees, anywhere in the image."""
    rng = np.random.default_rng(4)
    camera = camera_of(model)
    render = Renderer(camera)
    middle = np.array([COLUMNS / 2, ROWS / 2, 0])
    rim = [-0.8, COLUMNS + 0.8], [-0.8, ROWS + 0.8]
    outline = np.array([[x, y, 0.0] for x in rim[0] for y in rim[1]])
    wide = "FISHEYE" in model
    folder.mkdir()
    taken = 0
    while taken < count:
        place = rng.uniform(0.1, 0.9, size=2) * SIZE
        direction = camera.cam_ray_from_img(place[None])[0]
        # Turned to where it is seen, as somebody holds it, and then tilted.
        facing = Rotation.align_vectors(direction[None], [[0.0, 0.0, 1.0]])[0]
        rotation = (facing * Rotation.from_rotvec(rng.uniform(-0.55, 0.55, size=3))).as_matrix()
        translation = direction * (rng.uniform(4.5, 7) if wide else rng.uniform(6, 11)) - rotation @ middle
        if whole:
            seen = camera.img_from_cam(outline @ rotation.T + translation)
            if not ((seen > 2) & (seen < np.array(SIZE) - 2)).all():
                continue
        picture = render(texture, rotation, translation, rng)
        cv2.imwrite(str(folder / f"board_{taken:02d}.png"), picture)
        taken += 1
    return Photographs(folder, camera)


@pytest.fixture(scope="session")
def chessboards(tmp_path_factory: pytest.TempPathFactory) -> Photographs:
    return photograph(tmp_path_factory.mktemp("chessboard") / "images", "OPENCV", chessboard, True, 12)


@pytest.fixture(scope="session")
def charucos(tmp_path_factory: pytest.TempPathFactory) -> Photographs:
    return photograph(tmp_path_factory.mktemp("charuco") / "images", "OPENCV_FISHEYE", charuco(), False, 12)


def calibrator(images: Path, output: Path, **options: object) -> CameraCalibrator:
    usual = {"board": "chessboard", "num_columns": COLUMNS, "num_rows": ROWS}
    return CameraCalibrator(image_path=images, output_path=output, **{**usual, **options})  # type: ignore[arg-type]


def fails(command: CameraCalibrator) -> str:
    """The one line of a run that fails and leaves nothing behind."""
    before = sorted(command.output_path.parent.rglob("*"))
    with pytest.raises(RefractError) as raised:
        command.run()
    assert sorted(command.output_path.parent.rglob("*")) == before
    assert "\n" not in str(raised.value)
    return str(raised.value)


def assert_true_within_its_deviations(folder: Path, truth: pycolmap.Camera) -> None:
    """What was written against the camera that took the pictures, by parameters and by pixels."""
    (camera,) = read_cameras(folder).values()
    known = json.loads((folder / "calibration.json").read_text())
    std = np.array([param["std"] for param in known["camera"]["params"].values()])
    assert (camera.model, camera.width, camera.height) == (truth.model, *SIZE)
    # 8 parameters, so 3 deviations happen now and then; corners that are found with a bias make it a little more.
    assert (np.abs(camera.params - truth.params) < 4 * std).all()
    # A wrong origin would be 0.5 px, three deviations at least.
    assert (std[2:4] < 0.17).all()
    np.testing.assert_allclose(camera.params[2:4], truth.params[2:4], atol=0.3)
    # The same directions are seen at the same pixels where the board was.
    middle = np.stack(np.meshgrid(np.linspace(60, 420, 9), np.linspace(60, 300, 9)), axis=-1).reshape(-1, 2)
    rays = truth.cam_ray_from_img(middle)
    assert np.abs(camera.img_from_cam(rays) - middle).max() < 0.5


def test_chessboard(chessboards: Photographs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "calibration"
    calibrator(chessboards.folder, output, square_size=0.03).run()
    out, err = capsys.readouterr()
    assert err == ""
    assert {path.name for path in output.iterdir()} == {"cameras.txt", "calibration.json", "coverage.png"}
    assert_true_within_its_deviations(output, chessboards.camera)
    # pycolmap's own reader has the last word on the file's form; it reads whole models only.
    for name in ("images.txt", "points3D.txt"):
        (output / name).write_text("")
    read = pycolmap.Reconstruction(output)
    assert read.camera(1).params.tolist() == read_cameras(output)[1].params.tolist()

    known = json.loads((output / "calibration.json").read_text())
    assert len(known["views"]) == 12
    assert all(view["num_corners"] == (COLUMNS - 1) * (ROWS - 1) for view in known["views"].values())
    assert 0.01 < known["rms_error_px"] < 0.15
    assert known["coverage"]["distance_m"][1] == pytest.approx(0.03 * known["coverage"]["distance_squares"][1])
    assert 5.5 < known["coverage"]["distance_squares"][0] < known["coverage"]["distance_squares"][1] < 11.5

    picture = cv2.imread(str(output / "coverage.png"))
    assert picture is not None and min(picture.shape[:2]) > 500
    for name in ("fx", "fy", "cx", "cy"):
        assert re.search(rf"^{name} +[0-9.]+ \+- [0-9.]+ px$", out, re.MULTILINE)
    assert re.search(r"^board_00.png +48 +[0-9.]+ +[0-9.]+$", out, re.MULTILINE)
    assert re.search(r"^Reprojection error: +[0-9.]+ px \(rms\)", out, re.MULTILINE)
    assert "squares of 30 mm" in out and " m)" in out
    assert str(output) in out.splitlines()[-1]


def test_charuco_with_a_fisheye(charucos: Photographs, tmp_path: Path) -> None:
    """Boards that reach out of the image are found in part."""
    output = tmp_path / "calibration"
    options = {"square_size": 0.04, "marker_size": 0.03, "dictionary": DICTIONARY}
    calibrator(charucos.folder, output, board="charuco", camera_model="OPENCV_FISHEYE", **options).run()
    assert_true_within_its_deviations(output, charucos.camera)
    counts = [view["num_corners"] for view in json.loads((output / "calibration.json").read_text())["views"].values()]
    assert 6 <= min(counts) < max(counts)


@pytest.fixture
def images(chessboards: Photographs, tmp_path: Path) -> Path:
    """A folder with three of the photographs, to be spoiled."""
    folder = tmp_path / "boards"
    folder.mkdir()
    for name in ("board_00.png", "board_01.png", "board_02.png"):
        (folder / name).write_bytes((chessboards.folder / name).read_bytes())
    return folder


def test_turned_images_stay_as_they_are_stored(images: Path, tmp_path: Path) -> None:
    """COLMAP reads pixels as they are stored, whatever EXIF says of the orientation."""
    for path in images.glob("*.png"):
        picture = cv2.imread(str(path))
        assert picture is not None
        data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        # An EXIF block with nothing but orientation 6, a quarter turn.
        exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
        block = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
        path.with_suffix(".jpg").write_bytes(data[:2] + block + data[2:])
        path.unlink()
    turned = cv2.imread(str(images / "board_00.jpg"))
    assert turned is not None and turned.shape[:2] == SIZE  # OpenCV obeys unless told not to
    calibrator(images, tmp_path / "out", **FEW).run()
    (camera,) = read_cameras(tmp_path / "out").values()
    assert (camera.width, camera.height) == SIZE


def test_few_views_are_not_trusted(images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calibrator(images, tmp_path / "out", **FEW).run()
    out = capsys.readouterr().out
    assert "Not to be trusted" in out and "WARNING: Only 3 views were used" in out
    assert json.loads((tmp_path / "out" / "calibration.json").read_text())["warnings"]


def test_a_picture_without_a_board_is_said_and_passed_over(images: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(images / "sea.png"), np.full(SIZE[::-1], 90, np.uint8))
    calibrator(images, tmp_path / "out", **FEW).run()
    views = json.loads((tmp_path / "out" / "calibration.json").read_text())["views"]
    assert (views["sea.png"]["kept"], views["sea.png"]["reason"]) == (False, "the board was not found")
    assert sum(view["kept"] for view in views.values()) == 3


def test_other_boards_than_the_one_asked_for(images: Path, charucos: Photographs, tmp_path: Path) -> None:
    line = fails(calibrator(images, tmp_path / "out", num_columns=COLUMNS - 1, num_rows=ROWS - 1))
    assert "squares, not inner corners" in line
    assert f"--board chessboard --num_columns {COLUMNS} --num_rows {ROWS}" in line

    options = {"board": "charuco", "dictionary": DICTIONARY, "num_columns": ROWS, "num_rows": COLUMNS}
    (tmp_path / "marked").mkdir()
    name = "board_00.png"
    (tmp_path / "marked" / name).write_bytes((charucos.folder / name).read_bytes())
    line = fails(calibrator(tmp_path / "marked", tmp_path / "out", **options))
    assert f"--dictionary {DICTIONARY} --num_columns {COLUMNS} --num_rows {ROWS}" in line
    # Those of 50 and of 100 markers begin with the same ones.
    options = {"board": "charuco", "dictionary": "DICT_6X6_250"}
    line = fails(calibrator(tmp_path / "marked", tmp_path / "out", **options))
    assert f"--dictionary DICT_5X5_50 --num_columns {COLUMNS} --num_rows {ROWS}" in line


def test_another_board_in_most_images(images: Path, tmp_path: Path) -> None:
    """Three views are enough to calibrate from, but not where most others show that another board was meant."""
    small = photograph(tmp_path / "small", "OPENCV", smaller_board, True, 4).folder
    sizes = {"num_columns": COLUMNS - 1, "num_rows": ROWS - 1}
    for index in range(3):
        (images / f"small_{index}.png").write_bytes((small / f"board_{index:02d}.png").read_bytes())
    # Half of the images: nothing is said.
    views, _ = find_boards(images, Board(kind="chessboard", **sizes), lambda _: None)
    assert [view.name for view in views if len(view.xy)] == ["small_0.png", "small_1.png", "small_2.png"]
    (images / "small_2.png").unlink()
    line = fails(calibrator(images, tmp_path / "out", **sizes))
    assert "only 2 of the 5 images" in line
    assert f"--board chessboard --num_columns {COLUMNS} --num_rows {ROWS}" in line
    # A smaller one in the others may be the part that they show of the one that was sought.
    for index in range(2, 4):
        (images / f"small_{index}.png").write_bytes((small / f"board_{index:02d}.png").read_bytes())
    calibrator(images, tmp_path / "out", **FEW).run()


def test_what_one_picture_of_many_shows_is_no_advice(images: Path, tmp_path: Path) -> None:
    """Texture looks like some board now and then, not like the same one."""
    for name in ("board_01.png", "board_02.png"):
        cv2.imwrite(str(images / name), np.full(SIZE[::-1], 90, np.uint8))
    line = fails(calibrator(images, tmp_path / "out", num_columns=COLUMNS - 1, num_rows=ROWS - 1))
    assert "asks for" not in line and "white rim" in line


def test_a_few_squares_are_no_board() -> None:
    """Four by three corners are found among pebbles; five by four are a board, if others show them as well."""
    board = Board(kind="chessboard", num_columns=COLUMNS, num_rows=ROWS)
    down, across = np.mgrid[:400, :500] / 50 - 1.5
    for columns, rows, size in ((4, 4, None), (5, 4, None), (6, 5, (6, 5))):
        picture = np.asarray(chessboard(across, down, columns, rows), np.uint8)
        likeness = describe_board(cv2.GaussianBlur(picture, (0, 0), 0.9), board)
        assert (likeness and likeness.size) == size


def test_no_board_at_all(tmp_path: Path) -> None:
    (tmp_path / "boards").mkdir()
    cv2.imwrite(str(tmp_path / "boards" / "sea.png"), np.full(SIZE[::-1], 90, np.uint8))
    line = fails(calibrator(tmp_path / "boards", tmp_path / "out"))
    assert "in none of the 1 images" in line and "white rim" in line


def test_images_that_cannot_be_used(images: Path, tmp_path: Path) -> None:
    (images / "torn.jpg").write_bytes((images / "board_00.png").read_bytes()[:200])
    assert "torn.jpg" in fails(calibrator(images, tmp_path / "out"))
    (images / "torn.jpg").unlink()
    cv2.imwrite(str(images / "upright.png"), np.full(SIZE, 90, np.uint8))
    line = fails(calibrator(images, tmp_path / "out"))
    assert "upright.png" in line and "board_00.png" in line
    (tmp_path / "empty").mkdir()
    assert "no image" in fails(calibrator(tmp_path / "empty", tmp_path / "out"))
    (images / "upright.png").unlink()
    (images / "board_02.png").unlink()
    assert "2 of 2 views" in fails(calibrator(images, tmp_path / "out"))


def test_folders_that_a_calibration_must_not_be_written_to(images: Path, tmp_path: Path) -> None:
    assert "among the images" in fails(calibrator(images, images / "out"))
    assert "is the input" in fails(calibrator(images, images, overwrite=True))
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "points3D.bin").write_bytes(b"of the user")
    assert "holds a COLMAP model" in fails(calibrator(images, tmp_path / "model", overwrite=True))
    # Without a calibration of ours, nothing is mixed with what is there.
    (tmp_path / "foreign").mkdir()
    for name, text in (("notes.txt", "of the user"), ("calibration.json", '{"format": "of another program"}')):
        (tmp_path / "foreign" / name).write_text(text)
        for overwrite in (False, True):
            line = fails(calibrator(images, tmp_path / "foreign", overwrite=overwrite))
            assert "no earlier calibration" in line and "overwrite" not in line
    (tmp_path / "empty").mkdir()
    calibrator(images, tmp_path / "empty", **FEW, overwrite=True).run()
    assert (tmp_path / "empty" / "cameras.txt").exists()


def test_overwrite(images: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    output.mkdir()
    for name in ("cameras.bin", "coverage.png", "notes.txt"):
        (output / name).write_bytes(b"earlier")
    (output / "calibration.json").write_text('{"format": "colmap_refract calibration"}')
    assert "holds an earlier calibration" in (line := fails(calibrator(images, output, **FEW)))
    assert "--overwrite 1" in line
    calibrator(images, output, **FEW, overwrite=True).run()
    # An old cameras.bin would be read in place of the new cameras.txt.
    assert {path.name for path in output.iterdir()} == {"cameras.txt", "calibration.json", "coverage.png", "notes.txt"}


def test_a_full_disk(images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(self: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device", str(self))

    monkeypatch.setattr(Path, "write_bytes", write)
    assert "No space left" in fails(calibrator(images, tmp_path / "out", **FEW))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"num_columns": 3}, "too small"),
        ({"board": "charuco"}, "--dictionary DICT_5X5_100"),
        ({"board": "charuco", "dictionary": "DICT_9X9"}, "no dictionary 'DICT_9X9'"),
        ({"board": "charuco", "dictionary": "DICT_5X5_50", "num_columns": 20}, "70 markers"),
        ({"board": "charuco", "dictionary": DICTIONARY, "square_size": 0.03, "marker_size": 0.04}, "does not fit"),
        ({"board": "charuco", "dictionary": DICTIONARY, "marker_size": 0.04}, "needs square_size"),
        ({"marker_size": 0.02, "square_size": 0.03}, "marker_size is of a charuco board"),
        ({"dictionary": DICTIONARY}, "dictionary is of a charuco board"),
        ({"square_size": -1.0}, "not positive"),
        # There are no images: these are told before any is looked for.
        ({"max_view_error": 0.0}, "max_view_error 0 px is not positive"),
        ({"max_view_error": float("nan")}, "max_view_error"),
    ],
)
def test_options_that_make_no_sense(tmp_path: Path, options: dict[str, object], words: str) -> None:
    assert words in fails(calibrator(tmp_path / "boards", tmp_path / "out", **options))


def test_a_large_picture_is_found_small_and_measured_large() -> None:
    """Squares of 150.5 pixels, drawn twice as large; a board in a picture that is not reduced by a whole number."""
    drawn = np.full((2 * 1701, 2 * 2399), 120, np.uint8)
    at, side = np.array([301, 205]), 301
    drawn[at[1] - 250 : at[1] + ROWS * side + 250, at[0] - 250 : at[0] + COLUMNS * side + 250] = 225
    for row in range(ROWS):
        for column in range(row % 2, COLUMNS, 2):
            x, y = at + side * np.array([column, row])
            drawn[y : y + side, x : x + side] = 30
    picture = cv2.resize(drawn, (2399, 1701), interpolation=cv2.INTER_AREA)
    board = Board(kind="chessboard", num_columns=COLUMNS, num_rows=ROWS)
    view = find_board(np.asarray(picture, np.uint8), board, "large.png")
    expected = (at + side * board.corners[:, :2]) / 2
    assert len(view.xy) == len(expected)
    distances = np.linalg.norm(view.xy[:, None] - expected, axis=2)
    assert sorted(distances.argmin(axis=1)) == list(range(len(expected)))
    # A forgotten half pixel, here or in the reduced picture, would be 0.25 px at least.
    assert distances.min(axis=1).max() < 0.1


def test_boards_of_before_opencv_4_6() -> None:
    """With an even number of rows they begin with the other colour; nothing has to be told."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    board = Board(kind="charuco", num_columns=8, num_rows=6, dictionary=DICTIONARY)
    for legacy in (False, True):
        drawn = cv2.aruco.CharucoBoard((8, 6), 1.0, 0.75, dictionary)
        drawn.setLegacyPattern(legacy)
        picture = np.asarray(drawn.generateImage((640, 480), marginSize=0), np.uint8)
        view = find_board(np.pad(picture, 40, constant_values=225), board, "drawn.png")
        assert len(view.xy) == len(board.corners)
        np.testing.assert_allclose(view.xy, 40 + 80 * board.corners[view.corner_idxs, :2], atol=0.6)


def test_what_is_being_done_is_told(images: Path) -> None:
    told: list[str] = []
    find_boards(images, Board(kind="chessboard", num_columns=COLUMNS, num_rows=ROWS), told.append)
    assert "board_02.png" in told[-1] and "3 of 3" in told[-1]


def test_boards_are_numbered_as_opencv_numbers_them() -> None:
    """The places of the corners, against those that OpenCV draws."""
    board = Board(kind="charuco", num_columns=COLUMNS, num_rows=ROWS, dictionary=DICTIONARY)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    drawn = cv2.aruco.CharucoBoard((COLUMNS, ROWS), 1.0, 0.75, dictionary)
    np.testing.assert_allclose(board.corners, drawn.getChessboardCorners(), atol=1e-6)
