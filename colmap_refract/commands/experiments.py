"""`experiments`: the paper's experiments on simulated captures, and a report of them."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from colmap_refract.commands.progress import ProgressLine
from colmap_refract.experiments.run import EXPERIMENTS, Request


@dataclass(frozen=True, kw_only=True)
class Experiments:
    """Run the paper's experiments on simulated captures of the same set-ups.

    Writes index.html, a page with everything in it, results.md, the tables, results.json, every run, and the charts.
    Needs matplotlib: pip install "colmap-refract[experiments]".
    """

    output_path: Path
    """Folder to write the report to."""
    only: str = ",".join(EXPERIMENTS)
    """Which experiments, their names separated by commas."""
    seeds: int = 5
    """Captures of each set-up, drawn anew."""
    num_threads: int = -1
    """Captures that are measured at once, a process each; -1: as many as there are cores."""
    overwrite: bool = False
    """Replace a report that is at output_path."""

    def run(self) -> None:
        """Simulate, measure, report."""
        request = Request(
            only=tuple(name.strip() for name in self.only.split(",") if name.strip()),
            num_seeds=self.seeds,
            num_threads=self.num_threads,
        )
        from colmap_refract.experiments import page
        from colmap_refract.experiments.charts import check_matplotlib
        from colmap_refract.experiments.run import run, write
        from colmap_refract.files.output import output_folder

        check_matplotlib()
        with (
            output_folder(self.output_path, input_path=None, overwrite=self.overwrite, own_files=OWN_FILES) as folder,
            ProgressLine() as line,
        ):
            results = run(request, line.say)
            write(results, request, self._command(), folder, line.say)
        for result in results:
            print(page.summary(result))
        print(f"Written to {self.output_path}: open index.html")

    def _command(self) -> str:
        words = ["colmap-refract", "experiments", "--output_path", str(self.output_path)]
        words += ["--only", self.only, "--seeds", str(self.seeds)]
        return shlex.join(words)


OWN_FILES = (
    "index.html", "results.md", "results.json",
    *(f"{name}_{what}" for name in EXPERIMENTS for what in ("rmse.svg", "points.png", "mesh.png", "photographs.png")),
)  # fmt: skip
"""What an earlier run may have written."""
