"""Surfaces that are not flat, as files to look at: height maps, meshes and a page of them all.

A height map has the image's own rows and columns, made fewer: each of its pixels is the height, in model units, where
the ray through the middle of that part of the image meets the surface, along the normal of the image's plane and
positive towards the water. It is not a number where the ray does not meet the surface within the rectangle of the
surface's nodes: beyond it nothing was seen that would tell the heights.

A mesh has a vertex for every second pixel of every second row, in the model's world coordinates, with its height; its
triangles are counter-clockwise as seen from the camera. Colours are the same in all files of a model: red towards the
camera, white on the plane, blue towards the water.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.files.sidecar import ImageInterface, Sidecar
from colmap_refract.files.surface_files import (
    HEIGHTS_SUFFIX,
    MESH_SUFFIX,
    OVERVIEW_NAME,
    SURFACES_NAME,
    surface_stems,
)
from colmap_refract.files.surface_picture import color_of, overview, tiff
from colmap_refract.interface import Array

if TYPE_CHECKING:
    import pycolmap

_MAP_SIDE = 256
"""Pixels of a height map's longer side."""
_COARSER = 2
"""Of the mesh and the overview: every second pixel of the map."""
_BLOCK = 4096
_SHOWN = 99.5
"""Percentage of all heights that the colours tell apart: a single wild place would leave the others white."""


def write_surfaces(
    folder: Path,
    reconstruction: pycolmap.Reconstruction,
    sidecar: Sidecar,
    on_image: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write the surfaces of a model's images, where there are any, to `folder / "surfaces"`; otherwise nothing.

    Args:
        folder: that the model is written to, such as that of `output_folder`.
        reconstruction, sidecar: the model and its interfaces; images without a pose are passed over.
        on_image: called before each image, with how many are done, of how many.

    Raises:
        OSError: something cannot be written.
    """
    images = {
        image.name: image
        for _, image in sorted(reconstruction.images.items())
        if image.has_pose and image.name in sidecar.images and sidecar.images[image.name].surface is not None
    }
    if not images:
        return
    surfaces = folder / SURFACES_NAME
    stems = surface_stems(name for name, image in sidecar.images.items() if image.surface is not None)
    maps = []
    for done, (name, image) in enumerate(images.items()):
        on_image(done, len(images))
        heights = seen_heights(sight(image.camera), sidecar.images[name])
        path = surfaces / (stems[name] + HEIGHTS_SUFFIX)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(tiff(heights.astype(np.float32)))
        maps.append((name, heights[::_COARSER, ::_COARSER].copy()))
    seen = np.abs(np.concatenate([heights[np.isfinite(heights)] for _, heights in maps]))
    limit = float(np.percentile(seen, _SHOWN)) if len(seen) else 0.0
    limit = limit if limit > 0 else 1.0
    for name, heights in maps:
        image, interface = images[name], sidecar.images[name]
        ray = sight(image.camera)[::_COARSER, ::_COARSER]
        assert interface.distance is not None and interface.normal_in_cam is not None
        points = ((interface.distance + heights) / (ray @ np.array(interface.normal_in_cam)))[..., None] * ray
        pose = image.cam_from_world()
        in_world = (points - pose.translation) @ pose.rotation.matrix()
        (surfaces / (stems[name] + MESH_SUFFIX)).write_bytes(mesh(in_world, heights, limit))
    unit = "m" if sidecar.units.get("distance") == "metre" else "model units"
    (surfaces / OVERVIEW_NAME).write_bytes(overview(maps, limit, unit))


def sight(camera: pycolmap.Camera) -> Array:
    """Unit directions (rows, columns, 3), camera frame, through the middles of equal parts of an image.

    As many parts as there are pixels, but no more than 256 along the longer side.
    """
    size = np.array([camera.width, camera.height])
    columns, rows = np.maximum(np.round(size * min(1.0, _MAP_SIDE / size.max())), 1).astype(int).tolist()
    x, y = np.meshgrid((np.arange(columns) + 0.5) * size[0] / columns, (np.arange(rows) + 0.5) * size[1] / rows)
    ray = np.asarray(camera.cam_ray_from_img(np.column_stack([x.ravel(), y.ravel()])), dtype=np.float64)
    return ray.reshape(rows, columns, 3)


def seen_heights(directions: Array, interface: ImageInterface) -> Array:
    """Heights (rows, columns) where rays (rows, columns, 3) meet a surface; not a number beyond its nodes.

    Args:
        directions: unit, camera frame.
        interface: with a surface.
    """
    assert interface.surface is not None and interface.normal_in_cam is not None and interface.distance is not None
    surface, normal, distance = interface.surface, np.array(interface.normal_in_cam), interface.distance
    ray = directions.reshape(-1, 3)
    heights = np.full(len(ray), np.nan)
    # By blocks, for the memory of the nodes' part in each place.
    for start in range(0, len(ray), _BLOCK):
        block = slice(start, start + _BLOCK)
        local, local_distance = surface.local_planes(ray[block], normal, distance)
        with np.errstate(divide="ignore", invalid="ignore"):
            points = (local_distance / np.einsum("ni,ni->n", local, ray[block]))[:, None] * ray[block]
        heights[block] = np.where(surface.covers(points @ surface.axes), points @ normal - distance, np.nan)
    return heights.reshape(directions.shape[:2])


def mesh(points: Array, heights: Array, limit: float) -> bytes:
    """A binary PLY file of a grid's points (rows, columns, 3), coloured by heights (rows, columns); gaps where NaN."""
    there = np.isfinite(heights)
    vertices = np.zeros(
        int(there.sum()),
        dtype=[("xyz", "<f8", 3), ("rgb", "u1", 3), ("height", "<f4")],
    )
    vertices["xyz"], vertices["height"] = points[there], heights[there]
    vertices["rgb"] = color_of(heights[there], limit)
    number = np.where(there, np.cumsum(there).reshape(there.shape) - 1, 0)
    whole = there[:-1, :-1] & there[1:, :-1] & there[:-1, 1:] & there[1:, 1:]
    corner, right = number[:-1, :-1][whole], number[:-1, 1:][whole]
    below, across = number[1:, :-1][whole], number[1:, 1:][whole]
    faces = np.zeros(2 * len(corner), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"] = 3
    faces["vertices"][0::2] = np.column_stack([corner, below, right])
    faces["vertices"][1::2] = np.column_stack([right, below, across])
    header = [
        "ply", "format binary_little_endian 1.0", "comment height: model units from the plane, towards the water",
        f"element vertex {len(vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        "property float height",
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    return ("\n".join(header) + "\n").encode("ascii") + vertices.tobytes() + faces.tobytes()
