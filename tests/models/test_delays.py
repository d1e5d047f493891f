"""What acted before a record is not in it: outputs count from when the first input has arrived."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Delayed, Recorded
from pyro_dynogp.discrepancy.held_out import forecast_errors
from pyro_dynogp.discrepancy.residuals import residuals_of
from pyro_dynogp.inference.log_joint import Direct
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.models.delays import (
    comparable,
    longest_delay,
    unknown_beginning,
    where_inputs_are_known,
)
from pyro_dynogp.models.variants import with_channel
from tests.discrepancy.machines import machine
from tests.discrepancy.made import coloured, fitted_mode
from tests.discrepancy.plant_dynamics import System, response

N, STEP, LATE, NOISE = 300, 0.1, 8, 0.02
MODEL = dgp.LinearDynamicGP(1, pairs=1, process_noise=False)
POLE = -0.09 + 0.3j  # [1/sample]


def later(samples: float) -> dgp.LinearDynamicGP:
    return with_channel(MODEL, Delayed("u", samples * STEP))


@pytest.fixture(scope="module")
def record() -> dgp.Record:
    """The output follows the input eight samples late; before the record the input moved, too."""
    rng = np.random.default_rng(11)
    u = coloured(rng, N + 200 + LATE, 0.9)
    y = response(System(np.array([POLE]), np.array([[0.3 - 0.2j]])), u[:, None])
    y = y / y.std() + NOISE * rng.standard_normal(len(y))
    return dgp.Record(STEP * np.arange(N), u[200 + LATE :, None], y[200 : 200 + N, None],
                      input_names=("u",))  # fmt: skip


def test_delays_of_models() -> None:
    assert longest_delay(MODEL, with_channel(MODEL, Recorded("w"))) == 0.0
    assert longest_delay(MODEL, later(3), later(2)) == pytest.approx(0.3)


def test_outputs_are_missing_until_the_first_input_arrives(record: dgp.Record) -> None:
    assert where_inputs_are_known(record, 0.0) is record
    for delay, count in ((0.5 * STEP, 1), (3 * STEP, 3), (3.2 * STEP, 4)):
        assert unknown_beginning(record, delay) == count
        found = where_inputs_are_known(record, delay)
        assert np.isnan(found.outputs[:count]).all()
        assert np.array_equal(found.outputs[count:], record.outputs[count:])
    assert comparable(record, [MODEL, MODEL]) is record
    assert comparable(record, [later(3), later(3)], 1.3) is record  # all of them lose the same
    assert np.isnan(comparable(record, [MODEL, later(10)], 1.3).outputs[:13]).all()


@pytest.mark.parametrize("again", [False, True])
def test_what_acted_before_the_record_is_unknown_for_as_long_as_it_arrives(again: bool) -> None:
    """Three tanks, 28 samples late: no held first value drives them to where outputs count.

    Forecasts were off by ten times the noise.
    """
    plant = machine("tanks", 29, effects=("dead time",), strength="strong")
    record, late = plant.record[: plant.training], 28
    plain = replace(plant.model, scaling=None)
    model = with_channel(plain, Delayed("inflow", late * record.sampling_time))
    fit = fitted_mode(plain if again else model, record)
    fit = refit(fit, record, model=model) if again else fit
    assert int(np.isnan(fit.records[0].outputs).sum()) == late
    (begun,) = Direct(fit.model.collapsed, fit.records).records
    assert len(begun) == len(record) - late
    np.testing.assert_allclose(begun.inputs[:, 0], record.inputs[:-late, 0], atol=1e-9)
    known = plant.record[: plant.training + 160]
    error, _ = forecast_errors(fit, known, np.arange(len(known)) >= plant.training)
    assert np.sqrt(np.nanmean(error**2)) < 1.2 * plant.noise_sd[0]


def test_a_late_input_does_not_spoil_the_poles(record: dgp.Record) -> None:
    """With the first value of the input held before the record, poles and noise are wrong."""
    found = fitted_mode(later(LATE), record)
    # Of 292 samples the noise's sd is known to 1 / sqrt(2 * 292) = 4 %, a pole at noise of 2 % to
    # less; without the mending the noise is off by two thirds.
    assert found.modes.poles[0] * STEP == pytest.approx(POLE, rel=0.02)
    noise = found.noise_sd[0] * found.scaling.output_scale[0]
    assert noise == pytest.approx(NOISE, rel=0.15)
    late = np.concatenate([np.full(LATE, record.inputs[0, 0]), record.inputs[:-LATE, 0]])
    held = dgp.Record(record.time, late, record.outputs[:, 0])
    spoilt = fitted_mode(MODEL, held)
    assert spoilt.noise_sd[0] * spoilt.scaling.output_scale[0] > 1.4 * NOISE


def test_residuals_are_missing_where_inputs_are_not_known(record: dgp.Record) -> None:
    prompt = residuals_of(fitted_mode(MODEL, record), record, settings=dgp.LoopSettings())
    late = residuals_of(fitted_mode(later(LATE), record), record, settings=dgp.LoopSettings())
    missing = [int(np.isnan(one.output).sum()) for one in (prompt, late)]
    assert LATE <= missing[1] <= LATE + 0.1 * N
    assert np.isfinite(late.output[missing[1] :]).all()
