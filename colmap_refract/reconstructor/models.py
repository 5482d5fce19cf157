"""The third stage: COLMAP's models, which ignore refraction."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_refract.errors import RefractError, listed
from colmap_refract.files.model_io import read_model, write_model
from colmap_refract.mapping.database import copy_database, open_database
from colmap_refract.options import RefinerOptions
from colmap_refract.reconstructor.colmap_options import mapping_options
from colmap_refract.reconstructor.colmap_process import run_colmap
from colmap_refract.reconstructor.contents import camera_key, fingerprint
from colmap_refract.reconstructor.options import ReconstructorOptions, given
from colmap_refract.reconstructor.record import in_words
from colmap_refract.reconstructor.workspace import Workspace, replace_folder
from colmap_refract.reconstructor.workspace_database import Database

if TYPE_CHECKING:
    import pycolmap

MAPPING = "mapping"
USABLE = 0.5
"""Part of the images that the mapper has to register before start values from pairs are not even tried."""
_STAGE = "Mapping"
_NO_MODEL = (
    "the mapper finds no model: take more images that overlap, try --Mapper.init_min_num_inliers 50, or --scenario "
    "fixed_camera if the camera stood still"
)


@dataclass(frozen=True, kw_only=True)
class Model:
    """The model to refine.

    Attributes:
        reconstruction: the largest of COLMAP's.
        path: its folder.
        output: its fingerprint.
    """

    reconstruction: pycolmap.Reconstruction
    path: Path
    output: str


def map_images(
    workspace: Workspace,
    database: Database,
    options: ReconstructorOptions,
    refiner: RefinerOptions,
) -> Model:
    """COLMAP's incremental mapping with the intrinsics held; start values from pairs of images where that fails.

    All models of the mapper are kept, in `sparse/0, 1, ...`, the largest first. One made elsewhere is taken as it is.

    Args:
        workspace, database: of the matched images.
        options: of the mapper.
        refiner: its scenario, threads and seed; with `fixed_camera` the mapper is not asked, as there is no baseline.

    Raises:
        RefractError: no model comes about, or `sparse` holds a model of other images.
    """
    record, contents, target = workspace.record, database.contents, workspace.sparse_path
    inputs = {
        "features": contents.features,
        "matches": contents.matches,
        "cameras": {**contents.cameras, **{str(i): camera_key(camera) for i, camera in database.cameras.items()}},
        "fixed_camera": refiner.scenario == "fixed_camera",
        "Mapper": given(options.Mapper),
        "random_seed": refiner.random_seed,
        "reference_image": refiner.reference_image if refiner.scenario == "fixed_camera" else "",
    }
    output = fingerprint(target)
    step = record.stages.get(MAPPING)
    if output and (step is None or step.facts["elsewhere"] or output not in (step.output, step.facts["before"])):
        models = _models_made_elsewhere(workspace, database)
        record.begin(MAPPING, inputs)
        record.complete(MAPPING, output, {"elsewhere": True})
        _report(workspace, database, models, "made elsewhere, taken as it is")
        return Model(reconstruction=models[0], path=target / "0", output=fingerprint(target / "0"))
    remark = "taken over from an earlier run"
    if not output or workspace.done(MAPPING, inputs, output) is None:
        changes = workspace.changes(MAPPING, inputs)
        remark = f"mapped anew, since {in_words(changes[0])} changed" if output and changes else ""
        with workspace.scratch() as scratch:
            how = _map(workspace, database, options, refiner, scratch)
            # Noted before the folder changes hands, so that neither the old nor the new one is taken for a stranger's.
            record.begin(MAPPING, inputs)
            facts = {"elsewhere": False, "how": how, "before": output}
            record.complete(MAPPING, fingerprint(scratch / "sparse"), facts)
            replace_folder(scratch / "sparse", target, scratch / "old")
    how = str(record.stages[MAPPING].facts["how"])
    models = [read_model(folder) for folder in model_folders(target)]
    _report(workspace, database, models, ", ".join(part for part in (how, remark) if part))
    return Model(reconstruction=models[0], path=target / "0", output=fingerprint(target / "0"))


def model_folders(sparse: Path) -> list[Path]:
    """The models in a folder, 0, 1, ..., in their order."""
    found = [path for path in sparse.iterdir() if path.is_dir() and path.name.isdecimal()] if sparse.is_dir() else []
    return sorted(found, key=lambda path: int(path.name))


def _models_made_elsewhere(workspace: Workspace, database: Database) -> list[pycolmap.Reconstruction]:
    target = workspace.sparse_path
    folders = model_folders(target)
    if not folders or folders[0].name != "0":
        raise RefractError(f"{target} was made elsewhere, and holds no model {target / '0'}; move it away")
    models = [read_model(folder) for folder in folders]
    known = database.contents.num_keypoints
    for image in models[0].images.values():
        if known.get(image.name) != image.num_points2D():
            raise RefractError(
                f"{folders[0]} was made elsewhere and is not of this database: '{image.name}' has other keypoints in "
                f"it; move {target} away to have the images mapped anew"
            )
    return models


def _map(
    workspace: Workspace,
    database: Database,
    options: ReconstructorOptions,
    refiner: RefinerOptions,
    scratch: Path,
) -> str:
    """Models in `scratch / "sparse"`, the largest first; how they came about ('' for COLMAP's mapper)."""
    num_images = len(database.contents.image_id)
    database_path = _with_cameras(workspace.database_path, database, scratch)
    mapped: list[pycolmap.Reconstruction] = []
    fixed_camera = refiner.scenario == "fixed_camera"
    if not fixed_camera:
        mapped = _run_mapper(workspace, database, database_path, options, refiner, scratch)
    how = ""
    if not mapped or mapped[0].num_reg_images() < USABLE * num_images:
        initial, reason = _from_pairs(workspace, database_path, refiner)
        if initial is not None and (not mapped or initial.num_reg_images() > mapped[0].num_reg_images()):
            mapped, how = [initial, *mapped], "start values from pairs of images"
        elif not mapped:
            raise RefractError(reason if fixed_camera else f"{_NO_MODEL} ({reason})")
    for number, model in enumerate(mapped):
        folder = scratch / "sparse" / str(number)
        folder.mkdir(parents=True)
        write_model(model, folder)
    return how


def _run_mapper(
    workspace: Workspace,
    database: Database,
    database_path: Path,
    options: ReconstructorOptions,
    refiner: RefinerOptions,
    scratch: Path,
) -> list[pycolmap.Reconstruction]:
    num_images = len(database.contents.image_id)
    registered = 0

    def watch(message: dict[str, Any]) -> None:
        nonlocal registered
        registered = (0 if message.get("new_model") else registered) + message.get("new_images", 0)
        workspace.watcher.progress(_STAGE, registered, num_images, "images")

    workspace.watcher.progress(_STAGE, 0, num_images, "images")
    output = scratch / "mapped"
    output.mkdir()
    arguments = {
        "database_path": database_path,
        "image_path": workspace.image_path,
        "output_path": output,
        "options": mapping_options(options, refiner.num_threads, refiner.random_seed),
    }
    run_colmap("map", arguments, log_path=workspace.log_path, what="mapping", watch=watch)
    models = [read_model(folder) for folder in model_folders(output)]
    shutil.rmtree(output, ignore_errors=True)
    return sorted(models, key=lambda model: (model.num_reg_images(), model.num_points3D()), reverse=True)


def _from_pairs(
    workspace: Workspace, database_path: Path, refiner: RefinerOptions
) -> tuple[pycolmap.Reconstruction | None, str]:
    """Start values as the paper finds them, or why there are none."""
    from colmap_refract.mapping.database import read_correspondences
    from colmap_refract.mapping.initial import initial_model
    from colmap_refract.mapping.model_from_database import read_unposed_model
    from colmap_refract.mapping.tracks import build_tracks

    stage, watcher = "Start values from pairs of images", workspace.watcher
    watcher.say(f"{stage} ...")
    try:
        correspondences = read_correspondences(database_path)
        found = initial_model(
            correspondences,
            build_tracks(correspondences),
            read_unposed_model(database_path, correspondences),
            scenario=refiner.scenario,
            reference=refiner.reference_image or None,
            random_seed=refiner.random_seed,
            num_threads=refiner.num_threads,
            watch=lambda done, total: watcher.progress(stage, done, total, "images"),
        )
    except RefractError as error:
        return None, str(error)
    for warning in found.warnings:
        watcher.warn(warning)
    return found.reconstruction, ""


def _with_cameras(path: Path, database: Database, scratch: Path) -> Path:
    """A database for the mapper: the database itself, or a copy where it was made elsewhere or has other cameras.

    COLMAP alters every database that it opens. Other cameras are calibrated ones that a database made elsewhere must
    not be given, and guessed ones: they are said to be known, as the mapper otherwise finds a focal length of its own
    when it places an image, whatever its options.
    """
    guessed = [i for i in database.contents.camera_size if not database.contents.cameras[str(i)][3]]
    if database.ours and not database.cameras and not guessed:
        return path
    copy = scratch / "database.db"
    copy_database(path, copy)
    with open_database(copy) as opened:
        for camera_id in {*guessed, *database.cameras}:
            camera = database.cameras.get(camera_id) or opened.read_camera(camera_id)
            camera.has_prior_focal_length = True
            opened.update_camera(camera)
    return copy


def _report(workspace: Workspace, database: Database, models: list[pycolmap.Reconstruction], remark: str) -> None:
    watcher, names = workspace.watcher, set(database.contents.image_id)
    first = models[0]
    text = (
        f"{first.num_reg_images()} of {len(names)} images registered, {first.num_points3D()} points, "
        f"{first.compute_mean_reprojection_error():.2f} px without refraction"
    )
    watcher.report("Model", text + (f" ({remark})" if remark else ""))
    if first.num_reg_images() < USABLE * len(names):
        watcher.warn("less than half of the images are in the model: more overlap, or more features, would help")
    missing = sorted(names - {image.name for image in first.images.values() if image.has_pose})
    if missing:
        watcher.report("Not registered", listed(missing))
    for number, model in enumerate(models[1:], start=1):
        others = sorted(image.name for image in model.images.values() if image.has_pose)
        watcher.report(
            f"Model {number}, apart",
            f"{len(others)} images in {workspace.sparse_path / str(number)}, not refined: {listed(others)}",
        )
