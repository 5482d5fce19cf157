"""Frames are made here from a smooth random picture by known maps, so that it is known where each point went.

A frame is g(y) of the reference at each of its pixels y; the truth of a point x solves g(y) = x. What the pictures
do not show: caustics, reflections that move otherwise than the ground, and points that hide each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.optical_flow.estimate import affine_start
from colmap_refract.optical_flow.field import fit_field
from colmap_refract.optical_flow.frame import MIN_TRACKS, track_frame
from colmap_refract.optical_flow.options import FlowMethod, FlowOptions
from colmap_refract.optical_flow.pictures import correlation, level, match_sharpness
from colmap_refract.optical_flow.reference import choose_reference, find_corners
from colmap_refract.optical_flow.tracking import FlowTracks, track_against_reference

Gray = NDArray[np.uint8]
Array = NDArray[np.float64]
WIDTH, HEIGHT, MARGIN = 480, 360, 160
METHODS: tuple[FlowMethod, ...] = ("dense", "features")


def texture(seed: int) -> NDArray[np.float32]:
    """Grey values on several scales, with a margin on all sides."""
    rng = np.random.default_rng(seed)
    total = np.zeros((HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN), np.float32)
    for sigma, weight in ((1.2, 1.0), (2.5, 1.0), (5, 1.0), (12, 1.0), (30, 1.5)):
        layer = cv2.GaussianBlur(rng.standard_normal(total.shape).astype(np.float32), (0, 0), sigma)
        total += np.float32(weight / layer.std()) * layer
    return np.asarray(128 + 45 * total / total.std())


@dataclass(frozen=True)
class Warp:
    """A tilt and waves: g(y), from a frame's pixels to the reference's (centre of the first pixel at (0, 0))."""

    shift: tuple[float, float] = (0.0, 0.0)
    strain: float = 0.0
    wave: float = 0.0
    """Amplitude, pixels, of two waves a third of the picture long."""

    def __call__(self, y: Array) -> Array:
        centre = np.array([WIDTH, HEIGHT]) / 2
        stretch = np.eye(2) + self.strain * np.array([[1.0, 0.4], [-0.5, -0.8]])
        x = (y - centre) @ stretch.T + centre - self.shift
        for k, direction, push in ((0.3, (0.8, 0.6), (1.0, -0.4)), (1.9, (-0.5, 0.86), (0.3, 0.9))):
            phase = 2 * np.pi / (WIDTH / 3) * (y @ np.array(direction)) + k
            x = x + self.wave * np.sin(phase)[..., None] * np.array(push)
        return x

    def forth(self, x: Array) -> Array:
        """The y with g(y) = x, by a fixed point."""
        y = x.copy()
        for _ in range(100):
            y = y - (self(y) - x)
        assert np.abs(self(y) - x).max() < 1e-9
        return y

    def frame(
        self, picture: NDArray[np.float32], seed: int, *, blur: float = 0.8, noise: float = 2.0, gain: float = 1.0
    ) -> Gray:
        places = self(np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).astype(float)) + MARGIN
        x, y = (np.ascontiguousarray(places[..., k], np.float32) for k in (0, 1))
        values = cv2.GaussianBlur(cv2.remap(picture, x, y, cv2.INTER_LANCZOS4), (0, 0), blur) * gain
        values = values + np.random.default_rng(seed).normal(0, noise, values.shape)
        return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


PICTURE = texture(1)
REFERENCE = Warp().frame(PICTURE, 100)
OPTIONS = FlowOptions(max_num_points=500)


def errors_of(warp: Warp, frame: Gray, options: FlowOptions, reference: Gray = REFERENCE) -> tuple[Array, float, Array]:
    """Errors (n,) of the tracks, the part of the points in sight that is kept, and the true places."""
    points = find_corners(reference, options)
    truth = warp.forth(points)
    # Squares that are partly outside of the frame cannot be compared.
    edge = options.half_window + 1
    in_sight = ((truth >= edge) & (truth <= np.array([WIDTH, HEIGHT]) - 1 - edge)).all(axis=1)
    assert in_sight.sum() > 150
    rows, found, _ = track_frame(reference, frame, points, options)
    kept = np.zeros(len(points), dtype=bool)
    kept[rows] = True
    return np.linalg.norm(found - truth[rows], axis=1), float(kept[in_sight].mean()), truth[rows]


# Noise of 2 grey values on this texture makes 0.03 px in a square of 21 px; the rest is what the square averages
# over where waves stretch it, and what blur takes of the texture. Plain Lucas-Kanade tracks have 0.1 to 0.6 px.
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("warp", "blur", "gain", "rms"),
    [
        (Warp(), 0.8, 1.0, 0.06),
        (Warp(shift=(0.7, -0.6)), 0.8, 1.0, 0.06),
        (Warp(shift=(16.0, -12.0), strain=0.02, wave=1.0), 0.8, 1.0, 0.08),
        (Warp(shift=(-16.0, 12.0), strain=0.02, wave=2.5), 1.4, 0.75, 0.15),
        # 15 and 20 % of the width
        (Warp(shift=(58.0, 43.0), strain=0.05, wave=2.0), 0.8, 1.0, 0.1),
        (Warp(shift=(-96.0, 5.0), strain=0.05, wave=2.0), 1.4, 1.2, 0.15),
    ],
    ids=["same", "1 px", "20 px", "20 px, dim and blurred", "15 %", "20 %, bright and blurred"],
)
def test_tracks_are_where_the_points_went(method: FlowMethod, warp: Warp, blur: float, gain: float, rms: float) -> None:
    frame = warp.frame(PICTURE, 7, blur=blur, gain=gain)
    errors, kept, _ = errors_of(warp, frame, FlowOptions(method=method, max_num_points=500))
    assert np.sqrt((errors**2).mean()) < rms
    assert errors.max() < 1.0
    assert kept > 0.9


def test_deformation_does_not_bias() -> None:
    """A square that is stretched about one corner of it moves as a whole: this is what pulling straight avoids."""
    warp = Warp(strain=0.1)
    points = find_corners(REFERENCE, OPTIONS)
    frame = warp.frame(PICTURE, 7, noise=0.5)
    plain, _, _ = cv2.calcOpticalFlowPyrLK(REFERENCE, frame, points.astype(np.float32), None)
    errors, _, _ = errors_of(warp, frame, OPTIONS)
    plain_errors = np.linalg.norm(plain - warp.forth(points), axis=1)
    assert np.median(errors) < 0.5 * np.median(plain_errors)
    assert np.sqrt((errors**2).mean()) < 0.08


@pytest.mark.parametrize("method", METHODS)
def test_what_covers_the_scene_is_not_tracked(method: FlowMethod) -> None:
    warp = Warp(shift=(9.0, 5.0), strain=0.02, wave=1.0)
    frame = warp.frame(PICTURE, 7)
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    patch = ((x - 180) / 80) ** 2 + ((y - 170) / 60) ** 2 < 1
    sparks = np.random.default_rng(3).random(frame.shape) < 0.03
    glitter = cv2.GaussianBlur(np.where(sparks, 4000.0, 0.0).astype(np.float32), (0, 0), 1.5)
    frame[patch] = np.clip(frame[patch] + glitter[patch], 0, 255).astype(np.uint8)
    options = FlowOptions(method=method, max_num_points=500)
    points = find_corners(REFERENCE, options)
    covered = (((warp.forth(points) - (180, 170)) / (70, 50)) ** 2).sum(axis=1) < 1
    assert covered.sum() > 20
    rows, found, flow = track_frame(REFERENCE, frame, points, options)
    assert covered[rows].sum() <= 0.05 * covered.sum()
    wrong = np.linalg.norm(found - warp.forth(points)[rows], axis=1) > 1
    assert wrong.sum() <= 0.01 * len(rows)
    # And nothing else is lost.
    assert flow.num_tracks > 0.6 * len(points)


def test_another_picture_is_lost_not_tracked() -> None:
    points = find_corners(REFERENCE, OPTIONS)
    for frame in (Warp().frame(texture(2), 7), np.full_like(REFERENCE, 90), np.zeros_like(REFERENCE)):
        rows, found, flow = track_frame(REFERENCE, frame, points, OPTIONS)
        assert len(rows) == len(found) == flow.num_tracks == 0
        assert np.isnan(flow.length)


def test_affine_start_of_large_shifts() -> None:
    """To a few pixels, from which the flow finds the rest; opposite directions, so that a sign error shows."""
    middle = np.array([[240.0, 180.0]])
    for shift in ((90.0, 20.0), (-90.0, -20.0), (15.0, 80.0)):
        warp = Warp(shift=shift, strain=0.03, wave=2.0)
        affine = affine_start(REFERENCE, warp.frame(PICTURE, 7))
        assert np.linalg.norm(middle @ affine[:, :2].T + affine[:, 2] - warp.forth(middle)) < 6
    assert np.array_equal(affine_start(REFERENCE, Warp().frame(texture(2), 7)), np.eye(2, 3))


def test_corners_are_everywhere_and_as_many_as_asked_for() -> None:
    """A part of strong contrast, such as a reflection, must not take them all."""
    picture = REFERENCE.copy()
    picture[:, : WIDTH // 2] = 118 + picture[:, : WIDTH // 2] // 12
    corners = find_corners(picture, OPTIONS)
    assert len(corners) == OPTIONS.max_num_points
    assert len(np.unique(corners, axis=0)) == len(corners)
    assert 0.3 < (corners[:, 0] < WIDTH // 2).mean() < 0.7
    cells = np.floor(corners / 60).astype(int)
    assert len(np.unique(cells, axis=0)) == (WIDTH // 60) * (HEIGHT // 60)


def test_field_is_exact_where_affine_and_forgets_outliers() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1, (600, 2)) * (WIDTH, HEIGHT)
    slope, constant = np.array([[0.05, -0.02], [0.01, 0.03]]), np.array([12.0, -7.0])
    given = points @ slope.T + constant
    wrong = rng.random(len(points)) < 0.1
    given[wrong] += rng.uniform(-30, 30, (wrong.sum(), 2))
    field = fit_field(points, given, (HEIGHT, WIDTH), spacing=12)
    asked = rng.uniform(0.05, 0.95, (300, 2)) * (WIDTH, HEIGHT)
    errors = np.linalg.norm(field.at(asked) - (asked @ slope.T + constant), axis=1)
    # The outliers are 23 px in the mean; what they move a field that is exactly affine by is far below a pixel.
    assert np.percentile(errors, 99) < 0.1


def test_straightened_frames_are_like_the_reference() -> None:
    warp = Warp(shift=(12.0, 8.0), strain=0.03, wave=2.0)
    pixels = np.stack(np.meshgrid(np.arange(5.0, WIDTH, 10), np.arange(5.0, HEIGHT, 10)), axis=-1).reshape(-1, 2)
    field = fit_field(pixels, warp.forth(pixels) - pixels, (HEIGHT, WIDTH), spacing=12)
    straight = field.straighten(warp.frame(PICTURE, 7, noise=0))
    inner = np.s_[40:-40, 40:-40]
    assert np.corrcoef(straight[inner].ravel(), REFERENCE[inner].ravel())[0, 1] > 0.98


def test_levelling_takes_out_the_light() -> None:
    x = np.linspace(0.5, 1.0, WIDTH)
    dim = np.rint(REFERENCE * x).astype(np.uint8)
    before = np.abs(REFERENCE.astype(float) - dim).mean()
    after = np.abs(level(REFERENCE, 10).astype(float) - level(dim, 10)).mean()
    assert after < 0.15 * before


def test_correlation_is_numpys() -> None:
    points = np.array([[100.0, 100.0], [200.0, 50.0], [300.0, 200.0]])
    other = points + (3, -2)
    half = 5
    expected = []
    for (x, y), (u, v) in zip(points.astype(int), other.astype(int), strict=True):
        a, b = (REFERENCE[q - half : q + half + 1, p - half : p + half + 1].ravel() for p, q in ((x, y), (u, v)))
        expected.append(np.corrcoef(a, b)[0, 1])
    np.testing.assert_allclose(correlation(REFERENCE, REFERENCE, points, other, half), expected, atol=1e-5)
    assert not correlation(np.zeros_like(REFERENCE), REFERENCE, points, points, half).any()


@pytest.mark.parametrize("first_is_sharp", [True, False])
def test_the_sharper_picture_is_blurred(first_is_sharp: bool) -> None:
    sharp, soft = Warp().frame(PICTURE, 5, blur=0.8), Warp().frame(PICTURE, 6, blur=2.0)
    points = find_corners(REFERENCE, OPTIONS)
    given = (sharp, soft) if first_is_sharp else (soft, sharp)
    matched = match_sharpness(*given, points, 10)
    changed, kept = (0, 1) if first_is_sharp else (1, 0)
    assert np.array_equal(matched[kept], given[kept])
    before, after = (np.abs(a.astype(float) - b).mean() for a, b in (given, matched))
    assert after < 0.6 * before
    assert not np.array_equal(matched[changed], given[changed])


def many(frames: dict[str, Gray]) -> Callable[[str], Gray]:
    return frames.__getitem__


@pytest.fixture(scope="module")
def warps() -> dict[str, Warp]:
    return {
        "left.png": Warp(shift=(-8.0, 3.0), strain=0.01, wave=1.0),
        "reference.png": Warp(),
        "right.png": Warp(shift=(10.0, 2.0), strain=-0.02, wave=1.0),
    }


@pytest.fixture(scope="module")
def frames(warps: dict[str, Warp]) -> dict[str, Gray]:
    shots = {name: warp.frame(PICTURE, 7 + k) for k, (name, warp) in enumerate(warps.items())}
    return {**shots, "strange.png": Warp().frame(texture(2), 9)}


@pytest.fixture(scope="module")
def tracks(frames: dict[str, Gray]) -> FlowTracks:
    return track_against_reference(many(frames), list(frames), "reference.png", OPTIONS)


def test_tracks_are_in_colmaps_pixels(tracks: FlowTracks, warps: dict[str, Warp]) -> None:
    assert set(tracks.matches) == {("reference.png", "left.png"), ("reference.png", "right.png")}
    for (reference, name), pairs in tracks.matches.items():
        first, second = tracks.keypoints[reference][pairs[:, 0]], tracks.keypoints[name][pairs[:, 1]]
        # Half a pixel is ten times what is allowed in the mean, which noise does not move.
        offset = (second - (warps[name].forth(first - 0.5) + 0.5)).mean(axis=0)
        assert np.abs(offset).max() < 0.05
        assert len(pairs) == len(tracks.keypoints[name]) > 300
    # Corners are at pixel centres, which COLMAP's origin puts at halves.
    assert np.array_equal(tracks.keypoints["reference.png"] % 1, np.full_like(tracks.keypoints["reference.png"], 0.5))


def test_every_keypoint_of_the_reference_has_a_match(tracks: FlowTracks) -> None:
    rows = np.concatenate([pairs[:, 0] for pairs in tracks.matches.values()])
    assert np.array_equal(np.unique(rows), np.arange(len(tracks.keypoints["reference.png"])))


def test_lost_frames_are_named(tracks: FlowTracks) -> None:
    assert tracks.lost == ["strange.png"]
    assert "strange.png" not in tracks.keypoints
    right = tracks.frames["right.png"]
    assert right.num_points == OPTIONS.max_num_points
    assert right.num_tracks == len(tracks.keypoints["right.png"])
    assert 5 < right.length < 15
    assert right.error < 0.1


def test_the_reference_is_in_the_middle() -> None:
    """Of frames that are shifted along a line, the least different one, and not the blurred or the black one."""
    shots = {f"{k}.png": Warp(shift=(6.0 * k, 0.0)).frame(PICTURE, k) for k in range(7)}
    shots["blurred.png"] = Warp(shift=(18.0, 0.0)).frame(PICTURE, 8, blur=4)
    shots["black.png"] = np.zeros_like(REFERENCE)
    assert choose_reference(many(shots), list(shots)) in ("2.png", "3.png", "4.png")


def test_bad_input_is_one_clear_line(frames: dict[str, Gray]) -> None:
    names = list(frames)
    with pytest.raises(RefractError, match="no image 'referense.png'.*'reference.png'"):
        track_against_reference(many(frames), names, "referense.png", OPTIONS)
    with pytest.raises(RefractError, match="one frame only"):
        track_against_reference(many(frames), names[:1], names[0], OPTIONS)
    with pytest.raises(RefractError, match="one frame only"):
        choose_reference(many(frames), names[:1])
    flat = {**frames, "flat.png": np.full_like(REFERENCE, 128)}
    with pytest.raises(RefractError, match=f"'flat.png' has 0 corners.*{MIN_TRACKS} are needed"):
        track_against_reference(many(flat), list(flat), "flat.png", OPTIONS)
    with pytest.raises(RefractError, match="nothing could be tracked from 'strange.png'"):
        track_against_reference(many(frames), names, "strange.png", OPTIONS)
    small = {**frames, "small.png": REFERENCE[:, :-10].copy()}
    with pytest.raises(RefractError, match="'small.png'.* 470 x 360"):
        track_against_reference(many(small), ["reference.png", "small.png"], "reference.png", OPTIONS)
    tiny = {name: REFERENCE[:12, :9].copy() for name in ("a", "b")}
    with pytest.raises(RefractError, match="corners"):
        track_against_reference(many(tiny), ["a", "b"], "a", OPTIONS)


@pytest.mark.parametrize(
    "wrong",
    [{"max_num_points": 0}, {"window_size": 3}, {"window_size": 500}, {"max_error": 0.0}, {"min_correlation": 1.0}],
    ids=str,
)
def test_options_out_of_range(wrong: dict[str, float]) -> None:
    with pytest.raises(RefractError, match=next(iter(wrong))):
        FlowOptions(**wrong)


@pytest.mark.parametrize("method", METHODS)
def test_steep_waves_lose_some_and_do_not_mislead(method: FlowMethod) -> None:
    """Lengths change by half within a wave: the first flow fails in places, and squares average over a lot."""
    warp = Warp(shift=(10.0, -8.0), strain=0.02, wave=13.0)
    pixels = np.random.default_rng(0).uniform(0, 1, (1000, 2)) * (WIDTH, HEIGHT)
    columns = [(warp(pixels + step) - warp(pixels - step)) / 2 for step in np.eye(2)]
    lengths = np.linalg.svd(np.stack(columns, axis=-1), compute_uv=False)
    assert np.percentile(lengths, 98) > 1.4 and np.percentile(lengths, 2) < 0.6
    points = find_corners(REFERENCE, OPTIONS)
    options = FlowOptions(method=method, max_num_points=OPTIONS.max_num_points)
    rows, found, _ = track_frame(REFERENCE, warp.frame(PICTURE, 7), points, options)
    # g is compared, as its fixed point does not converge here.
    errors = np.linalg.norm(warp(found) - points[rows], axis=1)
    assert len(rows) > 0.6 * len(points)
    assert np.median(errors) < 0.4
    assert (errors > 1).mean() < 0.08


def test_narrow_and_even_windows_track_as_well() -> None:
    warp = Warp(shift=(10.0, 2.0), strain=0.02)
    frame = warp.frame(PICTURE, 7)
    for window in (9, 20, 41):
        errors, kept, _ = errors_of(warp, frame, FlowOptions(window_size=window, max_num_points=300))
        assert np.sqrt((errors**2).mean()) < 0.15
        assert kept > 0.8
