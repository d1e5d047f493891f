"""Saved cascades: exact round trip of every kind of model, and what is refused."""

import json
from dataclasses import replace
from types import MappingProxyType

import gpytorch
import numpy as np
import pyro
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

import pyro_dynogp as dgp
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.inference.storage import FORMAT
from pyro_dynogp.inference.stored_layers import layer_of, plain_layer
from pyro_dynogp.support.checkpoints import write_tensors
from tests.inference.cascades import FAST, wiener_record


def prior_fit(model, *records):
    """A "fit" whose values are a draw from the prior: enough to save, load and predict."""
    model = model.scaled_to(records)
    with torch.random.fork_rng(), torch.no_grad(), pyro.poutine.block():
        torch.manual_seed(1)
        short = [record[:5] for record in records]
        argument = short[0] if len(short) == 1 else tuple(short)
        trace = pyro.poutine.trace(model.collapsed).get_trace(argument)
    values = {
        name: site["value"].detach()
        for name, site in trace.nodes.items()
        if site["type"] == "sample" and not site["is_observed"]
    }
    return Fit(
        model=model,
        posterior=Mixture.at(values),
        draws=MappingProxyType({k: v.unsqueeze(0) for k, v in values.items()}),
        mode=MappingProxyType(values),
        history=np.array([2.0, 1.0]),
        start_energies=np.array([1.0]),
        diagnostics=MappingProxyType({"iterations": 2.0}),
        seed=0,
        records=tuple(records),
    )


def assert_equal(a, b):
    assert a.model == b.model
    assert (a.method, a.seed, a.training) == (b.method, b.seed, b.training)
    assert dict(a.diagnostics) == dict(b.diagnostics)
    for one, two in ((a.draws, b.draws), (a.mode, b.mode)):
        assert one.keys() == two.keys()
        assert all(torch.equal(one[k], two[k]) for k in one)
    assert np.array_equal(a.history, b.history)
    assert np.array_equal(a.start_energies, b.start_energies)


def test_limits_of_a_sensor_are_kept(tmp_path):
    record = wiener_record(n=60)
    low = float(np.quantile(record.outputs, 0.2))
    layers = (dgp.Dynamic(pairs=1), dgp.Static(inducing=5, limits=(low, None)))
    fit = prior_fit(dgp.Cascade(1, layers), record)
    fit.save(tmp_path / "fit.safetensors")
    again = dgp.load(tmp_path / "fit.safetensors")
    assert again.model.layers[-1].limits == (low, None)
    assert_same_predictions(fit, again, record)


def assert_same_predictions(a, b, record):
    rest = wiener_record(n=len(record) + 20)[len(record) :]
    for one, two in (
        (a.simulate(rest, samples=8), b.simulate(rest, samples=8)),
        (a.predict(record, horizon=2), b.predict(record, horizon=2)),
        (a.forecast(record, rest, samples=8), b.forecast(record, rest, samples=8)),
    ):
        assert np.array_equal(one.mean, two.mean)
        assert np.array_equal(one.variance, two.variance)
        assert np.array_equal(one.samples, two.samples)


@pytest.mark.parametrize("name", ["collapsed_fit", "layered_fit"])
def test_exact_round_trip(name, request, tmp_path, bent):
    fit = request.getfixturevalue(name)
    fit.save(tmp_path / "fit")
    again = dgp.load(tmp_path / "fit")
    assert_equal(fit, again)
    assert_same_predictions(fit, again, bent)
    assert again.summary() == fit.summary()
    # Trajectories along the training record are not kept, and nothing that is used needs them.
    assert not again.trajectories


def test_loaded_guide_is_the_same_distribution(collapsed_fit, tmp_path, bent):
    """The posterior is a normal for some sites and a point for the others: all are restored."""
    assert isinstance(collapsed_fit.posterior, Mixture)
    collapsed_fit.save(tmp_path / "fit")
    again = dgp.load(tmp_path / "fit")
    totals = []
    for guide in (collapsed_fit.guide, again.guide):
        with torch.random.fork_rng():
            torch.manual_seed(3)
            trace = pyro.poutine.trace(guide).get_trace(bent)
        totals.append(float(trace.log_prob_sum()))
        assert {n for n in trace.nodes if n in collapsed_fit.draws} == set(collapsed_fit.draws)
    assert totals[0] == totals[1]
    sites = [fit.posterior.sites for fit in (collapsed_fit, again)]
    assert [(s.name, s.shape) for s in sites[0]] == [(s.name, s.shape) for s in sites[1]]


MODELS = {
    "wiener": dgp.Wiener(1, pairs=2, inducing=5),
    "hammerstein": dgp.Hammerstein(1, pairs=1, inducing=5, priors="paper"),
    "wiener-hammerstein": dgp.WienerHammerstein(
        1, pairs=(1, 2), inducing=5, width=2, process_noise=(True, False)
    ),
    "hammerstein-wiener": dgp.HammersteinWiener(1, pairs=1, inducing=(4, 5)),
    "student": dgp.Wiener(1, pairs=1, inducing=5, likelihood=dgp.StudentT(3.0)),
    "heteroscedastic": dgp.Wiener(1, pairs=1, inducing=5, likelihood=dgp.Heteroscedastic(4)),
    "noise of the output": dgp.Wiener(
        1, pairs=1, inducing=5, likelihood=dgp.Heteroscedastic(4, of="output")
    ),
    "integrated": dgp.Wiener(1, pairs=1, inducing=5, initial_state="integrated"),
    "skips": dgp.Cascade(
        1,
        (
            dgp.Dynamic(pairs=1, name="body", noise="independent", feedthrough=False),
            dgp.Static(inducing=5, skip=("inputs",), mean="linear", learn_locations=False),
            dgp.Dynamic(pairs=1, skip=("body",), brownian=2),
        ),
        integrate="last",
    ),
}


@pytest.mark.parametrize("name", list(MODELS))
def test_every_model_comes_back(name, tmp_path, bent):
    fit = prior_fit(MODELS[name], bent)
    fit.save(tmp_path / "fit")
    again = dgp.load(tmp_path / "fit")
    assert_equal(fit, again)
    assert again.model.layers == MODELS[name].layers
    # Draws of flat priors exceed floating-point range.
    pair = (fit.predict(bent).mean, again.predict(bent).mean)
    assert np.array_equal(*pair, equal_nan=MODELS[name].priors == "paper")


def test_several_records(tmp_path, bent):
    """First states are numbered, and each training record is recognised by its fingerprint."""
    other = wiener_record(n=40, seed=4)
    fit = prior_fit(MODELS["wiener"], bent, other)
    fit.save(tmp_path / "fit")
    again = dgp.load(tmp_path / "fit")
    assert_equal(fit, again)
    for record in (bent, other):
        assert np.array_equal(fit.predict(record).mean, again.predict(record).mean)


def test_a_guide_with_first_states_of_several_records(tmp_path, bent):
    records = (bent[:40], wiener_record(n=30, seed=4))
    model = dgp.Wiener(1, pairs=1, inducing=3)
    fit = dgp.fit(model, records, **{**FAST, "steps": 1})
    fit.save(tmp_path / "fit")
    again = dgp.load(tmp_path / "fit")
    assert_equal(fit, again)
    names = [site.name for site in again.posterior.sites]
    assert names == ["f_values", "g_initial_state_0", "g_initial_state_1"]
    assert (
        sum(s.unconstrained.numel() for s in again.posterior.sites) == again.posterior.loc.shape[-1]
    )


def test_a_linear_guide_with_a_first_state(tmp_path, map_fit, record):
    """Its site comes after those of the parameters, and belongs to the normal too."""
    model = replace(map_fit.model, initial_state="site")
    values = {**map_fit.mode, "g_initial_state": torch.zeros(2, dtype=torch.float64)}
    potential = Potential(model, (record,), values)
    root = torch.eye(potential.size, dtype=torch.float64)
    fit = replace(
        map_fit,
        model=model,
        mode=values,
        draws={name: value.unsqueeze(0) for name, value in values.items()},
        posterior=Mixture.normal(potential, potential.pack(values), root),
    )
    fit.save(tmp_path / "fit")
    again = dgp.load(tmp_path / "fit")
    assert [s.name for s in again.posterior.sites] == [s.name for s in fit.posterior.sites]
    assert "g_initial_state" in again.guide(record)


def test_a_kernel_of_gpytorch_is_refused(tmp_path, bent):
    kernel = gpytorch.kernels.RBFKernel()
    fit = prior_fit(dgp.Wiener(1, pairs=1, inducing=5, kernel=kernel), bent)
    with pytest.raises(ValueError, match=r"save: .* got RBFKernel in layer 'f'"):
        fit.save(tmp_path / "fit")
    assert not list(tmp_path.iterdir())


def header_of(path):
    with safe_open(str(path), framework="pt") as file:
        return json.loads(file.metadata()[FORMAT])


def rewrite(path, header):
    write_tensors(path, load_file(str(path)), {FORMAT: json.dumps(header)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "Fourier"}, "unknown layer 'Fourier'"),
        ({"order": 3}, "incomplete or damaged"),
        ({"pairs": 0}, "pairs of layer 'g'"),
    ],
)
def test_damaged_layers_are_refused(change, message, tmp_path, bent):
    prior_fit(MODELS["wiener"], bent).save(tmp_path / "fit")
    header = header_of(tmp_path / "fit")
    header["options"]["layers"][0] |= change
    rewrite(tmp_path / "fit", header)
    with pytest.raises(ValueError, match=message):
        dgp.load(tmp_path / "fit")


def test_a_least_lengthscale_is_kept_and_files_without_one_have_none():
    layer = dgp.NonlinearFeedback(1).layers[1]
    options = plain_layer(layer)
    assert options is not None
    assert layer_of(options) == layer
    assert options.pop("least_lengthscale") == 2.0
    assert layer_of(options) == replace(layer, least_lengthscale=0.0)
