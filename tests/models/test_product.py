"""Products in feedback: bilinear systems, against a dense Kalman filter, saved and copied."""

import copy
import dataclasses
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import DeadZone, Recorded, Trend
from pyro_dynogp.effects.nonlinear_feedback import NonlinearFeedbackOfOutput
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.extended import extended_starts
from pyro_dynogp.models.assembly import assemble
from pyro_dynogp.models.feedback_variants import (
    with_feedback,
    with_products,
    with_products_of_states,
)
from pyro_dynogp.models.forms import have_no_place
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.product import Products, factors, is_product
from pyro_dynogp.models.variants import with_channel, without_channel
from pyro_dynogp.moments.functions import gauss_hermite
from tests.models.closed_loops import (
    ClosedLoop,
    check_free_run,
    check_gradient,
    make_record,
    system_at,
)
from tests.models.test_known import values_at as any_values_at

EFFECT = NonlinearFeedbackOfOutput()
SAID = SimpleNamespace(sentence="What the test said.", where={"output": "y"})
CASES = pytest.mark.parametrize(
    ("inputs", "outputs", "hidden", "irregular"),
    [(1, 1, False, False), (3, 1, False, True), (2, 2, False, False), (2, 1, True, False)],
)


def values_at(model, seed):
    """Values of all sites at random; with more feedback inputs would make the system unstable."""
    values = any_values_at(model, seed)
    values["g_input_gain"][:, model.inputs :] *= 0.05
    return values


class BilinearLoop(ClosedLoop):
    """x[k + 1] = (Phi + sum_ij Gamma_ij u_i[k] C_j) x[k] + drive_k + noise, in numpy."""

    def __init__(self, model, system, record, hidden):
        modes = system.layer("g").modes
        d, count = model.inputs, 1 if hidden else model.outputs
        lam = np.concatenate([modes.poles.numpy(), modes.poles.numpy().conj()])
        B = np.concatenate([modes.B.numpy(), modes.B.numpy().conj()])
        C = np.concatenate([modes.C.numpy(), modes.C.numpy().conj()], -1)[-count:]
        D = modes.D.numpy()[-count:, :d]
        offset = np.zeros(count) if hidden else system.offset.numpy()
        scaling, n_y = model.scaling, model.outputs
        u = (record.inputs - scaling.input_offset) / scaling.input_scale
        L = np.concatenate([modes.noise_gain.numpy(), modes.noise_gain.numpy().conj()])
        rates = lam[:, None] + lam.conj()[None]
        sigma = -(L @ L.conj().T) / rates
        self.F, self.drive, self.Q = [], [], []
        for k, step in enumerate(np.diff(record.time)):
            gain = (np.expm1(lam * step) / lam)[:, None] * B
            back = gain[:, d:].reshape(-1, d, count)
            along = np.einsum("pij,i->pj", back, u[k])
            self.F.append(np.diag(np.exp(lam * step)) + along @ C)
            self.drive.append(gain[:, :d] @ u[k] + along @ (D @ u[k] + offset))
            self.Q.append(-sigma * np.expm1(rates * step))
        self.H = np.concatenate([modes.C.numpy(), modes.C.numpy().conj()], -1)[:n_y]
        self.level = u @ modes.D.numpy()[:n_y, :d].T + system.offset.numpy()
        first = system.layer("g").first_state.numpy()
        self.m0, self.P0 = np.concatenate([first, first.conj()]), sigma
        self.noise = system.noise.constant_sd.numpy() ** 2
        self.scale, self.shift = scaling.output_scale, scaling.output_offset


def bilinear(inputs=1, outputs=1, hidden=False):
    model = with_products(dgp.LinearDynamicGP(inputs, outputs=outputs, pairs=2), hidden=hidden)
    ((_, layer),) = model.dynamic
    return dgp.Cascade(
        inputs, (layer.__class__(**{**vars(layer), "substeps": 1}), *model.layers[1:]),
        output=model.output,
    )  # fmt: skip


@CASES
def test_it_is_the_kalman_filter_of_the_bilinear_system(inputs, outputs, hidden, irregular):
    """Given the inputs the system is linear, if another one at every sample."""
    record = make_record(inputs, outputs, irregular=irregular)
    model = bilinear(inputs, outputs, hidden).scaled_to(record)
    for seed in range(3):
        system = system_at(model, values_at(model, seed))
        dense = BilinearLoop(model, system, record, hidden)
        y = dense.scaled(record.outputs)
        expected, means, covariances = dense.filter(y)
        (prepared,) = model.prepare(record)
        process = output_process(system, prepared)
        there = ~np.isnan(y)
        found = float(process.log_prob(prepared.observations))
        logs = np.log(dense.scale) @ there.sum(0)
        assert found == pytest.approx(expected - logs, rel=1e-8, abs=1e-7)
        ahead = process.one_step(prepared.observations)
        mean = dense.scaled(ahead.mean.numpy().reshape(y.shape))
        first = there[:, 0]  # later outputs are foretold given the first
        np.testing.assert_allclose(mean[first, 0], means[first, 0], rtol=1e-7, atol=1e-8)
        variance = ahead.variance.numpy().reshape(y.shape)[first, 0] / dense.scale[0] ** 2
        expected = covariances[first, 0, 0] + dense.noise[0]
        np.testing.assert_allclose(variance, expected, rtol=1e-7, atol=1e-9)


@CASES
def test_gradient_is_that_of_finite_differences(inputs, outputs, hidden, irregular):
    record = make_record(inputs, outputs, n=25, irregular=irregular)
    model = bilinear(inputs, outputs, hidden).scaled_to(record)
    check_gradient(Potential(model, (model.prepare(record),), values_at(model, 0)))


def test_points_side_by_side_are_those_one_by_one():
    record = make_record(2)
    model = bilinear(2).scaled_to(record)
    points = [values_at(model, seed) for seed in range(5)]
    potential = Potential(model, (model.prepare(record),), points[0])
    alone = [float(potential.energies_at([point])[0]) for point in points]
    # Sums are in another order in lanes.
    np.testing.assert_allclose(potential.energies_at(points), alone, rtol=1e-10)


def test_layers_drawn_as_sites_are_multiplied_alike():
    """Of inputs alone it is a layer before the dynamics: no filter, the same products."""
    record = make_record(2)
    model = dgp.Cascade(2, (dgp.Product(sees=("inputs",)), dgp.Dynamic(pairs=1))).scaled_to(record)
    system = system_at(model, values_at(model, 0))
    u = (record.inputs - model.scaling.input_offset) / model.scaling.input_scale
    found = system.layer("f").function.mean(torch.from_numpy(u))
    np.testing.assert_allclose(found[:, 0], u[:, 0] * u[:, 1])


@pytest.mark.parametrize("site", ["g_input_gain", "offset", "g_log_decay"])
def test_sites_matter_to_the_products(site):
    record = make_record()
    model = bilinear().scaled_to(record)
    values = values_at(model, 0)
    (prepared,) = model.prepare(record)

    def density(given):
        return float(output_process(system_at(model, given), prepared).log_prob(
            prepared.observations))  # fmt: skip

    moved = values | {site: values[site] + 0.1}
    if site == "g_input_gain":  # of what comes back alone
        moved[site][:, 0] = values[site][:, 0]
    assert abs(density(moved) - density(values)) > 1e-4


def test_each_of_the_first_is_multiplied_with_each_of_the_others():
    layer = dgp.Product(2, 3)
    assert (layer.outputs, factors(layer), is_product(layer)) == (6, 2, True)
    signals = [torch.full((4,), x) for x in (2.0, 3.0, 5.0, 7.0, 11.0)]
    assert layer.function(*signals)[0].tolist() == [10.0, 14.0, 22.0, 15.0, 21.0, 33.0]
    assert dgp.Product().function(*signals[:2]).tolist() == [6.0] * 4
    for other in (dgp.Form("step"), dgp.Static(), dgp.Known(torch.mul)):
        assert (factors(other), is_product(other)) == (0, False)


def test_copies_and_files_have_the_same_layer(tmp_path):
    layer = dgp.Product(2, sees=("inputs", "g"), name="heat")
    for twin in (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer)),
                 dgp.Product(2, sees=("inputs", "g"), name="heat")):  # fmt: skip
        assert twin == layer
    assert layer != dgp.Product(1, 2, sees=("inputs", "g"), name="heat")
    record = make_record(2, missing=False)
    fit = dgp.fit(bilinear(2), record, method="map", restarts=1, steps=3, workers=1,
                  progress=False)  # fmt: skip
    fit.save(tmp_path / "heat.fit")
    again = dgp.load(tmp_path / "heat.fit")
    assert again.model == fit.model
    assert isinstance(again.model.layers[1].function, Products)
    assert "product, 2 outputs" in fit.summary()
    run = fit.simulate(record).mean
    np.testing.assert_array_equal(again.simulate(record).mean, run)


@pytest.mark.parametrize(
    ("sees", "first", "others", "got"),
    [(("inputs", "g"), 1, 1, "3 signals"), (("g",), 1, 1, "1 signals"),
     (("inputs", "g"), 1, 3, "3 signals")],
)  # fmt: skip
def test_as_many_signals_as_it_multiplies(sees, first, others, got):
    layers = (dgp.Dynamic(feedback=("f",)), dgp.Product(first, others, sees=sees))
    with pytest.raises(ValueError, match=f"layer 'f': expected {first} signals.*{got}"):
        dgp.Cascade(2, layers, output="g")


def of_states(record, first=1, others=1, **options):
    """Products of hidden signals, of so many with so many others."""
    count = first + others
    layer = dgp.Dynamic(pairs=2, feedback=("f",), hidden=count, **options)
    product = dgp.Product(first, others, sees=("g_hidden",), name="f")
    return dgp.Cascade(1, (layer, product), output="g").scaled_to(record)


def test_known_factors_take_the_fewest_nodes():
    """What is linear in the rest is exact there: functions of inputs are known, dynamics not."""
    record = make_record(1, missing=False)
    loop = {"pairs": 1, "feedback": ("f",), "name": "g", "sees": ("bent", "g0")}
    for signal, nodes in (("bent", 4), ("g0", 25)):
        bent = dgp.Static(inducing=4, sees=("inputs",), name="bent")
        first = dgp.Dynamic(pairs=1, name="g0", sees=("inputs",))
        product = dgp.Product(sees=(signal, "g"), name="f")
        layers = (bent, first, dgp.Dynamic(**loop), product)
        model = dgp.Cascade(1, layers, output="g", integrate="all").scaled_to(record)
        (prepared,) = model.prepare(record)
        system = system_at(model, any_values_at(model, 0))
        layout = assemble(system, prepared.grid, prepared.scaled_inputs).problem.layout
        assert layout.node_count[-1] == nodes
        found = output_process(system, prepared).log_prob(prepared.observations)
        assert bool(found.isfinite())


@pytest.mark.parametrize("count", [2, 3, 4])
def test_moments_of_products_are_exact(count):
    """Of correlated normal signals, by Isserlis' theorem."""
    nodes, weights = gauss_hermite(count)
    rng = np.random.default_rng(count)
    L, m = np.tril(rng.standard_normal((count, count))), rng.standard_normal(count)
    S, z = L @ L.T, m + nodes @ L.T
    f = z[:, 0] * z[:, 1]
    mean = weights @ f
    assert mean == pytest.approx(m[0] * m[1] + S[0, 1])
    variance = S[0, 0] * S[1, 1] + S[0, 1] ** 2
    variance += m[0] ** 2 * S[1, 1] + m[1] ** 2 * S[0, 0] + 2.0 * m[0] * m[1] * S[0, 1]
    assert weights @ (f - mean) ** 2 == pytest.approx(variance)


def test_free_runs_of_products_of_states_are_those_of_a_plain_simulation():
    record = make_record(missing=False)
    model = of_states(record, process_noise=False, feedthrough=False)
    values = any_values_at(model, 3)
    values |= {k: 0.2 * x for k, x in values.items() if k.endswith("_gain")}
    check_free_run(model, values, record, lambda signals: signals[1] * signals[2], 1e-9)


@pytest.mark.parametrize("others", [1, 2])
def test_gradient_of_products_of_states(others):
    record = make_record(n=25)
    model = of_states(record, 1, others)
    values = any_values_at(model, 1)
    values |= {k: 0.3 * x for k, x in values.items() if k.endswith("_gain")}
    check_gradient(Potential(model, (model.prepare(record),), values))


def test_which_models_get_products_of_states():
    model = with_products_of_states(dgp.LinearDynamicGP(1, pairs=2))
    assert [w.sources for w in model.wires] == [("inputs",), ("g_hidden",)]
    ((wire, layer),) = model.dynamic
    assert (wire.feedback, layer.hidden, layer.substeps) == (("feedback_products",), 3, 3)
    assert model.layers[1].outputs == 2
    assert have_no_place(model.layers)
    assert not have_no_place(with_products(dgp.LinearDynamicGP(1), hidden=True).layers)
    for other in (
        dgp.LinearDynamicGP(1, pairs=1), dgp.LinearDynamicGP(1, pairs=2, outputs=2),
        dgp.NonlinearFeedback(1, pairs=2, hidden=1), model,
    ):  # fmt: skip
        assert with_products_of_states(other) is None


def test_predator_and_prey_are_found_by_products_of_states():
    """From a linear model, the prey measured: to little more than the noise."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.0, 0.3, 50), 12)[:, None]
    x, y = np.array([0.8, 0.6]), np.empty(600)
    for k in range(600):
        y[k] = x[0]
        for _ in range(20):
            growth = [1.0 - 0.3 * x[0] - x[1] - u[k, 0], -0.6 + 0.9 * x[0]]
            x = x + 0.01 * x * np.array(growth)
    sd = 0.02 * y.std()
    record = dgp.Record(0.2 * np.arange(600), u, (y + sd * rng.standard_normal(600))[:, None])
    past, future = record[:400], record[400:]
    line = dgp.fit(dgp.LinearDynamicGP(1, pairs=2), past, method="map", workers=1, progress=False)
    model = with_products_of_states(line.model)
    fit = refit(line, past, model=model, run=Run(0, workers=1))
    before, after = (
        np.sqrt(np.mean((one.forecast(past, future).mean[:, 0] - y[400:]) ** 2)) / sd
        for one in (line, fit)
    )
    assert before > 4.0
    assert after < 1.5
    assert EFFECT.parameters(fit, SAID, past) == {}
    assert EFFECT.sentence(SAID, model) == (
        "Products of signals of the dynamics of 'y' that are not measured act back on them."
    )


@pytest.mark.parametrize("bad", [0, -1, 1.5, "two", None])
@pytest.mark.parametrize("argument", ["first", "others"])
def test_numbers_of_signals_are_whole(argument, bad):
    with pytest.raises(ValueError, match=f"{argument}: expected a whole number"):
        dgp.Product(**{argument: bad})


class TestVariants:
    def test_the_loop_multiplies_inputs_with_the_output_or_a_hidden_signal(self):
        for outputs, hidden, sees in ((1, False, "g"), (2, False, "g"), (2, True, "g_hidden")):
            model = with_products(dgp.LinearDynamicGP(3, outputs=outputs), hidden=hidden)
            (product,) = model.dynamic[0][0].feedback
            wire = next(w for w in model.wires if w.name == product)
            assert wire.sources == ("inputs", sees)
            assert wire.layer.outputs == 3 * (1 if hidden else outputs)
            assert model.substeps == 3  # what multiplies changes within a step
            assert model.dynamic[0][1].hidden == int(hidden)

    def test_functions_that_act_back_stay(self):
        spring = with_feedback(dgp.LinearDynamicGP(1))
        both = with_products(spring)
        assert both.dynamic[0][0].feedback == ("feedback", "feedback_product")
        assert with_products(both) is None
        more = with_products(both, hidden=True)
        assert more.dynamic[0][0].feedback == ("feedback", "feedback_product", "hidden_product")

    def test_without_inputs_there_is_nothing_to_multiply(self):
        assert with_products(dgp.LinearDynamicGP(0)) is None
        heavy = dgp.LinearDynamicGP(1, likelihood=dgp.StudentT(4))
        assert with_products(heavy) is None


@pytest.mark.parametrize(("n", "method"), [(120, "importance"), (240, "svi")])
def test_without_functions_to_learn_draws_are_of_all_parameters(n, method):
    """Where functions are learnt, with feedback along 150 samples or fewer alone."""
    rng = np.random.default_rng(0)
    u = np.repeat(np.clip(0.5 * rng.standard_normal(n // 5), -0.9, 0.9), 5)
    x, y = 1.0, []
    for k in range(n):
        y.append(x)
        x += 0.1 * (1.0 + u[k] - x + 0.8 * u[k] * x)
    y = np.array(y) + 0.01 * rng.standard_normal(n)
    record = dgp.Record(0.1 * np.arange(n), u[:, None], y[:, None])
    model = with_products(dgp.LinearDynamicGP(1, pairs=1, process_noise=False))
    fit = dgp.fit(model, record, workers=1, progress=False)
    assert fit.method == method
    assert float(fit.draws["g_input_gain"].std(0).min()) > 1e-4
    # Of 120 samples it is known to 7 %: three standard errors.
    assert fit.noise_sd == pytest.approx(0.01, rel=0.2)


class TestChannels:
    @pytest.mark.parametrize(
        ("channel", "inputs"),
        [(Recorded("w"), 3), (DeadZone("u1", -0.5, 0.5), 2), (Trend(0.0, 4.0), 2)],
    )
    def test_all_inputs_that_drive_are_multiplied(self, channel, inputs):
        """A dead zone replaces its input, and a trend does not drive."""
        model = with_products(with_feedback(dgp.LinearDynamicGP(2)))
        more = with_channel(model, channel)
        (product,) = (layer for layer in more.layers if is_product(layer))
        assert factors(product) == inputs
        assert more.dynamic[0][0].fed == 1 + inputs
        assert without_channel(more, channel) == model

    @pytest.mark.parametrize("integrators", [0, 1])
    def test_what_is_learnt_stays_where_an_input_is_added(self, integrators):
        """Gains of what comes back follow those of the inputs, and move on by one."""
        rng = np.random.default_rng(5)
        record = make_record(2, missing=False)
        record = dgp.Record(record.time, record.inputs, record.outputs,
                            extra={"w": rng.standard_normal(len(record))})  # fmt: skip
        linear = dgp.LinearDynamicGP(2, pairs=1, process_noise=False, integrators=integrators)
        model = with_products(with_feedback(linear))
        fit = dgp.fit(model, record, method="map", restarts=1, steps=20, workers=1, progress=False)
        larger = with_channel(model, Recorded("w"))
        records = larger.prepare(record)
        scaled = dataclasses.replace(larger, scaling=records[0].scaling)
        start = extended_starts(fit, scaled, records, 0)[0][-1]
        old, new = fit.mode["g_input_gain"], start["g_input_gain"]
        assert new.shape[1] == 3 + 1 + 3
        np.testing.assert_array_equal(new[:, [0, 1, 3, 4, 5]], old)
        assert (new[:, [2, 6]] == 0.0).all()
        if integrators:
            old, new = fit.mode["g_integrator_gain"], start["g_integrator_gain"]
            np.testing.assert_array_equal(new[:, [0, 1, 3, 4, 5]], old)
            assert (new[:, [2, 6]] == 0.0).all()
        before, after = (
            output_process(system_at(given, values), prepared)
            .one_step(prepared.observations)
            .mean.numpy()
            for given, values, prepared in (
                (fit.model, fit.mode, fit.model.prepare(record)[0]), (scaled, start, records[0])
            )
        )  # fmt: skip
        np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-6)
