"""Photographing a scene: the capture with its truth, and the model that COLMAP would make of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers, plane_in_world
from colmap_refract.options import Scenario
from colmap_refract.simulation import scene
from colmap_refract.simulation.least_path import least_path_direction
from colmap_refract.simulation.scene import Arrangement, Plane, SceneOptions, Station
from colmap_refract.simulation.surface import Surface
from colmap_refract.simulation.wave_path import least_crossings

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class Capture:
    """A simulated capture.

    `reconstruction` holds the true poses, points, cameras and tracks; only its keypoints carry noise.
    """

    options: SceneOptions
    reconstruction: pycolmap.Reconstruction
    planes: dict[int, Plane]
    """Per image id, `(normal_in_cam, distance)`; the normal is (3,). With waves, their mean plane."""
    pixels: dict[int, Array]
    """Per image id, the exact pixels of its keypoints, (n, 2)."""
    outliers: set[tuple[int, int]]
    """`(image_id, point2D_idx)` of the observations that are random pixels."""
    world_plane: Plane | None
    """`(normal_in_world, offset)` of a static interface."""
    surfaces: dict[int, Surface] = field(default_factory=dict)
    """Per image id, the surface in the world, with the waves of its frame if there are any."""
    crossings: dict[int, Array] = field(default_factory=dict)
    """Per image id, where the light of each keypoint enters the (first) interface, (n, 3), world frame, metres;
    not a number for dry points."""

    @property
    def scenario(self) -> Scenario:
        return self.options.scenario

    @property
    def layers(self) -> Layers:
        return self.options.layers

    def normals_in_cam(self, image_id: int) -> Array:
        """True unit normals (n, 3) of the surface where the light of each keypoint of an image crosses it.

        From the camera into the water, camera frame; not a number for dry points.
        """
        crossing, surface = self.crossings[image_id], self.surfaces[image_id]
        if len(surface.waves):
            normals = np.column_stack([-surface.gradient(crossing[:, :2]), np.ones(len(crossing))])
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        else:
            normals = np.where(np.isfinite(crossing), surface.normal, np.nan)
        rotation = self.reconstruction.image(image_id).cam_from_world().rotation.matrix()
        return np.asarray(normals @ rotation.T)

    def heights(self, image_id: int) -> Array:
        """How far (n,) the surface is above its mean plane where the light of each keypoint of an image crosses it.

        Metres along the plane's normal, positive towards the camera; not a number for dry points.
        """
        surface = self.surfaces[image_id]
        return np.asarray(surface.offset - self.crossings[image_id] @ surface.normal)


def simulate(
    options: SceneOptions, arrangement: Arrangement | None = None, *, waves: Sequence[Array] | None = None
) -> Capture:
    """Photograph a scene through the interface: a random one, or what is given.

    The floor of a random scene has a relief of about a quarter of `scene_size`. Keypoints of points that no other
    image sees are kept, without a 3D point, and point ids have gaps where points were left out.

    Args:
        options: of the camera, the noise and the waves; and of where things stand, for which they must be true (the
            bounds go by them) also where it is given.
        arrangement: targets, points and stations in place of what `scene.lay_out` draws.
        waves: of each frame (W, 4), as `Surface` has them, in place of what the options' statistics draw.

    Raises:
        RefractError: options that contradict each other or what is given, or an interface that reaches behind a
            camera.
    """
    rng, wave_rng = np.random.default_rng(options.seed), np.random.default_rng([options.seed, 1])
    plan = arrangement if arrangement is not None else scene.lay_out(options, rng)
    num_frames = options.num_images // options.sensors_per_frame
    if len(plan.stations) != options.num_images or (waves is not None and len(waves) != num_frames):
        raise RefractError(
            f"{options.num_images} images of {num_frames} frames need as many stations and waves: got "
            f"{len(plan.stations)} stations" + ("" if waves is None else f" and waves of {len(waves)} frames")
        )
    points, cameras, sensors = plan.points, scene.cameras(options), scene.sensors_from_rig(options)

    reach = 0.9 * np.hypot(*options.footprint)
    views: list[_View] = []
    for station in plan.stations:
        # A rig looks through one surface.
        if station.sensor > 0:
            surface = views[-1].surface
        else:
            given = None if waves is None else waves[station.frame]
            surface = _surface(station, options, wave_rng, given)
        target = plan.targets[station.frame]
        near = np.flatnonzero(np.linalg.norm(points[:, :2] - target, axis=1) < reach)
        in_cam = points[near] @ station.rotation.T + station.translation
        direction, crossing = _look(station, surface, in_cam)
        pixels, visible = _project(station.camera, direction, margin=4 * options.pixel_noise)
        views.append(_View(station, surface, near[visible], pixels[visible], crossing[visible]))

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
        planes={image_id: view.station.plane for image_id, view in enumerate(views, start=1)},
        pixels={image_id: view.pixels for image_id, view in enumerate(views, start=1)},
        outliers=outliers,
        world_plane=_world_plane(plan.stations[0]) if options.scenario == "static_interface" else None,
        surfaces={image_id: view.surface for image_id, view in enumerate(views, start=1)},
        crossings={image_id: view.crossings for image_id, view in enumerate(views, start=1)},
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


class _View(NamedTuple):
    """One image: where it was taken from and through what, the points it sees, their exact pixels (n, 2) and the
    places (n, 3) where their light crosses the surface."""

    station: Station
    surface: Surface
    seen: NDArray[np.int64]
    pixels: Array
    crossings: Array


def _world_plane(station: Station) -> Plane:
    return plane_in_world(*station.plane, station.rotation, station.translation)


def _surface(station: Station, options: SceneOptions, rng: np.random.Generator, waves: Array | None) -> Surface:
    """The interface at the moment that a station's images are taken at, with waves that are given or drawn."""
    if waves is None:
        waves = options.wave_statistics.draw(rng) if options.wave_slope_deg > 0 else np.empty((0, 4))
    normal, offset = _world_plane(station)
    return Surface(normal=normal, offset=offset, layers=options.layers, waves=waves)


def _look(station: Station, surface: Surface, points_in_cam: Array) -> tuple[Array, Array]:
    """Directions (n, 3) in which a camera sees points, camera frame, and where that light crosses the surface (n, 3).

    The crossing, in the world, is not a number for dry points; nor is the direction of a wet one that is not seen.
    """
    rotation, translation = station.rotation, station.translation
    center = -rotation.T @ translation
    if not len(surface.waves):
        normal, distance = station.plane
        direction = least_path_direction(points_in_cam, normal, distance, surface.layers)
        wet = points_in_cam @ normal > distance
        reach = np.divide(distance, direction @ normal, out=np.full(len(wet), np.nan), where=wet)
        return direction, center + reach[:, None] * direction @ rotation
    if not surface.depth_below(center)[0] < 0:
        raise RefractError("the waves reach above a camera: use less wave_slope_deg or more distance_ratio")
    points = (points_in_cam - translation) @ rotation
    crossing = least_crossings(surface, center, points)
    wet = surface.depth_below(points) > 0
    direction = np.where(wet[:, None], (crossing - center) @ rotation.T, points_in_cam)
    return direction / np.linalg.norm(direction, axis=1, keepdims=True), crossing


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
        frame_number, sensor, camera, rotation, translation, _, name = view.station
        if sensor == 0:
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
            rig_id = 1 + (camera.camera_id - 1) // len(sensors)
            frame = pycolmap.Frame(frame_id=frame_number + 1, rig_id=rig_id, rig_from_world=pose)
            for k in range(len(sensors)):
                frame.add_data_id(pycolmap.data_t(cameras[camera.camera_id - 1 + k].sensor_id, image_id + k))
            model.add_frame(frame)
        image = pycolmap.Image(name, keypoints[image_id - 1], camera.camera_id, image_id)
        image.frame_id = frame_number + 1
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
