"""What a record can be made from: files, tables, objects of other libraries."""

from __future__ import annotations

from os import PathLike
from typing import Any, Self, Unpack

import xarray as xr

from pyro_dynogp.data import foreign, readers, text_files
from pyro_dynogp.data.checks import Names
from pyro_dynogp.data.columns import ColumnOptions


class Sources:
    """The constructors of `Record` from what holds columns."""

    @classmethod
    def _of(cls, fields: Any) -> Self:
        make: Any = cls
        return make(**fields)

    @classmethod
    def from_frame(
        cls, frame: Any, inputs: Names = (), outputs: Names = None,
        **options: Unpack[ColumnOptions],
    ) -> Self:  # fmt: skip
        """Record from a table; options as in `readers.read_frame`.

        Args:
            frame: a pandas DataFrame; or another table that narwhals reads (polars, pyarrow, ...),
                where that package is installed.
            inputs: names of the input columns. outputs: names of the output columns.
            options: `readers.read_frame`.
        """
        return cls._of(readers.read_frame(foreign.as_frame(frame), inputs, outputs, **options))

    @classmethod
    def from_csv(
        cls, path: str | PathLike[str], inputs: Names = (), outputs: Names = None,
        **options: Unpack[text_files.TextOptions],
    ) -> Self:  # fmt: skip
        """Record from a text file of columns; options as in `text_files.read_csv`."""
        return cls._of(text_files.read_csv(path, inputs, outputs, **options))

    @classmethod
    def from_xarray(
        cls, dataset: xr.Dataset, inputs: Names = (), outputs: Names = None,
        **options: Unpack[ColumnOptions],
    ) -> Self:  # fmt: skip
        """Record from an xarray Dataset; options as in `readers.read_xarray`."""
        return cls._of(readers.read_xarray(dataset, inputs, outputs, **options))

    @classmethod
    def from_mat(
        cls, path: str | PathLike[str], inputs: Names = (), outputs: Names = None,
        **options: Unpack[ColumnOptions],
    ) -> Self:  # fmt: skip
        """Record from the vectors of a MATLAB file; options as in `foreign.read_mat`."""
        return cls._of(foreign.read_mat(path, inputs, outputs, **options))

    @classmethod
    def from_benchmark(cls, data: Any, *, sampling_time: float | None = None) -> Self:
        """Record from a data set of the package nonlinear_benchmarks, or one like it.

        The first `data.state_initialization_window_length` samples of a test set are not to be
        scored: ``scores(..., skip=...)``.

        Args:
            data: with attributes `u` and `y`, (n,) or (n, channels), and `sampling_time`.
            sampling_time: step [s], where `data` has none.

        Raises:
            ValueError: no such attributes, no step, or arrays that are no channels.
        """
        return cls._of(foreign.read_benchmark(data, sampling_time))
