"""Boards with corners of known place, and finding them in a picture.

A corner has the index `row * (num_columns - 1) + column`, both from 0, and lies at `(column + 1, row + 1, 0)` squares.
Which corner of a chessboard is the first depends on how it is seen; for a flat board of equal squares that makes no
difference to a calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array
from colmap_refract.photographs.images import Gray, shrink

BoardKind = Literal["chessboard", "charuco"]

DICTIONARIES = sorted({name.upper() for name in dir(cv2.aruco) if name.startswith("DICT_")})
"""Names of the ArUco dictionaries that OpenCV knows."""

_FIND_SIZE = 1600  # px, the longer side at which a chessboard is sought first
_FEWEST_MARKERS = 4  # that are no accident
_FEWEST_CORNERS = 20  # of a chessboard of unknown size; 3 x 3 and 4 x 3 are found wherever there is texture
_USUAL_MARKER = 0.75  # of a square; it only sets the window in which a corner is located


@dataclass(frozen=True, kw_only=True)
class Board:
    """A chessboard, or a ChArUco board (a chessboard with an ArUco marker in each white square).

    Attributes:
        kind: of the board.
        num_columns, num_rows: squares, not inner corners. The first row of a ChArUco board is the one with marker 0.
        marker_size: side of a marker over the side of a square; None is the usual 0.75.
        dictionary: name of the markers' ArUco dictionary, as in `DICTIONARIES`.

    Raises:
        RefractError: there is no such board.
    """

    kind: BoardKind
    num_columns: int
    num_rows: int
    marker_size: float | None = None
    dictionary: str | None = None

    def __post_init__(self) -> None:
        fewest = 4 if self.kind == "chessboard" else 3
        if min(self.num_columns, self.num_rows) < fewest:
            raise RefractError(
                f"a {self.kind} board of {self.num_columns} x {self.num_rows} squares is too small; "
                f"it needs {fewest} squares each way (num_columns and num_rows count squares)"
            )
        if self.kind == "chessboard":
            return
        if self.dictionary is None:
            raise RefractError("a charuco board needs the dictionary of its markers, e.g. --dictionary DICT_5X5_100")
        if self.dictionary not in DICTIONARIES:
            raise RefractError(f"there is no dictionary '{self.dictionary}'; give one of {', '.join(DICTIONARIES)}")
        if self.marker_size is not None and not 0 < self.marker_size < 1:
            raise RefractError(
                f"a marker of {self.marker_size:g} times the side of a square does not fit into it; "
                "give marker_size and square_size in the same unit"
            )
        num_markers, known = self.num_columns * self.num_rows // 2, _dictionary_size(self.dictionary)
        if num_markers > known:
            raise RefractError(
                f"a charuco board of {self.num_columns} x {self.num_rows} squares has {num_markers} markers, "
                f"{self.dictionary} only {known}; give the dictionary that the board was made with"
            )

    @property
    def corners(self) -> Array:
        """Places of the inner corners, (N, 3), in squares, z = 0."""
        rows, columns = np.mgrid[1 : self.num_rows, 1 : self.num_columns]
        return np.stack([columns.ravel(), rows.ravel(), np.zeros(rows.size)], axis=1).astype(np.float64)

    def __str__(self) -> str:
        markers = f" with markers of {self.dictionary}" if self.kind == "charuco" else ""
        return f"{self.kind} of {self.num_columns} x {self.num_rows} squares{markers}"


@dataclass(frozen=True, kw_only=True)
class View:
    """The corners of a board that one picture shows.

    Attributes:
        name: of the image.
        corner_idxs: (C,) indices into `Board.corners`, none twice.
        xy: (C, 2), pixels, COLMAP's origin.
    """

    name: str
    corner_idxs: NDArray[np.int64]
    xy: Array


def find_board(gray: Gray, board: Board, name: str) -> View:
    """Find a board in a picture.

    Args:
        gray: (H, W).
        board: that is sought; of a chessboard all inner corners must be seen, of a ChArUco board some.
        name: of the image.

    Returns:
        The corners that were found, none if the board was not.
    """
    idxs, xy = _find_chessboard(gray, board) if board.kind == "chessboard" else _find_charuco(gray, board)
    # OpenCV's pixels have their origin in the centre of the top-left one.
    return View(name=name, corner_idxs=idxs, xy=xy + 0.5)


@dataclass(frozen=True, kw_only=True)
class Likeness:
    """What a picture shows in place of the board that was sought.

    Attributes:
        kind: of the board.
        dictionary: of its markers, None of a chessboard.
        size: squares along a row and along a column, None if only markers were recognised.
    """

    kind: BoardKind
    dictionary: str | None = None
    size: tuple[int, int] | None = None

    @property
    def options(self) -> str:
        """The options that ask for it."""
        words = f"--board {self.kind}"
        if self.dictionary is not None:
            words += f" --dictionary {self.dictionary}"
        if self.size is not None:
            words += f" --num_columns {self.size[0]} --num_rows {self.size[1]}"
        return words


def describe_board(gray: Gray, board: Board) -> Likeness | None:
    """The board that a picture shows in place of the one that was sought.

    A single picture proves little: a few rows of dark and light spots are soon found among pebbles, and of a board
    that reaches out of the picture only a part is seen.

    Args:
        gray: (H, W), in which `board` was not found.
        board: that was sought.

    Returns:
        What is there, None if nothing was recognised.
    """
    small, _ = _reduced(gray)
    # In the order of what is likely: each of these takes about a second.
    if board.kind == "chessboard":
        return _describe_chessboard(small, board) or _describe_charuco(small, board)
    return _describe_charuco(small, board) or _describe_chessboard(small, board)


def _describe_chessboard(gray: Gray, board: Board) -> Likeness | None:
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, _, kinds = cv2.findChessboardCornersSBWithMeta(gray, (3, 3), flags)
    if not found or kinds.size < _FEWEST_CORNERS:
        return None
    rows, columns = (length + 1 for length in kinds.shape)
    if (columns < rows) != (board.num_columns < board.num_rows):
        columns, rows = rows, columns
    return Likeness(kind="chessboard", size=(columns, rows))


def _describe_charuco(gray: Gray, board: Board) -> Likeness | None:
    dictionary = board.dictionary
    if dictionary is None or _count_markers(gray, dictionary) < _FEWEST_MARKERS:
        counts = {name: _count_markers(gray, name) for name in sorted(DICTIONARIES, key=_dictionary_size)}
        dictionary = max(counts, key=lambda name: counts[name])  # of those with as many, the smallest
        if counts[dictionary] < _FEWEST_MARKERS:
            return None
    found = {}
    for columns, rows in _near(board.num_columns, board.num_rows):
        if columns * rows <= 2 * _dictionary_size(dictionary):
            other = Board(kind="charuco", num_columns=columns, num_rows=rows, dictionary=dictionary)
            found[columns, rows] = len(_find_charuco(gray, other)[0])
    size = max(found, key=lambda size: found[size]) if any(found.values()) else None
    return Likeness(kind="charuco", dictionary=dictionary, size=size)


def _find_chessboard(gray: Gray, board: Board) -> tuple[NDArray[np.int64], Array]:
    """Corner indices (C,) and OpenCV's pixels (C, 2)."""
    size = (board.num_columns - 1, board.num_rows - 1)
    small, scale = _reduced(gray)
    whole = bool((scale == 1).all())
    found, corners = cv2.findChessboardCornersSB(small, size, flags=cv2.CALIB_CB_ACCURACY)
    # What is found in the whole picture with this flag is good to a few hundredths of a pixel as it is.
    fine = found and whole
    if not found:
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        found, corners = cv2.findChessboardCornersSB(small, size, flags=flags)
    if not found and not whole:
        found, corners = cv2.findChessboardCornersSB(gray, size, flags=0)
        scale = np.ones(2)
    if not found:
        return np.empty(0, np.int64), np.empty((0, 2))
    xy = (np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) * scale - 0.5
    return np.arange(len(xy)), xy if fine else _located(gray, xy, size)


def _located(gray: Gray, xy: Array, size: tuple[int, int]) -> Array:
    """Corners of a chessboard moved to where the grey values say, in windows of a third of a square."""
    grid = xy.reshape(size[1], size[0], 2)
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    half = int(np.clip(min(sides) / 3, 2, 40))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    start = np.asarray(xy, np.float32).reshape(-1, 1, 2)
    return np.asarray(cv2.cornerSubPix(gray, start, (half, half), (-1, -1), criteria), np.float64).reshape(-1, 2)


def _find_charuco(gray: Gray, board: Board) -> tuple[NDArray[np.int64], Array]:
    """Corner indices (C,) and OpenCV's pixels (C, 2)."""
    best = np.empty(0, np.int64), np.empty((0, 2))
    for detector in _charuco_detectors(board):
        corners, idxs, _, _ = detector.detectBoard(gray)
        if corners is not None and len(corners) > len(best[0]):
            best = np.asarray(idxs, np.int64).ravel(), np.asarray(corners, np.float64).reshape(-1, 2)
    return best


@cache
def _charuco_detectors(board: Board) -> list[Any]:
    """With an even number of rows, boards made before OpenCV 4.6 begin with a white square, later ones with a black."""
    detectors = []
    for legacy in (False, True) if board.num_rows % 2 == 0 else (False,):
        size, marker = (board.num_columns, board.num_rows), board.marker_size or _USUAL_MARKER
        pattern = cv2.aruco.CharucoBoard(size, 1.0, marker, _dictionary(str(board.dictionary)))
        pattern.setLegacyPattern(legacy)
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        detectors.append(cv2.aruco.CharucoDetector(pattern, cv2.aruco.CharucoParameters(), parameters))
    return detectors


def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _dictionary_size(name: str) -> int:
    return len(_dictionary(name).bytesList)


def _count_markers(gray: Gray, dictionary: str) -> int:
    _, idxs, _ = cv2.aruco.ArucoDetector(_dictionary(dictionary)).detectMarkers(gray)
    return 0 if idxs is None else len(idxs)


def _near(num_columns: int, num_rows: int) -> list[tuple[int, int]]:
    """Sizes that are easily taken for another: turned, inner corners for squares, one miscounted."""
    sizes = [(num_columns, num_rows), (num_rows, num_columns)]
    near = [(columns + a, rows + b) for columns, rows in sizes for a, b in product((0, 1, -1), repeat=2)]
    return [size for size in dict.fromkeys(near) if min(size) >= 3]


def _reduced(gray: Gray) -> tuple[Gray, Array]:
    """A picture of at most `_FIND_SIZE`, and what its pixels measure in those of the given one (x, y)."""
    small = shrink(gray, _FIND_SIZE)
    return small, np.divide(gray.shape, small.shape)[::-1]
