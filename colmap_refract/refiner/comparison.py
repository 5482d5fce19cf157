"""Which of several refinements of a capture to believe: the simplest that predicts as well as any.

Each candidate refines the model without some observations, the same for all, and predicts them. The freer of two
candidates fits better what it has seen, but does not predict better unless the images ask for its freedom.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import stdtrit

from colmap_refract.errors import RefractError
from colmap_refract.estimator.scenario import Index
from colmap_refract.interface import Array
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.refiner.continuation import Watch
from colmap_refract.refiner.held_out import HeldOut, hold_out
from colmap_refract.refiner.refinement import refine

if TYPE_CHECKING:
    import pycolmap

    from colmap_refract.estimator.adjustment import Progress

HELD_OUT_PART = 0.2
OBSERVATIONS_PER_IMAGE = 300
"""A decision takes far fewer than a solution does. With half of them, planes that move by little pass for one."""
_TOLERANCE = 1e-6
_MAX_ITERATIONS = 100
"""Of the solver: predictions are as good as they get long before the last digit."""
_CAP = 4.0
"""Times the noise in the best candidate's predictions: what an observation counts that is farther off."""
_MEDIAN_LENGTH = 1.1774
"""Of a plane vector with coordinates of unit standard deviation."""
_CONFIDENCE = 0.975
"""One-sided, of the interval of a difference: 95 % two-sided."""
_RELEVANT = 0.005
"""Part of the error: what is better by less is not worth more unknowns."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A way to refine the model.

    Attributes:
        label: what to call it.
        options: of the refinement.
        complexity: unknowns of interfaces and poses, of which the least is the simplest.
    """

    label: str
    options: RefinerOptions
    complexity: float


@dataclass(frozen=True, kw_only=True)
class Trial:
    """How a candidate did; its errors are px, from keypoint to prediction, with those of wrong matches capped.

    Attributes:
        candidate: what was tried.
        error: root mean square over what was held out; None where it could not be, or need not be, refined.
        difference: of `error` to the best candidate's; 0 for that one.
        difference_std: standard error of `difference`.
        tied: whether the difference is no larger than noise explains, or too small to matter.
        log_likelihood: of what was not held out, averaged over the waves, where there are some.
        seconds: of the refinement.
        reason: why it could not be refined; empty if it could.
    """

    candidate: Candidate
    error: float | None = None
    difference: float | None = None
    difference_std: float | None = None
    tied: bool = False
    log_likelihood: float | None = None
    seconds: float = 0.0
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Candidates, compared.

    Attributes:
        trials: in the order of the candidates.
        chosen: the simplest that predicts as well as any.
        why: one or two sentences.
        num_held_out: observations that were predicted.
        num_images: that they are in.
        num_points3D: points of the model that the candidates were refined with.
    """

    trials: tuple[Trial, ...]
    chosen: Candidate
    why: str
    num_held_out: int = 0
    num_images: int = 0
    num_points3D: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Numbers and text, for the sidecar's statistics."""
        numbers = asdict(replace(self, trials=()))
        trials = []
        for trial in self.trials:
            row = asdict(trial)
            del row["candidate"]
            trials.append({"label": trial.candidate.label, "complexity": trial.candidate.complexity, **row})
        return {**numbers, "chosen": self.chosen.label, "trials": trials}


def compare(
    reconstruction: pycolmap.Reconstruction,
    candidates: Sequence[Candidate],
    *,
    notes: ImageNotes | None = None,
    cameras: Mapping[int, pycolmap.Camera] | None = None,
    seed: int = 0,
    part: float = HELD_OUT_PART,
    per_image: int | None = OBSERVATIONS_PER_IMAGE,
    watch: Watch | None = None,
) -> Comparison:
    """Refine a model in several ways without some of its observations, and see which way predicts those best.

    A candidate is tied with the best one while noise explains the difference of their mean squared errors (95 %
    confidence, the images as clusters), or the roots differ by less than half a hundredth. Of the best and those tied
    with it the simplest is chosen; among equally simple ones the better. A single candidate is chosen untried.

    Between shapes that wave, prediction says little of what moves: a surface follows what the planes do, if it may be
    steep enough. Where such a shape is the simplest, the likelihood of what was seen decides between it and those
    tied with it that wave, too: an unknown more is worth one unit of its logarithm (Akaike 1974).

    Args:
        reconstruction: a COLMAP model that ignored refraction; not altered.
        candidates: with different labels. Their solvers' tolerance is widened: use the options of the chosen one
            to refine the whole model.
        notes, cameras: as for `refine`.
        seed: of the choice of what is held out.
        part: of the observations, to be held out.
        per_image: observations in each image that are enough, in a model that has more; None: all are used.
        watch: called as by `refine`, with the candidate's number and label before the stage's name.

    Raises:
        RefractError: no candidate could be refined, or no observation can be spared.
        KeyboardInterrupt: Ctrl-C during a solve; nothing has been changed.
    """
    if len({candidate.label for candidate in candidates}) < max(len(candidates), 1):
        raise RefractError("candidates to compare need different labels: give one or more")
    if len(candidates) == 1:
        only = candidates[0]
        return Comparison(
            trials=(Trial(candidate=only),), chosen=only, why=f"{only.label} is the only one that is possible here."
        )
    held_out = hold_out(reconstruction, part=part, per_image=per_image, seed=seed)
    trials, errors = [], []
    for number, candidate in enumerate(candidates, start=1):
        name = f"Candidate {number} of {len(candidates)}, {candidate.label}"
        trial, error = _try(candidate, held_out, notes, cameras, name, watch)
        trials.append(trial)
        errors.append(error)
    trials = _judge(trials, errors, held_out.observations.image)
    chosen, why = _choose(trials)
    return Comparison(
        trials=tuple(trials),
        chosen=chosen,
        why=why,
        num_held_out=len(held_out.observations.image),
        num_images=len(np.unique(held_out.observations.image)),
        num_points3D=held_out.reconstruction.num_points3D(),
    )


def paired_difference(first: Array, second: Array, cluster: Index) -> tuple[float, float, float]:
    """Mean of `first - second` (K,), its standard error, and how many of those make a 95 % interval to either side.

    What belongs to one `cluster` (K,) may be correlated, as errors through the same interface are: the sums over
    clusters are taken to be independent, as in cluster-robust regression (Liang & Zeger 1986, with the factor
    G / (G - 1)), and the interval is that of Student's t with G - 1 degrees of freedom. A single cluster tells
    nothing: its standard error is infinite.
    """
    difference = first - second
    mean = float(difference.mean())
    _, number = np.unique(cluster, return_inverse=True)
    sums = np.bincount(number, weights=difference - mean)
    count = len(sums)
    if count < 2:
        return mean, np.inf, 1.0
    deviation = float(np.sqrt(count / (count - 1) * (sums**2).sum())) / len(difference)
    return mean, deviation, float(stdtrit(count - 1, _CONFIDENCE))


def table(comparison: Comparison) -> str:
    """The comparison for a terminal: lines of text with units, without a final newline."""
    head = f"{'Candidate':20s}{'unknowns':>10s}{'error [px]':>12s}{'above the least [px]':>24s}{'time [s]':>10s}"
    lines, reasons = [head, "-" * len(head)], []
    for trial in comparison.trials:
        error, above = "-", "-"
        if trial.error is not None:
            error = f"{trial.error:.3f}"
        if trial.difference:
            above = f"{trial.difference:.3f} +- {trial.difference_std or 0.0:.3f} {' ' if trial.tied else '*'}"
        lines.append(
            f"{trial.candidate.label:20s}{trial.candidate.complexity:10.4g}{error:>12s}{above:>24s}{trial.seconds:10.1f}"
        )
        if trial.reason:
            reasons.append(f"{trial.candidate.label}: {trial.reason}.")
    if comparison.num_held_out:
        lines.append(
            f"Root mean square over {comparison.num_held_out} held-out observations of {comparison.num_images} images "
            f"and {comparison.num_points3D} points; *: more than noise."
        )
    return "\n".join([*lines, *reasons, comparison.why])


def _try(
    candidate: Candidate,
    held_out: HeldOut,
    notes: ImageNotes | None,
    cameras: Mapping[int, pycolmap.Camera] | None,
    name: str,
    watch: Watch | None,
) -> tuple[Trial, Array]:
    """A refinement without what was held out, and its errors (K,) there; infinite if it failed."""
    adjustment = candidate.options.BundleAdjustment
    quick = replace(
        adjustment,
        function_tolerance=max(adjustment.function_tolerance, _TOLERANCE),
        max_num_iterations=min(adjustment.max_num_iterations, _MAX_ITERATIONS),
    )

    def show(stage: str, progress: Progress) -> None:
        if watch is not None:
            watch(f"{name}: {stage}", progress)

    started = perf_counter()
    reason, error, likelihood = "", np.full(len(held_out.observations.image), np.inf), None
    try:
        options = replace(candidate.options, BundleAdjustment=quick)
        refined = refine(held_out.reconstruction, options, notes=notes, cameras=cameras, watch=show)
        error = held_out.errors(refined.reconstruction, refined.sidecar)
        likelihood = refined.sidecar.statistics.get("waves", {}).get("log_likelihood")
        if not np.isfinite(np.median(error)):
            reason = "it lost most of the points"
    except RefractError as problem:
        reason = str(problem)
    seconds = perf_counter() - started
    return Trial(candidate=candidate, log_likelihood=likelihood, seconds=seconds, reason=reason), error


def _judge(trials: list[Trial], errors: list[Array], image: Index) -> list[Trial]:
    """The trials with what their errors (K,) say; `image` (K,) is the one that each observation is in."""
    able = [k for k, trial in enumerate(trials) if not trial.reason]
    if not able:
        if len({trial.reason for trial in trials}) == 1:
            raise RefractError(trials[0].reason)  # not a matter of how they differ
        reasons = "; ".join(f"{trial.candidate.label}: {trial.reason}" for trial in trials)
        raise RefractError(f"no candidate could be refined, so check the model and its intrinsics ({reasons})")
    # One limit for all: a wrong match then counts the same everywhere, as does a point that a candidate has lost.
    limit = _CAP * min(float(np.median(errors[k])) for k in able) / _MEDIAN_LENGTH
    squared = {k: np.minimum(errors[k], limit) ** 2 for k in able}
    best = min(able, key=lambda k: float(squared[k].mean()))
    least = float(np.sqrt(squared[best].mean()))
    judged = list(trials)
    for k in able:
        error = float(np.sqrt(squared[k].mean()))
        mean, deviation, interval = paired_difference(squared[k], squared[best], image)
        # Differences of squares as differences of roots.
        both = max(error + least, 1e-300)
        judged[k] = replace(
            trials[k],
            error=error,
            difference=mean / both,
            difference_std=deviation / both,
            tied=k == best or mean <= interval * deviation or error <= (1 + _RELEVANT) * least,
        )
    return judged


def _gain(trial: Trial, simplest: Trial) -> float:
    """By what the log likelihood is higher than the simplest candidate's, less one for each unknown more."""
    more = trial.candidate.complexity - simplest.candidate.complexity
    if trial is simplest:
        return 0.0
    if trial.log_likelihood is None or simplest.log_likelihood is None or more <= 0:
        return -np.inf
    return trial.log_likelihood - simplest.log_likelihood - more


def _choose(trials: Sequence[Trial]) -> tuple[Candidate, str]:
    """The simplest of the best and those tied with it, and why."""
    tied = sorted(
        (trial for trial in trials if trial.tied), key=lambda trial: (trial.candidate.complexity, trial.error)
    )
    simplest = tied[0]
    winner = max(tied, key=lambda trial: _gain(trial, simplest))
    others = [trial for trial in tied if trial is not winner]
    label, options = winner.candidate.label, winner.candidate.options
    failed = [trial.candidate.label for trial in trials if trial.reason]
    equal = [trial.candidate.label for trial in others if trial.candidate.complexity == winner.candidate.complexity]
    freer = [trial.candidate.label for trial in others if trial.candidate.complexity > winner.candidate.complexity]
    sentences = []
    if len(failed) == len(trials) - 1:
        sentences.append(f"{label} is the only one that could be refined, which says little for it.")
    elif not others:
        sentences.append(f"{label} predicts best what was held out.")
    if winner is not simplest:
        more = winner.candidate.complexity - simplest.candidate.complexity
        sentences.append(
            f"{simplest.candidate.label} predicts as well as {label} and is simpler, but with waves that is not all: "
            f"what was seen is more probable with the latter (log likelihood higher by "
            f"{_gain(winner, simplest) + more:.0f}, for {more:.4g} more unknowns)."
        )
    if freer:
        sentences.append(f"{label} predicts as well as {', '.join(freer)}, and is simpler.")
    if equal:
        sentences.append(f"{label} and {', '.join(equal)} cannot be told apart here: name the right one, if you know.")
    if winner.error is not None and 0 < options.filter_max_reproj_error < winner.error:
        sentences.append(f"Its predictions are off by {winner.error:.2g} px: none of the candidates fits.")
    return winner.candidate, " ".join(sentences)
