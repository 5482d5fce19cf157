"""The COLMAP database that a matcher would have made of a capture, wrong matches included."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pycolmap


def write_database(
    path: Path,
    model: pycolmap.Reconstruction,
    *,
    wrong: float = 0.0,
    seed: int = 0,
    paired: Callable[[int, int], bool] = lambda i, j: True,
    with_rigs: bool = True,
    verified: bool = True,
) -> Path:
    """Write the keypoints and pairwise matches of a model's tracks into a new COLMAP database.

    Args:
        path: where no file is yet.
        model: with tracks, such as a capture's.
        wrong: part of each pair's matches that are exchanged among themselves.
        seed: of the choice of those.
        paired: whether two images, given by their ids, are matched at all.
        with_rigs: also the model's rigs and frames, which databases of COLMAP 3 have not.
        verified: write all matches as geometrically verified, too; otherwise that is left to COLMAP.
    """
    import pycolmap

    rng = np.random.default_rng(seed)
    with closing(pycolmap.Database.open(path)) as database:
        for camera in model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        if with_rigs:
            for rig in model.rigs.values():
                database.write_rig(rig, use_rig_id=True)
            for frame in model.frames.values():
                database.write_frame(frame, use_frame_id=True)
        seen = {}
        for image_id, image in sorted(model.images.items()):
            bare = pycolmap.Image(image.name, camera_id=image.camera_id, image_id=image_id)
            if with_rigs:
                bare.frame_id = image.frame_id
            database.write_image(bare, use_image_id=True)
            points2D = list(image.points2D)
            database.write_keypoints(image_id, np.array([p.xy for p in points2D], dtype=np.float32))
            seen[image_id] = {p.point3D_id: k for k, p in enumerate(points2D) if p.has_point3D()}
        for i, j in itertools.combinations(seen, 2):
            common = sorted(set(seen[i]) & set(seen[j]))
            if not common or not paired(i, j):
                continue
            matches = np.array([(seen[i][p], seen[j][p]) for p in common], dtype=np.uint32)
            exchanged = np.flatnonzero(rng.random(len(matches)) < wrong)
            matches[exchanged, 1] = rng.permutation(matches[exchanged, 1])
            database.write_matches(i, j, matches)
            if not verified:
                continue
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED.value
            geometry.inlier_matches = matches
            database.write_two_view_geometry(i, j, geometry)
    return path
