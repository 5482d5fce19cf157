"""The soft constraint as a quadratic prior: two slopes for every observation, alike among neighbours.

The paper's `n_ij` are the image's plane tilted by slopes of the observation's own, without any height, and its
regulariser a form in those slopes: the Laplacian of `neighbours.neighbour_weights`. To first order in the slopes these
are the normals that the paper compares. Nothing ties an image's plane to them: it only says where rays meet the water.

Every image has two unknowns per observation, and a dense matrix couples them with each other and with those of all
images that see one point: for small problems, and to judge coarser surfaces by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.estimator.chunk import Problem
from colmap_refract.estimator.neighbours import neighbour_weights
from colmap_refract.interface import Array, tangent_basis


def with_own_slopes(problem: Problem, keypoints: Array, *, smoothness: float, radius: float) -> Problem:
    """The problem with a normal of its own for each wet observation, all of them level at the start.

    Args:
        problem: with flat surfaces.
        keypoints: (N, 2) px, of the problem's observations.
        smoothness: the paper's `lambda`, in squared units of the residual.
        radius: px, of the neighbourhoods.

    Raises:
        RefractError: a `smoothness` or `radius` that has no meaning, or walls.
    """
    if not (np.isfinite(smoothness) and smoothness >= 0):
        raise RefractError(f"a smoothness of {smoothness:g} cannot weigh anything: give 0 or more")
    if any(problem.layers.thickness):
        raise RefractError("the soft constraint is for a surface that waves, which a wall does not: leave walls out")
    tracks, structure = problem.tracks, problem.structure
    mine = [np.flatnonzero((tracks.image == i) & tracks.wet) for i in range(structure.num_images)]
    most = max(len(rows) for rows in mine)
    waves = np.zeros((len(tracks.image), 3, 2 * most))
    prior = np.zeros((structure.num_images, most, 2, most, 2))
    for image, rows in enumerate(mine):
        n = len(rows)
        own = 2 * np.arange(n)
        waves[rows, 1, own] = waves[rows, 2, own + 1] = 1.0
        alike = neighbour_weights(keypoints[rows], radius)
        alike = (alike + alike.T).toarray()
        values, vectors = np.linalg.eigh(np.diag(alike.sum(axis=1)) - alike)
        # Semi-definite: the mean slope costs nothing.
        root = np.sqrt(smoothness * np.maximum(values, 0.0))[:, None] * vectors.T
        for axis in range(2):
            prior[image, :n, axis, :n, axis] = root
    normal, _ = problem.state.planes_in_cam(structure)
    wet = structure.image_plane >= 0
    axes = np.zeros((structure.num_images, 3, 2))
    axes[wet] = [tangent_basis(n) for n in normal[wet]]
    return replace(
        problem,
        tracks=tracks._replace(waves=waves, sight=tracks.direction.copy()),
        structure=replace(structure, wave_axes=axes),
        state=replace(problem.state, waves=np.zeros((structure.num_images, 2 * most))),
        wave_prior=prior.reshape(structure.num_images, 2 * most, 2 * most),
    )
