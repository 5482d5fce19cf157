"""Simulated captures: scenes photographed through a plane interface, with the truth.

The projection here knows nothing of the solver's: the refracted ray is the path of least optical
length (Fermat), so an error in one is not hidden by the same error in the other.

The world's z axis points down into the water and its origin is at the height of the cameras, so the
floor lies at about z = `depth` and a level interface at z = `distance`. Lengths are metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers, plane_in_cam, tangent_basis

if TYPE_CHECKING:
    import pycolmap

Scenario = Literal["moving_interface", "static_interface", "fixed_camera", "camera_housing"]
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
    tilt_deg: float = 5.0
    """Root mean square tilt of moving interfaces from level, or the tilt of the ports in their housings."""
    frames_per_interface: int = 1
    """Successive frames that share one moving interface (moving interface and fixed camera)."""
    oblique_deg: float = 17.0
    """Mean angle between the view and the vertical; the images vary by a third of it. 0: nadir only."""
    dry_point_ratio: float = 0.0
    """Part of the points that stand out of the water, on a pier through the middle of the scene."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.num_images < 2 or self.num_images % self.sensors_per_frame:
            raise RefractError(f"{self.num_images} images: need two or more, a multiple of sensors_per_frame")
        if self.scenario == "fixed_camera" and (self.num_cameras > 1 or self.sensors_per_frame > 1):
            raise RefractError("fixed_camera has one camera: leave num_cameras and sensors_per_frame at 1")
        if self.scenario == "camera_housing" and self.dry_point_ratio > 0:
            raise RefractError("camera_housing has no dry points: leave dry_point_ratio at 0")

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
    def footprint(self) -> Array:
        """Width and height of the part of the mean floor that a vertical view shows, (2,), metres."""
        tangent = 0.5 * np.array([self.width, self.height]) / self.focal_length
        sine = np.minimum(tangent / np.hypot(1, tangent) / self.layers.refractive_index, 0.95)
        water = self.camera_height - self.interface_height
        return np.asarray(2 * (self.interface_height * tangent + water * sine / np.sqrt(1 - sine**2)))


@dataclass(frozen=True, kw_only=True)
class Capture:
    """A simulated capture.

    `reconstruction` holds the true poses, points, cameras and tracks; only its keypoints carry noise.
    """

    options: SceneOptions
    reconstruction: pycolmap.Reconstruction
    planes: dict[int, Plane]
    """Per image id, `(normal_in_cam, distance)`; the normal is (3,)."""
    pixels: dict[int, Array]
    """Per image id, the exact pixels of its keypoints, (n, 2)."""
    outliers: set[tuple[int, int]]
    """`(image_id, point2D_idx)` of the observations that are random pixels."""
    world_plane: Plane | None
    """`(normal_in_world, offset)` of a static interface."""

    @property
    def scenario(self) -> Scenario:
        return self.options.scenario

    @property
    def layers(self) -> Layers:
        return self.options.layers


def least_path_direction(
    points_in_cam: ArrayLike, normal_in_cam: ArrayLike, distance: ArrayLike, layers: Layers
) -> Array:
    """Directions in which a camera sees points through plane layers, by least optical path.

    Args:
        points_in_cam: (n, 3), camera frame. A point on the camera's side of the plane is seen straight,
            and one inside a wall through the media in front of it.
        normal_in_cam: (3,) or (n, 3), unit, from the camera into the water.
        distance: scalar or (n,), of the first interface, > 0, in the units of the points.
        layers: the media, any indices > 0, thicknesses in the units of the points.

    Returns:
        (n, 3) unit vectors, camera frame; not a number for a point at the projection centre.

    Raises:
        RefractError: a distance is not positive.
    """
    points = np.asarray(points_in_cam, dtype=np.float64).reshape(-1, 3)
    normal = np.broadcast_to(np.asarray(normal_in_cam, dtype=np.float64), points.shape)
    dist = np.broadcast_to(np.asarray(distance, dtype=np.float64), points.shape[:1])
    if not (dist > 0).all():
        raise RefractError("interface distance must be positive: it is measured from the camera towards the water")
    # A wall without thickness bends nothing, but its path length has a kink that Newton cannot take.
    walls = [(h, mu) for h, mu in zip(layers.thickness, layers.index, strict=False) if h > 0]
    thickness = np.array([h for h, _ in walls])
    index = np.array([1.0, *(mu for _, mu in walls), layers.refractive_index])

    depth = np.einsum("ij,ij->i", points, normal)
    radial = points - depth[:, None] * normal
    starts = dist[:, None] + np.concatenate([[0.0], np.cumsum(thickness)])
    crossed = (depth[:, None] > starts).sum(axis=1)
    out = points.copy()
    for count in range(1, len(index)):
        rows = np.flatnonzero(crossed == count)
        walls_here = np.broadcast_to(thickness[: count - 1], (len(rows), count - 1))
        heights = np.column_stack([dist[rows], walls_here, depth[rows] - starts[rows, count - 1]])
        share = _first_crossing(heights, index[: count + 1], np.linalg.norm(radial[rows], axis=1))
        out[rows] = dist[rows, None] * normal[rows] + share[:, None] * radial[rows]
    with np.errstate(invalid="ignore"):
        return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def _first_crossing(heights: Array, index: Array, radius: Array) -> Array:
    """Where the least path from (0, 0) to (radius, sum of heights) meets the first interface, over the radius.

    Damped Newton on the convex `sum_k mu_k sqrt(h_k^2 + (radius ds_k)^2)`. The unknowns are the crossings
    divided by the radius, and so are the derivatives: nothing is singular on the axis.
    """
    squared = radius[:, None] ** 2
    paraxial = np.cumsum(heights / index, axis=1)
    share = np.concatenate([np.zeros((len(radius), 1)), paraxial / paraxial[:, -1:]], axis=1)
    share[:, -1] = 1.0
    active = np.arange(len(radius))
    for _ in range(200):
        if active.size == 0:
            break
        s, h, r2 = share[active], heights[active], squared[active]
        legs = np.diff(s, axis=1)
        length = np.sqrt(h**2 + r2 * legs**2)
        cost, sine = length @ index, index * legs / length
        stiffness = index * (h / length) ** 2 / length
        gradient = sine[:, :-1] - sine[:, 1:]
        hessian = np.einsum("ni,ij->nij", stiffness[:, :-1] + stiffness[:, 1:], np.eye(len(index) - 1))
        for k in range(len(index) - 2):
            hessian[:, k, k + 1] = hessian[:, k + 1, k] = -stiffness[:, k + 1]
        step = -np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
        descent = r2[:, 0] * np.einsum("ij,ij->i", gradient, step)
        factor = np.ones(len(active))
        for _ in range(60):
            legs = np.diff(np.pad(factor[:, None] * step, ((0, 0), (1, 1))), axis=1) + np.diff(s, axis=1)
            trial = np.sqrt(h**2 + r2 * legs**2) @ index
            # The last term is the rounding of the cost: near the minimum it cannot judge a step.
            worse = trial > cost + 1e-4 * factor * descent + 1e-15 * cost
            if not worse.any():
                break
            factor[worse] *= 0.5
        share[active, 1:-1] += factor[:, None] * step
        active = active[-descent > 1e-24 * cost]
    return np.asarray(share[:, 1])


class _View(NamedTuple):
    """One image: who took it, its pose and plane, the points it sees and their exact pixels (n, 2)."""

    frame: int
    sensor: int
    camera: pycolmap.Camera
    rotation: Array
    translation: Array
    plane: Plane
    seen: NDArray[np.int64]
    pixels: Array


def simulate(options: SceneOptions) -> Capture:
    """Photograph a random scene through the interface.

    The floor has a relief of about a quarter of `scene_size`. Keypoints of points that no other image sees
    are kept, without a 3D point, and point ids have gaps where points were left out.

    Raises:
        RefractError: options that contradict each other, or an interface that reaches behind a camera.
    """
    rng = np.random.default_rng(options.seed)
    targets = _targets(options, rng)
    rotations, centers = _rig_poses(options, targets, rng)
    points = _scene_points(options, targets, rng)
    normals, offsets = _world_planes(options, targets, rng)
    cameras, ports, sensors = _cameras(options), _ports(options), _sensors_from_rig(options)

    reach = 0.9 * np.hypot(*options.footprint)
    views = []
    for frame, sensor in np.ndindex(len(targets), len(sensors)):
        near = np.flatnonzero(np.linalg.norm(points[:, :2] - targets[frame], axis=1) < reach)
        k = frame % options.num_cameras * len(sensors) + sensor
        r = sensors[sensor][0] @ rotations[frame]
        t = sensors[sensor][1] - r @ centers[frame]
        housed = options.scenario == "camera_housing"
        normal, distance = ports[k] if housed else plane_in_cam(normals[frame], float(offsets[frame]), r, t)
        if distance <= 0:
            raise RefractError("the interface reaches behind a camera: use less tilt_deg or more distance_ratio")
        direction = least_path_direction(points[near] @ r.T + t, normal, distance, options.layers)
        pixels, visible = _project(cameras[k], direction, margin=4 * options.pixel_noise)
        views.append(_View(frame, sensor, cameras[k], r, t, (normal, distance), near[visible], pixels[visible]))

    num_seen = np.bincount(np.concatenate([view.seen for view in views]), minlength=len(points))
    outliers: set[tuple[int, int]] = set()
    keypoints = []
    for image_id, view in enumerate(views, start=1):
        noisy = view.pixels + options.pixel_noise * rng.standard_normal(view.pixels.shape)
        wrong = np.flatnonzero((rng.random(len(noisy)) < options.outlier_ratio) & (num_seen[view.seen] > 1))
        noisy[wrong] = rng.random((len(wrong), 2)) * [options.width, options.height]
        keypoints.append(noisy)
        outliers.update((image_id, idx) for idx in wrong.tolist())
    return Capture(
        options=options,
        reconstruction=_reconstruction(cameras, sensors, views, keypoints, points, num_seen > 1),
        planes={image_id: view.plane for image_id, view in enumerate(views, start=1)},
        pixels={image_id: view.pixels for image_id, view in enumerate(views, start=1)},
        outliers=outliers,
        world_plane=(normals[0], float(offsets[0])) if options.scenario == "static_interface" else None,
    )


def ignore_refraction(
    capture: Capture,
    *,
    perturbation: float = 0.01,
    seed: int = 0,
    num_threads: int = 1,
    refine_intrinsics: bool = False,
) -> pycolmap.Reconstruction:
    """The model that COLMAP makes of a capture: bundle adjustment without refraction.

    With a fixed camera there is no such model: all poses are the true one, and each point is put at the
    floor's mean depth along the mean ray of its keypoints.

    Args:
        perturbation: noise on the true poses and points before the adjustment, in radians and in depths.
        seed: of that noise.
        num_threads: of the adjustment; -1 for all.
        refine_intrinsics: also focal length and distortion, which then absorb part of the refraction.
    """
    import pycolmap

    model = pycolmap.Reconstruction(capture.reconstruction)
    if capture.scenario == "fixed_camera":
        _flatten(model, capture.options.camera_height)
        return model
    rng = np.random.default_rng(seed)
    size = perturbation * capture.options.camera_height
    for frame in model.frames.values():
        rotation = pycolmap.Rotation3d(perturbation * rng.standard_normal(3))
        frame.rig_from_world = pycolmap.Rigid3d(rotation, size * rng.standard_normal(3)) * frame.rig_from_world
    for point in model.points3D.values():
        point.xyz = point.xyz + size * rng.standard_normal(3)

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = refine_intrinsics
    options.refine_sensor_from_rig = False
    options.ceres.solver_options.num_threads = num_threads
    options.ceres.solver_options.function_tolerance = 1e-9
    if capture.outliers:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # What pycolmap.bundle_adjustment does, without its lines on standard error.
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    return model


def point_rmse(reconstruction: pycolmap.Reconstruction, capture: Capture, robust: bool = False) -> float:
    """Distance of the points to the truth after a similarity alignment, in metres.

    Args:
        reconstruction: a model with the capture's point ids; those it lacks are left out.
        robust: the median distance, aligned to the best 90 % of the points, in place of the root mean square.

    Raises:
        RefractError: fewer than three points in common.
    """
    truth = capture.reconstruction
    common = sorted(set(reconstruction.point3D_ids()) & set(truth.point3D_ids()))
    if len(common) < 3:
        raise RefractError(f"{len(common)} points in common with the truth; three are needed")
    source = np.array([reconstruction.points3D[i].xyz for i in common])
    target = np.array([truth.points3D[i].xyz for i in common])
    if not robust:
        return float(np.sqrt(np.mean(np.sum((_align(source, target, source) - target) ** 2, axis=1))))
    # Runaway points would spoil a first alignment, and they are far from the others.
    error = np.linalg.norm(source - np.median(source, axis=0), axis=1)
    for _ in range(20):
        best = np.argsort(error)[: max(3, int(0.9 * len(error)))]
        error = np.linalg.norm(_align(source[best], target[best], source) - target, axis=1)
    return float(np.median(error))


def _align(source: Array, target: Array, points: Array) -> Array:
    """`points` moved by the similarity that brings `source` to `target` (Umeyama 1991)."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    u, singular, vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    scale = singular @ sign / np.sum((source - source_mean) ** 2)
    return np.asarray(scale * (points - source_mean) @ (u * sign @ vt).T + target_mean)


def _unit_disc(count: int, rng: np.random.Generator) -> Array:
    """(count, 2), uniform in the disc of radius 1: successive azimuths a golden angle apart, to spread few well."""
    azimuth = 2.39996 * np.arange(count) + rng.uniform(0, 2 * np.pi)
    return np.asarray(np.sqrt(rng.random((count, 1))) * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1))


def _targets(options: SceneOptions, rng: np.random.Generator) -> Array:
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


def _rig_poses(options: SceneOptions, targets: Array, rng: np.random.Generator) -> tuple[Array, Array]:
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


def _scene_points(options: SceneOptions, targets: Array, rng: np.random.Generator) -> Array:
    """A floor of smooth hills with loose points up to a tenth of `scene_size` about them, (num_points, 3)."""
    margin = 0.35 * options.footprint
    low, high = targets.min(axis=0) - margin, targets.max(axis=0) + margin
    xy = rng.uniform(low, high, (options.num_points, 2))
    hills = np.zeros(options.num_points)
    for _ in range(6):
        wave = rng.normal(size=2) * 4 / options.scene_size
        hills += np.sin(xy @ wave + rng.uniform(0, 2 * np.pi))
    water = options.camera_height - options.interface_height
    relief = min(0.25 * options.scene_size, 0.7 * water)
    hills = (hills - hills.min()) / max(np.ptp(hills), 1e-12) - 0.5
    z = options.camera_height + relief * (0.7 * hills + 0.3 * rng.uniform(-0.5, 0.5, options.num_points))
    pier = np.argsort(abs(xy[:, 0] - 0.5 * (low + high)[0]))[: round(options.dry_point_ratio * options.num_points)]
    above = 0.25 * np.hypot(*options.footprint) * _largest_slope(options)
    above = above + options.scene_size * rng.uniform(0.02, 0.08, len(pier))
    z[pier] = options.interface_height - np.minimum(above, 0.6 * options.interface_height)
    return np.column_stack([xy, z])


def _largest_slope(options: SceneOptions) -> float:
    """Of a moving interface: its slope is uniform in a disc, so the largest is sqrt(2) of the mean square."""
    return 0.0 if options.scenario == "static_interface" else float(np.tan(np.radians(np.sqrt(2) * options.tilt_deg)))


def _world_planes(options: SceneOptions, targets: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Per frame, normal (n, 3) and offset (n,) of the interface in the world; it turns about the frame's target."""
    count = len(targets)
    shared = count if options.scenario == "static_interface" else options.frames_per_interface
    group = np.arange(count) // shared
    normals = np.column_stack([_largest_slope(options) * _unit_disc(count, rng), np.ones(count)])[group]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lift = 0.1 * min(0.5 * options.scene_size, options.interface_height) * rng.uniform(-1, 1, count)[group]
    height = options.interface_height + (0 if options.scenario == "static_interface" else lift)
    pivot = np.column_stack([targets[group * shared], np.broadcast_to(height, count)])
    return normals, np.einsum("ij,ij->i", normals, pivot)


def _ports(options: SceneOptions) -> list[Plane]:
    """The port of each camera's housing, `(normal_in_cam, distance)`."""
    k = np.arange(options.num_cameras * options.sensors_per_frame)
    slope, azimuth = np.tan(np.radians(options.tilt_deg)), 0.7 + 2.39996 * k
    normals = np.stack([slope * np.cos(azimuth), slope * np.sin(azimuth), np.ones(len(k))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return list(zip(normals, (options.interface_height * (1 + 0.2 * k)).tolist(), strict=True))


def _cameras(options: SceneOptions) -> list[pycolmap.Camera]:
    """Cameras 1, 2, ... of slightly different focal lengths, mildly distorted where the model can."""
    import pycolmap

    cameras = []
    for k in range(options.num_cameras * options.sensors_per_frame):
        focal_length = options.focal_length * (1 + 0.02 * k)
        camera = pycolmap.Camera.create_from_model_name(
            k + 1, options.camera_model, focal_length, options.width, options.height
        )
        for idx in camera.extra_params_idxs()[:1]:
            # The field-of-view model has no undistorted state and comes with a value already.
            camera.params[idx] = camera.params[idx] or (0.1 if options.camera_model == "EUCM" else -0.02)
        cameras.append(camera)
    return cameras


def _sensors_from_rig(options: SceneOptions) -> list[tuple[Array, Array]]:
    """Rotation and translation `sensor_from_rig` of each sensor: side by side, turned a little inwards."""
    sensors = []
    for k in range(options.sensors_per_frame):
        cos, sin = np.cos(0.05 * k), np.sin(0.05 * k)
        rotation = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        sensors.append((rotation, rotation @ [-0.1 * options.scene_size * k, 0, 0]))
    return sensors


def _project(camera: pycolmap.Camera, directions: Array, *, margin: float) -> tuple[Array, NDArray[np.int64]]:
    """Pixels (n, 2), and the indices of those that lie in the image."""
    pixels = np.asarray(camera.img_from_cam(directions))
    inside = (pixels >= margin) & (pixels < np.array([camera.width, camera.height]) - margin)
    visible = np.flatnonzero(inside.all(axis=1))
    # A distortion polynomial folds directions far outside the view back into the image.
    rays = camera.cam_ray_from_img(pixels[visible])
    return pixels, visible[np.einsum("ij,ij->i", rays, directions[visible]) > 1 - 1e-9]


def _reconstruction(
    cameras: list[pycolmap.Camera],
    sensors: list[tuple[Array, Array]],
    views: list[_View],
    keypoints: list[Array],
    points: Array,
    kept: NDArray[np.bool_],
) -> pycolmap.Reconstruction:
    """The capture as a COLMAP model: all ids count from 1, and point `i` has the id `i + 1`."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera(camera)
    for first in range(0, len(cameras), len(sensors)):
        rig = pycolmap.Rig(rig_id=1 + first // len(sensors))
        rig.add_ref_sensor(cameras[first].sensor_id)
        for camera, (rotation, translation) in zip(cameras[first + 1 :], sensors[1:], strict=False):
            rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation))
        model.add_rig(rig)
    for image_id, view in enumerate(views, start=1):
        if view.sensor == 0:
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(view.rotation), view.translation)
            rig_id = 1 + (view.camera.camera_id - 1) // len(sensors)
            frame = pycolmap.Frame(frame_id=view.frame + 1, rig_id=rig_id, rig_from_world=pose)
            for k in range(len(sensors)):
                frame.add_data_id(pycolmap.data_t(cameras[view.camera.camera_id - 1 + k].sensor_id, image_id + k))
            model.add_frame(frame)
        folder = f"sensor{view.sensor + 1}/" if len(sensors) > 1 else ""
        name = f"{folder}frame_{view.frame + 1:04d}.jpg"
        image = pycolmap.Image(name, keypoints[image_id - 1], view.camera.camera_id, image_id)
        image.frame_id = view.frame + 1
        model.add_image(image)
    for frame_id in list(model.frames):
        model.register_frame(frame_id)

    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points]
    for image_id, view in enumerate(views, start=1):
        for idx, point in enumerate(view.seen.tolist()):
            tracks[point].append(pycolmap.TrackElement(image_id, idx))
    level = (points[:, 2] - points[:, 2].min()) / max(np.ptp(points[:, 2]), 1e-12)
    ramp = zip([235, 215, 150], [70, 180, 170], [20, 50, 120], strict=True)  # sand above, deep blue below
    colors = np.stack([np.interp(level, [0, 0.5, 1], channel) for channel in ramp], axis=1).astype(np.uint8)
    for point in np.flatnonzero(kept).tolist():
        track = pycolmap.Track(tracks[point])
        model.add_point3D_with_id(point + 1, pycolmap.Point3D(xyz=points[point], color=colors[point], track=track))
    return model


def _flatten(model: pycolmap.Reconstruction, depth: float) -> None:
    """Put every point at one depth along the mean ray of its keypoints, in a model with a single pose."""
    total = {point3D_id: np.zeros(3) for point3D_id in model.point3D_ids()}
    for image in model.images.values():
        points2D = image.get_observation_points2D()
        rays = image.camera.cam_ray_from_img(np.array([point2D.xy for point2D in points2D]))
        for point2D, ray in zip(points2D, rays, strict=True):
            total[point2D.point3D_id] += ray
    world_from_cam = model.images[1].cam_from_world().inverse()
    for point3D_id, ray in total.items():
        model.points3D[point3D_id].xyz = world_from_cam * (depth / ray[2] * ray)
