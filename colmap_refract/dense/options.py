"""What a user can ask for when points are made dense."""

from __future__ import annotations

import math
from dataclasses import dataclass

from colmap_refract.errors import RefractError

MOST_NODES = 250_000
"""Of the grid, where the step is not given."""
_FINEST_STEP = 2
_DEEPEST = 16
_LEAST_SIZE = 100
_MIN_ANGLE_DEG, _MIN_ANGLE_FIXED_DEG = 0.5, 0.05


@dataclass(frozen=True, kw_only=True)
class DenseOptions:
    """How dense points are matched, triangulated and filtered. Lengths in pixels where nothing else is said."""

    reference_image: str = ""
    """Name of the image whose grid is matched. By default the one that sees most of the sparse points."""
    num_references: int = 1
    """Images whose grids are matched, one after the other, each where the ones before have left no points."""
    max_num_images: int = 16
    """Images that a reference is matched with, at most: those that share most points with it at a good angle."""
    max_image_size: int = 2000
    """Larger images are matched in copies of so many pixels along their longer side; step and the limits of matches
    count the copies' pixels."""
    step: int = 0
    """Between the nodes of the grid. 0: 2, or more in large images, so that there are 250 000 nodes at most."""
    window_size: int = 15
    """Width of the square around a node that is compared. Smaller shows more detail, and more noise."""
    max_error: float = 0.5
    """A match is kept if it leads forth to the other image and back to within this distance of its node."""
    min_correlation: float = 0.8
    """A match is kept if the squares at its ends, once their deformation is undone, correlate as much (at most 1)."""
    min_num_views: int = 3
    """A point is kept if so many images see it, the reference among them."""
    max_reproj_error: float = 1.0
    """Matches whose reprojection error is larger are left out of a point."""
    min_tri_angle: float | None = None
    """Points whose refracted rays meet at a smaller angle, degrees, are removed.
    By default 0.5, and 0.05 with a fixed camera."""
    max_depth_error: float = 0.02
    """Points whose depth differs by a larger part from the median of their neighbours are removed."""

    def __post_init__(self) -> None:
        for name in ("num_references", "max_num_images"):
            if getattr(self, name) < 1:
                raise RefractError(f"{name} {getattr(self, name)} is too few: give 1 or more")
        if self.max_image_size < _LEAST_SIZE:
            raise RefractError(f"max_image_size {self.max_image_size} is too small: give {_LEAST_SIZE} or more pixels")
        if not (self.step == 0 or 1 <= self.step <= 100):
            raise RefractError(f"step {self.step} is not from 1 to 100 pixels, nor 0, for what the size asks for")
        if not 5 <= self.window_size <= 101:
            raise RefractError(f"window_size {self.window_size} is not from 5 to 101 pixels")
        if not 0 < self.max_error <= 10:
            raise RefractError(f"max_error {self.max_error:g} is not above 0 and at most 10 pixels")
        if not -1 <= self.min_correlation < 1:
            raise RefractError(f"min_correlation {self.min_correlation:g} is not from -1 to below 1")
        if self.min_num_views < 2:
            raise RefractError(f"min_num_views {self.min_num_views} is too few: give 2 or more")
        if not 0 < self.max_reproj_error < math.inf:
            raise RefractError(f"max_reproj_error {self.max_reproj_error:g} is not positive; give pixels, usually 1")
        if self.min_tri_angle is not None and not 0 <= self.min_tri_angle < 180:
            raise RefractError(f"min_tri_angle {self.min_tri_angle:g} is not from 0 to below 180 degrees")
        if not 0 < self.max_depth_error < math.inf:
            raise RefractError(f"max_depth_error {self.max_depth_error:g} is not positive; give a part, usually 0.02")

    @property
    def half_window(self) -> int:
        """Pixels from a node to the edge of its square."""
        return self.window_size // 2

    def min_angle(self, scenario: str) -> float:
        """`min_tri_angle` with its default, which is the refiner's, degrees."""
        if self.min_tri_angle is not None:
            return self.min_tri_angle
        return _MIN_ANGLE_FIXED_DEG if scenario == "fixed_camera" else _MIN_ANGLE_DEG

    def step_for(self, width: int, height: int) -> int:
        """`step` with its default for an image of a size."""
        return self.step or max(_FINEST_STEP, math.ceil(math.sqrt(width * height / MOST_NODES)))


@dataclass(frozen=True, kw_only=True)
class PoissonMeshingOptions:
    """How points become a mesh; names and meanings are COLMAP's."""

    point_weight: float = 1.0
    """Weight of passing through the points against following their normals. 0: normals alone."""
    depth: int = 0
    """Depth of the octree, at most: cells are 1 / 2^depth of the scene. 0: a level finer than the points are apart."""
    color: bool = True
    """Whether the mesh has the points' colors."""
    trim: float | None = None
    """The mesh is cut away where points are sparser than a cell of this depth of the octree.
    By default 1.5 levels coarser than the points are apart. 0: keep all."""
    num_threads: int = 1
    """Of the mesher; -1: as many as there are cores. More than one helps only where the cores are idle."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.point_weight) and self.point_weight >= 0):
            raise RefractError(f"point_weight {self.point_weight:g} is not a number from 0 on; COLMAP's is 1")
        if not (self.depth == 0 or 1 <= self.depth <= _DEEPEST):
            raise RefractError(f"depth {self.depth} is not from 1 to {_DEEPEST}, nor 0, for what the points ask for")
        if self.trim is not None and not 0 <= self.trim < math.inf:
            raise RefractError(f"trim {self.trim:g} is not a number from 0 on; 0 keeps all")
        if self.num_threads < 1 and self.num_threads != -1:
            raise RefractError(f"num_threads {self.num_threads} is not 1 or more, nor -1 for all cores")
