"""A fitted friction law through every verb, and what a fit with a user's function refuses."""

import numpy as np
import pyro.distributions as dist
import pytest
import torch
from scipy.stats import ks_2samp

import pyro_dynogp as dgp
from pyro_dynogp.models.outputs import output_process
from tests.models.closed_loops import plain_loop, system_at

STEP, WIDTH = 0.05, 0.1


def sliding(n, seed, noise=0.02):
    """v' + 0.5 v + 0.8 tanh(v / 0.1) = u, measured with noise; the true velocity."""
    rng = np.random.default_rng(seed)
    u = np.repeat(2.0 * rng.standard_normal(n // 10 + 1), 10)[:n]
    v, truth = 0.0, np.empty(n)
    for k in range(n):
        truth[k] = v
        for _ in range(20):
            v += STEP / 20 * (u[k] - 0.5 * v - 0.8 * np.tanh(v / WIDTH))
    sd = noise * truth.std()
    y = truth + sd * rng.standard_normal(n)
    return dgp.Record(time=STEP * np.arange(n), inputs=u, outputs=y), truth, sd


def friction(process_noise=True):
    law = dgp.Known(
        lambda v, width: torch.tanh(v / width), {"width": dist.LogNormal(np.log(0.3), 1.0)}
    )
    layers = (dgp.Dynamic(pairs=1, feedback=("f",), process_noise=process_noise), law)
    return dgp.Cascade(1, layers, output="g")


OPTIONS = {"progress": False, "restarts": 1, "seed": 0}


@pytest.fixture(scope="module")
def fitted():
    record, _, _ = sliding(600, 0)
    return dgp.fit(friction(), record[:400], workers=1, draws=300, **OPTIONS), record


def test_the_parameter_is_found_and_free_runs_are_near_the_noise(fitted):
    fit, record = fitted
    _, truth, sd = sliding(600, 0)
    width = fit.draws["f_width"]
    assert 0.0 < float(width.std()) < 0.3 * WIDTH
    assert abs(float(width.mean()) - WIDTH) < 3.0 * float(width.std())
    error = fit.forecast(record[:400], record[400:]).mean[:, 0] - truth[400:]
    assert np.sqrt(np.mean(error**2)) < 1.5 * sd
    assert fit.summary().table.loc["f: width", "mean"] == pytest.approx(float(width.mean()))


def test_every_verb(fitted):
    fit, record = fitted
    train, later = record[:400], record[400:]
    for verb in (fit.predict(train), fit.predict(train, horizon=5), fit.simulate(later)):
        assert np.isfinite(verb.mean).all()
    causes = fit.forecast(train, later)
    total = sum(causes.parts.values())
    np.testing.assert_allclose(total, causes.variance, rtol=1e-8)
    assert np.isfinite(fit.log_likelihood(train)).all()
    assert set(fit.layers(train)) == {"g", "f"}
    band = fit.static_function("f", train)
    middle = -(fit.scaling.output_offset / fit.scaling.output_scale + fit.mode["offset"].numpy())
    steepest = band.x[np.argmax(np.gradient(band.mean[:, 0], band.x))]
    assert steepest == pytest.approx(float(middle[0]), abs=2.0 * float(band.x[1] - band.x[0]))
    posterior = fit.to_arviz(samples=20, prior_samples=20)
    assert posterior.posterior["f_width"].dims == ("chain", "draw")


def test_posterior_draws_of_outputs_are_those_of_a_plain_simulation(fitted):
    fit, record = fitted
    train, count, times = record[:60], 300, (2, 15, 30, 59)
    rng = np.random.default_rng(1)
    draws = {name: value[:count] for name, value in fit.draws.items()}
    assert len(draws["f_width"]) == count
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        system = system_at(fit.model, draws)
        process = output_process(system, fit.model.prepare(train)[0])
        found = process.sample().numpy()
    function = system.layer("f").function
    centre, size = float(function.centre), float(function.size)
    shift, scale = float(fit.scaling.output_offset[0]), float(fit.scaling.output_scale[0])
    expected = np.empty_like(found)
    for k in range(count):
        own = {name: value[k] for name, value in draws.items()}
        loop = plain_loop(fit.model, system_at(fit.model, own), train)
        width, offset = float(own["f_width"]), float(own["offset"])

        def back(g, width=width, offset=offset):
            return (np.tanh((shift + scale * (g + offset)) / width) - centre) / size

        expected[k] = shift + scale * loop.simulate(back, rng)[0, :, 0]
    for time in times:
        assert ks_2samp(found[:, time], expected[:, time]).pvalue > 0.001, time


def test_a_file_holds_no_code(fitted, tmp_path):
    with pytest.raises(ValueError, match="a known function in layer 'f'"):
        fitted[0].save(tmp_path / "friction.safetensors")


def test_same_bits_with_one_and_two_workers():
    record, _, _ = sliding(120, 1)
    fits = [
        dgp.fit(friction(False), record, workers=workers, steps=20, **(OPTIONS | {"restarts": 2}))
        for workers in (1, 2)
    ]
    for name, value in fits[0].draws.items():
        assert torch.equal(value, fits[1].draws[name]), name


def test_an_actuator_and_a_sensor_that_are_known():
    """A dead zone, dynamics, a sensor that saturates: both parameters, in their own units."""
    rng = np.random.default_rng(0)
    n = 500
    u = np.repeat(4.0 * rng.standard_normal(n // 5), 5)
    force = np.sign(u) * np.maximum(np.abs(u) - 1.5, 0.0)
    x = np.zeros(n)
    for k in range(1, n):
        x[k] = 0.9 * x[k - 1] + 0.1 * force[k - 1]
    truth = 2.0 * np.tanh(x / 2.0) + 3.0
    record = dgp.Record(
        time=0.1 * np.arange(n), inputs=u, outputs=truth + 0.02 * rng.standard_normal(n)
    )
    zone = dgp.Known(
        lambda u, dead: u.sign() * (u.abs() - dead).clamp_min(0.0),
        {"dead": dist.LogNormal(0.0, 0.5)},
    )
    sensor = dgp.Known(
        lambda x, most: 3.0 + most * torch.tanh((x - 3.0) / most),
        {"most": dist.LogNormal(1.0, 0.5)},
    )
    layers = (zone, dgp.Dynamic(pairs=1, process_noise=False), sensor)
    model = dgp.Cascade(1, layers, integrate="all")
    fit = dgp.fit(model, record[:350], workers=1, **OPTIONS)
    error = fit.simulate(record).mean[350:, 0] - truth[350:]
    assert np.sqrt(np.mean(error**2)) < 0.01
    assert float(fit.mode["f1_dead"]) == pytest.approx(1.5, rel=0.05)
    assert float(fit.mode["f2_most"]) == pytest.approx(2.0, rel=0.1)
