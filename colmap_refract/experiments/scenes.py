"""The paper's set-ups: where board, bricks or table, camera and water stand, and what the camera then sees.

The world is the simulation's: z points into the water, lengths are metres. A tank that is seen from its side lies on
its back here; light does not know.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from colmap_refract.interface import Array, Layers, plane_in_cam, tangent_basis
from colmap_refract.options import Scenario
from colmap_refract.simulation import Capture, SceneOptions, simulate
from colmap_refract.simulation.scene import Arrangement, Station, cameras
from colmap_refract.simulation.surface import GRAVITY

PIXEL_NOISE = 0.22
"""Root mean square error of SIFT's keypoints on rendered pictures, px (benchmarks/results/photographs.md)."""
CAMERA: dict[str, Any] = {"camera_model": "SIMPLE_RADIAL", "width": 1600, "height": 1200}
"""About that of a Point Grey Grasshopper 2."""
_TELE, _NORMAL = 1600.0, 1200.0
"""Focal lengths, px: of 7 mm and 5.3 mm on its sensor."""


@dataclass(frozen=True, kw_only=True)
class Setup:
    """One capture of an experiment, and what else was photographed."""

    name: str
    """Of the paper's scenario, such as 'fixed camera'."""
    capture: Capture
    dry: Capture | None = None
    """The same points, from the camera that does not move, before the water was poured in: same point ids."""
    groups: dict[str, str] | None = None
    """Image name to the inclination that it was taken at, where several images share one."""
    thinned: Capture | None = None
    """The same with fewer frames per inclination, for the noise bound."""

    @property
    def scenario(self) -> Scenario:
        return self.capture.scenario

    @property
    def is_wavy(self) -> bool:
        return self.capture.options.wave_slope_deg > 0


@dataclass(frozen=True, kw_only=True)
class Stand:
    """Where a camera stands and what it looks through."""

    rotation: Array
    """(3, 3) `cam_from_world`."""
    center: Array
    """(3,) of the projection."""
    normal: Array
    """(3,) of the mean interface, unit, world."""
    offset: float
    """Of the mean interface along it."""


def photograph_stands(
    options: SceneOptions,
    points: Array,
    stands: Sequence[Stand],
    *,
    waves: Sequence[Array] | None = None,
) -> Capture:
    """Photograph points (P, 3) from given stands, an image each."""
    camera = cameras(options)[0]
    stations = []
    for k, stand in enumerate(stands):
        translation = -stand.rotation @ stand.center
        plane = plane_in_cam(stand.normal, stand.offset, stand.rotation, translation)
        stations.append(Station(k, 0, camera, stand.rotation, translation, plane, f"frame_{k + 1:04d}.jpg"))
    targets = np.tile(points[:, :2].mean(axis=0), (len(stands), 1))
    return simulate(options, Arrangement(targets, points, stations), waves=waves)


def looking_at(center: Array, target: Array, roll: float = 0.0) -> Array:
    """`cam_from_world` (3, 3) of a camera at a place whose optical axis goes through another."""
    axis = (target - center) / np.linalg.norm(target - center)
    e1, e2 = tangent_basis(axis).T
    return np.stack([np.cos(roll) * e1 + np.sin(roll) * e2, np.cos(roll) * e2 - np.sin(roll) * e1, axis])


def tilted(rng: np.random.Generator, count: int, rms_deg: float) -> Array:
    """Unit normals (count, 3) about z: their slopes are uniform in a disc, successive ones a golden angle apart."""
    azimuth = 2.39996 * np.arange(count) + rng.uniform(0, 2 * np.pi)
    radius = np.tan(np.radians(rms_deg)) * np.sqrt(2 * (np.arange(count) + rng.random(count)) / count)
    # Small tilts and large ones take turns.
    radius = radius[np.argsort((0.618034 * np.arange(count)) % 1)]
    normals = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.ones(count)])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def board_points(markers: tuple[int, int], spacing: float, center: Array, rotation: Array) -> Array:
    """Corners (P, 3) of a plane board's markers, columns by rows."""
    x, y = np.meshgrid(*(spacing * (np.arange(count) - 0.5 * (count - 1)) for count in markers))
    flat = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return np.asarray(center + flat @ rotation.T)


def box_points(
    rng: np.random.Generator, middle: tuple[float, float], size: tuple[float, float, float], bottom: float, count: int,
    *, yaw: float = 0.0, lid: bool = True,
) -> Array:  # fmt: skip
    """Random points (count, 3) on the sides and, with a lid, the top of a box that stands at z = `bottom`."""
    length, width, height = size
    areas = np.array([length * width if lid else 0.0, 2 * length * height, 2 * width * height])
    face = rng.choice(3, count, p=areas / areas.sum())
    u, v, end = rng.uniform(-0.5, 0.5, count), rng.uniform(-0.5, 0.5, count), rng.choice([-0.5, 0.5], count)
    x = np.where(face == 2, end, u) * length
    y = np.where(face == 1, end, np.where(face == 2, u, v)) * width
    z = np.where(face == 0, bottom - height, bottom - (0.5 + v) * height)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.column_stack([middle[0] + cos * x - sin * y, middle[1] + sin * x + cos * y, z])


def turned(vector: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,), radians."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def _dry(options: SceneOptions, points: Array, stand: Stand) -> Capture:
    """Twice the same dry picture: a point needs two images to be one."""
    air = replace(options, num_images=2, layers=Layers(index=(1.0,)), wave_slope_deg=0.0, seed=options.seed + 1_000_000)
    return photograph_stands(air, points, [stand, stand])


def _around(rng: np.random.Generator, count: int, reach: Array, target: Array) -> list[tuple[Array, Array]]:
    """Poses of a camera that is moved by up to `reach` (3,) about the origin and looks about a target."""
    azimuth = 2.39996 * np.arange(count) + rng.uniform(0, 2 * np.pi)
    radius = np.sqrt((np.arange(count) + rng.random(count)) / count)[rng.permutation(count)]
    centers = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), rng.uniform(-1, 1, count)]) * reach
    aims = target + 0.02 * rng.standard_normal((count, 3))
    rolls = rng.uniform(-0.3, 0.3, count)
    return [(looking_at(place, aim, roll), place) for place, aim, roll in zip(centers, aims, rolls, strict=True)]


def flat_setups(
    seed: int, *, markers: tuple[int, int] = (13, 10), images: tuple[int, int, int] = (15, 10, 10)
) -> list[Setup]:
    """A board in a tank that the camera sees through its front: fixed camera, static and moving interface.

    The board hangs 0.22 m behind the front, which is 0.5 m from the camera, turned by 10 to 20 degrees. A moving tank
    is turned by 8 degrees (root mean square) and shifted by up to 3 cm; a moving camera by up to 25 cm sideways.
    """
    rng = np.random.default_rng([seed, 10])
    front, middle = 0.5, np.array([0.0, 0.0, 0.72])
    lean = rng.uniform(0, 2 * np.pi)
    turn = turned(np.radians(rng.uniform(10, 20)) * np.array([np.cos(lean), np.sin(lean), 0.0]))
    points = board_points(markers, 0.04 * 12 / (markers[0] - 1), middle, turn)
    fixed, static, moving = images
    setups = []
    shared: dict[str, Any] = {
        **CAMERA, "focal_length": _TELE, "depth": 0.72, "distance_ratio": front / 0.72, "num_points": len(points),
        "pixel_noise": PIXEL_NOISE, "seed": seed,
    }  # fmt: skip

    def tanks(count: int) -> list[tuple[Array, float]]:
        normals, lifts = tilted(rng, count, 8.0), rng.uniform(-0.03, 0.03, count)
        return [(n, float(n @ [0, 0, front + lift])) for n, lift in zip(normals, lifts, strict=True)]

    home = np.eye(3), np.zeros(3)
    options = SceneOptions(scenario="fixed_camera", num_images=fixed, tilt_deg=8.0, **shared)
    stands = [Stand(rotation=home[0], center=home[1], normal=n, offset=o) for n, o in tanks(fixed)]
    capture = photograph_stands(options, points, stands)
    setups.append(Setup(name="fixed camera", capture=capture, dry=_dry(options, points, stands[0])))

    reach = np.array([0.25, 0.2, 0.05])
    options = SceneOptions(scenario="static_interface", num_images=static, **shared)
    normal, offset = tanks(1)[0]
    stands = [Stand(rotation=r, center=c, normal=normal, offset=offset) for r, c in _around(rng, static, reach, middle)]
    setups.append(Setup(name="static interface", capture=photograph_stands(options, points, stands)))

    options = SceneOptions(scenario="moving_interface", num_images=moving, tilt_deg=8.0, **shared)
    poses = _around(rng, moving, reach, middle)
    stands = [
        Stand(rotation=r, center=c, normal=n, offset=o) for (r, c), (n, o) in zip(poses, tanks(moving), strict=True)
    ]
    setups.append(Setup(name="moving interface", capture=photograph_stands(options, points, stands)))
    return setups


def wavy_setups(
    seed: int,
    *,
    markers: tuple[int, int] = (13, 10),
    inclinations: int = 3,
    images: tuple[int, int, int] = (20, 15, 20),
) -> list[Setup]:
    """A board on the bottom of a tank, seen from above through waves of 0.1 to 0.3 m with slopes of 1.5 degrees (rms).

    The camera is 0.5 m above the water, which is 0.25 m deep. Fixed camera: a number of images at each of several
    inclinations of the tank, camera and board moving with it. Static interface: no inclination, the camera moved by up
    to 25 cm. Moving interface: both. Inclinations are 5 degrees (root mean square).
    """
    rng = np.random.default_rng([seed, 20])
    level, floor = 0.5, 0.75
    aim = np.array([*rng.uniform(-0.03, 0.03, 2), floor])
    lean = rng.uniform(0, 2 * np.pi)
    points = board_points(markers, 0.04 * 12 / (markers[0] - 1), np.array([0.0, 0.0, floor]), np.eye(3))
    per_inclination, static, moving = images
    shared: dict[str, Any] = {
        **CAMERA, "focal_length": _TELE, "depth": floor, "distance_ratio": level / floor, "num_points": len(points),
        "pixel_noise": PIXEL_NOISE, "seed": seed, "wave_slope_deg": 1.5, "wavelength": (0.1, 0.3),
    }  # fmt: skip
    center = floor * np.tan(np.radians(10)) * np.array([np.cos(lean), np.sin(lean), 0.0])
    rotation = looking_at(center, aim)

    count = inclinations * per_inclination
    options = SceneOptions(
        scenario="fixed_camera", num_images=count, tilt_deg=5.0, frames_per_interface=per_inclination, **shared
    )
    normals = np.repeat(tilted(rng, inclinations, 5.0), per_inclination, axis=0)
    stands = [Stand(rotation=rotation, center=center, normal=n, offset=float(n[2] * level)) for n in normals]
    capture = photograph_stands(options, points, stands)
    groups = {f"frame_{k + 1:04d}.jpg": f"inclination {k // per_inclination + 1}" for k in range(count)}
    setups = [Setup(name="fixed camera", capture=capture, dry=_dry(options, points, stands[0]), groups=groups)]

    reach = np.array([0.25, 0.2, 0.05])
    still = np.array([0.0, 0.0, 1.0])
    options = SceneOptions(scenario="static_interface", num_images=static, **shared)
    stands = [Stand(rotation=r, center=c, normal=still, offset=level) for r, c in _around(rng, static, reach, aim)]
    setups.append(Setup(name="static interface", capture=photograph_stands(options, points, stands)))

    options = SceneOptions(scenario="moving_interface", num_images=moving, tilt_deg=5.0, **shared)
    poses = _around(rng, moving, reach, aim)
    stands = [
        Stand(rotation=r, center=c, normal=n, offset=float(n[2] * level))
        for (r, c), n in zip(poses, tilted(rng, moving, 5.0), strict=True)
    ]
    setups.append(Setup(name="moving interface", capture=photograph_stands(options, points, stands)))
    return setups


def brick_setup(seed: int, *, inclinations: int = 10, frames: int = 100, num_points: int = 120) -> Setup:
    """Three bricks on the bottom of a tank, 0.3 m under water that the camera, fixed to the tank, is 0.5 m above.

    Waves of 5 to 20 cm have slopes of 2.5 degrees (rms); the tank's inclinations are 5 degrees (rms).
    """
    rng = np.random.default_rng([seed, 30])
    level, floor = 0.5, 0.8
    size = (0.21, 0.10, 0.065)
    places = [((-0.09, -0.06), floor), ((0.10, 0.05), floor), ((0.0, 0.0), floor - size[2])]
    # Two on the bottom and one across them.
    parts = [
        box_points(rng, middle, size, bottom, num_points // 4, yaw=rng.uniform(-0.6, 0.6)) for middle, bottom in places
    ]
    rest = num_points - sum(map(len, parts))
    parts.append(
        np.column_stack([rng.uniform(-0.22, 0.22, rest), rng.uniform(-0.16, 0.16, rest), np.full(rest, floor)])
    )
    points = np.concatenate(parts)
    count = inclinations * frames
    options = SceneOptions(
        scenario="fixed_camera", num_images=count, tilt_deg=5.0, frames_per_interface=frames, **CAMERA,
        focal_length=_TELE, depth=floor, distance_ratio=level / floor, num_points=len(points), pixel_noise=PIXEL_NOISE,
        seed=seed, wave_slope_deg=2.5, wavelength=(0.05, 0.2),
    )  # fmt: skip
    center = np.array([0.05, -0.04, 0.0])
    rotation = looking_at(center, np.array([0.0, 0.0, floor]))
    means = [
        Stand(rotation=rotation, center=center, normal=n, offset=float(n[2] * level))
        for n in tilted(rng, inclinations, 5.0)
    ]
    few = min(4, frames)
    thin = replace(options, num_images=inclinations * few, frames_per_interface=few)
    return Setup(
        name="fixed camera",
        capture=photograph_stands(options, points, [stand for stand in means for _ in range(frames)]),
        groups={f"frame_{k + 1:04d}.jpg": f"inclination {k // frames + 1}" for k in range(count)},
        thinned=photograph_stands(thin, points, [stand for stand in means for _ in range(few)]),
    )


POOL_LEVEL, POOL_DEPTH, TABLE_HEIGHT, BASKET_HEIGHT = 0.6, 1.8, 0.6, 0.3
"""Camera above the water, water, table and basket, metres: the paper's."""
WAVE_PERIOD = 1.0
WAVE_AMPLITUDE = 0.02
"""Half of the height from trough to crest, metres: the paper does not give it."""


def deep_water_wavelength(period: float) -> float:
    """Metres from crest to crest of gravity waves of a period, seconds, over deep water."""
    return GRAVITY * period**2 / (2 * np.pi)


def pool_setups(seed: int, *, num_images: int = 20, num_points: int = 500) -> list[Setup]:
    """A table with a basket of bricks on it, in a pool; the camera goes along a line of 1.2 m.

    Still water, then long-crested waves of the generator's period; the camera takes each image at another moment.
    """
    rng = np.random.default_rng([seed, 40])
    bottom = POOL_LEVEL + POOL_DEPTH
    table = bottom - TABLE_HEIGHT
    share = num_points // 5

    def plate(half: tuple[float, float], z: float, count: int) -> Array:
        x, y = (rng.uniform(-side, side, count) for side in half)
        return np.column_stack([x, y, np.full(count, z)])

    parts = [
        plate((0.6, 0.4), table, 2 * share),
        box_points(rng, (0.05, 0.0), (0.45, 0.35, BASKET_HEIGHT), table, share, yaw=0.2, lid=False),
        box_points(rng, (0.0, 0.05), (0.21, 0.10, 0.2), table, share // 2, yaw=0.9),
        box_points(rng, (0.1, -0.05), (0.21, 0.10, 0.13), table, share - share // 2, yaw=-0.5),
        plate((0.8, 0.6), bottom, share),
    ]
    points = np.concatenate(parts)
    along = np.linspace(-0.6, 0.6, num_images)
    centers = np.column_stack([along, np.zeros(num_images), np.zeros(num_images)])
    centers += 0.01 * rng.standard_normal(centers.shape)
    aims = np.column_stack([0.5 * along, np.zeros(num_images), np.full(num_images, table)])
    aims[:, :2] += 0.04 * rng.standard_normal((num_images, 2))
    rotations = [
        looking_at(c, a, r) for c, a, r in zip(centers, aims, 0.03 * rng.standard_normal(num_images), strict=True)
    ]
    level = np.array([0.0, 0.0, 1.0])
    stands = [
        Stand(rotation=r, center=c, normal=level, offset=POOL_LEVEL) for r, c in zip(rotations, centers, strict=True)
    ]
    length = deep_water_wavelength(WAVE_PERIOD)
    number = 2 * np.pi / length
    shared: dict[str, Any] = {
        **CAMERA, "focal_length": _NORMAL, "num_images": num_images, "depth": table, "num_points": len(points),
        "distance_ratio": POOL_LEVEL / table, "pixel_noise": PIXEL_NOISE, "seed": seed,
    }  # fmt: skip
    still = SceneOptions(scenario="static_interface", **shared)
    # Level on average: the mean planes do not tilt.
    wavy = SceneOptions(
        scenario="moving_interface", tilt_deg=0.0, wavelength=(length, length),
        wave_slope_deg=float(np.degrees(np.arctan(WAVE_AMPLITUDE * number / np.sqrt(2)))), **shared,
    )  # fmt: skip
    heading = rng.uniform(0, 2 * np.pi)
    waves = [
        np.array([[number * np.cos(heading), number * np.sin(heading), WAVE_AMPLITUDE, phase]])
        for phase in rng.uniform(0, 2 * np.pi, num_images)
    ]
    return [
        Setup(name="static interface, still", capture=photograph_stands(still, points, stands)),
        Setup(name="moving interface, waves", capture=photograph_stands(wavy, points, stands, waves=waves)),
    ]
