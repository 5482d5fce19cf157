"""`automatic_reconstructor` on pictures: what it makes of them, what it does not do twice, and how it stops.

The pictures are of a relief below a flat surface, traced by Snell's law as written here. They are small, sharp and
without glare: what real water does to features is not shown.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from test_stages import Told, calls, files, tables, write_blank

from colmap_refract.commands.automatic_reconstructor import AutomaticReconstructor
from colmap_refract.errors import RefractError
from colmap_refract.interface import Array
from colmap_refract.options import RefinerOptions
from colmap_refract.reconstructor.options import (
    MapperOptions,
    ReconstructorOptions,
    SiftExtractionOptions,
    SiftMatchingOptions,
    TwoViewGeometryOptions,
)
from colmap_refract.reconstructor.pipeline import Reconstructed, reconstruct
from colmap_refract.reconstructor.record import RECORD_NAME
from colmap_refract.reconstructor.watcher import Watcher

__all__ = ["calls"]  # a fixture

WIDTH, HEIGHT, FOCAL_LENGTH = 320, 240, 260.0
DEPTH, SURFACE, INDEX = 2.0, 0.6, 1.333
"""Of the mean ground and of the water's surface below the cameras, metres; of the water."""
FEATURES = SiftExtractionOptions(max_num_features=700)
REFINER = RefinerOptions(scenario="static_interface", num_threads=1)


def relief(x: Array, y: Array) -> Array:
    """Depth of the ground."""
    return np.asarray(DEPTH + 0.25 * np.sin(3 * x + 0.3) * np.cos(2.3 * y))


def write_pictures(folder: Path, count: int) -> None:
    rng = np.random.default_rng(5)
    texels = 1200
    texture = np.zeros((texels, texels), np.float32)
    for coarse in (3, 6, 12, 24):
        grain = rng.standard_normal((texels // coarse, texels // coarse)).astype(np.float32)
        texture += coarse**0.5 * cv2.resize(grain, (texels, texels), interpolation=cv2.INTER_CUBIC)
    texture = np.clip(128 + 45 * texture / texture.std(), 0, 255)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.stack([(u - WIDTH / 2) / FOCAL_LENGTH, (v - HEIGHT / 2) / FOCAL_LENGTH, np.ones_like(u)], -1)
    for k in range(count):
        azimuth, oblique = 2.4 * k, np.radians(rng.uniform(12, 24))
        view = np.array([np.sin(oblique) * np.cos(azimuth), np.sin(oblique) * np.sin(azimuth), np.cos(oblique)])
        across = np.cross([0, 1, 0], view) / np.linalg.norm(np.cross([0, 1, 0], view))
        rotation = np.array([across, np.cross(view, across), view])
        center = np.array([*rng.uniform(-0.15, 0.15, 2), DEPTH]) - DEPTH / np.cos(oblique) * view
        rays = pixels.reshape(-1, 3) @ rotation
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        entry = center + ((SURFACE - center[2]) / rays[:, 2])[:, None] * rays
        below = rays / INDEX  # Snell: what is along the surface shrinks
        below[:, 2] = np.sqrt(1 - (below[:, :2] ** 2).sum(axis=1))
        z = np.full(len(rays), DEPTH)
        for _ in range(30):
            ground = entry + ((z - SURFACE) / below[:, 2])[:, None] * below
            z = 0.5 * (z + relief(ground[:, 0], ground[:, 1]))
        place = ((ground[:, :2] / 5 + 0.5) * texels).astype(np.float32).reshape(HEIGHT, WIDTH, 2)
        picture = cv2.remap(texture, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / f"view{k}.png"), np.clip(picture + rng.normal(0, 2, u.shape), 0, 255).astype(np.uint8))


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with six pictures and, outside of it, the calibration."""
    folder = tmp_path_factory.mktemp("pictures")
    write_pictures(folder / "images", 6)
    params = f"{FOCAL_LENGTH} {FOCAL_LENGTH} {WIDTH / 2} {HEIGHT / 2}"
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {params}\n")
    return folder


def run(workspace: Path, pictures: Path, watcher: Watcher | None = None, **more: Any) -> Reconstructed:
    options = {"SiftExtraction": FEATURES, **{k: v for k, v in more.items() if k not in ("refiner", "database_path")}}
    return reconstruct(
        workspace,
        ReconstructorOptions(**options),
        more.get("refiner", REFINER),
        image_path=None if (workspace / "images").exists() else pictures / "images",
        camera_path=pictures / "cameras.txt",
        database_path=more.get("database_path"),
        watcher=watcher,
    )


@pytest.fixture(scope="session")
def finished(pictures: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Told]:
    """A workspace in which everything is done, and what was said."""
    workspace, watcher = tmp_path_factory.mktemp("finished") / "workspace", Told()
    run(workspace, pictures, watcher)
    return workspace, watcher


@pytest.fixture
def workspace(finished: tuple[Path, Told], tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished[0], tmp_path / "workspace"))


def counts(workspace: Path) -> dict[str, int]:
    with closing(sqlite3.connect(workspace / "database.db")) as database:
        names = ("images", "keypoints", "matches", "two_view_geometries")
        return {name: database.execute(f"SELECT COUNT(*) FROM {name}").fetchone()[0] for name in names}


def height_error(path: Path) -> float:
    """Median distance of points from the relief, metres, after the similarity that fits them best.

    The cameras give it roughly, and the points the rest.
    """
    model = pycolmap.Reconstruction(path)
    points = np.array([point.xyz for point in model.points3D.values() if point.track.length() >= 3])
    assert len(points) > 200
    from scipy.optimize import least_squares

    centers = {image.name: image.projection_center() for image in model.images.values()}
    names = sorted(centers)
    source = np.array([centers[name] for name in names])
    target = _true_centers(len(names))
    s, t = source - source.mean(axis=0), target - target.mean(axis=0)
    u, sigma, vt = np.linalg.svd(t.T @ s)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    scale = sigma.sum() / (s**2).sum()
    start = scale * (points - source.mean(axis=0)) @ turn.T + target.mean(axis=0)
    middle = start.mean(axis=0)

    def moved(x: Array) -> Array:
        rotation = pycolmap.Rotation3d(x[:3]).matrix()
        return np.asarray(np.exp(x[6]) * (start - middle) @ rotation.T + middle + x[3:6])

    def heights(x: Array) -> Array:
        place = moved(x)
        return np.asarray(place[:, 2] - relief(place[:, 0], place[:, 1]))

    found = least_squares(heights, np.zeros(7), loss="soft_l1", f_scale=0.02)
    return float(np.median(np.abs(heights(found.x))))


def _true_centers(count: int) -> Array:
    """Of `write_pictures`: the same draws."""
    rng = np.random.default_rng(5)
    for coarse in (3, 6, 12, 24):
        rng.standard_normal((1200 // coarse, 1200 // coarse))
    centers = []
    for k in range(count):
        azimuth, oblique = 2.4 * k, np.radians(rng.uniform(12, 24))
        view = np.array([np.sin(oblique) * np.cos(azimuth), np.sin(oblique) * np.sin(azimuth), np.cos(oblique)])
        centers.append(np.array([*rng.uniform(-0.15, 0.15, 2), DEPTH]) - DEPTH / np.cos(oblique) * view)
        rng.normal(0, 2, (HEIGHT, WIDTH))
    return np.array(centers)


# --- What it makes -------------------------------------------------------------------------------------------------


def test_everything_from_pictures(finished: tuple[Path, Told]) -> None:
    workspace, watcher = finished
    assert sorted(path.name for path in workspace.iterdir()) == [
        RECORD_NAME,
        "database.db",
        "log.txt",
        "sparse",
        "sparse_refractive",
    ]
    assert counts(workspace) == {"images": 6, "keypoints": 6, "matches": 15, "two_view_geometries": 15}
    assert "6 of 6 images registered" in watcher.said("Model")
    assert {"Reading images", "Extracting features", "Matching", "Mapping"} <= set(watcher.stages)
    (camera,) = pycolmap.Reconstruction(workspace / "sparse" / "0").cameras.values()
    assert list(camera.params) == [FOCAL_LENGTH, FOCAL_LENGTH, WIDTH / 2, HEIGHT / 2]
    with pycolmap.Database.open(workspace / "database.db") as database:
        assert database.read_camera(1).has_prior_focal_length
    # A pixel is 8 mm on the ground, and keypoints are good to a tenth of one: 2 mm of 2 m are what is to be had.
    assert height_error(workspace / "sparse" / "0") > 0.008
    assert height_error(workspace / "sparse_refractive" / "0") < 0.003


def test_models_without_refraction_are_colmaps_own(workspace: Path, pictures: Path, tmp_path: Path) -> None:
    """With COLMAP's limits, intrinsics held, its seed and one thread: the same model to the last digit."""
    limits = {name: 4.0 for name in ("init_max_error", "filter_max_reproj_error")}
    result = run(workspace, pictures, refine=False, Mapper=MapperOptions(**limits, abs_pose_max_error=12.0))
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.num_threads, options.random_seed = 1, 0
    (tmp_path / "own").mkdir()
    own = pycolmap.incremental_mapping(workspace / "database.db", pictures / "images", tmp_path / "own", options)[0]
    model = pycolmap.Reconstruction(result.sparse_path)
    assert model.num_points3D() == own.num_points3D()
    for image_id in own.reg_image_ids():
        np.testing.assert_array_equal(
            model.image(image_id).cam_from_world().matrix(), own.image(image_id).cam_from_world().matrix()
        )


# --- What it does not do twice -------------------------------------------------------------------------------------


def test_nothing_is_done_twice(workspace: Path, pictures: Path, calls: list[str]) -> None:
    before, watcher = files(workspace), Told()
    run(workspace, pictures, watcher)
    assert calls == [] and files(workspace) == before
    assert watcher.stages == []
    for label in ("Features", "Matches", "Model", "Refinement"):
        assert "taken over from an earlier run" in watcher.said(label)


def test_copied_pictures_are_the_same_pictures(workspace: Path, pictures: Path, calls: list[str]) -> None:
    """Other times of change, same contents."""
    shutil.copytree(pictures / "images", workspace / "images", copy_function=shutil.copyfile)
    run(workspace, pictures)
    assert calls == []


def test_other_options_do_again_what_they_change(workspace: Path, pictures: Path, calls: list[str]) -> None:
    before, watcher = tables(workspace / "database.db"), Told()
    refiner = RefinerOptions(scenario="static_interface", num_threads=1, refractive_index=1.34)
    run(workspace, pictures, watcher, refiner=refiner, complete_tracks=False)
    assert calls == [] and tables(workspace / "database.db") == before

    run(workspace, pictures, watcher, refine=False, TwoViewGeometry=TwoViewGeometryOptions(max_error=1.0))
    after = tables(workspace / "database.db")
    assert calls == ["match", "map"]
    assert {name for name in before if after[name] != before[name]} == {"two_view_geometries"}  # matches verified anew

    calls.clear()
    run(workspace, pictures, watcher, refine=False, SiftMatching=SiftMatchingOptions(max_ratio=0.6))
    last = tables(workspace / "database.db")
    assert calls == ["match", "map"]
    assert {name for name in before if last[name] != after[name]} == {"matches", "two_view_geometries"}
    total = [sum(row[1] for row in content["matches"]) for content in (after, last)]
    assert total[1] < total[0]


def test_other_features_or_pictures_begin_anew(workspace: Path, pictures: Path, calls: list[str]) -> None:
    for change in ("options", "a picture less"):
        watcher = Told("Matching")
        if change == "a picture less":
            shutil.copytree(pictures / "images", workspace / "images")
            (workspace / "images" / "view5.png").unlink()
        with pytest.raises(KeyboardInterrupt):
            run(workspace, pictures, watcher, SiftExtraction=SiftExtractionOptions(max_num_features=300))
        assert "made anew" in watcher.said("Features")
    assert calls == 2 * ["add_images", "extract"]
    assert counts(workspace) == {"images": 5, "keypoints": 5, "matches": 0, "two_view_geometries": 0}


def test_one_picture_more(workspace: Path, pictures: Path, calls: list[str]) -> None:
    """Its features and its pairs are added."""
    shutil.copytree(pictures / "images", workspace / "images")
    more = cv2.imread(str(workspace / "images" / "view0.png"))
    cv2.imwrite(str(workspace / "images" / "view9.png"), np.roll(more, 5, axis=1))
    before = {name: {row[0]: row for row in rows} for name, rows in tables(workspace / "database.db").items()}
    watcher = Told()
    run(workspace, pictures, watcher, refine=False)
    assert calls == ["add_images", "extract", "match", "map"]
    assert counts(workspace) == {"images": 7, "keypoints": 7, "matches": 21, "two_view_geometries": 21}
    after = {name: {row[0]: row for row in rows} for name, rows in tables(workspace / "database.db").items()}
    for name in before:
        assert before[name].items() <= after[name].items(), name
    assert "1 images new" in watcher.said("Features") and "6 pairs new" in watcher.said("Matches")
    assert len(after["cameras"]) == 1


def test_calibration_that_comes_later(workspace: Path, pictures: Path, calls: list[str], tmp_path: Path) -> None:
    """Features stay; what was verified with other intrinsics is verified again."""
    text = (pictures / "cameras.txt").read_text()
    (tmp_path / "cameras.txt").write_text(text.replace(f"{WIDTH} {HEIGHT} {FOCAL_LENGTH}", f"{WIDTH} {HEIGHT} 255.0"))
    reconstruct(
        workspace,
        ReconstructorOptions(SiftExtraction=FEATURES, refine=False),
        REFINER,
        image_path=pictures / "images",
        camera_path=tmp_path / "cameras.txt",
    )
    assert calls == ["match", "map"]
    (camera,) = pycolmap.Reconstruction(workspace / "sparse" / "0").cameras.values()
    assert camera.focal_length_x == 255.0
    # And one that is taken back leaves nothing of itself.
    options = ReconstructorOptions(SiftExtraction=FEATURES)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(workspace, options, REFINER, image_path=pictures / "images", watcher=Told("Matching"))
    with pycolmap.Database.open(workspace / "database.db") as database:
        assert database.read_camera(1).mean_focal_length() == 1.2 * WIDTH


def test_database_made_elsewhere_gets_what_it_lacks(pictures: Path, tmp_path: Path, calls: list[str]) -> None:
    """Four of six images, by COLMAP's own commands with other options."""
    path, names = tmp_path / "database.db", [f"view{k}.png" for k in range(4)]
    pycolmap.Database.open(path).close()
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        options = pycolmap.FeatureExtractionOptions()
        options.sift.max_num_features = 500
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(path, pictures / "images", names, mode, extraction_options=options)
        pycolmap.match_exhaustive(path)
    finally:
        pycolmap.logging.minloglevel = level
    before = {name: {row[0]: row for row in rows} for name, rows in tables(path).items()}
    assert {name: len(rows) for name, rows in before.items()}["matches"] == 6

    def go(watcher: Told) -> None:
        refine = ReconstructorOptions(SiftExtraction=FEATURES, refine=False)
        images, cameras = pictures / "images", pictures / "cameras.txt"
        reconstruct(
            tmp_path / "w",
            refine,
            REFINER,
            image_path=images,
            camera_path=cameras,
            database_path=path,
            watcher=watcher,
        )

    with pytest.raises(KeyboardInterrupt):
        go(Told("Matching"))
    watcher = Told()
    go(watcher)
    assert calls == ["add_images", "extract", "match", "map"]
    after = {name: {row[0]: row for row in rows} for name, rows in tables(path).items()}
    for name in before:
        assert before[name].items() <= after[name].items(), name
    assert len(after["keypoints"]) == 6 and len(after["two_view_geometries"]) == 15
    assert sorted(p.name for p in tmp_path.iterdir()) == ["database.db", "w"]
    assert not any("do not look like" in line for line in watcher.lines)
    assert "6 of 6 images registered" in watcher.said("Model")
    # What is now complete is used as it is.
    calls.clear()
    go(watcher)
    assert calls == []


def test_database_of_other_pictures_of_the_same_names(workspace: Path, pictures: Path, tmp_path: Path) -> None:
    """Turned pictures have the same sizes and other features. That other detectors pass is shown for corners."""
    other = tmp_path / "other"
    for number, turned in enumerate((False, True)):
        shutil.rmtree(other, ignore_errors=True)
        shutil.copytree(pictures / "images", other / "images")
        shutil.copy(pictures / "cameras.txt", other)
        for path in (other / "images").iterdir():
            picture = cv2.imread(str(path))
            cv2.imwrite(str(path), picture[::-1, ::-1] if turned else picture)
        for corners in (False, True):
            database_path = shutil.copy(workspace / "database.db", other / "foreign.db")
            if corners:
                with pycolmap.Database.open(database_path) as database:
                    for image in database.read_all_images():
                        gray = cv2.imread(str(pictures / "images" / image.name), cv2.IMREAD_GRAYSCALE)
                        count = database.num_keypoints_for_image(image.image_id)
                        found = cv2.goodFeaturesToTrack(gray, count, 1e-4, 1).reshape(-1, 2) + 0.5
                        keypoints = np.resize(found, (count, 2)).astype(np.float32)
                        database.update_keypoints(image.image_id, keypoints)
            watcher = Told("Mapping")
            with pytest.raises(KeyboardInterrupt):
                run(other / "w", other, watcher, refine=False, database_path=Path(database_path))
            warned = [line for line in watcher.lines if "'view0.png' do not look like those of the picture" in line]
            assert len(warned) == number, corners
            shutil.rmtree(other / "w")


# --- How it stops --------------------------------------------------------------------------------------------------


def test_interrupted_stages_go_on(pictures: Path, tmp_path: Path, finished: tuple[Path, Told]) -> None:
    for stage in ("Reading images", "Extracting features", "Matching"):
        watcher = Told(stage)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "w", pictures, watcher, refine=False)
        assert not list((tmp_path / "w").glob(".colmap_refract-*"))
    assert "made anew" not in watcher.said("Features")
    watcher = Told()
    run(tmp_path / "w", pictures, watcher, refine=False)
    assert "taken over" in watcher.said("Features")
    assert counts(tmp_path / "w") == counts(finished[0])
    assert tables(tmp_path / "w" / "database.db")["keypoints"] == tables(finished[0] / "database.db")["keypoints"]


CODE = """
import signal
import sys
from pathlib import Path
from colmap_refract.commands.automatic_reconstructor import AutomaticReconstructor
from colmap_refract.errors import RefractError
from colmap_refract.options import RefinerOptions
from colmap_refract.reconstructor.options import ReconstructorOptions
signal.signal(signal.SIGINT, signal.default_int_handler)  # which what is started in the background may lack
try:
    AutomaticReconstructor(
        workspace_path=Path(sys.argv[1]), image_path=Path(sys.argv[2]) / "images",
        camera_path=Path(sys.argv[2]) / "cameras.txt", options=ReconstructorOptions(refine=False),
        refiner=RefinerOptions(scenario="static_interface", num_threads=1)).run()
except RefractError as error:
    sys.exit(f"ERROR: {error}")
except KeyboardInterrupt as interrupt:
    sys.exit(f"{interrupt}")
"""


def wait_for(what: Any, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "nothing happens"
        time.sleep(0.02)


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent as a signal")
def test_ctrl_c_in_the_middle_of_extraction(pictures: Path, tmp_path: Path, finished: tuple[Path, Told]) -> None:
    """Sent to the whole group, as a terminal does, once some images are through and some are not."""
    workspace = tmp_path / "w"
    command = [sys.executable, "-c", CODE, str(workspace), str(pictures)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )

    def under_way() -> bool:
        try:
            return process.poll() is not None or counts(workspace)["keypoints"] > 0
        except sqlite3.Error:
            return False

    wait_for(lambda: (workspace / "database.db").exists())
    wait_for(under_way)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    if process.returncode == 0:
        pytest.skip("it was done before it could be interrupted")
    assert "goes on from there" in err and "Traceback" not in err and err.count("\n") == 1
    done = tables(workspace / "database.db")["keypoints"]
    assert done
    again = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert again.returncode == 0, again.stderr
    after = tables(workspace / "database.db")["keypoints"]
    assert set(done) <= set(after) and len(after) == 6


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="needs a limit on the size of files")
def test_disk_that_is_full(pictures: Path, tmp_path: Path) -> None:
    """A limit on the size of a file stands for the disk; it is met in different stages. Afterwards there is room."""
    workspace = tmp_path / "w"
    command = [sys.executable, "-c", CODE, str(workspace), str(pictures)]
    for kilobytes in (1, 150, 1000):

        def limit(size: int = 1024 * kilobytes) -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

        failed = subprocess.run(command, capture_output=True, text=True, timeout=100, preexec_fn=limit)
        print(kilobytes, failed.stdout, failed.stderr)
        assert failed.returncode == 1
        assert failed.stderr.startswith("ERROR: ") and failed.stderr.count("\n") == 1, failed.stderr
        assert "full" in failed.stderr or "too large" in failed.stderr.lower(), failed.stderr
    again = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert again.returncode == 0, again.stderr
    assert "6 of 6 images registered" in again.stdout


# --- Input that cannot be used -------------------------------------------------------------------------------------


def reconstruct_folder(folder: Path, tmp_path: Path, **more: Any) -> None:
    reconstruct(tmp_path / "w", ReconstructorOptions(**more), REFINER, image_path=folder)


def test_folders_without_enough_images(tmp_path: Path) -> None:
    with pytest.raises(RefractError, match="there is no folder .*images"):
        reconstruct(tmp_path / "w", ReconstructorOptions(), REFINER)
    (tmp_path / "images").mkdir()
    with pytest.raises(RefractError, match="holds no image"):
        reconstruct_folder(tmp_path / "images", tmp_path)
    assert not (tmp_path / "w").exists()
    write_blank(tmp_path / "images" / "a.png")
    with pytest.raises(RefractError, match="a single image, 'a.png'"):
        reconstruct_folder(tmp_path / "images", tmp_path)


def test_images_that_cannot_be_used(tmp_path: Path, calls: list[str]) -> None:
    folder = tmp_path / "images"
    write_blank(folder / "a.png", (80, 60))
    write_blank(folder / "b.png", (60, 80))
    with pytest.raises(RefractError, match="80 x 60.*60 x 80"):
        reconstruct_folder(folder, tmp_path)
    (folder / "b.png").write_bytes((folder / "a.png").read_bytes()[:60])
    with pytest.raises(RefractError, match="b.png.*decoded"):
        reconstruct_folder(folder, tmp_path)
    assert calls == []
    write_blank(folder / "b.png", (80, 60))
    with pytest.raises(RefractError, match="no image has any features"):
        reconstruct_folder(folder, tmp_path)


def test_images_of_different_things(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    (tmp_path / "images").mkdir()
    for name in ("a.png", "b.png", "c.png"):
        noise = cv2.resize(rng.integers(0, 255, (40, 50), dtype=np.uint8), (200, 160), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(tmp_path / "images" / name), noise)
    for _ in range(2):  # said again, without doing it again
        with pytest.raises(RefractError, match=r"no two images match \(3 pairs were tried\)"):
            reconstruct_folder(tmp_path / "images", tmp_path)


def test_calibration_for_another_shape(pictures: Path, tmp_path: Path, calls: list[str]) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 360 500 500 320 180\n")
    with pytest.raises(RefractError, match="320 x 240.*640 x 360"):
        reconstruct(
            tmp_path / "w",
            ReconstructorOptions(),
            REFINER,
            image_path=pictures / "images",
            camera_path=tmp_path / "cameras.txt",
        )
    assert calls == []


def test_calibration_at_twice_the_size_is_said_to_be_rescaled(
    workspace: Path, pictures: Path, tmp_path: Path, calls: list[str]
) -> None:
    f, cx, cy = 2 * FOCAL_LENGTH, float(WIDTH), float(HEIGHT)
    (tmp_path / "cameras.txt").write_text(f"1 PINHOLE {2 * WIDTH} {2 * HEIGHT} {f} {f} {cx} {cy}\n")
    watcher = Told()
    reconstruct(
        workspace,
        ReconstructorOptions(SiftExtraction=FEATURES),
        REFINER,
        image_path=pictures / "images",
        camera_path=tmp_path / "cameras.txt",
        watcher=watcher,
    )
    assert calls == []  # the same intrinsics as before
    assert "calibration rescaled from 640 x 480 to 320 x 240" in watcher.said("Images")


# --- The command ---------------------------------------------------------------------------------------------------


def test_command_reports(workspace: Path, pictures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    AutomaticReconstructor(
        workspace_path=workspace,
        image_path=pictures / "images",
        camera_path=pictures / "cameras.txt",
        options=ReconstructorOptions(SiftExtraction=FEATURES),
        refiner=REFINER,
    ).run()
    out, err = capsys.readouterr()
    assert err == ""
    assert [line.split(":")[0] for line in out.splitlines()[:5]] == [
        "Images",
        "Features",
        "Matches",
        "Model",
        "Refinement",
    ]
    assert "Refractive refinement, static_interface" in out
    assert str(workspace / "sparse" / "0") in out and str(workspace / "sparse_refractive" / "0") in out


def test_guessed_focal_length_is_warned_of(pictures: Path, tmp_path: Path) -> None:
    watcher = Told("Extracting features")
    with pytest.raises(KeyboardInterrupt):
        reconstruct(tmp_path / "w", ReconstructorOptions(), REFINER, image_path=pictures / "images", watcher=watcher)
    assert "384 px, 1.2 times the longer side" in watcher.said("WARNING")
