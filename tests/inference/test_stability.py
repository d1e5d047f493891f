"""A fit says where a pole is slower than its record, and where the plant is unstable."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.stability import of_numbers, warnings_of
from tests.statistics.test_growth import closed_loop

QUICK = {"restarts": 1, "steps": 30, "workers": 1, "progress": False}


def tank(n=200, step=10.0):
    """Level of a tank that integrates its inflow."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], size=n // 12 + 1), 12)[:n]
    level = 0.01 * step * np.cumsum(np.concatenate([[0.0], u[:-1]]))
    return dgp.Record(
        time=step * np.arange(n), inputs=u, outputs=level + 0.02 * rng.standard_normal(n)
    )


def settling(n=200):
    """A plant with a time constant of a fiftieth of the record."""
    rng = np.random.default_rng(2)
    u, y, phi = rng.standard_normal(n), np.zeros(n), np.exp(-0.25)
    for k in range(1, n):
        y[k] = phi * y[k - 1] + (1.0 - phi) * u[k - 1]
    return dgp.Record(time=np.arange(n), inputs=u, outputs=y + 0.05 * rng.standard_normal(n))


@pytest.fixture(scope="module")
def fit():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return dgp.fit(dgp.LinearDynamicGP(1, pairs=1), settling(), **QUICK)


def slowed(fit, held, frequency=0.1):
    """The fit with so many time constants of its pole in the record."""
    decay = -fit.system_at(fit.mode).layers[0].modes.poles.real
    log_decay = fit.mode["g_log_decay"] + torch.log(held / fit.scaling.duration / decay)
    frequency = log_decay + np.log(frequency)
    values = {**fit.mode, "g_log_decay": log_decay, "g_log_frequency": frequency}
    return replace(fit, mode=values)


@pytest.mark.parametrize("held", [0.1, 1.0, 2.9, 3.1, 10.0])
def test_a_pole_is_slow_where_the_record_holds_fewer_than_three_time_constants(fit, held):
    said = warnings_of(slowed(fit, held))
    assert bool(said) == (held < 3.0)
    assert all(f"only {held:.1f} of its time constants" in sentence for sentence in said)


def test_the_advice_is_of_the_kind_of_pole(fit):
    (said,) = warnings_of(slowed(fit, 1.0, frequency=20.0))
    assert "oscillates on" in said
    assert "Sinusoid" in said
    (said,) = warnings_of(slowed(fit, 1.0))
    assert "is hardly different from an integrator" in said
    assert "integrators=1" in said
    (layer,) = fit.model.layers
    model = replace(fit.model, layers=(replace(layer, integrators=1, process_noise=False),))
    slow, one = slowed(fit, 1.0), torch.ones(1, dtype=torch.float64)
    more = {"g_integrator_drift": one, "g_integrator_gain": one[None]}
    (said,) = warnings_of(replace(slow, model=model, mode={**slow.mode, **more}))
    assert "integrators=1" not in said


def test_fit_summary_and_check_say_so():
    with pytest.warns(UserWarning, match="time constants") as caught:
        found = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), tank(), **QUICK)
    assert caught[0].filename == __file__
    (said,) = warnings_of(found)
    assert said in found.summary()
    finding = dgp.check(found, progress=False)["poles"]
    assert finding.good is False
    assert finding.text == said


def test_a_good_fit_says_nothing(fit):
    assert warnings_of(fit) == ()
    assert "warning" not in fit.summary()
    with pytest.raises(KeyError):
        dgp.check(fit, progress=False)["poles"]


def test_an_unstable_plant_is_named():
    u, y = closed_loop(0)
    record = dgp.Record(time=0.05 * np.arange(len(y)), inputs=u, outputs=y)
    with pytest.warns(UserWarning, match="only stable systems can be identified"):
        found = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **QUICK)
    (said,) = warnings_of(found)
    assert "unstable plant" in said
    assert "reference" in said


@pytest.mark.parametrize(("samples", "said"), [(62, True), (63, False)])
def test_a_model_with_functions_has_fewer_numbers_than_there_are_outputs(samples, said):
    """Fifty numbers are four fifths of 62.5 outputs; those that are missing do not count."""
    record = settling(100)
    y = record.outputs.copy()
    y[samples:] = np.nan
    fit = SimpleNamespace(
        model=dgp.Wiener(1), mode={"a": torch.zeros(25), "b": torch.zeros(5, 5)},
        records=[record.with_outputs(y)],
    )  # fmt: skip
    found = of_numbers(fit)
    assert bool(found) is said
    if said:
        assert f"has 50 free numbers, and there are {samples} measured outputs" in found[0]
    fit.model = dgp.LinearDynamicGP(1)
    assert of_numbers(fit) == ()


def test_too_many_numbers_are_said_by_the_fit_its_summary_and_check():
    record = settling(40)
    with pytest.warns(UserWarning, match="free numbers, and there are 40 measured outputs"):
        fit = dgp.fit(dgp.Wiener(1, pairs=1), record, method="map", **{**QUICK, "steps": 2})
    assert "free numbers, and there are 40 measured outputs" in str(fit.summary())
    found = dgp.check(fit, forecasts=False, draws=50, workers=1, progress=False)
    assert found["numbers"].good is False
