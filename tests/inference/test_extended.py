"""Every model that the loop may start from, extended in every way: the starts have a density."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import DeadZone, Recorded, Trend
from pyro_dynogp.inference.density import WALL, Potential
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.extended import extended_starts
from pyro_dynogp.inference.starts.plans import starting_points
from pyro_dynogp.models.feedback_variants import with_feedback
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.variants import (
    with_channel,
    with_input_function,
    with_integrator,
    with_likelihood,
    with_output_function,
    with_pairs,
    with_process_noise,
)

N = 60
LATE = dgp.LinearDynamicGP(1, pairs=1, channels=(dgp.Delayed("u"),))
BASES: dict[str, Model] = {
    "linear": dgp.LinearDynamicGP(1, pairs=1),
    "two of each": dgp.LinearDynamicGP(2, outputs=2, pairs=1),
    "an integrator": dgp.Cascade(1, (dgp.Dynamic(pairs=1, integrators=1),)),
    "a free dead time": LATE,
    "one of two is late": replace(LATE, inputs=2),
    "heavy tails": dgp.Cascade(1, (dgp.Dynamic(pairs=1),), dgp.StudentT()),
    "Hammerstein": dgp.Hammerstein(1, pairs=1),
    "Wiener": dgp.Wiener(1, pairs=1),
    "Wiener, two of each": dgp.Wiener(2, outputs=2, pairs=1),
    "Hammerstein-Wiener": dgp.HammersteinWiener(1, pairs=1),
    "Wiener-Hammerstein": dgp.WienerHammerstein(1),
    "branches": dgp.ParallelWienerHammerstein(1),
    "feedback": dgp.NonlinearFeedback(1, pairs=1, inducing=4),
    "feedback, two outputs": dgp.NonlinearFeedback(1, outputs=2, pairs=1, inducing=4),
    "hidden": dgp.NonlinearFeedback(1, hidden=1, pairs=1, inducing=4),
    "hidden, two outputs": dgp.NonlinearFeedback(1, outputs=2, hidden=1, pairs=1, inducing=4),
}  # fmt: skip
# Ways of wiring that no ready model has.
CURVED, PLAIN = dgp.Static(outputs=2, inducing=4, name="f"), dgp.Dynamic(pairs=1)
WIRED: dict[str, Model] = {
    "a function of inputs, and feedback": dgp.Cascade(
        2,
        (
            CURVED,
            dgp.Dynamic(pairs=1, sees=("f",), feedback=("b",)),
            dgp.Static(name="b", sees=("g",), inducing=4),
        ),
        output="g",
    ),
    "a function of inputs of which one is late": dgp.Cascade(
        2, (CURVED, PLAIN), channels=(dgp.Delayed("u"),)
    ),
    "a late input before a function": dgp.Cascade(
        2, (PLAIN, dgp.Static(inducing=4)), channels=(dgp.Delayed("u"),)
    ),
    "an integrator behind a function": dgp.Cascade(
        1, (PLAIN, dgp.Static(inducing=4), dgp.Dynamic(pairs=1, integrators=1))
    ),
}
WAYS: dict[str, Callable[[Model], Model | None]] = {
    "the same": lambda model: model,
    "a pair": lambda model: with_pairs(model, 1),
    "an integrator": with_integrator,
    "a function of the inputs": with_input_function,
    "a function of the output": with_output_function,
    "feedback": with_feedback,
    "feedback of a hidden signal": lambda model: with_feedback(model, output=False, hidden=True),
    "feedback of both": lambda model: with_feedback(model, hidden=True),
    "an input": lambda model: with_channel(model, Recorded("w")),
    "a dead zone": lambda model: (
        None if model.late else with_channel(model, DeadZone("u", -0.5, 0.5))
    ),
    "a trend": lambda model: with_channel(model, Trend(0.0, float(N))),
    "process noise": with_process_noise,
    "heavy tails": lambda model: with_likelihood(model, dgp.StudentT()),
}


def made(model: Model) -> dgp.Record:
    """Inputs that hold for some samples, and outputs that follow them."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.standard_normal((N // 4, model.inputs)), 4, axis=0)
    y = np.zeros((N, model.outputs))
    for k in range(1, N):
        y[k] = 0.8 * y[k - 1] + 0.3 * np.tanh(u[k - 1].sum()) + 0.02 * rng.standard_normal()
    y += 0.1 * rng.standard_normal(y.shape)
    names, w = ("u", "v")[: model.inputs], rng.standard_normal(N)
    return dgp.Record(np.arange(N), u, y, input_names=names, extra={"w": w})


@pytest.mark.parametrize("name", BASES)
def test_starts_of_every_extension_have_a_density(name: str) -> None:
    base = BASES[name]
    record = made(base)
    quick = {"method": "map", "restarts": 1, "steps": 1, "workers": 1, "progress": False}
    fit = dgp.fit(base, record, **quick)
    tried = 0
    for way, extend in WAYS.items():
        model = extend(base)
        if model is None:
            continue
        records = model.prepare(record)
        scaled = replace(model, scaling=records[0].scaling)
        starts, new = extended_starts(fit, scaled, records, 0)
        assert starts, way
        potential = Potential(scaled.collapsed, (records,), starts[0])
        assert (potential.energies_at(starts) < WALL).all(), way
        for one in (*starts, new):
            assert all(bool(value.isfinite().all()) for value in one.values()), way
        tried += 1
    assert tried >= 4


@pytest.mark.parametrize("name", WIRED)
def test_first_starts_have_a_density(name: str) -> None:
    model = WIRED[name]
    problem = Problem.of(model, made(model))
    starts = starting_points(problem.target, problem.records, Run(0, workers=1), count=4, steps=2)
    potential = Potential(problem.target, (problem.records,), starts[0])
    assert (potential.energies_at(starts) < WALL).all()


@pytest.mark.parametrize(
    ("larger", "smaller"),
    [
        ("feedback of both", "feedback"),
        ("feedback of both", "feedback of a hidden signal"),
        ("feedback", "the same"),
        ("an input", "the same"),
        ("a dead zone", "the same"),
        ("heavy tails", "the same"),
    ],
)
def test_what_is_made_smaller_starts_at_what_is_learnt(larger: str, smaller: str) -> None:
    """Layers keep their names: what was learnt of the output is no function of a hidden signal."""
    linear = BASES["linear"]
    record = made(linear)
    quick = {"method": "map", "restarts": 1, "steps": 1, "workers": 1, "progress": False}
    more, less = WAYS[larger](linear), WAYS[smaller](linear)
    assert more is not None
    assert less is not None
    fit = dgp.fit(more, record, **quick)
    records = less.prepare(record)
    scaled = replace(less, scaling=records[0].scaling)
    starts, _ = extended_starts(fit, scaled, records, 0)
    start = starts[-1]
    functions = [name for name in start if name.endswith("feedback_values")]
    assert len(functions) == (smaller != "the same")
    for name in functions:
        assert start[name].equal(fit.mode[name])
    assert start["g_log_decay"].equal(fit.mode["g_log_decay"])
    potential = Potential(scaled.collapsed, (records,), start)
    assert (potential.energies_at([start]) < WALL).all()
