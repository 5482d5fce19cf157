"""The command line: what it writes and says, and that whatever is wrong costs one line and nothing else."""

from __future__ import annotations

import os
import pty
import re
import resource
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from conftest import Scene, Scenes

import colmap_refract
from colmap_refract.cli import main
from colmap_refract.files.sidecar import read_sidecar
from colmap_refract.simulation import SceneOptions, simulate

FIVE = {f"{name}.bin" for name in ("cameras", "images", "points3D", "rigs", "frames")}
OUTPUT = {*FIVE, "refraction.json"}
COMMAND = [sys.executable, "-m", "colmap_refract.cli"]
TIMEOUT = 120


def snapshot(folder: Path) -> dict[str, bytes]:
    """Every file and folder below `folder`, hidden ones included."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"folder" for p in sorted(folder.rglob("*"))}


@pytest.fixture(scope="session")
def scene(scenes: Scenes) -> Scene:
    """Solved once in this process, so that whatever is compiled is compiled and stored."""
    scene = scenes("static_interface", num_images=10, num_points=120)
    assert scene.refined.converged
    return scene


@pytest.fixture(scope="session")
def pristine(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pristine")
    scene.model.write_binary(folder)
    return folder


@pytest.fixture
def model(pristine: Path, tmp_path: Path) -> Path:
    """A folder with the model, to be read or damaged."""
    return Path(shutil.copytree(pristine, tmp_path / "model"))


@pytest.fixture
def earlier(tmp_path: Path) -> Path:
    """An output of an earlier run."""
    folder = tmp_path / "earlier"
    folder.mkdir()
    for name in OUTPUT:
        (folder / name).write_bytes(b"earlier " + name.encode())
    return folder


def refiner(model: Path, output: Path, *more: str, scenario: str = "static_interface") -> list[str]:
    return ["refiner", "--input_path", str(model), "--output_path", str(output), "--scenario", scenario, *more]


class Run:
    """`main` in this process, with what the file descriptors got, so that COLMAP's own log counts."""

    def __init__(self, capfd: pytest.CaptureFixture[str], folder: Path) -> None:
        self._capfd = capfd
        self._folder = folder

    def __call__(self, arguments: list[str]) -> str:
        """Standard output of a run that goes well and says nothing on standard error."""
        self._capfd.readouterr()
        status = main(arguments)
        out, err = self._capfd.readouterr()
        assert (status, err) == (0, "")
        return out

    def fails(self, arguments: list[str]) -> str:
        """The one line of a run that fails and leaves every file as it was."""
        before = snapshot(self._folder)
        self._capfd.readouterr()
        status = main(arguments)
        out, err = self._capfd.readouterr()
        assert status == 1
        assert out == ""
        assert_one_line(err)
        assert snapshot(self._folder) == before
        return err


def assert_one_line(err: str) -> None:
    assert err.startswith("ERROR: ") and err.endswith("\n") and err.count("\n") == 1, err
    assert "Traceback" not in err


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    return Run(capfd, tmp_path)


# --- What it writes and says -----------------------------------------------------------------------------------------


def test_refiner(run: Run, model: Path, tmp_path: Path, scene: Scene) -> None:
    before = snapshot(model)
    out = run(refiner(model, tmp_path / "a" / "out"))
    output = tmp_path / "a" / "out"
    assert {p.name for p in output.iterdir()} == OUTPUT
    assert {p.name for p in (tmp_path / "a").iterdir()} == {"out"}
    assert snapshot(model) == before

    written = pycolmap.Reconstruction(output)
    assert written.num_points3D() == scene.refined.reconstruction.num_points3D()
    for point3D_id, point in scene.refined.reconstruction.points3D.items():
        np.testing.assert_allclose(written.point3D(point3D_id).xyz, point.xyz, atol=1e-3 * scene.bound)
    sidecar = read_sidecar(output)
    assert sidecar.scenario == "static_interface"
    assert sidecar.images.keys() == scene.refined.sidecar.images.keys()

    for label in ("Images", "Points", "Observations", "Filtered", "Solver", "Gradient", "Refractive index"):
        assert re.search(rf"^{label}[^:]*:", out, re.MULTILINE)
    assert re.search(r"Mean reprojection error: +[0-9.]+ px without refraction, [0-9.]+ px with it", out)
    assert "distance [model units]" in out and "tilt [deg]" in out
    assert "+-" in out
    assert str(output) in out.splitlines()[-1]

    analyzed = run(["model_analyzer", "--path", str(output)])
    assert analyzed.strip()
    assert out.startswith(analyzed.rstrip("\n"))


def test_options_arrive(run: Run, model: Path, tmp_path: Path) -> None:
    run(
        refiner(
            model, tmp_path / "out",
            "--refractive_index", "1.34",
            "--layer_thickness", "0.01", "0.02", "--layer_refractive_index", "1.52", "1.49",
            "--interface_distance", "1.1", "--interface_normal", "0", "0.1", "1", "--refine_interface_normal", "0",
            "--reference_image", "frame_0002.jpg", "--filter_max_reproj_error", "5", "--filter_min_tri_angle", "1",
            "--BundleAdjustment.loss_function_type", "huber", "--BundleAdjustment.loss_function_scale", "1.5",
            "--BundleAdjustment.refine_points3D", "1", "--num_threads", "1", "--random_seed", "3",
        )
    )  # fmt: skip
    sidecar = read_sidecar(tmp_path / "out")
    options = sidecar.options
    assert options["refractive_index"] == 1.34 and sidecar.layers.index == (1.52, 1.49, 1.34)
    assert options["layer_thickness"] == [0.01, 0.02]
    assert options["refine_interface_normal"] is False
    assert options["BundleAdjustment"]["loss_function_type"] == "huber"
    assert (options["num_threads"], options["random_seed"]) == (1, 3)
    assert sidecar.solver["reference_image"] == "frame_0002.jpg"
    assert (sidecar.solver["loss_function_type"], sidecar.solver["loss_function_scale"]) == ("huber", 1.5)
    entry = sidecar.images["frame_0002.jpg"]
    assert entry.distance == pytest.approx(1.1, rel=1e-12)
    np.testing.assert_allclose(entry.normal_in_cam, np.array([0, 0.1, 1]) / np.hypot(0.1, 1), atol=1e-12)
    assert sidecar.units["distance"] == "metre"


def test_groups_and_dry_images(run: Run, model: Path, tmp_path: Path, scene: Scene) -> None:
    names = sorted(image.name for image in scene.model.images.values())
    groups, dry = tmp_path / "groups.txt", tmp_path / "dry.txt"
    groups.write_text("# image group\n\n" + "".join(f"{name} half{k // 5}\n" for k, name in enumerate(names)))
    dry.write_text("# none\n\n")
    out = run(
        refiner(
            model, tmp_path / "out", "--interface_group_path", str(groups), "--dry_image_list_path", str(dry),
            scenario="moving_interface",
        )
    )  # fmt: skip
    sidecar = read_sidecar(tmp_path / "out")
    assert set(sidecar.world_planes) == {"half0", "half1"}
    assert sidecar.options["interface_groups"][names[0]] == "half0"
    assert re.search(r"^half0 +5 ", out, re.MULTILINE)

    dry.write_text(f"{names[3]}\n")
    out = run(refiner(model, tmp_path / "out2", "--dry_image_list_path", str(dry), "--filter_max_reproj_error", "0"))
    assert read_sidecar(tmp_path / "out2").images[names[3]].distance is None
    assert "1 images without an interface" in out


def test_group_names_may_follow_image_names_with_spaces(run: Run, scene: Scene, tmp_path: Path) -> None:
    model = scene.copy()
    for image in model.images.values():
        image.name = "my images/" + image.name
    (tmp_path / "model").mkdir()
    model.write_binary(tmp_path / "model")
    groups = tmp_path / "groups.txt"
    groups.write_text("".join(f"{image.name} one\n" for image in model.images.values()))
    run(refiner(tmp_path / "model", tmp_path / "out", "--interface_group_path", str(groups)))
    assert set(read_sidecar(tmp_path / "out").world_planes) == {"one"}


@pytest.mark.parametrize("form", ["bin", "txt", "folder"])
def test_camera_path(run: Run, model: Path, tmp_path: Path, scene: Scene, form: str) -> None:
    known = tmp_path / "calibration"
    known.mkdir()
    calibrated = scene.copy()
    calibrated.camera(1).params = calibrated.camera(1).params * [1.001, 1, 1, 1]
    (calibrated.write_text if form == "txt" else calibrated.write_binary)(known)
    path = known if form == "folder" else known / f"cameras.{form}"
    run(refiner(model, tmp_path / "out", "--camera_path", str(path)))
    written = pycolmap.Reconstruction(tmp_path / "out").camera(1).params
    np.testing.assert_allclose(written, calibrated.camera(1).params, rtol=1e-12)


@pytest.mark.parametrize("form", ["text", "colmap3", "colmap3 text"])
def test_other_forms_of_a_model(run: Run, pristine: Path, tmp_path: Path, form: str) -> None:
    """COLMAP 3 has neither rigs nor frames, and text has as many digits as it is given."""
    (tmp_path / "model").mkdir()
    model = pycolmap.Reconstruction(pristine)
    (model.write_text if "text" in form else model.write_binary)(tmp_path / "model")
    if "colmap3" in form:
        for name in ("rigs", "frames"):
            for suffix in (".bin", ".txt"):
                (tmp_path / "model" / (name + suffix)).unlink(missing_ok=True)
    run(refiner(tmp_path / "model", tmp_path / "out"))
    run(refiner(pristine, tmp_path / "expected"))
    assert {p.name for p in (tmp_path / "out").iterdir()} == OUTPUT
    found, expected = pycolmap.Reconstruction(tmp_path / "out"), pycolmap.Reconstruction(tmp_path / "expected")
    assert found.num_points3D() == expected.num_points3D()
    for point3D_id, point in expected.points3D.items():
        np.testing.assert_allclose(found.point3D(point3D_id).xyz, point.xyz, atol=1e-4)
    assert {i: image.name for i, image in found.images.items()} == {
        i: image.name for i, image in expected.images.items()
    }


def test_scenario_auto(run: Run, model: Path, tmp_path: Path) -> None:
    arguments = refiner(model, tmp_path / "auto", "--refractive_index", "1.34", scenario="auto")
    lines = run(arguments).splitlines()
    begin = next(k for k, line in enumerate(lines) if line.startswith("==="))
    comparison = "\n".join(lines[:begin])
    # Unknowns and error; a plane fixed in a camera that looks about is found nowhere, which is said instead.
    for scenario, error in (("static_interface", "[0-9.]+"), ("moving_interface", "[0-9.]+"), ("camera_housing", "-")):
        assert len(re.findall(rf"^{scenario} +[0-9]+ +{error} ", comparison, re.MULTILINE)) == 1
    assert re.search("^camera_housing: the interface ran", comparison, re.MULTILINE)
    for word in ("unknowns", "[px]", "[s]", "static_interface predicts"):
        assert word in comparison
    assert lines[begin + 1] == "Refractive refinement, static_interface"
    # As if it had been named.
    run(refiner(model, tmp_path / "named", "--refractive_index", "1.34"))
    auto, named = (read_sidecar(tmp_path / name) for name in ("auto", "named"))
    assert (auto.scenario, auto.options) == (named.scenario, named.options)
    assert auto.images.keys() == named.images.keys()
    for name, image in named.images.items():
        assert auto.images[name].distance == pytest.approx(image.distance, rel=1e-6)
    recorded = auto.statistics["comparison"]
    assert recorded["chosen"] == "static_interface" and recorded["why"] == lines[begin - 2]
    assert [trial["label"] for trial in recorded["trials"]][-1] == "moving_interface"
    errors = {trial["label"]: trial["error"] for trial in recorded["trials"]}
    assert errors.pop("camera_housing") is None
    # Two coordinates of 0.5 px, and what the points are off.
    assert len(errors) == 2 and all(0.5 < error < 1.5 for error in errors.values())
    assert "comparison" not in named.statistics


def test_scenario_auto_with_what_cannot_be(run: Run, model: Path, tmp_path: Path) -> None:
    arguments = refiner(model, tmp_path / "out", "--reference_image", "nobody.jpg", scenario="auto")
    assert run.fails(arguments).count("'nobody.jpg'") == 1
    workspace = ["automatic_reconstructor", "--workspace_path", str(tmp_path / "new"), "--scenario", "auto"]
    said = run.fails(workspace)
    assert "--refine 0" in said and f"--scenario auto --input_path {tmp_path / 'new' / 'sparse' / '0'}" in said


def test_overwrite(run: Run, model: Path, earlier: Path) -> None:
    (earlier / "points3D.txt").write_text("stale")
    (earlier / "point_std.csv").write_text("of points that are there no more")
    (earlier / "notes.txt").write_text("of the user")
    run(refiner(model, earlier, "--overwrite", "1"))
    assert {p.name for p in earlier.iterdir()} == {*OUTPUT, "notes.txt"}
    assert pycolmap.Reconstruction(earlier).num_reg_images() == 10


@pytest.mark.parametrize(("word", "value"), [("0", False), ("1", True), ("false", False), ("true", True)])
def test_booleans_are_colmaps(run: Run, model: Path, tmp_path: Path, word: str, value: bool) -> None:
    run(
        refiner(
            model, tmp_path / "out", "--refine_interface_normal", word, "--BundleAdjustment.refine_focal_length", word,
            "--overwrite", word,
        )
    )  # fmt: skip
    options = read_sidecar(tmp_path / "out").options
    assert options["refine_interface_normal"] is value
    assert options["BundleAdjustment"]["refine_focal_length"] is value


@pytest.mark.parametrize("command", [[], ["refiner"], ["model_analyzer"]])
def test_help(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([*command, "--help"])
    assert caught.value.code == 0
    out = capsys.readouterr().out
    expected = {
        "": ("refiner", "model_analyzer"),
        "refiner": ("--input_path", "--scenario", "--refractive_index", "--BundleAdjustment.refine_focal_length", "px"),
        "model_analyzer": ("--path",),
    }["".join(command)]
    for word in expected:
        assert word in out


@pytest.mark.parametrize(
    "line",
    [
        "",
        "refine",
        "refiner",
        "refiner --input_path a --output_path b",
        "refiner --input_path a --output_path b --scenario aquarium",
        "refiner --input_path a --output_path b --scenario camera_housing --index 1.3",
        "refiner --input_path a --output_path b --scenario camera_housing --overwrite 2",
        "refiner --input_path a --output_path b --scenario camera_housing --overwrite",
        "refiner --input_path a --output_path b --scenario camera_housing --num_threads two",
        "refiner --input_path a --output_path b --scenario camera_housing --interface_normal 1",
        "model_analyzer",
    ],
)
def test_wrong_command_line(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(line.split())
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_as_a_program(model: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [*COMMAND, *refiner(model, tmp_path / "out")], capture_output=True, text=True, timeout=TIMEOUT
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert {p.name for p in (tmp_path / "out").iterdir()} == OUTPUT
    assert "Refractive refinement, static_interface" in done.stdout
    failed = subprocess.run(
        [*COMMAND, *refiner(tmp_path / "none", tmp_path / "out2")], capture_output=True, text=True, timeout=TIMEOUT
    )
    assert failed.returncode == 1
    assert_one_line(failed.stderr)
    wrong = subprocess.run([*COMMAND, "refiner", "--nonsense"], capture_output=True, text=True, timeout=TIMEOUT)
    assert wrong.returncode == 2 and "Traceback" not in wrong.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model", "out"]


# --- What is wrong ---------------------------------------------------------------------------------------------------


def cut(name: str) -> Callable[[Path], None]:
    def damage(model: Path) -> None:
        data = (model / name).read_bytes()
        (model / name).write_bytes(data[: 2 * len(data) // 3])

    return damage


def rewrite(change: Callable[[pycolmap.Reconstruction], object]) -> Callable[[Path], None]:
    def damage(model: Path) -> None:
        reconstruction = pycolmap.Reconstruction(model)
        change(reconstruction)
        reconstruction.write_binary(model)

    return damage


def deregister(reconstruction: pycolmap.Reconstruction) -> None:
    for frame_id in list(reconstruction.reg_frame_ids()):
        reconstruction.deregister_frame(frame_id)


def clear_points(reconstruction: pycolmap.Reconstruction) -> None:
    for point3D_id in list(reconstruction.point3D_ids()):
        reconstruction.delete_point3D(point3D_id)


def nan_point(reconstruction: pycolmap.Reconstruction) -> None:
    next(iter(reconstruction.points3D.values())).xyz = np.array([0.0, np.nan, 1.0])


def nan_pose(reconstruction: pycolmap.Reconstruction) -> None:
    reconstruction.frame(2).rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0, np.inf, 0]))


def nan_keypoint(reconstruction: pycolmap.Reconstruction) -> None:
    image = reconstruction.image(3)
    image.points2D[image.get_observation_point2D_idxs()[0]].xy = np.array([np.nan, 1.0])


def nan_focal_length(reconstruction: pycolmap.Reconstruction) -> None:
    reconstruction.camera(1).params = reconstruction.camera(1).params * [np.nan, 1, 1, 1]


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "nowhere": (shutil.rmtree, "does not exist"),
    "empty folder": (lambda model: [p.unlink() for p in model.iterdir()], "no COLMAP model"),
    "a file missing": (lambda model: (model / "points3D.bin").unlink(), "missing|no COLMAP model"),
    "no rigs": (lambda model: (model / "rigs.bin").unlink(), "rigs.bin is missing"),
    **{f"{name} cut off": (cut(name), name) for name in sorted(FIVE)},
    "no registered image": (rewrite(deregister), "no image is registered"),
    "no points": (rewrite(clear_points), "no points"),
    "point not finite": (rewrite(nan_point), "not finite"),
    "pose not finite": (rewrite(nan_pose), "not finite"),
    "keypoint not finite": (rewrite(nan_keypoint), "not finite"),
    "focal length not finite": (rewrite(nan_focal_length), "not finite"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_models(run: Run, model: Path, tmp_path: Path, earlier: Path, damage: str) -> None:
    apply, said = DAMAGES[damage]
    apply(model)
    assert re.search(said, run.fails(refiner(model, tmp_path / "out")))
    assert re.search(said, run.fails(refiner(model, earlier, "--overwrite", "1")))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--refractive_index", "0"], "index"),
        (["--refractive_index", "-1.333"], "index"),
        (["--refractive_index", "nan"], "index"),
        (["--layer_thickness", "0.01", "--layer_refractive_index", "-1.5"], "index"),
        (["--layer_thickness", "-0.01", "--layer_refractive_index", "1.5"], "thickness"),
        (["--layer_thickness", "0.01"], "layer_thickness"),
        (["--interface_normal", "0", "0", "-1"], "behind"),
        (["--interface_normal", "0", "0", "0"], "not a direction"),
        (["--interface_normal", "0", "nan", "1"], "not a direction"),
        (["--interface_distance", "-1"], "not in front of the camera"),
        (["--interface_distance", "0"], "not in front of the camera"),
        (["--interface_distance", "inf"], "not in front of the camera"),
        (["--interface_distance", "50", "--BundleAdjustment.refine_rig_from_world", "0"], "beyond the points"),
        (["--initial_distance_ratio", "1.5"], "beyond the points"),
        (["--initial_distance_ratio", "-0.5"], "behind the camera"),
        (["--refine_interface_distance", "0"], "interface_distance"),
        (["--filter_max_reproj_error", "-1"], "from 0 on"),
        (["--filter_min_tri_angle", "nan"], "from 0 on"),
        (["--refractive_index", "13.33"], "no medium"),
        (["--num_threads", "0"], "one per core"),
        (["--random_seed", "-1"], "from 0 on"),
        (["--BundleAdjustment.max_num_iterations", "0"], "1 or more"),
        (["--BundleAdjustment.function_tolerance", "-1"], "small number"),
        (["--BundleAdjustment.loss_function_scale", "0"], "not positive"),
        (["--reference_image", "nobody.jpg"], "'nobody.jpg'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_impossible_options(
    run: Run, model: Path, tmp_path: Path, earlier: Path, options: list[str], said: str
) -> None:
    assert said in run.fails(refiner(model, tmp_path / "out", *options))
    assert said in run.fails(refiner(model, earlier, "--overwrite", "1", *options))


@pytest.mark.parametrize("option", ["--interface_group_path", "--dry_image_list_path"])
@pytest.mark.parametrize(
    ("content", "said"),
    [(b"nobody.jpg x\n", "nobody.jpg"), (b"\xff\xfe\x00", "cannot be read"), (None, "cannot be read")],
)
def test_lists_of_images(run: Run, model: Path, tmp_path: Path, option: str, content: bytes | None, said: str) -> None:
    listed = tmp_path / "list.txt"
    if content is not None:
        listed.write_bytes(content)
    assert said in run.fails(refiner(model, tmp_path / "out", option, str(listed)))


@pytest.mark.parametrize(
    ("lines", "said"),
    [("frame_0001.jpg a\nframe_0001.jpg b\n", "two groups"), ("frame_0001.jpg\n", "IMAGE_NAME GROUP")],
)
def test_groups_that_say_two_things(run: Run, model: Path, tmp_path: Path, lines: str, said: str) -> None:
    (tmp_path / "list.txt").write_text(lines)
    arguments = refiner(model, tmp_path / "out", "--interface_group_path", str(tmp_path / "list.txt"))
    assert said in run.fails(arguments)


def test_dry_images_that_cannot_be(run: Run, model: Path, tmp_path: Path, scene: Scene) -> None:
    listed, groups = tmp_path / "list.txt", tmp_path / "groups.txt"
    names = [image.name for image in scene.model.images.values()]
    arguments = refiner(model, tmp_path / "out", "--dry_image_list_path", str(listed))
    listed.write_text("\n".join(names))
    assert "every image" in run.fails(arguments)
    listed.write_text(names[0])
    assert "reference image" in run.fails([*arguments, "--reference_image", names[0]])
    groups.write_text(f"{names[0]} x\n")
    assert "dry and in group" in run.fails([*arguments, "--interface_group_path", str(groups)])


@pytest.mark.parametrize("grouped", [False, True])
def test_group_with_too_few_points(run: Run, model: Path, tmp_path: Path, grouped: bool) -> None:
    reconstruction = pycolmap.Reconstruction(model)
    image = reconstruction.image(4)
    for idx in image.get_observation_point2D_idxs()[3:]:
        reconstruction.delete_observation(4, idx)
    reconstruction.write_binary(model)
    (tmp_path / "groups.txt").write_text(f"{image.name} lonely\n" if grouped else "")
    said = run.fails(
        refiner(
            model, tmp_path / "out", "--interface_group_path", str(tmp_path / "groups.txt"),
            scenario="moving_interface",
        )
    )  # fmt: skip
    assert ("group 'lonely' has 3 points" if grouped else f"'{image.name}' has 3 points") in said
    # The world's one plane has enough.
    run(refiner(model, tmp_path / "out"))


def test_two_images_are_the_least(run: Run, model: Path, tmp_path: Path) -> None:
    reconstruction = pycolmap.Reconstruction(model)
    for frame_id in range(2, 11):
        reconstruction.deregister_frame(frame_id)
    shutil.rmtree(model)
    model.mkdir()
    # What is left of a point has one observation at most.
    reconstruction.write_binary(model)
    run.fails(refiner(model, tmp_path / "out"))


def test_camera_path_that_does_not_fit(run: Run, model: Path, tmp_path: Path) -> None:
    cameras = tmp_path / "cameras.txt"
    arguments = refiner(model, tmp_path / "out", "--camera_path", str(cameras))
    assert "does not exist" in run.fails(arguments)
    cameras.write_text("1 SIMPLE_RADIAL 800 500 600 400 250 0\n")
    said = run.fails(arguments)
    assert "1600 x 1200" in said and "800 x 500" in said
    cameras.write_text("3 PINHOLE 1600 1200 1 1 1 1\n7 PINHOLE 1600 1200 1 1 1 1\n")
    assert "no camera 1" in run.fails(arguments)
    cameras.write_text("1 PINHOLE 1600 1200 nan 1 1 1\n")
    assert "not finite" in run.fails(arguments)


def test_camera_of_another_size_is_rescaled_and_that_is_said(run: Run, model: Path, tmp_path: Path) -> None:
    camera = pycolmap.Reconstruction(model).camera(1)
    camera.rescale(800, 600)
    (tmp_path / "cameras.txt").write_text(
        f"1 {camera.model.name} 800 600 {' '.join(map(repr, camera.params.tolist()))}\n"
    )
    plain = run(refiner(model, tmp_path / "plain"))
    said = run(refiner(model, tmp_path / "out", "--camera_path", str(tmp_path / "cameras.txt")))
    assert "rescaled to 1600 x 1200" in said and "rescaled" not in plain
    a, b = (pycolmap.Reconstruction(tmp_path / name) for name in ("plain", "out"))
    np.testing.assert_allclose(b.camera(1).params, a.camera(1).params, rtol=1e-9)


def test_version(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capfd.readouterr().out == f"colmap-refract {colmap_refract.__version__}\n"


def test_a_reader_that_stops_reading(run: Run, model: Path, tmp_path: Path) -> None:
    """As `colmap-refract model_analyzer ... | head` does."""
    run(refiner(model, tmp_path / "out"))
    command = f"{sys.executable} -m colmap_refract model_analyzer --path {tmp_path / 'out'}"
    shell = f"{command} | true; echo ${{PIPESTATUS[0]}}"
    piped = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, check=True)
    assert (piped.stdout, piped.stderr) == ("0\n", "")


@pytest.mark.parametrize("how", ["same", "dots", "link"])
def test_output_is_the_input(run: Run, model: Path, tmp_path: Path, how: str) -> None:
    (tmp_path / "link").symlink_to(model)
    output = {"same": model, "dots": tmp_path / "link" / ".." / "model", "link": tmp_path / "link"}[how]
    assert "is the input" in run.fails(refiner(model, output, "--overwrite", "1"))


def test_output_exists(run: Run, model: Path, earlier: Path, tmp_path: Path) -> None:
    said = run.fails(refiner(model, earlier))
    assert "not empty" in said and "--overwrite" in said
    run.fails(refiner(model, earlier, "--overwrite", "0"))
    (tmp_path / "file").write_text("a file")
    assert "is a file" in run.fails(refiner(model, tmp_path / "file", "--overwrite", "1"))


def test_unwritable_folder(run: Run, model: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file")
    assert "cannot write" in run.fails(refiner(model, tmp_path / "file" / "below"))
    if Path("/proc/self").is_dir():
        assert "cannot write" in run.fails(refiner(model, Path("/proc/nowhere/out")))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folder_of_others(run: Run, model: Path, tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir()
    closed.chmod(0o500)
    try:
        assert "cannot write" in run.fails(refiner(model, closed / "out"))
        assert "cannot write" in run.fails(refiner(model, closed))
    finally:
        closed.chmod(0o700)


@pytest.mark.parametrize("existing", [False, True])
def test_full_disk(model: Path, tmp_path: Path, earlier: Path, existing: bool) -> None:
    """Files may not grow over 20 kB, which the images' and the points' do: the system says it as it would of a disk."""
    output = earlier if existing else tmp_path / "out"
    before = snapshot(tmp_path)
    done = subprocess.run(
        [*COMMAND, *refiner(model, output, "--overwrite", "1")],
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert_one_line(done.stderr)
    assert "cannot write" in done.stderr
    assert snapshot(tmp_path) == before


def test_analyzer_without_a_sidecar(run: Run, model: Path) -> None:
    assert "refraction.json" in run.fails(["model_analyzer", "--path", str(model)])
    run.fails(["model_analyzer", "--path", str(model / "nowhere")])
    (model / "refraction.json").write_text("{}")
    assert "refraction.json" in run.fails(["model_analyzer", "--path", str(model)])


def test_analyzer_with_the_sidecar_of_another_model(run: Run, model: Path, tmp_path: Path) -> None:
    run(refiner(model, tmp_path / "out"))
    reconstruction = pycolmap.Reconstruction(tmp_path / "out")
    reconstruction.image(1).name = "renamed.jpg"
    reconstruction.write_binary(tmp_path / "out")
    assert "frame_0001.jpg" in run.fails(["model_analyzer", "--path", str(tmp_path / "out")])


# --- Terminals -------------------------------------------------------------------------------------------------------


class OnTerminal:
    """A run whose standard error is a terminal."""

    def __init__(self, arguments: list[str]) -> None:
        self._master, slave = pty.openpty()
        self.process = subprocess.Popen(
            [*COMMAND, *arguments], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=slave
        )
        os.close(slave)
        self.shown = b""

    def read(self, until: bytes | None = None) -> None:
        """Collect what is shown, to the end or until `until` is in it."""
        end = time.monotonic() + TIMEOUT
        while until is None or until not in self.shown:
            assert time.monotonic() < end, self.shown
            if not select.select([self._master], [], [], 0.5)[0]:
                continue
            try:
                data = os.read(self._master, 4096)
            except OSError:  # what Linux says when the other end is closed
                data = b""
            if not data:
                assert until is None, self.shown
                break
            self.shown += data

    def close(self) -> tuple[int, str]:
        """Exit status and standard output."""
        self.read()
        assert self.process.stdout is not None
        out = self.process.stdout.read().decode()
        self.process.stdout.close()
        os.close(self._master)
        return self.process.wait(TIMEOUT), out


def test_progress_is_for_terminals(model: Path, tmp_path: Path) -> None:
    """Not for logs: `test_as_a_program` and all others find standard error empty."""
    run = OnTerminal(refiner(model, tmp_path / "out"))
    status, out = run.close()
    assert status == 0
    shown = run.shown.decode()
    assert re.search(r"iteration [0-9]+, error [0-9.]+ px", shown)
    assert "Candidate" not in shown
    # One line, that is cleared in the end.
    assert "\n" not in shown
    assert shown.rstrip("\r").split("\r")[-1].strip() == ""
    assert "iteration 1," not in out


def test_progress_says_which_candidate_is_tried(model: Path, tmp_path: Path) -> None:
    run = OnTerminal(refiner(model, tmp_path / "out", scenario="auto"))
    status, out = run.close()
    assert status == 0
    shown = run.shown.decode()
    found = re.findall(r"Candidate ([0-9]) of 3, (?:static|moving|camera)_[a-z]+: [^\r]*iteration [0-9]+", shown)
    assert {*found} == {"1", "2", "3"} and found == sorted(found)
    assert "iteration" in shown.rpartition("Candidate 3 of 3")[2].partition("\r")[2]
    # That is for the line of progress; what came of it is for all.
    assert "Candidate 1" not in out and "unknowns" in out


@pytest.fixture(scope="session")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that takes some seconds: its points and planes start far from where they belong."""
    folder = tmp_path_factory.mktemp("large")
    capture = simulate(SceneOptions(scenario="moving_interface", num_images=60, num_points=3000))
    capture.reconstruction.write_binary(folder)
    return folder


@pytest.mark.parametrize("existing", [False, True])
def test_interrupt(large: Path, tmp_path: Path, earlier: Path, existing: bool) -> None:
    output = earlier if existing else tmp_path / "a" / "out"
    before, large_before = snapshot(tmp_path), snapshot(large)
    # Without a tolerance it has not ended when the signal comes, however busy the machine is.
    endless = ("--BundleAdjustment.function_tolerance", "0", "--BundleAdjustment.max_num_iterations", "100000")
    run = OnTerminal(refiner(large, output, "--overwrite", "1", *endless, scenario="moving_interface"))
    run.read(until=b"iteration 2")
    run.process.send_signal(signal.SIGINT)
    started = time.monotonic()
    status, out = run.close()
    assert status == 130
    assert out == ""
    shown = run.shown.decode()
    assert "nothing was written" in shown and "Traceback" not in shown
    # Ceres is asked to stop after the step it is at, not after the solve.
    assert time.monotonic() - started < 10
    assert snapshot(tmp_path) == before and snapshot(large) == large_before
