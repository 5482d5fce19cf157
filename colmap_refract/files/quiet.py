"""COLMAP kept off the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet_pycolmap() -> Iterator[None]:
    """COLMAP logs nothing in the block: what matters comes as an exception, or is said by the caller."""
    from pycolmap import logging

    level = logging.minloglevel
    logging.minloglevel = logging.FATAL.value
    try:
        yield
    finally:
        logging.minloglevel = level
