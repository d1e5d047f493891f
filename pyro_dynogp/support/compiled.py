"""How functions are compiled, and when their compiled code goes.

Arithmetic is that of the source, operation by operation: no sum is reordered, no step contracted.
What the compiler may reorder it reorders as its inlining has it, and that depends on whether a
called function was compiled in this process or read from disk; two processes would then differ in
the last bits, and a resumed fit would not be the fit that was killed. It costs 6 to 10 % of speed.

numba keeps machine code beside a module and makes it again when that module's file changes. It does
not look at the modules that the compiled functions call: after a change in one of them alone the
old code would go on being used, silently.
"""

from __future__ import annotations

from pathlib import Path

from numba import njit

# Division by zero gives infinity, which callers tell from a covariance.
OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy"}


def accepted(**options: object) -> bool:
    """Whether this version of numba knows the options; nothing is compiled to find out."""
    try:
        from numba.core.compiler import Flags

        njit(lambda: None).targetdescr.options.parse_as_flags(Flags(), options)
    except (ImportError, AttributeError, KeyError, TypeError):  # unknown, or asked otherwise
        return False
    return True


# For what allocates nothing and returns no array: the caller holds all arrays, and counting its
# references would cost more than the arithmetic of one sample. The option is numba's own, so it is
# left out where numba no longer has it: the results are the same, the recursions slower.
BORROWING = {**OPTIONS, "_nrt": False} if accepted(_nrt=False) else dict(OPTIONS)
# Such leaves when they become part of their caller: handing over many arrays costs more than a row.
WITHIN = {**BORROWING, "forceinline": True}
# The same where an array is returned; the caller's own options rule then.
INLINED = {**OPTIONS, "inline": "always"}


def drop_stale(folder: Path, *called: Path) -> list[Path]:
    """Remove kept machine code of a package's folder that is older than one of its sources.

    Args:
        folder: of the package. called: folders whose compiled functions it calls.

    Returns:
        The files removed. Where they may not be removed (an installation that is read only) numba
        could not have written them there either.
    """
    kept = list((folder / "__pycache__").glob("*.nb[ic]"))
    if not kept:
        return []
    sources = [path for f in (folder, *called) for path in f.glob("*.py")]
    sources.append(Path(__file__))  # here are the compiler's options
    changed = max(source.stat().st_mtime for source in sources)
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
