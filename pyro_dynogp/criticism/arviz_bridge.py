"""All that this package asks of ArviZ (0.21 to 0.23); no other module imports it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import xarray as xr

from pyro_dynogp.inference.pareto import good_k
from pyro_dynogp.support.shown import preformatted


def _arviz() -> Any:
    """ArviZ, imported when it is first needed: it takes seconds."""
    with warnings.catch_warnings():
        # Its notice about version 1, once a day, is not for our users.
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    return arviz


def elpd_data(
    elpd: np.ndarray,
    k: np.ndarray,
    *,
    lppd: float,
    draws: int,
    warning: bool,
    coords: Mapping[str, np.ndarray],
    extra: Mapping[str, Any],
) -> Any:
    """ArviZ's ELPDData from densities (N,) of single samples.

    Args:
        elpd: log predictive density of each sample [nats]. k: (N,) Pareto shapes.
        lppd: log density of all samples with what was fitted to them. draws: S.
        warning: whether something is not reliable.
        coords: (N,) what tells the samples apart. extra: further entries.
    """
    labels = {name: ("observation", value) for name, value in coords.items()}
    pointwise = xr.DataArray(elpd, dims="observation", coords=labels, name="loo_i")
    entries = {
        "elpd_loo": float(elpd.sum()),
        "se": float(np.sqrt(len(elpd) * np.var(elpd))),
        "p_loo": float(lppd - elpd.sum()),
        "n_samples": draws,
        "n_data_points": len(elpd),
        "warning": warning,
        "loo_i": pointwise,
        "pareto_k": pointwise.copy(data=k).rename("pareto_shape"),
        "scale": "log",
        "good_k": good_k(draws),
        **extra,
    }
    return _elpd(entries)


def _elpd(entries: Mapping[str, Any]) -> Any:
    """ArviZ's class of these entries, in their order."""
    return _elpd_class()(data=list(entries.values()), index=list(entries))


@cache
def _elpd_class() -> Any:
    """ArviZ's ELPDData, whose text also says what the draws are of, and the notes."""

    class Elpd(_arviz().stats.stats_utils.ELPDData):  # type: ignore[misc]  # ArviZ has no types
        def copy(self, deep: bool = True) -> Any:
            """A copy of the same kind: ArviZ's own is of its class."""
            return Elpd(super().copy(deep))

        def __str__(self) -> str:
            lines = [super().__str__()]
            if "drawn" in self:
                lines += ["", f"Draws of {self['drawn']} ({self['draws_from']})."]
                lines += [f"Fits or draws made again: {self['refits']}.", *self["notes"]]
            return "\n".join(lines)

        def _repr_html_(self) -> str:
            return preformatted(str(self))

    Elpd.__qualname__ = "Elpd"  # pickle finds it by `__getattr__` below
    return Elpd


def __getattr__(name: str) -> Any:
    """The class of results, which needs ArviZ: for pickle, that looks for it here."""
    if name == "Elpd":
        return _elpd_class()
    raise AttributeError(name)


ARVIZ_ENTRIES = (
    "elpd_loo", "se", "p_loo", "n_samples", "n_data_points", "warning", "loo_i", "pareto_k",
    "scale", "good_k",
)  # fmt: skip


def compare_table(elpds: Mapping[str, Any], method: str) -> Any:
    """`arviz.compare` of ELPDData by name, weights by `method`."""
    plain = {name: _elpd({e: one[e] for e in ARVIZ_ENTRIES}) for name, one in elpds.items()}
    with warnings.catch_warnings():
        # ArviZ sorts tables in a way that pandas 4 will not have.
        warnings.simplefilter("ignore", DeprecationWarning)
        return _arviz().compare(plain, ic="loo", method=method, scale="log")


def inference_data(groups: Mapping[str, xr.Dataset], attrs: Mapping[str, Any]) -> Any:
    """ArviZ's InferenceData.

    Args:
        groups: datasets by the name of their group, in any order.
        attrs: of the whole, repeated in every group, so that a group by itself still has them.
    """
    return _arviz().InferenceData(
        attrs=dict(attrs), **{name: group.assign_attrs(attrs) for name, group in groups.items()}
    )
