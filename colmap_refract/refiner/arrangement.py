"""A model and a user's options as a refractive adjustment: units, tying, what is held, and where to start."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from difflib import get_close_matches

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.estimator.chunk import Held, Problem
from colmap_refract.estimator.elimination import Tracks
from colmap_refract.estimator.scenario import Index, State, Structure, share_planes
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.interface import Array, Layers, plane_in_cam, plane_in_world
from colmap_refract.options import ImageNotes, RefinerOptions, Scenario
from colmap_refract.refiner.observations import Observations, lens_jacobian
from colmap_refract.refiner.start import image_depths, start_planes

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Arrangement:
    """What is to be solved, before any start value is chosen.

    The origin is the reference camera's centre and the unit the median depth: then tolerances and start
    values mean the same for a model of any size.

    Attributes:
        options: the user's.
        observations: in units of the solve; their poses are the tied ones.
        structure, held: the tying, and what is left as it is.
        plane_names: (B,) name of each plane's group, or None.
        frame_pose: (F,) pose block of each frame.
        reference: index of the reference image.
        origin: (3,) model coordinates of the solve's origin.
        unit: model units per unit of the solve.
        scale_known: whether the model's size is known: poses or points are held, or its rig has a baseline.
        lens_parameters: per camera, the indices of the intrinsic parameters that are refined.
    """

    options: RefinerOptions
    observations: Observations
    structure: Structure
    held: Held
    plane_names: list[str | None]
    frame_pose: Index
    reference: int
    origin: Array
    unit: float
    scale_known: bool
    lens_parameters: list[list[int]]

    def layers(self, distance: float) -> Layers:
        """The media in units of the solve.

        Where the wall's thickness is known in metres but the model's size is not, the reference image's
        `distance` (which is held then) tells how thick the wall is.
        """
        options = self.options
        if options.interface_distance is None or self.scale_known:
            return options.layers.scaled(1.0 / self.unit)
        return options.layers.scaled(distance / options.interface_distance)

    @property
    def pinned_pose(self) -> int | None:
        """The pose block that keeps the size where only a wall would tell it: the one farthest from the reference."""
        options = self.options
        if not any(options.layer_thickness) or self.scale_known or options.interface_distance is not None:
            return None
        frame = int(np.argmax(np.linalg.norm(self.observations.rig_from_world_translation, axis=1)))
        return int(self.frame_pose[frame])

    @property
    def normal(self) -> Array | None:
        """The unit normal that the options give, in the camera's frame."""
        if self.options.interface_normal is None:
            return None
        normal = np.array(self.options.interface_normal, dtype=np.float64)
        return np.asarray(normal / np.linalg.norm(normal))

    @property
    def ratio(self) -> float | None:
        """Interface distance over median depth, where the options say it."""
        options = self.options
        if options.interface_distance is not None and self.scale_known:
            return options.interface_distance / self.unit
        return options.initial_distance_ratio

    def start(self, ratio: float, observations: Observations) -> Problem:
        """The adjustment of some of the observations, from a distance at `ratio` of the median depth.

        Args:
            ratio: interface distance over median depth.
            observations: a selection of this arrangement's.

        Returns:
            A problem in which every observation of an image with an interface is taken to be wet.
        """
        options, structure = self.options, self.structure
        normal, distance = start_planes(self.observations, structure, ratio, self.normal, self.reference)
        if not options.refine_interface_distance:
            rotation, translation = self.observations.cam_from_world
            centers = -np.einsum("nji,nj->ni", rotation, translation)
            for block in range(structure.num_planes):
                image = int(np.flatnonzero(structure.image_plane == block)[0])
                image = self.reference if structure.image_plane[self.reference] == block else image
                lever = (
                    centers[image] - structure.plane_anchor[block] if structure.plane_in_world[block] else np.zeros(3)
                )
                distance[block] = ratio + normal[block] @ lever
        num_poses = structure.num_poses
        pose_frame = np.array([int(np.flatnonzero(self.frame_pose == p)[0]) for p in range(num_poses)])
        num_lens = max((len(p) for p in self.lens_parameters), default=0)
        state = State(
            rotation=observations.rig_from_world_rotation[pose_frame],
            translation=observations.rig_from_world_translation[pose_frame],
            normal=normal,
            distance=distance,
            index=options.refractive_index,
            lens=np.zeros((len(observations.cameras), num_lens)),
        )
        return Problem(
            tracks=self.tracks(observations),
            structure=structure,
            layers=self.layers(float(state.planes_in_cam(structure)[1][self.reference])),
            state=state,
            points=observations.points,
            held=self.held,
            pinned_pose=self.pinned_pose,
        )

    def resume(self, earlier: Sidecar) -> Problem:
        """The adjustment of all observations, from the interfaces of an earlier one of the same images.

        An image that had no part in that one starts from the mean of the others' interfaces.
        """
        observations, structure = self.observations, self.structure
        problem = self.start(0.5, observations)
        rotation, translation = observations.cam_from_world
        in_cam: list[tuple[Array, float] | None] = []
        for name in observations.image_names:
            image = earlier.images.get(name)
            known = image is not None and image.normal_in_cam is not None and image.distance is not None
            in_cam.append((np.array(image.normal_in_cam), image.distance / self.unit) if known else None)  # type: ignore
        in_world = [
            None if plane is None else plane_in_world(*plane, rotation[i], translation[i])
            for i, plane in enumerate(in_cam)
        ]
        normal, distance = problem.state.normal.copy(), problem.state.distance.copy()
        for block in range(structure.num_planes):
            images = np.flatnonzero(structure.image_plane == block).tolist()
            fixed_in_world = bool(structure.plane_in_world[block])
            new = not any(in_cam[i] is not None for i in images)
            # A plane that nobody has seen yet is like the others, in the frame that those are alike in.
            like = range(len(in_cam)) if new else images
            alike_in_world = fixed_in_world or (new and self.options.scenario != "camera_housing")
            found = [plane for i in like if (plane := (in_world if alike_in_world else in_cam)[i]) is not None]
            if not found:
                continue
            mean = np.mean([n for n, _ in found], axis=0)
            mean, offset = mean / np.linalg.norm(mean), float(np.mean([d for _, d in found]))
            if fixed_in_world:
                normal[block], distance[block] = mean, offset - mean @ structure.plane_anchor[block]
            elif alike_in_world:
                normal[block], distance[block] = plane_in_cam(mean, offset, rotation[images[0]], translation[images[0]])
            else:
                normal[block], distance[block] = mean, offset
        state = replace(problem.state, normal=normal, distance=distance, index=earlier.layers.refractive_index)
        layers = self.layers(float(state.planes_in_cam(structure)[1][self.reference]))
        return replace(problem, state=state, layers=layers)

    def tracks(self, observations: Observations, predicted: Array | None = None) -> Tracks:
        """The kernel's view of observations, all of images with an interface taken to be wet.

        Args:
            predicted: (N, 3) directions at which a change of the intrinsics is judged; the keypoints' own by
                default. Theirs carry the noise, which then looks like a trend of the focal length.
        """
        at = observations.direction if predicted is None else predicted
        num_lens = max((len(p) for p in self.lens_parameters), default=0)
        lens = np.zeros((len(observations.image), 2, num_lens))
        if num_lens:
            camera_of = observations.image_camera[observations.image]
            for c, camera in enumerate(observations.cameras):
                mine = np.flatnonzero(camera_of == c)
                parameters = self.lens_parameters[c]
                lens[mine, :, : len(parameters)] = lens_jacobian(camera, at[mine], parameters)
            if observations.weight is not None:
                lens *= observations.weight[:, None, None]
        return Tracks(
            start=observations.start,
            image=observations.image.astype(np.int32),
            direction=observations.direction,
            metric=observations.metric,
            lens=lens,
            wet=self.structure.image_plane[observations.image] >= 0,
        )


def arrange(
    observations: Observations, options: RefinerOptions, notes: ImageNotes, *, refined: bool = False
) -> Arrangement:
    """Tie the images of a model according to the scenario, in units of the solve.

    Args:
        refined: whether poses and points are those of an earlier refinement, and so right with a fixed camera, too.

    Raises:
        RefractError: an image name that is not in the model, a group that says two things, too few points
            for the unknowns, or options that do not fit the model.
    """
    names = observations.image_names
    _check_names(names, options, notes)
    reference = _reference_image(observations, options, notes)
    dry = [name in notes.dry_images for name in names]
    if all(dry):
        raise RefractError("every image is listed as dry: nothing is refracted; use pycolmap.bundle_adjustment")
    if dry[reference]:
        raise RefractError(f"the reference image '{names[reference]}' is listed as dry: name one with an interface")
    groups = [notes.interface_groups.get(name) for name in names]
    scenario = options.scenario
    image_plane, in_world, plane_names = share_planes(
        scenario, observations.image_frame.tolist(), observations.image_camera.tolist(), groups, dry
    )
    _check_counts(observations, scenario, image_plane, plane_names)

    frame_pose = np.arange(len(observations.frame_ids))
    if scenario == "fixed_camera":
        observations, frame_pose = _fix_camera(
            observations, reference, options.BundleAdjustment.refine_points3D and not refined
        )
    moved, origin, unit = _to_solve_units(observations, reference)
    rotation, translation = moved.cam_from_world
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    anchor = np.zeros((len(in_world), 3))
    for block in range(len(in_world)):
        images = np.flatnonzero(image_plane == block)
        anchor[block] = centers[reference if image_plane[reference] == block else images[0]]
    structure = Structure(
        image_pose=frame_pose[moved.image_frame],
        image_plane=image_plane,
        image_camera=moved.image_camera,
        sensor_rotation=moved.sensor_rotation,
        sensor_translation=moved.sensor_translation,
        plane_in_world=in_world,
        plane_anchor=anchor,
    )
    adjustment = options.BundleAdjustment
    poses_known = not adjustment.refine_rig_from_world and scenario != "fixed_camera"
    rigid = bool(np.abs(moved.sensor_translation).max() > 1e-9)
    scale_known = poses_known or rigid or not adjustment.refine_points3D
    if (
        any(options.layer_thickness)
        and scenario == "fixed_camera"
        and options.interface_distance is None
        and not scale_known
    ):
        raise RefractError(
            "layer_thickness says nothing to a fixed camera, whose model has no size: give interface_distance, too"
        )
    if scale_known and options.interface_distance is not None and not options.interface_distance < unit:
        raise RefractError(
            f"interface_distance {options.interface_distance:g} lies beyond the points (median depth {unit:g} in "
            "units of the model, whose size is taken as known)"
        )
    arrangement = Arrangement(
        options=options,
        observations=moved,
        structure=structure,
        held=_held(structure, options, reference, scale_known),
        plane_names=plane_names,
        frame_pose=frame_pose,
        reference=reference,
        origin=origin,
        unit=unit,
        scale_known=scale_known,
        lens_parameters=_lens_parameters(moved, options),
    )
    return arrangement


def min_num_points(scenario: Scenario, num_images: int) -> int:
    """Points that an image must share with the others to be solvable at all (counts of the paper's section 3.3).

    They follow from `9 I - 6`, `6 I + 3` and `3 I + 3` unknowns besides the points' own against `2 (I - 1)`
    equations per point, of which each point's depth takes one. A housing is counted as a static interface.
    """
    if num_images < 2:
        return np.iinfo(np.int32).max
    unknowns = {
        "moving_interface": 9 * num_images - 6,
        "static_interface": 6 * num_images + 3,
        "fixed_camera": 3 * num_images + 3,
        "camera_housing": 6 * num_images + 3,
    }[scenario]
    return -(-unknowns // (2 * num_images - 3))


def _check_names(names: list[str], options: RefinerOptions, notes: ImageNotes) -> None:
    known = set(names)
    mentioned = [("dry_images", n) for n in sorted(notes.dry_images)]
    mentioned += [("interface_groups", n) for n in notes.interface_groups]
    mentioned += [("reference_image", options.reference_image)] if options.reference_image else []
    for what, name in mentioned:
        if name not in known:
            near = get_close_matches(name, names, n=2)
            like = " or ".join(f"'{n}'" for n in near)
            raise RefractError(
                f"{what}: there is no registered image named '{name}' in the model; "
                + (f"is {like} meant?" if near else f"its images are named like '{names[0]}'")
            )
    both = sorted(set(notes.interface_groups) & notes.dry_images)
    if both:
        raise RefractError(f"image '{both[0]}' is listed as dry and in group '{notes.interface_groups[both[0]]}'")


def _reference_image(observations: Observations, options: RefinerOptions, notes: ImageNotes) -> int:
    if options.reference_image:
        return observations.image_names.index(options.reference_image)
    counts = np.bincount(observations.image, minlength=len(observations.image_ids)).astype(np.float64)
    for i, name in enumerate(observations.image_names):
        if name in notes.dry_images:
            counts[i] = -1
    return int(counts.argmax())


def _check_counts(
    observations: Observations, scenario: Scenario, image_plane: Index, plane_names: list[str | None]
) -> None:
    num_images = len(observations.image_ids)
    if num_images < 2:
        raise RefractError(
            "the model has one registered image; refraction shows between images: two or more are needed"
        )
    needed = min_num_points(scenario, num_images)
    point = observations.point
    for block, name in enumerate(plane_names):
        mine = image_plane[observations.image] == block
        seen = len(np.unique(point[mine]))
        if seen < needed:
            first = observations.image_names[int(np.flatnonzero(image_plane == block)[0])]
            who = f"group '{name}'" if name is not None else f"the interface of image '{first}'"
            raise RefractError(
                f"{who} has {seen} points; its unknowns need {needed} ({scenario}, {num_images} images): put the image "
                "in a group with others, list it as dry, or leave it out of the model"
            )


def _fix_camera(observations: Observations, reference: int, move_points: bool) -> tuple[Observations, Index]:
    """One pose for all frames, the reference image's; among rigs of several sensors, one for each rig.

    A rig of one camera says nothing of where that camera stands: COLMAP makes one for every camera, and a camera for
    every image of which it is not told otherwise. Where each rig has its own pose, a further one gets that of its
    first frame.

    Points are put at their depth from that pose along the median direction they are seen in, since poses
    that a mapper made up for a camera that did not move have put them anywhere.
    """
    frames = observations.image_frame
    frame_rig = np.zeros(len(observations.frame_ids), dtype=np.int64)
    frame_rig[frames] = observations.image_rig
    if one_pose_for_all(observations):
        frame_rig[:] = 0
    rigs = np.unique(frame_rig)
    frame_pose = np.searchsorted(rigs, frame_rig)
    keeper = np.array([int(np.flatnonzero(frame_pose == p)[0]) for p in range(len(rigs))])
    keeper[frame_pose[frames[reference]]] = frames[reference]
    fixed = replace(
        observations,
        rig_from_world_rotation=observations.rig_from_world_rotation[keeper[frame_pose]],
        rig_from_world_translation=observations.rig_from_world_translation[keeper[frame_pose]],
    )
    if not move_points:
        return fixed, frame_pose
    rotation, translation = fixed.cam_from_world
    image = fixed.image
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    ray = np.einsum("nji,nj->ni", rotation[image], fixed.direction)
    # A median, since one wrong match would pull a mean far off.
    middle = np.stack([segment_median(ray[:, j], fixed.start) for j in range(3)], axis=1)
    middle /= np.maximum(np.linalg.norm(middle, axis=1), 1e-12)[:, None]
    # Depths are the input's own, seen from where it had its cameras.
    old_rotation, old_translation = observations.cam_from_world
    old_centers = -np.einsum("nji,nj->ni", old_rotation, old_translation)
    first = image[fixed.start[:-1]]
    away = np.linalg.norm(observations.points - old_centers[first], axis=1)
    typical = np.median(away)
    if not typical > 0:
        raise RefractError("the points lie at the projection centre; give the model a depth (any constant will do)")
    away = np.clip(away, 0.3 * typical, 3.0 * typical)
    return replace(fixed, points=centers[first] + away[:, None] * middle), frame_pose


def one_pose_for_all(observations: Observations) -> bool:
    """Whether the frames of a fixed camera share one pose: no frame has two images, nor an image a pose in its rig."""
    moved = observations.sensor_translation.any() or (observations.sensor_rotation != np.eye(3)).any()
    return len(observations.image_ids) == len(observations.frame_ids) and not moved


def segment_median(values: Array, start: Index) -> Array:
    """Median (P,) of each run of `values` between successive entries of `start`."""
    segment = np.repeat(np.arange(len(start) - 1), np.diff(start))
    order = np.lexsort((values, segment))
    low, high = start[:-1] + (np.diff(start) - 1) // 2, start[:-1] + np.diff(start) // 2
    return np.asarray(0.5 * (values[order[low]] + values[order[high]]))


def _to_solve_units(observations: Observations, reference: int) -> tuple[Observations, Array, float]:
    rotation, translation = observations.cam_from_world
    origin = -rotation[reference].T @ translation[reference]
    unit = float(np.median(image_depths(observations)))
    if not (np.isfinite(unit) and unit > 0):
        raise RefractError("no point lies in front of its cameras: the model's poses or points are damaged")
    rig_rotation = observations.rig_from_world_rotation
    moved = replace(
        observations,
        rig_from_world_translation=(observations.rig_from_world_translation + rig_rotation @ origin) / unit,
        sensor_translation=observations.sensor_translation / unit,
        points=(observations.points - origin) / unit,
    )
    return moved, origin, unit


def _held(structure: Structure, options: RefinerOptions, reference: int, scale_known: bool) -> Held:
    poses = np.full(structure.num_poses, not options.BundleAdjustment.refine_rig_from_world)
    normals = np.full(structure.num_planes, not options.refine_interface_normal)
    distances = np.full(structure.num_planes, not options.refine_interface_distance)
    adjustment = options.BundleAdjustment
    walls = any(options.layer_thickness) and not scale_known
    if walls and options.interface_distance is not None:
        # The wall's thickness is known in units of this distance only: it carries the scale.
        distances[structure.image_plane[reference]] = True
    chosen = options.scenario == "fixed_camera" or normals.any() or distances.any() or walls
    if chosen and adjustment.refine_points3D:
        # A pose is a choice of the world's frame; a plane held in the world needs one to stand still against.
        poses[structure.image_pose[reference]] = True
    return Held(
        poses=poses,
        normals=normals,
        distances=distances,
        points=not adjustment.refine_points3D,
        index=not options.refine_refractive_index,
        lens=not (
            adjustment.refine_focal_length or adjustment.refine_principal_point or adjustment.refine_extra_params
        ),
    )


def _lens_parameters(observations: Observations, options: RefinerOptions) -> list[list[int]]:
    adjustment = options.BundleAdjustment
    parameters = []
    for camera in observations.cameras:
        mine: list[int] = []
        mine += list(camera.focal_length_idxs()) if adjustment.refine_focal_length else []
        mine += list(camera.principal_point_idxs()) if adjustment.refine_principal_point else []
        mine += list(camera.extra_params_idxs()) if adjustment.refine_extra_params else []
        parameters.append([int(i) for i in mine])
    return parameters


def select_tracks(observations: Observations, per_image: int, seed: int) -> NDArray[np.bool_]:
    """Mark the observations (N,) of a few tracks that cover every image: long ones first.

    Args:
        per_image: observations that each image should have, where it has as many.
        seed: of the order among tracks of equal length.
    """
    lengths = np.diff(observations.start)
    rng = np.random.default_rng(seed)
    order = np.lexsort((rng.random(len(lengths)), -lengths))
    missing = np.full(len(observations.image_ids), per_image)
    chosen = np.zeros(len(lengths), dtype=np.bool_)
    image, start = observations.image, observations.start
    for p in order:
        mine = image[start[p] : start[p + 1]]
        if (missing[mine] > 0).any():
            chosen[p] = True
            missing[mine] -= 1
    return np.repeat(chosen, lengths)
