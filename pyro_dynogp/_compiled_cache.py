"""Compiled code that is kept on disk must not outlive the sources that it was made of.

numba keeps machine code beside a module and makes it again when that module's file changes. It does
not look at the modules that the compiled functions call: after a change in one of them alone the
old code would go on being used, silently.
"""

from __future__ import annotations

from pathlib import Path


def drop_stale(folder: Path) -> list[Path]:
    """Remove kept machine code of a package's folder that is older than one of its sources.

    Returns:
        The files removed. Where they may not be removed (an installation that is read only) numba
        could not have written them there either.
    """
    kept = list((folder / "__pycache__").glob("*.nb[ic]"))
    if not kept:
        return []
    changed = max(source.stat().st_mtime for source in folder.glob("*.py"))
    removed = []
    for path in kept:
        try:
            stale = path.stat().st_mtime < changed
        except FileNotFoundError:  # another process was first
            continue
        if stale:
            removed.append(path)
    if not removed:
        return []
    # All of them: which function calls which is not known here.
    for path in kept:
        try:
            path.unlink(missing_ok=True)
        except PermissionError:
            return []
    return kept
