"""What is computed for the stored results: 12 fits, 6 leave-one-out sums, 20 closed loops.

Every case is a function without arguments that returns numbers and texts as JSON has them. Only
public names are used, so that the same cases run on any version of the package.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import pyro_dynogp as dgp
from tests.benchmarks.planted import Case, study
from tests.conftest import simulate_record
from tests.inference.cascades import wiener_record

QUICK: dict[str, Any] = {"progress": False, "workers": 1, "seed": 0}
EFFECTS = (
    "extra input", "dead time", "unmodelled dynamics", "output nonlinearity",
    "input nonlinearity", "saturation", "dead zone", "hysteresis", "drift", "level shift",
    "periodic disturbance", "calendar", "clock shift", "heavy tails", "heteroscedastic noise",
    "process noise", "feedback", "outside catalogue", None, None,
)  # fmt: skip


def drives() -> dgp.Record:
    """The first 300 samples of the coupled drives."""
    return dgp.datasets.load("coupled_drives", record=1).train[:300]


def furnace() -> dgp.Record:
    """The gas furnace, 200 samples."""
    return dgp.datasets.load("gas_furnace").train[:200]


def two_outputs() -> dgp.Record:
    """Two outputs that share a pair, with gaps."""
    modes = dgp.Modes([-0.4 + 1.5j], [[0.8 - 0.3j]], [[1.0], [0.4 + 0.3j]], [[0.05, 0.02]])
    record = simulate_record(modes, 0.02, n=160, seed=3)
    outputs = record.outputs.copy()
    outputs[40:55, 1] = np.nan
    return record.with_outputs(outputs)


def fitted(fit: Any, record: dgp.Record, future: dgp.Record | None = None) -> dict[str, Any]:
    """Numbers of a fit."""
    found = {
        "log_joint": -float(fit.start_energies[0]),
        "energies": [float(x) for x in fit.start_energies],
        "mode": {name: value.reshape(-1).tolist() for name, value in fit.mode.items()},
        "log_likelihood": float(np.mean(fit.log_likelihood(record))),
        "one_step": fit.predict(record).mean[:20].reshape(-1).tolist(),
        "simulated": fit.simulate(record, seed=1).mean[:20].reshape(-1).tolist(),
    }
    if future is not None:
        forecast = fit.forecast(record, future, seed=1)
        found["forecast"] = forecast.mean[:20].reshape(-1).tolist()
        found["forecast_sd"] = forecast.sd[:20].reshape(-1).tolist()
    return found


def linear_drives(**options: Any) -> dict[str, Any]:
    """A linear fit of the drives, and its forecast."""
    record = drives()
    model = dgp.LinearDynamicGP(inputs=1, pairs=options.pop("pairs", 2))
    fit = dgp.fit(model, record[:240], **{**QUICK, **options})
    return fitted(fit, record[:240], record[240:])


def linear_furnace(**options: Any) -> dict[str, Any]:
    """A linear fit of the furnace with options of the model."""
    model = dgp.LinearDynamicGP(inputs=1, pairs=2, **options)
    return fitted(dgp.fit(model, furnace(), restarts=3, **QUICK, method="map"), furnace())


def linear_two_outputs() -> dict[str, Any]:
    """Two outputs."""
    record = two_outputs()
    model = dgp.LinearDynamicGP(inputs=1, outputs=2, pairs=1)
    return fitted(dgp.fit(model, record, restarts=3, **QUICK, method="map"), record)


def linear_two_records() -> dict[str, Any]:
    """Two records that share all parameters."""
    record = drives()
    pair = (record[:100], record[120:260])
    fit = dgp.fit(dgp.LinearDynamicGP(inputs=1, pairs=2), pair, restarts=3, **QUICK, method="map")
    return fitted(fit, pair[1])


def cascade(make: Callable[..., Any], **options: Any) -> dict[str, Any]:
    """A short fit of a cascade."""
    record = wiener_record(n=120)
    fit = dgp.fit(make(1, pairs=1, inducing=6, **options), record[:100], restarts=2, steps=40,
                  draws=20, **QUICK)  # fmt: skip
    return fitted(fit, record[:100], record[100:])


FITS: dict[str, Callable[[], dict[str, Any]]] = {
    "linear, drives": linear_drives,
    "linear, drives, svi": partial(linear_drives, method="svi", steps=100, draws=40, restarts=3),
    "linear, drives, adam": partial(linear_drives, optimizer="adam", steps=120, restarts=2),
    "linear, furnace": linear_furnace,
    "linear, furnace, no process noise": partial(linear_furnace, process_noise=False),
    "linear, furnace, first state zero": partial(linear_furnace, initial_state="zero"),
    "linear, furnace, no feedthrough": partial(linear_furnace, feedthrough=False),
    "linear, two outputs": linear_two_outputs,
    "linear, two records": linear_two_records,
    "Wiener": partial(cascade, dgp.Wiener),
    "Hammerstein": partial(cascade, dgp.Hammerstein),
    "Wiener-Hammerstein, Student-t": partial(
        cascade, dgp.WienerHammerstein, likelihood=dgp.StudentT(4.0)
    ),
}


def elpd(method: str, target: str, kind: str = "linear", **options: Any) -> dict[str, Any]:
    """Leave-one-out of a small fit."""
    if kind == "linear":
        record = drives()[:120]
        given = {"steps": 200, "draws": 400} if method == "svi" else {}
        model = dgp.LinearDynamicGP(inputs=1, pairs=1)
        fit = dgp.fit(model, record, method=method, restarts=2, **given, **QUICK)
    else:
        record = wiener_record(n=100)
        fit = dgp.fit(dgp.Wiener(1, pairs=1, inducing=6), record, restarts=2, steps=60, draws=200,
                      **QUICK)  # fmt: skip
    found = dgp.loo(fit, target=target, refits=0, seed=0, progress=False, **options)
    return {"elpd": float(found.elpd_loo), "se": float(found.se)}


LOO: dict[str, Callable[[], dict[str, Any]]] = {
    "linear, mode, missing sample": partial(elpd, "map", "missing sample", parameters="mode"),
    "linear, mode, forecast": partial(elpd, "map", "forecast", parameters="mode"),
    "linear, map, missing sample": partial(elpd, "map", "missing sample"),
    "linear, svi, missing sample": partial(elpd, "svi", "missing sample"),
    "linear, svi, forecast": partial(elpd, "svi", "forecast"),
    "Wiener, missing sample": partial(elpd, "svi", "missing sample", "wiener"),
}


def loop(effect: str | None, replicate: int) -> dict[str, Any]:
    """A closed loop on a development plant: what was found, and the errors."""
    row = study(Case(effect, "strong" if effect else "none", replicate))
    kept = ("named", "p_values", "ties", "reported", "outcome", "before", "after", "seconds")
    return {name: row[name] for name in kept}


LOOPS: dict[str, Callable[[], dict[str, Any]]] = {
    f"{effect or 'nothing'} {replicate}": partial(loop, effect, replicate)
    for effect, replicate in zip(EFFECTS, (0,) * 19 + (1,), strict=True)
}
GROUPS = {"fits": FITS, "loo": LOO, "loops": LOOPS}
