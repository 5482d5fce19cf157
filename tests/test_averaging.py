"""Means of groups of frames: what they are, what they weigh, and what a refinement makes of them."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from colmap_refract.errors import RefractError
from colmap_refract.options import ImageNotes, RefinerOptions
from colmap_refract.refiner.averaging import average_groups
from colmap_refract.refiner.observations import read_observations
from colmap_refract.refiner.refinement import refine
from colmap_refract.simulation import ignore_refraction, noise_bound, point_rmse, simulate
from colmap_refract.simulation.scene import SceneOptions

PER_GROUP = 8
OPTIONS = RefinerOptions(scenario="fixed_camera", average_groups=True, filter_max_reproj_error=12.0)


def capture(seed: int = 0, outlier_ratio: float = 0.0):
    return simulate(
        SceneOptions(
            scenario="fixed_camera",
            num_images=5 * PER_GROUP,
            num_points=150,
            frames_per_interface=PER_GROUP,
            outlier_ratio=outlier_ratio,
            seed=seed,
        )
    )


def groups_of(model: pycolmap.Reconstruction) -> dict[str, str]:
    names = sorted(image.name for image in model.images.values())
    return {name: f"group {k // PER_GROUP}" for k, name in enumerate(names)}


def test_means_are_those_of_the_keypoints() -> None:
    model = ignore_refraction(capture())
    groups = groups_of(model)
    single = read_observations(model)
    averaged = average_groups(single, OPTIONS, groups)
    means = averaged.observations
    assert averaged.member_of.min() >= -1
    # The frames of a group, which share pose and interface, have their points in common, but for those at the edge.
    assert 4.9 * len(means.points) < len(means.image) <= 5 * len(means.points)
    for row in (0, 17, len(means.image) - 1):
        mine = averaged.member_of == row
        ids = single.point3D_ids[single.point[mine]]
        assert len(ids) and (ids == means.point3D_ids[means.point[row]]).all()
        assert len({groups[single.image_names[i]] for i in single.image[mine]}) == 1
        np.testing.assert_allclose(means.pixel[row], single.pixel[mine].mean(axis=0), atol=1e-9)
    # Eight keypoints at 0.5 px; with the same number in each mean all weigh about the same.
    assert np.median(means.weight) == pytest.approx(1.0, abs=0.01)
    assert means.weight.std() < 0.3


def test_means_follow_the_exact_pixels() -> None:
    """The spread of means about the truth is that of single keypoints over the root of their number."""
    scene = capture()
    averaged = average_groups(read_observations(scene.reconstruction), OPTIONS, groups_of(scene.reconstruction))
    means = averaged.observations
    exact = np.array(
        [scene.pixels[int(means.image_ids[i])][k] for i, k in zip(means.image, means.point2D_idx, strict=True)]
    )
    deviation = (means.pixel - exact).std()
    # 750 means: the estimate itself is good to 3 %.
    assert deviation == pytest.approx(0.5 / np.sqrt(PER_GROUP), rel=0.12)


def test_wrong_matches_are_left_out_of_the_means() -> None:
    scene = capture(outlier_ratio=0.1)
    single = read_observations(scene.reconstruction)
    averaged = average_groups(single, OPTIONS, groups_of(scene.reconstruction))
    wrong = np.array(
        [
            (int(single.image_ids[i]), int(k)) in scene.outliers
            for i, k in zip(single.image, single.point2D_idx, strict=True)
        ]
    )
    assert wrong.sum() > 300
    # At the picture's edge some means have two or three keypoints, which cannot tell the wrong one.
    assert (averaged.member_of[wrong] == -1).mean() > 0.93
    assert (averaged.member_of[~wrong] == -1).mean() < 0.02


def test_a_spread_becomes_a_weight() -> None:
    model = ignore_refraction(capture())
    rng = np.random.default_rng(0)
    restless = set(list(model.points3D)[::2])
    for image in model.images.values():
        for point in image.points2D:
            if point.point3D_id in restless:
                point.xy = point.xy + 2.0 * rng.standard_normal(2)
    means = average_groups(read_observations(model), OPTIONS, groups_of(model)).observations
    moved = np.isin(means.point3D_ids[means.point], list(restless))
    ratio = np.median(means.weight[~moved]) / np.median(means.weight[moved])
    # Spreads of 0.5 and 2.06 px; each is drawn to the common one, since eight samples tell it badly.
    assert 2.0 < ratio < 4.2


@pytest.mark.parametrize("outlier_ratio", [0.0, 0.1])
def test_refining_means_is_as_good_as_refining_all(outlier_ratio: float) -> None:
    scene = capture(seed=1, outlier_ratio=outlier_ratio)
    model = ignore_refraction(scene)
    notes = ImageNotes(interface_groups=groups_of(model))
    result = refine(model, OPTIONS, notes=notes)
    assert result.converged
    assert not any("lost all" in sentence for sentence in result.warnings)
    assert point_rmse(result.reconstruction, scene) < 1.2 * noise_bound(scene)
    # The model is the input's, keypoint by keypoint, but for the outliers.
    good = model.compute_num_observations() - len(scene.outliers)
    assert 0.98 * good <= result.reconstruction.compute_num_observations() <= 1.02 * good
    assert result.reconstruction.num_reg_images() == model.num_reg_images()
    # A mean of eight keypoints at 0.5 px.
    assert result.sidecar.statistics["noise"] == pytest.approx(0.5 / np.sqrt(PER_GROUP), rel=0.2)


def test_what_cannot_be_averaged() -> None:
    model = ignore_refraction(capture())
    with pytest.raises(RefractError, match="no two images share an interface"):
        refine(model, OPTIONS)
    groups = groups_of(model)
    with pytest.raises(RefractError, match="only frames of a fixed_camera"):
        refine(
            model,
            RefinerOptions(scenario="moving_interface", average_groups=True),
            notes=ImageNotes(interface_groups=groups),
        )


def test_one_camera_per_image_makes_no_difference() -> None:
    """COLMAP makes a camera and a rig for every image of which it is not told otherwise."""
    model = capture().reconstruction
    apart = pycolmap.Reconstruction()
    camera = model.camera(1)
    for image_id, image in sorted(model.images.items()):
        own = pycolmap.Camera(camera.todict())
        own.camera_id = image_id
        apart.add_camera_with_trivial_rig(own)
        keypoints = [pycolmap.Point2D(point.xy) for point in image.get_observation_points2D()]
        bare = pycolmap.Image(image.name, keypoints, camera_id=image_id, image_id=image_id)
        apart.add_image_with_trivial_frame(bare, image.cam_from_world())
    for point in model.points3D.values():
        elements = [(e.image_id, e.point2D_idx) for e in point.track.elements]
        places = [
            (i, int(np.flatnonzero(np.array(model.image(i).get_observation_point2D_idxs()) == k)[0]))
            for i, k in elements
        ]
        apart.add_point3D(point.xyz, pycolmap.Track([pycolmap.TrackElement(*place) for place in places]))
    together = average_groups(read_observations(model), OPTIONS, groups_of(model)).observations
    found = average_groups(read_observations(apart), OPTIONS, groups_of(apart)).observations
    assert len(found.image) == len(together.image)
    np.testing.assert_allclose(np.sort(found.pixel[:, 0]), np.sort(together.pixel[:, 0]), atol=1e-9)
