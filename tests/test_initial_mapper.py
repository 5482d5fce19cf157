"""`initial_mapper` writes a model that the refiner takes, whole or not at all, and leaves the database alone."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from conftest import Scene, Scenes

from colmap_refract.cli import main
from colmap_refract.commands.initial_mapper import InitialMapper
from colmap_refract.commands.refiner import Refiner
from colmap_refract.errors import RefractError
from colmap_refract.files.model_io import read_model
from colmap_refract.options import RefinerOptions
from colmap_refract.simulation import Capture
from colmap_refract.simulation.database import write_database


@pytest.fixture
def scene(scenes: Scenes) -> Scene:
    return scenes("moving_interface")


def command(folder: Path, capture: Capture, **options: Any) -> InitialMapper:
    path = folder / "database.db"
    if not path.exists():
        write_database(path, capture.reconstruction, wrong=0.02)
    arguments = {"scenario": capture.scenario, "output_path": folder / "out", "num_threads": 1, **options}
    return InitialMapper(database_path=path, **arguments)


def test_model_is_written_and_can_be_refined(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mapper = command(tmp_path, scene.capture)
    mapper.run()
    text = capsys.readouterr().out
    model = read_model(tmp_path / "out")
    assert model.num_reg_images() == 12
    assert re.search(r"Images: +12 \(12 registered\)", text)
    assert re.search(rf"Points: +{model.num_points3D()}\n", text)
    assert re.search(rf"Observations: +{model.compute_num_observations()}\n", text)
    assert "Pairs of images averaged" in text
    assert "WARNING: the intrinsics of camera 1 are a guess" in text
    Refiner(
        input_path=tmp_path / "out",
        output_path=tmp_path / "refined",
        options=RefinerOptions(scenario="moving_interface", num_threads=1),
    ).run()
    assert read_model(tmp_path / "refined").num_reg_images() == 12
    # Water that was ignored shows in the residuals; what is left are half a pixel of noise.
    errors = [float(m) for m in re.findall(r"([\d.]+) px with", capsys.readouterr().out)]
    assert errors[0] > 1.3 * 0.65
    assert errors[1] < 0.65


def test_fixed_camera_says_what_its_depths_are_worth(
    scenes: Scenes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command(tmp_path, scenes("fixed_camera", tilt_deg=8.0).capture).run()
    share = re.search(r"Depths: +a relief about one depth, reliability (\d\.\d\d) ", capsys.readouterr().out)
    assert share is not None
    assert 0.5 <= float(share[1]) <= 1


def test_calibrated_cameras_are_used(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = pycolmap.Camera(scene.capture.reconstruction.camera(1).todict())
    guessed = pycolmap.Reconstruction(scene.capture.reconstruction)
    guessed.camera(1).params = [2000.0, *list(camera.params)[1:]]
    write_database(tmp_path / "database.db", guessed)
    calibrated = pycolmap.Reconstruction()
    calibrated.add_camera_with_trivial_rig(camera)
    calibrated.write(tmp_path)
    command(tmp_path, scene.capture, camera_path=tmp_path / "cameras.bin").run()
    assert "WARNING" not in capsys.readouterr().out
    np.testing.assert_array_equal(read_model(tmp_path / "out").camera(1).params, camera.params)


def test_reference_image_is_at_the_origin(scene: Scene, tmp_path: Path) -> None:
    command(tmp_path, scene.capture, reference_image="frame_0007.jpg").run()
    image = read_model(tmp_path / "out").find_image_with_name("frame_0007.jpg")
    assert image is not None
    np.testing.assert_allclose(image.cam_from_world().matrix(), np.eye(3, 4), atol=1e-9)


def test_model_is_replaced_only_when_told_to(scene: Scene, tmp_path: Path) -> None:
    mapper = command(tmp_path, scene.capture)
    mapper.run()
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    again = replace(mapper, reference_image="frame_0002.jpg")
    with pytest.raises(RefractError, match="not empty"):
        again.run()
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    replace(again, overwrite=True).run()
    assert (tmp_path / "out" / "images.bin").read_bytes() != before["images.bin"]


def test_nothing_is_written_when_something_is_wrong(scene: Scene, tmp_path: Path) -> None:
    mapper = command(tmp_path, scene.capture)
    before = mapper.database_path.read_bytes()
    for change, message in [
        ({"reference_image": "other.jpg"}, "no image named 'other.jpg'"),
        ({"camera_path": tmp_path / "nowhere.bin"}, "does not exist"),
        ({"database_path": tmp_path / "nowhere.db"}, "does not exist"),
        ({"random_seed": -1}, "random_seed -1"),
    ]:
        with pytest.raises(RefractError, match=message):
            replace(mapper, **change).run()
        assert sorted(path.name for path in tmp_path.iterdir()) == ["database.db"]
    assert mapper.database_path.read_bytes() == before


def test_next_command_can_be_pasted(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "my dive"
    folder.mkdir()
    command(folder, scene.capture, output_path=folder / "start").run()
    program, *words = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert program == "colmap-refract" and str(folder / "start") in words and str(folder / "database.db") in words
    main([*words, "--num_threads", "1", "--BundleAdjustment.max_num_iterations", "3"])
    assert read_model(folder / "start_refined").num_reg_images() == 12


def test_interrupt_leaves_nothing(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    mapper = command(tmp_path, scene.capture)
    monkeypatch.setattr("colmap_refract.mapping.initial.put_into_model", interrupt)
    with pytest.raises(KeyboardInterrupt):
        mapper.run()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["database.db"]
