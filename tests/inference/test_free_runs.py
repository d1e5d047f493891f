"""Fits of cascades are chosen by their free runs, too: the rules, and that they hold."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.inference import free_runs
from pyro_dynogp.inference.free_runs import free_run_error, noise_pays
from pyro_dynogp.inference.methods import mode
from pyro_dynogp.inference.run import Run

LINE = 0.5


def optimum(energy, error):
    return SimpleNamespace(energy=energy, values=error)


def chosen(monkeypatch, *attempts, model=None):
    """Optima that `cascade_optima` returns of given (energy, free-run error) by attempt."""
    model = model or dgp.Wiener(1)
    problem = SimpleNamespace(target=model, records=[], learnt=None)
    twin = (dgp.LinearDynamicGP(1), [], [LINE])
    left = list(attempts)
    monkeypatch.setattr(mode, "linear_twins", lambda *_: {"g": twin})
    monkeypatch.setattr(mode, "spread", lambda *_: [{}])
    monkeypatch.setattr(mode, "free_run_error", lambda model, values, records: values)
    monkeypatch.setattr(mode, "climb", lambda *_, **__: [optimum(*one) for one in left.pop(0)])
    found = mode.cascade_optima(problem, Run(0, 1, False), "adam", 10)
    return [(one.energy, one.values) for one in found], len(attempts) - len(left)


@pytest.mark.parametrize("model", [dgp.Wiener(1), dgp.Hammerstein(1), dgp.NonlinearFeedback(1)])
def test_optima_that_run_worse_than_the_linear_model_are_left_out(monkeypatch, model):
    given = [(-9.0, 0.6), (-7.0, 0.51), (-3.0, 0.4), (-1.0, 0.5)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found, used = chosen(monkeypatch, given, [], model=model)
    assert found == [(-3.0, 0.4), (-1.0, 0.5)]
    assert used == 1


def test_there_is_another_set_of_starts_where_none_holds(monkeypatch):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found, used = chosen(monkeypatch, [(-9.0, 0.6)], [(-8.0, 0.45), (-8.5, 0.55)])
    assert found == [(-8.0, 0.45)]
    assert used == 2


def test_a_warning_where_nothing_helps(monkeypatch):
    with pytest.warns(UserWarning, match="no better than those of the linear model"):
        found, used = chosen(monkeypatch, [(-8.0, 0.6)], [(-9.0, 0.7)])
    assert found == [(-9.0, 0.7), (-8.0, 0.6)]
    assert used == 2


def test_a_model_without_functions_is_not_judged(monkeypatch):
    model = dgp.Cascade(1, (dgp.Dynamic(), dgp.Dynamic()))
    assert chosen(monkeypatch, [(-8.0, 0.6)], model=model) == ([(-8.0, 0.6)], 1)


@pytest.mark.parametrize(
    ("model", "with_noise", "pays"),
    [
        (dgp.Wiener(1), 1.49, True),
        (dgp.Wiener(1), 1.51, False),
        (dgp.NonlinearFeedback(1), 0.98, True),
        (dgp.NonlinearFeedback(1), 1.0, False),
    ],
)
def test_what_process_noise_may_cost(monkeypatch, model, with_noise, pays):
    monkeypatch.setattr(free_runs, "free_run_error", lambda model, values, records: values)
    assert noise_pays(model, [], optimum(0.0, with_noise), optimum(0.0, 1.0), 1.5) == pays
    if not model.has_feedback:  # nor has it to run better than both
        assert noise_pays(model, [], optimum(0.0, 1.0), optimum(0.0, 1.0), 0.5)


def bent(n=240):
    """A sensor that saturates, behind a lag."""
    rng = np.random.default_rng(4)
    u, x = np.repeat(rng.standard_normal(n // 3), 3), np.zeros(n)
    for k in range(1, n):
        x[k] = 0.85 * x[k - 1] + 0.4 * u[k - 1]
    y = np.tanh(1.5 * x) + 0.03 * rng.standard_normal(n)
    return dgp.Record(time=np.arange(float(n)), inputs=u, outputs=y)


def test_a_fit_runs_better_than_the_linear_model():
    record = bent()
    options = {"method": "map", "restarts": 2, "workers": 1, "progress": False}
    fits = (
        dgp.fit(dgp.Wiener(1, pairs=1), record, steps=100, **options),
        dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **options),
    )
    errors = [free_run_error(f.model.collapsed, f.mode, f.model.prepare(record)) for f in fits]
    assert errors[0] < 0.7 * errors[1]


def test_the_warning_is_of_the_line_that_called(monkeypatch):
    monkeypatch.setattr(mode, "free_run_error", lambda model, *_: 1.0 + model.has_function)
    with pytest.warns(UserWarning, match="no better than") as caught:
        dgp.fit(
            dgp.Wiener(1, pairs=1), bent(60), method="map", restarts=1, steps=2, workers=1,
            progress=False,
        )  # fmt: skip
    said = [one for one in caught if "no better" in str(one.message)]
    assert [one.filename for one in said] == [__file__]
