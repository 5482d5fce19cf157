"""What the data say of the waves: how steep and how long they are, and how far planes scatter about the level.

The statistics are those that make the data most probable, to the second order about a solution (empirical Bayes;
the updates of MacKay 1992). They need not be exact: halving or doubling one changes the points by little.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from colmap_refract.estimator.banded import Inverse, factorize
from colmap_refract.estimator.chunk import LevelPrior, Problem
from colmap_refract.estimator.elimination import LEVEL, PLANE, POSE, WAVES
from colmap_refract.estimator.priors import compare_to_level, first_images, images_with_waves, mean_plane, plane_stands
from colmap_refract.estimator.whole import evaluated
from colmap_refract.interface import Array, tangent_basis
from colmap_refract.refiner.continuation import residuals
from colmap_refract.refiner.waves import WaveStatistics, Wavy

_JITTER = 1e-9
"""Of the scaled diagonal: what the gauge leaves without curvature."""
_LEAST_SLOPE, _MOST_SLOPE = np.tan(np.radians(0.02)), np.tan(np.radians(20.0))
_LEAST_TILT, _LEAST_LIFT = np.radians(0.01), 1e-4
_LARGEST_FACTOR = 3.0
"""By which one update may change a deviation."""
_LEAST_NOISE, _MOST_NOISE = 1e-6, 1.0
"""Pixels: keypoints are found to better, so that more is something else."""
_USUAL_NOISE, _USUAL_WEIGHT = 0.3, 2.0
"""Of keypoints, px, and in how many coordinates' worth of evidence."""
_LEAST_DETERMINED = 1.0
_LEAST_FREE = 0.05
_MOST_UPDATES, _SETTLED = 200, 1e-4
_LARGEST_SQUARE, _MEDIAN_SQUARE = 9.21, 1.386
"""Of a chi-squared variable of two degrees of freedom: one in a hundred is larger, one in two is."""
_KEPT_SQUARE = 0.9535
"""Of its mean, of those that are not larger."""


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
    wavy: Wavy, solved: Problem, statistics: WaveStatistics, *, given_slope: bool, num_threads: int = 1
) -> tuple[WaveStatistics, LevelPrior | None]:
    """One update of slope deviation, noise and level prior at a solution with waves.

    Slopes show in the coefficients, and, where the modes cannot take them, in residuals that grow with the depth of
    the water; the noise of the keypoints does not. Wrong matches are left out.

    Args:
        wavy: at its solution.
        solved: what was solved, at its solution.
        statistics: that it was solved with.
        given_slope: whether the slope deviation stays as it is.
        num_threads: to evaluate it with.
    """
    level = solved.level_prior
    found = posterior(solved, num_threads)
    if found is None:
        return statistics, level
    unit = statistics.noise**2
    determined, squared = 0.0, 0.0
    for image in images_with_waves(solved).tolist():
        if (WAVES, image) not in found.columns:
            continue
        first = found.columns[WAVES, image]
        mine = np.arange(first, first + solved.num_waves)
        determined += float((1.0 - np.minimum(unit * found.variance[mine], 1.0)).sum())
        squared += float((solved.state.waves[image] ** 2).sum())
    unknowns = 3 * len(solved.points) + determined
    unknowns += sum(width for key, width in found.widths.items() if key[0] in (POSE, PLANE))
    grown, noise = _settle_residuals(wavy, solved, statistics, unknowns)
    slope, unresolved = statistics.slope_deviation, statistics.unresolved
    if not given_slope:
        # Modes tell the slopes where there are any; else what is unresolved is all of them.
        factor = np.sqrt(squared / determined) if determined > _LEAST_DETERMINED else np.sqrt(grown)
        slope *= float(np.clip(factor, 1.0 / _LARGEST_FACTOR, _LARGEST_FACTOR))
        slope = float(np.clip(slope, _LEAST_SLOPE, _MOST_SLOPE))
        unresolved *= grown * (statistics.slope_deviation / slope) ** 2
    if level is not None:
        level = _scatter(solved, replace(level, noise=noise), found, statistics.noise)
    return replace(statistics, slope_deviation=slope, noise=noise, unresolved=unresolved), level


def _settle_residuals(wavy: Wavy, solved: Problem, statistics: WaveStatistics, unknowns: float) -> tuple[float, float]:
    """By what the variance of unresolved slopes is larger than was thought, and the noise, as the residuals show.

    A residual is the sum of noise and of unresolved slopes, whose covariance is known but for its size: with `C` that
    of the sum and `V` that of a part, the part's square is expected to be `tr(C^-1 V)` and found to be
    `r^T C^-1 V C^-1 r`. What is found over what is expected corrects the part's variance.
    """
    raw = raw_residuals(wavy, solved)
    inverse = np.linalg.inv(wavy.whiten)
    unresolved = (inverse @ inverse.transpose(0, 2, 1) - np.eye(2)) * statistics.noise**2
    # Residuals are smaller than what they estimate by the degrees of freedom that were fitted.
    free = max(1.0 - unknowns / (2 * len(raw)), _LEAST_FREE) * _KEPT_SQUARE
    grown, noise = 1.0, statistics.noise
    for _ in range(_MOST_UPDATES):
        before = grown, noise
        inverse = np.linalg.inv(noise**2 * np.eye(2) + grown * unresolved)
        weighted = np.einsum("nab,nb->na", inverse, raw)
        good = _without_outliers(np.einsum("na,na->n", weighted, raw))
        by_slopes = grown * np.einsum("na,nab,nb->n", weighted, unresolved, weighted)[good].sum()
        expected = free * np.einsum("nab,nba->n", inverse, unresolved)[good].sum()
        grown = float((grown * by_slopes + _USUAL_WEIGHT) / (grown * expected + _USUAL_WEIGHT))
        grown = float(np.clip(grown, _LARGEST_FACTOR**-2, _LARGEST_FACTOR**2))
        # Under waves much larger than the noise nothing is seen of it.
        noisy = noise**4 * (weighted[good] ** 2).sum()
        expected = free * noise**2 * np.einsum("naa->n", inverse[good]).sum()
        noise = float(np.sqrt((noisy + _USUAL_WEIGHT * _USUAL_NOISE**2) / (expected + _USUAL_WEIGHT)))
        noise = float(np.clip(noise, _LEAST_NOISE, _MOST_NOISE))
        if np.allclose(np.log([grown, noise]), np.log(before), atol=_SETTLED):
            break
    return grown, noise


def raw_residuals(wavy: Wavy, solved: Problem) -> Array:
    """(N, 2) px: residuals before what unresolved slopes add to their variance was taken out."""
    return np.asarray(np.linalg.solve(wavy.whiten, residuals(solved)[:, :, None])[:, :, 0])


def _without_outliers(squares: Array) -> NDArray[np.bool_]:
    """Which squared residuals a normal distribution of the same median has, but for one in a hundred."""
    return np.asarray(squares <= _LARGEST_SQUARE * np.median(squares) / _MEDIAN_SQUARE)


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
    return -cost / noise**2 - volume + log_whitening - 2.0 * len(problem.tracks.image) * float(np.log(noise))
