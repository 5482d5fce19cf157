"""Putting a result back into the frame and size of the model it came from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_refract.estimator.rotation import mean_rotation
from colmap_refract.interface import Array

_ROUNDS = 10


@dataclass(frozen=True, kw_only=True)
class Similarity:
    """`x' = scale * rotation @ x + translation`."""

    scale: float
    rotation: Array
    translation: Array

    def points(self, points: Array) -> Array:
        """(N, 3) points moved."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def cam_from_world(self, rotation: Array, translation: Array) -> tuple[Array, Array]:
        """Poses (N, 3, 3), (N, 3) of cameras in the moved world, whose camera frames are scaled with it."""
        moved = rotation @ self.rotation.T
        return moved, self.scale * translation - np.einsum("nij,j->ni", moved, self.translation)

    def plane(self, normal: Array, offset: float) -> tuple[Array, float]:
        """A world plane `normal . x = offset` moved."""
        moved = self.rotation @ normal
        return moved, float(self.scale * offset + moved @ self.translation)


def align_poses(
    source: tuple[Array, Array], target: tuple[Array, Array], *, spread: float, scale: float | None = None
) -> Similarity | None:
    """The similarity that brings poses to those of another model.

    The rotation is the mean of the poses' own turns, which is there even where the projection centres stand in
    a line; scale and translation come from the centres, robustly, since single poses of a bent model are off.

    Args:
        source, target: `cam_from_world` rotations (N, 3, 3) and translations (N, 3) of the same images.
        spread: least standard deviation of the centres, in units of the target, that tells the scale.
        scale: known scale; by default estimated.

    Returns:
        The similarity; None where the centres are too close together to tell the scale.
    """
    turns = np.einsum("nji,njk->nik", target[0], source[0])
    weight = np.ones(len(turns))
    for _ in range(_ROUNDS):
        rotation = mean_rotation(weight[:, None, None] * turns)
        angle = np.linalg.norm(turns - rotation, axis=(1, 2))
        weight = 1.0 / (angle + np.median(angle) + 1e-12)
    source_center = -np.einsum("nji,nj->ni", source[0], source[1]) @ rotation.T
    target_center = -np.einsum("nji,nj->ni", target[0], target[1])
    estimated = 1.0 if scale is None else scale
    weight = np.ones(len(turns))
    for _ in range(_ROUNDS):
        share = weight[:, None] / weight.sum()
        mean_source, mean_target = (share * source_center).sum(axis=0), (share * target_center).sum(axis=0)
        from_source, from_target = source_center - mean_source, target_center - mean_target
        if scale is None:
            if np.sqrt((share * from_target**2).sum()) < spread:
                return None
            moment = (share * from_source**2).sum()
            estimated = float((share * from_source * from_target).sum() / moment) if moment > 0 else 0.0
            if not estimated > 0:
                return None
        error = np.linalg.norm(estimated * from_source - from_target, axis=1)
        weight = 1.0 / (error + np.median(error) + 1e-12)
    return Similarity(scale=estimated, rotation=rotation, translation=mean_target - estimated * mean_source)


def rescale_about(center: Array, scale: float) -> Similarity:
    """A change of size that leaves one point where it is."""
    return Similarity(scale=scale, rotation=np.eye(3), translation=(1.0 - scale) * center)
