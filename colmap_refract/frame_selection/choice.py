"""Which frames to reconstruct from, by features, sharpness and length of the optical flow, and why.

"Usually it can be decided which image to use according to the number of detected feature points, or distance of optical
flows (longer optical flow makes longer baseline)": Ichimaru et al., section on real image processing, whose
reconstruction of a mannequin is from 26 of 240 images and a reference.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.frame_selection import fixed_camera, moving_camera
from colmap_refract.frame_selection.looking import Looked, look
from colmap_refract.frame_selection.options import SelectionOptions
from colmap_refract.frame_selection.selection import FrameRecord, Selection, Verdict
from colmap_refract.photographs.frames import FrameSource

_MOST_FRAMES = 600  # that are looked at by default: a minute, and 200 MB of small copies


def select_frames(
    source: FrameSource, options: SelectionOptions, *, watch: Callable[[str], None] = lambda _: None
) -> Selection:
    """Choose frames and a reference.

    Only small copies are kept in memory, 0.3 MB for each frame that is looked at.

    Args:
        source: a folder of images or a video.
        options: what is wanted.
        watch: told how far it is.

    Returns:
        The choice; fewer frames than wanted, and a warning, where fewer can be used.

    Raises:
        RefractError: fewer than two frames, or than two that can be used or differ; an unknown reference; frames
            that cannot be read or are of different sizes.
    """
    step = options.frame_step or math.ceil(source.count() / _MOST_FRAMES)
    looked = look(source, options, step, watch)
    decide = _fixed_camera if options.scenario == "fixed_camera" else _moving_camera
    records, warnings = decide(looked, options, watch)
    selection = Selection(
        options=options,
        source=str(source.path),
        image_size=looked.image_size,
        frame_step=step,
        frames=records,
        warnings=[*looked.warnings, *warnings],
    )
    num_chosen = len(selection.chosen)
    if num_chosen < 2:
        raise RefractError(
            f"all {len(records)} frames of {source.path} but one are useless: {_left_out(records)}; "
            "give frames in which something moves"
        )
    if num_chosen < options.num_images:
        selection.warnings.insert(
            0, f"only {num_chosen} of the {options.num_images} images asked for: {_left_out(records)}"
        )
    return selection


def _left_out(records: list[FrameRecord]) -> str:
    counts = Counter(record.verdict for record in records if not record.is_chosen)
    return ", ".join(f"{count} {verdict}" for verdict, count in counts.items()) or "there are no more"


def _fixed_camera(
    looked: Looked, options: SelectionOptions, watch: Callable[[str], None]
) -> tuple[list[FrameRecord], list[str]]:
    choice = fixed_camera.choose(
        looked.usable_smalls,
        looked.usable_grades,
        num_images=options.num_images,
        reference=looked.reference,
        watch=watch,
    )
    scale, records = looked.scale, list(looked.records)
    for k, place in enumerate(looked.usable):
        flow, lost = choice.flows[k], choice.flows[k].is_lost and k != choice.reference
        verdict: Verdict
        difference = None
        if k == choice.reference:
            verdict, reason = "reference", "given"
            if looked.reference is None:
                reason = (
                    f"differs least from the others, by {scale * choice.mean_distance[k]:.1f} px of flow in the mean; "
                    f"all together by {scale * np.nanmean(choice.mean_distance):.1f} px"
                )
        elif k in choice.chosen:
            gain = choice.gains[choice.chosen.index(k)]
            verdict, reason = "chosen", f"{scale * gain:.1f} px of flow from the nearest one chosen before"
        elif lost:
            verdict, reason = "lost track", f"{100 * flow.tracked:.0f} % of the reference's points found"
        else:
            difference = float(scale * choice.nearest[k])
            spare = choice.nearest[k] >= fixed_camera.SIMILAR * looked.side and len(choice.chosen) == options.num_images
            verdict, reason = _not_chosen(difference, spare=bool(spare))
        records[place] = replace(
            records[place],
            verdict=verdict,
            reason=reason,
            difference=difference,
            flow_length=None if lost else scale * flow.length,
            flow=None if lost else (scale * flow.field.coefficients[0], scale * flow.field.coefficients[1]),
            flow_residual=None if lost else scale * flow.field.residual,
            tracked_fraction=flow.tracked,
        )
    warnings = []
    num_lost = sum(record.verdict == "lost track" for record in records)
    if num_lost > len(looked.usable) / 2:
        warnings.append(
            f"in {num_lost} of {len(looked.usable)} usable frames the reference's points are lost: "
            "does the camera move? Choose another scenario, then"
        )
    return records, warnings


def _moving_camera(
    looked: Looked, options: SelectionOptions, watch: Callable[[str], None]
) -> tuple[list[FrameRecord], list[str]]:
    scale, records, grades = looked.scale, list(looked.records), looked.usable_grades
    path = moving_camera.flow_path(looked.usable_smalls, watch)
    warnings = []
    if looked.reference is not None and np.isnan(path.positions[looked.reference]):
        path = path.filled(looked.reference)
        warnings.append(f"the reference {options.reference_image} has nothing in common with the frames around it")
    chosen = moving_camera.choose(path, grades, looked.side, num_images=options.num_images, reference=looked.reference)
    reference = looked.reference
    if reference is None:
        reference = max(chosen, key=lambda k: records[looked.usable[k]].num_features)
    positions = scale * path.positions
    before = dict(zip(chosen[1:], chosen, strict=False))
    for k, place in enumerate(looked.usable):
        verdict: Verdict
        difference = None
        if k in chosen:
            verdict = "reference" if k == reference else "chosen"
            reason = f"{positions[k] - positions[before[k]]:.1f} px of flow since the last" if k in before else "first"
            if k == reference:
                reason += ", given" if looked.reference is not None else ", most features"
        elif np.isnan(positions[k]):
            verdict, reason = "lost track", "no flow from the frames around it, which have one to each other"
        else:
            difference = float(np.nanmin(np.abs(positions[chosen] - positions[k])))
            spare = difference >= scale * moving_camera.MIN_STEP * looked.side and len(chosen) == options.num_images
            verdict, reason = _not_chosen(difference, spare=spare)
        records[place] = replace(
            records[place],
            verdict=verdict,
            reason=reason,
            difference=difference,
            flow_length=None if np.isnan(positions[k]) else float(positions[k]),
        )
    return records, [*warnings, *_path_warnings(looked, path, chosen)]


def _not_chosen(difference: float, *, spare: bool) -> tuple[Verdict, str]:
    """Verdict and reason of a frame that could have been chosen; `spare` if it is a view of its own."""
    return "not needed" if spare else "too similar", f"{difference:.1f} px of flow from a chosen one"


def _path_warnings(looked: Looked, path: moving_camera.FlowPath, chosen: list[int]) -> list[str]:
    names = [looked.records[place].name for place in looked.usable]
    warnings, side = [], looked.side
    if path.breaks:
        where = ", ".join(names[k] for k in path.breaks[:3]) + (", ..." if len(path.breaks) > 3 else "")
        warnings.append(
            f"no flow from the frames before was found at {len(path.breaks)} of {len(names)} usable frames ({where}): "
            "a cut, or too long a way between frames"
        )
    most = float(np.nanmax(np.diff(path.positions[chosen]), initial=0.0))
    if most > moving_camera.MAX_STEP * side:
        enough = math.ceil(path.length / (moving_camera.MAX_STEP / 2 * side)) + 1
        warnings.append(
            f"neighbours are up to {looked.scale * most:.0f} px apart, {100 * most / side:.0f} % of the picture, and "
            f"may overlap too little to be matched; {_enough(enough, len(names), len(chosen))}"
        )
    return warnings


def _enough(enough: int, usable: int, chosen: int) -> str:
    """How to have as many images as would do."""
    if enough <= usable:
        return f"about {enough} images would do (num_images)"
    take = f"take all {usable} that can be used (num_images {usable}), and" if chosen < usable else "if you can,"
    return f"{take} photograph more in between: about {enough} images would do"
