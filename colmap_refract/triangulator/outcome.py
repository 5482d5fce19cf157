"""Triangulated points put back into the model and its sidecar, with what they are worth."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from colmap_refract.files.sidecar import ImageInterface, Sidecar
from colmap_refract.interface import Array
from colmap_refract.refiner.observations import Observations
from colmap_refract.refiner.outcome import keep_only
from colmap_refract.triangulator.options import TriangulatorOptions

if TYPE_CHECKING:
    import pycolmap

    from colmap_refract.estimator.scenario import Index

_TOO_LARGE, _TOO_SMALL = 1.2, 0.8
"""Times the errors that the waves allow: the deviations of the points are wrong by as much."""
_MANY_REMOVED = 0.05
"""Part of the observations: there are so many wrong matches, but more often the limit is wrong."""


@dataclass(frozen=True, kw_only=True)
class Triangulation:
    """Outcome of `triangulate_points`: P points, lengths in the model's units.

    Attributes:
        reconstruction: the model with its points moved and what was wrong removed; `point3D.error` is the mean
            reprojection error through the mean planes, px, so it holds the waves.
        sidecar: that of the model, with the new statistics.
        point3D_ids: (P,), points: (P, 3).
        covariance: (P, 3, 3) of each point; infinite entries where no parallax tells the depth.
        std_along, std_across: (P,) standard deviation along the mean line of sight, and of one coordinate across it.
        num_observations: (P,).
        reprojection_error: (P,) mean of each point, px.
        error_scale: root mean square error over what the deviations given let one expect; 1 if they are right.
        num_restless: points that did not settle.
        warnings: sentences for the user.
    """

    reconstruction: pycolmap.Reconstruction
    sidecar: Sidecar
    point3D_ids: Index
    points: Array
    covariance: Array
    std_along: Array
    std_across: Array
    num_observations: Index
    reprojection_error: Array
    error_scale: float
    num_restless: int
    warnings: list[str]

    @property
    def std_per_axis(self) -> Array:
        """(P, 3) standard deviations of x, y and z."""
        return np.asarray(np.sqrt(np.einsum("pii->pi", self.covariance)))

    @property
    def std(self) -> Array:
        """(P,) root of the trace of the covariance: the root mean square error of the point's position."""
        return np.asarray(np.sqrt(np.einsum("pii->p", self.covariance)))


def outcome(
    model: pycolmap.Reconstruction,
    sidecar: Sidecar,
    options: TriangulatorOptions,
    observations: Observations,
    *,
    principal_axes: Array,
    principal_variances: Array,
    errors: Array,
    squared: Array,
    num_dry: int,
    num_filtered_large_error: int,
    num_filtered_small_angle: int,
    num_dissolved: int,
    num_restless: int,
) -> Triangulation:
    """Write points into the model and gather what is to be told.

    Args:
        model: altered in place.
        sidecar, options: of the triangulation.
        observations: the N that were used, with the P new points.
        principal_axes, principal_variances: (P, 3, 3) columns and (P, 3) of the points' covariances; a variance may be
            infinite.
        errors: (N,) reprojection errors, px; squared: (N,) squared in units of their own standard deviations.
        num_dry: observations of points before the interface.
        num_filtered_large_error: observations removed; num_filtered_small_angle, num_dissolved: points.
        num_restless: points that did not settle.
    """
    num_before = model.num_points3D(), model.compute_num_observations()
    counts = np.diff(observations.start)
    mean_error = np.add.reduceat(errors, observations.start[:-1]) / counts
    _write_back(model, observations, mean_error)
    along = _variance_along(_lines_of_sight(observations), principal_axes, principal_variances)
    covariance = _covariance(principal_axes, principal_variances)
    with np.errstate(invalid="ignore"):
        across = np.where(np.isfinite(along), 0.5 * (np.einsum("pii->p", covariance) - along), np.inf)
    # A sum of chi-squares, of which each point has taken three degrees of freedom.
    scale = float(np.sqrt(squared.sum() / max(2 * len(squared) - 3 * len(counts), 1)))
    std = np.sqrt(np.einsum("pii->p", covariance))
    statistics: dict[str, Any] = {
        "num_points3D_before": num_before[0],
        "num_points3D": model.num_points3D(),
        "num_observations_before": num_before[1],
        "num_observations": model.compute_num_observations(),
        "mean_reprojection_error": float(errors.mean()),
        "median_reprojection_error": float(np.median(errors)),
        "num_filtered_large_error": num_filtered_large_error,
        "num_filtered_small_angle": num_filtered_small_angle,
        "num_dissolved_points3D": num_dissolved,
        "num_dry_observations": num_dry,
        "median_point_std": float(np.median(std)),
        "median_point_std_along_view": float(np.sqrt(np.median(along))),
        "median_point_std_across_view": float(np.sqrt(np.median(across))),
        "triangulation_error_scale": scale,
    }
    return Triangulation(
        reconstruction=model,
        sidecar=replace(
            sidecar,
            images=_entries(model, sidecar),
            options={**sidecar.options, "point_triangulator": asdict(options)},
            statistics={**sidecar.statistics, **statistics},
        ),
        point3D_ids=observations.point3D_ids,
        points=observations.points,
        covariance=covariance,
        std_along=np.sqrt(along),
        std_across=np.sqrt(across),
        num_observations=counts,
        reprojection_error=mean_error,
        error_scale=scale,
        num_restless=num_restless,
        warnings=_advise(options, scale, num_filtered_large_error / num_before[1], num_restless, len(counts)),
    )


def _write_back(model: pycolmap.Reconstruction, observations: Observations, mean_error: Array) -> None:
    """Points and errors into the model, and what is not among the observations out of it."""
    keep_only(model, observations, observations)
    for point3D_id, xyz, error in zip(observations.point3D_ids.tolist(), observations.points, mean_error, strict=True):
        point = model.point3D(point3D_id)
        point.xyz, point.error = xyz, float(error)


def _entries(model: pycolmap.Reconstruction, sidecar: Sidecar) -> dict[str, ImageInterface]:
    """The interfaces of the images that the written model has."""
    written = {model.image(image_id).name for image_id in model.reg_image_ids()}
    return {name: image for name, image in sidecar.images.items() if name in written}


def _lines_of_sight(observations: Observations) -> Array:
    """Mean unit direction (P, 3) from the cameras to each point, world."""
    rotation, translation = observations.cam_from_world
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    lines = observations.points[observations.point] - centers[observations.image]
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    mean = np.add.reduceat(lines, observations.start[:-1], axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True))


def _bounded(variances: Array) -> NDArray[np.bool_]:
    """Which points (P,) have a depth that parallax tells."""
    return np.asarray(np.isfinite(variances).all(axis=1))


def _covariance(axes: Array, variances: Array) -> Array:
    """(P, 3, 3); where a variance is infinite, so are those of all coordinates, and what they share is not known."""
    bounded = _bounded(variances)
    finite = np.where(bounded[:, None], variances, 1.0)
    covariance = np.einsum("pij,pj,pkj->pik", axes, finite, axes)
    covariance[~bounded] = np.where(np.eye(3, dtype=np.bool_), np.inf, np.nan)
    return np.asarray(covariance)


def _variance_along(lines: Array, axes: Array, variances: Array) -> Array:
    """`line^T C line` (P,), infinite where a variance is."""
    shares = np.einsum("pi,pij->pj", lines, axes) ** 2
    bounded = _bounded(variances)
    along = np.einsum("pj,pj->p", shares, np.where(bounded[:, None], variances, 1.0))
    return np.where(bounded, along, np.inf)


def _advise(
    options: TriangulatorOptions, scale: float, removed: float, num_restless: int, num_points: int
) -> list[str]:
    sentences = []
    expected = f"waves of {options.slope_deviation_deg:g} deg and {options.pixel_noise:g} px of noise"
    if scale > _TOO_LARGE:
        sentences.append(
            f"The errors are {scale:.3g} times what {expected} allow, so the standard deviations are too small: give a "
            "larger --slope_deviation_deg, or refine the poses and planes."
        )
    if removed > _MANY_REMOVED:
        sentences.append(
            f"{100 * removed:.2g} % of the observations were removed, more than {options.filter_max_error_std:g} times "
            f"what {expected} allow: unless there are so many wrong matches, the waves are steeper, or the poses or "
            "planes are wrong."
        )
    if scale < _TOO_SMALL:
        sentences.append(
            f"The errors are {scale:.3g} times what {expected} allow, so the standard deviations are too large: give a "
            "smaller --slope_deviation_deg or --pixel_noise. (Planes that were fitted to the same keypoints have taken "
            "up a part of the waves.)"
        )
    if num_restless:
        sentences.append(f"{num_restless} of {num_points} points did not settle: what is said of them means little.")
    return sentences
