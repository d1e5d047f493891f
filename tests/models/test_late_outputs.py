"""Outputs of a system with a dead time: the state is unknown where the first input arrives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.log_joint import Direct
from pyro_dynogp.models.late_outputs import LateOutputs
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.prediction.records import following
from tests.discrepancy.made import coloured
from tests.discrepancy.plant_dynamics import System, response

N, STEP, LATE = 120, 0.1, 9
GIVEN, FREE = (dgp.Delayed("u", LATE * STEP),), (dgp.Delayed("u"),)
MODELS = {
    "given": dgp.LinearDynamicGP(1, pairs=1, channels=GIVEN),
    "free": dgp.LinearDynamicGP(1, pairs=1, channels=FREE),
    "Wiener": dgp.Wiener(1, pairs=1, channels=GIVEN, initial_state="integrated"),
    "two outputs": dgp.LinearDynamicGP(1, outputs=2, pairs=1, channels=GIVEN),
}


@pytest.fixture(scope="module")
def records() -> dict[int, dgp.Record]:
    rng = np.random.default_rng(5)
    u = coloured(rng, N + 200 + LATE, 0.9)
    y = response(System(np.array([-0.03 + 0.0j]), np.array([[0.3 + 0.0j]])), u[:, None])
    y = y[200 : 200 + N] / y.std() + 0.05 * rng.standard_normal(N)
    both = np.column_stack([y, -2.0 * y + 0.1 * rng.standard_normal(N)])
    time, late = STEP * np.arange(N), u[200 + LATE :, None]
    return {count: dgp.Record(time, late, both[:, :count], input_names=("u",)) for count in (1, 2)}


@pytest.fixture(scope="module", params=MODELS)
def fit(request: Any, records: dict[int, dgp.Record]) -> dgp.Fit:
    model = MODELS[request.param]
    return dgp.fit(model, records[model.outputs], method="map", restarts=1, workers=1,
                   progress=False)  # fmt: skip


@pytest.mark.filterwarnings("ignore:fit. free runs through:UserWarning")
def test_densities_of_single_outputs_add_up_to_what_was_climbed(fit: dgp.Fit) -> None:
    (ready,) = fit.model.prepare(fit.records)
    first = int(np.isnan(fit.records[0].outputs).all(1).argmin())
    assert ready.arrived == first >= LATE
    y = ready.observations
    outputs = output_process(fit.system, ready)
    assert isinstance(outputs, LateOutputs)
    with torch.no_grad():
        ahead, whole = outputs.one_step(y), outputs.log_prob(y)
        density = Direct(fit.model.collapsed, fit.records)
        (process,), (begun,) = density.outputs(dict(fit.mode)), density.observations
        climbed = process.log_prob(begun)
    assert float(ahead.log_density.nansum()) == pytest.approx(float(whole.sum()), rel=1e-9)
    assert float(whole.sum()) == pytest.approx(float(climbed.sum()), rel=1e-9)
    assert fit.log_likelihood(fit.records[0]).item() == pytest.approx(float(whole), rel=1e-9)
    assert torch.isnan(ahead.log_density[..., :first, :]).all()
    assert ahead.mean.shape[-2:] == (N, fit.model.outputs)


@pytest.mark.filterwarnings("ignore:fit. free runs through:UserWarning")
def test_every_verb_has_all_times_and_knows_nothing_of_the_state_before(fit: dgp.Fit) -> None:
    (ready,) = fit.model.prepare(fit.records)
    first, y = ready.arrived, ready.observations
    outputs = output_process(fit.system, ready)
    (known,) = fit.model.collapsed.begun((ready,))
    rest, late = output_process(fit.system, known), known.observations
    assert not isinstance(rest, LateOutputs)
    with torch.no_grad():
        for name, given in (("one_step", ()), ("ahead", (3,)), ("left_out", ())):
            whole, part = getattr(outputs, name)(y, *given), getattr(rest, name)(late, *given)
            for quantity in ("mean", "variance", "log_density"):
                torch.testing.assert_close(
                    getattr(whole, quantity)[..., first:, :], getattr(part, quantity),
                    equal_nan=True,
                )  # fmt: skip
        for x, z in zip(outputs.innovations(y), rest.innovations(late), strict=True):
            assert x.shape[-y.dim() :] == y.shape
            dim = -2 if y.dim() == 2 else -1
            torch.testing.assert_close(x.narrow(dim, first, len(late)), z, equal_nan=True)
        for value in (y, None):
            smooth = outputs.smooth(value)
            after = rest.smooth(None if value is None else late)
            for name, layer in smooth.items():
                assert layer.mean.shape == layer.sd.shape
                assert layer.mean.shape[-2] == N
                np.testing.assert_allclose(layer.mean[..., first:, :], after[name].mean)
        at = known.inputs[-1]
        state, same = outputs.state_after(y, STEP, at), rest.state_after(late, STEP, at)
        torch.testing.assert_close(state.mean, same.mean)
        assert outputs.sample().shape[-y.dim() :] == y.shape


@pytest.mark.filterwarnings("ignore:fit. free runs through:UserWarning")
def test_predictions_of_the_training_record_hold(fit: dgp.Fit) -> None:
    """With the first input held until it arrives they were off by many standard deviations."""
    record = fit.records[0]
    y, seen = record.outputs, np.isfinite(record.outputs)
    for horizon in (1, 4):
        found = fit.predict(record, horizon=horizon)
        assert np.isfinite(found.mean).all()
        z = ((y - found.mean) / found.sd)[seen]
        assert np.abs(z).max() < 5.0
        assert np.isfinite(found.samples).all()
    past, future = record[:60], record[60:]
    assert following(fit, past, future)[0].arrived == int((~seen).all(1).sum())
    ahead = fit.forecast(past, future)
    assert np.abs((future.outputs - ahead.mean) / ahead.sd).max() < 6.0
