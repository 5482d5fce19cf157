"""`simulator`: a capture that is planned, what accuracy to expect of it, and pictures of it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from colmap_refract.commands.progress import ProgressLine
from colmap_refract.errors import RefractError
from colmap_refract.interface import Layers
from colmap_refract.options import Scenario
from colmap_refract.simulation.rendering import Look
from colmap_refract.simulation.scene import Layout

if TYPE_CHECKING:
    import pycolmap

    from colmap_refract.simulation.session import SessionOptions
    from colmap_refract.simulation.surface import Wave


@dataclass(frozen=True, kw_only=True)
class Simulator:
    """Plan a capture: what an image shows, and what accuracy the images allow.

    With output_path, the capture is also rendered: images, cameras.txt and the truth, a workspace to try things on.
    The accuracy is the bound that the noise of the keypoints sets (Cramer and Rao), for a flat interface. Poses,
    points and planes are drawn at random about what the options say.
    """

    scenario: Scenario
    """What is shared (see refiner). Of a housing, the interface is the port."""
    layout: Layout = "orbit"
    """Path of the camera. orbit: every image sees the same scene.
    strip and survey: one line or several, and each image sees its own part. Not of a fixed camera."""
    num_images: int = 15
    """Images taken."""
    output_path: Path | None = None
    """Folder to render the workspace to. Without it, nothing is rendered."""

    camera_path: Path | None = None
    """COLMAP cameras file (.bin or .txt) with the camera, in place of the four options below."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's camera model."""
    width: int = 1600
    """Of the images, px."""
    height: int = 1200
    """Of the images, px."""
    focal_length: float = 1200.0
    """px."""

    interface_distance: float | None = None
    """From the cameras down to the surface, or from the camera to the port, metres. By default 1, or 0.05."""
    water_depth: float = 1.5
    """From the surface down to the mean ground, or from the port on, metres."""
    relief: float | None = None
    """From the deepest to the highest place of the ground, metres. By default a quarter of the water's depth."""
    oblique_deg: float = 17.0
    """Mean inclination of the views from the vertical, degrees. 0: all look straight down."""
    tilt_deg: float = 5.0
    """Tilt of moving surfaces (root mean square), or of the port in its housing, degrees."""
    refractive_index: float = 1.333
    """Of the water, relative to the camera's medium."""
    layer_thickness: tuple[float, ...] = ()
    """Thickness of each wall between camera and water, metres, nearest the camera first."""
    layer_refractive_index: tuple[float, ...] = ()
    """Refractive index of each wall. Glass 1.52, acrylic 1.49."""

    wave_amplitude: tuple[float, ...] = ()
    """Of each wave, from the mean level to its crest, metres."""
    wavelength: tuple[float, ...] = ()
    """Of each wave, metres. Its period follows from gravity and the water's depth."""
    wave_direction: tuple[float, ...] = ()
    """Of each wave's travel, degrees. By default spread evenly."""
    interval: float = 0.7
    """Time from image to image, seconds, in which the waves travel."""

    pixel_noise: float = 0.5
    """Noise of the keypoints to expect, px (1 sigma, per axis). About 0.1 for SIFT on rendered images, more on real."""
    num_points: int = 400
    """Points to plan with; twice as many known as well make the interface better known, not the points."""
    compare: bool = True
    """Also tell what other plans would bring: more images, other views."""
    seed: int = 0
    """Of whatever is drawn at random."""

    look: Annotated[Look, tyro.conf.arg(name="Look")] = Look(blur=0.4, shot_noise=0.012, read_noise=0.002)
    jpeg_quality: int = 90
    """Of the rendered images, 1 to 100."""
    num_threads: int = -1
    """Of the rendering, 1 or more; -1: as many as there are cores."""

    def run(self) -> None:
        """Plan, report, render."""
        options = self.options()
        self._check_output()
        from colmap_refract.files.output import output_folder
        from colmap_refract.simulation.plan import alternatives, plan
        from colmap_refract.simulation.plan_report import report
        from colmap_refract.simulation.session import photograph, write_session

        with ProgressLine() as line:
            line.say("Planning ...")
            expected = plan(options)
            line.say("Comparing ...")
            others = alternatives(options.scene) if self.compare else {}
        print(report(expected, others), flush=True)
        if self.output_path is None:
            return
        with (
            output_folder(self.output_path, input_path=None, overwrite=False) as folder,
            ProgressLine() as line,
        ):
            line.say("Making the ground ...")
            session = photograph(options)
            write_session(session, folder, num_threads=self.num_threads, watch=_Remaining(line))
        print(f"\nWritten to {self.output_path}")

    def options(self) -> SessionOptions:
        """What was asked for.

        Raises:
            RefractError: options that contradict each other, or are no numbers to simulate with.
        """
        from colmap_refract.simulation.scene import SceneOptions
        from colmap_refract.simulation.session import SessionOptions

        housed = self.scenario == "camera_housing"
        distance = self.interface_distance if self.interface_distance is not None else (0.05 if housed else 1.0)
        positive = {
            "interface_distance": distance,
            "water_depth": self.water_depth,
            "focal_length": self.focal_length,
            "width": self.width,
            "height": self.height,
            "pixel_noise": self.pixel_noise,
            "num_points": self.num_points,
        }
        for name, value in positive.items():
            if not 0 < value < float("inf"):
                raise RefractError(f"{name} {value:g} is not positive")
        for name, value in {"oblique_deg": self.oblique_deg, "tilt_deg": self.tilt_deg}.items():
            if not 0 <= value < 60:
                raise RefractError(f"{name} {value:g} is not from 0 to 60 degrees")
        if self.num_threads < 1 and self.num_threads != -1:
            raise RefractError(f"num_threads {self.num_threads} is no number of threads: give 1 or more, or -1 for all")
        if self.scenario == "fixed_camera" and self.layout != "orbit":
            raise RefractError(f"a fixed camera has no path: leave layout {self.layout} out")
        camera = self._camera()
        depth = distance + self.water_depth
        return SessionOptions(
            scene=SceneOptions(
                scenario=self.scenario,
                layout=self.layout,
                num_images=self.num_images,
                num_points=self.num_points,
                pixel_noise=self.pixel_noise,
                camera_model=camera.model_name,
                width=camera.width,
                height=camera.height,
                focal_length=camera.mean_focal_length(),
                camera_params=tuple(camera.params.tolist()) if self.camera_path is not None else (),
                layers=self._layers(),
                depth=depth,
                distance_ratio=distance / depth,
                relief=self.relief if self.relief is not None else 0.25 * self.water_depth,
                tilt_deg=self.tilt_deg,
                oblique_deg=self.oblique_deg,
                seed=self.seed,
            ),
            waves=self._waves(),
            interval=self.interval,
            look=self.look,
            jpeg_quality=self.jpeg_quality,
        )

    def _camera(self) -> pycolmap.Camera:
        import pycolmap

        from colmap_refract.files.cameras_file import read_cameras

        if self.camera_path is None:
            if self.camera_model not in pycolmap.CameraModelId.__members__ or self.camera_model == "INVALID":
                raise RefractError(f"camera_model {self.camera_model} is not one of COLMAP's, such as SIMPLE_RADIAL")
            return pycolmap.Camera.create_from_model_name(
                1, self.camera_model, self.focal_length, self.width, self.height
            )
        cameras = read_cameras(self.camera_path)
        if len(cameras) != 1:
            raise RefractError(f"{self.camera_path} holds {len(cameras)} cameras; give a file with the one to plan for")
        return next(iter(cameras.values()))

    def _layers(self) -> Layers:
        if len(self.layer_thickness) != len(self.layer_refractive_index):
            raise RefractError(
                f"{len(self.layer_thickness)} layer_thickness and {len(self.layer_refractive_index)} "
                "layer_refractive_index: give one of each per wall"
            )
        return Layers(thickness=self.layer_thickness, index=(*self.layer_refractive_index, self.refractive_index))

    def _waves(self) -> tuple[Wave, ...]:
        import numpy as np

        from colmap_refract.simulation.surface import Wave

        count = len(self.wave_amplitude)
        if len(self.wavelength) != count or len(self.wave_direction) not in (0, count):
            raise RefractError(
                f"{count} wave_amplitude, {len(self.wavelength)} wavelength and {len(self.wave_direction)} "
                "wave_direction: give one of each per wave, or no direction at all"
            )
        # A golden angle apart, so that no two run together.
        directions = self.wave_direction or tuple(137.508 * k for k in range(count))
        phases = np.random.default_rng(self.seed).uniform(0, 360, count)
        return tuple(
            Wave(amplitude=amplitude, wavelength=length, direction_deg=direction, phase_deg=phase)
            for amplitude, length, direction, phase in zip(
                self.wave_amplitude, self.wavelength, directions, phases.tolist(), strict=True
            )
        )

    def _check_output(self) -> None:
        """The output has folders in it, which are never mixed with those of another."""
        path = self.output_path
        if path is not None and path.is_dir() and any(path.iterdir()):
            raise RefractError(f"the output folder {path} is not empty; choose another")


class _Remaining:
    """Says how many images are done, and how long the others will take."""

    def __init__(self, line: ProgressLine) -> None:
        self._line = line
        self._begin = time.monotonic()

    def __call__(self, done: int, total: int) -> None:
        left = (time.monotonic() - self._begin) / done * (total - done) if done else None
        self._line.say(f"Rendering: {done} of {total} images" + (f", {left:.0f} s left" if left is not None else ""))
