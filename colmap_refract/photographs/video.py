"""Frames of a video, as stored: whatever rotation its header asks for is ignored, as with images."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.photographs.frames import Frame
from colmap_refract.photographs.images import Gray
from colmap_refract.photographs.silence import silence

FrameFormat = Literal["png", "jpg"]

# FFmpeg's decoders have threads of their own, which `silence` about single calls does not catch. OpenCV looks at this
# when it first uses FFmpeg; -8 is FFmpeg's "quiet". What a user has set stays.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

_JPEG_QUALITY = 98
# Headers count a little wrong in sound files, too.
_FRAMES_AMISS, _FRACTION_AMISS = 2, 0.02
_FEWEST_LEFT = 10  # frames before a break, to choose from


@dataclass(frozen=True)
class Video:
    """A stretch of a video."""

    path: Path
    start_time: float = 0.0
    """Seconds; frames before are passed over."""
    end_time: float | None = None
    """Seconds; frames after are not read."""
    frame_format: FrameFormat = "png"
    """Of image files that are written: without loss, or JPEG of high quality."""

    def __post_init__(self) -> None:
        end = math.inf if self.end_time is None else self.end_time
        if not 0 <= self.start_time < end:
            raise RefractError(f"start_time {self.start_time:g} s is negative or not before end_time {end:g} s")

    def count(self) -> int:
        """Number of frames between start and end, as the header has it; counted if it has none.

        Raises:
            RefractError: there is no such file, or it cannot be decoded.
        """
        with self._opened() as capture:
            total, fps = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        if not total >= 1:
            return sum(1 for _ in self._grabbed())
        if not fps > 0:
            return round(total)
        end = total if self.end_time is None else min(total, self.end_time * fps)
        return max(1, round(end - self.start_time * fps))

    def frames(self, step: int = 1) -> Iterator[Frame]:
        """Every `step`-th frame between start and end, indices counted from the video's first.

        Raises:
            RefractError: there is no such file, it cannot be decoded, it breaks off well before the frame that
                its header says is the last, or there is no frame between start and end.
        """
        first = None
        for index, time, capture in self._grabbed():
            first = index if first is None else first
            if (index - first) % step == 0:
                image = self._retrieve(capture, index)
                gray: Gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
                yield Frame(index=index, name=self._name(index), time=time, gray=gray)
        if first is None:
            raise RefractError(f"{self.path} has no frame from {self.start_time:g} s on; give an earlier start_time")

    def write(self, indices: Collection[int], folder: Path) -> None:
        """Image files of some frames, `frame_000123.png`.

        Raises:
            RefractError: as `frames`.
        """
        missing = set(indices)
        for index, _, capture in self._grabbed():
            if index in missing:
                parameters = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if self.frame_format == "jpg" else []
                data = cv2.imencode(f".{self.frame_format}", self._retrieve(capture, index), parameters)[1]
                (folder / self._name(index)).write_bytes(data.tobytes())
                missing.remove(index)
            if not missing:
                break

    def _name(self, index: int) -> str:
        return f"frame_{index:06d}.{self.frame_format}"

    @contextmanager
    def _opened(self) -> Iterator[cv2.VideoCapture]:
        if not self.path.is_file():
            raise RefractError(f"there is no video {self.path}; give a video file")
        capture = cv2.VideoCapture()
        try:
            # What decoders print of a broken file, the error says in one line.
            with silence():
                opened = capture.open(str(self.path))
            if not opened:
                raise self._undecodable()
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
            yield capture
        finally:
            with silence():
                capture.release()

    def _grabbed(self) -> Iterator[tuple[int, float, cv2.VideoCapture]]:
        """Index, time and the capture that holds it, of each frame between start and end.

        Seeking is exact in few formats, so that all frames before are decoded as well.
        """
        with self._opened() as capture:
            total, fps = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
            index, time = 0, 0.0
            while _grab(capture):
                stamp = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                # Some formats carry no time.
                time = stamp if stamp > 0 or not fps > 0 else index / fps
                if self.end_time is not None and time > self.end_time:
                    return
                if time >= self.start_time:
                    yield index, time, capture
                index += 1
            if index == 0:
                raise self._undecodable()
            if index < total - max(_FRAMES_AMISS, _FRACTION_AMISS * total):
                raise self._broken(index, total, time)

    def _retrieve(self, capture: cv2.VideoCapture, index: int) -> Gray:
        with silence():
            decoded, image = capture.retrieve()
        if not decoded or image is None:
            raise self._broken(index, capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        return np.asarray(image, np.uint8)

    def _broken(self, index: int, total: float, time: float) -> RefractError:
        what = f"the video {self.path} breaks off after {index} of {total:.0f} frames; copy or convert it again"
        end = math.floor(10 * (time - 0.1)) / 10
        if index >= _FEWEST_LEFT and end > self.start_time:
            what += f", or use what is there: --end_time {end:g}"
        return RefractError(what)

    def _undecodable(self) -> RefractError:
        return RefractError(f"the video {self.path} cannot be decoded; copy it again, or convert it, to MP4 say")


def _grab(capture: cv2.VideoCapture) -> bool:
    with silence():
        return capture.grab()
