"""Sessions in pictures, what is said of reconstructions from them, and plans.

What this does not prove: that a reconstruction from the pictures succeeds; here, models are made up from the truth.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pycolmap
import pytest
from conftest import Scenes

from colmap_refract.commands.simulator import Simulator
from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, plane_in_world
from colmap_refract.options import Scenario
from colmap_refract.simulation import Capture, SceneOptions, noise_bound, point_rmse, simulate
from colmap_refract.simulation.accuracy import configuration_of
from colmap_refract.simulation.judge import judge
from colmap_refract.simulation.plan import plan
from colmap_refract.simulation.plan_report import report, weaknesses
from colmap_refract.simulation.precision import precision
from colmap_refract.simulation.session import Session, SessionOptions, photograph, write_session
from colmap_refract.simulation.surface import Wave
from colmap_refract.simulation.truth import Truth, load_truth

SCENARIOS: tuple[Scenario, ...] = get_args(Scenario)
SMALL = {"num_images": 6, "width": 160, "height": 120, "focal_length": 130.0}
WAVES = (Wave(amplitude=0.002, wavelength=0.5, direction_deg=40),)


def session(scenario: Scenario, *, waves: tuple[Wave, ...] = (), **scene: Any) -> Session:
    return photograph(SessionOptions(scene=SceneOptions(scenario=scenario, **{**SMALL, **scene}), waves=waves))


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_session_stands_where_the_simulated_capture_does(scenario: Scenario) -> None:
    truth = session(scenario).truth
    capture = simulate(SceneOptions(scenario=scenario, **SMALL))
    assert len(truth.names) == len(capture.planes)
    for image_id, image in capture.reconstruction.images.items():
        taken = truth.view(image.name)
        assert taken.cam_from_world == pytest.approx(image.cam_from_world().matrix(), abs=1e-12)
        plane = truth.planes[truth.names.index(image.name)]
        assert plane == pytest.approx([*capture.planes[image_id][0], capture.planes[image_id][1]], abs=1e-12)
        assert taken.camera.params == pytest.approx(image.camera.params)
    # The ground reaches as far as the cameras see.
    for name in truth.names:
        corners = np.array([[0, 0], [160, 0], [0, 120], [160, 120]])
        assert np.isfinite(truth.trace(name, corners)).all()


def test_layouts_and_rigs_have_their_views() -> None:
    survey = session("moving_interface", layout="survey", num_images=8).truth
    assert (survey.terrain.high - survey.terrain.low > session("moving_interface").truth.terrain.high * 0.5).all()
    rig = session("static_interface", num_images=6, sensors_per_frame=2).truth
    assert rig.frames.tolist() == [0, 0, 1, 1, 2, 2] and len(rig.cameras) == 2
    assert rig.interfaces.tolist() == [0] * 6


def test_waves_travel_from_image_to_image() -> None:
    truth = session("static_interface", waves=WAVES).truth
    phases = [taken.surface.waves[0, 3] for taken in truth.views]
    period = WAVES[0].period(1.5)
    turned = np.diff(phases) + 2 * np.pi * 0.7 / period
    assert np.cos(turned) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("waves", [(), WAVES])
def test_the_truth_survives_the_disk(waves: tuple[Wave, ...], tmp_path: Path) -> None:
    made = session("static_interface", waves=waves, num_images=2, camera_model="OPENCV")
    done: list[tuple[int, int]] = []
    write_session(made, tmp_path, watch=lambda *numbers: done.append(numbers))
    assert done == [(0, 2), (1, 2), (2, 2)]
    truth = load_truth(tmp_path)
    assert (truth.scenario, truth.names) == (made.truth.scenario, made.truth.names)
    pixels = np.random.default_rng(0).uniform([0, 0], [160, 120], (200, 2))
    for name in truth.names:
        image = pycolmap.Bitmap.read(tmp_path / "images" / name, True).to_array()
        assert image.shape == (120, 160, 3) and image.std() > 10
        points = truth.trace(name, pixels)
        # Every bit of it: poses, planes, waves, cameras and the heights of the ground.
        assert np.array_equal(points, made.truth.trace(name, pixels))
        assert truth.project(name, points) == pytest.approx(pixels, abs=1e-6)
    assert truth.options == json.loads(json.dumps(made.truth.options))
    with np.load(tmp_path / "truth.npz") as file:
        assert file["cam_from_world"].shape == (2, 3, 4) and file["planes"].shape == (2, 4)
        assert float(file["mu"]) == 1.333
    with pytest.raises(RefractError, match="knows no image"):
        truth.view("other.jpg")
    (tmp_path / "truth.npz").write_bytes(b"PK")
    with pytest.raises(RefractError, match="not the truth"):
        load_truth(tmp_path)


def test_pictures_hold_features_to_match(tmp_path: Path) -> None:
    """An eighth of a megapixel is good for more than the eight hundred features that mapping wants, and they repeat."""
    made = session("moving_interface", num_images=2, width=400, height=300, focal_length=320.0, tilt_deg=3.0)
    write_session(made, tmp_path)
    pycolmap.logging.minloglevel = 2
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = 1500
    pycolmap.extract_features(tmp_path / "database.db", tmp_path / "images", extraction_options=options)
    pycolmap.match_exhaustive(tmp_path / "database.db")
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        ids = [image.image_id for image in database.read_all_images()]
        names = [image.name for image in database.read_all_images()]
        keypoints = [np.asarray(database.read_keypoints(image_id))[:, :2] for image_id in ids]
        matches = database.read_matches(ids[0], ids[1])
    assert min(map(len, keypoints)) > 800
    first, second = (
        made.truth.trace(name, xy[matches[:, k]]) for k, (name, xy) in enumerate(zip(names, keypoints, strict=True))
    )
    away = np.linalg.norm(first - second, axis=1)
    # Matches show the same place: within a third of a pixel's 7 mm in the median.
    assert len(matches) > 200 and np.median(away) < 0.0024


def made_up(truth: Truth, *, count: int, noise: float, shift: float = 0.0) -> pycolmap.Reconstruction:
    """A model of points on the ground, `shift` metres (per axis) beside the truth, in the truth's frame."""
    rng = np.random.default_rng(0)
    middle, reach = 0.5 * (truth.terrain.high + truth.terrain.low), 0.25 * (truth.terrain.high - truth.terrain.low)
    places = middle + reach * rng.uniform(-1, 1, (count, 2))
    points = np.column_stack([places, truth.terrain.height(places)])
    model = pycolmap.Reconstruction()
    for camera in truth.cameras.values():
        model.add_camera_with_trivial_rig(camera)
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points]
    for index, name in enumerate(truth.names):
        pixels = truth.project(name, points)
        seen = ((pixels > 2) & (pixels < [158, 118])).all(axis=1)
        noisy = pixels[seen] + noise * rng.standard_normal((seen.sum(), 2))
        image = pycolmap.Image(name, noisy, int(truth.camera_ids[index]), index + 1)
        pose = truth.views[index].cam_from_world
        model.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3].copy()), pose[:, 3].copy())
        )
        for row, point in enumerate(np.flatnonzero(seen).tolist()):
            tracks[point].append(pycolmap.TrackElement(index + 1, row))
    moved = points + shift * rng.standard_normal(points.shape)
    for xyz, track in zip(moved, tracks, strict=True):
        if len(track) >= 2:
            model.add_point3D(xyz, pycolmap.Track(track), np.zeros(3, dtype=np.uint8))
    return model


def mislead(model: pycolmap.Reconstruction) -> int:
    """Move keypoints of the first image, of points that four images or more see, by 20 px; returns how many."""
    count = 0
    for point2D in model.images[1].points2D:
        x, y = point2D.xy
        room = x < 130 and y < 90 and point2D.has_point3D()
        if room and model.points3D[point2D.point3D_id].track.length() >= 4 and count < 15:
            point2D.xy = point2D.xy + 20
            count += 1
    return count


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_model_is_judged_by_what_its_keypoints_show(scenario: Scenario) -> None:
    truth = session(scenario, waves=WAVES if scenario == "moving_interface" else ()).truth
    model = made_up(truth, count=300, noise=0.2, shift=0.02)
    wrong = mislead(model)
    model.transform(pycolmap.Sim3d(3.0, pycolmap.Rotation3d(np.array([0.3, -0.8, 0.2])), np.array([5.0, 1.0, -2.0])))
    said = judge(model, truth)
    assert said.scale == pytest.approx(1 / 3, rel=0.01)
    # 600 coordinates know their standard deviation to 3 %; the keypoints' own noise adds 2 mm.
    assert said.num_points > 200
    assert said.rmse == pytest.approx(0.02 * np.sqrt(3), rel=0.09)
    assert said.rmse_best90 < said.rmse and said.median_error < said.rmse
    # Along the normal there is one axis of the three.
    assert 0.4 * 0.02 < said.surface_rms < 1.1 * 0.02
    assert said.depth_rmse_best90 == pytest.approx(0.017, rel=0.2)
    assert said.constant_depth_rmse > 0.03
    # The wrong keypoints are all found, and hardly any other is taken for one.
    assert wrong >= 10 and wrong <= said.wrong_observations <= wrong + 4 and said.wrong_points == 0
    assert said.keypoint_noise == pytest.approx(0.2, rel=0.06)
    assert said.keypoint_rms == pytest.approx(0.2, rel=0.06)
    assert said.bound is not None and said.bound_best90 is not None
    # Printed, the numbers have their units, and there are no arrays: a line for each, none of them long.
    lines = str(said).splitlines()
    assert 8 < len(lines) < 15 and max(map(len, lines)) < 100
    assert f"{said.num_points} points" in lines[0] and all(": " in line for line in lines)
    assert f"{1000 * said.rmse_best90:.3g} mm" in str(said) and f"{said.keypoint_noise:.3g} px" in str(said)
    assert len(repr(said)) < 1000 and "point3D_ids" not in repr(said)
    assert "Allowed" in str(said) and "Allowed" not in str(replace(said, bound=None, bound_best90=None))


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_bound_of_a_model_is_that_of_its_capture(scenario: Scenario) -> None:
    truth = session(scenario).truth
    model = made_up(truth, count=100, noise=0.1)
    capture = Capture(
        options=SceneOptions(scenario=scenario, **SMALL),
        reconstruction=model,
        planes={k + 1: (plane[:3], float(plane[3])) for k, plane in enumerate(truth.planes)},
        pixels={},
        outliers=set(),
        world_plane=None,
    )
    said = judge(model, truth)
    assert said.bound is not None
    # The judge takes the points from keypoints with 0.1 px of noise, a millimetre of ten.
    assert said.bound / said.keypoint_noise == pytest.approx(noise_bound(capture) / 0.5, rel=0.02)
    assert said.rmse < 0.003


def test_models_of_other_images_are_refused() -> None:
    truth = session("static_interface").truth
    model = made_up(truth, count=30, noise=0.1)
    with pytest.raises(RefractError, match="not one of the truth"):
        judge(model, replace(truth, names=tuple(f"other/{name}" for name in truth.names)))
    with pytest.raises(RefractError, match="no points"):
        judge(pycolmap.Reconstruction(), truth)


def test_interfaces_are_as_uncertain_as_the_bound_says(scenes: Scenes) -> None:
    """Against the refiner's, which knows nothing of the bound: deviations over standard deviations are about 1."""
    scene = scenes("moving_interface")
    unit, result = precision(configuration_of(scene.capture)), scene.refined
    truth, found = scene.capture.reconstruction, result.reconstruction
    common = sorted(set(truth.point3D_ids()) & set(found.point3D_ids()))
    spread = [np.array([model.points3D[i].xyz for i in common]).std(axis=0) for model in (truth, found)]
    scale = np.linalg.norm(spread[0]) / np.linalg.norm(spread[1])
    distances, tilts = [], []
    for k, (image_id, (normal, distance)) in enumerate(sorted(scene.capture.planes.items())):
        own = result.sidecar.images[truth.images[image_id].name]
        distances.append((scale * own.distance - distance) / (0.5 * unit.distance_std[k]))
        off = np.degrees(np.linalg.norm(np.array(own.normal_in_cam) - normal)) / np.sqrt(2)
        tilts.append(off / (0.5 * unit.normal_std_deg[k]))
    # Twelve samples, correlated by what they share.
    assert 0.5 < np.sqrt(np.mean(np.square(distances))) < 1.7
    assert 0.6 < np.sqrt(np.mean(np.square(tilts))) < 1.5


def test_directions_of_the_bound_add_up() -> None:
    capture = simulate(SceneOptions(scenario="moving_interface", num_images=6, num_points=60))
    unit = precision(configuration_of(capture))
    per_axis = [unit.std_along(axis) for axis in np.eye(3)]
    assert np.sqrt(np.mean(np.sum(np.square(per_axis), axis=0))) == pytest.approx(unit.rmse)
    assert 0.5 * unit.rmse == pytest.approx(noise_bound(capture))
    # From above, heights are the weak side.
    assert np.median(per_axis[2]) > np.median(per_axis[0])


def test_a_given_camera_and_relief_are_used() -> None:
    params = (1190.0, 1210.0, 805.0, 590.0, -0.1, 0.02, 0.001, -0.002)
    options = SceneOptions(scenario="static_interface", camera_model="OPENCV", camera_params=params, relief=0.1)
    capture = simulate(options)
    assert capture.reconstruction.cameras[1].params.tolist() == list(params)
    depths = [point.xyz[2] for point in capture.reconstruction.points3D.values()]
    assert 0.05 < np.ptp(depths) <= 0.1
    assert point_rmse(capture.reconstruction, capture) < 1e-12
    with pytest.raises(RefractError, match="one camera"):
        SceneOptions(scenario="static_interface", camera_params=params, num_cameras=2)
    with pytest.raises(RefractError, match="relief"):
        SceneOptions(scenario="static_interface", relief=5.0)


def test_a_plan_says_what_is_weak() -> None:
    sound = plan(SessionOptions(scene=SceneOptions(scenario="static_interface", num_images=10, num_points=150)))
    assert weaknesses(sound) == [] and "The plan is sound." in report(sound, {})
    assert sound.accuracy.rmse == pytest.approx(noise_bound(simulate(sound.options.scene)))
    assert sound.accuracy.horizontal < sound.accuracy.vertical < sound.accuracy.worst_vertical
    assert sound.footprint[0] > sound.footprint[1] > 1
    # 1 m of air and 1.5 m of water, whose depth looks like three quarters of it: (1 + 1.5 / 1.333) / 1200.
    assert sound.sample_distance == pytest.approx((1 + 1.5 / 1.333) / 1200, rel=0.15)
    few = plan(replace(sound.options, scene=replace(sound.options.scene, num_images=3, layout="strip", oblique_deg=0)))
    text = report(few, {"30 images": sound.accuracy})
    assert weaknesses(few) and "WEAK" in text and "30 images" in text
    windy = plan(replace(sound.options, waves=(Wave(amplitude=0.01, wavelength=1.0),)))
    assert windy.wave_shift > 1 and any("waves move keypoints" in line for line in weaknesses(windy))
    assert windy.accuracy == sound.accuracy and "FLAT interface" in report(windy, {})


def test_waves_shift_keypoints_by_their_slope() -> None:
    """Long waves tilt the surface: the ray turns by (1 - 1/mu) of the slope, over the depth of the water."""
    scene = SceneOptions(scenario="static_interface", **{**SMALL, "num_images": 8, "oblique_deg": 0, "relief": 0.0})
    options = SessionOptions(scene=scene, waves=(Wave(amplitude=0.0005, wavelength=1.5, direction_deg=25),))
    said = plan(options)
    per_axis = said.wave_slope / np.sqrt(2) * (1 - 1 / 1.333) * 1.5 / said.sample_distance
    # Rays aslant turn more, and the crossing moves.
    assert said.wave_shift == pytest.approx(per_axis, rel=0.35)


def run(tmp_path: Path, **options: Any) -> None:
    usual = {"scenario": "static_interface", "num_points": 80, "compare": False}
    Simulator(**{**usual, **options}).run()


def test_the_command_plans_and_renders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calibrated = tmp_path / "cameras.txt"
    calibrated.write_text("3 OPENCV 160 120 130 131 81 59 -0.1 0.02 0.001 0\n")
    folder = tmp_path / "out"
    run(tmp_path, camera_path=calibrated, num_images=3, output_path=folder, wave_amplitude=(0.001,), wavelength=(0.4,))
    text = capsys.readouterr().out
    for words in ("static_interface", "OPENCV, 160 x 120 px", "A pixel shows", "FLAT", "Written to"):
        assert words in text
    assert sorted(path.name for path in (folder / "images").iterdir()) == [f"frame_000{k}.jpg" for k in (1, 2, 3)]
    truth = load_truth(folder)
    assert truth.cameras[1].params.tolist() == [130, 131, 81, 59, -0.1, 0.02, 0.001, 0]
    assert len(truth.views[0].surface.waves) == 1
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(RefractError, match="not empty"):
        run(tmp_path, camera_path=calibrated, num_images=3, output_path=folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"water_depth": -1.0}, "water_depth"),
        ({"interface_distance": 0.0}, "interface_distance"),
        ({"focal_length": np.nan}, "focal_length"),
        ({"tilt_deg": 90.0}, "tilt_deg"),
        ({"num_images": 1}, "images"),
        ({"camera_model": "SQUARE"}, "camera_model"),
        ({"camera_path": Path("no/such/cameras.txt")}, "does not exist"),
        ({"refractive_index": 0.0}, "refractive index"),
        ({"layer_thickness": (0.01,)}, "layer_refractive_index"),
        ({"wave_amplitude": (0.01,)}, "wavelength"),
        ({"wave_amplitude": (0.5,), "wavelength": (0.5,)}, "break"),
        ({"scenario": "camera_housing", "wave_amplitude": (0.01,), "wavelength": (0.5,)}, "no waves"),
        ({"num_images": 0}, "num_images 0 is too few images: give two or more$"),
        ({"num_points": 3}, "num_points 3 is too few"),
        ({"relief": -0.1}, "relief of -0.1 m is negative"),
        ({"relief": 100.0}, "reaches out of the water"),
        ({"relief": np.nan}, "relief"),
        ({"seed": -1}, "seed -1 is negative"),
        ({"seed": -1, "wave_amplitude": (0.01,), "wavelength": (1.0,)}, "seed -1 is negative"),
        ({"interval": -1.0}, "interval -1 s"),
        ({"num_threads": 0}, "num_threads 0"),
        ({"num_threads": -2}, "num_threads -2"),
        ({"scenario": "fixed_camera", "layout": "strip"}, "no path"),
        ({"jpeg_quality": 0}, "jpeg_quality"),
        ({"interval": np.inf}, "interval"),
        ({"scenario": "moving_interface", "interface_distance": 0.05, "tilt_deg": 30.0}, "interface|surface"),
    ],
)
def test_wrong_options_are_told_in_one_line(options: dict[str, Any], match: str, tmp_path: Path) -> None:
    with pytest.raises(RefractError, match=match) as raised:
        run(tmp_path, output_path=tmp_path / "out", **options)
    assert "\n" not in str(raised.value)
    assert list(tmp_path.iterdir()) == []


def planes_of(truth: Truth) -> Array:
    """Mean planes (m, 4) in the world."""
    rows = []
    for taken, plane in zip(truth.views, truth.planes, strict=True):
        pose = taken.cam_from_world
        normal, offset = plane_in_world(plane[:3], float(plane[3]), pose[:, :3], pose[:, 3])
        rows.append([*normal, offset])
    return np.array(rows)


def test_planes_are_shared_as_the_scenario_says() -> None:
    assert np.ptp(planes_of(session("static_interface").truth), axis=0) == pytest.approx(0, abs=1e-12)
    assert np.ptp(session("camera_housing").truth.planes, axis=0) == pytest.approx(0, abs=1e-12)
    moving = session("moving_interface").truth
    assert len(np.unique(moving.interfaces)) == 6 and np.ptp(planes_of(moving)[:, 0]) > 0.02
    assert len(np.unique([taken.cam_from_world for taken in session("fixed_camera").truth.views], axis=0)) == 1
