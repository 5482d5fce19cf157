"""The one exception that is meant for the user."""

from __future__ import annotations

from collections.abc import Iterable

_MOST_NAMES = 5


class RefractError(Exception):
    """Something about the input or the options that the user can put right.

    The message is one line: what is wrong, and what to do. The command line
    prints it and exits with status 1; scripts catch it as any exception.
    """


def reason_of(error: Exception) -> str:
    """Why something failed: the system's own words, where there are such, without number and path."""
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


def listed(names: Iterable[str]) -> str:
    """The first few names; with their number, where there are more."""
    names = list(names)
    more = f", ... ({len(names)} in all)" if len(names) > _MOST_NAMES else ""
    return ", ".join(names[:_MOST_NAMES]) + more
