"""Surfaces that are not flat: the plane that each keypoint's ray is refracted by."""

from __future__ import annotations

import numpy as np

from colmap_refract.estimator.elimination import Tracks
from colmap_refract.estimator.scenario import State, Structure
from colmap_refract.interface import Array


def local_planes(tracks: Tracks, structure: Structure, state: State) -> tuple[Array, Array]:
    """The tangent plane of the surface where each keypoint's ray meets it; the image's plane where it is flat.

    Returns:
        `(normal, distance)`, (N, 3) and (N,), in the cameras' frames; NaN for images without an interface.
    """
    normal, distance = state.planes_in_cam(structure)
    normal, distance = normal[tracks.image], distance[tracks.image]
    if tracks.waves.shape[2]:
        height, *slopes = np.moveaxis(np.einsum("nak,nk->na", tracks.waves, state.waves[tracks.image]), 1, 0)
    elif len(tracks.relief):
        height, *slopes = tracks.relief.T
    else:
        return normal, distance
    facing = np.einsum("ni,ni->n", normal, tracks.sight)
    local = normal + np.einsum("nia,an->ni", structure.wave_axes[tracks.image], np.array(slopes))
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    along = distance * (1.0 + height) / facing
    return local, along * np.einsum("ni,ni->n", local, tracks.sight)
