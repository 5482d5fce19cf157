"""What refraction costs COLMAP's verification and mapping, and what comes back when the rays are refracted.

Simulated captures are written as databases with wrong matches, verified and mapped by COLMAP with the intrinsics held,
and refined with and without the database. The truth of every keypoint is known, so that split tracks can be counted.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from tables import RESULTS, ProgressLine, publish, table

from colmap_refract.mapping.database import read_correspondences
from colmap_refract.mapping.retriangulation import refine_with_database
from colmap_refract.options import RefinerOptions, Scenario
from colmap_refract.refiner.refinement import refine
from colmap_refract.simulation import Capture, SceneOptions, bayesian_bound, noise_bound, simulate
from colmap_refract.simulation.accuracy import align
from colmap_refract.simulation.database import write_database

SCENES: tuple[tuple[Scenario, float, float], ...] = (
    ("moving_interface", 5.0, 0.0),
    ("moving_interface", 8.0, 0.0),
    ("static_interface", 5.0, 0.0),
    ("camera_housing", 5.0, 0.0),
    ("moving_interface", 3.0, 1.5),
)
"""Tilt of the planes and slope of a swell of 1 to 2.5 m, degrees (root mean square)."""
MOST_MORE = 1.01
"""Points after completion over the points there are."""
BOUND_LIMIT, WAVES_LIMIT = 1.1, 2.0
"""RMSE over the bound; with waves of unknown statistics the bound is for a solver that knows them."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """A model's tracks against the truth: `rmse` is in metres, over all points that show one true point."""

    num_points: int
    num_observations: int
    num_split: int
    rmse: float


def tracks_of(model: pycolmap.Reconstruction, capture: Capture) -> Tracks:
    """Compare a model with the true point of each of its keypoints."""
    truth = capture.reconstruction
    shows = {(e.image_id, e.point2D_idx): i for i, point in truth.points3D.items() for e in point.track.elements}
    owners: Counter[int] = Counter()
    found, true = [], []
    for point in model.points3D.values():
        seen = Counter(shows.get((e.image_id, e.point2D_idx), -1) for e in point.track.elements)
        point3D_id, count = seen.most_common(1)[0]
        if point3D_id >= 0 and count >= 2:
            owners[point3D_id] += 1
            found.append(point.xyz)
            true.append(truth.point3D(point3D_id).xyz)
    source, target = np.array(found), np.array(true)
    error = np.linalg.norm(align(source, target, source) - target, axis=1)
    return Tracks(
        num_points=model.num_points3D(),
        num_observations=model.compute_num_observations(),
        num_split=sum(count > 1 for count in owners.values()),
        rmse=float(np.sqrt(np.mean(error**2))),
    )


def mapped(capture: Capture, folder: Path, wrong: float) -> tuple[pycolmap.Reconstruction, Path]:
    """What COLMAP makes of a capture, and the database it was made from."""
    for camera in capture.reconstruction.cameras.values():
        # Without the flag COLMAP's mapper changes the focal length, whatever its options.
        camera.has_prior_focal_length = True
    database = write_database(folder / "database.db", capture.reconstruction, wrong=wrong, verified=False)
    names = sorted(image.name for image in capture.reconstruction.images.values())
    pairs = folder / "pairs.txt"
    pairs.write_text("\n".join(f"{a} {b}" for k, a in enumerate(names) for b in names[k + 1 :]))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pycolmap.verify_matches(database, pairs, verification)
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.extract_colors = False
    options.random_seed = 0
    sparse = folder / "sparse"
    sparse.mkdir()
    models = pycolmap.incremental_mapping(database, folder, sparse, options)
    return max(models.values(), key=lambda model: model.num_reg_images()), database


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_images", type=int, default=20)
    parser.add_argument("--num_points", type=int, default=1500)
    parser.add_argument("--wrong", type=float, default=0.1, help="part of the matches that are wrong")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--result", type=Path, default=RESULTS / "completion.md", help="file to write")
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    progress = ProgressLine(len(SCENES))
    rows, missed = [], []
    for scenario, tilt, slope in SCENES:
        waves = f", swell of {slope:g} deg" if slope else ""
        progress.step(f"{scenario}, tilts of {tilt:g} deg{waves}")
        capture = simulate(
            SceneOptions(
                scenario=scenario,
                num_images=arguments.num_images,
                num_points=arguments.num_points,
                tilt_deg=tilt,
                wave_slope_deg=slope,
                wavelength=(1.0, 2.5),
                seed=arguments.seed,
            )
        )
        options = RefinerOptions(scenario=scenario, interface_shape="soft" if slope else "plane")
        with tempfile.TemporaryDirectory() as folder:
            model, database = mapped(capture, Path(folder), arguments.wrong)
            matches = read_correspondences(database, verified=False)
        before = tracks_of(model, capture)
        alone = tracks_of(refine(model, options).reconstruction, capture)
        after = tracks_of(refine_with_database(model, options, matches).reconstruction, capture)
        bound = bayesian_bound(capture) if slope else noise_bound(capture)
        there = capture.reconstruction.num_points3D()
        name = f"`{scenario}`, tilts of {tilt:g} deg{waves}"
        limit = WAVES_LIMIT if slope else BOUND_LIMIT
        rows.append(
            [
                name, f"{model.num_reg_images()} / {arguments.num_images}", str(there),
                f"{before.num_points} ({before.num_split} split)", f"{after.num_points} ({after.num_split} split)",
                f"{capture.reconstruction.compute_num_observations()}", f"{before.num_observations}",
                f"{after.num_observations}", f"{1e3 * before.rmse:.1f}", f"{1e3 * alone.rmse:.2f}",
                f"{1e3 * after.rmse:.2f}", f"{1e3 * bound:.2f}",
            ]
        )  # fmt: skip
        if after.num_points > MOST_MORE * there:
            missed.append(f"{name}: {after.num_points} points where there are {there}")
        if after.rmse > limit * bound:
            missed.append(f"{name}: RMSE {after.rmse / bound:.2f} x the bound, {limit:g} is the limit")
    progress.clear()
    header = [
        "scenario", "registered", "points there are", "COLMAP's", "after", "observations there are", "COLMAP's",
        "after", "RMSE of COLMAP's [mm]", "refined without the database [mm]", "with it [mm]", "bound [mm]",
    ]  # fmt: skip
    note = f"{100 * arguments.wrong:g} % of the matches of each pair are wrong; 0.5 px of noise."
    return publish(arguments.result, "What refraction cost, and what comes back", [table(header, rows), note], missed)


if __name__ == "__main__":
    sys.exit(main())
