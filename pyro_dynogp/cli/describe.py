"""What `pyro-dynogp info` tells."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import click

from pyro_dynogp.cli.data import DATASETS, existing, table_of
from pyro_dynogp.cli.tables import aligned

PACKAGES = ("torch", "pyro-ppl", "gpytorch", "numpy", "scipy", "numba", "pandas", "matplotlib")


def tell(subject: str | None, layout: Mapping[str, Any]) -> None:
    """Print about the package, or about one data set, saved fit or CSV file."""
    if subject is None:
        _tell_versions()
    elif subject in DATASETS:
        _tell_dataset(subject)
    elif _is_safetensors(existing(subject)):
        _tell_fit(Path(subject))
    else:
        _tell_columns(Path(subject), layout)


def _tell_versions() -> None:
    versions = ", ".join(f"{package} {metadata.version(package)}" for package in PACKAGES)
    click.echo(f"pyro-dynogp {metadata.version('pyro-dynogp')}")
    click.echo(f"Python {platform.python_version()}, {versions}")
    click.echo("\nData sets (pyro-dynogp info NAME tells more):")
    for name, line in DATASETS.items():
        click.echo(f"  {name:<22}{line}")


def _is_safetensors(path: Path) -> bool:
    """Whether the file begins as the format does: eight bytes of length, then JSON."""
    with path.open("rb") as file:
        return file.read(9)[8:] == b"{"


def _tell_dataset(name: str) -> None:
    from pyro_dynogp.examples import datasets

    data = datasets.load(name)
    click.echo(f"{name}: {DATASETS[name]}\nSource: {data.source}\nProtocol: {data.protocol}")
    trains = data.train if isinstance(data.train, tuple) else (data.train,)
    for label, record in (*(("train", one) for one in trains), ("test", data.test)):
        click.echo(f"\n{label}: {record.summary()}")


def _tell_fit(path: Path) -> None:
    from pyro_dynogp import load

    fit = load(path)
    scaling = fit.scaling
    click.echo(fit.summary())
    for role in ("input", "output"):
        names, units = getattr(scaling, f"{role}_names"), getattr(scaling, f"{role}_units")
        shown = [f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True)]
        click.echo(f"{role}s: {', '.join(shown) or 'none'}")
    click.echo(f"training: step {scaling.time_step:g} {scaling.time_unit}, "
               f"length {scaling.duration:g} {scaling.time_unit}")  # fmt: skip
    for record in fit.training:
        click.echo(f"training record: SHA-256 {record}")
    for name, value in fit.diagnostics.items():
        click.echo(f"{name}: {value:.6g}")


def _tell_columns(path: Path, layout: Mapping[str, Any]) -> None:
    import numpy as np

    table = table_of(path, layout)
    click.echo(f"{path}: {len(table.lines)} rows, {len(table.columns)} columns")
    rows: list[tuple[str, ...]] = [("column", "holds", "unit", "min", "mean", "max", "missing")]
    texts = []
    for name, cells in table.columns.items():
        unit = table.units.get(name, "-")
        try:
            values = table.numbers(name)
        except ValueError:  # a cell that is no number: a column of stamps or of text
            rows.append((name, _kind_of_text(table, name), unit, "", "", "", ""))
            texts.append(f"{name}: {cells[0]} ... {cells[-1]}")
            continue
        seen = values[np.isfinite(values)]
        numbers = (seen.min(), seen.mean(), seen.max()) if len(seen) else (np.nan,) * 3
        shown = (f"{number:.5g}" for number in numbers)
        rows.append((name, "numbers", unit, *shown, str(len(values) - len(seen))))
    click.echo("\n".join([aligned(rows, left=3), *texts]))


def _kind_of_text(table: Any, name: str) -> str:
    try:
        table.times(name, "UTC")
    except ValueError:
        return "text"
    return "time stamps"
