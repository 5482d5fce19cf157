"""Tracks that straight rays split, shortened or lost come back once the interfaces are known.

The truth of every keypoint is the simulator's, whose rays are not the solver's. Not shown here: that COLMAP's mapper
splits tracks in this way (it does, see `benchmarks/`), nor anything about images that it did not register.
"""

from __future__ import annotations

import itertools
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_refract.cli import main
from colmap_refract.errors import RefractError
from colmap_refract.mapping import completion
from colmap_refract.mapping.database import Correspondences
from colmap_refract.mapping.retriangulation import complete_model, refine_with_database
from colmap_refract.options import RefinerOptions, Scenario
from colmap_refract.refiner.refinement import refine
from colmap_refract.simulation import Capture, SceneOptions, ignore_refraction, noise_bound, point_rmse, simulate
from colmap_refract.simulation.database import write_database

SPLIT, DROPPED, LOST = 0.3, 0.1, 0.1
"""Parts of the points that are made two, of the observations and of the points that are taken away."""


def capture_of(scenario: Scenario, seed: int = 0) -> Capture:
    return simulate(SceneOptions(scenario=scenario, num_images=10, num_points=250, seed=seed))


def true_points(capture: Capture) -> dict[tuple[int, int], int]:
    """Keypoint to the point that it shows."""
    return {
        (e.image_id, e.point2D_idx): point3D_id
        for point3D_id, point in capture.reconstruction.points3D.items()
        for e in point.track.elements
    }


def matches_of(capture: Capture, wrong: float, seed: int = 0) -> Correspondences:
    """What a matcher finds: all pairs of images, some matches between the wrong keypoints."""
    model, rng = capture.reconstruction, np.random.default_rng(seed)
    image_ids = sorted(model.images)
    shows = true_points(capture)
    per_image = [{shows[i, k]: k for k in range(model.image(i).num_points2D()) if (i, k) in shows} for i in image_ids]
    pairs, matches = [], []
    for a, b in itertools.combinations(range(len(image_ids)), 2):
        common = sorted(per_image[a].keys() & per_image[b].keys())
        pair = np.array([(per_image[a][p], per_image[b][p]) for p in common]).reshape(-1, 2)
        mixed = np.flatnonzero(rng.random(len(pair)) < wrong)
        pair[mixed, 1] = rng.permutation(pair[mixed, 1])
        pairs.append((a, b))
        matches.append(pair)
    return Correspondences(
        image_ids=np.array(image_ids),
        image_names=[model.image(i).name for i in image_ids],
        image_camera=np.array([model.image(i).camera_id - 1 for i in image_ids]),
        camera_ids=np.array(sorted(model.cameras)),
        cameras=[camera for _, camera in sorted(model.cameras.items())],
        keypoints=[np.array([point.xy for point in model.image(i).points2D]) for i in image_ids],
        pairs=np.array(pairs),
        matches=matches,
    )


def damage(model: pycolmap.Reconstruction, seed: int = 0) -> pycolmap.Reconstruction:
    """What straight rays do to tracks, at random: some in two, some shorter, some gone."""
    model, rng = pycolmap.Reconstruction(model), np.random.default_rng(seed)
    for point3D_id in sorted(model.point3D_ids()):
        point = model.point3D(point3D_id)
        elements = [(e.image_id, e.point2D_idx) for e in point.track.elements]
        xyz, kind = point.xyz.copy(), rng.random()
        if kind < LOST:
            model.delete_point3D(point3D_id)
            continue
        gone = [e for e in elements if rng.random() < DROPPED][: max(len(elements) - 4, 0)]
        left = [e for e in elements if e not in gone]
        apart = left[: len(left) // 2] if kind < LOST + SPLIT and len(left) >= 4 else []
        for element in gone + apart:
            model.delete_observation(*element)
        if len(apart) >= 2:
            model.add_point3D(xyz, pycolmap.Track([pycolmap.TrackElement(*e) for e in apart]))
    return model


def partition(model: pycolmap.Reconstruction, capture: Capture) -> tuple[int, int, int]:
    """Points that show only one true point; true points with several points; observations in a wrong one."""
    shows = true_points(capture)
    owners: dict[int, int] = {}
    pure = wrong = 0
    for point in model.points3D.values():
        seen = [shows.get((e.image_id, e.point2D_idx), -1) for e in point.track.elements]
        main = max(set(seen), key=seen.count)
        owners[main] = owners.get(main, 0) + 1
        pure += len(set(seen)) == 1
        wrong += sum(p != main for p in seen)
    return pure, sum(count > 1 for count in owners.values()), wrong


@pytest.mark.parametrize("wrong", [0.0, 0.15])
@pytest.mark.parametrize("scenario", ["moving_interface", "static_interface", "camera_housing", "fixed_camera"])
def test_damaged_tracks_come_back(scenario: Scenario, wrong: float) -> None:
    capture = capture_of(scenario)
    whole = ignore_refraction(capture)
    model = damage(whole)
    assert partition(model, capture)[1] > 0.15 * whole.num_points3D()  # there is something to mend
    assert model.compute_num_observations() < 0.85 * whole.compute_num_observations()

    result = refine_with_database(model, RefinerOptions(scenario=scenario), matches_of(capture, wrong))
    again = result.reconstruction
    pure, split, foreign = partition(again, capture)
    assert split == 0
    # A wrong match whose rays meet by chance cannot be told from a right one.
    assert foreign <= (0 if wrong == 0 else 0.001 * whole.compute_num_observations())
    # New points need three images; a track of two that was lost stays lost.
    assert abs(again.num_points3D() - whole.num_points3D()) <= 0.02 * whole.num_points3D()
    assert again.compute_num_observations() >= 0.985 * whole.compute_num_observations()
    statistics = result.sidecar.statistics
    assert statistics["num_points3D_before"] == model.num_points3D()
    assert statistics["num_observations"] == again.compute_num_observations()
    assert statistics["num_merged_points3D"] > 0 and statistics["num_created_points3D"] > 0
    if wrong == 0:
        # As good as if nothing had happened; `point_rmse` speaks of the ids that both models have.
        untouched = refine(whole, RefinerOptions(scenario=scenario)).reconstruction
        assert point_rmse(again, capture) < 1.1 * max(point_rmse(untouched, capture), noise_bound(capture))


def test_new_tracks_that_never_agree_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planes are off, so that two rays meet where all of a track's do not; with a single round none can be left out."""
    capture = capture_of("moving_interface")
    whole = ignore_refraction(capture)
    options = RefinerOptions(scenario="moving_interface")
    result, matches = refine(damage(whole), options), matches_of(capture, 0.0)
    rng = np.random.default_rng(0)
    off = {
        name: replace(one, distance=(one.distance or 0.0) * (1 + 0.05 * rng.standard_normal()))
        for name, one in result.sidecar.images.items()
    }
    created, usual = {}, completion._ROUNDS
    for rounds in (usual, 1):
        monkeypatch.setattr(completion, "_ROUNDS", rounds)
        _, gain = complete_model(result.reconstruction, replace(result.sidecar, images=off), matches, options)
        created[rounds] = gain.num_created
    assert created[1] < created[usual]


def test_tracks_come_back_through_waves() -> None:
    """Each keypoint's ray is that of its image's surface; with planes in place of the surfaces most do not meet.

    Only the first round: points of split tracks that are merged say more of the surfaces in the next.
    """
    capture = simulate(
        SceneOptions(
            scenario="static_interface", num_images=10, num_points=200, wave_slope_deg=1.5, wavelength=(1.0, 2.5)
        )
    )
    whole = ignore_refraction(capture)
    model = damage(whole)
    options = RefinerOptions(scenario="static_interface", interface_shape="soft")
    result = refine(model, options)
    surfaces = result.sidecar
    assert all(image.surface is not None for image in surfaces.images.values())
    planes = replace(surfaces, images={name: replace(one, surface=None) for name, one in surfaces.images.items()})
    matches = matches_of(capture, 0.1)
    parts = {}
    for key, sidecar in (("surfaces", surfaces), ("planes", planes)):
        again, gain = complete_model(result.reconstruction, sidecar, matches, options)
        parts[key] = partition(again, capture), again.compute_num_observations(), gain
    (_, split, foreign), count, gain = parts["surfaces"]
    assert split <= 2 and foreign <= 0.001 * whole.compute_num_observations()
    assert count >= 0.97 * whole.compute_num_observations() and gain.num_merged > 20
    assert parts["planes"][0][1] > 10 * max(split, 1) and parts["planes"][2].num_merged < 0.5 * gain.num_merged


def test_a_whole_model_is_left_alone() -> None:
    capture = capture_of("static_interface")
    model = ignore_refraction(capture)
    options = RefinerOptions(scenario="static_interface")
    result = refine_with_database(model, options, matches_of(capture, 0.1))
    assert result.reconstruction.point3D_ids() == model.point3D_ids()
    assert result.reconstruction.compute_num_observations() == model.compute_num_observations()
    alone = refine(model, options)
    for point3D_id in alone.reconstruction.point3D_ids():
        np.testing.assert_allclose(
            result.reconstruction.point3D(point3D_id).xyz, alone.reconstruction.point3D(point3D_id).xyz, atol=1e-9
        )


def test_a_shore_is_completed_with_straight_rays() -> None:
    options = SceneOptions(scenario="static_interface", num_images=10, num_points=250, dry_point_ratio=0.2, seed=1)
    capture = simulate(options)
    whole = ignore_refraction(capture)
    result = refine_with_database(damage(whole), RefinerOptions(scenario="static_interface"), matches_of(capture, 0.0))
    assert result.sidecar.statistics["num_dry_observations"] > 100
    _, split, foreign = partition(result.reconstruction, capture)
    assert split == 0 and foreign == 0
    assert result.reconstruction.compute_num_observations() >= 0.97 * whole.compute_num_observations()


def test_ids_and_the_input_stay() -> None:
    capture = capture_of("moving_interface")
    model = damage(ignore_refraction(capture))
    before = {i: point.xyz.copy() for i, point in model.points3D.items()}
    tracks = {(e.image_id, e.point2D_idx): i for i, point in model.points3D.items() for e in point.track.elements}
    result = refine_with_database(model, RefinerOptions(scenario="moving_interface"), matches_of(capture, 0.0))
    assert before.keys() == model.point3D_ids()
    assert all((model.point3D(i).xyz == xyz).all() for i, xyz in before.items())
    # A point keeps its observations, unless it was merged: then all of them are in one other.
    for point3D_id in result.reconstruction.point3D_ids() & before.keys():
        mine = [e for e, i in tracks.items() if i == point3D_id]
        track = {(e.image_id, e.point2D_idx) for e in result.reconstruction.point3D(point3D_id).track.elements}
        assert len(track.intersection(mine)) >= len(mine) - 1
    for image in result.reconstruction.images.values():
        for point in image.get_observation_points2D():
            assert result.reconstruction.exists_point3D(point.point3D_id)


def test_planes_held_completion_judges_by_refraction() -> None:
    """With the interfaces forgotten the same completion finds far less: it is refraction that it undoes."""
    capture = simulate(SceneOptions(scenario="moving_interface", num_images=10, num_points=250, tilt_deg=8.0, seed=2))
    options = RefinerOptions(scenario="moving_interface")
    refined = refine(damage(ignore_refraction(capture)), options)
    matches = matches_of(capture, 0.0)
    _, gain = complete_model(refined.reconstruction, refined.sidecar, matches, options)
    dry = {name: replace(image, normal_in_cam=None, distance=None) for name, image in refined.sidecar.images.items()}
    _, blind = complete_model(refined.reconstruction, replace(refined.sidecar, images=dry), matches, options)
    assert gain.num_merged > 4 * blind.num_merged
    assert gain.num_created > 4 * blind.num_created


def test_an_earlier_refinement_is_taken_up() -> None:
    """From its own result a refinement goes nowhere else, and needs no start."""
    for scenario in ("moving_interface", "static_interface", "camera_housing", "fixed_camera"):
        capture = capture_of(scenario, seed=3)
        options = RefinerOptions(scenario=scenario)
        first = refine(ignore_refraction(capture), options)
        stages: list[str] = []
        again = refine(
            first.reconstruction,
            replace(options, reference_image=str(first.sidecar.solver["reference_image"])),
            earlier=first.sidecar,
            watch=lambda stage, _, stages=stages: stages.append(stage),
        )
        assert stages and not any("Start" in stage for stage in stages)
        difference = abs(point_rmse(again.reconstruction, capture) - point_rmse(first.reconstruction, capture))
        assert difference < 0.02 * noise_bound(capture)


def test_another_database_is_refused() -> None:
    capture = capture_of("static_interface")
    model, matches = ignore_refraction(capture), matches_of(capture, 0.0)
    options = RefinerOptions(scenario="static_interface")
    renamed = replace(matches, image_names=[f"other/{name}" for name in matches.image_names])
    with pytest.raises(RefractError, match="does not hold image"):
        refine_with_database(model, options, renamed)
    with pytest.raises(RefractError, match=r"keypoints in the model and \d+ in the database"):
        refine_with_database(model, options, replace(matches, keypoints=[k[:-1] for k in matches.keypoints]))
    with pytest.raises(RefractError, match="are others in the database"):
        refine_with_database(model, options, replace(matches, keypoints=[k + 1 for k in matches.keypoints]))


def contents(database: Path) -> list[str]:
    """All that a database holds; its file also counts how often it was opened."""
    with closing(sqlite3.connect(database)) as connection:
        return list(connection.iterdump())


def test_the_command_takes_a_database(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = capture_of("moving_interface")
    write_database(tmp_path / "database.db", capture.reconstruction, wrong=0.05)
    (tmp_path / "sparse").mkdir()
    damage(ignore_refraction(capture)).write_binary(tmp_path / "sparse")
    arguments = ["refiner", "--input_path", str(tmp_path / "sparse"), "--scenario", "moving_interface"]
    database = tmp_path / "database.db"
    before = contents(database)
    assert main([*arguments, "--output_path", str(tmp_path / "out"), "--database_path", str(database)]) == 0
    assert "points merged into others" in capsys.readouterr().out
    assert contents(database) == before
    assert main(["model_analyzer", "--path", str(tmp_path / "out")]) == 0
    assert "points merged into others" in capsys.readouterr().out
    assert partition(pycolmap.Reconstruction(tmp_path / "out"), capture)[1] == 0

    for wrong in (tmp_path / "none.db", tmp_path / "sparse" / "cameras.bin"):
        assert main([*arguments, "--output_path", str(tmp_path / "no"), "--database_path", str(wrong)]) == 1
        error = capsys.readouterr().err
        assert error.startswith("ERROR:") and error.count("\n") == 1 and str(wrong) in error
        assert not (tmp_path / "no").exists()
