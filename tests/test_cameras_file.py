"""Cameras survive every form of a cameras file, and a wrong file says what is wrong."""

from __future__ import annotations

from pathlib import Path

import pycolmap
import pytest
from conftest import error_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from colmap_refract.files.cameras_file import read_cameras


@given(
    model=st.sampled_from([m for m in pycolmap.CameraModelId.__members__.values() if int(m) >= 0]),
    width=st.integers(1, 10000),
    height=st.integers(1, 10000),
    data=st.data(),
)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_cameras_round_trip(
    tmp_path: Path, model: pycolmap.CameraModelId, width: int, height: int, data: st.DataObject
) -> None:
    camera = pycolmap.Camera.create_from_model_id(3, model, 1000.0, width, height)
    floats = st.floats(1e-300, 1e300)
    camera.params = data.draw(st.lists(floats, min_size=len(camera.params), max_size=len(camera.params)))
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera(camera)
    reconstruction.write_binary(tmp_path)
    reconstruction.write_text(tmp_path)
    for file in (tmp_path / "cameras.bin", tmp_path / "cameras.txt", tmp_path):
        cameras = read_cameras(file)
        assert list(cameras) == [3]
        assert cameras[3].model == model and (cameras[3].width, cameras[3].height) == (width, height)
        assert (cameras[3].params == camera.params).all()


def test_read_cameras_by_hand(tmp_path: Path) -> None:
    file = tmp_path / "air.txt"
    file.write_bytes(b"\xef\xbb\xbf# in air\r\n\r\n 2  PINHOLE 640 480 500 500.5\t320 240 \r\n")
    assert read_cameras(str(file))[2].params_to_string() == "500, 500.5, 320, 240"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("", "no camera"),
        ("1 PINHOLE 640", "line 1 is not 'CAMERA_ID"),
        ("1 PINHOLE 640 480 500 x 320 240", "line 1 is not 'CAMERA_ID"),
        ("1 PINHOLE 640.5 480 500 500 320 240", "line 1 is not 'CAMERA_ID"),
        ("1 PINHOLE 640 480 500 320 240", "has 3 parameters, PINHOLE needs fx, fy, cx, cy"),
        ("1 PINE 640 480 500 320 240", "model 'PINE', which pycolmap"),
        ("1 INVALID 640 480", "model 'INVALID', which pycolmap"),
        ("-1 PINHOLE 640 480 500 500 320 240", "no valid id"),
        ("1 PINHOLE 0 480 500 500 320 240", "impossible image size"),
        ("1 PINHOLE 640 480 500 nan 320 240", "not finite"),
        ("1 PINHOLE 640 480 0 500 320 240", "focal length"),
        ("1 SIMPLE_PINHOLE 9 9 9 9 9\n1 SIMPLE_PINHOLE 9 9 9 9 9", "occurs twice"),
    ],
)
def test_read_cameras_says_what_is_wrong(tmp_path: Path, line: str, expected: str) -> None:
    file = tmp_path / "cameras.txt"
    file.write_text(line + "\n")
    message = error_of(lambda: read_cameras(file))
    assert expected in message and str(file) in message


def test_read_cameras_without_a_file(tmp_path: Path) -> None:
    assert "does not exist" in error_of(lambda: read_cameras(tmp_path / "none.txt"))
    assert "neither cameras.bin nor cameras.txt" in error_of(lambda: read_cameras(tmp_path))
    (tmp_path / "photo.txt").write_bytes(b"\x89PNG\xff")
    assert "not UTF-8" in error_of(lambda: read_cameras(tmp_path / "photo.txt"))
