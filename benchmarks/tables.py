"""What the benchmarks share: Markdown tables, the lines that say how they were made, and a progress line."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path

RESULTS = Path(__file__).parent / "results"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table whose columns also line up as plain text; columns of numbers are set to the right."""
    body = [list(row) for row in rows]
    widths = [max(len(cell) for cell in column) for column in zip(header, *body, strict=True)]
    right = [bool(body) and all(_is_number(row[c]) for row in body) for c in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        padded = (
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(cells, widths, right, strict=True)
        )
        return f"| {' | '.join(padded)} |"

    rule = "|".join("-" * (width + 1) + (":" if r else "-") for width, r in zip(widths, right, strict=True))
    return "\n".join([line(header), f"|{rule}|", *map(line, body)])


def _is_number(cell: str) -> bool:
    return cell == "-" or cell[:1] in set("+-.0123456789")


def environment() -> str:
    """Versions and cores that a result was obtained with."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("pycolmap", "pyceres", "numpy", "numba"))
    return f"Python {sys.version.split()[0]}, {packages}; {len(os.sched_getaffinity(0))} cores."


def command() -> str:
    """The command line of this run as one would type it in the repository; of absolute paths only the name."""
    arguments = [Path(argument).name if Path(argument).is_absolute() else argument for argument in sys.argv[1:]]
    return shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *arguments])


def publish(path: Path, title: str, sections: Sequence[str], missed: Sequence[str]) -> int:
    """Print a result and write it to a Markdown file.

    Args:
        path: the file; its folder is made.
        title: of the page.
        sections: Markdown.
        missed: the limits that were not kept, a sentence each; printed at the end, to standard error.

    Returns:
        The exit status, 1 if a limit was missed.
    """
    verdict = "\n".join(f"- MISSED: {sentence}" for sentence in missed) or "All limits are kept."
    parts = [f"# {title}", f"    {command()}", environment(), *sections, f"## Limits\n\n{verdict}"]
    text = "\n\n".join(parts) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    print(text, end="")
    for sentence in missed:
        print(f"MISSED: {sentence}", file=sys.stderr)
    return 1 if missed else 0


class ProgressLine:
    """One line on standard error, `3/40 what is being done`, written over; silent when nobody watches."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._count = 0
        self._shown = sys.stderr.isatty()

    def step(self, what: str) -> None:
        """Say what is begun now."""
        self._count += 1
        self._write(f"{self._count}/{self._total} {what}")

    def clear(self) -> None:
        """Leave an empty line behind."""
        self._write("")

    def _write(self, text: str) -> None:
        if self._shown:
            sys.stderr.write(f"\r{text[:100]:100s}" + ("" if text else "\r"))
            sys.stderr.flush()
