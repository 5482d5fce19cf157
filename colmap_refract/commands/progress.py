"""One line that says how far it is, for people who watch."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from colmap_refract.estimator.adjustment import Progress


class ProgressLine:
    """One line on standard error that is written over while a solve runs; silent when nobody watches."""

    def __init__(self) -> None:
        self._shown = sys.stderr.isatty()
        self._length = 0

    def __enter__(self) -> ProgressLine:
        self._write("Reading ...")
        return self

    def __exit__(self, *_: object) -> None:
        self._write("")
        if self._shown:
            sys.stderr.write("\r")
            sys.stderr.flush()

    def show(self, stage: str, progress: Progress) -> None:
        """Called by the solver after every iteration, and by other stages after every part."""
        if progress.total is not None:
            self._write(f"{stage}: {progress.iteration} of {progress.total}")
            return
        self._write(
            f"{stage}: iteration {progress.iteration}, error {progress.rms:.4g} px (rms), "
            f"gradient {progress.gradient_max_norm:.2g}"
        )

    def say(self, text: str) -> None:
        """What is being done, in a few words."""
        self._write(text)

    def print(self, text: str) -> None:
        """Lines for standard output, below which the line goes on."""
        self.say("")
        self.say("")
        print(text, flush=True)

    def _write(self, text: str) -> None:
        if self._shown:
            sys.stderr.write("\r" + text[:118].ljust(self._length))
            sys.stderr.flush()
            self._length = len(text[:118])
