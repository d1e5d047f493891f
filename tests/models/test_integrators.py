"""Poles at zero: densities, predictions, gradients and fits of plants that integrate."""

import warnings

import numpy as np
import pyro
import pytest
import torch
from scipy.linalg import expm
from scipy.signal import lfilter
from scipy.stats import multivariate_normal
from statsmodels.tsa.statespace.structural import UnobservedComponents

import pyro_dynogp as dgp
from pyro_dynogp.inference.starts.poles import values_given_poles
from pyro_dynogp.layers.sites import sample
from pyro_dynogp.lti.covariance import autocovariance
from pyro_dynogp.lti.response import mean_response
from pyro_dynogp.lti.state import ModalState, propagate
from pyro_dynogp.lti.views import step_response
from pyro_dynogp.models.exact_outputs import ExactOutputs
from pyro_dynogp.models.moment_outputs import MomentOutputs
from pyro_dynogp.models.past_inputs import LEVEL, past_input_covariance
from pyro_dynogp.models.priors import WALK, WALKED
from tests.lti.oracles import irregular_times, tensor

QUICK = {"restarts": 1, "workers": 1, "progress": False}


def some_record(n=40, inputs=1, outputs=1, seed=0):
    rng = np.random.default_rng(seed)
    y = np.cumsum(rng.standard_normal((n, outputs)), axis=0)
    y[[3, 17]] = np.nan
    return dgp.Record(irregular_times(n, seed), rng.standard_normal((n, inputs)), y)


def prepared(model, record, seed=1):
    """A system of the model at values drawn from the prior, along the record."""
    model = model.scaled_to(record)
    (along,) = model.prepare(record)
    with pyro.poutine.block():
        pyro.set_rng_seed(seed)
        values = sample(model.sites(along.scaling))
    return model, along, values


def dense(model, along, values):
    """Mean and covariance (N, N) of scaled outputs, the integrators added to those of the pairs."""
    n, n_y = len(along), model.outputs
    time, u = along.grid.time.numpy(), along.scaled_inputs.numpy()
    n_t = time[-1] - time[0]
    rate = np.sqrt(np.pi / (n_t * float(along.scaling.time_step)))
    (layer,) = model.layers
    plain = dgp.LinearDynamicGP(
        model.inputs, outputs=n_y, pairs=layer.pairs, noise=layer.noise, scaling=along.scaling,
        process_noise=layer.process_noise, brownian=layer.brownian,
    )  # fmt: skip
    pairs = plain.system(values, along.scaling).layers[0]
    mean = pairs.mean(along.scaled_inputs, along.grid).numpy() + values["offset"].numpy()
    held = np.vstack([np.zeros(model.inputs), np.cumsum(np.diff(time)[:, None] * u[:-1], axis=0)])
    mean = mean + rate * held @ values["g_integrator_gain"].numpy().T
    mean = mean + rate * (time - time[0])[:, None] * values["g_integrator_drift"].numpy()
    lag = time[:, None] - time
    own = autocovariance(pairs.modes, tensor(lag)).numpy().reshape(n, n, n_y, n_y)
    rows = []
    for at in time - time[0]:
        C, poles = pairs.modes.C.numpy(), pairs.modes.poles.numpy()
        row = C * np.exp(poles * at)
        rows.append(np.hstack([2 * row.real, -2 * row.imag]))
    O = np.concatenate(rows)
    K = own.transpose(0, 2, 1, 3).reshape(n * n_y, n * n_y) + O @ pairs.past_inputs.numpy() @ O.T
    level = np.full((n, n), LEVEL**2)
    K += np.kron(level, np.eye(n_y))
    if layer.process_noise:
        L = WALKED / np.sqrt(n_t) * values["g_integrator_noise"].numpy()
        walk = np.exp(-WALK / n_t * np.abs(lag)) / (2 * WALK / n_t)
        noise = L @ L.T if layer.noise == "shared" else np.diag((L**2).sum(1))
        K += np.kron(walk, noise)
    K += np.kron(np.eye(n), np.diag(values["noise_sd"].numpy() ** 2))
    return mean.reshape(-1), K


MODELS = {
    "one output": {"noise": "independent"},
    "without process noise": {"process_noise": False},
    "two inputs, two outputs": {"inputs": 2, "outputs": 2, "noise": "independent"},
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("engine", [ExactOutputs, MomentOutputs])
def test_the_density_is_that_of_the_joint_gaussian(name, engine):
    options = {"inputs": 1, "outputs": 1, **MODELS[name]}
    record = some_record(inputs=options["inputs"], outputs=options["outputs"])
    model = dgp.LinearDynamicGP(options.pop("inputs"), pairs=2, integrators=1, **options)
    model, along, values = prepared(model, record)
    mean, K = dense(model, along, values)
    y = along.scaled_outputs.numpy().reshape(-1)
    there = np.isfinite(y)
    expected = multivariate_normal(mean[there], K[np.ix_(there, there)]).logpdf(y[there])
    expected -= np.log(along.scaling.output_scale).sum() * there.sum() / model.outputs
    outputs = engine(model.system(values, along.scaling), along)
    assert float(outputs.log_prob(along.observations)) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("outputs", [1, 2])
def test_predictions_of_both_engines_are_equal(outputs):
    record = some_record(outputs=outputs)
    model = dgp.LinearDynamicGP(1, outputs=outputs, pairs=2, integrators=1)
    model, along, values = prepared(model, record)
    values = {k: v.unsqueeze(0) for k, v in values.items()}
    system = model.system(values, along.scaling)
    exact, moments = (engine(system, along) for engine in (ExactOutputs, MomentOutputs))
    y, there = along.observations, ~torch.isnan(along.scaled_outputs)
    for verb in ("one_step", "ahead", "left_out"):
        more = (4,) if verb == "ahead" else ()
        a, b = (getattr(engine, verb)(y, *more) for engine in (exact, moments))
        second = "log_density" if verb == "left_out" else "variance"  # with and without noise
        for what in ("mean", second):
            x, z = (getattr(found, what)[:, there] for found in (a, b))
            torch.testing.assert_close(x, z, rtol=1e-8, atol=1e-9)
    inputs = along.inputs[-1]
    ends = [engine.state_after(y, 0.3, inputs) for engine in (exact, moments)]
    torch.testing.assert_close(ends[0].mean, ends[1].mean, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(ends[0].covariance, ends[1].covariance, rtol=1e-5, atol=1e-8)


def test_gradients():
    record = some_record(n=20)
    model, along, values = prepared(dgp.LinearDynamicGP(1, pairs=1, integrators=1), record)
    names, leaves = list(values), [v.clone().requires_grad_() for v in values.values()]

    def density(*given):
        system = model.system(dict(zip(names, given, strict=True)), along.scaling)
        return ExactOutputs(system, along).log_prob(along.observations)

    assert torch.autograd.gradcheck(density, leaves, eps=1e-6, atol=1e-5, rtol=1e-5)


def test_responses_are_those_of_the_matrix_exponential():
    """A pole at zero and drift of all states, beside a pair, at irregular steps."""
    time, rng = irregular_times(30, 5), np.random.default_rng(2)
    u = rng.standard_normal((30, 1))
    modes = dgp.Modes(
        [-0.5 + 2.0j, 0.0], [[0.3 - 0.2j], [0.7]], [1.0, 1.0], drift=[0.1 + 0.4j, -0.2]
    )
    pair = np.array([[-0.5, -2.0], [2.0, -0.5]])
    A = np.zeros((3, 3))
    A[:2, :2] = pair
    B, b, C = np.array([[0.3], [-0.2], [0.7]]), np.array([0.1, 0.4, -0.2]), [2.0, 0.0, 2.0]
    x, expected = np.array([0.2, -0.1, 0.4]), []
    for k, step in enumerate(np.append(np.diff(time), 0.7)):
        expected.append(np.dot(C, x))
        last = x
        M = np.zeros((4, 4))
        M[:3, :3], M[:3, 3] = A, B @ u[k] + b
        x = (expm(M * step) @ np.append(x, 1.0))[:3]
    start = torch.tensor([0.2 - 0.1j, 0.4 + 0.0j], dtype=torch.complex128)
    found = mean_response(modes, time, u, start)
    np.testing.assert_allclose(found.output, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found.state.real, last[[0, 2]], rtol=1e-10)
    after = propagate(modes, ModalState(found.state), 0.7, tensor(u[-1])).mean
    np.testing.assert_allclose(after.real, x[[0, 2]], rtol=1e-10)
    ramp = step_response(dgp.Modes([0.0], [[0.5]], [1.0]), [0.0, 2.0, 4.0])
    np.testing.assert_allclose(ramp[:, 0, 0], [0.0, 2.0, 4.0], atol=1e-14)
    faster = modes.rescale(time=10.0)
    np.testing.assert_allclose(
        mean_response(faster, 10.0 * time, u, start).output, expected, rtol=1e-10, atol=1e-12
    )


@pytest.mark.parametrize("pole", [0.0 + 1.0j, 0.1 + 0.0j])
def test_other_poles_on_the_boundary_are_refused(pole):
    with pytest.raises(ValueError, match="stable poles"):
        dgp.Modes([pole], [[1.0]], [1.0])
    with pytest.raises(ValueError, match="stable poles"):
        dgp.Modes([0.0], [[1.0]], [1.0], [[0.1]])
    with pytest.raises(ValueError, match="integrators"):
        dgp.LinearDynamicGP(1, integrators=2)


def test_what_past_inputs_leave_in_an_integrator():
    alone = dgp.Modes([-0.5 + 2.0j], [[0.3 - 0.2j]], [1.0])
    both = dgp.Modes([-0.5 + 2.0j, 0.0], [[0.3 - 0.2j], [0.7]], [1.0, 1.0])
    found = past_input_covariance(both, 3.0)
    kept = torch.tensor([0, 2])
    torch.testing.assert_close(found[kept][:, kept], past_input_covariance(alone, 3.0))
    assert float(4.0 * found[1, 1]) == pytest.approx(LEVEL**2)  # of 2 Re x
    assert float(found.abs().sum() - found[kept][:, kept].abs().sum()) == float(found[1, 1])


def test_the_random_walk_is_that_of_statsmodels():
    """Known first level, no pair: a local level."""
    n, sd, walk = 150, 0.3, 2.0
    rng = np.random.default_rng(3)
    record = dgp.Record(np.arange(float(n)), rng.standard_normal(n), rng.standard_normal(n))
    model, along, values = prepared(dgp.LinearDynamicGP(1, pairs=1, integrators=1), record)
    values = {k: 0.0 * v if "g_" in k and "_log" not in k else v for k, v in values.items()}
    values["g_integrator_noise"] = tensor([[walk]])
    values["noise_sd"], values["offset"] = tensor([sd]), tensor([0.0])
    y = along.scaled_outputs.numpy()
    theirs = UnobservedComponents(y, "local level")
    before = (WALKED * walk) ** 2 / (2.0 * WALK)  # of the random walk at the first sample
    theirs.initialize_known(np.zeros(1), np.array([[LEVEL**2 + before]]))
    theirs.loglikelihood_burn = 0
    expected = theirs.loglike([sd**2, (WALKED * walk) ** 2 / (n - 1)])
    outputs = ExactOutputs(model.system(values, along.scaling), along)
    found = float(outputs.log_prob(along.observations)) + n * np.log(along.scaling.output_scale[0])
    assert found == pytest.approx(expected, abs=0.02)


def plant(n=360, seed=1, time_constant=None):
    """A level, or a position behind a lag, with its truth."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], size=n // 12 + 1), 12)[:n]
    rate = np.zeros(n)
    for k in range(1, n):
        keep = 0.0 if time_constant is None else np.exp(-1.0 / time_constant)
        rate[k] = keep * rate[k - 1] + (1.0 - keep) * u[k - 1]
    truth = 0.02 * np.cumsum(rate) + 4.0
    y = truth + 0.02 * rng.standard_normal(n)
    return dgp.Record(time=np.arange(float(n)), inputs=50.0 + 5.0 * u, outputs=y), truth


@pytest.fixture(scope="module")
def fit():
    record, _ = plant()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return dgp.fit(dgp.LinearDynamicGP(1, pairs=1, integrators=1), record[:240], **QUICK)


def test_forecasts_hold(fit):
    record, truth = plant()
    found = fit.forecast(record[:240], record[240:])
    assert np.sqrt(np.mean((found.mean[:, 0] - truth[240:]) ** 2)) < 0.015
    low, high = found.quantile([0.025, 0.975])[..., 0]
    y = record.outputs[240:, 0]
    assert 0.88 <= np.mean((y >= low) & (y <= high)) <= 1.0


def test_the_rate_is_told_in_units_of_the_record(fit):
    posterior = fit.to_arviz(prior_samples=2, samples=2).posterior
    assert float(posterior["g_integrator_rate"].mean()) == pytest.approx(0.02 / 5.0, rel=0.02)
    assert "g_steady_state_gain" not in posterior
    assert posterior["g_time_constant"].shape[-1] == 1
    assert "an integrator" in fit.summary()
    assert "nan" not in fit.summary()


def test_files_keep_integrators(fit, tmp_path):
    record, _ = plant()
    fit.save(tmp_path / "level.safetensors")
    again = dgp.load(tmp_path / "level.safetensors")
    a, b = (f.forecast(record[:240], record[240:]).mean for f in (fit, again))
    np.testing.assert_array_equal(a, b)


def test_a_cascade_of_one_layer_is_the_linear_model(fit):
    record, _ = plant()
    model = dgp.Cascade(1, (dgp.Dynamic(pairs=1, integrators=1),), scaling=fit.scaling)
    values = pyro.poutine.condition(model.collapsed, data=dict(fit.mode))
    found = float(pyro.poutine.trace(values).get_trace(record[:240]).log_prob_sum())
    assert found == pytest.approx(fit.log_joint(record[:240]), rel=1e-12)


def test_a_sensor_that_is_not_linear():
    """The integrator below a function."""
    record, truth = plant(n=240, time_constant=4.0)
    truth = np.tanh(1.5 * (truth - 4.0))
    bent = record.with_outputs(np.tanh(1.5 * (record.outputs - 4.0)))
    layers = (dgp.Dynamic(pairs=1, integrators=1, process_noise=False), dgp.Static())
    options = {**QUICK, "restarts": 2, "steps": 150}
    found = dgp.fit(dgp.Cascade(1, layers), bent[:160], method="map", **options)
    error = found.forecast(bent[:160], bent[160:]).mean[:, 0] - truth[160:]
    assert np.sqrt(np.mean(error**2)) < 0.1 * truth.std()


def test_feedback_from_a_position():
    """An integrator in a loop: samples of the model are finite, and its density has a gradient."""
    layers = (dgp.Dynamic(pairs=1, integrators=1, feedback=("f",)), dgp.Static(inducing=6))
    record = some_record(n=30)
    model, along, values = prepared(dgp.Cascade(1, layers, output="g"), record)
    value = values["g_integrator_gain"].requires_grad_()
    system = model.system(values, along.scaling)
    density = MomentOutputs(system, along).log_prob(along.observations)
    (gradient,) = torch.autograd.grad(density, value)
    assert value.shape == (1, 2)
    assert bool(torch.isfinite(gradient).all() and (gradient != 0).all())


@pytest.mark.parametrize(("process_noise", "outputs"), [(True, 1), (False, 1), (True, 2)])
def test_hidden_signals_do_not_see_integrators(process_noise, outputs):
    """Where an output integrates nothing depends on its level: levels are of outputs alone."""
    layer = dgp.Dynamic(
        outputs=outputs, pairs=2, integrators=1, hidden=1, feedback=("f",),
        process_noise=process_noise,
    )  # fmt: skip
    function = dgp.Static(inducing=4, sees=("g_hidden",), name="f")
    model = dgp.Cascade(1, (layer, function), output="g")
    model, along, values = prepared(model, some_record(outputs=outputs))
    shapes = {k: tuple(v.shape) for k, v in values.items()}
    assert shapes["g_integrator_gain"] == (outputs, 2)  # of the input, and of what comes back
    assert shapes["g_integrator_drift"] == (outputs,)
    assert shapes.get("g_integrator_noise") == ((outputs, outputs) if process_noise else None)
    modes = model.system(values, along.scaling).layer("g").modes
    at_zero = modes.poles == 0.0
    assert int(at_zero.sum()) == outputs
    own = modes.C[:, at_zero]
    np.testing.assert_array_equal(own[:outputs], np.eye(outputs))
    assert not own[outputs:].any()
    labels = {site.name: site.dims for site in model.sites(along.scaling)}
    assert labels["g_integrator_gain"] == ("output", "g_input")
    outputs_ = MomentOutputs(model.begin(model.system(values, along.scaling), {}), along)
    assert np.isfinite(float(outputs_.log_prob(along.observations)))


# Of the sensor of a position; its input moves it by four times as much.
NOISE = 0.005


def fast_moves(n=400, seed=3):
    """A position that integrates an input without a slow part, behind a lag."""
    rng = np.random.default_rng(seed)
    u = np.diff(rng.standard_normal(n + 1))
    lagged = lfilter([0.0, 0.3], [1.0, -0.7], u)
    y = 0.05 * np.cumsum(np.concatenate([[0.0], lagged[:-1]]))
    return dgp.Record(0.1 * np.arange(n), u[:, None], (y + NOISE * rng.standard_normal(n))[:, None])


def test_rates_may_be_large_and_draws_of_them_forecast():
    """What the integral of a fast input makes is small: gains are tens of standard deviations.

    A normal prior of one held them down (its cost was hundreds of nats), and draws counted for
    nothing beyond 40.
    """
    record = fast_moves()
    fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1, integrators=1), record[:250], **QUICK)
    assert float(fit.draws["g_integrator_gain"].mean()) > 20.0
    assert np.isfinite(fit.diagnostics["pareto_k"])
    found = fit.forecast(record[:250], record[250:])
    assert np.sqrt(np.mean((found.mean - record.outputs[250:]) ** 2)) < 1.2 * NOISE


def test_starts_have_the_rate_that_data_say_beside_time():
    """Time goes far and the integral of a fast input does not: one ridge is for both."""
    record = fast_moves()
    model = dgp.LinearDynamicGP(1, pairs=1, integrators=1).scaled_to(record)
    (along,) = model.prepare(record)
    poles = np.array([np.log(0.7) / 0.1 + 0.01j])
    _, values = values_given_poles(model, [along], along.scaling, poles)
    rate = np.sqrt(np.pi / (39.9 * 0.1))
    u, y = along.scaling.input_scale[0], along.scaling.output_scale[0]
    exact = 0.05 / 0.1 / rate * float(u / y)
    assert exact > 20.0
    # The noise of a quarter of the output makes the least squares uncertain by some percent; a
    # ridge that time dominates leaves a twentieth (2.1 of 36).
    assert float(values["g_integrator_gain"]) == pytest.approx(exact, rel=0.1)
