"""A solution put back: into the model's frame and size, into its poses, points and tracks, and into the sidecar."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_refract.estimator.adjustment import Adjustment
from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.scenario import State
from colmap_refract.files.sidecar import ImageInterface, Sidecar, WorldPlane
from colmap_refract.interface import Array, plane_in_cam
from colmap_refract.options import ImageNotes
from colmap_refract.refiner.advice import has_converged
from colmap_refract.refiner.alignment import Similarity, align_poses, rescale_about
from colmap_refract.refiner.arrangement import Arrangement
from colmap_refract.refiner.observations import Observations
from colmap_refract.refiner.selection import Selection
from colmap_refract.refiner.uncertainty import Uncertainty

if TYPE_CHECKING:
    import pycolmap


def _stays(arrangement: Arrangement) -> bool:
    """Whether the world's frame and size are the input's by what is held."""
    poses_known = bool(arrangement.held.poses.all()) and arrangement.options.scenario != "fixed_camera"
    return arrangement.held.points or poses_known


def output_frame(arrangement: Arrangement, state: State, points: Array) -> Similarity:
    """From units of the solve to the output: the input's frame and size, or metres."""
    options, observations = arrangement.options, arrangement.observations
    back = Similarity(scale=arrangement.unit, rotation=np.eye(3), translation=arrangement.origin)
    if _stays(arrangement):
        return back
    # What the size is to be: the input's, by default.
    scale = 1.0 if arrangement.scale_known else None
    if options.interface_distance is not None and not arrangement.scale_known:
        _, distance = state.planes_in_cam(arrangement.structure)
        scale = options.interface_distance / (arrangement.unit * float(distance[arrangement.reference]))
    target = observations.cam_from_world
    aligned = None
    if options.scenario != "fixed_camera":
        aligned = align_poses(state.cam_from_world(arrangement.structure), target, spread=1e-3, scale=scale)
    if aligned is None:
        # The cameras stand at one place: their distance to the points tells the size.
        center = -target[0][arrangement.reference].T @ target[1][arrangement.reference]
        if scale is None:
            before = np.median(np.linalg.norm(observations.points - center, axis=1))
            scale = float(before / np.median(np.linalg.norm(points - center, axis=1)))
        aligned = rescale_about(center, scale)
    return Similarity(
        scale=back.scale * aligned.scale,
        rotation=aligned.rotation,
        translation=back.scale * aligned.translation + back.translation,
    )


def write_back(
    model: pycolmap.Reconstruction,
    arrangement: Arrangement,
    problem: Problem,
    errors: Array,
    to_output: Similarity,
    stays: Observations,
) -> None:
    """Poses, points, errors and intrinsics into the model, and what is not in `stays` out of it."""
    import pycolmap

    observations, state = arrangement.observations, problem.state
    rotation, translation = to_output.cam_from_world(state.rotation, state.translation)
    reference = int(observations.image_frame[arrangement.reference])
    original = model.frame(int(observations.frame_ids[reference])).rig_from_world
    for f, frame_id in enumerate(observations.frame_ids):
        pose = arrangement.frame_pose[f]
        moved = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation[pose]), translation[pose])
        if arrangement.held.poses[pose]:
            # What was held comes out to the last digit, where the output's frame is the input's.
            if _stays(arrangement):
                continue
            if arrangement.options.scenario == "fixed_camera" and pose == arrangement.frame_pose[reference]:
                moved = pycolmap.Rigid3d(original.rotation, original.translation)
        model.frame(int(frame_id)).rig_from_world = moved
    for camera_id, camera in zip(observations.camera_ids, observations.cameras, strict=True):
        model.camera(int(camera_id)).params = list(camera.params)
    keep_only(model, observations, stays)
    points = to_output.points(problem.points)
    mean_error = np.add.reduceat(errors, observations.start[:-1]) / np.diff(observations.start)
    for point3D_id, xyz, error in zip(observations.point3D_ids.tolist(), points, mean_error, strict=True):
        point = model.point3D(point3D_id)
        if not arrangement.held.points:
            point.xyz = xyz
        point.error = float(error)


def keep_only(model: pycolmap.Reconstruction, points: Observations, stays: Observations) -> None:
    """Take out of the model the points that are not among `points`, and the observations that are not in `stays`."""
    kept_points = set(points.point3D_ids.tolist())
    image_id = stays.image_ids[stays.image]
    kept = set(zip(image_id.tolist(), stays.point2D_idx.tolist(), strict=True))
    for point3D_id in list(model.point3D_ids()):
        if point3D_id not in kept_points:
            model.delete_point3D(point3D_id)
            continue
        # Elements are live references into a list that deleting changes.
        elements = [(e.image_id, e.point2D_idx) for e in model.point3D(point3D_id).track.elements]
        for element in elements:
            if element not in kept:
                model.delete_observation(*element)


def make_sidecar(
    arrangement: Arrangement,
    notes: ImageNotes,
    problem: Problem,
    adjustment: Adjustment,
    uncertainty: Uncertainty,
    noise: float,
    to_output: Similarity,
    warnings: list[str],
) -> Sidecar:
    observations, structure, state = arrangement.observations, arrangement.structure, problem.state
    scale = to_output.scale
    layers = problem.layers.with_index(state.index).scaled(scale)
    names = _plane_names(arrangement)
    world_planes = {}
    for block in np.flatnonzero(structure.plane_in_world).tolist():
        offset = state.distance[block] + state.normal[block] @ structure.plane_anchor[block]
        normal, offset = to_output.plane(state.normal[block], float(offset))
        world_planes[names[block]] = WorldPlane(normal_in_world=_unit(normal), offset=offset)
    rotation, translation = to_output.cam_from_world(*state.cam_from_world(structure))
    cam_normal, cam_distance = state.planes_in_cam(structure)
    images = {}
    for i, name in enumerate(observations.image_names):
        block = int(structure.image_plane[i])
        if block < 0:
            images[name] = ImageInterface(image_id=int(observations.image_ids[i]))
            continue
        normal, distance = cam_normal[i], scale * float(cam_distance[i])
        if structure.plane_in_world[block]:
            plane = world_planes[names[block]]
            normal, distance = plane_in_cam(np.array(plane.normal_in_world), plane.offset, rotation[i], translation[i])
        images[name] = ImageInterface(
            image_id=int(observations.image_ids[i]),
            normal_in_cam=_unit(normal),
            distance=distance,
            group=names[block],
            normal_std_deg=_finite(np.degrees(uncertainty.normal[block]) * noise),
            distance_std=_finite(scale * uncertainty.distance[block] * noise),
        )
    metric = arrangement.options.interface_distance is not None
    length = "metre" if metric else "unit of the input model"
    options = asdict(arrangement.options)
    options["dry_images"] = sorted(notes.dry_images)
    options["interface_groups"] = dict(notes.interface_groups)
    return Sidecar(
        scenario=arrangement.options.scenario,
        layers=layers,
        images=images,
        world_planes=world_planes,
        units={
            "distance": length, "offset": length, "thickness": length, "distance_std": length,
            "normal_std_deg": "degree", "reprojection_error": "pixel", "noise": "pixel",
        },
        options=options,
        solver={
            "termination": adjustment.termination,
            "converged": has_converged(adjustment, uncertainty),
            "message": adjustment.message,
            "num_iterations": adjustment.num_iterations,
            "cost": adjustment.cost,
            "gradient_max_norm": adjustment.gradient_max_norm,
            "newton_decrement": uncertainty.decrement,
            "loss_function_type": problem.loss,
            "loss_function_scale": problem.loss_scale,
            "refractive_index": state.index,
            "refractive_index_std": _finite(uncertainty.index * noise),
            "reference_image": observations.image_names[arrangement.reference],
            "warnings": list(warnings),
        },
        statistics={},
    )  # fmt: skip


def statistics(
    reconstruction: pycolmap.Reconstruction,
    model: pycolmap.Reconstruction,
    before: Array,
    errors: Array,
    selection: Selection,
    num_unusable: int,
    problem: Problem,
    noise: float,
    seconds: tuple[float, float],
) -> dict[str, Any]:
    seen = before[np.isfinite(before)]
    marks = selection.marks
    refracted = problem.structure.image_plane[problem.tracks.image] >= 0
    return {
        "num_images": model.num_images(),
        "num_reg_images": model.num_reg_images(),
        "num_points3D_before": reconstruction.num_points3D(),
        "num_points3D": model.num_points3D(),
        "num_observations_before": reconstruction.compute_num_observations(),
        "num_observations": model.compute_num_observations(),
        "mean_pinhole_error_before": float(seen.mean()) if len(seen) else None,
        "median_pinhole_error_before": float(np.median(seen)) if len(seen) else None,
        "mean_reprojection_error": float(errors.mean()),
        "median_reprojection_error": float(np.median(errors)),
        "noise": noise,
        "num_filtered_large_error": marks.num_large_error if marks else 0,
        "num_filtered_small_angle": marks.num_small_angle if marks else 0,
        "num_unusable_observations": num_unusable,
        "num_dry_observations": int((refracted & ~problem.tracks.wet).sum()),
        "solve_seconds": seconds[0],
        "total_seconds": seconds[1],
    }


def _plane_names(arrangement: Arrangement) -> list[str]:
    """A name for each plane: its group's, or what the scenario ties it to."""
    observations, structure = arrangement.observations, arrangement.structure
    names = []
    for block, group in enumerate(arrangement.plane_names):
        first = int(np.flatnonzero(structure.image_plane == block)[0])
        if group is not None:
            names.append(group)
        elif arrangement.options.scenario == "static_interface":
            names.append("world")
        elif arrangement.options.scenario == "camera_housing":
            names.append(f"camera {observations.camera_ids[observations.image_camera[first]]}")
        else:
            names.append(observations.image_names[first])
    return names


def _unit(vector: Array) -> tuple[float, float, float]:
    x, y, z = (vector / np.linalg.norm(vector)).tolist()
    return x, y, z


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
