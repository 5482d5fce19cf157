"""Looking for a board in a folder of images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from colmap_refract.calibration.boards import Board, View, describe_board, find_board
from colmap_refract.errors import RefractError
from colmap_refract.photographs.images import check_images, common_size, list_images, read_gray

_LOOKED_AT = 3  # images, for another board than the one that was sought


def find_boards(folder: Path, board: Board, watch: Callable[[str], None]) -> tuple[list[View], tuple[int, int]]:
    """Find a board in the images of a folder.

    Args:
        folder: of images by one camera.
        board: that they show.
        watch: is told what is being done.

    Returns:
        A view per image, without corners where the board was not found, and the images' width and height.

    Raises:
        RefractError: there is no image, one cannot be read, their sizes differ, or the board is in none of them.
    """
    names = list_images(folder)
    watch(f"Reading {len(names)} images ...")
    size = common_size(check_images(folder, names))
    views: list[View] = []
    for number, name in enumerate(names, 1):
        found = sum(len(view.xy) > 0 for view in views)
        watch(f"Image {number} of {len(names)}: {name} (the board was found in {found})")
        views.append(find_board(read_gray(folder / name), board, name))
    if not any(len(view.xy) for view in views):
        watch("Looking for another board ...")
        raise _not_found(folder, names, board)
    return views, size


def _not_found(folder: Path, names: list[str], board: Board) -> RefractError:
    what = (
        f"the board was found in none of the {len(names)} images of {folder}; it was to be a {board} "
        "(num_columns and num_rows count squares, not inner corners)"
    )
    for index in np.unique(np.linspace(0, len(names) - 1, _LOOKED_AT).astype(int)):
        options = describe_board(read_gray(folder / names[index]), board)
        if options is not None:
            return RefractError(f"{what}; what '{names[index]}' shows asks for {options}")
    seen = "all of it with a white rim" if board.kind == "chessboard" else "a good part of it"
    return RefractError(f"{what}; check these options, and take sharp, evenly lit pictures that show {seen}")
