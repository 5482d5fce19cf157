"""A capture in pictures: the stations of a simulated scene, with ground and water in place of loose points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, plane_in_world
from colmap_refract.simulation import scene
from colmap_refract.simulation.rendering import Look, render
from colmap_refract.simulation.scene import SceneOptions
from colmap_refract.simulation.surface import Wave, surface_at
from colmap_refract.simulation.terrain import Terrain, flat_board, hilly_ground
from colmap_refract.simulation.texture import Image, Texture, stony_texture
from colmap_refract.simulation.truth import Truth, save_truth
from colmap_refract.simulation.view import View, trace

if TYPE_CHECKING:
    import pycolmap

Watch = Callable[[int, int], None]
LARGEST_TEXTURE = 5e7  # texels


@dataclass(frozen=True, kw_only=True)
class SessionOptions:
    """What to photograph. Every picture is determined by its options, the seed in `scene` included."""

    scene: SceneOptions
    """Cameras, poses and planes, as those of `simulate`; its points, their noise and outliers have no say here. Without
    a relief it is a quarter of the mean depth of the water."""
    waves: tuple[Wave, ...] = ()
    """On the surface."""
    interval: float = 0.7
    """Seconds from frame to frame, for the waves to travel."""
    look: Look = field(default_factory=lambda: Look(blur=0.4, shot_noise=0.012, read_noise=0.002))
    """Light, water, lens and sensor."""
    jpeg_quality: int = 90
    """Of the written pictures."""

    def __post_init__(self) -> None:
        if not 1 <= self.jpeg_quality <= 100:
            raise RefractError(f"jpeg_quality {self.jpeg_quality} is not from 1 to 100")
        if not 0 <= self.interval < np.inf:
            raise RefractError(
                f"interval {self.interval:g} s between the images is negative or no number: give 0 or more"
            )
        if self.waves and self.scene.scenario == "camera_housing":
            raise RefractError("camera_housing looks through a port, which has no waves: leave them out")


@dataclass(frozen=True, kw_only=True)
class Session:
    """Views of one ground, ready to be rendered."""

    options: SessionOptions
    truth: Truth

    def picture(self, index: int, *, num_threads: int = -1) -> Image:
        """The picture (H, W, 3) of one view."""
        view, seed = self.truth.views[index], [self.options.scene.seed, index]
        return render(view, self.truth.terrain, self.texture, self.options.look, seed=seed, num_threads=num_threads)

    @cached_property
    def texture(self) -> Texture:
        """The ground's, with a texel of half of what a pixel shows, or larger where it would have too many."""
        terrain = self.truth.terrain
        area = float(np.prod(terrain.high - terrain.low))
        finest = min(ground_sample_distance(view, terrain) for view in self.truth.views)
        texel = max(0.5 * finest, float(np.sqrt(area / LARGEST_TEXTURE)))
        return stony_texture(terrain.low, terrain.high, texel=texel, seed=self.options.scene.seed + 1)


def photograph(options: SessionOptions) -> Session:
    """Lay out a session: stations as `simulate` would place them, over a ground that reaches as far as they see.

    Raises:
        RefractError: options that contradict each other, a camera at or below the surface.
    """
    rng = np.random.default_rng(options.scene.seed)
    stations = scene.lay_out(options.scene, rng).stations
    group = _interface_groups(options.scene, stations)
    views = []
    for station in stations:
        mean = plane_in_world(*station.plane, station.rotation, station.translation)
        surface = surface_at(
            *mean,
            layers=options.scene.layers,
            waves=options.waves,
            time=options.interval * station.frame,
            water_depth=options.scene.water_depth,
        )
        pose = np.column_stack([station.rotation, station.translation])
        views.append(View(camera=station.camera, cam_from_world=pose, surface=surface))
    for view in views:
        view.check()
    terrain = _ground(options, views)
    return Session(
        options=options,
        truth=Truth(
            scenario=options.scene.scenario,
            names=tuple(station.name for station in stations),
            cameras={camera.camera_id: camera for camera in scene.cameras(options.scene)},
            camera_ids=np.array([station.camera.camera_id for station in stations]),
            frames=np.array([station.frame for station in stations]),
            interfaces=np.array(group),
            views=tuple(views),
            terrain=terrain,
            options=asdict(options),
        ),
    )


def write_session(session: Session, folder: Path, *, num_threads: int = -1, watch: Watch | None = None) -> None:
    """Write a workspace: `images/`, `calibration/cameras.txt`, and the truth (`truth.npz`).

    Args:
        session: what to render.
        folder: exists and is written into.
        num_threads: of the rendering; -1 for one per core.
        watch: called with how many images are done, and of how many, before the first and after each.

    Raises:
        RefractError: an image cannot be written.
    """
    import pycolmap

    count = len(session.truth.names)
    for index, name in enumerate(session.truth.names):
        if watch is not None:
            watch(index, count)
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = pycolmap.Bitmap.from_array(session.picture(index, num_threads=num_threads))
        picture.set_jpeg_quality(session.options.jpeg_quality)
        if not picture.write(path):
            raise RefractError(f"{path} cannot be written; is the disk full?")
    save_truth(session.truth, folder)
    if watch is not None:
        watch(count, count)


def ground_sample_distance(view: View, terrain: Terrain) -> float:
    """Metres on the ground from a pixel to the next, in the middle of the image; infinite where it shows no ground."""
    middle = 0.5 * np.array([view.camera.width, view.camera.height])
    points, seen = trace(view, terrain, middle + [[0, 0], [1, 0], [0, 1]])
    return float(np.sqrt(np.prod(np.linalg.norm(points[1:] - points[0], axis=1)))) if seen.all() else np.inf


def _interface_groups(options: SceneOptions, stations: list[scene.Station]) -> list[int]:
    """Which images share an interface: a number for each."""
    if options.scenario == "static_interface":
        return [0] * len(stations)
    if options.scenario == "camera_housing":
        return [station.camera.camera_id - 1 for station in stations]
    return [station.frame // options.frames_per_interface for station in stations]


def _ground(options: SessionOptions, views: list[View]) -> Terrain:
    """A hilly ground that reaches a little farther than the edges of all views."""
    relief = options.scene.relief if options.scene.relief is not None else 0.25 * options.scene.water_depth
    depth, size = options.scene.camera_height, options.scene.scene_size
    board = flat_board([-1e4 * size] * 2, [1e4 * size] * 2, depth + relief)
    border = []
    for view in views:
        edge = _border(view.camera)
        points, seen = trace(view, board, edge)
        # Where a ray leads up or is reflected there is nothing to see; far away there is nothing worth it.
        near = seen & (np.linalg.norm(points - view.center, axis=1) < 20 * depth)
        border.append(points[near, :2])
    seen_at = np.concatenate(border)
    if not len(seen_at):
        raise RefractError("no camera sees the ground: use a narrower view or less tilt")
    margin = 0.05 * np.ptp(seen_at, axis=0) + 0.05 * size
    return hilly_ground(
        seen_at.min(axis=0) - margin,
        seen_at.max(axis=0) + margin,
        depth,
        relief=relief,
        hill_size=0.5 * size,
        seed=options.scene.seed,
    )


def _border(camera: pycolmap.Camera) -> Array:
    """Pixels (n, 2) along the edges of an image."""
    step = np.linspace(0, 1, 33)
    edges = [np.column_stack([step, np.full(33, end)]) for end in (0, 1)]
    return np.concatenate([*edges, *(edge[:, ::-1] for edge in edges)]) * [camera.width, camera.height]
