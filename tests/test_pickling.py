"""What is returned survives copies, pickles, torch.save and other processes, to the last bit."""

import copy
import io
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import joblib
import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.effects import LevelShift


def through_torch(value):
    buffer = io.BytesIO()
    torch.save(value, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=False)


def through_joblib(value):
    buffer = io.BytesIO()
    joblib.dump(value, buffer)
    buffer.seek(0)
    return joblib.load(buffer)


def itself(value):
    return value


def through_a_process(value):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(itself, value).result()


COPIES = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "torch": through_torch,
    "joblib": through_joblib,
}
FITS = ["map_fit", "svi_fit", "two_output_fit"]


def same_fit(a, b, past, future):
    assert (a.method, a.seed, a.model, a.records) == (b.method, b.seed, b.model, b.records)
    assert a.scaling == b.scaling
    for one, two in ((a.draws, b.draws), (a.mode, b.mode)):
        assert list(one) == list(two)
        assert all(torch.equal(one[name], two[name]) for name in one)
    assert dict(a.diagnostics) == dict(b.diagnostics)
    assert a.posterior.kind == b.posterior.kind
    same_prediction(a.forecast(past, future), b.forecast(past, future))
    assert np.array_equal(a.log_likelihood(past), b.log_likelihood(past))
    assert str(a.summary()) == str(b.summary())


def same_prediction(a, b):
    for name in ("mean", "variance", "samples", "time"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert list(a.parts) == list(b.parts)
    assert all(np.array_equal(a.parts[cause], b.parts[cause]) for cause in a.parts)


@pytest.mark.parametrize("through", list(COPIES))
@pytest.mark.parametrize("name", FITS)
def test_a_fit(name, through, request, record, two_outputs):
    fit = request.getfixturevalue(name)
    data = two_outputs if name == "two_output_fit" else record
    same_fit(fit, COPIES[through](fit), data[:160], data[160:])


def test_a_fit_comes_back_from_another_process(svi_fit, record):
    same_fit(svi_fit, through_a_process(svi_fit), record[:160], record[160:])


def test_what_a_fit_has_kept_stays_with_it(svi_fit):
    dgp.check(svi_fit, draws=50, progress=False)
    assert set(vars(copy.deepcopy(svi_fit))) == {
        "model", "posterior", "draws", "mode", "history", "start_energies", "diagnostics", "seed",
        "records",
    }  # fmt: skip


@pytest.mark.parametrize("through", list(COPIES))
def test_predictions_and_what_judges_them(through, svi_fit, record):
    copied = COPIES[through]
    forecast = svi_fit.forecast(record[:160], record[160:])
    same_prediction(forecast, copied(forecast))
    one_step = svi_fit.predict(record, horizon=3)
    same_prediction(copied(one_step), one_step)
    calibration = dgp.calibration(svi_fit.predict(record), record)
    assert str(copied(calibration)) == str(calibration)
    check = dgp.check(svi_fit, draws=50, progress=False)
    assert str(copied(check)) == str(check)


@pytest.mark.parametrize("through", list(COPIES))
def test_models_records_and_scalings(through, map_fit, record):
    copied = COPIES[through]
    record = dgp.Record(
        record.time, record.inputs, record.outputs, extra={"room": record.time},
        extra_units={"room": "degC"},
    )  # fmt: skip
    again = copied(record)
    assert again == record
    assert again.fingerprint == record.fingerprint
    assert copied(map_fit.model) == map_fit.model
    assert copied(map_fit.scaling) == map_fit.scaling
    wiener = dgp.Wiener(1, pairs=1, inducing=5, likelihood=dgp.StudentT())
    assert copied(wiener) == wiener
    for method in (dgp.Mode(), dgp.Normal(draws=3), dgp.Nuts(chains=2), dgp.Trajectories()):
        assert copied(method) == method


def test_a_mapping_of_a_record_is_read_only(record):
    kept = dgp.Record(record.time, outputs=record.outputs, extra={"room": record.time}).extra
    with pytest.raises(TypeError):
        kept["room"] = record.time


@pytest.mark.parametrize("through", list(COPIES))
def test_reports(through, small_report):
    again = COPIES[through](small_report)
    assert str(again) == str(small_report)
    assert again.to_dict() == small_report.to_dict()
    same_prediction(again.forecast_after, small_report.forecast_after)
    assert all(torch.equal(again.fit.mode[k], v) for k, v in small_report.fit.mode.items())


@pytest.fixture(scope="module")
def small_report():
    """A loop over a small record, in which a step is found."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(80), 6)
    y = 0.5 * u + 0.05 * rng.standard_normal(480) + 0.5 * (np.arange(480) >= 300)
    record = dgp.Record(np.arange(480.0), u, y)
    model = dgp.LinearDynamicGP(1, pairs=1, process_noise=False)
    quick = {"workers": 1, "progress": False}
    fit = dgp.fit(model, record[:240], restarts=1, steps=40, **quick, method="map")
    return dgp.close_loop(fit, record, effects=(LevelShift(),), max_rounds=1, **quick)


def test_fits_of_every_method(record):
    quick = {"restarts": 1, "steps": 2, "workers": 1, "progress": False}
    nuts = dgp.fit(
        dgp.LinearDynamicGP(1, pairs=1), record[:40], method=dgp.Nuts(2, warmup=2, draws=4), **quick
    )
    paths = dgp.fit(
        dgp.Wiener(1, pairs=1, inducing=4), record[:40],
        method=dgp.Trajectories(draws=3, particles=1), **quick,
    )  # fmt: skip
    for fit in (nuts, paths):
        again = pickle.loads(pickle.dumps(fit))
        same_fit(fit, again, record[:40], record[40:50])
        assert list(again.trajectories) == list(fit.trajectories)
