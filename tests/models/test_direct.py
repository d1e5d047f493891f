"""Inputs that act on the output at once, and models that carry channels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data import channels

STEP = channels.Step(15.0)


def machine(n: int = 240) -> dgp.Record:
    rng = np.random.default_rng(2)
    time = np.arange(n) * 0.1
    u = np.repeat(rng.standard_normal(n // 6), 6)
    late = np.concatenate([np.full(4, u[0]), u[:-4]])
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.8 * y[k - 1] + 0.2 * late[k - 1]
    y = y + 0.7 * (time >= 15.0) + 0.03 * rng.standard_normal(n)
    return dgp.Record(time, u, y)


def with_step(inputs: int = 1) -> dgp.LinearDynamicGP:
    return dgp.LinearDynamicGP(inputs=inputs + 1, pairs=1, direct=1, channels=(STEP,))


def draw(model: object, data: dgp.Record) -> dict[str, torch.Tensor]:
    with torch.random.fork_rng():
        torch.manual_seed(1)
        trace = pyro.poutine.trace(model).get_trace(data)
    return {
        name: node["value"]
        for name, node in trace.nodes.items()
        if node["type"] == "sample" and not node["is_observed"]
    }


def log_prob(model: object, data: dgp.Record, values: dict[str, torch.Tensor]) -> float:
    run = pyro.poutine.trace(pyro.poutine.condition(model, data=values)).get_trace(data)
    run.compute_log_prob()
    return float(run.nodes["y"]["log_prob_sum"])


def test_direct_inputs_shift_the_mean_and_nothing_else() -> None:
    """The likelihood is that of the outputs less the weighted columns, under the model without."""
    data = machine()
    model = with_step().scaled_to(data)
    values = draw(model, data)
    columns = STEP.columns(data)[:, 0]
    scaled = (columns - columns.mean()) / columns.std()
    shift = data.outputs.std() * float(values["direct"]) * scaled
    plain = dgp.LinearDynamicGP(inputs=1, pairs=1).scaled_to(data)
    moved = data.with_outputs(data.outputs[:, 0] - shift)
    rest = {name: value for name, value in values.items() if name != "direct"}
    expected = log_prob(plain, moved, rest)
    assert log_prob(model, data, values) == pytest.approx(expected, rel=1e-9)
    changed = {**values, "direct": values["direct"] + 0.5}
    assert abs(log_prob(model, data, changed) - expected) > 0.1  # the site matters


def test_a_cascade_of_one_dynamic_layer_with_direct_inputs_is_the_linear_model() -> None:
    data = machine()
    linear = with_step().scaled_to(data)
    cascade = dgp.Cascade(
        2, (dgp.Dynamic(pairs=1),), direct=1, channels=(STEP,), integrate="all"
    ).scaled_to(data)
    values = draw(linear, data)
    assert log_prob(cascade, data, values) == pytest.approx(
        log_prob(linear, data, values), rel=1e-7
    )


@pytest.mark.parametrize("integrate", ["none", "all"])
def test_direct_inputs_pass_a_nonlinearity_by(integrate: str) -> None:
    """Simulated outputs of a Wiener model move by the weighted columns."""
    data = machine(60)
    model = dgp.Wiener(
        2, pairs=1, inducing=6, direct=1, channels=(channels.Trend(0.0, 6.0),), integrate=integrate
    ).scaled_to(data)
    values = draw(model, data)
    blank = data.with_outputs(np.zeros((60, 0)), names=(), units=())

    def outputs(weight: float) -> np.ndarray:
        here = {**values, "direct": torch.full((1, 1), weight, dtype=torch.float64)}
        with torch.random.fork_rng():
            torch.manual_seed(3)
            run = pyro.poutine.trace(pyro.poutine.condition(model, data=here)).get_trace(blank)
        return run.nodes["y"]["value"].numpy()

    column = data.time / 6.0
    scaled = (column - column.mean()) / column.std()
    np.testing.assert_allclose(
        outputs(1.5) - outputs(0.5), data.outputs.std() * scaled, rtol=1e-7, atol=1e-9
    )


def test_numbers_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="direct: expected a whole number from 0 to 1"):
        dgp.LinearDynamicGP(inputs=1, direct=2)
    with pytest.raises(ValueError, match="from 1 to 1"):
        dgp.LinearDynamicGP(inputs=1, channels=(STEP,))
    with pytest.raises(ValueError, match="without direct inputs"):
        dgp.Cascade(2, (dgp.Dynamic(),), direct=1, integrate="last")


@pytest.fixture(scope="module")
def fitted() -> tuple[dgp.Fit, dgp.Record, dgp.Record]:
    data = machine()
    past, future = data.split(180)
    model = dgp.LinearDynamicGP(
        inputs=2, pairs=1, direct=1, channels=(channels.Delayed("u", 0.4), STEP)
    )
    return dgp.fit(model, past, restarts=2, workers=1, progress=False, method="map"), past, future


def test_a_fit_with_channels_takes_records_as_they_were_measured(
    fitted: tuple[dgp.Fit, dgp.Record, dgp.Record],
) -> None:
    fit, past, future = fitted
    found = dgp.scores(fit.forecast(past, future), future)
    assert found["rmse"] < 0.045  # the noise is 0.03; without the step 0.7 would be missing
    step = float(fit.mode["direct"]) * float(
        fit.scaling.output_scale[0] / fit.scaling.input_scale[1]
    )
    assert step == pytest.approx(0.7, abs=0.05)
    assert len(fit.predict(past)) == 180
    assert len(fit.simulate(future)) == 60
    assert np.isfinite(fit.innovations(past)).all()
    assert fit.log_likelihood(past).shape == (1,)


def test_a_forecast_reaches_back_into_the_past(
    fitted: tuple[dgp.Fit, dgp.Record, dgp.Record],
) -> None:
    """A delayed input of the first future samples was recorded before them."""
    fit, past, future = fitted
    data = machine()
    whole = channels.prepared(data, fit.model.channels)
    expected = fit.forecast(whole[:180], whole[180:]).mean
    np.testing.assert_allclose(fit.forecast(past, future).mean, expected, atol=1e-12)
    alone = channels.prepared(future, fit.model.channels)
    assert np.abs(fit.forecast(whole[:180], alone).mean - expected).max() > 1e-3


def test_a_saved_fit_keeps_its_channels(
    fitted: tuple[dgp.Fit, dgp.Record, dgp.Record], tmp_path: Path
) -> None:
    fit, past, future = fitted
    fit.save(tmp_path / "fit.safetensors")
    again = dgp.load(tmp_path / "fit.safetensors")
    assert again.model.channels == fit.model.channels
    assert (again.forecast(past, future).mean == fit.forecast(past, future).mean).all()
