"""A curved body on the bottom of a tank, photographed by a camera that is fixed to the tank while the water tilts."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from colmap_refract.experiments.scenes import looking_at
from colmap_refract.interface import Array
from colmap_refract.simulation.scene import SceneOptions, cameras
from colmap_refract.simulation.session import Session, SessionOptions
from colmap_refract.simulation.surface import surface_at
from colmap_refract.simulation.terrain import Terrain
from colmap_refract.simulation.truth import Truth
from colmap_refract.simulation.view import View

LEVEL, FLOOR = 0.45, 0.85
"""From the camera to the water and to the tank's bottom, metres."""
BODY_DEPTH = 0.17
"""From the body's highest place to the bottom, metres."""
_HALF = np.array([0.29, 0.19])
"""Of the body, along x and y, metres."""
_TILT_DEG = 8.0
_SPACING = 0.004
"""Of the terrain's nodes, metres."""


def torso() -> Terrain:
    """A rounded body with a chest, a waist and a hip over a flat bottom, as large as the camera sees.

    It has no overhang, and its sides are no steeper than about 55 degrees.
    """
    low, high = np.array([-0.52, -0.42]), np.array([0.52, 0.42])
    count = np.round((high - low) / _SPACING).astype(int) + 1
    x, y = np.meshgrid(*(low[k] + _SPACING * np.arange(count[k]) for k in range(2)))
    waist = 1 - 0.22 * np.exp(-(((x - 0.05) / 0.08) ** 2))
    away = (x / _HALF[0]) ** 2 + (y / (waist * _HALF[1])) ** 2
    height = 0.14 * np.maximum(1 - away, 0) ** 1.5
    for place, width, lift in (((-0.10, 0.06), 0.045, 0.04), ((-0.10, -0.06), 0.045, 0.04), ((0.16, 0.0), 0.07, 0.02)):
        height += lift * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / width**2)
    height *= BODY_DEPTH / height.max()
    return Terrain(heights=FLOOR - height, origin=(float(low[0]), float(low[1])), spacing=_SPACING)


def slopes(num_frames: int, rng: np.random.Generator) -> Array:
    """Slopes (n, 2) of the water in a swaying tank: along each axis an oscillation that swells and fades."""
    phase = rng.uniform(0, 2 * np.pi, 4)
    t = 2 * np.pi * np.arange(num_frames)
    swell = [0.8 + 0.2 * np.sin(t / period + phase[2 + k]) for k, period in enumerate((160, 130))]
    swaying = np.column_stack([swell[k] * np.sin(t / period + phase[k]) for k, period in enumerate((37, 29))])
    return np.asarray(swaying * np.tan(np.radians(_TILT_DEG)) / np.sqrt(np.mean(np.sum(swaying**2, axis=1))))


def swaying_tank(seed: int, *, num_frames: int = 240, width: int = 640) -> Session:
    """The frames to be of a plane water surface that tilts by 8 degrees (root mean square) over a torso.

    Args:
        seed: of the tilts, the camera's small inclination, texture and sensor noise.
        num_frames: in their order in time.
        width: of the images, px; the height is three quarters of it.
    """
    rng = np.random.default_rng([seed, 50])
    options = SceneOptions(
        scenario="fixed_camera", num_images=num_frames, width=width, height=3 * width // 4,
        focal_length=1.16 * width, depth=FLOOR, distance_ratio=LEVEL / FLOOR, tilt_deg=_TILT_DEG, seed=seed,
    )  # fmt: skip
    camera = cameras(options)[0]
    rotation = looking_at(np.zeros(3), np.array([*rng.uniform(-0.02, 0.02, 2), FLOOR]))
    pose = np.column_stack([rotation, np.zeros(3)])
    views = []
    for slope in slopes(num_frames, rng):
        normal = np.array([*slope, 1.0]) / np.hypot(1.0, np.linalg.norm(slope))
        lift = rng.uniform(-0.01, 0.01)
        surface = surface_at(normal, float(normal[2] * (LEVEL + lift)), layers=options.layers)
        views.append(View(camera=camera, cam_from_world=pose, surface=surface))
    session = SessionOptions(scene=options)
    truth = Truth(
        scenario="fixed_camera",
        names=tuple(f"frame_{k + 1:04d}.jpg" for k in range(num_frames)),
        cameras={camera.camera_id: camera},
        camera_ids=np.full(num_frames, camera.camera_id),
        frames=np.arange(num_frames),
        interfaces=np.arange(num_frames),
        views=tuple(views),
        terrain=torso(),
        options=asdict(session),
    )
    return Session(options=session, truth=truth)
