"""The first stage: a database with the images and their features."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from colmap_refract.errors import RefractError
from colmap_refract.mapping.database import open_database
from colmap_refract.reconstructor.calibration import Assignment
from colmap_refract.reconstructor.colmap_options import extraction_options
from colmap_refract.reconstructor.colmap_process import run_colmap
from colmap_refract.reconstructor.contents import NUM_KEYPOINTS, Contents, camera_key, count_rows, read_contents
from colmap_refract.reconstructor.options import ReconstructorOptions, given
from colmap_refract.reconstructor.record import Photograph, Step, in_words
from colmap_refract.reconstructor.workspace import Workspace
from colmap_refract.reconstructor.workspace_database import (
    FEATURES,
    MATCHES,
    Database,
    check_images,
    check_keypoints,
    other_cameras,
    put_database,
    warn_of_intrinsics,
)

_STAGE = "Extracting features"


def extract_features(
    workspace: Workspace,
    photographs: Mapping[str, Photograph],
    assignment: Assignment,
    options: ReconstructorOptions,
    num_threads: int,
) -> Database:
    """The database with features of every image: made, completed, or taken over as it is.

    Raises:
        RefractError: a database of other images, no features anywhere, or COLMAP fails.
    """
    record = workspace.record
    inputs = {
        "images": {name: photograph.sha256 for name, photograph in photographs.items()},
        "detector": "sift",
        "cameras": assignment.scheme,
        "FeatureExtraction": given(options.FeatureExtraction),
        "SiftExtraction": given(options.SiftExtraction),
    }
    path = workspace.database_path
    contents = read_contents(path) if os.path.lexists(path) else None
    ours = contents is not None and contents.mark != 0 and contents.mark == record.database_mark
    reason = "made"
    if contents is not None and ours:
        reason = why_anew(workspace, inputs, assignment)
        if reason:
            contents = None
    if contents is None:
        _make_database(workspace, assignment)
        contents, ours = read_contents(path), True
    elif not ours:
        check_images(path, contents, photographs)
    warn_of_intrinsics(workspace, assignment, ours=ours)
    known = contents
    cameras = other_cameras(path, contents, assignment)
    if ours and cameras:
        with open_database(path) as database:
            for camera in cameras.values():
                database.update_camera(camera)
        contents, cameras = read_contents(path), {}
    missing = [name for name in photographs if name not in contents.image_id]
    lacking = [name for name in photographs if name not in contents.num_keypoints]
    step = record.stages.get(FEATURES)
    facts = {"elsewhere": not ours, "calibrated": assignment.calibrated}
    if lacking:
        record.stages.pop(MATCHES, None)
        if not ours:  # those it has are not enough any more
            record.stages[MATCHES] = Step(inputs={})
        record.begin(FEATURES, inputs)
        if missing:
            _add_images(workspace, contents, assignment, missing, calibrated=assignment.calibrated)
        _extract(workspace, photographs, lacking, options, num_threads)
        contents = read_contents(path)
        cameras = {} if ours else other_cameras(path, contents, assignment)
    _check_features(workspace, photographs, contents)
    if not ours:
        check_keypoints(workspace, known)
    taken_over = not lacking
    if lacking or workspace.done(FEATURES, inputs, contents.features) is None or (step and step.facts != facts):
        record.begin(FEATURES, inputs)
        record.complete(FEATURES, contents.features, facts)
    _report(workspace, contents, ours, taken_over, len(lacking), reason)
    return Database(contents=contents, ours=ours, cameras=cameras)


def why_anew(workspace: Workspace, inputs: dict[str, Any], assignment: Assignment) -> str:
    """Why our database has to be made again; '' if it can be gone on with."""
    step = workspace.record.stages.get(FEATURES)
    if step is None:
        return ""
    before, now = step.inputs.get("images", {}), inputs["images"]
    if any(now.get(name) != digest for name, digest in before.items()):
        return "made anew, since images were changed or removed"
    changes = [name for name in workspace.changes(FEATURES, inputs) or [] if not name.startswith("images.")]
    if changes == ["cameras"] or (step.facts.get("calibrated") and not assignment.calibrated):
        return "made anew, since the cameras were dealt out anew"
    if changes:
        return f"made anew, since {in_words(changes[0])} changed"
    return ""


def _make_database(workspace: Workspace, assignment: Assignment) -> None:
    """A database with the images and no features, in place of one of ours."""
    groups = [(group.names, group.camera, None) for group in assignment.groups]
    with workspace.scratch() as scratch:
        new = scratch / "database.db"
        arguments = {"database_path": new, "image_path": workspace.image_path, "groups": groups}
        run_colmap("add_images", arguments, log_path=workspace.log_path, what="import of images")
        put_database(workspace, new)


def _add_images(
    workspace: Workspace, contents: Contents, assignment: Assignment, missing: list[str], *, calibrated: bool
) -> None:
    """Images that the database lacks, of the camera that its other images are of, if that is the same."""
    groups = []
    for group in assignment.groups:
        names = [name for name in group.names if name in set(missing)]
        key, size = camera_key(group.camera), (group.camera.width, group.camera.height)
        fitting = [
            camera_id
            for camera_id, known in sorted(contents.camera_size.items())
            if (contents.cameras[str(camera_id)] == key if calibrated else known == size)
        ]
        if names:
            groups.append((names, group.camera, fitting[0] if fitting else None))
    arguments = {
        "database_path": workspace.database_path,
        "image_path": workspace.image_path,
        "groups": groups,
    }
    run_colmap("add_images", arguments, log_path=workspace.log_path, what="import of images")


def _extract(
    workspace: Workspace,
    photographs: Mapping[str, Photograph],
    lacking: list[str],
    options: ReconstructorOptions,
    num_threads: int,
) -> None:
    path = workspace.database_path
    total = len(photographs)

    def poll() -> None:
        done = count_rows(path, NUM_KEYPOINTS)
        if done is not None:
            workspace.watcher.progress(_STAGE, done, total, "images")

    workspace.watcher.progress(_STAGE, total - len(lacking), total, "images")
    arguments = {
        "database_path": path,
        "image_path": workspace.image_path,
        "names": lacking,
        "options": extraction_options(options, num_threads),
    }
    run_colmap("extract", arguments, log_path=workspace.log_path, what="feature extraction", poll=poll)


def _check_features(workspace: Workspace, photographs: Mapping[str, Photograph], contents: Contents) -> None:
    lacking = [name for name in photographs if name not in contents.num_keypoints]
    if lacking:
        raise RefractError(
            f"COLMAP did not extract features from '{lacking[0]}'"
            + (f" and {len(lacking) - 1} more" if len(lacking) > 1 else "")
            + f"; see {workspace.log_path}"
        )
    empty = [name for name in photographs if not contents.num_keypoints[name]]
    if len(empty) > len(photographs) - 2:
        raise RefractError(
            f"{'no image has' if len(empty) == len(photographs) else 'only one image has'} any features: are the "
            "images blank or blurred? A lower --SiftExtraction.peak_threshold finds fainter ones"
        )
    if empty:
        others = f" and {len(empty) - 1} more" if len(empty) > 1 else ""
        workspace.watcher.warn(f"'{empty[0]}'{others} without any features: nothing can be matched with them")


def _report(workspace: Workspace, contents: Contents, ours: bool, taken_over: bool, num_new: int, reason: str) -> None:
    count = sum(contents.num_keypoints.values())
    text = f"{len(contents.num_keypoints)} images, {count} keypoints"
    if not ours:
        text += (
            f" (database made elsewhere, {'used as it is' if taken_over else f'features of {num_new} images added'})"
        )
    elif taken_over:
        text += " (taken over from an earlier run)"
    elif reason.startswith("made anew"):
        text += f" ({reason})"
    elif num_new < len(contents.num_keypoints):
        text += f" ({num_new} images new, the others taken over from an earlier run)"
    workspace.watcher.report("Features", text)
