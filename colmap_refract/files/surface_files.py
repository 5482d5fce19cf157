"""Names of the files that show surfaces which are not flat, and which files in their folder are no such.

    surfaces/IMAGE_NAME.tif    heights as the image sees them
    surfaces/IMAGE_NAME.ply    the surface in the world
    surfaces/overview.png      all of them on a page

Image names may have folders, which are made. A name that is no path below the folder, or that is in the way of another
file, is written percent-encoded instead.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from urllib.parse import quote

from colmap_refract.errors import RefractError
from colmap_refract.files.sidecar import read_sidecar

SURFACES_NAME, OVERVIEW_NAME = "surfaces", "overview.png"
HEIGHTS_SUFFIX, MESH_SUFFIX = ".tif", ".ply"
_LOOKED_AT = {".DS_Store", "Thumbs.db", "desktop.ini"}
"""What file managers leave in a folder that they have shown."""


def surface_stems(names: Iterable[str]) -> dict[str, str]:
    """By image name, the path in the folder of surfaces without its suffix, with `/` between folders."""
    names = list(names)
    files = {name + suffix for name in names for suffix in (HEIGHTS_SUFFIX, MESH_SUFFIX)} | {OVERVIEW_NAME}
    return {
        name: name
        if _is_below(name) and files.isdisjoint(map(str, PurePosixPath(name).parents))
        else quote(name, safe="", errors="surrogatepass")
        for name in names
    }


def foreign_file(folder: Path) -> Path | None:
    """Something in the place of a model's surfaces that was not written with the model, or None.

    Args:
        folder: of the model; its `refraction.json` says which images have a surface.
    """
    surfaces = folder / SURFACES_NAME
    if not os.path.lexists(surfaces):
        return None
    if surfaces.is_symlink() or not surfaces.is_dir():
        return surfaces
    try:
        images = read_sidecar(folder).images
        stems = surface_stems(name for name, image in images.items() if image.surface is not None).values()
    except RefractError:
        stems = {}.values()
    own = {stem + suffix for stem in stems for suffix in (HEIGHTS_SUFFIX, MESH_SUFFIX)} | {OVERVIEW_NAME}
    for inside in surfaces.rglob("*"):
        is_folder = inside.is_dir() and not inside.is_symlink()
        if not is_folder and inside.name not in _LOOKED_AT and inside.relative_to(surfaces).as_posix() not in own:
            return inside
    return None


def _is_below(name: str) -> bool:
    """Whether a name is the path of a file below a folder, written the one way there is."""
    path = Path(name)
    try:
        os.fsencode(name)
    except UnicodeEncodeError:
        return False
    return path.as_posix() == name and not path.anchor and ".." not in path.parts and "\0" not in name
