"""One form for the errors that a user can cause: what is wrong, with which argument, what to do."""

from __future__ import annotations


def invalid(argument: str, *, expected: str, got: str, advice: str = "") -> ValueError:
    """Build the ValueError that every public function raises on bad input.

    Args:
        argument: name of the argument as the caller wrote it.
        expected: what the argument has to be.
        got: what came instead.
        advice: what to do about it, a full sentence.

    Returns:
        The error, to be raised by the caller (so that the traceback ends there).
    """
    message = f"{argument}: expected {expected}, got {got}."
    return ValueError(f"{message} {advice}" if advice else message)
