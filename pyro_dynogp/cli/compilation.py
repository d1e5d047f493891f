"""The command that compiles all kernels, so that no first fit waits for the compiler."""

from __future__ import annotations

import click

from pyro_dynogp.cli.options import WORK


@click.command(name="compile")
@WORK
def compile_now(workers: int | None, quiet: bool) -> None:
    """Compile the numerical kernels now, once after installation.

    Without this they are compiled when they are first called: a first linear fit waits about 15
    seconds for it, a first fit with a static function about a minute. The result is kept beside the
    package and used by every later process.
    """
    from pyro_dynogp.prediction.compilation import compile_kernels

    compile_kernels(workers=workers, progress=not quiet)
