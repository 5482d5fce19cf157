"""What the data say of the waves: how steep and how long they are, and how far planes scatter about the level.

The statistics are those that make the data most probable, to the second order about a solution (empirical Bayes;
the updates of MacKay 1992). They need not be exact: halving or doubling one changes the points by little.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from colmap_refract.estimator.banded import Inverse, factorize
from colmap_refract.estimator.chunk import LevelPrior, Problem
from colmap_refract.estimator.elimination import LEVEL, PLANE, POSE, WAVES
from colmap_refract.estimator.priors import compare_to_level, first_images, images_with_waves, mean_plane, plane_stands
from colmap_refract.estimator.whole import evaluated
from colmap_refract.interface import Array, tangent_basis
from colmap_refract.refiner.continuation import residuals
from colmap_refract.refiner.filtering import noise as noise_of
from colmap_refract.refiner.waves import WaveStatistics

_JITTER = 1e-9
"""Of the scaled diagonal: what the gauge leaves without curvature."""
_LEAST_SLOPE, _MOST_SLOPE = np.tan(np.radians(0.02)), np.tan(np.radians(20.0))
_LEAST_TILT, _LEAST_LIFT = np.radians(0.01), 1e-4
_LEAST_NOISE = 1e-6
_LARGEST_FACTOR = 3.0
"""By which one update may change a deviation."""


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """What the statistics need of the inverse of the normal equations at a solution.

    Attributes:
        columns: where each free block, (slot, block), begins; widths: of each.
        variance: (n,) of the parameters, for residuals of unit noise.
        inverse: of the scaled equations, as far as their band reaches; scale: (n,).
    """

    columns: dict[tuple[int, int], int]
    widths: dict[tuple[int, int], int]
    variance: Array
    inverse: Inverse
    scale: Array

    def covariance(self, columns: Array) -> Array:
        """(k, k) at columns of blocks that one image or all images look at."""
        scale = self.scale[columns]
        return np.asarray(self.inverse.block(columns) * scale * scale[:, None])


def posterior(problem: Problem, num_threads: int = 1) -> Posterior | None:
    """None where the system cannot be evaluated or has no free parameter."""
    found = evaluated(problem, num_threads)
    if found is None:
        return None
    system, _, _, matrix = found
    diagonal = matrix.diagonal
    if not (diagonal > 0).all():
        return None
    scale = 1.0 / np.sqrt(diagonal)
    matrix.scale(scale)
    matrix.add_diagonal(_JITTER)
    factor = factorize(matrix)
    if factor is None:
        return None
    inverse = factor.inverse()
    return Posterior(
        columns=system.columns, widths=system.widths, variance=inverse.diagonal * scale**2, inverse=inverse, scale=scale
    )


def estimate_statistics(
    problem: Problem, statistics: WaveStatistics, *, given_slope: bool, num_threads: int = 1
) -> tuple[WaveStatistics, LevelPrior | None]:
    """One update of slope deviation, noise and level prior at a solution with waves.

    Args:
        problem: at its solution.
        statistics: that it was solved with.
        given_slope: whether the slope deviation stays as it is.
        num_threads: to evaluate it with.
    """
    level = problem.level_prior
    found = posterior(problem, num_threads)
    if found is None:
        return statistics, level
    unit = statistics.noise**2
    determined, squared = 0.0, 0.0
    for image in images_with_waves(problem).tolist():
        if (WAVES, image) not in found.columns:
            continue
        first = found.columns[WAVES, image]
        mine = np.arange(first, first + problem.num_waves)
        determined += float((1.0 - np.minimum(unit * found.variance[mine], 1.0)).sum())
        squared += float((problem.state.waves[image] ** 2).sum())
    slope = statistics.slope_deviation
    if not given_slope and determined > 1.0:
        factor = np.clip(np.sqrt(squared / determined), 1.0 / _LARGEST_FACTOR, _LARGEST_FACTOR)
        slope = float(np.clip(slope * factor, _LEAST_SLOPE, _MOST_SLOPE))
    unknowns = 3 * len(problem.points) + determined
    unknowns += sum(width for key, width in found.widths.items() if key[0] in (POSE, PLANE))
    noise = max(noise_of(residuals(problem), unknowns), _LEAST_NOISE)
    if level is not None:
        level = _scatter(problem, replace(level, noise=noise), found, statistics.noise)
    return replace(statistics, slope_deviation=slope, noise=noise), level


def _scatter(problem: Problem, level: LevelPrior, found: Posterior, noise: float) -> LevelPrior:
    """The level prior with the spread that the planes show."""
    structure, state = problem.structure, problem.state
    plane = mean_plane(structure, state)
    along = block_diag(tangent_basis(plane.normal).T, 1.0)
    deviations, variances = [], []
    for block, image in enumerate(first_images(structure).tolist()):
        pose = int(structure.image_pose[image])
        standing = plane_stands(structure, state, block, image, np.zeros(6), np.zeros(3))
        deviation, *by = compare_to_level(standing, plane, np.zeros(3))
        deviation, by = along @ deviation, [along @ part for part in by]
        free = [
            (key, part)
            for key, part in zip([(POSE, pose), (PLANE, block), (LEVEL, 0)], by, strict=True)
            if key in found.columns
        ]
        deviations.append(deviation)
        if not free:
            variances.append(np.zeros(3))
            continue
        jacobian = np.hstack([part for _, part in free])
        covariance = found.covariance(
            np.concatenate([found.columns[key] + np.arange(found.widths[key]) for key, _ in free])
        )
        variances.append(noise**2 * np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian))
    squared, variance = np.array(deviations) ** 2, np.array(variances)
    if not np.isfinite(squared).all() or not np.isfinite(variance).all():
        return level
    tilt = _deviation(squared[:, :2], variance[:, :2], level.tilt)
    lift = _deviation(squared[:, 2:], variance[:, 2:], level.lift)
    return replace(level, tilt=max(tilt, _LEAST_TILT), lift=max(lift, _LEAST_LIFT))


def _deviation(squared: Array, variance: Array, assumed: float) -> float:
    """The standard deviation that squared values show which are known up to a variance, assumed before."""
    determined = float((1.0 - np.minimum(variance / assumed**2, 1.0)).sum())
    # A common plane takes away one degree of freedom.
    determined *= max(len(squared) - 1, 1) / len(squared)
    if determined < 1e-3 * squared.size:
        return assumed
    factor = np.sqrt(squared.sum() / determined) / assumed
    return float(assumed * np.clip(factor, 1.0 / _LARGEST_FACTOR, _LARGEST_FACTOR))


def log_evidence(problem: Problem, noise: float, log_whitening: float, num_threads: int = 1) -> float:
    """Log probability of the data at a solution, up to a constant: what the choice of a wavelength goes by.

    Args:
        problem: at its solution.
        noise: px.
        log_whitening: sum of the log determinants of the observations' whitening.
        num_threads: to evaluate it with.
    """
    found = evaluated(problem, num_threads)
    if found is None:
        return -np.inf
    system, cost, _, matrix = found
    mine = [np.arange(first, first + system.widths[key]) for key, first in system.columns.items() if key[0] == WAVES]
    volume = 0.0
    if mine:
        at = np.sort(np.concatenate(mine))
        factor = factorize(matrix.part(at))
        if factor is None:
            return -np.inf
        volume = 0.5 * (factor.log_determinant - 2.0 * len(at) * float(np.log(noise)))
    return -cost / noise**2 - volume + log_whitening
