"""The truth of a rendered capture, beside its images: what every pixel shows, and where every point is seen."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers, plane_in_cam
from colmap_refract.options import Scenario
from colmap_refract.simulation.surface import Surface
from colmap_refract.simulation.terrain import Terrain
from colmap_refract.simulation.view import View, project, trace

if TYPE_CHECKING:
    import pycolmap

TRUTH_NAME = "truth.npz"
CAMERAS_NAME = "calibration/cameras.txt"


@dataclass(frozen=True, kw_only=True)
class Truth:
    """A capture of m images as it really was. Lengths are metres, the world's z axis points down."""

    scenario: Scenario
    names: tuple[str, ...]
    cameras: dict[int, pycolmap.Camera]
    """By `camera_id`."""
    camera_ids: NDArray[np.int64]
    """(m,)"""
    frames: NDArray[np.int64]
    """(m,) images of one number were taken at once, by a rig."""
    interfaces: NDArray[np.int64]
    """(m,) images of one number share an interface (its mean plane)."""
    views: tuple[View, ...]
    terrain: Terrain
    options: dict[str, Any]
    """What the capture was made with."""

    def view(self, image_name: str) -> View:
        """Camera, pose and surface of an image; raises RefractError where it is unknown."""
        if image_name not in self.names:
            raise RefractError(f"the truth knows no image '{image_name}'; it has {', '.join(self.names[:3])}, ...")
        return self.views[self.names.index(image_name)]

    def trace(self, image_name: str, pixels: ArrayLike) -> Array:
        """The points (n, 3) of the ground that pixels (n, 2) show; not a number where they show none."""
        return trace(self.view(image_name), self.terrain, pixels)[0]

    def project(self, image_name: str, points: ArrayLike, *, near: ArrayLike | None = None) -> Array:
        """The pixels (n, 2) at which points (n, 3) are seen; see `view.project`."""
        return project(self.view(image_name), points, near=near)

    @property
    def planes(self) -> Array:
        """(m, 4) mean planes in the cameras: unit normal into the water, and distance."""
        rows = []
        for view in self.views:
            pose = view.cam_from_world
            normal, distance = plane_in_cam(view.surface.normal, view.surface.offset, pose[:, :3], pose[:, 3])
            rows.append([*normal, distance])
        return np.array(rows)


def save_truth(truth: Truth, folder: Path) -> None:
    """Write `truth.npz` and `calibration/cameras.txt` into a folder."""
    (folder / CAMERAS_NAME).parent.mkdir(parents=True, exist_ok=True)
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for camera_id, camera in sorted(truth.cameras.items()):
        params = " ".join(repr(value) for value in camera.params.tolist())
        lines.append(f"{camera_id} {camera.model_name} {camera.width} {camera.height} {params}")
    (folder / CAMERAS_NAME).write_text("\n".join(lines) + "\n", encoding="utf-8")

    layers, terrain = truth.views[0].surface.layers, truth.terrain
    np.savez_compressed(
        folder / TRUTH_NAME,
        scenario=np.array(truth.scenario),
        names=np.array(truth.names),
        camera_ids=truth.camera_ids,
        frames=truth.frames,
        interfaces=truth.interfaces,
        cam_from_world=np.array([view.cam_from_world for view in truth.views]),
        planes=truth.planes,
        surfaces=np.array([[*view.surface.normal, view.surface.offset] for view in truth.views]),
        waves=np.array([view.surface.waves for view in truth.views]),
        mu=np.array(layers.refractive_index),
        layer_thickness=np.array(layers.thickness, dtype=np.float64),
        layer_refractive_index=np.array(layers.index),
        # Of 24 bits each by their making.
        terrain_heights=terrain.heights.astype(np.float32),
        terrain_grid=np.array([*terrain.origin, terrain.spacing, *terrain.slope]),
        options=np.array(json.dumps(truth.options)),
    )


def load_truth(folder: str | Path) -> Truth:
    """The truth that lies beside rendered images.

    Args:
        folder: a workspace, with `truth.npz` and `calibration/cameras.txt`.

    Raises:
        RefractError: there is no such truth, or it is damaged.
    """
    import pycolmap

    path = Path(folder) / TRUTH_NAME
    try:
        with np.load(path) as file:
            data = dict(file)
        cameras = {}
        for line in (Path(folder) / CAMERAS_NAME).read_text(encoding="utf-8").splitlines():
            if line.strip() and not line.startswith("#"):
                camera_id, model, width, height, *params = line.split()
                camera = pycolmap.Camera.create_from_model_name(int(camera_id), model, 1.0, int(width), int(height))
                camera.params = [float(value) for value in params]
                cameras[int(camera_id)] = camera
        scenario = str(data["scenario"])
        if scenario not in get_args(Scenario):
            raise ValueError(f"scenario {scenario}")
        layers = Layers(
            thickness=tuple(data["layer_thickness"].tolist()), index=tuple(data["layer_refractive_index"].tolist())
        )
        x, y, spacing, *slope = data["terrain_grid"].tolist()
        terrain = Terrain(
            heights=data["terrain_heights"].astype(np.float64),
            origin=(x, y),
            spacing=spacing,
            slope=(slope[0], slope[1]),
        )
        views = tuple(
            View(
                camera=cameras[camera_id],
                cam_from_world=pose,
                surface=Surface(normal=plane[:3], offset=float(plane[3]), layers=layers, waves=waves),
            )
            for camera_id, pose, plane, waves in zip(
                data["camera_ids"].tolist(), data["cam_from_world"], data["surfaces"], data["waves"], strict=True
            )
        )
        return Truth(
            scenario=cast(Scenario, scenario),
            names=tuple(data["names"].tolist()),
            cameras=cameras,
            camera_ids=data["camera_ids"],
            frames=data["frames"],
            interfaces=data["interfaces"],
            views=views,
            terrain=terrain,
            options=json.loads(str(data["options"])),
        )
    except (OSError, KeyError, ValueError, IndexError, TypeError) as error:
        raise RefractError(f"{path} is not the truth of a rendered capture ({error}); render it again") from None
