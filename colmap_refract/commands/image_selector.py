"""`image_selector`: the frames to reconstruct from, out of many."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from colmap_refract.commands.progress import ProgressLine
from colmap_refract.errors import RefractError
from colmap_refract.frame_selection.options import SelectionOptions

if TYPE_CHECKING:
    from colmap_refract.photographs.frames import FrameSource


@dataclass(frozen=True, kw_only=True)
class ImageSelector:
    """Choose the frames to reconstruct from, and a reference, out of a folder of images or a video.

    Blurred frames and frames with few features are left out; of the others those are chosen whose optical flow is long
    and unlike. Prints what was chosen and why. Writes images/, image_list.txt, selection.json and selection.png.
    """

    options: Annotated[SelectionOptions, tyro.conf.arg(name="")]
    image_path: Path | None = None
    """Folder of the images, in the order of their names."""
    video_path: Path | None = None
    """A video, in place of the images."""
    output_path: Path | None = None
    """Folder to write the chosen images to. By default only the report is printed."""
    start_time: float = 0.0
    """Seconds; frames of the video before are passed over."""
    end_time: float | None = None
    """Seconds; frames of the video after are passed over."""
    frame_format: Literal["png", "jpg"] = "png"
    """Of images that are taken from a video; jpg is of high quality."""
    overwrite: bool = False
    """Replace an earlier choice that is at output_path."""

    def run(self) -> None:
        """Look, choose, write, report."""
        if (self.image_path is None) == (self.video_path is None):
            raise RefractError("give either --image_path, a folder of images, or --video_path")
        if self.image_path is not None and (self.start_time != 0 or self.end_time is not None):
            raise RefractError("--start_time and --end_time are of a video; images have no time")
        from colmap_refract.frame_selection.choice import select_frames
        from colmap_refract.frame_selection.output import selection_folder, write_selection
        from colmap_refract.frame_selection.report import report

        source = self._source()
        with ExitStack() as stack:
            folder = None
            if self.output_path is not None:
                folder = stack.enter_context(
                    selection_folder(self.output_path, source_path=source.path, overwrite=self.overwrite)
                )
            with ProgressLine() as line:
                selection = select_frames(source, self.options, watch=line.say)
                if folder is not None:
                    line.say("Writing ...")
                    write_selection(selection, source, folder)
        print(report(selection))
        if self.output_path is not None:
            print(f"\nWritten to {self.output_path}")

    def _source(self) -> FrameSource:
        from colmap_refract.photographs.frames import ImageFolder
        from colmap_refract.photographs.video import Video

        if self.image_path is not None:
            return ImageFolder(self.image_path)
        assert self.video_path is not None
        return Video(self.video_path, self.start_time, self.end_time, self.frame_format)
