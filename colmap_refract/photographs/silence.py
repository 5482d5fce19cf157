"""Decoders kept off the terminal: FFmpeg, libjpeg and libpng write what they think of a file to standard error."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Lock

_STANDARD_ERROR = 2  # of the process, whatever sys.stderr is
_lock = Lock()
_depth = 0
_kept: int | None = None


@contextmanager
def silence() -> Iterator[None]:
    """Nothing reaches the process's standard error in the block: what matters is said by the caller.

    Meant to be put about single calls of a decoder, since what other threads write meanwhile is lost as well. Blocks
    may be nested, and may overlap in several threads: the first in closes the way, the last out opens it.
    """
    _enter()
    try:
        yield
    finally:
        _leave()


def _enter() -> None:
    global _depth, _kept
    with _lock:
        _depth += 1
        if _depth > 1:
            return
        # Without a standard error, or with no file left to open, there is nothing to be done; it is only noise.
        with suppress(OSError):
            kept = os.dup(_STANDARD_ERROR)
            try:
                nowhere = os.open(os.devnull, os.O_WRONLY)
                try:
                    os.dup2(nowhere, _STANDARD_ERROR)
                finally:
                    os.close(nowhere)
            except OSError:
                os.close(kept)
                raise
            _kept = kept


def _leave() -> None:
    global _depth, _kept
    with _lock:
        _depth -= 1
        if _depth == 0 and _kept is not None:
            os.dup2(_kept, _STANDARD_ERROR)
            os.close(_kept)
            _kept = None
