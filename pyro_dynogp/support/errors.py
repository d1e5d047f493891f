"""One form for the errors that a user can cause, and for warnings: at the user's own line."""

from __future__ import annotations

import inspect
import warnings


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


def warn(message: str) -> None:
    """Warn of the line that called the package."""
    frame, level = inspect.currentframe(), 1
    while frame is not None and str(frame.f_globals.get("__name__")).startswith("pyro_dynogp"):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)
