"""The unknowns of `E_soft`: which observations take part, and the parameter blocks that stand for them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.optics import back_project
from colmap_refract.estimator.scenario import Change, Index, State, Structure, apply
from colmap_refract.interface import Array, Layers


@dataclass(frozen=True)
class Pairing:
    """Which observations take part: those of points that the reference sees, by index into the tracks.

    Attributes:
        reference: index of the image.
        point: (p,) the points, of_reference: (p,) the reference's observation of each.
        others: (m,) the other observations, point_of: (m,) index into `point`.
    """

    reference: int
    point: Index
    of_reference: Index
    others: Index
    point_of: Index


def pair(problem: Problem, reference: int) -> Pairing:
    tracks = problem.tracks
    point_of = np.repeat(np.arange(len(tracks.start) - 1), np.diff(tracks.start))
    # The first observation of each point by each image.
    _, first = np.unique(point_of * problem.structure.num_images + tracks.image, return_index=True)
    from_reference = tracks.image[first] == reference
    seen = first[from_reference & tracks.wet[first]]
    others = first[~from_reference]
    others = others[np.isin(point_of[others], point_of[seen])]
    seen = seen[np.isin(point_of[seen], point_of[others])]
    # By image and side, since an image's view is made anew for other values of its blocks than the last.
    others = others[np.lexsort((tracks.wet[others], tracks.image[others]))]
    return Pairing(reference, point_of[seen], seen, others, np.searchsorted(point_of[seen], point_of[others]))


@dataclass(frozen=True)
class Blocks:
    """Ceres' parameter blocks; what is held has none.

    Attributes:
        depth: `d_j` of each point of the pairing, (1,).
        normal: `n_ij` by observation that looks through the interface, (3,).
        pose, plane: by block of the structure, changes from the start as in `Change`, (6,) and (3,).
    """

    depth: list[Array]
    normal: dict[int, Array]
    pose: dict[int, Array]
    plane: dict[int, Array]


def anchored(problem: Problem, reference: int) -> Problem:
    """The same problem with the reference's plane measured from the reference camera: `d_r` is what is held."""
    structure, block = problem.structure, problem.structure.image_plane[reference]
    if not structure.plane_in_world[block]:
        return problem
    rotation, translation = problem.state.cam_from_world(structure)
    anchors = structure.plane_anchor.copy()
    anchors[block] = -rotation[reference].T @ translation[reference]
    state = with_anchors(problem.state, structure, anchors)
    return replace(problem, structure=replace(structure, plane_anchor=anchors), state=state)


def with_anchors(state: State, structure: Structure, anchors: Array) -> State:
    """The state of the same planes, measured from other anchors (B, 3) than the structure's."""
    shift = np.einsum("bi,bi->b", state.normal, structure.plane_anchor - anchors)
    return replace(state, distance=state.distance + np.where(structure.plane_in_world, shift, 0.0))


def images_of(problem: Problem, pairing: Pairing) -> list[int]:
    """The images that take part, the reference first."""
    return [pairing.reference, *np.unique(problem.tracks.image[pairing.others]).tolist()]


def fixed_of_plane(problem: Problem, reference: int, block: int) -> list[int]:
    """Which of a plane block's three parameters are held."""
    distance = problem.held.distances[block] or block == problem.structure.image_plane[reference]
    return ([0, 1] if problem.held.normals[block] else []) + ([2] if distance else [])


def blocks_at_start(problem: Problem, pairing: Pairing) -> Blocks:
    """The parameter blocks at the start: depths nearest to the points, normals of the planes."""
    tracks, structure, reference = problem.tracks, problem.structure, pairing.reference
    images = images_of(problem, pairing)
    poses = {int(structure.image_pose[i]) for i in images} - {int(structure.image_pose[reference])}
    planes = {int(structure.image_plane[i]) for i in images} - {-1}
    normal, distance = problem.state.planes_in_cam(structure)
    rotation, translation = problem.state.cam_from_world(structure)
    direction = tracks.direction[pairing.of_reference]
    origin, ray = back_project(direction, normal[reference], distance[reference], _water(problem))
    in_cam = problem.points[pairing.point] @ rotation[reference].T + translation[reference]
    taking_part = np.concatenate([pairing.of_reference, pairing.others])
    return Blocks(
        depth=[np.array([d]) for d in np.einsum("ni,ni->n", in_cam - origin, ray)],
        normal={int(k): normal[tracks.image[k]].copy() for k in taking_part if tracks.wet[k]},
        pose={p: np.zeros(6) for p in sorted(poses) if not problem.held.poses[p]},
        plane={b: np.zeros(3) for b in sorted(planes) if len(fixed_of_plane(problem, reference, b)) < 3},
    )


def check_count(problem: Problem, pairing: Pairing, blocks: Blocks) -> None:
    """Refuse a reference whose points cannot tell even plane interfaces (the paper's hard constraint)."""
    fixed = sum(len(fixed_of_plane(problem, pairing.reference, block)) for block in blocks.plane)
    unknowns = len(blocks.depth) + 6 * len(blocks.pose) + 3 * len(blocks.plane) - fixed
    equations = 2 * len(pairing.others)
    if not 0 < unknowns <= equations:
        raise RefractError(
            f"the reference image sees {len(blocks.depth)} points that others see: their {equations} equations are too "
            f"few for the {unknowns} unknowns of plane interfaces already; choose a reference that sees more"
        )


def _water(problem: Problem) -> Layers:
    return Layers(index=(problem.state.index,))


def points_in_reference(problem: Problem, state: State, pairing: Pairing, blocks: Blocks) -> Array:
    """`P_j` of the blocks' depths and normals and a state's plane: (p, 3) in the reference camera's frame."""
    normal, distance = (plane[pairing.reference] for plane in state.planes_in_cam(problem.structure))
    surface = np.array([blocks.normal[int(k)] for k in pairing.of_reference])
    direction = problem.tracks.direction[pairing.of_reference]
    origin, ray = back_project(direction, normal, distance, _water(problem), surface)
    return np.asarray(origin + np.array(blocks.depth) * ray)


def state_after(problem: Problem, blocks: Blocks) -> State:
    """The state that the blocks' values stand for."""
    change = Change.zero(problem.state)
    for block, value in blocks.pose.items():
        change.pose[block] = value
    for block, value in blocks.plane.items():
        change.plane[block] = value
    return apply(problem.state, change)
