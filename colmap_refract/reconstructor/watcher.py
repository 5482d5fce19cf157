"""Whoever is told how far the pipeline is."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from colmap_refract.estimator.adjustment import Progress


class Watcher:
    """Told of what goes on; does nothing by itself."""

    def progress(self, stage: str, done: int, total: int | None, unit: str) -> None:
        """How far a stage is: `done` of `total` (None: unknown)."""

    def say(self, text: str) -> None:
        """What is being done, in a few words."""

    def solving(self, stage: str, progress: Progress) -> None:
        """The refiner has done an iteration."""

    def report(self, label: str, text: str) -> None:
        """What a stage has come to."""

    def warn(self, line: str) -> None:
        """A sentence about what may spoil the result."""
