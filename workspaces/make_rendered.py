"""Write the rendered workspaces: one small capture per scenario in pictures, with the truth.

python workspaces/make_rendered.py --output_path FOLDER
"""

from __future__ import annotations

import argparse
import shutil
import textwrap
from pathlib import Path

import numpy as np

from colmap_refract.simulation import SceneOptions
from colmap_refract.simulation.rendering import Look
from colmap_refract.simulation.session import Session, SessionOptions, ground_sample_distance, photograph, write_session
from colmap_refract.simulation.truth import CAMERAS_NAME

# Focal lengths, principal point and distortion of an ordinary lens.
CAMERA = {
    "camera_model": "OPENCV",
    "width": 800,
    "height": 600,
    "focal_length": 640.0,
    "camera_params": (640.0, 641.5, 403.2, 296.4, -0.09, 0.03, 0.0006, -0.0004),
}
# Clear water, which takes the red, and a small camera.
LOOK = Look(
    exposure=1.35,
    attenuation=(0.30, 0.06, 0.04),
    veil=(0.01, 0.05, 0.06),
    vignetting=0.5,
    blur=0.5,
    shot_noise=0.012,
    read_noise=0.003,
)
SCENES = {
    "moving_interface": (
        "A pool photographed from above while the camera and the level both change: every image has its own pose "
        "and its own interface. The interfaces are tilted by 5 degrees (root mean square).",
        SceneOptions(scenario="moving_interface", num_images=12, seed=11, **CAMERA),
    ),
    "static_interface": (
        "A still pool photographed from above by a moving camera: one interface, fixed in the world.",
        SceneOptions(scenario="static_interface", num_images=12, seed=12, **CAMERA),
    ),
    "fixed_camera": (
        "A camera that does not move above a surface that does: one pose, an interface per image, tilted by "
        "5 degrees (root mean square).",
        SceneOptions(scenario="fixed_camera", num_images=12, seed=13, **CAMERA),
    ),
    "camera_housing": (
        "A camera under water in a housing with a flat port: one interface, fixed in the camera, 50 mm in front of it "
        "and tilted by 5 degrees.",
        SceneOptions(scenario="camera_housing", num_images=12, seed=14, **CAMERA),
    ),
}

README = """\
# Rendered: {scenario}

{text}

{images} images of {width} x {height} px, rendered by exact ray tracing: stones and sand on a ground with
{relief:.2f} m of relief, {depth:.2f} m below the cameras, the interface {distance:.2f} m below them. A pixel shows
{sample:.1f} mm of the ground.

- `images/`: the pictures, JPEG.
- `calibration/cameras.txt`: the true intrinsics, COLMAP's format, as calibrated in air.
- `truth.npz`: lengths in metres. `names` (m,) of the images with `cam_from_world` (m, 3, 4) and `planes` (m, 4): the
  unit normal in the camera's frame, towards the water, and the distance from the projection centre along it; `mu`, the
  refractive index; `scenario`; the heights of the ground, and the options it was made with.

What a reconstruction from the pictures is worth:

```python
from colmap_refract.simulation.judge import judge
from colmap_refract.simulation.truth import load_truth

import pycolmap

truth = load_truth("{folder}")
print(judge(pycolmap.Reconstruction("sparse_refractive/0"), truth))
```

`truth.trace(image_name, pixels)` gives the points of the ground that pixels show, `truth.project(image_name, points)`
the pixels at which points are seen. Made by `workspaces/make_rendered.py`.
"""


def write_readme(folder: Path, text: str, session: Session) -> None:
    scene, truth = session.options.scene, session.truth
    sample = np.median([ground_sample_distance(view, truth.terrain) for view in truth.views])
    (folder / "README.md").write_text(
        README.format(
            scenario=scene.scenario,
            text=textwrap.fill(text, 110),
            images=len(truth.names),
            width=scene.width,
            height=scene.height,
            relief=np.ptp(truth.terrain.heights),
            depth=scene.camera_height,
            distance=scene.interface_height,
            sample=1e3 * sample,
            folder=f"workspaces/rendered_{scene.scenario}",
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output_path", type=Path, default=Path(__file__).parent, help="where the folders go")
    parser.add_argument("--jpeg_quality", type=int, default=85, help="of the pictures")
    parser.add_argument("scenarios", nargs="*", default=list(SCENES), help="which of them; all by default")
    arguments = parser.parse_args()
    for name in arguments.scenarios:
        text, options = SCENES[name]
        folder = arguments.output_path / f"rendered_{name}"
        # A stale file would be read with the new ones.
        for stale in ("images", Path(CAMERAS_NAME).parent):
            shutil.rmtree(folder / stale, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        session = photograph(SessionOptions(scene=options, look=LOOK, jpeg_quality=arguments.jpeg_quality))
        write_session(session, folder)
        write_readme(folder, text, session)
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        print(f"{folder}: {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
