"""The second stage: matches between the images, verified with straight rays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from colmap_refract.errors import RefractError
from colmap_refract.mapping.database import open_database
from colmap_refract.reconstructor.colmap_options import matching_options, pairing_options, verification_options
from colmap_refract.reconstructor.colmap_process import run_colmap
from colmap_refract.reconstructor.contents import NUM_PAIRS, Contents, count_rows, read_contents
from colmap_refract.reconstructor.options import ReconstructorOptions, given
from colmap_refract.reconstructor.record import in_words
from colmap_refract.reconstructor.workspace import Workspace
from colmap_refract.reconstructor.workspace_database import MATCHES, Database

_STAGE = "Matching"


def match_features(
    workspace: Workspace, database: Database, options: ReconstructorOptions, num_threads: int, random_seed: int
) -> Database:
    """Match the images of the database as far as that is still to be done.

    A change of the options of matching removes the matches, one of verification or of the intrinsics only what was
    verified; neither from a database made elsewhere, whose matches are taken as they are.

    Raises:
        RefractError: no two images match, or COLMAP fails.
    """
    record, contents = workspace.record, database.contents
    inputs = {
        "features": contents.features,
        "matching": _matching(options),
        "verification": {**given(options.TwoViewGeometry), "random_seed": random_seed, "cameras": contents.cameras},
    }
    step = record.stages.get(MATCHES)
    changes = workspace.changes(MATCHES, inputs)
    reason = ""
    if not database.ours:
        complete = step is None or (step.output is not None and step.inputs.get("features") == contents.features)
        taken_over = complete and contents.num_verified_pairs > 0
    else:
        taken_over = workspace.done(MATCHES, inputs, contents.matches) is not None
        changed = [name for name in changes or [] if name != "features"]
        if changed and contents.num_pairs:
            reason = f"matched anew, since {in_words(changed[0])} changed"
            _clear(workspace, everything=options.FeatureMatching.guided_matching or _touches_matching(changed))
            contents = read_contents(workspace.database_path)
    num_before = contents.num_pairs
    if not taken_over:
        record.begin(MATCHES, inputs)
        _match(workspace, options, num_threads, random_seed, num_before)
        contents = read_contents(workspace.database_path)
    if not contents.num_verified_pairs:
        raise RefractError(
            f"no two images match ({contents.num_pairs} pairs were tried): do they overlap, and show the same scene? "
            "--SiftMatching.max_ratio 0.9 or a lower --TwoViewGeometry.min_num_inliers accept weaker matches"
        )
    if step is None or step.output != contents.matches or not taken_over:
        record.begin(MATCHES, inputs)
        record.complete(MATCHES, contents.matches, {})
    _report(workspace, contents, database.ours, taken_over, num_before, reason)
    return replace(database, contents=contents)


def _matching(options: ReconstructorOptions) -> dict[str, Any]:
    pairing = options.SequentialPairing if options.matcher == "sequential" else options.ExhaustivePairing
    return {
        "matcher": options.matcher,
        "FeatureMatching": {k: v for k, v in given(options.FeatureMatching).items() if k != "use_gpu"},
        "SiftMatching": given(options.SiftMatching),
        "pairing": {k: v for k, v in given(pairing).items() if k != "block_size"},
    }


def _touches_matching(changed: list[str]) -> bool:
    return any(name.startswith("matching") for name in changed)


def _clear(workspace: Workspace, *, everything: bool) -> None:
    with open_database(workspace.database_path) as database:
        database.clear_two_view_geometries()
        if everything:
            database.clear_matches()


def _match(
    workspace: Workspace, options: ReconstructorOptions, num_threads: int, random_seed: int, num_before: int
) -> None:
    path = workspace.database_path
    total: int | None = None

    def watch(message: dict[str, Any]) -> None:
        nonlocal total
        total = message.get("pairs", total)

    def poll() -> None:
        done = count_rows(path, NUM_PAIRS)
        if done is not None:
            workspace.watcher.progress(_STAGE, done, total, "pairs of images")

    workspace.watcher.progress(_STAGE, num_before, total, "pairs of images")
    arguments = {
        "database_path": path,
        "sequential": options.matcher == "sequential",
        "matching_options": matching_options(options, num_threads),
        "pairing_options": pairing_options(options, num_threads),
        "verification_options": verification_options(options, random_seed),
    }
    run_colmap("match", arguments, log_path=workspace.log_path, what="matching", watch=watch, poll=poll)


def _report(
    workspace: Workspace, contents: Contents, ours: bool, taken_over: bool, num_before: int, reason: str
) -> None:
    text = (
        f"{contents.num_inlier_matches} verified, in {contents.num_verified_pairs} of {contents.num_pairs} pairs of "
        "images"
    )
    if taken_over:
        text += " (taken over from an earlier run)" if ours else " (made elsewhere, used as they are)"
    elif reason:
        text += f" ({reason})"
    elif num_before:
        text += f" ({contents.num_pairs - num_before} pairs new)"
    workspace.watcher.report("Matches", text)
