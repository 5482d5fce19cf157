"""Looking for a board in a folder of images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from colmap_refract.calibration.boards import Board, Likeness, View, describe_board, find_board
from colmap_refract.errors import RefractError
from colmap_refract.photographs.images import check_images, common_size, list_images, read_gray

_LOOKED_AT = 5  # images, for another board than the one that was sought
_WITHOUT_ANY = 2  # that show no board at all, after which the search is given up: it takes seconds for each
_MOST = 0.6  # of those, that have to agree on a smaller board
_FEW = 0.5  # of the images; where the board is in fewer, another may have been meant


def find_boards(folder: Path, board: Board, watch: Callable[[str], None]) -> tuple[list[View], tuple[int, int]]:
    """Find a board in the images of a folder.

    Args:
        folder: of images by one camera.
        board: that they show.
        watch: is told what is being done.

    Returns:
        A view per image, without corners where the board was not found, and the images' width and height.

    Raises:
        RefractError: there is no image, one cannot be read, their sizes differ, the board is in none of them, or in
            few while another is in the others.
    """
    names = list_images(folder)
    watch(f"Reading {len(names)} images ...")
    size = common_size(check_images(folder, names))
    views: list[View] = []
    for number, name in enumerate(names, 1):
        found = sum(len(view.xy) > 0 for view in views)
        watch(f"Image {number} of {len(names)}: {name} (the board was found in {found})")
        views.append(find_board(read_gray(folder / name), board, name))
    found = sum(len(view.xy) > 0 for view in views)
    if found < _FEW * len(views):
        watch("Looking for another board ...")
        without = [view.name for view in views if not len(view.xy)]
        other = _other_board(folder, without, board, found)
        if found == 0:
            raise _not_found(folder, len(names), board, other)
        if other is not None:
            raise RefractError(
                f"the board was found in only {found} of the {len(names)} images of {folder}; it was to be a {board}, "
                f"but what the others show asks for {other.options} (num_columns and num_rows count squares, not inner "
                "corners)"
            )
    return views, size


def _other_board(folder: Path, without: list[str], board: Board, found: int) -> Likeness | None:
    """What most of the images without the board show in its place, None if there is no such thing.

    Args:
        folder: of the images.
        without: names of those in which the board was not found.
        board: that was sought.
        found: number of images in which it was found.
    """
    places = np.unique(np.linspace(0, len(without) - 1, _LOOKED_AT).astype(int))
    shown: Counter[Likeness] = Counter()
    for looked_at, place in enumerate(places):
        if looked_at == _WITHOUT_ANY and not shown:
            return None
        likeness = describe_board(read_gray(folder / without[place]), board)
        if likeness is not None:
            shown[likeness] += 1
    if not shown:
        return None
    other, count = shown.most_common(1)[0]
    # One picture says something only where there is no other.
    if count < min(2, len(places)) or (len(places) == 1 and other.size is None):
        return None
    # Of boards that reach out of the image a part is seen, a different one in most pictures.
    part = (
        other.kind == board.kind == "chessboard"
        and other.size is not None
        and all(np.sort(other.size) <= np.sort([board.num_columns, board.num_rows]))
    )
    if found == 0:
        return None if part and count <= _MOST * len(places) else other
    # A chessboard that was found as a whole is no smaller one.
    return None if part or count / len(places) * len(without) <= found else other


def _not_found(folder: Path, count: int, board: Board, other: Likeness | None) -> RefractError:
    what = (
        f"the board was found in none of the {count} images of {folder}; it was to be a {board} "
        "(num_columns and num_rows count squares, not inner corners)"
    )
    if other is not None:
        return RefractError(f"{what}; what they show asks for {other.options}")
    seen = "all of it with a white rim" if board.kind == "chessboard" else "a good part of it"
    return RefractError(f"{what}; check these options, and take sharp, evenly lit pictures that show {seen}")
