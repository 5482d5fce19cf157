"""The paper's experiments: scenes against independent truth, results and their report, the command.

Small captures: what is shown is that figures are measured and reported rightly, not how accurate the methods are, nor
that findings of the paper hold.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import error_of
from scipy.optimize import minimize

from colmap_refract.cli import main
from colmap_refract.errors import RefractError
from colmap_refract.experiments import body, flat, mannequin, measure, methods, parallel, run, scenes, tables
from colmap_refract.experiments.results import Bound, Case, ExperimentResult, Fact, Finding, Run, judged, merged
from colmap_refract.interface import Array
from colmap_refract.simulation.scene import SceneOptions

SEEDS = (0, 1)
QUICK = ("SfM", "DfR", "DfR, plane known", "hard")


def quiet(_: str) -> None:
    pass


@pytest.fixture(scope="module")
def small() -> ExperimentResult:
    """The flat experiment with few markers and images."""
    return flat.run(SEEDS, quiet, markers=(6, 5), images=(6, 5, 5))


# --- Scenes. ---


def optical_length(center: Array, crossing: Array, point: Array, index: float) -> float:
    return float(np.linalg.norm(crossing - center) + index * np.linalg.norm(point - crossing))


@pytest.mark.parametrize("name", ["fixed camera", "static interface", "moving interface"])
def test_markers_are_seen_along_the_shortest_optical_path(name: str) -> None:
    """Fermat's principle, minimised without derivatives over places on the tank's front: neither Snell nor Newton."""
    setup = next(s for s in scenes.flat_setups(3, markers=(4, 3), images=(3, 3, 3)) if s.name == name)
    capture = setup.capture
    image = capture.reconstruction.image(2)
    normal, distance = capture.planes[2]
    e1, e2 = np.linalg.svd(normal[None])[2][1:]
    pose = image.cam_from_world()
    for k in (0, len(capture.pixels[2]) - 1):
        point = pose * capture.reconstruction.point3D(image.points2D[k].point3D_id).xyz

        def place(uv: Array) -> Array:
            return distance * normal + uv[0] * e1 + uv[1] * e2

        best = minimize(
            lambda uv, p=point: optical_length(np.zeros(3), place(uv), p, 1.333), [0.0, 0.0], method="Nelder-Mead",
            options={"xatol": 1e-9, "fatol": 1e-15},
        )  # fmt: skip
        seen = image.camera.img_from_cam(place(best.x)[None])[0]
        # A length is flat at its minimum: rounding of 1e-16 leaves 1e-8 m, which is 3e-5 px.
        np.testing.assert_allclose(capture.pixels[2][k], seen, atol=1e-3)


def test_boards_are_flat_and_as_large_as_they_are_said_to_be() -> None:
    for setup in [*scenes.flat_setups(0), *scenes.wavy_setups(0, inclinations=1, images=(5, 5, 5))]:
        points = np.array([p.xyz for _, p in sorted(setup.capture.reconstruction.points3D.items())])
        assert len(points) == 130
        centred = points - points.mean(axis=0)
        assert np.linalg.svd(centred)[1][2] < 1e-9
        assert np.linalg.norm(points[12] - points[0]) == pytest.approx(0.48)
        assert np.linalg.norm(points[-13] - points[0]) == pytest.approx(0.36)


def test_a_dry_picture_shows_straight_rays() -> None:
    setup = scenes.flat_setups(1, markers=(4, 3), images=(2, 2, 2))[0]
    assert setup.dry is not None
    true = setup.dry.reconstruction
    image = true.image(1)
    ids = [p.point3D_id for p in image.points2D]
    straight = image.camera.img_from_cam(np.array([image.cam_from_world() * true.point3D(i).xyz for i in ids]))
    np.testing.assert_allclose(setup.dry.pixels[1], straight, atol=1e-9)
    # The same points have the same ids under water, and are seen elsewhere: more than a few pixels at the edge.
    wet = methods.keypoints_of(setup.capture, 1)
    assert set(ids) == set(wet)
    assert max(np.linalg.norm(wet[i] - straight[k]) for k, i in enumerate(ids)) > 5


def test_frames_of_an_inclination_share_the_mean_plane_but_not_the_waves() -> None:
    setup = scenes.brick_setup(0, inclinations=2, frames=3, num_points=24)
    assert setup.groups is not None
    capture = setup.capture
    images = capture.reconstruction.images
    by_group: dict[str, list[int]] = {}
    for image_id in sorted(images):
        by_group.setdefault(setup.groups[images[image_id].name], []).append(image_id)
    assert [len(ids) for ids in by_group.values()] == [3, 3]
    for ids in by_group.values():
        for image_id in ids[1:]:
            np.testing.assert_array_equal(capture.planes[image_id][0], capture.planes[ids[0]][0])
            assert not np.array_equal(capture.surfaces[image_id].waves, capture.surfaces[ids[0]].waves)
    first, second = (capture.planes[ids[0]][0] for ids in by_group.values())
    assert first @ second < 1 - 1e-6


def test_pool_waves_have_the_generators_period_in_deep_water() -> None:
    """omega^2 = g k: the frequency of a wave of the length that the scene has, without the function under test."""
    still, wavy = scenes.pool_setups(0, num_images=3, num_points=60)
    assert not len(still.capture.surfaces[1].waves)
    phases = set()
    for surface in wavy.capture.surfaces.values():
        ((kx, ky, amplitude, phase),) = surface.waves
        assert np.sqrt(9.81 * np.hypot(kx, ky)) == pytest.approx(2 * np.pi / 1.0)
        assert amplitude == scenes.WAVE_AMPLITUDE
        phases.add(phase)
    assert len(phases) == 3
    depths = np.array([p.xyz[2] for p in wavy.capture.reconstruction.points3D.values()])
    # Camera 0.6 m above 1.8 m of water: the floor, a table 0.6 m above it, a basket 0.3 m above that.
    assert depths.max() == pytest.approx(2.4)
    assert depths.min() >= 1.5
    assert np.isclose(depths, 1.8).sum() > 10


def test_given_stations_and_waves_must_be_as_many_as_images() -> None:
    options = SceneOptions(scenario="static_interface", num_images=2)
    stand = scenes.Stand(rotation=np.eye(3), center=np.zeros(3), normal=np.array([0.0, 0, 1]), offset=0.5)
    points = np.array([[0.0, 0, 1], [0.1, 0, 1], [0, 0.1, 1]])
    assert "2 images" in error_of(lambda: scenes.photograph_stands(options, points, [stand]))
    waves = [np.empty((0, 4))]
    assert "waves of 1 frames" in error_of(
        lambda: scenes.photograph_stands(options, points, [stand, stand], waves=waves)
    )


def test_the_body_is_as_deep_as_it_is_said_to_be_and_its_water_sways() -> None:
    session = body.swaying_tank(0, num_frames=120, width=160)
    heights = session.truth.terrain.heights
    assert heights.max() == pytest.approx(body.FLOOR)
    assert heights.min() == pytest.approx(body.FLOOR - body.BODY_DEPTH)
    # Nothing of it reaches the water, however that tilts.
    normals = np.array([view.surface.normal for view in session.truth.views])
    tilt = np.degrees(np.arccos(normals[:, 2]))
    assert np.sqrt(np.mean(tilt**2)) == pytest.approx(8.0, rel=0.02)
    lowest = body.LEVEL + 0.01 + 0.5 * np.tan(np.radians(tilt.max()))
    assert heights.min() > lowest
    # A camera at rest: nothing but the water moves.
    assert len({view.cam_from_world.tobytes() for view in session.truth.views}) == 1
    first, later = normals[0], normals[5]
    assert np.degrees(np.arccos(first @ later)) > 1


def test_a_mesh_that_is_moved_along_the_view_is_off_by_that_and_holes_are_no_mesh() -> None:
    session = body.swaying_tank(0, num_frames=2, width=160)
    terrain = session.truth.terrain
    x, y = np.meshgrid(np.arange(-0.4, 0.4, 0.002), np.arange(-0.3, 0.3, 0.002))
    places = np.column_stack([x.ravel(), y.ravel()])
    vertices = np.column_stack([places, terrain.height(places) + 0.001])
    vertices = vertices[np.linalg.norm(vertices[:, :2], axis=1) > 0.05]
    view = SimpleNamespace(margin=8, colours=np.full((len(vertices), 3), 7, np.uint8))
    found = mannequin._compared(session, "frame_0001.jpg", vertices, view, vertices)
    assert found.seen.mean() > 0.9
    errors = found.errors[found.seen]
    hole = np.pi * (0.05 - mannequin._GAP) ** 2 / (found.seen.sum() * (found.x[1] - found.x[0]) ** 2)
    assert np.isnan(errors).mean() == pytest.approx(hole, rel=0.2)
    # Moved along z, so by less along the normal of a slope; a chord between vertices is off by less than 0.1 mm.
    x, y = np.meshgrid(found.x, found.y)
    kept = found.seen & np.isfinite(found.errors) & (np.hypot(x, y) > 0.055)
    steepness = np.linalg.norm(terrain.gradient(np.column_stack([x[kept], y[kept]])), axis=1)
    np.testing.assert_allclose(found.errors[kept] * np.hypot(1, steepness), 1e-3, atol=1e-4)


# --- Measuring. ---


def test_every_method_and_bound_is_there_for_every_seed(small: ExperimentResult) -> None:
    assert small.scenarios == ("fixed camera", "static interface", "moving interface")
    assert {run.seed for run in small.runs} == set(SEEDS)
    for scenario in small.scenarios:
        assert len([b for b in small.bounds if b.scenario == scenario]) == len(SEEDS)
        assert len(small.of(Case(scenario=scenario, method="hard"))) == len(SEEDS)
    # COLMAP has nothing to say of a camera that does not move, and the others nothing of one that does.
    assert not small.of(Case(scenario="fixed camera", method="SfM"))
    assert not small.of(Case(scenario="static interface", method="DfT"))
    for done in small.runs:
        assert done.failed or (done.rmse >= done.median * 0.5 and 0 <= done.outliers <= 1 and 0 < done.kept <= 1)


def test_the_same_seed_has_the_same_result(small: ExperimentResult) -> None:
    again = flat.run(SEEDS[:1], quiet, markers=(6, 5), images=(6, 5, 5))
    first = [run for run in small.runs if run.seed == SEEDS[0]]
    assert [(r.scenario, r.method) for r in again.runs] == [(r.scenario, r.method) for r in first]
    np.testing.assert_array_equal([r.rmse for r in again.runs], [r.rmse for r in first])


def test_errors_are_those_after_a_similarity() -> None:
    """Truth moved by a similarity is without error; one point moved aside has about that error."""
    setup = scenes.flat_setups(0, markers=(6, 5), images=(2, 2, 2))[0]
    true = methods.points_of(setup.capture.reconstruction)
    turn = scenes.turned(np.array([0.3, -0.5, 0.2]))
    moved = {i: 3.0 * turn @ xyz + [1.0, 2.0, 3.0] for i, xyz in true.items()}

    def judged_as(points: dict[int, Array]) -> Run:
        method = methods.Method(name="m", text="", given="", estimate=lambda _: methods.Estimate(points=points))
        return measure.attempt(method, setup, 0, 0.05)[0]

    assert judged_as(moved).rmse < 1e-12
    ids = sorted(moved)
    shifted = {**moved, ids[0]: moved[ids[0]] + 3.0 * np.array([0.0, 0.0, 0.1])}
    off = judged_as(shifted)
    # 0.1 m of one point in 30, less what the alignment takes up.
    assert 0.5 * 0.1 / np.sqrt(30) < off.rmse <= 0.1 / np.sqrt(30)
    assert off.outliers == pytest.approx(1 / 30)
    del shifted[ids[1]], shifted[ids[2]]
    assert judged_as(shifted).kept == pytest.approx(28 / 30)
    few = judged_as({ids[0]: moved[ids[0]]})
    assert few.failed
    assert "three are needed" in few.failure


def test_a_thinned_capture_has_the_bound_of_the_whole() -> None:
    """Four frames per inclination and eight: the information is in proportion, so both tell the same bound."""
    whole = scenes.brick_setup(0, inclinations=3, frames=8, num_points=24)
    thinned = measure.bound_of(whole, 0).rmse
    direct = measure.bound_of(replace(whole, thinned=None), 0).rmse
    assert thinned == pytest.approx(direct, rel=1e-3)


def doubled(value: int, say: Callable[[str], None]) -> int:
    say(f"doubling {value}")
    if value < 0:
        raise RefractError(f"{value} is negative: give another")
    return 2 * value


def test_tasks_beside_each_other_keep_their_order_and_their_words() -> None:
    said: list[str] = []
    tasks = [partial(doubled, value) for value in range(5)]
    assert parallel.together(tasks, 2, said.append) == [0, 2, 4, 6, 8]
    assert any("doubling" in text for text in said)
    assert parallel.together(tasks, 1, said.append) == [0, 2, 4, 6, 8]
    assert "-1 is negative" in error_of(lambda: parallel.together([partial(doubled, v) for v in (1, -1)], 2, quiet))


def test_results_of_seeds_make_one(small: ExperimentResult) -> None:
    parts = [
        replace(
            small, runs=[r for r in small.runs if r.seed == seed], bounds=[b for b in small.bounds if b.seed == seed],
            facts=[Fact(text="t", value=f"{seed}")],
        )
        for seed in SEEDS
    ]  # fmt: skip
    whole = merged(parts)
    for case in {(r.scenario, r.method) for r in small.runs}:
        key = Case(scenario=case[0], method=case[1])
        np.testing.assert_array_equal(whole.values(key), small.values(key))
    assert [whole.bound(s) for s in small.scenarios] == [small.bound(s) for s in small.scenarios]
    assert whole.facts == [Fact(text="t", value="0; 1")]


# --- What is said. ---


def a_result(better: list[float], worse: list[float]) -> ExperimentResult:
    runs = [
        Run(scenario="s", method=method, seed=seed, rmse=value, median=value, outliers=0.0, kept=1.0, seconds=1.0,
            failure="" if np.isfinite(value) else "it | stopped")
        for method, values in (("a", better), ("b", worse))
        for seed, value in enumerate(values)
    ]  # fmt: skip
    return ExperimentResult(
        name="x", title="X", text="", view="plan", outlier_limit=0.01, scenarios=("s",), methods=("a", "b"),
        described=(), runs=runs, bounds=[Bound(scenario="s", seed=0, rmse=1e-3)],
    )  # fmt: skip


def test_what_differs_from_the_paper_is_said() -> None:
    finding = Finding(
        text="a is better than b", better=Case(scenario="s", method="a"), worse=Case(scenario="s", method="b")
    )
    assert judged(finding, a_result([1e-3], [2e-3])) == "The paper: a is better than b. Here, too: 1 against 2 mm."
    assert "otherwise: 2 against 1 mm" in judged(finding, a_result([2e-3], [1e-3]))
    assert "hardly differ: 1 against 1.02 mm" in judged(finding, a_result([1e-3], [1.02e-3]))
    assert "cannot be compared: a has no result, b has 1 mm" in judged(finding, a_result([np.nan], [1e-3]))


def test_failures_are_counted_and_told() -> None:
    result = a_result([1e-3, np.nan, 3e-3], [np.nan] * 3)
    first, second = tables.rows(result)
    assert first[2] == "2 (1 - 3)"
    assert first[-1] == "1 of 3"
    assert (second[2], second[-1]) == ("-", "3 of 3")
    assert tables.remarks(result) == [
        "s, a, seed 1: failed: it | stopped", "s, b, seed 0, 1, 2: failed: it | stopped",
    ]  # fmt: skip
    assert "it / stopped" in tables.markdown(("what",), [["it | stopped"]])


class Links(HTMLParser):
    """What a page refers to, the alternative texts of its images, and the cells of its tables."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.alternatives: list[str | None] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        given = dict(attrs)
        self.targets += [v for k in ("src", "href", "data", "srcset") if (v := given.get(k)) is not None]
        if tag == "img":
            self.alternatives.append(given.get("alt"))


def test_the_report_has_the_numbers_and_is_self_contained(small: ExperimentResult, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    run.write([small], run.Request(only=("flat",), num_seeds=2), "colmap-refract experiments", tmp_path, quiet)
    numbers = json.loads((tmp_path / "results.json").read_text())["flat"]
    assert [r["rmse"] for r in numbers["runs"]] == [None if r.failed else r.rmse for r in small.runs]
    page, text = ((tmp_path / name).read_text() for name in ("index.html", "results.md"))
    for case in {(r.scenario, r.method) for r in small.runs}:
        values = [1e3 * r["rmse"] for r in numbers["runs"] if (r["scenario"], r["method"]) == case and r["rmse"]]
        shown = f"{np.median(values):.3g}"
        shown += f" ({min(values):.3g} - {max(values):.3g})" if len(values) > 1 else ""
        assert f"| {case[0]} | {case[1]} | {shown} |" in text
        assert f"<td>{case[0]}</td><td>{case[1]}</td><td>{shown}</td>" in page

    links = Links()
    links.feed(page)
    assert all(target.startswith(("data:image/", "#")) for target in links.targets)
    assert len([t for t in links.targets if t.startswith("data:")]) == 2
    assert all(links.alternatives)
    assert not links.tags & {"script", "link", "iframe"}
    assert not re.search(r"url\(|@import", page)

    # The bars' numbers are drawn as they are in the table.
    from matplotlib.figure import Figure

    from colmap_refract.experiments import charts

    written: list[str] = []

    def keep(figure: Figure, form: str) -> bytes:
        written.extend(t.get_text() for axes in figure.axes for t in axes.texts)
        return b""

    original, charts._written = charts._written, keep
    try:
        charts.bars(small)
    finally:
        charts._written = original
    for row in tables.rows(small):
        assert row[2].split(" ")[0] in written


def test_charts_are_the_same_for_the_same_result(small: ExperimentResult) -> None:
    pytest.importorskip("matplotlib")
    from colmap_refract.experiments import charts

    assert charts.bars(small) == charts.bars(small)


# --- The command. ---


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--only", "flat,wave"), "there is no experiment 'wave': choose among flat, wavy"),
        (("--only", ","), "no experiment is named"),
        (("--seeds", "0"), "seeds 0"),
        (("--seeds", "-2"), "seeds -2"),
        (("--num_threads", "0"), "num_threads 0"),
    ],
)
def test_what_makes_no_sense_is_one_clear_line(
    arguments: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["experiments", "--output_path", str(tmp_path / "out"), *arguments]) == 1
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def small_experiment(monkeypatch: pytest.MonkeyPatch, result: Callable[[], ExperimentResult]) -> None:
    monkeypatch.setattr(run, "experiment", lambda name: lambda seeds, say: result())


def test_the_command_writes_all_or_nothing(
    small: ExperimentResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    command = ["experiments", "--output_path", str(out), "--only", "flat", "--seeds", "2", "--num_threads", "1"]

    def interrupted() -> ExperimentResult:
        raise KeyboardInterrupt

    small_experiment(monkeypatch, interrupted)
    assert main(command) == 130
    assert list(tmp_path.iterdir()) == []
    capsys.readouterr()

    small_experiment(monkeypatch, lambda: small)
    assert main(command) == 0
    assert "RMSE" in capsys.readouterr().out
    assert {p.name for p in out.iterdir()} == {
        "index.html", "results.md", "results.json", "flat_rmse.svg", "flat_points.png",
    }  # fmt: skip
    before = (out / "results.json").read_bytes()
    assert main(command) == 1
    assert "not empty" in capsys.readouterr().err
    assert (out / "results.json").read_bytes() == before
    assert main([*command, "--overwrite", "1"]) == 0


def test_without_matplotlib_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["experiments", "--output_path", str(tmp_path / "out")]) == 1
    assert 'pip install "colmap-refract[experiments]"' in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
