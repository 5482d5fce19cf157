"""Calibration from corners: against known cameras, against OpenCV's, and what is said when it cannot be trusted.

Corners here are projected by COLMAP's camera models and moved by noise; how well they are found in pictures is tested
with the command.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import get_args, get_type_hints

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from colmap_refract.calibration.boards import Board, View
from colmap_refract.calibration.calibration import Calibration, CameraModel, calibrate
from colmap_refract.calibration.coverage import Coverage, judge, measure_coverage
from colmap_refract.calibration.picture import draw_coverage
from colmap_refract.calibration.precision import image_std
from colmap_refract.commands.camera_calibrator import CameraCalibrator
from colmap_refract.errors import RefractError
from colmap_refract.interface import Array

SIZE = (1280, 960)
CORNERS = Board(kind="chessboard", num_columns=10, num_rows=7).corners
NOISE = 0.1
TRUTH: dict[str, list[float]] = {
    "SIMPLE_PINHOLE": [900.0, 651.0, 467.0],
    "PINHOLE": [900.0, 906.0, 651.0, 467.0],
    "SIMPLE_RADIAL": [900.0, 651.0, 467.0, -0.15],
    "RADIAL": [900.0, 651.0, 467.0, -0.2, 0.06],
    "OPENCV": [900.0, 906.0, 651.0, 467.0, -0.25, 0.08, 0.001, -0.0007],
    "FULL_OPENCV": [900.0, 906.0, 651.0, 467.0, -0.25, 0.08, 0.001, -0.0007, 0.01, 0.02, 0.01, 0.0],
    "SIMPLE_RADIAL_FISHEYE": [450.0, 651.0, 467.0, -0.02],
    "RADIAL_FISHEYE": [450.0, 651.0, 467.0, -0.02, 0.01],
    "OPENCV_FISHEYE": [450.0, 453.0, 651.0, 467.0, -0.02, 0.01, -0.003, 0.001],
}


def camera_of(model: str) -> pycolmap.Camera:
    return pycolmap.Camera(camera_id=1, model=model, width=SIZE[0], height=SIZE[1], params=TRUTH[model])


def make_views(
    camera: pycolmap.Camera,
    count: int = 15,
    *,
    tilt: float = 0.35,
    reach: float = 0.9,
    distance: tuple[float, float] | None = None,
    fewest: int = 20,
    seed: int = 0,
) -> list[View]:
    """A board anywhere in the image, without noise; what reaches out of the image is not seen.

    Args:
        camera: that sees it.
        count: of views.
        tilt: standard deviation about each axis, radians.
        reach: how far from the middle its middle gets, 1 is the edge.
        distance: least and largest, squares.
        fewest: corners of a view.
        seed: of all that is random.
    """
    rng = np.random.default_rng(seed)
    if distance is None:
        distance = (4.0, 8.0) if "FISHEYE" in camera.model.name else (9.0, 16.0)
    views: list[View] = []
    while len(views) < count:
        rotation = Rotation.from_rotvec(tilt * rng.normal(size=3)).as_matrix()
        place = (0.5 + 0.5 * reach * rng.uniform(-1, 1, size=2)) * SIZE
        middle = camera.cam_ray_from_img(place[None])[0] * rng.uniform(*distance)
        xy = camera.img_from_cam((CORNERS - CORNERS.mean(axis=0)) @ rotation.T + middle)
        seen = np.flatnonzero(((xy > 0) & (xy < SIZE)).all(axis=1))
        if len(seen) >= fewest:
            views.append(View(name=f"view{len(views)}.png", corner_idxs=seen, xy=xy[seen]))
    return views


def noisy(views: Sequence[View], seed: int = 1, noise: float = NOISE) -> list[View]:
    rng = np.random.default_rng(seed)
    return [replace(view, xy=view.xy + noise * rng.normal(size=view.xy.shape)) for view in views]


def covered(calibration: Calibration) -> Coverage:
    return measure_coverage(calibration, CORNERS)


def center_pixels() -> Array:
    """Pixels that views of all sets cover."""
    return np.stack(np.meshgrid(np.linspace(200, 1080, 8), np.linspace(150, 810, 8)), axis=-1).reshape(-1, 2)


@cache
def repetitions(model: CameraModel) -> list[Calibration]:
    """40 calibrations from the same 10 views, each with noise of its own."""
    views = make_views(camera_of(model), 10)
    return [calibrate(CORNERS, noisy(views, seed), SIZE, model) for seed in range(40)]


# --- The camera ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", TRUTH)
def test_without_noise_the_camera_is_found_exactly(model: CameraModel) -> None:
    truth = camera_of(model)
    found = calibrate(CORNERS, make_views(truth), SIZE, model)
    assert found.camera.model.name == model and not any(fit.dropped for fit in found.views)
    assert found.rms_error < 1e-4
    # The eight distortion parameters of FULL_OPENCV are nearly one unknown: there, only the pixels are compared.
    if model != "FULL_OPENCV":
        np.testing.assert_allclose(found.camera.params, truth.params, rtol=1e-4, atol=1e-4)
    pixels = center_pixels()
    np.testing.assert_allclose(found.camera.img_from_cam(truth.cam_ray_from_img(pixels)), pixels, atol=1e-2)


def test_every_model_of_the_command_is_tested() -> None:
    assert set(get_args(CameraModel)) == set(TRUTH)
    assert get_type_hints(CameraCalibrator)["camera_model"] == CameraModel


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_standard_deviations_are_those_of_repetition(model: CameraModel) -> None:
    """40 times new noise: the spread of the parameters is what each time was stated, and their mean is the truth."""
    runs = repetitions(model)
    assert all(len(run.kept) == 10 for run in runs)
    off = np.array([run.camera.params for run in runs]) - TRUTH[model]
    stated = np.mean([run.std for run in runs], axis=0)
    # A spread of 40 has a standard deviation of 11 %; a variance in place of a deviation is a factor of 10.
    ratio = np.sqrt(np.mean(off**2, axis=0)) / stated
    assert (ratio > 0.6).all() and (ratio < 1.5).all()
    assert (np.abs(off.mean(axis=0)) < 4 * stated / np.sqrt(40)).all()
    # With their correlations: the mean of chi-square with P degrees of freedom is P, its deviation sqrt(2 P / 40).
    chi = [o @ np.linalg.solve(run.covariance, o) for o, run in zip(off, runs, strict=True)]
    assert np.mean(chi) == pytest.approx(off.shape[1], abs=4 * np.sqrt(2 * off.shape[1] / 40))
    assert np.mean([run.noise for run in runs]) == pytest.approx(NOISE, rel=0.02)


def test_precision_in_the_image_is_that_of_repetition() -> None:
    """Where known directions are seen, a rotation of the camera apart, as far from the truth as stated."""
    truth = camera_of("OPENCV")
    pixels = center_pixels()
    rays = truth.cam_ray_from_img(pixels)
    squared, stated = [], []
    for run in repetitions("OPENCV"):
        seen = run.camera.cam_ray_from_img(pixels)
        turn = Rotation.align_vectors(seen, rays)[0]
        squared.append(np.sum((run.camera.img_from_cam(turn.apply(rays)) - pixels) ** 2, axis=1))
        stated.append(image_std(run.camera, run.covariance, pixels))
    spread = np.sqrt(np.mean(squared, axis=0))
    # Two axes, of which the worse is stated: between 1 and sqrt(2) of it. The turn is fitted a little otherwise here.
    ratio = np.median(spread / np.mean(stated, axis=0))
    assert 0.8 < ratio < 1.6


def test_as_opencv_calibrates() -> None:
    """OpenCV's own calibration of the same corners: half a pixel beside, the same deviations."""
    views = noisy(make_views(camera_of("OPENCV")))
    found = calibrate(CORNERS, views, SIZE, "OPENCV")
    places = [CORNERS[view.corner_idxs].astype(np.float32) for view in views]
    pixels = [(view.xy - 0.5).astype(np.float32) for view in views]
    start = np.array([[1000.0, 0, 640], [0, 1000.0, 480], [0, 0, 1]])
    rms, matrix, distortion, rotations, translations, std, _, per_view = cv2.calibrateCameraExtended(
        places, pixels, SIZE, start, np.zeros(5), flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    )
    expected = [matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5, *distortion.ravel()[:4]]
    assert (np.abs(found.camera.params - expected) < 0.02 * found.std).all()
    np.testing.assert_allclose(found.std, std.ravel()[:8], rtol=0.05)
    assert found.rms_error == pytest.approx(rms, rel=1e-4)
    np.testing.assert_allclose([fit.rms_error for fit in found.views], np.ravel(per_view), rtol=1e-3)
    # COLMAP's projection with the camera that is written is OpenCV's, half a pixel beside.
    rotation = cv2.Rodrigues(rotations[0])[0]
    by_colmap = found.camera.img_from_cam(places[0].astype(float) @ rotation.T + translations[0].ravel())
    params = np.asarray(found.camera.params)
    own = np.array([[params[0], 0, params[2] - 0.5], [0, params[1], params[3] - 0.5], [0, 0, 1]])
    by_opencv, _ = cv2.projectPoints(places[0], rotations[0], translations[0], own, params[4:])
    np.testing.assert_allclose(by_colmap, by_opencv.reshape(-1, 2) + 0.5, atol=1e-6)


def test_lenses_from_wide_to_tele() -> None:
    for focal, distance in ((500.0, (5.0, 9.0)), (5000.0, (50.0, 80.0))):
        truth = pycolmap.Camera(model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=[focal, 640, 480, 0.02])
        found = calibrate(CORNERS, noisy(make_views(truth, distance=distance)), SIZE, "SIMPLE_RADIAL")
        assert (np.abs(found.camera.params - truth.params) < 4 * found.std).all()
        assert found.std[0] < 0.005 * focal


def test_a_board_that_is_numbered_otherwise_gives_the_same_camera() -> None:
    """A chessboard has no first corner: numbered from the other end, or as if seen from behind."""
    views = noisy(make_views(camera_of("OPENCV"), fewest=len(CORNERS)))
    found = calibrate(CORNERS, views, SIZE, "OPENCV")
    columns, rows = 9, 6
    order = np.arange(len(CORNERS)).reshape(rows, columns)
    for renumbered in (order[::-1, ::-1], order[:, ::-1]):
        others = [replace(view, corner_idxs=renumbered.ravel()) if v % 2 else view for v, view in enumerate(views)]
        other = calibrate(CORNERS, others, SIZE, "OPENCV")
        assert (np.abs(other.camera.params - found.camera.params) < 1e-3 * found.std).all()
        assert other.tilt == pytest.approx(found.tilt, abs=0.01)


# --- Views that do not fit -------------------------------------------------------------------------------------------


def test_bad_views_are_dropped_and_named() -> None:
    views = noisy(make_views(camera_of("OPENCV")))
    rng = np.random.default_rng(3)
    blurred = views[3].xy + rng.normal(size=views[3].xy.shape)
    one_off = views[7].xy.copy()
    one_off[4] += 8
    spoiled = {
        3: replace(views[3], xy=blurred),
        5: replace(views[5], corner_idxs=rng.permutation(views[5].corner_idxs)),
        7: replace(views[7], xy=one_off),
        9: replace(views[9], corner_idxs=views[9].corner_idxs[:5], xy=views[9].xy[:5]),
        11: replace(views[11], corner_idxs=np.empty(0, np.int64), xy=np.empty((0, 2))),
    }
    on_a_line = CORNERS[views[13].corner_idxs, 1] == CORNERS[views[13].corner_idxs[-1], 1]
    spoiled[13] = replace(views[13], corner_idxs=views[13].corner_idxs[on_a_line], xy=views[13].xy[on_a_line])
    assert on_a_line.sum() >= 6
    mixed = [spoiled.get(v, view) for v, view in enumerate(views)]
    found = calibrate(CORNERS, mixed, SIZE, "OPENCV")
    assert {v for v, fit in enumerate(found.views) if fit.dropped} == set(spoiled)
    assert [fit.view.name for fit in found.views] == [view.name for view in views]
    reasons = [found.views[v].dropped for v in spoiled]
    assert reasons[0].startswith("error of 1.") and "px (rms" in reasons[0]
    assert reasons[3:] == [
        "only 5 corners of the board were found, 6 are needed",
        "the board was not found",
        "all corners that were found are on one line",
    ]
    # As if they had never been there.
    without = calibrate(CORNERS, [view for v, view in enumerate(views) if v not in spoiled], SIZE, "OPENCV")
    assert (np.abs(found.camera.params - without.camera.params) < 1e-2 * without.std).all()
    assert judge(found, covered(found)).advice or judge(found, covered(found)).warnings


def test_a_third_of_gross_views_does_not_spoil_the_rest() -> None:
    views = noisy(make_views(camera_of("OPENCV"), 18))
    rng = np.random.default_rng(5)
    for v in range(0, 18, 3):
        views[v] = replace(views[v], xy=views[v].xy + 20 * rng.normal(size=views[v].xy.shape))
    found = calibrate(CORNERS, views, SIZE, "OPENCV")
    assert {v for v, fit in enumerate(found.views) if fit.dropped} == set(range(0, 18, 3))
    assert (np.abs(found.camera.params - TRUTH["OPENCV"]) < 4 * found.std).all()


def test_max_view_error() -> None:
    views = noisy(make_views(camera_of("OPENCV")))
    usual = calibrate(CORNERS, views, SIZE, "OPENCV")
    assert not any(fit.dropped for fit in usual.views)
    errors = sorted(fit.rms_error for fit in usual.views)
    strict = calibrate(CORNERS, views, SIZE, "OPENCV", max_view_error=errors[-3])
    assert 0 < sum(bool(fit.dropped) for fit in strict.views) < 8
    assert max(fit.rms_error for fit in strict.kept) <= errors[-3]
    with pytest.raises(RefractError, match=r"only \d of 15 views fit to 0.001 px"):
        calibrate(CORNERS, views, SIZE, "OPENCV", max_view_error=0.001)


# --- What cannot be calibrated, or not well --------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV"])
@pytest.mark.parametrize("tilt", [0.0, 0.005])
def test_parallel_views_are_refused(model: CameraModel, tilt: float) -> None:
    """Boards parallel to each other leave the focal length open, whatever their place."""
    views = noisy(make_views(camera_of(model), tilt=tilt))
    with pytest.raises(RefractError, match="tilted by 20 to 40 degrees") as raised:
        calibrate(CORNERS, views, SIZE, model)
    assert "\n" not in str(raised.value)


def test_parallel_tilted_views_are_refused() -> None:
    camera = camera_of("PINHOLE")
    rotation = Rotation.from_rotvec([0.4, 0.3, 0.1]).as_matrix()
    views = []
    for k in range(12):
        middle = np.array([k % 4 - 1.5, k // 4 - 1.0, 12.0 + k % 5])
        xy = camera.img_from_cam((CORNERS - CORNERS.mean(axis=0)) @ rotation.T + middle)
        views.append(View(name=str(k), corner_idxs=np.arange(len(CORNERS)), xy=xy))
    with pytest.raises(RefractError, match="same direction in all views"):
        calibrate(CORNERS, noisy(views), SIZE, "PINHOLE")


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_views_are_refused(count: int) -> None:
    with pytest.raises(RefractError, match=f"{count} of {count} views show enough"):
        calibrate(CORNERS, make_views(camera_of("OPENCV"), count), SIZE, "OPENCV")


def test_a_wrong_board_is_refused_or_not_trusted() -> None:
    """Corners of another board: nothing fits, and nothing is found by chance."""
    views = noisy(make_views(camera_of("OPENCV")))
    rng = np.random.default_rng(0)
    shuffled = [replace(view, corner_idxs=rng.permutation(view.corner_idxs)) for view in views]
    with pytest.raises(RefractError):
        calibrate(CORNERS, shuffled, SIZE, "OPENCV", max_view_error=5.0)


def test_good_coverage_is_trusted() -> None:
    found = calibrate(CORNERS, noisy(make_views(camera_of("OPENCV"), 25, distance=(7.0, 12.0))), SIZE, "OPENCV")
    coverage = covered(found)
    assert coverage.area > 0.9 and coverage.corner_gaps.max() < 0.2
    assert judge(found, coverage).warnings == ()


@pytest.mark.parametrize(
    ("views", "words"),
    [
        (
            {"reach": 0.15, "distance": (15.0, 18.0), "fewest": 50},
            "of the image: take pictures with it in the other parts",
        ),
        ({"reach": 0.15, "distance": (15.0, 18.0), "fewest": 50}, "distortion there is extrapolated"),
        ({"tilt": 0.06}, "directions differ by"),
        ({"count": 4}, "Only 4 views were used"),
        ({"count": 4, "tilt": 0.06}, "The focal length is only known to"),
        ({"reach": 0.15, "distance": (15.0, 18.0), "fewest": 50}, "directions are only good to"),
    ],
)
def test_poor_coverage_is_said(views: dict[str, float], words: str) -> None:
    found = calibrate(CORNERS, noisy(make_views(camera_of("OPENCV"), **views)), SIZE, "OPENCV")  # type: ignore[arg-type]
    warnings = judge(found, covered(found)).warnings
    assert any(words in sentence for sentence in warnings), warnings


def test_a_bad_board_is_said() -> None:
    """A board that is bent by a quarter of a square in its middle."""
    camera = camera_of("OPENCV")
    bent = CORNERS + [0, 0, 1] * (0.25 * np.sin(np.pi * CORNERS[:, :1] / 10))
    rng = np.random.default_rng(0)
    views = []
    for k in range(15):
        rotation = Rotation.from_rotvec(0.35 * rng.normal(size=3)).as_matrix()
        xy = camera.img_from_cam((bent - bent.mean(axis=0)) @ rotation.T + [0, 0, 10.0 + k % 3])
        views.append(View(name=str(k), corner_idxs=np.arange(len(CORNERS)), xy=xy))
    found = calibrate(CORNERS, noisy(views), SIZE, "OPENCV")
    # The focal length is off by many deviations, which are those of independent errors: that has to be said.
    assert abs(found.camera.focal_length_x - 900) > 5 * found.std[0]
    assert any("neighbouring corners are alike" in sentence for sentence in judge(found, covered(found)).warnings)


def test_a_model_with_too_few_parameters_is_said() -> None:
    views = noisy(make_views(camera_of("OPENCV")))
    found = calibrate(CORNERS, views, SIZE, "SIMPLE_RADIAL", max_view_error=100.0)
    assert any("neighbouring corners are alike" in sentence for sentence in judge(found, covered(found)).warnings)
    # Noise alone is not taken for it.
    assert abs(calibrate(CORNERS, views, SIZE, "OPENCV").correlation) < 0.15


def test_corners_that_only_one_view_sees() -> None:
    """COLMAP has no use for a point with one observation; a calibration has."""
    views = noisy(make_views(camera_of("PINHOLE"), 3, fewest=len(CORNERS)))
    parts = [
        replace(view, corner_idxs=view.corner_idxs[18 * v : 18 * v + 18], xy=view.xy[18 * v : 18 * v + 18])
        for v, view in enumerate(views)
    ]
    found = calibrate(CORNERS, parts, SIZE, "PINHOLE")
    assert (np.abs(found.camera.params - TRUTH["PINHOLE"]) < 4 * found.std).all()
    # The rows that each view has were fitted, not left out.
    assert found.rms_error < 2 * NOISE and 0.4 * NOISE < found.noise < 2 * NOISE


def test_coverage_is_counted_where_the_board_was() -> None:
    """One quarter of the image, seen twice."""
    camera = pycolmap.Camera(model="PINHOLE", width=1280, height=960, params=[900, 900, 640, 480])
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
    view = View(name="a", corner_idxs=np.arange(4), xy=np.array([[0, 0], [640, 0], [0, 480], [640, 480]], float))
    found = calibrate(CORNERS, noisy(make_views(camera)), SIZE, "PINHOLE")
    fit = replace(found.views[0], view=view)
    coverage = measure_coverage(replace(found, camera=camera, views=(fit, fit)), corners)
    assert coverage.area == pytest.approx(0.25, abs=0.01)
    assert coverage.counts.max() == 2
    half = np.hypot(640, 480)
    expected = [0, 640 / half, 480 / half, 1]
    np.testing.assert_allclose(coverage.corner_gaps, expected, atol=0.01)


def test_precision_is_infinite_where_the_distortion_turns_back() -> None:
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1280, height=960, params=[600, 640, 480, -0.3])
    pixels = np.array([[640.0, 480.0], [700.0, 500.0], [500.0, 300.0], [2.0, 2.0]])
    std = image_std(camera, np.diag([1.0, 0.01, 0.01, 1e-6]), pixels)
    assert np.isfinite(std[:3]).all() and np.isinf(std[3])


def test_the_picture_shows_where_the_board_was() -> None:
    """Its colours, not its looks: the stripes of what is bare are nowhere if all is covered."""
    found = calibrate(CORNERS, noisy(make_views(camera_of("OPENCV"))), SIZE, "OPENCV")
    coverage = covered(found)
    stripes = [
        np.mean((draw_coverage(found, replace(coverage, counts=counts)) == (196, 196, 232)).all(axis=2))
        for counts in (np.zeros_like(coverage.counts), coverage.counts, np.ones_like(coverage.counts))
    ]
    assert all(more > less for more, less in pairwise(stripes))
