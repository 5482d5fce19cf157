"""The machine that a run has at its disposal."""

from __future__ import annotations

import os


def threads(wanted: int) -> int:
    """`wanted` threads; where that is not positive, as many as there are cores that this process may use."""
    if wanted > 0:
        return wanted
    # What a container or a queue gives the process is known on Linux only.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
