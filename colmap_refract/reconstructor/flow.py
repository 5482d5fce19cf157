"""In place of the first two stages: tracks of a fixed camera's frames by optical flow, as a database."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict

from colmap_refract.errors import RefractError
from colmap_refract.optical_flow.options import FlowOptions
from colmap_refract.reconstructor.calibration import Assignment
from colmap_refract.reconstructor.contents import camera_key, read_contents
from colmap_refract.reconstructor.record import Photograph, in_words
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


def track_flow(
    workspace: Workspace,
    photographs: Mapping[str, Photograph],
    assignment: Assignment,
    options: FlowOptions,
    reference_image: str,
) -> Database:
    """The database of tracks against a reference frame: made, or taken over.

    Args:
        workspace: its own database is replaced where its inputs changed; one made elsewhere is used as it is.
        photographs: the frames.
        assignment: of the one camera.
        options: of the tracker.
        reference_image: name of the frame; '' for the one that the others differ least from.

    Raises:
        RefractError: frames that cannot be tracked, or a database made elsewhere that has no matches.
    """
    record, path = workspace.record, workspace.database_path
    inputs = {
        "images": {name: photograph.sha256 for name, photograph in photographs.items()},
        "detector": "flow",
        "cameras": [camera_key(group.camera) for group in assignment.groups],
        "Flow": asdict(options),
        "reference_image": reference_image,
    }
    contents = read_contents(path) if os.path.lexists(path) else None
    ours = contents is None or (contents.mark != 0 and contents.mark == record.database_mark)
    warn_of_intrinsics(workspace, assignment, ours=ours)
    remark, reference = "made elsewhere, used as they are", ""
    if contents is not None and not ours:
        check_images(path, contents, photographs)
        if not contents.num_verified_pairs:
            raise RefractError(
                f"{path} was made elsewhere and has no verified matches; move it away, or match it first"
            )
        check_keypoints(workspace, contents)
    elif contents is None or workspace.done(FEATURES, inputs, contents.features) is None:
        changes = workspace.changes(FEATURES, inputs) if contents is not None else None
        remark = f"tracked anew, since {in_words(changes[0])} changed" if changes else ""
        reference = _track(workspace, photographs, assignment, options, reference_image)
        contents = read_contents(path)
        facts = {"elsewhere": False, "calibrated": assignment.calibrated, "reference": reference}
        record.begin(FEATURES, inputs)
        record.complete(FEATURES, contents.features, facts)
        record.begin(MATCHES, {"features": contents.features})
        record.complete(MATCHES, contents.matches, {})
    else:
        remark = "taken over from an earlier run"
        reference = record.stages[FEATURES].facts.get("reference", reference_image)
    text = (
        f"{contents.num_inlier_matches} of the flow, in {contents.num_verified_pairs} of {len(photographs) - 1} frames "
        f"beside the reference{f', {reference}' if reference else ''}"
    )
    workspace.watcher.report("Matches", text + (f" ({remark})" if remark else ""))
    cameras = {} if ours else other_cameras(path, contents, assignment)
    return Database(contents=contents, ours=ours, cameras=cameras)


def _track(
    workspace: Workspace,
    photographs: Mapping[str, Photograph],
    assignment: Assignment,
    options: FlowOptions,
    reference_image: str,
) -> str:
    """Make the database; the name of the reference."""
    from colmap_refract.mapping.flow_database import create_flow_database
    from colmap_refract.optical_flow.reference import check_names, choose_reference
    from colmap_refract.optical_flow.report import lost_warning
    from colmap_refract.optical_flow.tracking import track_against_reference
    from colmap_refract.photographs.images import Gray, read_gray

    if len(assignment.groups) != 1:
        raise RefractError("optical flow follows the frames of one camera; give one calibrated camera")

    def read(name: str) -> Gray:
        return read_gray(workspace.image_path / name)

    names, say = list(photographs), workspace.watcher.say
    check_names(names, reference_image or None)
    reference = reference_image or choose_reference(read, names, watch=say)
    tracks = track_against_reference(read, names, reference, options, watch=say)
    camera = assignment.groups[0].camera if assignment.calibrated else None
    with workspace.scratch() as scratch:
        new = scratch / "database.db"
        create_flow_database(new, workspace.image_path, names, camera, tracks)
        put_database(workspace, new)
    if warning := lost_warning(tracks):
        workspace.watcher.warn(warning)
    return reference
