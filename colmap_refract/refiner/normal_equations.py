"""The normal equations of a whole problem at its state: all chunks' reduced systems and the priors, added up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_refract.estimator.chunk import Problem, slot_width, split
from colmap_refract.estimator.priors import prior_blocks
from colmap_refract.interface import Array

Key = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """Half the squared length of all residuals, to second order in the changes of n camera-side parameters.

    Attributes:
        keys: (slot, block) of the free parameter blocks; columns: where each begins.
        widths: of each block.
        cost, gradient, hessian: px^2; (n,); (n, n) symmetric and sparse, Gauss-Newton's.
    """

    keys: list[Key]
    columns: dict[Key, int]
    widths: dict[Key, int]
    cost: float
    gradient: Array
    hessian: sp.csc_array


def normal_equations(problem: Problem) -> NormalEquations | None:
    """Assemble them; None where a plane lies behind its camera or nothing can be evaluated."""
    chunks, priors = split(problem, 1), prior_blocks(problem)
    keys = sorted({key for chunk in chunks for key in chunk.keys} | {key for prior in priors for key in prior.keys})
    widths = {key: slot_width(key[0], problem.state) for key in keys}
    firsts = np.concatenate([[0], np.cumsum([widths[key] for key in keys])]).astype(int)
    columns = dict(zip(keys, firsts[:-1].tolist(), strict=True))
    n = int(firsts[-1])
    gradient, cost = np.zeros(n), 0.0
    rows, cols, values = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]

    def place(part: list[Key]) -> NDArray[np.int64]:
        return np.concatenate([columns[key] + np.arange(widths[key]) for key in part]).astype(np.int64)

    for chunk in chunks:
        reduced = chunk.reduce([np.zeros(w) for w in chunk.widths], None)
        if reduced is None:
            return None
        if not chunk.keys:
            cost += reduced[0]
            continue
        at = place(chunk.keys)
        matrix = np.triu(reduced[2])
        matrix = matrix + np.triu(matrix, 1).T
        i, j = np.nonzero(matrix)
        rows.append(at[i])
        cols.append(at[j])
        values.append(matrix[i, j])
        gradient[at] += reduced[1]
        cost += reduced[0]
    for prior in priors:
        residual, by_blocks = prior.evaluate([np.zeros(widths[key]) for key in prior.keys])
        jacobian = np.hstack(by_blocks)
        at = place(prior.keys)
        i, j = np.indices((len(at), len(at))).reshape(2, -1)
        rows.append(at[i])
        cols.append(at[j])
        values.append((jacobian.T @ jacobian).ravel())
        gradient[at] += jacobian.T @ residual
        cost += 0.5 * float(residual @ residual)
    hessian = sp.csc_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))), shape=(n, n))
    return NormalEquations(
        keys=keys, columns=columns, widths=widths, cost=cost, gradient=gradient, hessian=hessian
    )  # fmt: skip
