"""Databases of every version are read without being altered, and tracks hold no image twice whatever the matches."""

from __future__ import annotations

import itertools
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from capture_database import MAX_IMAGES, write_colmap_3_database
from conftest import Scenes
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_refract.errors import RefractError
from colmap_refract.mapping.database import (
    Correspondences,
    check_database,
    read_correspondences,
    write_tracks,
)
from colmap_refract.mapping.model_from_database import read_unposed_model
from colmap_refract.mapping.tracks import Tracks, build_tracks
from colmap_refract.simulation.database import write_database

NAMES = ["b/late.png", "a.jpg", "c.jpg"]


def pixels(count: int, seed: int = 0) -> Any:
    return np.random.default_rng(seed).uniform(0, 400, (count, 2)).astype(np.float32)


def make_database(path: Path, *, columns: int = 2) -> Path:
    """Three images with the ids 3, 7 and 8 by the cameras 2 and 5, with 4, 5 and 6 keypoints; two pairs."""
    with closing(pycolmap.Database.open(path)) as database:
        for camera_id in (2, 5):
            camera = pycolmap.Camera.create_from_model_name(camera_id, "OPENCV", 500.0 + camera_id, 640, 480)
            database.write_camera(camera, use_camera_id=True)
        for image_id, name, camera_id, count in zip((3, 7, 8), NAMES, (5, 2, 5), (4, 5, 6), strict=True):
            database.write_image(pycolmap.Image(name, camera_id=camera_id, image_id=image_id), use_image_id=True)
            extra = np.ones((count, columns - 2), dtype=np.float32)
            database.write_keypoints(image_id, np.hstack([pixels(count, image_id), extra]))
        # The higher id first: COLMAP turns the pair round, and its columns with it.
        database.write_matches(7, 3, np.array([[4, 0], [1, 3], [0, 2]], dtype=np.uint32))
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = 2
        geometry.inlier_matches = np.array([[4, 0], [1, 3]], dtype=np.uint32)
        database.write_two_view_geometry(7, 3, geometry)
        database.write_matches(7, 8, np.array([[2, 5]], dtype=np.uint32))
    return path


@pytest.mark.parametrize("columns", [2, 4, 6])
def test_database_is_read_as_it_was_written(tmp_path: Path, columns: int) -> None:
    found = read_correspondences(make_database(tmp_path / "database.db", columns=columns))
    assert found.image_ids.tolist() == [3, 7, 8]
    assert found.image_names == NAMES
    assert [found.camera_ids[c] for c in found.image_camera] == [5, 2, 5]
    assert [camera.focal_length_x for camera in found.cameras] == [502.0, 505.0]
    for keypoints, image_id, count in zip(found.keypoints, (3, 7, 8), (4, 5, 6), strict=True):
        np.testing.assert_array_equal(keypoints, pixels(count, image_id))
    assert found.first_keypoint.tolist() == [0, 4, 9, 15]
    assert found.pairs.tolist() == [[0, 1]]
    assert found.matches[0].tolist() == [[0, 4], [3, 1]]
    everything = read_correspondences(tmp_path / "database.db", verified=False)
    assert everything.pairs.tolist() == [[0, 1], [1, 2]]
    assert [len(pair) for pair in everything.matches] == [3, 1]


@pytest.mark.parametrize("priors", [True, False])
def test_database_of_colmap_3_is_read_and_stays_as_it_is(scenes: Scenes, tmp_path: Path, priors: bool) -> None:
    truth = scenes("static_interface").capture.reconstruction
    new = write_database(tmp_path / "new.db", truth)
    old = write_colmap_3_database(tmp_path / "old.db", new, priors=priors)
    before = old.read_bytes()
    found, expected = read_correspondences(old), read_correspondences(new)
    model = read_unposed_model(old, found)
    assert old.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new.db", "old.db"]
    assert found.image_names == expected.image_names
    assert all((a == b).all() for a, b in zip(found.keypoints, expected.keypoints, strict=True))
    assert all((a == b).all() for a, b in zip(found.matches, expected.matches, strict=True))
    assert len(found.matches) == 66
    # What COLMAP 4 would make of it: a rig per camera, a frame per image.
    assert (model.num_rigs(), model.num_frames()) == (1, 12)
    assert {image.frame_id for image in model.images.values()} == set(model.frames)
    assert model.num_reg_images() == 0


def test_model_of_a_database_has_its_rigs_and_frames(scenes: Scenes, tmp_path: Path) -> None:
    truth = scenes("moving_interface", sensors_per_frame=2).capture.reconstruction
    path = write_database(tmp_path / "database.db", truth)
    model = read_unposed_model(path, read_correspondences(path))
    assert (model.num_rigs(), model.num_frames(), model.num_images()) == (1, 6, 12)
    for image_id, image in truth.images.items():
        ours = model.image(image_id)
        assert (ours.name, ours.camera_id, ours.frame_id) == (image.name, image.camera_id, image.frame_id)
        assert ours.num_points2D() == image.num_points2D()
    sensor = truth.camera(2).sensor_id
    place, expected = (m.rig(1).sensor_from_rig(sensor) for m in (model, truth))
    np.testing.assert_allclose(place.matrix(), expected.matrix(), atol=1e-12)


def test_rig_of_unknown_geometry_is_refused(scenes: Scenes, tmp_path: Path) -> None:
    truth = pycolmap.Reconstruction(scenes("moving_interface", sensors_per_frame=2).capture.reconstruction)
    path = write_database(tmp_path / "database.db", truth)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE rig_sensors SET sensor_from_rig = NULL")
        connection.commit()
    with pytest.raises(RefractError, match="rig 1 does not say where its camera 2 sits"):
        read_unposed_model(path, read_correspondences(path))


def test_given_intrinsics_replace_the_database(scenes: Scenes, tmp_path: Path) -> None:
    truth = scenes("static_interface").capture.reconstruction
    path = write_database(tmp_path / "database.db", truth)
    found = read_correspondences(path)
    calibrated = pycolmap.Camera.create_from_model_name(9, "OPENCV", 1234.0, 1600, 1200)
    camera = read_unposed_model(path, found, cameras={9: calibrated}).camera(1)
    assert (camera.camera_id, camera.focal_length_x, camera.has_prior_focal_length) == (1, 1234.0, True)
    with pytest.raises(RefractError, match="have no camera 1"):
        read_unposed_model(path, found, cameras={9: calibrated, 10: calibrated})
    calibrated.width = 800
    with pytest.raises(RefractError, match="another shape"):
        read_unposed_model(path, found, cameras={9: calibrated})


def test_database_that_cannot_be_written_to_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The superuser may write to everything, so a user who may not is pretended; that COLMAP fails there is not shown.
    path = make_database(tmp_path / "database.db")
    before = path.read_bytes(), path.stat().st_mtime_ns
    monkeypatch.setattr(os, "access", lambda *_: False)
    found = read_correspondences(path)
    assert found.image_ids.tolist() == [3, 7, 8]
    assert [len(pair) for pair in found.matches] == [2]
    assert (path.read_bytes(), path.stat().st_mtime_ns) == before
    assert list(tmp_path.iterdir()) == [path]


def empty(path: Path) -> None:
    pycolmap.Database.open(path).close()


def images_only(path: Path) -> None:
    make_database(path)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("DELETE FROM keypoints")
        connection.commit()


def beyond(path: Path) -> None:
    make_database(path)
    with closing(sqlite3.connect(path)) as connection:
        rows = np.array([[0, 99]], dtype=np.uint32).tobytes()
        connection.execute(
            "UPDATE two_view_geometries SET rows = 1, data = ? WHERE pair_id = ?", (rows, 3 * MAX_IMAGES + 7)
        )
        connection.commit()


def other_tables(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE images (name TEXT)")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "does not exist"),
        (lambda path: path.mkdir(), "no database file"),
        (lambda path: path.write_text("nothing of the kind" * 100), "cannot be read as a database"),
        (other_tables, "no table cameras, keypoints, matches"),
        (empty, "holds no images"),
        (images_only, "holds no keypoints"),
        (beyond, r"matches keypoints of b/late.png and a.jpg that it does not have"),
    ],
)
def test_what_is_wrong_with_a_database_is_said(tmp_path: Path, make: Any, message: str) -> None:
    path = tmp_path / "database.db"
    make(path)
    with pytest.raises(RefractError, match=message) as caught:
        read_correspondences(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("mode", ["wal", "delete"])
def test_looking_at_a_database_does_not_alter_it(tmp_path: Path, mode: str) -> None:
    path = make_database(tmp_path / "database.db")
    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute(f"PRAGMA journal_mode = {mode}").fetchone() == (mode,)
    before = path.read_bytes()
    assert before[18] == {"wal": 2, "delete": 1}[mode]  # as SQLite's header says
    check_database(path)
    read_unposed_model(path, read_correspondences(path))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_what_another_process_has_just_written_is_read(tmp_path: Path) -> None:
    """It is in the write-ahead log only, and stays there."""
    path = make_database(tmp_path / "database.db")
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = wal")
        connection.execute("UPDATE images SET name = 'new.jpg' WHERE name = 'a.jpg'")
        connection.commit()
        shutil.copytree(tmp_path, tmp_path / "copy", ignore=shutil.ignore_patterns("copy", "*-shm"))
    path = tmp_path / "copy" / "database.db"
    before = path.read_bytes(), Path(f"{path}-wal").read_bytes()
    assert before[1] and b"new.jpg" not in before[0]
    assert "new.jpg" in read_correspondences(path).image_names
    assert (path.read_bytes(), Path(f"{path}-wal").read_bytes()) == before


def correspondences(num_keypoints: list[int], matches: dict[tuple[int, int], list[tuple[int, int]]]) -> Correspondences:
    count = len(num_keypoints)
    return Correspondences(
        image_ids=np.arange(1, count + 1),
        image_names=[f"{i}.jpg" for i in range(count)],
        image_camera=np.zeros(count, dtype=np.int64),
        camera_ids=np.array([1]),
        cameras=[],
        keypoints=[np.zeros((n, 2)) for n in num_keypoints],
        pairs=np.array(list(matches), dtype=np.int64).reshape(-1, 2),
        matches=[np.array(pair, dtype=np.int64).reshape(-1, 2) for pair in matches.values()],
    )


def sets_of(tracks: Tracks) -> set[frozenset[tuple[int, int]]]:
    """The tracks as sets of (image, keypoint)."""
    rows = list(zip(tracks.image.tolist(), tracks.point2D_idx.tolist(), strict=True))
    return {frozenset(rows[a:b]) for a, b in itertools.pairwise(tracks.start.tolist())}


def test_matches_join_through_others() -> None:
    tracks = build_tracks(correspondences([2, 2, 3, 1], {(0, 1): [(0, 1)], (1, 2): [(1, 2)], (0, 3): [(1, 0)]}))
    assert sets_of(tracks) == {frozenset({(0, 0), (1, 1), (2, 2)}), frozenset({(0, 1), (3, 0)})}
    assert tracks.point.tolist() == np.repeat([0, 1], np.diff(tracks.start)).tolist()


def test_no_matches_make_no_tracks() -> None:
    tracks = build_tracks(correspondences([3, 4], {}))
    assert len(tracks.start) == 1
    assert len(tracks.image) == 0


def test_match_that_nothing_bears_out_joins_no_two_points() -> None:
    # Two points that all of four images see and match, and one wrong match from one to the other.
    pairs = {pair: [(0, 0), (1, 1)] for pair in itertools.combinations(range(4), 2)}
    pairs[0, 3] = [(0, 1), (1, 0)]
    tracks = build_tracks(correspondences([2] * 4, pairs))
    assert sets_of(tracks) == {frozenset((i, k) for i in range(4)) for k in range(2)}


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.02, 0.1, 0.5]))
def test_no_track_holds_an_image_twice(seed: int, wrong: float) -> None:
    rng = np.random.default_rng(seed)
    num_images, num_points = int(rng.integers(2, 9)), int(rng.integers(1, 40))
    # Keypoint k of an image is of point order[image][k], and some images lack some points.
    order = [rng.permutation(num_points)[: rng.integers(1, num_points + 1)] for _ in range(num_images)]
    matches = {}
    for i, j in itertools.combinations(range(num_images), 2):
        _, a, b = np.intersect1d(order[i], order[j], return_indices=True)
        bad = rng.random(len(a)) < wrong
        b[bad] = rng.integers(0, len(order[j]), bad.sum())
        matches[i, j] = list(zip(a.tolist(), b.tolist(), strict=True))
    tracks = build_tracks(correspondences([len(o) for o in order], matches))
    found = sets_of(tracks)
    assert len(found) == len(tracks.start) - 1
    keypoints = [keypoint for track in found for keypoint in track]
    assert len(set(keypoints)) == len(keypoints)
    for track in found:
        assert len(track) >= 2
        assert len({image for image, _ in track}) == len(track)
    if wrong == 0.0:
        truth: dict[int, set[tuple[int, int]]] = {}
        for i, points in enumerate(order):
            for k, point in enumerate(points.tolist()):
                truth.setdefault(point, set()).add((i, k))
        assert found == {frozenset(track) for track in truth.values() if len(track) >= 2}


@pytest.mark.parametrize("wrong", [0.03, 0.1])
def test_wrong_matches_cost_few_tracks(scenes: Scenes, tmp_path: Path, wrong: float) -> None:
    # At 3 % already, wrong matches join nearly all points of 66 pairs of images with each other.
    truth = scenes("static_interface").capture.reconstruction
    found = sets_of(build_tracks(read_correspondences(write_database(tmp_path / "database.db", truth, wrong=wrong))))
    expected = {
        frozenset((element.image_id - 1, element.point2D_idx) for element in point.track.elements)
        for point in truth.points3D.values()
    }
    assert len(found & expected) >= 0.95 * len(expected)


def test_written_tracks_are_read(tmp_path: Path) -> None:
    path = make_database(tmp_path / "database.db")
    with closing(sqlite3.connect(path)) as connection:
        for table in ("keypoints", "matches", "two_view_geometries"):
            connection.execute(f"DELETE FROM {table}")
        connection.commit()
    keypoints = {name: pixels(3, k).astype(np.float64) for k, name in enumerate(NAMES)}
    matches = {(NAMES[2], NAMES[0]): np.array([[2, 1]]), (NAMES[0], NAMES[1]): np.array([[1, 0], [0, 2]])}
    with pytest.raises(RefractError, match="does not hold image 'd.jpg'"):
        write_tracks(path, {"d.jpg": pixels(1)}, {})
    write_tracks(path, keypoints, matches)
    for verified in (True, False):
        found = read_correspondences(path, verified=verified)
        assert sets_of(build_tracks(found)) == {frozenset({(2, 2), (0, 1), (1, 0)}), frozenset({(0, 0), (1, 2)})}
        np.testing.assert_array_equal(found.keypoints[1], keypoints[NAMES[1]])
    with pytest.raises(RefractError, match=f"has keypoints of '{NAMES[0]}' already"):
        write_tracks(path, keypoints, matches)
