"""From rendered photographs to a refined model, by the command that a user would run, judged against the truth.

Every scenario is photographed by the simulator, reconstructed by `colmap-refract automatic_reconstructor` from nothing
but the pictures and the intrinsics, and compared with what the pictures really show. The dry case is the control.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import pycolmap
from tables import RESULTS, ProgressLine, publish, table

from colmap_refract.cli import main as colmap_refract
from colmap_refract.files.sidecar import read_sidecar
from colmap_refract.interface import Layers
from colmap_refract.options import Scenario
from colmap_refract.simulation import SceneOptions
from colmap_refract.simulation.judge import Judgement, judge
from colmap_refract.simulation.session import SessionOptions, photograph, write_session
from colmap_refract.simulation.truth import Truth, load_truth

LEAST_REGISTERED = 0.95
BOUND_LIMIT = 1.5
GAIN_LIMIT = 10.0
CONSTANT_DEPTH_LIMIT = 5.0
TILTS = (1.5, 3.0, 8.0)
CAMERA = {"camera_model": "OPENCV", "width": 1000, "height": 750, "focal_length": 800.0}


@dataclass(frozen=True, kw_only=True)
class Case:
    """A capture and how it is reconstructed."""

    name: str
    scene: SceneOptions
    arguments: tuple[str, ...] = ()
    dry: bool = False


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of a case; `refined` is None where the refiner failed. `said`: its error, or its warnings."""

    case: Case
    num_images: int
    num_registered: int
    seconds: float
    before: Judgement
    refined: Judgement | None
    said: str


def cases(num_images: int, seed: int) -> list[Case]:
    """The three scenarios of a moving camera, the fixed one by flow and by SIFT at three tilts, and the control."""
    moving: tuple[Scenario, ...] = ("static_interface", "moving_interface", "camera_housing")
    found = [
        Case(name=scenario, scene=SceneOptions(scenario=scenario, num_images=num_images, seed=seed, **CAMERA))
        for scenario in moving
    ]
    for tilt in TILTS:
        scene = SceneOptions(scenario="fixed_camera", num_images=15, tilt_deg=tilt, seed=seed, **CAMERA)
        for matcher, word in (("flow", "flow"), ("exhaustive", "SIFT")):
            found.append(
                Case(name=f"fixed_camera, {tilt:g} deg, {word}", scene=scene, arguments=("--matcher", matcher))
            )
    air = SceneOptions(
        scenario="static_interface", num_images=num_images, seed=seed, layers=Layers(index=(1.0,)), **CAMERA
    )
    found.append(Case(name="dry", scene=air, dry=True))
    return found


def run(case: Case, folder: Path) -> Outcome:
    """Render the pictures where they are not there yet, reconstruct, judge."""
    scene = case.scene
    photographs = folder / f"{scene.scenario}_{scene.tilt_deg:g}_{scene.layers.refractive_index:g}"
    if not (photographs / "truth.npz").exists():
        photographs.mkdir(parents=True)
        write_session(photograph(SessionOptions(scene=scene)), photographs)
    workspace = folder / case.name.replace(", ", "_").replace(" ", "_")
    started = perf_counter()
    said = _reconstruct(
        *("--workspace_path", str(workspace), "--image_path", str(photographs / "images")),
        *("--camera_path", str(photographs / "calibration"), "--scenario", scene.scenario, *case.arguments),
    )
    seconds = perf_counter() - started
    truth = load_truth(photographs)
    model = pycolmap.Reconstruction(workspace / "sparse" / "0")
    refined = workspace / "sparse_refractive" / "0"
    return Outcome(
        case=case,
        num_images=len(truth.names),
        num_registered=model.num_reg_images(),
        seconds=seconds,
        before=_judge(model, truth),
        refined=_judge(pycolmap.Reconstruction(refined), truth) if refined.exists() else None,
        said=said or " ".join(read_sidecar(refined).solver["warnings"]),
    )


def _judge(model: pycolmap.Reconstruction, truth: Truth) -> Judgement:
    return judge(model, truth)


def _reconstruct(*arguments: str) -> str:
    """What the command said on standard error, if it failed."""
    errors = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
        status = colmap_refract(["automatic_reconstructor", *arguments])
    return errors.getvalue().strip() if status else ""


def moving_row(outcome: Outcome) -> list[str]:
    before, after = outcome.before, outcome.refined
    assert after is not None and after.bound is not None
    return [
        f"`{outcome.case.name}`",
        f"{outcome.num_registered} / {outcome.num_images}",
        str(after.num_points),
        f"{after.keypoint_noise:.3f} / {after.keypoint_rms:.3f}",
        f"{1e3 * before.rmse:.1f}",
        f"{1e3 * after.rmse:.2f}",
        f"{before.rmse / after.rmse:.1f}",
        f"{1e3 * after.bound * after.keypoint_rms / after.keypoint_noise:.2f}",
        f"{after.rmse / rms_bound(after):.2f}",
        f"{outcome.seconds:.0f}",
    ]


def rms_bound(found: Judgement) -> float:
    """The bound for the keypoints' root mean square error, which for SIFT is twice the robust one."""
    assert found.bound is not None
    return found.bound * found.keypoint_rms / found.keypoint_noise


def fixed_row(outcome: Outcome) -> list[str]:
    after = outcome.refined
    assert after is not None
    return [
        outcome.case.name.removeprefix("fixed_camera, "),
        f"{outcome.num_registered} / {outcome.num_images}",
        str(after.num_points),
        f"{after.keypoint_noise:.3f} / {after.keypoint_rms:.3f}",
        f"{1e3 * after.constant_depth_rmse:.0f}",
        f"{1e3 * after.depth_rmse_best90:.1f}",
        f"{after.constant_depth_rmse / after.depth_rmse_best90:.1f}",
        f"{1e3 * rms_bound(after):.1f}",
        f"{1e3 * after.rmse:.1f}",
        f"{outcome.seconds:.0f}",
    ]


def dry_row(outcome: Outcome) -> list[str]:
    return [
        f"{outcome.num_registered} / {outcome.num_images}",
        str(outcome.before.num_points),
        f"{1e3 * outcome.before.rmse:.2f}",
        f"{1e3 * rms_bound(outcome.before):.2f}",
        outcome.said.replace("\n", " ").replace("|", "/") or "nothing",
    ]


def missed(outcome: Outcome) -> list[str]:
    """The limits that an outcome did not keep."""
    name, after, before = outcome.case.name, outcome.refined, outcome.before
    found = []
    if outcome.num_registered < LEAST_REGISTERED * outcome.num_images:
        found.append(f"{name}: {outcome.num_registered} of {outcome.num_images} images registered")
    if outcome.case.dry:
        if before.rmse > BOUND_LIMIT * rms_bound(before):
            found.append(f"{name}: {before.rmse / rms_bound(before):.2f} x the bound, {BOUND_LIMIT:g} is the limit")
        if after is not None and "Straight rays explain the images better" not in outcome.said:
            found.append(f"{name}: an interface was found where there is none, and nothing was said")
        return found
    if after is None:
        return [*found, f"{name}: not refined ({outcome.said})"]
    if outcome.case.scene.scenario == "fixed_camera":
        gain = after.constant_depth_rmse / after.depth_rmse_best90
        if gain < CONSTANT_DEPTH_LIMIT:
            found.append(
                f"{name}: {gain:.1f} times better than a constant depth, {CONSTANT_DEPTH_LIMIT:g} is the limit"
            )
        return found
    if after.rmse > BOUND_LIMIT * rms_bound(after):
        found.append(f"{name}: {after.rmse / rms_bound(after):.2f} x the bound, {BOUND_LIMIT:g} is the limit")
    if before.rmse < GAIN_LIMIT * after.rmse:
        found.append(f"{name}: {before.rmse / after.rmse:.1f} times better than without refraction, not {GAIN_LIMIT:g}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="cases whose name begins so")
    parser.add_argument("--num_images", type=int, default=14, help="of a moving camera")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--work_path", type=Path, help="keep pictures and workspaces here, and go on from them")
    parser.add_argument("--result", type=Path, default=RESULTS / "photographs.md", help="file to write")
    arguments = parser.parse_args()
    chosen = [case for case in cases(arguments.num_images, arguments.seed) if case.name.startswith(arguments.only)]
    if not chosen:
        parser.error(f"no case begins with '{arguments.only}'")
    progress = ProgressLine(len(chosen))
    outcomes = []
    with contextlib.ExitStack() as stack:
        folder = arguments.work_path or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for case in chosen:
            progress.step(case.name)
            outcomes.append(run(case, folder))
    progress.clear()
    done = [outcome for outcome in outcomes if outcome.refined is not None or outcome.case.dry]
    moving = [o for o in done if not o.case.dry and o.case.scene.scenario != "fixed_camera"]
    fixed = [o for o in done if o.case.scene.scenario == "fixed_camera"]
    dry = [o for o in done if o.case.dry]
    sections = []
    if moving:
        header = [
            "scenario", "registered", "points", "keypoint noise, robust / rms [px]", "RMSE ignoring refraction [mm]",
            "RMSE [mm]", "times better", "bound [mm]", "RMSE / bound", "time [s]",
        ]  # fmt: skip
        sections.append("## A moving camera\n\n" + table(header, [moving_row(o) for o in moving]))
    if fixed:
        header = [
            "tilts and tracks", "registered", "points", "keypoint noise, robust / rms [px]",
            "constant depth [mm]", "depth RMSE, best 90 % [mm]", "times better", "bound of the RMSE [mm]", "RMSE [mm]",
            "time [s]",
        ]  # fmt: skip
        sections.append("## A fixed camera\n\n" + table(header, [fixed_row(o) for o in fixed]))
    if dry:
        header = ["registered", "points", "RMSE of COLMAP's model [mm]", "bound [mm]", "what the refiner says"]
        sections.append("## Without water\n\n" + table(header, [dry_row(o) for o in dry]))
    return publish(arguments.result, "From photographs", sections, [line for o in outcomes for line in missed(o)])


if __name__ == "__main__":
    sys.exit(main())
