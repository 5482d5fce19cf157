"""The nodes of a reference image that are matched: a regular grid, so that what is found is a picture again."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array
from colmap_refract.optical_flow.field import Field


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Nodes at whole pixels, `step` apart, of a picture (height, width), and no closer to its edge than `margin`."""

    width: int
    height: int
    step: int
    margin: int

    def __post_init__(self) -> None:
        if min(self.shape) < 2:
            raise RefractError(
                f"an image of {self.width} x {self.height} pixels has no room for a grid of {self.step} pixels; "
                "give a smaller step or window_size"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of nodes."""
        rows, columns = ((side - 1 - 2 * self.margin) // self.step + 1 for side in (self.height, self.width))
        return rows, columns

    @property
    def nodes(self) -> Array:
        """(rows * columns, 2), OpenCV's pixels, row by row."""
        rows, columns = self.shape
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        return np.asarray(self.margin + self.step * np.stack([x, y], axis=-1).reshape(-1, 2), dtype=np.float64)

    def field(self, displacements: Array) -> Field:
        """The field of the whole picture with displacements (rows * columns, 2) at the nodes, linear between them."""
        rows, columns = self.shape
        y, x = np.mgrid[0 : self.height, 0 : self.width].astype(np.float32)
        x, y = (x - self.margin) / self.step, (y - self.margin) / self.step
        values = displacements.reshape(rows, columns, 2).astype(np.float32)
        return Field(np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)))
