"""The one exception that is meant for the user."""

from __future__ import annotations


class RefractError(Exception):
    """Something about the input or the options that the user can put right.

    The message is one line: what is wrong, and what to do. The command line
    prints it and exits with status 1; scripts catch it as any exception.
    """
