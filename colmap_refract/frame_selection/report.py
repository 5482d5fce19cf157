"""The choice of frames in words and numbers, for a terminal, and as data."""

from __future__ import annotations

import dataclasses
import json

import numpy as np

from colmap_refract.frame_selection.selection import FrameRecord, Selection

FORMAT = "colmap_refract selection"
VERSION = 1

_WIDTH = 78
_MOST_NAMES = 3
_LEFT_OUT = ("blurred", "few features", "lost track", "too similar", "not needed")


def report(selection: Selection) -> str:
    """The report of a choice.

    Returns:
        Lines of text with units, without a final newline.
    """
    chosen, scenario = selection.chosen, selection.options.scenario
    width, height = selection.image_size
    every = "" if selection.frame_step == 1 else f", one in {selection.frame_step}"
    reference = selection.reference
    lines = [
        "=" * _WIDTH,
        f"Choice of frames, {scenario}",
        "=" * _WIDTH,
        _row("Frames looked at", f"{len(selection.frames)}{every}, {width} x {height} px"),
        _row("Chosen", f"{len(chosen)} of {selection.options.num_images} asked for, the reference included"),
        _row("Reference", reference.name),
        _row("", reference.reason),
        _row(
            "", f"{reference.num_features} features, {100 * reference.sharpness:.0f} % of the sharpness of good frames"
        ),
        _row("Criterion", _criterion(selection)),
    ]
    lines += _flow(selection)
    for verdict in _LEFT_OUT:
        left_out = [frame for frame in selection.frames if frame.verdict == verdict]
        if left_out:
            lines.append(_row(f"Left out, {verdict}", _examples(left_out)))
    lines += ["", *_table(chosen, fixed=scenario == "fixed_camera")]
    if selection.warnings:
        lines += ["", *(f"WARNING: {sentence}" for sentence in selection.warnings)]
    return "\n".join(lines)


def to_json(selection: Selection) -> str:
    """All figures of all frames: the text of `selection.json`.

        {"format", "version", "source", "image_size": [width, height], "frame_step", "options": {...},
         "reference": name, "chosen": [names], "warnings": [...],
         "frames": [{"index", "name", "time", "num_features", "sharpness", "verdict", "reason", "flow_length",
                     "difference", "flow", "flow_residual", "tracked_fraction"}, ...]}

    Lengths are in pixels of the original, times in seconds; what was not measured is null.
    """
    data = {
        "format": FORMAT,
        "version": VERSION,
        "source": selection.source,
        "image_size": selection.image_size,
        "frame_step": selection.frame_step,
        "options": dataclasses.asdict(selection.options),
        "reference": selection.reference.name,
        "chosen": [frame.name for frame in selection.chosen],
        "warnings": selection.warnings,
        "frames": [dataclasses.asdict(frame) for frame in selection.frames],
    }
    return json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _row(label: str, value: str) -> str:
    return f"{label + ':' if label else '':40s}{value}"


def _criterion(selection: Selection) -> str:
    if selection.options.scenario == "fixed_camera":
        return "flow from the reference as unlike as can be, in sharp frames rich in features"
    return "even distances along the flow, a sharp frame rich in features at each"


def _flow(selection: Selection) -> list[str]:
    if selection.options.scenario == "fixed_camera":
        return [
            _row("Flow from the reference, chosen", _lengths(selection.chosen)),
            _row("Flow from the reference, all", _lengths(selection.frames)),
        ]
    lengths = np.array([frame.flow_length for frame in selection.chosen], float)
    steps = np.diff(np.sort(lengths))
    share = 100 / max(selection.image_size)
    return [
        _row("Flow along all frames", f"{max(f.flow_length or 0.0 for f in selection.frames):.0f} px"),
        _row(
            "Flow between neighbours",
            f"{np.median(steps):.1f} px ({steps.min():.1f} to {steps.max():.1f}), "
            f"{share * np.median(steps):.1f} % of the picture",
        ),
    ]


def _lengths(frames: list[FrameRecord]) -> str:
    lengths = [f.flow_length for f in frames if f.flow_length is not None and f.verdict != "reference"]
    return f"{np.median(lengths):.1f} px in the median, up to {max(lengths):.1f} px" if lengths else "none"


def _examples(frames: list[FrameRecord]) -> str:
    if frames[0].verdict in ("too similar", "not needed"):
        most = max(frame.difference or 0.0 for frame in frames)
        return f"{len(frames)}, at most {most:.1f} px of flow from a chosen one"
    first, *others = [frame.name for frame in frames[:_MOST_NAMES]]
    more = ["..."] if len(frames) > _MOST_NAMES else []
    return f"{len(frames)}: {', '.join([f'{first} ({frames[0].reason})', *others, *more])}"


def _table(chosen: list[FrameRecord], *, fixed: bool) -> list[str]:
    length = min(max(len(frame.name) for frame in chosen), 40)
    head = f"{'Frame':{length}s}  features  sharpness  " + (
        "flow [px]: median  right   down  tracked" if fixed else "path [px]"
    )
    lines = [head + "  why", "-" * _WIDTH]
    for frame in chosen:
        cells = f"{frame.name:{length}s}  {frame.num_features:8d}  {100 * frame.sharpness:7.0f} %  "
        if fixed:
            right, down = frame.flow or (float("nan"), float("nan"))
            cells += f"{frame.flow_length:17.1f} {right:6.1f} {down:6.1f}  {100 * (frame.tracked_fraction or 0):5.0f} %"
        else:
            cells += f"{frame.flow_length:9.1f}"
        lines.append(f"{cells}  {'the reference' if frame.verdict == 'reference' else frame.reason}")
    return lines
