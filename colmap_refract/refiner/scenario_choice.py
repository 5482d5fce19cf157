"""Which scenario a capture is of: what its poses leave open, compared by what it predicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.scenario import share_planes
from colmap_refract.interface import Array
from colmap_refract.options import ImageNotes, InterfaceShape, RefinerOptions, RefinerRequest, Scenario
from colmap_refract.refiner.arrangement import one_pose_for_all
from colmap_refract.refiner.comparison import Candidate, Comparison, compare
from colmap_refract.refiner.continuation import Watch
from colmap_refract.refiner.observations import Observations, read_observations
from colmap_refract.refiner.start import image_depths

if TYPE_CHECKING:
    import pycolmap

_STANDS_STILL = 1e-3
"""Of the depth: with all projection centres within, scenarios of a moving camera have no baseline."""
_HARDLY_MOVES = 0.06
"""Of the depth: a mapper takes the water's motion for a baseline, so a camera that moved by less may not have."""


def choose_scenario(
    reconstruction: pycolmap.Reconstruction,
    request: RefinerRequest,
    *,
    notes: ImageNotes | None = None,
    cameras: Mapping[int, pycolmap.Camera] | None = None,
    watch: Watch | None = None,
) -> Comparison:
    """Find scenario and shape of a capture: the simplest that predict held-out observations as well as any.

    Args:
        reconstruction: a COLMAP model that ignored refraction; not altered.
        request: of the refinement; of its scenario and interface_shape what is `auto` is chosen, and its
            `random_seed` is that of what is held out.
        notes, cameras: as for `refine`.
        watch: called as by `refine`, with the number and the name of the scenario before the stage's.

    Returns:
        `Comparison`: `refine(reconstruction, comparison.chosen.options)` refines the whole model.

    Raises:
        RefractError: the model has no points that two images see, no scenario could be refined, or no
            observation can be spared.
        KeyboardInterrupt: Ctrl-C during a solve; nothing has been changed.
    """
    named = None if request.scenario == "auto" else (request.scenario,)
    candidates = scenario_candidates(reconstruction, request, notes, named)
    return compare(reconstruction, candidates, notes=notes, cameras=cameras, seed=request.random_seed, watch=watch)


def scenario_candidates(
    reconstruction: pycolmap.Reconstruction,
    request: RefinerRequest,
    notes: ImageNotes | None = None,
    scenarios: Sequence[Scenario] | None = None,
) -> tuple[Candidate, ...]:
    """The scenarios that could be those of a capture, the simplest first.

    A camera that stood at one place can only be a fixed one, since the others start from a baseline. One that
    hardly moved may be a fixed one, whose mapper took the water's motion for its own. One that moved is not,
    unless asked for.

    Scenarios that come to the same in this model count once, under the first name: where each image has a camera
    of its own, a plane per camera is a moving interface.

    Args:
        reconstruction: a COLMAP model that ignored refraction; not altered.
        request: of the refinement; its scenario says nothing.
        notes: which images share an interface, and which have none.
        scenarios: those to choose from; by default what the poses allow.

    Raises:
        RefractError: the model has no points that two images see.
    """
    observations = read_observations(reconstruction)
    if not len(observations.points):
        raise RefractError("the model has no point that two registered images see: there is nothing to refine")
    num_images = len(observations.image_ids)
    found: dict[object, Candidate] = {}
    for scenario in possible_scenarios(observations) if scenarios is None else scenarios:
        options = request.with_scenario(scenario)
        tying, complexity = _tying(observations, options, notes or ImageNotes())
        for shape in _shapes(request, scenario):
            # A surface for each image is less simple than any tying.
            more = num_images * request.num_wave_modes if shape == "soft" else 0
            candidate = Candidate(
                label=scenario if request.interface_shape != "auto" else f"{scenario}, {shape}",
                options=replace(options, interface_shape=shape),
                complexity=complexity + more,
            )
            found.setdefault((tying, shape), candidate)
    return tuple(sorted(found.values(), key=lambda candidate: candidate.complexity))


def _shapes(request: RefinerRequest, scenario: Scenario) -> tuple[InterfaceShape, ...]:
    """The shapes of the interface to choose from: glass does not wave."""
    if request.interface_shape != "auto":
        return (request.interface_shape,)
    waves = scenario != "camera_housing" and not any(request.layer_thickness)
    return ("plane", "soft") if waves else ("plane",)


def possible_scenarios(observations: Observations) -> tuple[Scenario, ...]:
    """What the poses of a model that ignored refraction leave open."""
    moving: tuple[Scenario, ...] = ("static_interface", "moving_interface", "camera_housing")
    # Sensors of a rig are at different places even if the rig never moves.
    rotation, translation = observations.rig_from_world_rotation, observations.rig_from_world_translation
    centers = -np.einsum("fji,fj->fi", rotation, translation)
    rigs = np.zeros(len(centers), dtype=np.int64)
    rigs[observations.image_frame] = observations.image_rig
    if one_pose_for_all(observations):
        rigs[:] = 0
    moved = max(_spread(centers[rigs == rig]) for rig in np.unique(rigs)) / float(np.median(image_depths(observations)))
    if moved < _STANDS_STILL:
        return ("fixed_camera",)
    return ("fixed_camera", *moving) if moved < _HARDLY_MOVES else moving


def _spread(centers: Array) -> float:
    """Root mean square distance of points (n, 3) from their median."""
    return float(np.sqrt(((centers - np.median(centers, axis=0)) ** 2).sum(axis=1).mean()))


def _tying(observations: Observations, options: RefinerOptions, notes: ImageNotes) -> tuple[object, float]:
    """Who shares what, for comparison, and the unknowns of interfaces and poses."""
    names = observations.image_names
    frames = observations.image_frame.tolist()
    image_plane, in_world, _ = share_planes(
        options.scenario,
        frames,
        observations.image_camera.tolist(),
        [notes.interface_groups.get(name) for name in names],
        [name in notes.dry_images for name in names],
    )
    num_poses = len(observations.frame_ids)
    if options.scenario == "fixed_camera":
        num_poses = 1 if one_pose_for_all(observations) else len(np.unique(observations.image_rig))
    # In the world or in the camera is the same to a plane that only one image sees.
    alone = np.bincount(image_plane[image_plane >= 0], minlength=len(in_world)) == 1
    tying = (num_poses, tuple(image_plane.tolist()), tuple((in_world | alone).tolist()))
    per_plane = 2 * options.refine_interface_normal + options.refine_interface_distance
    per_pose = 6 * options.BundleAdjustment.refine_rig_from_world
    return tying, float(per_plane * len(in_world) + per_pose * num_poses)
