"""Symmetric matrices with a band and a border: Cholesky's factor, solutions, and the inverse within the band.

Images of a survey share points with their neighbours only. In the order in which they lie beside each other, the
normal equations have a band, and a border of what all images share. Then all work is on dense blocks, by LAPACK.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack
from threadpoolctl import threadpool_limits

from colmap_refract.interface import Array

_BLOCK = 128
"""Columns of the inverse that are found at once."""


@dataclass(frozen=True, kw_only=True)
class Banded:
    """A symmetric matrix of n + m columns, the last m of which are dense.

    Attributes:
        band: (n, w + 1), `band[j, i - j]` is the entry (i, j), i >= j; zero beyond the last row.
        border: (n, m); corner: (m, m), its upper triangle.
    """

    band: Array
    border: Array
    corner: Array

    @property
    def num_columns(self) -> int:
        return len(self.band) + len(self.corner)

    @property
    def diagonal(self) -> Array:
        return np.concatenate([self.band[:, 0], np.diag(self.corner)])

    def copy(self) -> Banded:
        return Banded(band=self.band.copy(), border=self.border.copy(), corner=self.corner.copy())

    def scale(self, scale: Array) -> None:
        """Multiply rows and columns by `scale` (n + m,), in place: these are the largest arrays of a solve."""
        n, width = self.band.shape
        beyond = np.concatenate([scale[:n], np.zeros(width)])
        self.band[...] *= np.lib.stride_tricks.sliding_window_view(beyond, width)[:n]
        self.band[...] *= scale[:n, None]
        self.border[...] *= scale[:n, None] * scale[n:]
        self.corner[...] *= scale[n:, None] * scale[n:]

    def add_diagonal(self, values: Array | float) -> None:
        """In place."""
        values = np.broadcast_to(values, self.num_columns)
        n = len(self.band)
        self.band[:, 0] += values[:n]
        self.corner[np.diag_indices_from(self.corner)] += values[n:]

    def hold(self, columns: Array) -> None:
        """Make columns and their rows those of the identity, in place."""
        n, width = self.band.shape
        for j in columns.tolist():
            if j < n:
                above = np.arange(max(0, j - width + 1), j)
                self.band[above, j - above] = 0.0
                self.band[j] = 0.0
                self.band[j, 0] = 1.0
                self.border[j] = 0.0
            else:
                self.border[:, j - n] = 0.0
                self.corner[j - n], self.corner[:, j - n] = 0.0, 0.0
                self.corner[j - n, j - n] = 1.0

    def part(self, columns: Array) -> Banded:
        """Some columns of the band and their rows, in rising order."""
        n, width = self.band.shape
        chosen = np.full(n + width, -1)
        chosen[columns] = np.arange(len(columns))
        band = np.zeros((len(columns), width))
        widest = 1
        for k, j in enumerate(columns.tolist()):
            here = chosen[j : j + width]
            there = here >= 0
            band[k, here[there] - k] = self.band[j, there]
            widest = max(widest, int(here.max()) - k + 1)
        return Banded(
            band=np.ascontiguousarray(band[:, :widest]), border=np.zeros((len(columns), 0)), corner=np.zeros((0, 0))
        )


@dataclass(frozen=True, kw_only=True)
class Factor:
    """Of a positive definite `Banded`.

    Attributes:
        band: (n, w + 1), Cholesky's factor of the band, laid out as that.
        across: (n, m) the inverse of the band times the border.
        corner: (m, m) inverse of what the band leaves of the corner.
    """

    band: Array
    across: Array
    corner: Array
    log_determinant: float

    def solve(self, right: Array) -> Array:
        """(n + m,) or (n + m, k)."""
        n = len(self.band)
        right = np.asarray(right, dtype=np.float64)
        columns = right.reshape(len(right), -1)
        below = self.corner @ (columns[n:] - self.across.T @ columns[:n])
        above = self._by_band(columns[:n]) - self.across @ below
        return np.concatenate([above, below]).reshape(right.shape)

    def _by_band(self, right: Array) -> Array:
        return _solve_band(self.band, right)

    def inverse(self) -> Inverse:
        """The inverse within the band, without the rest of it (Takahashi et al. 1973), by blocks."""
        n, width = self.band.shape
        reach = width - 1
        inverse = np.zeros_like(self.band)
        window = np.zeros((0, 0))
        with threadpool_limits(limits=1, user_api="blas"):
            for first in range((n - 1) // _BLOCK * _BLOCK, -1, -_BLOCK):
                last = min(first + _BLOCK, n)
                size, below = last - first, min(n, last + reach) - last
                tall = np.zeros((size + below, size))
                for j in range(size):
                    height = min(width, size + below - j)
                    tall[j : j + height, j] = self.band[first + j, :height]
                inverted, _ = lapack.dtrtri(tall[:size], lower=1)
                inverted = np.tril(inverted)
                gain = tall[size:] @ inverted
                under = -window[:below, :below] @ gain
                here = inverted.T @ inverted - gain.T @ under
                grown = np.empty((size + below, size + below))
                grown[:size, :size], grown[size:, size:] = here, window[:below, :below]
                grown[size:, :size], grown[:size, size:] = under, under.T
                for j in range(size):
                    height = min(width, size + below - j)
                    inverse[first + j, :height] = grown[j : j + height, j]
                window = grown
        return Inverse(band=inverse, across=self.across, corner=self.corner)


@dataclass(frozen=True, kw_only=True)
class Inverse:
    """The inverse of a `Banded`, as far as its band and border reach.

    Attributes:
        band: (n, w + 1) of the inverse of the band alone; across, corner: as of `Factor`.
    """

    band: Array
    across: Array
    corner: Array

    @property
    def diagonal(self) -> Array:
        """(n + m,)."""
        beside = np.einsum("nk,kl,nl->n", self.across, self.corner, self.across)
        return np.concatenate([self.band[:, 0] + beside, np.diag(self.corner)])

    def block(self, columns: Array) -> Array:
        """(k, k) at columns (k,), each pair of which is within the band or in the border."""
        n, width = self.band.shape
        across = np.concatenate([self.across, -np.eye(len(self.corner))])[columns]
        block = np.asarray(across @ self.corner @ across.T)
        i, j = np.meshgrid(columns, columns, indexing="ij")
        low, high = np.minimum(i, j), np.maximum(i, j)
        banded = high < n
        if (high - low)[banded].max(initial=0) >= width:
            raise ValueError("the inverse is known within the band only")
        block[banded] += self.band[low[banded], (high - low)[banded]]
        return block


def factorize(matrix: Banded) -> Factor | None:
    """None where the matrix is not positive definite; its band is overwritten."""
    n, _ = matrix.band.shape
    with threadpool_limits(limits=1, user_api="blas"):
        band, info = lapack.dpbtrf(matrix.band.T, lower=1, overwrite_ab=1)
        if info != 0:
            return None
        band = band.T
        across = _solve_band(band, matrix.border)
        upper = np.triu(matrix.corner)
        left = upper + np.triu(upper, 1).T - matrix.border.T @ across
        try:
            lower = np.linalg.cholesky(left)
        except np.linalg.LinAlgError:
            return None
        corner = np.asarray(np.linalg.inv(left), dtype=np.float64)
    log_determinant = 2.0 * float(np.log(band[:, 0]).sum() + np.log(np.diag(lower)).sum())
    return Factor(band=band, across=across, corner=corner, log_determinant=log_determinant)


def _solve_band(band: Array, right: Array) -> Array:
    if not right.shape[1] or not len(band):
        return np.zeros_like(right)
    solved, _ = lapack.dpbtrs(band.T, np.asfortranarray(right), lower=1)
    return np.ascontiguousarray(solved)
