"""Cascades of every architecture, short records for them, and what a Pyro trace says of both."""

from __future__ import annotations

import numpy as np
import pyro
import torch
from pyro import poutine

import pyro_dynogp as dgp
from pyro_dynogp.models.wiring import Dynamic, Static

SMALL = {"pairs": 2, "inducing": 6}

MODELS = {
    "linear": lambda: dgp.Cascade(1, (Dynamic(pairs=2),)),
    "Wiener": lambda: dgp.Wiener(1, **SMALL),
    "Hammerstein": lambda: dgp.Hammerstein(1, **SMALL),
    "Wiener-Hammerstein": lambda: dgp.WienerHammerstein(1, **SMALL),
    "Hammerstein-Wiener": lambda: dgp.HammersteinWiener(1, **SMALL),
    "several channels": lambda: dgp.WienerHammerstein(2, outputs=2, width=2, **SMALL),
    "skips": lambda: dgp.Cascade(
        2,
        (
            Dynamic(pairs=1),
            Static(inducing=5, skip=("inputs",)),
            Dynamic(outputs=2, pairs=2, skip=("g1", "inputs")),
        ),
    ),
    "two dynamic layers": lambda: dgp.Cascade(1, (Dynamic(pairs=1), Dynamic(pairs=2))),
}


def make_record(inputs=1, outputs=1, n=24, seed=0, step=0.1, gaps=False):
    """Some signals; what a model makes of them is the tests' question, not where they are from."""
    rng = np.random.default_rng(seed)
    y = 2.0 + 0.5 * np.cumsum(rng.standard_normal((n, outputs)), 0)
    if gaps:
        y[[2, 7]] = np.nan
        y[11, -1] = np.nan
    u = np.repeat(rng.standard_normal((n // 3 + 1, inputs)), 3, axis=0)[:n]
    return dgp.Record(time=step * np.arange(n), inputs=u, outputs=y)


def case(name, **options):
    """A model, scaled to its record, and the record."""
    model = MODELS[name]()
    record = make_record(model.inputs, model.outputs, **options)
    return model.scaled_to(record), record


def blank(record):
    """The same record without outputs."""
    return dgp.Record(time=record.time, inputs=record.inputs, input_names=record.input_names)


def draw(model, record, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return poutine.trace(model).get_trace(record)


def trajectories(model, suffix=""):
    """Sites of whole signals: every layer's own."""
    return [one.name + suffix for one in model.wires]


def parameters(model, trace):
    """Values of all sites but the signals and the outputs."""
    signals = {one.name for one in model.wires}
    return {
        name: node["value"]
        for name, node in trace.nodes.items()
        if node["type"] == "sample"
        and name.split("_")[0] != "y"
        and not any(name == s or (name.startswith(f"{s}_") and name[len(s) + 1 :].isdigit())
                    for s in signals)
    }  # fmt: skip


def nodes(model, record, values, seed=0):
    """Sites of the model at given values, others drawn, with their log-densities."""
    trace = draw(poutine.condition(model, data=values), record, seed)
    trace.compute_log_prob()
    return {k: v for k, v in trace.nodes.items() if v["type"] == "sample"}


def log_prob(model, record, values, *sites):
    found = nodes(model, record, values)
    return float(sum(found[site]["log_prob_sum"] for site in sites))


def particles(model, count):
    """The model with a plate on the left."""

    def vectorised(record):
        with pyro.plate("particles", count, dim=-1):
            model(record)

    return vectorised
