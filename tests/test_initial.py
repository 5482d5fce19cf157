"""Start values from matches alone lead the refiner to where it comes from COLMAP's own model: the noise bound."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from capture_database import write_colmap_3_database
from conftest import Scene, Scenes
from scipy.stats import spearmanr

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, Layers
from colmap_refract.mapping.clouds import average_clouds, pair_cloud, weighted_medians
from colmap_refract.mapping.database import read_correspondences
from colmap_refract.mapping.fixed_camera import find_relief
from colmap_refract.mapping.initial import InitialModel, initial_model, initial_model_from_database
from colmap_refract.mapping.model_from_database import observations_of_tracks, read_unposed_model
from colmap_refract.mapping.pairs import common_points, connected_groups, rank_pairs, rotational_residual
from colmap_refract.mapping.tracks import build_tracks
from colmap_refract.refiner.observations import Observations
from colmap_refract.simulation import point_rmse
from colmap_refract.simulation.database import write_database

DRY = Layers(index=(1.0001,))
"""As good as no water: what is found of such a scene must be the truth, but for 1e-4 of it."""


def start(
    scene: Scene, folder: Path, *, wrong: float = 0.03, reference: str | None = None, **options: Any
) -> InitialModel:
    path = write_database(
        folder / f"{len(list(folder.iterdir()))}.db", scene.capture.reconstruction, wrong=wrong, **options
    )
    return initial_model_from_database(path, scenario=scene.capture.scenario, reference=reference)


def with_ids_of(scene: Scene, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The model with the point ids of the scene; of points that share an id, the one seen most."""
    truth = scene.capture.reconstruction
    named: dict[int, tuple[Array, list[tuple[int, int]]]] = {}
    for _, point in sorted(model.points3D.items(), key=lambda item: item[1].track.length()):
        elements = [(e.image_id, e.point2D_idx) for e in point.track.elements]
        ids = [truth.image(i).point2D(k).point3D_id for i, k in elements]
        ids = [i for i in ids if truth.exists_point3D(i)]
        if ids:
            named[max(set(ids), key=ids.count)] = (point.xyz.copy(), elements)
    renamed = pycolmap.Reconstruction(model)
    for point3D_id in list(renamed.point3D_ids()):
        renamed.delete_point3D(point3D_id)
    for point3D_id, (xyz, elements) in named.items():
        track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
        renamed.add_point3D_with_id(point3D_id, pycolmap.Point3D(xyz=xyz, track=track))
    return renamed


def observed(scene: Scene, folder: Path) -> tuple[Observations, Array]:
    """The scene's tracks as observations, and the true points of them."""
    path = write_database(folder / "observed.db", scene.capture.reconstruction)
    found = read_correspondences(path)
    observations = observations_of_tracks(read_unposed_model(path, found), found, build_tracks(found))
    first = observations.start[:-1]
    truth = scene.capture.reconstruction
    ids = [
        truth.image(int(observations.image_ids[i])).point2D(int(k)).point3D_id
        for i, k in zip(observations.image[first], observations.point2D_idx[first], strict=True)
    ]
    return observations, np.array([truth.point3D(i).xyz for i in ids])


# Seeds at which the usual start (COLMAP's model, or a constant depth) reaches 1.15 of the bound, too: a single scene's
# error scatters by several per cent about it, which no start can change. What this does not show is how often.
@pytest.mark.parametrize(
    ("scenario", "options"),
    [
        ("static_interface", {"seed": 0}),
        ("static_interface", {"seed": 1, "outlier_ratio": 0.05}),
        ("moving_interface", {"seed": 0}),
        ("camera_housing", {"seed": 0}),
        ("camera_housing", {"seed": 1, "num_cameras": 2}),
        ("fixed_camera", {"seed": 4, "tilt_deg": 1.5}),
        ("fixed_camera", {"seed": 1, "tilt_deg": 3.0}),
        ("fixed_camera", {"seed": 4, "tilt_deg": 3.0, "outlier_ratio": 0.05}),
        ("fixed_camera", {"seed": 1, "tilt_deg": 8.0}),
    ],
)
def test_refining_the_start_reaches_the_noise_bound(
    scenes: Scenes, tmp_path: Path, scenario: Any, options: dict[str, Any]
) -> None:
    scene = scenes(scenario, **options)
    initial = start(scene, tmp_path)
    assert initial.reconstruction.num_reg_images() == 12
    assert initial.unregistered == ()
    model = with_ids_of(scene, initial.reconstruction)
    assert model.num_points3D() >= 0.95 * scene.capture.reconstruction.num_points3D()
    # It is a start: what it is asked to do remains to be done.
    assert scene.excess(model) > 1.3 if scenario != "fixed_camera" else True
    assert scene.excess(scene.refine(model).reconstruction) <= 1.15


@pytest.mark.parametrize(("scenario", "layout"), [("static_interface", "strip"), ("moving_interface", "survey")])
def test_images_far_from_the_reference_are_registered(
    scenes: Scenes, tmp_path: Path, scenario: Any, layout: str
) -> None:
    scene = scenes(scenario, layout=layout, num_images=14, num_points=500)
    initial = start(scene, tmp_path)
    assert initial.reconstruction.num_reg_images() == 14
    reference = initial.reconstruction.find_image_with_name(initial.reference_image)
    assert reference is not None
    assert reference.num_points3D < 0.6 * initial.reconstruction.num_points3D()
    model = with_ids_of(scene, initial.reconstruction)
    assert scene.excess(scene.refine(model).reconstruction) <= 1.15


def test_rigs_give_the_size_and_frames_stay_together(scenes: Scenes, tmp_path: Path) -> None:
    scene = scenes("moving_interface", sensors_per_frame=2, num_images=16)
    model = start(scene, tmp_path).reconstruction
    truth = scene.capture.reconstruction
    assert model.num_reg_images() == 16
    assert model.num_reg_frames() == 8
    for frame in model.frames.values():
        places = [model.image(data.id).projection_center() for data in frame.data_ids]
        assert np.linalg.norm(places[0] - places[1]) == pytest.approx(0.1 * scene.capture.options.scene_size, rel=1e-9)
    size, true_size = (
        np.std([image.projection_center() for _, image in sorted(m.images.items())], axis=0).max()
        for m in (model, truth)
    )
    # Water shortens depths by a quarter, and baselines that are told from it with them.
    assert 0.6 < size / true_size < 1.4
    assert scene.excess(scene.refine(with_ids_of(scene, model)).reconstruction) <= 1.15


def test_clouds_without_refraction_are_the_truth(scenes: Scenes, tmp_path: Path) -> None:
    scene = scenes("static_interface", layers=DRY, pixel_noise=0.0)
    observations, truth = observed(scene, tmp_path)
    common = common_points(observations)
    pairs = rank_pairs(observations, common, np.arange(12), anchor=4)[:5]
    clouds = [cloud for pair in pairs if (cloud := pair_cloud(observations, pair, 0)) is not None]
    assert len(clouds) == 5
    center = scene.capture.reconstruction.image(5).projection_center()
    distance = np.linalg.norm(truth - center, axis=1)
    for cloud in clouds:
        scaled = distance[cloud.point] / cloud.away
        # Keypoints are single precision in a database, the limits of an essential matrix two pixels wide.
        np.testing.assert_allclose(scaled, np.median(scaled), rtol=5e-3)
    average = average_clouds(clouds, len(truth))
    known = np.isfinite(average)
    assert known.sum() > 0.95 * (common[4, 4] - 1)
    ratio = distance[known] / average[known]
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=5e-3)


def test_model_without_refraction_is_the_truth(scenes: Scenes, tmp_path: Path) -> None:
    scene = scenes("static_interface", layers=DRY, pixel_noise=0.0)
    initial = start(scene, tmp_path, wrong=0.05)
    model = with_ids_of(scene, initial.reconstruction)
    assert point_rmse(model, scene.capture) < 1e-3
    reference = model.find_image_with_name(initial.reference_image)
    assert reference is not None
    pose = reference.cam_from_world()
    np.testing.assert_allclose(pose.matrix(), np.eye(3, 4), atol=1e-12)
    seen = [p.point3D_id for p in reference.points2D if p.has_point3D()]
    assert np.median([model.point3D(i).xyz[2] for i in seen]) == pytest.approx(1.0, rel=0.01)


def without_trend(values: Array, directions: Array) -> Array:
    x, y = (directions[:, :2] / directions[:, 2:]).T
    basis = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)
    return np.asarray(values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0])


@pytest.mark.parametrize(
    "options",
    [{}, {"outlier_ratio": 0.1}, {"distance_ratio": 0.8}, {"distance_ratio": 0.15}, {"focal_length": 2400.0}],
)
def test_relief_of_a_fixed_camera_is_not_inside_out(scenes: Scenes, tmp_path: Path, options: dict[str, Any]) -> None:
    scene = scenes("fixed_camera", tilt_deg=8.0, seed=2, **options)
    observations, truth = observed(scene, tmp_path)
    common = common_points(observations)
    relief = find_relief(observations, common, np.arange(12), 0)
    pose = scene.capture.reconstruction.image(1).cam_from_world()
    depth = (truth @ pose.rotation.matrix().T + pose.translation)[:, 2]
    directions = observations.direction[observations.start[:-1]]
    # Within the smooth part, which clouds do not show, see the module.
    true_relief = without_trend(1.0 / depth, directions)
    assert relief.reliability > 0.4
    assert spearmanr(relief.inverse_depth, true_relief).statistic > 0.4
    # The clouds themselves are inside out, or this would show nothing.
    turned = []
    for cloud in relief.clouds:
        rows = cloud.first_row
        inverse = without_trend(1.0 / (cloud.away * observations.direction[rows, 2]), observations.direction[rows])
        turned.append(spearmanr(inverse, true_relief[cloud.point]).statistic)
    assert len(turned) >= 20
    assert np.median(turned) < -0.3


@pytest.mark.parametrize("options", [{"layers": DRY}, {"num_images": 3, "tilt_deg": 8.0}])
def test_depths_that_nothing_bears_out_are_one(scenes: Scenes, tmp_path: Path, options: dict[str, Any]) -> None:
    scene = scenes("fixed_camera", **options)
    initial = start(scene, tmp_path, wrong=0.0)
    assert initial.reliability == 0.0
    assert any("no better than by chance" in warning for warning in initial.warnings)
    np.testing.assert_allclose([p.xyz[2] for p in initial.reconstruction.points3D.values()], 1.0, rtol=1e-6)


def test_fixed_camera_stands_at_the_origin(scenes: Scenes, tmp_path: Path) -> None:
    initial = start(scenes("fixed_camera", tilt_deg=8.0, seed=1), tmp_path)
    model = initial.reconstruction
    for image in model.images.values():
        np.testing.assert_array_equal(image.cam_from_world().matrix(), np.eye(3, 4))
    reference = model.find_image_with_name(initial.reference_image)
    assert reference is not None
    seen = [p for p in reference.points2D if p.has_point3D()]
    expected = reference.camera.img_from_cam(np.array([model.point3D(p.point3D_id).xyz for p in seen]))
    assert len(seen) > 100
    np.testing.assert_allclose(expected, [p.xy for p in seen], atol=1e-3)


def test_reference_is_the_one_asked_for(scenes: Scenes, tmp_path: Path) -> None:
    scene = scenes("moving_interface")
    initial = start(scene, tmp_path, reference="frame_0003.jpg")
    assert initial.reference_image == "frame_0003.jpg"
    assert all(pair.first == "frame_0003.jpg" for pair in initial.pairs)
    np.testing.assert_allclose(initial.reconstruction.image(3).cam_from_world().matrix(), np.eye(3, 4), atol=1e-12)
    with pytest.raises(RefractError, match="no image named 'other.jpg'"):
        start(scene, tmp_path, reference="other.jpg")


def test_default_reference_shares_most(scenes: Scenes, tmp_path: Path) -> None:
    # In a strip the ends share little; the middle it is.
    initial = start(scenes("static_interface", layout="strip", num_images=14, num_points=500), tmp_path)
    assert 4 <= int(initial.reference_image.removeprefix("frame_").removesuffix(".jpg")) <= 11


def test_start_is_repeatable(scenes: Scenes, tmp_path: Path) -> None:
    first, second = (start(scenes("moving_interface"), tmp_path) for _ in range(2))
    a, b = ([p.xyz for _, p in sorted(s.reconstruction.points3D.items())] for s in (first, second))
    np.testing.assert_array_equal(a, b)
    assert first.pairs == second.pairs


def test_larger_group_of_images_is_kept(scenes: Scenes, tmp_path: Path) -> None:
    scene = scenes("moving_interface")
    initial = start(scene, tmp_path, paired=lambda i, j: (i <= 4) == (j <= 4))
    assert initial.reconstruction.num_reg_images() == 8
    assert initial.unregistered == tuple(f"frame_000{i}.jpg" for i in (1, 2, 3, 4))
    assert "frame_0001.jpg, frame_0002.jpg, frame_0003.jpg, frame_0004.jpg" in initial.warnings[-1]
    with pytest.raises(RefractError, match="'frame_0002.jpg' shares too few points with most other images"):
        start(scene, tmp_path, paired=lambda i, j: (i <= 4) == (j <= 4), reference="frame_0002.jpg")


def test_what_is_missing_is_said(scenes: Scenes, tmp_path: Path) -> None:
    scene = scenes("moving_interface")
    with pytest.raises(RefractError, match="no matches between the images"):
        start(scene, tmp_path, paired=lambda i, j: False)
    few = scenes("moving_interface", num_points=11)
    with pytest.raises(RefractError, match=r"no two images have 12 points in common \(1[01] at most\)"):
        start(few, tmp_path, wrong=0.0)
    single = pycolmap.Reconstruction()
    truth = scene.capture.reconstruction
    single.add_camera_with_trivial_rig(truth.camera(1))
    single.add_image_with_trivial_frame(pycolmap.Image("a.jpg", np.ones((3, 2)), 1, 1))
    path = write_database(tmp_path / "single.db", single)
    with pytest.raises(RefractError, match="one image only"):
        initial_model_from_database(path, scenario="moving_interface")


def test_turning_camera_has_no_start(scenes: Scenes, tmp_path: Path) -> None:
    # A fixed camera above a dry scene has the same picture twelve times: nothing to tell a depth from.
    scene = scenes("fixed_camera", layers=DRY)
    path = write_database(tmp_path / "database.db", scene.capture.reconstruction)
    with pytest.raises(RefractError, match="shows the scene from two sides"):
        initial_model_from_database(path, scenario="moving_interface")


def test_fixed_rig_is_refused(scenes: Scenes, tmp_path: Path) -> None:
    scene = scenes("moving_interface", sensors_per_frame=2, num_images=16)
    path = write_database(tmp_path / "database.db", scene.capture.reconstruction)
    with pytest.raises(RefractError, match="rig of several"):
        initial_model_from_database(path, scenario="fixed_camera")


def test_fixed_camera_that_is_many_is_called_out(scenes: Scenes, tmp_path: Path) -> None:
    # What COLMAP makes of images without a common camera: one each.
    scene = scenes("fixed_camera", tilt_deg=8.0, seed=1)
    path = write_database(tmp_path / "database.db", scene.capture.reconstruction, with_rigs=False)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(
            "INSERT INTO cameras SELECT image_id + 1, model, width, height, params, prior_focal_length "
            "FROM images, cameras WHERE cameras.camera_id = 1"
        )
        connection.execute("UPDATE images SET camera_id = image_id + 1")
        connection.commit()
    initial = initial_model_from_database(path, scenario="fixed_camera")
    assert initial.reconstruction.num_reg_images() == 12
    assert any("12 cameras, each of which would have a pose of its own" in warning for warning in initial.warnings)


def test_guessed_intrinsics_are_called_out(scenes: Scenes, tmp_path: Path) -> None:
    scene = scenes("static_interface")
    # What COLMAP knows of a simulated camera is no prior either.
    assert not scene.capture.reconstruction.camera(1).has_prior_focal_length
    path = write_database(tmp_path / "database.db", scene.capture.reconstruction)
    guessed = initial_model_from_database(path, scenario="static_interface")
    assert any("intrinsics of camera 1 are a guess" in warning for warning in guessed.warnings)
    camera = scene.capture.reconstruction.camera(1)
    calibrated = initial_model_from_database(path, scenario="static_interface", cameras={1: camera})
    assert calibrated.warnings == ()


def test_database_of_colmap_3_gives_the_same_start(scenes: Scenes, tmp_path: Path) -> None:
    scene = scenes("moving_interface")
    new = write_database(tmp_path / "new.db", scene.capture.reconstruction)
    old = write_colmap_3_database(tmp_path / "old.db", new, priors=True)
    first, second = (initial_model_from_database(path, scenario="moving_interface") for path in (new, old))
    for image_id, image in first.reconstruction.images.items():
        other = second.reconstruction.image(image_id)
        np.testing.assert_allclose(image.cam_from_world().matrix(), other.cam_from_world().matrix(), atol=1e-9)


def test_inputs_are_not_altered(scenes: Scenes, tmp_path: Path) -> None:
    path = write_database(tmp_path / "database.db", scenes("moving_interface").capture.reconstruction)
    found = read_correspondences(path)
    tracks, unposed = build_tracks(found), read_unposed_model(path, found)
    before = tracks.image.copy(), [keypoints.copy() for keypoints in found.keypoints]
    initial_model(found, tracks, unposed, scenario="moving_interface")
    assert unposed.num_reg_images() == unposed.num_points3D() == 0
    np.testing.assert_array_equal(tracks.image, before[0])
    assert all((a == b).all() for a, b in zip(found.keypoints, before[1], strict=True))


def test_pairs_are_ranked_by_what_no_rotation_explains(scenes: Scenes, tmp_path: Path) -> None:
    scene = scenes("static_interface", layout="strip", num_images=14, num_points=500)
    observations, truth = observed(scene, tmp_path)
    common = common_points(observations)
    pairs = rank_pairs(observations, common, np.arange(14))
    information = [pair.information for pair in pairs]
    assert information == sorted(information, reverse=True)
    # What the truth says of them: the angles at which rays really meet, above the water.
    centers = [image.projection_center() for _, image in sorted(scene.capture.reconstruction.images.items())]
    true_information = []
    for pair in pairs:
        points = truth[observations.point[pair.first_row]]
        a, b = (
            (points - centers[i]) / np.linalg.norm(points - centers[i], axis=1)[:, None]
            for i in (pair.first, pair.second)
        )
        true_information.append(float((np.linalg.norm(a - b, axis=1) ** 2).sum()))
    assert len(pairs) > 40
    assert spearmanr(information, true_information).statistic > 0.6
    assert np.mean(true_information[:5]) > 1.5 * np.median(true_information)
    for pair in pairs:
        assert len(pair.first_row) == common[pair.first, pair.second] >= 12
        assert (observations.image[pair.first_row] == pair.first).all()
        assert (observations.point[pair.first_row] == observations.point[pair.second_row]).all()


def test_rotation_leaves_no_parallax() -> None:
    rng = np.random.default_rng(0)
    first = rng.normal(size=(60, 3)) + [0, 0, 4]
    first /= np.linalg.norm(first, axis=1)[:, None]
    rotation = pycolmap.Rotation3d(np.array([0.3, -0.2, 0.5])).matrix()
    second = first @ rotation.T
    assert rotational_residual(first, second).max() < 1e-12
    # A quarter of wrong matches does not turn the rest.
    second[:15] = second[rng.permutation(15)]
    assert np.median(rotational_residual(first, second)) < 1e-4


def test_groups_are_those_that_enough_points_join() -> None:
    common = np.diag([50, 50, 50, 50, 50])
    for i, j, count in [(0, 1, 40), (1, 2, 12), (3, 4, 30), (2, 3, 11)]:
        common[i, j] = common[j, i] = count
    assert [group.tolist() for group in connected_groups(common)] == [[0, 1, 2], [3, 4]]


def test_weighted_median_is_where_half_the_weight_is() -> None:
    rng = np.random.default_rng(1)
    value, weight, label = rng.normal(size=400), rng.uniform(0.1, 2, 400), rng.integers(0, 9, 400)
    found = weighted_medians(value, weight, label, 11)
    assert np.isnan(found[9:]).all()
    for k in range(9):
        mine = label == k
        total = weight[mine].sum()
        assert weight[mine & (value < found[k])].sum() <= 0.5 * total
        assert weight[mine & (value > found[k])].sum() <= 0.5 * total
