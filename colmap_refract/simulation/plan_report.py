"""A plan in words: what to expect, whether that is weak, and what would help."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping

import numpy as np

from colmap_refract.simulation.plan import Accuracy, Plan

_WIDTH = 78
# Weak is what a plan is called whose points gain less than this from knowing of refraction at all,
_LEAST_GAIN = 3.0
# whose interface is known to no better than this part of its distance,
_LARGEST_DISTANCE_STD = 0.1
# whose heights are worse than the rest by more than this,
_LARGEST_ANISOTROPY = 6.0
# whose points are in fewer images than this,
_LEAST_OBSERVATIONS = 4
# or too large a part of which is in one image or none.
_LEAST_PART_SEEN = 0.7


def report(plan: Plan, others: Mapping[str, Accuracy]) -> str:
    """The plan as text.

    Args:
        plan: to be told.
        others: what could be changed, and the accuracy it would bring.
    """
    options, accuracy = plan.options, plan.accuracy
    scene = options.scene
    camera = f"{scene.camera_model}, {scene.width} x {scene.height} px, focal length {scene.focal_length:.5g} px"
    place = "port" if scene.scenario == "camera_housing" else "surface"
    lines = [
        "=" * _WIDTH,
        f"Plan of a capture, {scene.scenario}, {scene.layout}",
        "=" * _WIDTH,
        _row("Camera", camera),
        _row("View in air", f"{plan.view_deg[0]:.0f} x {plan.view_deg[1]:.0f} deg"),
        _row("Heights", f"{_m(scene.interface_height)} to the {place}, {_m(scene.water_depth)} of water"),
        _row("One image shows", f"{plan.footprint[0]:.2f} x {plan.footprint[1]:.2f} m of the ground"),
        _row("A pixel shows", f"{1e3 * plan.sample_distance:.3g} mm of the ground"),
        _row("Images", f"{scene.num_images}; a point is in {plan.observations_per_point:.0f} of them (median)"),
        _row("Points in two images or more", f"{plan.num_points} of {scene.num_points}"),
    ]
    if options.waves:
        periods = ", ".join(f"{wave.period(scene.water_depth):.2g} s" for wave in options.waves)
        lines += [
            _row("Waves", f"periods {periods}, slope {np.degrees(np.arctan(plan.wave_slope)):.2g} deg (rms)"),
            _row("They move keypoints by", f"{plan.wave_shift:.2g} px (rms, per axis)"),
        ]
    noise = f"Expected, for keypoints of {scene.pixel_noise:g} px noise (1 sigma, per axis)"
    lines += [
        "",
        noise + (" and a FLAT interface" if options.waves else ""),
        "-" * _WIDTH,
        _row("Points, horizontally", f"+- {_mm(accuracy.horizontal)} per axis (median)"),
        _row(
            "Points, vertically", f"+- {_mm(accuracy.vertical)} (median), a tenth above {_mm(accuracy.worst_vertical)}"
        ),
        _row("Points, RMSE", f"{_mm(accuracy.rmse)}, after a similarity alignment"),
        _row("Points, RMSE without refraction", f"{_mm(plan.ignored)}"),
        _row("Interface", f"distance +- {_mm(accuracy.distance)}, tilt +- {accuracy.tilt_deg:.2g} deg"),
    ]
    if others:
        lines += ["", "Instead                                      points, RMSE    vertically", "-" * _WIDTH]
        lines += [f"{name:<44} {_mm(other.rmse):>12} {_mm(other.vertical):>13}" for name, other in others.items()]
    lines += ["", *(_verdict(plan, others) or ["The plan is sound."])]
    return "\n".join(lines)


def weaknesses(plan: Plan) -> list[str]:
    """What is weak about a plan, a sentence each; none if nothing is."""
    scene, accuracy = plan.options.scene, plan.accuracy
    found = []
    if plan.part_seen < _LEAST_PART_SEEN:
        found.append(f"{1 - plan.part_seen:.0%} of the points are in one image only: take images nearer to each other.")
    if plan.observations_per_point < _LEAST_OBSERVATIONS:
        found.append(f"A point is in {plan.observations_per_point:.0f} images only: more overlap finds wrong matches.")
    if accuracy.rmse > plan.ignored / _LEAST_GAIN:
        found.append(
            f"The points' noise, {_mm(accuracy.rmse)}, is not far below the error of ignoring refraction, "
            f"{_mm(plan.ignored)}: the images hardly show the interface."
        )
    if accuracy.distance > _LARGEST_DISTANCE_STD * scene.interface_height:
        found.append(
            f"The interface's distance is known to {accuracy.distance / scene.interface_height:.0%} only: measure it, "
            "and hold it (interface_distance, refine_interface_distance 0)."
        )
    if scene.scenario != "fixed_camera" and accuracy.vertical > _LARGEST_ANISOTROPY * accuracy.horizontal:
        found.append(
            f"Heights are {accuracy.vertical / accuracy.horizontal:.0f} times worse than positions: incline the views, "
            "or take them farther apart."
        )
    if plan.options.waves and plan.wave_shift > scene.pixel_noise:
        found.append(
            f"The waves move keypoints by {plan.wave_shift:.2g} px, more than their noise: the accuracy above will not "
            "be reached by a flat interface; take more images, or wait for less wind."
        )
    return found


def _verdict(plan: Plan, others: Mapping[str, Accuracy]) -> list[str]:
    found = weaknesses(plan)
    if not found:
        return []
    lines = ["The plan is WEAK:"]
    lines += [textwrap.fill(sentence, _WIDTH, initial_indent="- ", subsequent_indent="  ") for sentence in found]
    better = {name: other.rmse for name, other in others.items() if other.rmse < 0.9 * plan.accuracy.rmse}
    if better:
        best = min(better, key=lambda name: better[name])
        lines.append(
            f"Of what was tried, most would help: {best} ({_mm(better[best])} instead of {_mm(plan.accuracy.rmse)})."
        )
    return lines


def _row(name: str, value: str) -> str:
    return f"{name + ':':<33} {value}"


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"


def _m(metres: float) -> str:
    return f"{metres:.3g} m"
