"""Going through frames once: small copies, what is measured of each, and which can be chosen from."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.frame_selection.options import SelectionOptions
from colmap_refract.frame_selection.quality import SMALL_SIDE, Grades, Quality, grade, measure
from colmap_refract.frame_selection.selection import FrameRecord
from colmap_refract.interface import Array
from colmap_refract.photographs.frames import Frame, FrameSource
from colmap_refract.photographs.images import Gray, common_size, shrink

_NEIGHBOURS = 15  # that a frame of a moving camera is compared with, on either side


@dataclass(frozen=True, kw_only=True)
class Looked:
    """What is kept of the frames that were looked at: small copies and figures."""

    records: list[FrameRecord]
    grades: Grades
    smalls: list[Gray]
    image_size: tuple[int, int]
    usable: list[int]
    """Frames that can be chosen from, places in `records`."""
    reference: int | None
    """The given one, place in `usable`."""
    warnings: list[str]

    @property
    def side(self) -> int:
        """The longest of the small copies, pixels."""
        return int(max(self.smalls[0].shape))

    @property
    def scale(self) -> float:
        """Pixels of the original per pixel of a small copy."""
        return max(self.image_size) / self.side

    @property
    def usable_smalls(self) -> list[Gray]:
        return [self.smalls[k] for k in self.usable]

    @property
    def usable_grades(self) -> Array:
        return np.array((self.grades.features * self.grades.sharpness)[self.usable], float)


def look(source: FrameSource, options: SelectionOptions, step: int, watch: Callable[[str], None]) -> Looked:
    """Go through all frames once.

    Args:
        source: of the frames.
        options: what is wanted.
        step: every n-th frame is looked at.
        watch: told how far it is.

    Raises:
        RefractError: fewer than two frames, none that can be used, an unknown reference; frames that cannot be read or
            are of different sizes.
    """
    frames: list[Frame] = []
    smalls: list[Gray] = []
    qualities: list[Quality] = []
    by_size: dict[tuple[int, int], list[str]] = {}
    count = math.ceil(source.count() / step)
    for frame in source.frames(step):
        watch(f"Features: frame {len(frames) + 1} of {max(count, len(frames) + 1)}")
        by_size.setdefault((frame.gray.shape[1], frame.gray.shape[0]), [frame.name])
        common_size(by_size)
        small = shrink(frame.gray, SMALL_SIDE)
        smalls.append(small)
        qualities.append(measure(frame.gray, small))
        frames.append(replace(frame, gray=small))
    if len(frames) < 2:
        raise RefractError(f"{source.path} has one frame only to choose from; give two or more (frame_step {step})")
    names = [frame.name for frame in frames]
    if options.reference_image and options.reference_image not in names:
        raise RefractError(
            f"reference_image '{options.reference_image}' is not among the {len(names)} frames of {source.path} that "
            f"were looked at, '{names[0]}' to '{names[-1]}' (one in {step}); give the name of one of them"
        )

    fixed = options.scenario == "fixed_camera"
    grades = grade(qualities, min_num_features=options.min_num_features, window=None if fixed else _NEIGHBOURS)
    usable = [k for k, rejection in enumerate(grades.rejections) if rejection is None]
    if not usable:
        most = max(quality.num_features for quality in qualities)
        raise RefractError(
            f"no frame of {source.path} has {options.min_num_features} features, the best has {most}; "
            "give other images, or a smaller min_num_features"
        )
    warnings = []
    given = names.index(options.reference_image) if options.reference_image else None
    if given is not None and given not in usable:
        rejection = grades.rejections[given]
        assert rejection is not None
        warnings.append(f"the reference {names[given]} would have been left out: {rejection[0]} ({rejection[1]})")
        usable = sorted([*usable, given])
    records = []
    for frame, quality, sharpness, rejection in zip(
        frames, qualities, grades.sharpness, grades.rejections, strict=True
    ):
        record = FrameRecord(
            index=frame.index,
            name=frame.name,
            time=frame.time,
            num_features=quality.num_features,
            sharpness=float(sharpness),
        )
        records.append(record if rejection is None else replace(record, verdict=rejection[0], reason=rejection[1]))
    return Looked(
        records=records,
        grades=grades,
        smalls=smalls,
        image_size=next(iter(by_size)),
        usable=usable,
        reference=None if given is None else usable.index(given),
        warnings=warnings,
    )
