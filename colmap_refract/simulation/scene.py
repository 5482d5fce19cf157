"""What is simulated: where cameras, points and interfaces stand, drawn at random from the options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers, plane_in_cam, tangent_basis
from colmap_refract.options import Scenario
from colmap_refract.simulation.waves import WaveStatistics

if TYPE_CHECKING:
    import pycolmap

Layout = Literal["orbit", "strip", "survey"]
Plane = tuple[Array, float]


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """What to simulate. Every capture is determined by its options, `seed` included."""

    scenario: Scenario
    """Who shares the interface: nobody, the world, nobody but with one camera pose, or each camera."""
    layout: Layout = "orbit"
    """`orbit`: every image sees the same scene. `strip`, `survey`: one or several flight lines, and an
    image sees its own part of the scene, so that a point is in about eight images."""
    num_images: int = 15
    num_points: int = 400
    """Points in the scene; those that fewer than two images see are then left out."""
    pixel_noise: float = 0.5
    """Standard deviation of each coordinate of a keypoint, px."""
    outlier_ratio: float = 0.0
    """Part of the observations that are replaced by a uniformly random pixel of the image."""
    camera_model: str = "SIMPLE_RADIAL"
    width: int = 1600
    height: int = 1200
    focal_length: float = 1200.0
    """In px. A narrow view is taken from farther away, so that it shows the same part of the scene."""
    camera_params: tuple[float, ...] = ()
    """All parameters of the camera model, as in COLMAP's camera files. Empty: `focal_length`, the principal point in
    the middle, and a mild distortion. With them, `focal_length` is still what the scene's size goes by."""
    num_cameras: int = 1
    """Cameras (or rigs) that the frames alternate between."""
    sensors_per_frame: int = 1
    """Images taken at once by a rig of that many cameras, 0.1 of the scene's size apart."""
    layers: Layers = Layers()
    """Media behind the first interface, thicknesses in metres."""
    depth: float | None = None
    """From the cameras down to the mean floor, metres. None: 2.5, or more for a narrow view."""
    distance_ratio: float | None = None
    """Interface distance over depth. None: 0.02 in a housing, otherwise what leaves 1.5 m of water."""
    relief: float | None = None
    """From the deepest to the highest place of the floor, metres. None: a quarter of `scene_size`, or less where the
    water is shallow."""
    tilt_deg: float = 5.0
    """Root mean square tilt of moving interfaces from level, or the tilt of the ports in their housings."""
    frames_per_interface: int = 1
    """Successive frames that share one moving interface (moving interface and fixed camera)."""
    oblique_deg: float = 17.0
    """Mean angle between the view and the vertical; the images vary by a third of it. 0: nadir only."""
    dry_point_ratio: float = 0.0
    """Part of the points that stand out of the water, on a pier through the middle of the scene."""
    wave_slope_deg: float = 0.0
    """Root mean square slope of the waves on the interface, degrees: of the steepest direction, over all places and
    frames. Each frame has waves of its own. 0: flat."""
    wavelength: tuple[float, float] = (1.0, 2.5)
    """Shortest and longest of the waves, metres."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.num_images < 2:
            raise RefractError(f"num_images {self.num_images} is too few images: give two or more")
        if self.num_images % self.sensors_per_frame:
            raise RefractError(
                f"{self.num_images} images cannot be taken {self.sensors_per_frame} at once: give a num_images that is "
                "a multiple of sensors_per_frame"
            )
        if self.seed < 0:
            raise RefractError(f"seed {self.seed} is negative: give 0 or more")
        if self.scenario == "fixed_camera" and (self.num_cameras > 1 or self.sensors_per_frame > 1):
            raise RefractError("fixed_camera has one camera: leave num_cameras and sensors_per_frame at 1")
        if self.scenario == "camera_housing" and self.dry_point_ratio > 0:
            raise RefractError("camera_housing has no dry points: leave dry_point_ratio at 0")
        if self.camera_params and self.num_cameras * self.sensors_per_frame > 1:
            raise RefractError("camera_params are those of one camera: leave num_cameras and sensors_per_frame at 1")
        if self.relief is not None and not self.relief >= 0:
            raise RefractError(f"a relief of {self.relief:g} m is negative: give 0, a flat floor, or more")
        if self.relief is not None and not self.relief < 2 * self.water_depth:
            raise RefractError(
                f"a relief of {self.relief:g} m reaches out of the water: give less than twice its depth"
            )

        if not 0 <= self.wave_slope_deg < 90:
            raise RefractError(f"wave_slope_deg {self.wave_slope_deg:g} is no slope: give 0, a flat interface, or more")
        _ = self.wave_statistics
        if self.wave_slope_deg > 0 and self.scenario == "camera_housing":
            raise RefractError("the port of a camera_housing has no waves: leave wave_slope_deg at 0")
        if self.wave_slope_deg > 0 and self.layers.thickness:
            raise RefractError("a wall does not make waves: leave wave_slope_deg at 0, or layers without thickness")

    @property
    def wave_statistics(self) -> WaveStatistics:
        """Of the interface's heights and slopes over its mean plane."""
        return WaveStatistics(rms_slope=float(np.tan(np.radians(self.wave_slope_deg))), wavelength=self.wavelength)

    @property
    def camera_height(self) -> float:
        """From the cameras to the mean floor, metres."""
        return self.depth if self.depth is not None else 2.5 * max(1.0, 4 / 3 * self.focal_length / self.width)

    @property
    def scene_size(self) -> float:
        """Length that the relief and the camera offsets are proportional to: 2.5 by default, metres."""
        return self.camera_height * min(1.0, 0.75 * self.width / self.focal_length)

    @property
    def interface_height(self) -> float:
        """From the cameras to the mean interface, metres."""
        if self.distance_ratio is not None:
            return self.distance_ratio * self.camera_height
        if self.scenario == "camera_housing":
            return 0.02 * self.camera_height
        return self.camera_height - 0.6 * self.scene_size

    @property
    def water_depth(self) -> float:
        """From the mean interface to the mean floor, metres."""
        return self.camera_height - self.interface_height

    @property
    def floor_relief(self) -> float:
        """`relief`, or its default, metres."""
        return self.relief if self.relief is not None else min(0.25 * self.scene_size, 0.7 * self.water_depth)

    @property
    def footprint(self) -> Array:
        """Width and height of the part of the mean floor that a vertical view shows, (2,), metres."""
        tangent = 0.5 * np.array([self.width, self.height]) / self.focal_length
        sine = np.minimum(tangent / np.hypot(1, tangent) / self.layers.refractive_index, 0.95)
        return np.asarray(2 * (self.interface_height * tangent + self.water_depth * sine / np.sqrt(1 - sine**2)))


class Station(NamedTuple):
    """Where one image is taken from: frame and sensor from 0, pose, and plane `(normal_in_cam, distance)`."""

    frame: int
    sensor: int
    camera: pycolmap.Camera
    rotation: Array
    translation: Array
    plane: Plane
    name: str


class Arrangement(NamedTuple):
    """A capture before anything is photographed: targets (F, 2) of the frames, points (P, 3), and the stations."""

    targets: Array
    points: Array
    stations: list[Station]


def frame_targets(options: SceneOptions, rng: np.random.Generator) -> Array:
    """Where the optical axis of each frame meets the floor, (n, 2)."""
    frame = np.arange(options.num_images // options.sensors_per_frame)
    if options.scenario == "fixed_camera":
        return np.zeros((len(frame), 2))
    if options.layout == "orbit":
        # A nadir view has no offset from its target, so the targets have to give the baseline.
        return (0.25 if options.oblique_deg == 0 else 0.08) * options.scene_size * _unit_disc(len(frame), rng)
    spacing = np.array([0.40, 0.11 if options.layout == "strip" else 0.28]) * options.footprint
    lines = 1 if options.layout == "strip" else max(1, round(np.sqrt(len(frame) * spacing[1] / spacing[0])))
    per_line = -(-len(frame) // lines)
    line, along = np.divmod(frame, per_line)
    along = np.where(line % 2 == 0, along, per_line - 1 - along)
    grid = np.stack([line, along], axis=1) * spacing
    return np.asarray(grid + 0.02 * options.footprint * rng.standard_normal(grid.shape))


def rig_poses(options: SceneOptions, targets: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Rotations `rig_from_world` (n, 3, 3) and centres (n, 3): each looks obliquely at its target."""
    count = len(targets)
    angle = np.radians(options.oblique_deg) * rng.uniform(2 / 3, 4 / 3, count)
    azimuth = 2.39996 * np.arange(count) + rng.uniform(0, 2 * np.pi)
    roll = rng.uniform(0, 2 * np.pi, count) if options.layout == "orbit" else 0.05 * rng.standard_normal(count)
    height = options.camera_height * (1 + rng.uniform(-0.05, 0.05, count))
    if options.scenario == "fixed_camera":
        angle, azimuth, roll, height = (np.full(count, value[0]) for value in (angle, azimuth, roll, height))
    away = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    view = np.column_stack([-np.sin(angle)[:, None] * away, np.cos(angle)])
    ground = np.column_stack([targets, np.full(count, options.camera_height)])
    rotations = []
    for axis, turn in zip(view, roll, strict=True):
        e1, e2 = tangent_basis(axis).T
        rotations.append([np.cos(turn) * e1 + np.sin(turn) * e2, np.cos(turn) * e2 - np.sin(turn) * e1, axis])
    return np.array(rotations), ground - (height / np.cos(angle))[:, None] * view


def cameras(options: SceneOptions) -> list[pycolmap.Camera]:
    """Cameras 1, 2, ... of slightly different focal lengths, mildly distorted where the model can."""
    import pycolmap

    cameras = []
    for k in range(options.num_cameras * options.sensors_per_frame):
        focal_length = options.focal_length * (1 + 0.02 * k)
        camera = pycolmap.Camera.create_from_model_name(
            k + 1, options.camera_model, focal_length, options.width, options.height
        )
        if options.camera_params:
            camera.params = list(options.camera_params)
            cameras.append(camera)
            continue
        for idx in camera.extra_params_idxs()[:1]:
            # The field-of-view model has no undistorted state and comes with a value already.
            camera.params[idx] = camera.params[idx] or (0.1 if options.camera_model == "EUCM" else -0.02)
        cameras.append(camera)
    return cameras


def sensors_from_rig(options: SceneOptions) -> list[tuple[Array, Array]]:
    """Rotation and translation `sensor_from_rig` of each sensor: side by side, turned a little inwards."""
    sensors = []
    for k in range(options.sensors_per_frame):
        cos, sin = np.cos(0.05 * k), np.sin(0.05 * k)
        rotation = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        sensors.append((rotation, rotation @ [-0.1 * options.scene_size * k, 0, 0]))
    return sensors


def scene_points(options: SceneOptions, targets: Array, rng: np.random.Generator) -> Array:
    """A floor of smooth hills with loose points up to a tenth of `scene_size` about them, (num_points, 3)."""
    margin = 0.35 * options.footprint
    low, high = targets.min(axis=0) - margin, targets.max(axis=0) + margin
    xy = rng.uniform(low, high, (options.num_points, 2))
    hills = np.zeros(options.num_points)
    for _ in range(6):
        wave = rng.normal(size=2) * 4 / options.scene_size
        hills += np.sin(xy @ wave + rng.uniform(0, 2 * np.pi))
    hills = (hills - hills.min()) / max(np.ptp(hills), 1e-12) - 0.5
    z = options.camera_height + options.floor_relief * (0.7 * hills + 0.3 * rng.uniform(-0.5, 0.5, options.num_points))
    pier = np.argsort(abs(xy[:, 0] - 0.5 * (low + high)[0]))[: round(options.dry_point_ratio * options.num_points)]
    above = 0.25 * np.hypot(*options.footprint) * _largest_slope(options)
    above = above + options.scene_size * rng.uniform(0.02, 0.08, len(pier)) + 3 * options.wave_statistics.rms_height
    z[pier] = options.interface_height - np.minimum(above, 0.6 * options.interface_height)
    return np.column_stack([xy, z])


def world_planes(options: SceneOptions, targets: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Per frame, normal (n, 3) and offset (n,) of the interface in the world; it turns about the frame's target."""
    count = len(targets)
    shared = count if options.scenario == "static_interface" else options.frames_per_interface
    group = np.arange(count) // shared
    normals = np.column_stack([_largest_slope(options) * _unit_disc(count, rng), np.ones(count)])[group]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lift = _largest_lift(options) * rng.uniform(-1, 1, count)[group]
    height = options.interface_height + (0 if options.scenario == "static_interface" else lift)
    pivot = np.column_stack([targets[group * shared], np.broadcast_to(height, count)])
    return normals, np.einsum("ij,ij->i", normals, pivot)


def plane_scatter(options: SceneOptions) -> tuple[float, float]:
    """Standard deviations of what `world_planes` draws: slope along each axis, and lift at the target in metres."""
    # A uniform disc has a quarter of its squared radius along each axis, and an interval a third of its half's.
    lift = 0.0 if options.scenario == "static_interface" else _largest_lift(options)
    return _largest_slope(options) / 2, float(lift / np.sqrt(3))


def ports(options: SceneOptions) -> list[Plane]:
    """The port of each camera's housing, `(normal_in_cam, distance)`."""
    k = np.arange(options.num_cameras * options.sensors_per_frame)
    slope, azimuth = np.tan(np.radians(options.tilt_deg)), 0.7 + 2.39996 * k
    normals = np.stack([slope * np.cos(azimuth), slope * np.sin(azimuth), np.ones(len(k))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return list(zip(normals, (options.interface_height * (1 + 0.2 * k)).tolist(), strict=True))


def lay_out(options: SceneOptions, rng: np.random.Generator) -> Arrangement:
    """Everything that stands somewhere; images by frame, then by sensor.

    Raises:
        RefractError: an interface that reaches behind a camera.
    """
    targets = frame_targets(options, rng)
    rotations, centers = rig_poses(options, targets, rng)
    points = scene_points(options, targets, rng)
    normals, offsets = world_planes(options, targets, rng)
    every_camera, every_port, sensors = cameras(options), ports(options), sensors_from_rig(options)
    stations = []
    for frame, sensor in np.ndindex(len(targets), len(sensors)):
        k = frame % options.num_cameras * len(sensors) + sensor
        r = sensors[sensor][0] @ rotations[frame]
        t = sensors[sensor][1] - r @ centers[frame]
        housed = options.scenario == "camera_housing"
        plane = every_port[k] if housed else plane_in_cam(normals[frame], float(offsets[frame]), r, t)
        if plane[1] <= 0:
            raise RefractError("the interface reaches behind a camera: use less tilt_deg or more distance_ratio")
        folder = f"sensor{sensor + 1}/" if len(sensors) > 1 else ""
        stations.append(Station(frame, sensor, every_camera[k], r, t, plane, f"{folder}frame_{frame + 1:04d}.jpg"))
    return Arrangement(targets, points, stations)


def _largest_slope(options: SceneOptions) -> float:
    """Of a moving interface: its slope is uniform in a disc, so the largest is sqrt(2) of the mean square."""
    return 0.0 if options.scenario == "static_interface" else float(np.tan(np.radians(np.sqrt(2) * options.tilt_deg)))


def _largest_lift(options: SceneOptions) -> float:
    """Of a moving interface from its mean height, metres."""
    return 0.1 * min(0.5 * options.scene_size, options.interface_height)


def _unit_disc(count: int, rng: np.random.Generator) -> Array:
    """(count, 2), uniform in the disc of radius 1: successive azimuths a golden angle apart, to spread few well."""
    azimuth = 2.39996 * np.arange(count) + rng.uniform(0, 2 * np.pi)
    return np.asarray(np.sqrt(rng.random((count, 1))) * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1))
