"""The last stage: refraction."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from colmap_refract.errors import RefractError
from colmap_refract.files.model_io import write_model
from colmap_refract.files.output import WORK_PREFIX, output_folder
from colmap_refract.files.sidecar import SIDECAR_NAME, Sidecar, read_sidecar, write_sidecar
from colmap_refract.files.surfaces import write_surfaces
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.reconstructor.contents import camera_key, fingerprint
from colmap_refract.reconstructor.models import Model
from colmap_refract.reconstructor.record import in_words
from colmap_refract.reconstructor.workspace import Workspace
from colmap_refract.reconstructor.workspace_database import Database

if TYPE_CHECKING:
    import pycolmap

    from colmap_refract.refiner.refinement import Refinement

REFINEMENT = "refinement"


def check_refined(workspace: Workspace) -> None:
    """Raise RefractError where the result would replace what was not written here."""
    folder = workspace.refractive_path
    if not folder.is_dir():
        if os.path.lexists(folder):
            raise RefractError(f"{folder} is a file, where the refined model is to be written; move it away")
        return
    if all(name.startswith(WORK_PREFIX) for name in os.listdir(folder)):
        return
    step = workspace.record.stages.get(REFINEMENT)
    if step is None or fingerprint(folder) not in (step.output, step.facts.get("before")):
        raise RefractError(
            f"{folder} holds files that were not written here, or were changed since; move it away, it is not replaced"
        )


def refine_model(
    workspace: Workspace,
    database: Database,
    model: Model,
    options: RefinerOptions,
    *,
    complete_tracks: bool,
    notes: ImageNotes,
    cameras: Mapping[str, pycolmap.Camera],
) -> Sidecar:
    """Refine the model into `sparse_refractive/0`, or find that this has been done.

    Args:
        complete_tracks: use the database's matches, those included that the verification threw away.
        cameras: calibrated, by image name; empty if there are none.

    Returns:
        What `refraction.json` holds.
    """
    record, target = workspace.record, workspace.refractive_path
    chosen = {name: value for name, value in asdict(options).items() if name != "num_threads"}
    inputs: dict[str, Any] = {
        "model": model.output,
        "matches": database.contents.matches if complete_tracks else None,
        "options": chosen,
        "interface_groups": dict(notes.interface_groups),
        "dry_images": sorted(notes.dry_images),
        "cameras": {str(i): camera_key(camera) for i, camera in sorted(_by_id(model, cameras).items())},
    }
    output = fingerprint(target)
    if output and workspace.done(REFINEMENT, inputs, output) is not None:
        workspace.watcher.report("Refinement", "taken over from an earlier run")
        return read_sidecar(target)
    changes = workspace.changes(REFINEMENT, inputs) if output else None
    try:
        with output_folder(target, input_path=model.path, overwrite=True) as folder:
            result = _refine(workspace, database, model, options, complete_tracks, notes, cameras)
            write_model(result.reconstruction, folder)
            write_sidecar(result.sidecar, folder / SIDECAR_NAME)
            write_surfaces(
                folder,
                result.reconstruction,
                result.sidecar,
                lambda done, total: workspace.watcher.progress("Surfaces", done, total, "images"),
            )
            # Noted before the folder changes hands, so that neither the old nor the new one is taken for a stranger's.
            new = fingerprint(folder)
            record.begin(REFINEMENT, inputs)
            record.complete(REFINEMENT, new, {"before": output})
    except (RefractError, KeyboardInterrupt):
        if output:
            cause = f" ({in_words(changes[0])} has changed since)" if changes else ""
            workspace.watcher.warn(f"{target} is of an earlier run{cause}, and still there")
        raise
    workspace.watcher.report("Refinement", f"done anew, since {in_words(changes[0])} changed" if changes else "done")
    return result.sidecar


def leave_refined(workspace: Workspace, model: Model) -> None:
    """Say that there is a refined model still where none was asked for."""
    target, step = workspace.refractive_path, workspace.record.stages.get(REFINEMENT)
    if not fingerprint(target):
        return
    same = step is not None and step.inputs.get("model") == model.output
    of = "of this model" if same else "of another model without refraction than the one that is here now"
    workspace.watcher.warn(f"{target} is of an earlier run, {of}, and still there")


def _refine(
    workspace: Workspace,
    database: Database,
    model: Model,
    options: RefinerOptions,
    complete_tracks: bool,
    notes: ImageNotes,
    cameras: Mapping[str, pycolmap.Camera],
) -> Refinement:
    by_id = _by_id(model, cameras) or None
    watch = workspace.watcher.solving
    if not complete_tracks:
        from colmap_refract.refiner.refinement import refine

        return refine(model.reconstruction, options, notes=notes, cameras=by_id, watch=watch)
    from colmap_refract.mapping.database import read_correspondences
    from colmap_refract.mapping.retriangulation import refine_with_database

    correspondences = read_correspondences(workspace.database_path, verified=False)
    if database.cameras:
        seen = [
            database.cameras.get(int(camera_id), camera)
            for camera_id, camera in zip(correspondences.camera_ids, correspondences.cameras, strict=True)
        ]
        correspondences = replace(correspondences, cameras=seen)
    return refine_with_database(model.reconstruction, options, correspondences, notes=notes, cameras=by_id, watch=watch)


def _by_id(model: Model, cameras: Mapping[str, pycolmap.Camera]) -> dict[int, pycolmap.Camera]:
    """Calibrated cameras by their ids in the model."""
    return {
        image.camera_id: cameras[image.name] for image in model.reconstruction.images.values() if image.name in cameras
    }
