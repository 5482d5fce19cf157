"""Write the example workspaces: one small simulated capture per scenario, as COLMAP would have modelled it.

python workspaces/make_workspaces.py
"""

from __future__ import annotations

import argparse
import shutil
import textwrap
from dataclasses import asdict
from pathlib import Path

import numpy as np

from colmap_refract.simulation import Capture, SceneOptions, ignore_refraction, point_rmse, simulate

SCENES = {
    "moving_interface": (
        "A pool photographed from above while the camera and the level both change: every image has its own pose "
        "and its own interface. The interfaces are tilted by 5 degrees (root mean square).",
        SceneOptions(scenario="moving_interface", num_images=18, num_points=600, seed=1),
    ),
    "static_interface": (
        "A still pool photographed from above by a moving camera: one interface, fixed in the world.",
        SceneOptions(scenario="static_interface", num_images=18, num_points=600, seed=2),
    ),
    "fixed_camera": (
        "A camera that does not move above a surface that does: one pose, an interface per image, tilted by "
        "5 degrees (root mean square). Without refraction there is no baseline, so the model has all "
        "points at one depth.",
        SceneOptions(scenario="fixed_camera", num_images=15, num_points=600, seed=3),
    ),
    "camera_housing": (
        "A camera under water in a housing with a flat port: one interface, fixed in the camera, 50 mm in front of it "
        "and tilted by 5 degrees.",
        SceneOptions(scenario="camera_housing", num_images=18, num_points=600, seed=4),
    ),
}

SCENE_README = """\
# {scenario}

{text}

Simulated; lengths are metres. `sparse/0` is the COLMAP model with refraction ignored: {images} images, {points} points,
{observations} keypoints with a point, intrinsics held at their values in air. Its points are {rmse:.0f} mm from
the truth (root mean square, after a similarity alignment); the keypoints carry {noise:g} px of noise.

    colmap-refract refiner --input_path workspaces/{scenario}/sparse/0 \\
        --output_path /tmp/{scenario} --scenario {scenario}

The scene is a floor about {depth:.2f} m below the camera, the interface {distance:.2f} m. Made by
`workspaces/make_workspaces.py` with

    {options}
"""

README = """\
# Workspaces

Small simulated captures to try the commands on, of two kinds: COLMAP models to refine, and pictures to reconstruct
from.

## Models

One per scenario, for `refiner`. `python workspaces/make_workspaces.py` writes them again.

| workspace | images | points | RMSE with refraction ignored |
|---|---|---|---|
{rows}

Each holds

- `sparse/0/`: a COLMAP 4 model (`cameras`, `images`, `points3D`, `rigs`, `frames`) made with refraction ignored. There
  are no image files: nothing was photographed.
- `truth.npz`: the truth, lengths in metres. `point3D_ids` (n,) and `points` (n, 3); `names` (m,) of the images with
  `cam_from_world` (m, 3, 4) and `planes` (m, 4): the unit normal in the camera's frame, towards the water, and the
  distance from the projection centre along it; `mu`, the refractive index; `scenario`.

The scale and frame of a model without a known distance are arbitrary, so align it to the truth by a similarity before
comparing; `colmap_refract.simulation.point_rmse` does the like for a simulated capture.

## Pictures

One per scenario, rendered by exact ray tracing, for `automatic_reconstructor` and the commands that it is made of.
`python workspaces/make_rendered.py` writes them again.

{rendered}

Each holds `images/`, `calibration/cameras.txt` and the truth, as its README says, with how to judge what was
reconstructed from it.
"""


def write_truth(path: Path, capture: Capture) -> None:
    """The true points, poses and planes, in the order of the ids."""
    points = sorted(capture.reconstruction.points3D.items())
    images = [image for _, image in sorted(capture.reconstruction.images.items())]
    np.savez_compressed(
        path,
        point3D_ids=np.array([point3D_id for point3D_id, _ in points]),
        points=np.array([point.xyz for _, point in points]),
        names=np.array([image.name for image in images]),
        cam_from_world=np.array([image.cam_from_world().matrix() for image in images]),
        planes=np.array([[*normal, distance] for _, (normal, distance) in sorted(capture.planes.items())]),
        mu=np.array(capture.layers.refractive_index),
        scenario=np.array(capture.scenario),
    )


def write_workspace(folder: Path, text: str, options: SceneOptions) -> str:
    """One workspace; returns its row of the table."""
    capture = simulate(options)
    model = ignore_refraction(capture)
    rmse = 1e3 * point_rmse(model, capture)
    # A stale file would be read with the new ones.
    shutil.rmtree(folder, ignore_errors=True)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    write_truth(folder / "truth.npz", capture)
    defaults = asdict(SceneOptions(scenario=options.scenario))
    given = ", ".join(f"{name}={value!r}" for name, value in asdict(options).items() if value != defaults[name])
    readme = SCENE_README.format(
        scenario=options.scenario,
        text=textwrap.fill(text, 110),
        images=model.num_images(),
        points=model.num_points3D(),
        observations=model.compute_num_observations(),
        rmse=rmse,
        noise=options.pixel_noise,
        depth=options.camera_height,
        distance=options.interface_height,
        options=f"SceneOptions(scenario={options.scenario!r}, {given})",
    )
    (folder / "README.md").write_text(readme)
    name = options.scenario
    return f"| [`{name}`]({name}/README.md) | {model.num_images()} | {model.num_points3D()} | {rmse:.0f} mm |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output_path", type=Path, default=Path(__file__).parent, help="where the folders go")
    output_path: Path = parser.parse_args().output_path
    rows = [write_workspace(output_path / name, text, options) for name, (text, options) in SCENES.items()]
    rendered = [f"- [`rendered_{name}`](rendered_{name}/README.md)" for name in SCENES]
    (output_path / "README.md").write_text(README.format(rows="\n".join(rows), rendered="\n".join(rendered)))


if __name__ == "__main__":
    main()
