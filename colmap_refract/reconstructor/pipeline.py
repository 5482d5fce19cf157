"""From photographs to a refined model: the stages in their order, each taken over where it has been done."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_refract.errors import RefractError
from colmap_refract.files.cameras_file import read_cameras
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.machine import threads
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.photographs.images import list_images
from colmap_refract.reconstructor.calibration import Assignment, assign_cameras
from colmap_refract.reconstructor.colmap_options import check_options
from colmap_refract.reconstructor.features import extract_features
from colmap_refract.reconstructor.flow import track_flow
from colmap_refract.reconstructor.inventory import take_inventory
from colmap_refract.reconstructor.matches import match_features
from colmap_refract.reconstructor.models import map_images
from colmap_refract.reconstructor.options import ReconstructorOptions, widened
from colmap_refract.reconstructor.record import Record
from colmap_refract.reconstructor.refined import check_refined, leave_refined, refine_model
from colmap_refract.reconstructor.watcher import Watcher
from colmap_refract.reconstructor.workspace import Workspace


@dataclass(frozen=True, kw_only=True)
class Reconstructed:
    """Where the results are.

    Attributes:
        sparse_path: the model that ignores refraction.
        refractive_path: the refined model; None if that was not asked for.
        sidecar: what is known of the interfaces; None likewise.
    """

    sparse_path: Path
    refractive_path: Path | None
    sidecar: Sidecar | None


def reconstruct(
    workspace_path: Path,
    options: ReconstructorOptions,
    refiner: RefinerOptions,
    *,
    image_path: Path | None = None,
    database_path: Path | None = None,
    camera_path: Path | None = None,
    notes: ImageNotes | None = None,
    watcher: Watcher | None = None,
) -> Reconstructed:
    """Reconstruct a scene that was photographed through a plane interface.

    The workspace gets `database.db`, `sparse/0, 1, ...` and `sparse_refractive/0`, and `colmap_refract.json`, by which
    a later run knows what is done: a stage is done again only if its inputs changed, and what was not made here is
    never replaced.

    Args:
        workspace_path: made if it does not exist.
        options: of extraction, matching and mapping.
        refiner: of the refinement; its `num_threads` and `random_seed` hold for all stages.
        image_path: folder of the photographs; `images` in the workspace by default.
        database_path: of COLMAP; `database.db` in the workspace by default.
        camera_path: COLMAP cameras file with intrinsics calibrated in air.
        notes: which images share an interface, and which have none.
        watcher: is told how far it is.

    Raises:
        RefractError: the input cannot be used, or a stage comes to nothing; what was done before stays.
        KeyboardInterrupt: Ctrl-C; the next run goes on from there.
    """
    watcher = watcher or Watcher()
    refiner = replace(refiner, num_threads=threads(refiner.num_threads))
    images = image_path if image_path is not None else workspace_path / "images"
    if options.matcher == "flow" and refiner.scenario != "fixed_camera":
        raise RefractError("--matcher flow follows the pixels of a camera that stands still: it needs fixed_camera")
    check_options(options)
    cameras = read_cameras(camera_path) if camera_path is not None else None
    list_images(images)  # before anything is made
    record = Record(workspace_path)
    workspace = Workspace(
        path=workspace_path,
        database_path=database_path if database_path is not None else workspace_path / "database.db",
        image_path=images,
        record=record,
        watcher=watcher,
    )
    with workspace.locked():
        if record.lost:
            watcher.warn(record.lost)
        if options.refine:
            check_refined(workspace)
        photographs = take_inventory(images, record, watcher)
        _check_notes(notes, photographs)
        assignment = assign_cameras(
            photographs, images, cameras, camera_path, known=os.path.lexists(workspace.database_path)
        )
        options = widened(options, max(max(p.width, p.height) for p in photographs.values()))
        _report_images(watcher, len(photographs), assignment)
        if options.matcher == "flow":
            database = track_flow(workspace, photographs, assignment, options.Flow, refiner.reference_image)
        else:
            database = extract_features(workspace, photographs, assignment, options, refiner.num_threads)
            database = match_features(workspace, database, options, refiner.num_threads, refiner.random_seed)
        model = map_images(workspace, database, options, refiner)
        if not options.refine:
            leave_refined(workspace, model)
            return Reconstructed(sparse_path=model.path, refractive_path=None, sidecar=None)
        sidecar = refine_model(
            workspace,
            database,
            model,
            refiner,
            complete_tracks=options.complete_tracks,
            notes=notes or ImageNotes(),
            cameras=assignment.camera_of if assignment.calibrated else {},
        )
        return Reconstructed(sparse_path=model.path, refractive_path=workspace.refractive_path, sidecar=sidecar)


def _check_notes(notes: ImageNotes | None, photographs: Mapping[str, object]) -> None:
    """An error now, not after an hour of matching."""
    named = {} if notes is None else {**dict.fromkeys(notes.dry_images), **notes.interface_groups}
    strangers = sorted(name for name in named if name not in photographs)
    if strangers:
        raise RefractError(f"'{strangers[0]}' has a group or is listed as dry, but is not among the images")


def _report_images(watcher: Watcher, num_images: int, assignment: Assignment) -> None:
    sizes = ", ".join(f"{group.camera.width} x {group.camera.height}" for group in assignment.groups)
    remarks = "".join(f"; {remark}" for remark in assignment.remarks)
    watcher.report("Images", f"{num_images}, {sizes} pixels{remarks}")
