"""Comparing refinements by what they predict: the right scenario, and no peeping at what is held out.

Scenes are small (8 images, 80 points), so planes that move by less than a degree are not asked to be noticed.
"""

from __future__ import annotations

import json
from dataclasses import fields, replace
from typing import Any, get_args

import numpy as np
import pycolmap
import pytest
from conftest import Scenes, error_of

import colmap_refract
from colmap_refract.options import ImageNotes, RefinerOptions, RefinerRequest, Scenario, ScenarioOrAuto
from colmap_refract.refiner import comparison
from colmap_refract.refiner.comparison import Candidate, Comparison, Trial, compare, paired_difference, table
from colmap_refract.refiner.held_out import HeldOut, hold_out, predict_directions
from colmap_refract.refiner.observations import read_observations
from colmap_refract.refiner.refinement import refine
from colmap_refract.refiner.scenario_choice import scenario_candidates

SMALL: dict[str, Any] = {"num_images": 8, "num_points": 80, "pixel_noise": 0.3}
STATIC = RefinerOptions(scenario="static_interface", num_threads=1)


def as_text(model: pycolmap.Reconstruction) -> str:
    """Poses, points, tracks and keypoints, to the last digit."""
    parts: list[object] = [(i, model.frame(i).rig_from_world.matrix().tolist()) for i in sorted(model.reg_frame_ids())]
    for point3D_id, point in sorted(model.points3D.items()):
        track = sorted((e.image_id, e.point2D_idx) for e in point.track.elements)
        parts.append((point3D_id, point.xyz.tolist(), track))
    for image_id, image in sorted(model.images.items()):
        parts.append((image_id, image.name, [p.xy.tolist() for p in image.points2D]))
    return repr(parts)


def held(held_out: HeldOut) -> set[tuple[int, int]]:
    """`(image_id, point2D_idx)` of what is held out."""
    observations = held_out.observations
    ids = observations.image_ids[observations.image]
    return set(zip(ids.tolist(), observations.point2D_idx.tolist(), strict=True))


@pytest.mark.parametrize(
    ("scenario", "options"),
    [
        ("static_interface", {}),
        ("static_interface", {"outlier_ratio": 0.05, "seed": 3}),
        ("moving_interface", {"tilt_deg": 3.0}),
        ("moving_interface", {"tilt_deg": 3.0, "outlier_ratio": 0.05, "seed": 3}),
        ("camera_housing", {"tilt_deg": 0.0}),
        ("camera_housing", {"tilt_deg": 5.0, "seed": 3}),
        ("fixed_camera", {"tilt_deg": 3.0}),
    ],
)
def test_the_scenario_is_found(scenes: Scenes, scenario: Scenario, options: dict[str, Any]) -> None:
    scene = scenes(scenario, **{**SMALL, **options})
    # What the user's options say of the scenario must not matter.
    candidates = scenario_candidates(scene.model, replace(STATIC, scenario="moving_interface"))
    result = compare(scene.model, candidates)
    assert result.chosen.label == scenario, table(result)
    assert result.chosen.options == replace(STATIC, scenario=scenario)
    assert [trial.candidate for trial in result.trials] == list(candidates)


def test_a_fixed_camera_with_poses_made_up_by_a_mapper_is_found(scenes: Scenes) -> None:
    """Straight rays through moving water make a camera at rest move by a percent of the depth or so."""
    scene = scenes("fixed_camera", tilt_deg=3.0, **SMALL)
    model = scene.copy()
    rng = np.random.default_rng(0)
    for frame in model.frames.values():
        turn = pycolmap.Rotation3d(0.002 * rng.standard_normal(3))
        frame.rig_from_world = pycolmap.Rigid3d(turn, 0.02 * rng.standard_normal(3)) * frame.rig_from_world
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_focal_length = options.refine_extra_params = False
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    candidates = scenario_candidates(model, STATIC)
    assert len(candidates) == 4
    assert compare(model, candidates).chosen.label == "fixed_camera"


def test_a_scenario_is_chosen_for_whoever_leaves_it_open(scenes: Scenes) -> None:
    scene = scenes("moving_interface", tilt_deg=3.0, **SMALL)
    request = colmap_refract.RefinerRequest(scenario="auto", num_threads=1, random_seed=2, filter_max_reproj_error=3.0)
    chosen = colmap_refract.choose_scenario(scene.model, request)
    assert isinstance(chosen, colmap_refract.Comparison)
    options = chosen.chosen.options
    # All that was asked for is still asked for.
    assert options == RefinerOptions(
        scenario="moving_interface", num_threads=1, random_seed=2, filter_max_reproj_error=3.0
    )
    assert refine(scene.model, options).sidecar.scenario == "moving_interface"
    candidates = scenario_candidates(scene.model, request)
    errors = [trial.error for trial in chosen.trials]
    assert [trial.error for trial in compare(scene.model, candidates, seed=2).trials] == errors
    assert [trial.error for trial in compare(scene.model, candidates, seed=3).trials] != errors


@pytest.mark.parametrize("scenario", ["auto", "aquarium"])
def test_a_refinement_has_one_of_the_four_scenarios(scenario: Any) -> None:
    message = error_of(lambda: RefinerOptions(scenario=scenario))
    assert f"'{scenario}'" in message and "camera_housing" in message and "choose_scenario" in message


def test_a_request_is_an_options_object_but_for_its_scenario() -> None:
    request, options = fields(RefinerRequest), fields(RefinerOptions)
    assert [part.name for part in request] == [part.name for part in options]
    assert {*get_args(ScenarioOrAuto)} == {*get_args(Scenario), "auto"}


def test_which_scenarios_are_tried(scenes: Scenes) -> None:
    moving = scenes("static_interface", **SMALL).model
    found = scenario_candidates(moving, STATIC)
    assert {c.label: c.complexity for c in found} == {
        "static_interface": 8 * 6 + 3, "camera_housing": 8 * 6 + 3, "moving_interface": 8 * 6 + 8 * 3,
    }  # fmt: skip
    assert found[-1].label == "moving_interface"
    asked = scenario_candidates(moving, STATIC, scenarios=("moving_interface", "fixed_camera"))
    assert [(c.label, c.complexity) for c in asked] == [("fixed_camera", 6 + 24), ("moving_interface", 48 + 24)]
    resting = scenes("fixed_camera", tilt_deg=3.0, **SMALL).model
    assert [c.label for c in scenario_candidates(resting, STATIC)] == ["fixed_camera"]
    # With as many cameras as frames, a plane per camera is a plane per image.
    own_cameras = scenes("moving_interface", **{**SMALL, "num_cameras": 8}).model
    assert [c.label for c in scenario_candidates(own_cameras, STATIC)] == ["static_interface", "moving_interface"]
    # A group of images that share one plane, and one that has none.
    names = [image.name for image in moving.images.values()]
    notes = ImageNotes(interface_groups=dict.fromkeys(names[:3], "calm"), dry_images=frozenset(names[3:4]))
    by_label = {c.label: c.complexity for c in scenario_candidates(moving, STATIC, notes)}
    assert by_label["moving_interface"] == 48 + 3 * (1 + 4)
    assert by_label["static_interface"] == 48 + 3 * (1 + 1)


def test_what_is_held_out_leaves_points_and_images_enough(scenes: Scenes) -> None:
    model = scenes("static_interface", layout="strip", num_images=10, num_points=250).model
    before = as_text(model)
    held_out = hold_out(model, part=0.1, seed=4)
    assert as_text(model) == before
    taken, rest = held(held_out), held_out.reconstruction
    total = model.compute_num_observations()
    assert len(taken) == len(held_out.observations.points) == round(0.1 * total)
    assert rest.compute_num_observations() == total - len(taken)
    assert rest.num_points3D() == model.num_points3D()
    assert len(set(held_out.observations.point3D_ids.tolist())) == len(taken)
    lengths = {i: len(point.track.elements) for i, point in rest.points3D.items()}
    assert min(lengths[i] for i in held_out.observations.point3D_ids.tolist()) >= 2
    # Both kinds of track are there: those too short to lose one, and those that have just enough.
    assert {2, 3} <= {len(point.track.elements) for point in model.points3D.values()}
    for image_id, image in model.images.items():
        lost = image.num_points3D - rest.image(image_id).num_points3D
        assert 0.05 < lost / image.num_points3D <= 0.2
        assert [p.xy.tolist() for p in rest.image(image_id).points2D] == [p.xy.tolist() for p in image.points2D]
    for image_id, idx in taken:
        assert model.image(image_id).points2D[idx].has_point3D()
        assert not rest.image(image_id).points2D[idx].has_point3D()
    assert held(hold_out(model, part=0.1, seed=4)) == taken
    assert held(hold_out(model, part=0.1, seed=5)) != taken


def test_of_a_large_model_some_points_are_enough(scenes: Scenes) -> None:
    model = scenes("static_interface", num_images=8, num_points=200).model
    rest = hold_out(model, part=0.1, per_image=40).reconstruction
    assert rest.num_points3D() < 0.4 * model.num_points3D()
    counts = [image.num_points3D for image in rest.images.values()]
    assert min(counts) >= 0.8 * 40
    assert len(rest.images) == len(model.images)


def test_keypoints_that_are_held_out_are_not_used(scenes: Scenes) -> None:
    scene = scenes("static_interface", **SMALL)
    held_out = hold_out(scene.model, part=0.1)
    wild = pycolmap.Reconstruction(held_out.reconstruction)
    used = pycolmap.Reconstruction(held_out.reconstruction)
    for image_id, idx in held(held_out):
        wild.image(image_id).points2D[idx].xy = np.array([3.0, 1000.0])
    element = next(iter(used.points3D.values())).track.elements[0]
    used.image(element.image_id).points2D[element.point2D_idx].xy += 2.0
    positions = []
    for model in (held_out.reconstruction, wild, used):
        points = refine(model, STATIC).reconstruction.points3D
        positions.append(np.array([points[i].xyz for i in sorted(points)]))
    assert (positions[0] == positions[1]).all()
    # One that is used makes a difference, so the equality above means something.
    assert np.abs(positions[0] - positions[2]).max() > 1e-4


def test_predictions_are_those_of_the_truth(scenes: Scenes) -> None:
    """The simulator finds its rays by Fermat's principle, not by the solver's formula."""
    scene = scenes("camera_housing", tilt_deg=5.0, **{**SMALL, "outlier_ratio": 0.05})
    refined = scene.refine(num_threads=1)
    truth = scene.capture
    names = {image_id: image.name for image_id, image in truth.reconstruction.images.items()}
    sidecar = replace(
        refined.sidecar,
        layers=truth.layers,
        images={
            name: replace(
                refined.sidecar.images[name], normal_in_cam=tuple(truth.planes[i][0]), distance=truth.planes[i][1]
            )
            for i, name in names.items()
        },
    )
    image = truth.reconstruction.image(2)
    seen = [(k, p.point3D_id) for k, p in enumerate(image.points2D) if p.has_point3D()]
    points = np.array([truth.reconstruction.point3D(p).xyz for _, p in seen])
    direction = predict_directions(truth.reconstruction, sidecar, 2, points)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, rtol=1e-12)
    # Least paths are found to 1e-6 px or so; straight rays would be tens of pixels off.
    exact = truth.pixels[2][[k for k, _ in seen]]
    np.testing.assert_allclose(image.camera.img_from_cam(direction), exact, atol=1e-4)
    dry = replace(sidecar.images[image.name], normal_in_cam=None, distance=None)
    straight = predict_directions(truth.reconstruction, replace(sidecar, images={image.name: dry}), 2, points)
    pose = image.cam_from_world()
    np.testing.assert_allclose(straight * np.linalg.norm(pose * points, axis=1)[:, None], pose * points, atol=1e-12)
    assert np.abs(image.camera.img_from_cam(straight) - exact).max() > 5.0
    # The errors, by keypoint: noise, but for outliers and for points that are gone.
    held_out = hold_out(truth.reconstruction, part=0.1)
    lost = int(held_out.observations.point3D_ids[0])
    model = pycolmap.Reconstruction(truth.reconstruction)
    model.delete_point3D(lost)
    errors = held_out.errors(model, sidecar)
    assert np.isinf(errors[0]) and np.isfinite(errors[1:]).all()
    keys = zip(
        held_out.observations.image_ids[held_out.observations.image].tolist(),
        held_out.observations.point2D_idx.tolist(),
        strict=True,
    )
    wrong = np.array([key in truth.outliers for key in keys])[1:]
    # Six standard deviations of the noise; a random pixel is hundreds away.
    assert errors[1:][~wrong].max() < 6 * 0.3
    np.testing.assert_allclose(np.sqrt((errors[1:][~wrong] ** 2).mean() / 2), 0.3, rtol=0.2)


def test_the_standard_error_is_that_of_a_bootstrap_over_images() -> None:
    rng = np.random.default_rng(1)
    image = np.repeat(np.arange(40), rng.integers(5, 15, 40))
    common = 0.5 * rng.standard_normal(40)[image]
    first = 2.0 + common + rng.standard_normal(len(image))
    second = 1.9 + 0.1 * rng.standard_normal(len(image))
    mean, deviation, interval = paired_difference(first, second, image)
    assert mean == pytest.approx((first - second).mean())
    members = [np.flatnonzero(image == g) for g in range(40)]
    difference = first - second
    means = []
    for _ in range(4000):
        drawn = np.concatenate([members[g] for g in rng.integers(0, 40, 40)])
        means.append(difference[drawn].mean())
    # A bootstrap of 40 clusters is itself good to some percent; without clusters it is two thirds of this.
    assert deviation == pytest.approx(np.std(means), rel=0.08)
    assert difference.std() / np.sqrt(len(image)) < 0.8 * deviation
    assert interval == pytest.approx(2.0227, abs=1e-3)  # Student's t, 39 degrees of freedom
    assert paired_difference(first, second, np.zeros(len(first)))[1] == np.inf


def judged(errors: dict[str, tuple[float, Any]], image: Any) -> Comparison:
    """What is chosen among candidates with given complexity and errors."""
    trials = [
        Trial(candidate=Candidate(label=name, options=STATIC, complexity=complexity))
        for name, (complexity, _) in errors.items()
    ]
    judged = comparison._judge(trials, [np.asarray(e, dtype=float) for _, e in errors.values()], image)
    chosen, why = comparison._choose(judged)
    return Comparison(trials=tuple(judged), chosen=chosen, why=why)


def test_the_simplest_of_equals_wins() -> None:
    rng = np.random.default_rng(0)
    image = np.repeat(np.arange(10), 20)
    error = np.linalg.norm(rng.standard_normal((200, 2)), axis=1)
    same = error + 0.02 * rng.standard_normal(200)
    worse = np.hypot(error, 0.8)
    tie = judged({"free": (9, error), "simple": (3, same)}, image)
    assert tie.chosen.label == "simple" and "as well as free" in tie.why
    clear = judged({"free": (9, error), "simple": (3, worse)}, image)
    assert clear.chosen.label == "free"
    assert [trial.tied for trial in clear.trials] == [True, False]
    better = judged({"free": (9, worse), "simple": (3, error)}, image)
    assert better.chosen.label == "simple" and "best" in better.why
    alike = judged({"free": (9, error), "one": (3, same), "other": (3, error)}, image)
    assert alike.chosen.label == "other" and "one cannot be told apart" in alike.why
    # Surely different, but by half a percent: not worth the unknowns.
    slightly = judged({"free": (9, error), "simple": (3, 1.005 * error)}, image)
    assert slightly.chosen.label == "simple"
    assert slightly.trials[1].difference > 2.3 * slightly.trials[1].difference_std
    # All the difference is in one image of ten, which may be chance.
    single = judged({"free": (9, error), "simple": (3, np.where(image == 4, np.hypot(error, 2.0), error))}, image)
    assert single.chosen.label == "simple"


def test_of_waves_that_predict_alike_the_likelihood_decides() -> None:
    """An unknown more is worth one unit; what was not tied before, or has no likelihood, has no part in it."""
    rng = np.random.default_rng(0)
    image = np.repeat(np.arange(10), 20)
    error = np.linalg.norm(rng.standard_normal((200, 2)), axis=1)

    def chosen(simple: float | None, free: float | None, off: float = 0.0) -> tuple[str, str]:
        trials = [
            Trial(candidate=Candidate(label=label, options=STATIC, complexity=complexity), log_likelihood=likelihood)
            for label, complexity, likelihood in (("simple", 3, simple), ("free", 9, free), ("flat", 1, None))
        ]
        errors = [error, np.hypot(error, off), np.hypot(error, 2.0)]
        candidate, why = comparison._choose(comparison._judge(trials, errors, image))
        return candidate.label, why

    label, why = chosen(100.0, 110.0)
    assert label == "free" and "higher by 10, for 6 more unknowns" in why
    label, why = chosen(100.0, 105.0)
    assert label == "simple" and "as well as free" in why
    assert chosen(100.0, 200.0, off=1.0)[0] == "simple"
    assert chosen(None, 200.0)[0] == chosen(100.0, None)[0] == "simple"


def test_wrong_matches_and_lost_points_do_not_decide() -> None:
    rng = np.random.default_rng(0)
    image = np.repeat(np.arange(10), 20)
    error = np.linalg.norm(rng.standard_normal((200, 2)), axis=1)
    worse = np.hypot(error, 0.8)
    wrong = rng.random(200) < 0.1
    # By the plain mean square the worse one would seem the better by far.
    far, farther = np.where(wrong, 300.0, worse), np.where(wrong, 500.0, error)
    result = judged({"worse": (3, far), "better": (3, farther)}, image)
    assert result.chosen.label == "better" and not result.trials[0].tied
    # A point that a candidate has lost counts as a wrong match does, so losing points wins nothing.
    lost = judged({"lost": (3, np.where(rng.random(200) < 0.3, np.inf, error)), "kept": (9, error)}, image)
    assert lost.chosen.label == "kept"


def test_failures_are_said(scenes: Scenes) -> None:
    model = scenes("static_interface", **SMALL).model
    good = Candidate(label="plain", options=STATIC, complexity=1)
    bad = Candidate(label="averaged", options=replace(STATIC, average_groups=True), complexity=0)
    result = compare(model, [bad, good])
    assert result.chosen is good and "only one that could be refined" in result.why
    assert "average_groups" in result.trials[0].reason and result.trials[0].error is None
    assert result.trials[0].reason in table(result)
    # What is wrong with all of them alike is said as it is; else each has its say.
    assert error_of(lambda: compare(model, [bad, replace(bad, label="again")])) == result.trials[0].reason
    moving = replace(bad, label="moving", options=bad.options.with_scenario("moving_interface"))
    message = error_of(lambda: compare(model, [bad, moving]))
    assert "averaged: " in message and "moving: " in message
    assert "labels" in error_of(lambda: compare(model, [good, good]))
    assert "labels" in error_of(lambda: compare(model, []))
    pairs = pycolmap.Reconstruction(model)
    for point3D_id in list(pairs.point3D_ids()):
        for element in [(e.image_id, e.point2D_idx) for e in pairs.point3D(point3D_id).track.elements][2:]:
            pairs.delete_observation(*element)
    assert "held out" in error_of(lambda: hold_out(pairs, part=0.1))


def test_a_single_candidate_costs_nothing(scenes: Scenes) -> None:
    model = scenes("static_interface", **SMALL).model
    broken = Candidate(label="any", options=replace(STATIC, average_groups=True), complexity=1)
    result = compare(model, [broken])
    assert result.chosen is broken and result.num_held_out == 0
    assert "only" in result.why and result.why in table(result)


def test_the_same_seed_gives_the_same_comparison_and_the_model_stays(scenes: Scenes) -> None:
    scene = scenes("moving_interface", tilt_deg=3.0, **SMALL)
    model = scene.copy()
    before = as_text(model)
    candidates = scenario_candidates(model, STATIC)
    stages: list[str] = []
    results = [compare(model, candidates, seed=seed, watch=lambda stage, _: stages.append(stage)) for seed in (0, 0, 1)]
    assert as_text(model) == before
    errors = [[trial.error for trial in result.trials] for result in results]
    assert errors[0] == errors[1] != errors[2]
    assert list(dict.fromkeys(stage.partition(": ")[0] for stage in stages)) == [
        f"Candidate {number} of 3, {candidate.label}" for number, candidate in enumerate(candidates, start=1)
    ]
    first = results[0]
    assert json.loads(json.dumps(first.as_dict(), allow_nan=False)) == first.as_dict()
    assert first.as_dict()["chosen"] == "moving_interface"
    assert first.num_images == 8 and first.num_points3D == model.num_points3D()
    lines = table(first).splitlines()
    for candidate in candidates:
        assert sum(line.startswith(candidate.label + " ") for line in lines[2:5]) == 1
    assert lines[-1] == first.why


def test_interrupts_pass(scenes: Scenes) -> None:
    model = scenes("static_interface", **SMALL).model

    def stop(stage: str, progress: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare(model, scenario_candidates(model, STATIC), watch=stop)


def test_given_intrinsics_are_those_of_the_predictions(scenes: Scenes) -> None:
    """A model with a wrong focal length, and the right one beside it."""
    scene = scenes("static_interface", **SMALL)
    model = scene.copy()
    right = {i: pycolmap.Camera(camera.todict()) for i, camera in model.cameras.items()}
    for camera in model.cameras.values():
        camera.focal_length *= 1.05
    candidates = scenario_candidates(model, STATIC, scenarios=("static_interface", "moving_interface"))
    with_right = compare(model, candidates, cameras=right)
    error = with_right.trials[0].error
    # Two coordinates of 0.3 px, and what the points are off.
    assert error is not None and 0.3 < error < 0.7
    assert read_observations(model).cameras[0].focal_length == pytest.approx(1.05 * right[1].focal_length)
