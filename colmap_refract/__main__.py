"""`python -m colmap_refract COMMAND`, and what `colmap-refract` starts: an interrupt while loading is no traceback."""

from __future__ import annotations

import sys


def run() -> int:
    """The command line's exit status."""
    try:
        from colmap_refract.cli import main

        return main()
    except KeyboardInterrupt:
        print("\nInterrupted: nothing was written.", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(run())
