"""A fitted spring through every verb, and what feedback refuses."""

import warnings

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy.held_out import forecast_errors
from pyro_dynogp.discrepancy.residuals import free_run_of
from pyro_dynogp.inference.free_runs import free_run_error
from pyro_dynogp.models.draws import JointState
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.statistics.settings import LoopSettings
from tests.models.closed_loops import spring

STEP = 0.05


def moved(n, seed, noise, acceleration, size, held, substeps):
    """Force, position, and position measured with noise, of x'' = acceleration(u, x, x')."""
    rng = np.random.default_rng(seed)
    u = np.repeat(size * rng.standard_normal(n // held + 1), held)[:n]
    x, v, out = 0.0, 0.0, np.empty(n)
    for k in range(n):
        out[k] = x
        for _ in range(substeps):
            v += STEP / substeps * acceleration(u[k], x, v)
            x += STEP / substeps * v
    return u, out, out + noise * out.std() * rng.standard_normal(n)


def duffing(n, seed, noise=0.02):
    """x'' + 0.6 x' + 4 x + 4 x^3 = u, measured with noise; the true output."""
    u, out, y = moved(
        n, seed, noise, lambda u, x, v: u - 0.6 * v - 4.0 * x - 4.0 * x**3, 5.0, 4, 20
    )
    y[[5, n // 2]] = np.nan
    return dgp.Record(time=STEP * np.arange(n), inputs=u, outputs=y), out, noise * out.std()


@pytest.fixture(scope="module")
def fitted():
    record, _, _ = duffing(600, 0)
    options = {"workers": 1, "progress": False, "restarts": 1, "seed": 0}
    return dgp.fit(dgp.NonlinearFeedback(1), record[:450], **options), record


def test_free_runs_find_the_spring_again(fitted):
    """Near the noise, where the linear model is far; the climb ends without process noise."""
    fit, record = fitted
    _, truth, sd = duffing(600, 0)
    forecast = fit.forecast(record[:450], record[450:])
    error = forecast.mean[:, 0] - truth[450:]
    linear = dgp.fit(
        dgp.LinearDynamicGP(1, pairs=2), record[:450], workers=1, progress=False, method="map"
    )
    other = linear.forecast(record[:450], record[450:]).mean[:, 0] - truth[450:]
    assert np.sqrt(np.mean(error**2)) < 1.5 * sd
    assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean(other**2))
    low, high = forecast.quantile([0.025, 0.975])[..., 0]
    inside = (low < record.outputs[450:, 0]) & (record.outputs[450:, 0] < high)
    assert 0.85 < inside.mean() <= 1.0
    causes = sum(forecast.parts[name] for name in forecast.parts)
    np.testing.assert_allclose(causes, forecast.variance, rtol=1e-8)
    assert not forecast.parts["process noise of g"].max() > 0.01 * sd**2


def test_every_verb(fitted, tmp_path):
    fit, record = fitted
    train, later = record[:450], record[450:]
    ahead = fit.predict(train, horizon=5)
    assert np.isfinite(ahead.mean).all()
    one = fit.predict(train)
    scores = fit.innovations(train)
    assert np.nanstd(scores) == pytest.approx(1.0, abs=0.25)
    layers = fit.layers(train)
    np.testing.assert_allclose(
        fit.scaling.output_scale * (layers["g"].mean + fit.mode["offset"].numpy())
        + fit.scaling.output_offset,
        one.mean,
        atol=0.1 * float(fit.scaling.output_scale[0]),
    )
    assert set(layers) == {"g", "f"}
    assert fit.static_function("f", train).mean.shape == (200, 1)
    assert np.isfinite(fit.log_likelihood(train)).all()
    loo = dgp.loo(fit, train, target="missing sample")
    assert np.isfinite(loo.elpd_loo)
    with pytest.warns(
        UserWarning, match=r"simulation: \d+ of \d+ free runs leave"
    ):  # some draws of the prior do
        posterior = fit.to_arviz(future=later, samples=20, prior_samples=20)
    assert posterior.posterior["g_input_gain"].dims[2:] == ("pair", "g_input", "term")
    assert list(posterior.posterior["g_input"].values) == ["u", "f"]
    assert list(posterior.posterior["g_feedthrough"].dims[2:]) == ["input"]
    assert np.isfinite(posterior.posterior_predictive["y"]).all()
    mode = fit.at_mode()
    path = tmp_path / "spring.safetensors"
    fit.save(path)
    again = dgp.load(path)
    assert again.model == fit.model
    for verb in (lambda f: f.simulate(later), lambda f: f.forecast(train, later)):
        np.testing.assert_array_equal(verb(again).mean, verb(fit).mean)
        assert np.isfinite(verb(mode).mean).all()


def rubbed(n, seed, noise=0.02):
    """x'' + 0.3 x' + 0.8 tanh(20 x') + 4 x = u; the position is measured, friction sees x'."""
    u, out, y = moved(
        n, seed, noise, lambda u, x, v: u - 0.3 * v - 0.8 * np.tanh(20.0 * v) - 4.0 * x, 3.0, 5, 40
    )
    return dgp.Record(time=STEP * np.arange(n), inputs=u, outputs=y), out, noise * out.std()


def test_friction_acts_on_a_velocity_that_nothing_measures(tmp_path):
    """With a hidden signal within the noise; with a function of the position alone far off."""
    record, truth, sd = rubbed(700, 0)
    train, later = record[:500], record[500:]
    options = {"method": "map", "workers": 1, "progress": False, "seed": 0}
    model = dgp.NonlinearFeedback(1, hidden=1, process_noise=False)
    seen = [("inputs",), ("g",), ("g_hidden",), ("g_hidden",)]
    assert [wire.sources for wire in model.wires] == seen
    fit = dgp.fit(model, train, **options)

    def error(found):
        return np.sqrt(np.mean((found.forecast(train, later).mean[:, 0] - truth[500:]) ** 2))

    assert error(fit) < 0.9 * sd  # of the noise-free output
    with warnings.catch_warnings():  # it says itself that its free runs are poor
        warnings.simplefilter("ignore", UserWarning)
        plain = dgp.fit(dgp.NonlinearFeedback(1, process_noise=False), train, **options)
    assert error(plain) > 3.0 * sd
    # The hidden signal is the velocity, but for its size and sign.
    layers = fit.layers(train)
    assert set(layers) == {"g", "g_hidden", "f1", "f2", "step"}
    velocity = np.gradient(truth[:500], STEP)
    assert abs(np.corrcoef(layers["g_hidden"].mean[:, 0], velocity)[0, 1]) > 0.95
    # What comes back steps where it changes its sign.
    at, width = (float(fit.mode[f"step_{name}"]) for name in ("at", "width"))
    assert abs(at) < 0.1
    assert width < 0.3
    data = fit.to_arviz().posterior
    assert data["g_output_gain"].dims[2:] == ("g_output", "pair", "part")
    assert list(data["g_output"].values) == ["g", "g_hidden"]
    path = tmp_path / "friction.safetensors"
    fit.save(path)
    np.testing.assert_array_equal(dgp.load(path).simulate(later).mean, fit.simulate(later).mean)


def test_runs_from_far_beyond_the_data_come_back(fitted):
    """A hundred ranges away: what comes back keeps its value there, and the poles are stable."""
    fit, record = fitted
    outputs = output_process(fit.at_mode().system, fit.model.prepare(record)[0])
    far = JointState(torch.full((1, 2), 300.0).double(), torch.zeros(2, 2).double())
    later = output_process(outputs.system, fit.model.prepare(record)[0], start=far)
    runs = np.abs(later.components(samples=20, seed=0).mean)
    assert runs[:, 0].min() > 100.0 * float(fit.scaling.output_scale[0])
    assert runs[:, -1].max() < 0.2 * runs[:, 0].min()


def test_runs_that_diverge_are_reported_where_they_do(fitted):
    fit, record = fitted
    mode = fit.at_mode()
    gain = mode.mode["g_input_gain"].clone()
    gain[:, 1] *= -100.0  # what pulled back drives away
    wild = mode.with_draws(dict(mode.draws) | {"g_input_gain": gain[None]})
    with pytest.warns(UserWarning, match=r"simulation: .* first at sample \d+ "):
        wild.simulate(record)
    at_once = [record[:3], record[3:]]  # from a known state it takes a while
    with pytest.warns(UserWarning, match=r"forecast: .* first at sample \d+ "):
        wild.forecast(*at_once)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit.forecast(record[:450], record[450:])
        # The loop tries candidates, and tests the residuals of those that it keeps.
        later = np.arange(len(record)) >= 3
        forecast_errors(wild, record, later)
        free_run_of(wild, record, held_out=later, seed=0, settings=LoopSettings())


def test_several_records_and_another_step():
    """Two records, one on irregular times; a forecast over other steps than the training's."""
    whole, _, _ = duffing(360, 1)
    keep = np.sort(np.random.default_rng(0).choice(np.arange(180, 360), 120, replace=False))
    rest = dgp.Record(time=whole.time[keep], inputs=whole.inputs[keep], outputs=whole.outputs[keep])
    records = [whole[:180], rest]
    options = {"workers": 1, "progress": False, "restarts": 1, "steps": 20, "method": "map"}
    fit = dgp.fit(dgp.NonlinearFeedback(1), records, **options)
    assert {"g_initial_state_0", "g_initial_state_1"} <= set(fit.mode)
    error = free_run_error(fit.model.collapsed, fit.mode, fit.model.prepare(fit.records))
    assert 0.0 < error < 1.0
    assert np.isfinite(fit.forecast(records[0], records[1]).mean).all()


def test_a_loop_without_inputs():
    """x'' - (1 - x^2) x' + x = 0, van der Pol's oscillator, by Euler's method: it swings alone."""
    x, v, out = 0.1, 0.0, np.empty(300)
    for k in range(300):
        out[k] = x
        for _ in range(10):
            v += 0.02 * ((1.0 - x**2) * v - x)
            x += 0.02 * v
    record = dgp.Record(time=0.2 * np.arange(300), outputs=out)
    options = {"workers": 1, "progress": False, "restarts": 1, "steps": 10, "method": "map"}
    with warnings.catch_warnings():  # ten steps are too few for good free runs
        warnings.simplefilter("ignore", UserWarning)
        fit = dgp.fit(dgp.NonlinearFeedback(0), record[:200], **options)
        assert fit.mode["g_input_gain"].shape == (1, 1, 2)
        assert np.isfinite(fit.forecast(record[:200], record[200:]).mean).all()


def test_same_bits_with_one_and_two_workers():
    record, _, _ = duffing(120, 2)
    options = {"progress": False, "restarts": 2, "steps": 6, "method": "map"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # so few steps lead nowhere
        one, two = (
            dgp.fit(dgp.NonlinearFeedback(1), record, workers=workers, **options)
            for workers in (1, 2)
        )
    for name, value in one.mode.items():
        assert torch.equal(value, two.mode[name]), name


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: spring(integrate="none"), "cannot be sample sites"),
        (lambda: spring(likelihood=dgp.Heteroscedastic(of="output")), "varies with the inputs"),
        (lambda: dgp.Cascade(1, (dgp.Dynamic(feedback=("g",)),)), "later static layers"),
        (lambda: dgp.Cascade(1, (dgp.Dynamic(feedback="f"), dgp.Static())), "expected a tuple"),
        (lambda: dgp.Cascade(1, (dgp.Dynamic(hidden=1), dgp.Static())), "hidden of layer 'g'"),
        (
            lambda: dgp.Cascade(
                1, (dgp.Dynamic(hidden=1, feedback=("f",)), dgp.Static()), output="g"
            ),
            "functions that see all of 'g_hidden'",
        ),
        (
            lambda: dgp.Cascade(1, (dgp.Dynamic(hidden=1), dgp.Static(sees=("g_hidden",)))),
            "in a layer with feedback",
        ),
        (
            lambda: dgp.Cascade(1, (dgp.Dynamic(hidden=1), dgp.Static(name="g_hidden"))),
            "a name of its own",
        ),
        (lambda: dgp.NonlinearFeedback(1, hidden=-1), "hidden: expected a whole number >= 0"),
        (
            lambda: dgp.Cascade(1, (dgp.Static(), dgp.Dynamic(feedback=("f",)))),
            "of later static layers, of []",
        ),
        (lambda: dgp.Cascade(1, (dgp.Dynamic(), dgp.Static()), output="h"), "one of the layers"),
        (lambda: dgp.Cascade(1, (dgp.Dynamic(), dgp.Static()), output="g"), "without effect"),
    ],
)
def test_what_is_refused_with_a_sentence(make, text):
    with pytest.raises(ValueError, match=text.replace("[", r"\[")):
        make()


def test_trajectories_as_sites_are_refused_before_work():
    record, _, _ = duffing(60, 3)
    with pytest.raises(ValueError, match="feedback"):
        dgp.fit(dgp.NonlinearFeedback(1), record, guide="gauss-markov")
