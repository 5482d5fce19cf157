"""Time of a refinement against `pycolmap.bundle_adjustment` without refraction: same tracks, same start, one process.

    python benchmarks/speed.py [--images 100 500] [--threads 2] [--repeats 3]

COLMAP is timed twice: on the very keypoints (which refraction bends away from its model, as a user would
run it) and on the keypoints of the same scene without water, which its model fits and where it converges at its
best. Ours includes everything from finding the start to the last solve after filtering. Peak memory is measured in
a process of its own each.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

NUM_POINTS = {100: 17_500, 500: 98_000}
LARGE = 200
PERTURBATION = 0.003
"""Radians, and of the camera height: what poses and points are off by at the start."""


def make_scene(num_images: int, water: bool) -> tuple[Any, Any]:
    """A simulated survey over a static surface (or without any), and the same with poses and points perturbed."""
    import pycolmap

    from colmap_refract.interface import Layers
    from colmap_refract.simulation import SceneOptions, simulate

    options = SceneOptions(
        scenario="static_interface",
        layout="survey",
        num_images=num_images,
        num_points=NUM_POINTS.get(num_images, 180 * num_images),
        layers=Layers(index=(1.333 if water else 1.0,)),
    )
    capture = simulate(options)
    start = pycolmap.Reconstruction(capture.reconstruction)
    rng = np.random.default_rng(1)
    size = PERTURBATION * options.camera_height
    for frame in start.frames.values():
        turn = pycolmap.Rotation3d(PERTURBATION * rng.standard_normal(3))
        frame.rig_from_world = pycolmap.Rigid3d(turn, size * rng.standard_normal(3)) * frame.rig_from_world
    for point in start.points3D.values():
        point.xyz = point.xyz + size * rng.standard_normal(3)
    return capture, start


def time_colmap(start: Any, num_threads: int) -> dict[str, float]:
    """Seconds and iterations of COLMAP's own adjustment, intrinsics held."""
    import pycolmap

    model = pycolmap.Reconstruction(start)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = options.refine_principal_point = False
    options.ceres.solver_options.num_threads = num_threads
    options.ceres.solver_options.function_tolerance = 1e-9
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    began = time.perf_counter()
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    seconds = time.perf_counter() - began
    ceres = summary.ceres_summary
    return {"seconds": seconds, "iterations": ceres.num_successful_steps + ceres.num_unsuccessful_steps}


def time_ours(start: Any, capture: Any, num_threads: int) -> dict[str, float]:
    """Seconds of the refinement, and the accuracy it reached."""
    from colmap_refract import RefinerOptions, refine
    from colmap_refract.simulation import point_rmse

    began = time.perf_counter()
    result = refine(start, RefinerOptions(scenario="static_interface", num_threads=num_threads))
    total = time.perf_counter() - began
    return {
        "seconds": result.sidecar.statistics["solve_seconds"],
        "total": total,
        "iterations": result.sidecar.solver["num_iterations"],
        "rmse": point_rmse(result.reconstruction, capture),
        "converged": float(result.converged),
    }


def measure(num_images: int, num_threads: int, repeats: int) -> dict[str, float]:
    """All figures of one scene, medians over the repeats; the methods take turns."""
    capture, start = make_scene(num_images, water=True)
    _, dry_start = make_scene(num_images, water=False)
    warm, warm_start = make_scene(12, water=True)
    time_ours(warm_start, warm, num_threads)  # loads the compiled kernels
    rows = []
    for repeat in range(repeats):
        print(f"{num_images} images, repeat {repeat + 1} of {repeats} ...", file=sys.stderr, flush=True)
        ours = time_ours(start, capture, num_threads)
        dry = time_colmap(dry_start, num_threads)
        bent = time_colmap(start, num_threads)
        rows.append(
            {
                "ours": ours["seconds"],
                "ours_total": ours["total"],
                "rmse_mm": 1e3 * ours["rmse"],
                "converged": ours["converged"],
                "colmap_fits": dry["seconds"],
                "colmap_fits_iterations": dry["iterations"],
                "colmap_same": bent["seconds"],
                "colmap_same_iterations": bent["iterations"],
                "ratio_fits": ours["seconds"] / dry["seconds"],
                "ratio_same": ours["seconds"] / bent["seconds"],
            }
        )
    result = {key: float(np.median([row[key] for row in rows])) for key in rows[0]}
    result["observations"] = start.compute_num_observations()
    return result


def reset_peak() -> None:
    """Forget the peak of making the scene (Linux; elsewhere the whole process is measured)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_since_reset() -> float:
    """Peak resident memory, MB, since `reset_peak`."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def peak_memory(num_images: int, num_threads: int, method: str) -> float:
    """Peak resident memory, MB, while solving, of a process that holds the scene."""
    command = [sys.executable, __file__, "--images", str(num_images), "--threads", str(num_threads), "--memory", method]
    return float(json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)["peak"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, nargs="+", default=[100, 500])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--memory", choices=["ours", "colmap"], help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.memory:
        capture, start = make_scene(arguments.images[0], water=True)
        reset_peak()
        run = time_ours(start, capture, arguments.threads) if arguments.memory == "ours" else None
        if run is None:
            time_colmap(start, arguments.threads)
        print(json.dumps({"peak": peak_since_reset()}))
        return
    head = (
        "images", "observations", "refiner [s]", "COLMAP, no water [s] (iterations)", "ratio",
        "COLMAP, same keypoints [s] (iterations)", "ratio", "peak memory, refiner / COLMAP [MB]", "RMSE [mm]",
    )  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for num_images in arguments.images:
        repeats = arguments.repeats if num_images <= LARGE else 1
        row = measure(num_images, arguments.threads, repeats)
        ours, colmap = (peak_memory(num_images, arguments.threads, method) for method in ("ours", "colmap"))
        lines.append(
            f"| {num_images} | {row['observations']:.0f} | {row['ours']:.2f} | "
            f"{row['colmap_fits']:.2f} ({row['colmap_fits_iterations']:.0f}) | {row['ratio_fits']:.2f} | "
            f"{row['colmap_same']:.2f} ({row['colmap_same_iterations']:.0f}) | {row['ratio_same']:.2f} | "
            f"{ours:.0f} / {colmap:.0f} | {row['rmse_mm']:.2f} |"
        )
    text = (
        f"Medians of {arguments.repeats} runs (one run over {LARGE} images), {arguments.threads} threads; "
        f"{os.cpu_count()} cores.\n\n" + "\n".join(lines)
    )
    print(text)
    results = Path(__file__).parent / "results"
    results.mkdir(exist_ok=True)
    command = (
        f"python benchmarks/speed.py --images {' '.join(map(str, arguments.images))} --threads {arguments.threads}"
    )
    (results / "speed.md").write_text(f"`{command} --repeats {arguments.repeats}`\n\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
