"""Problems in units and an order of channels that do not depend on the record's."""

import dataclasses

import numpy as np
import pyro.distributions as dist
import pytest
import torch
from gpytorch.kernels import RBFKernel

import pyro_dynogp as dgp
from pyro_dynogp.inference.canonical import DIGITS, Canonical, _triangular
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.base import Problem

QUICK = {"workers": 1, "progress": False}


def record(n=60, inputs=3, outputs=3, seed=0):
    """Channels of which the second is the smoothest and the first the roughest; gaps."""
    rng = np.random.default_rng(seed)
    smooth = [0.0, 0.95, 0.7]

    def channel(memory, level):
        x = np.zeros(n)
        for k in range(1, n):
            x[k] = memory * x[k - 1] + rng.standard_normal()
        return level * (1.0 + 0.3 * x)

    u = np.stack([channel(smooth[k], 10.0**k) for k in range(inputs)], 1)
    y = np.stack([channel(smooth[k], 5.0 - 3.0 * k) for k in range(outputs)], 1)
    y[7, 0], y[20:23] = np.nan, np.nan
    names = [f"u{k}" for k in range(inputs)], [f"y{k}" for k in range(outputs)]
    return dgp.Record(np.arange(n) * 0.1, u, y, input_names=names[0], output_names=names[1])


CASES = {
    "three inputs and outputs": lambda: dgp.NonlinearFeedback(3, outputs=3, pairs=2, inducing=4),
    "hidden signals": lambda: dgp.NonlinearFeedback(3, outputs=3, pairs=1, inducing=4, hidden=2),
    "a direct input": lambda: dgp.NonlinearFeedback(3, outputs=3, pairs=1, inducing=4, direct=1),
    "direct inputs": lambda: dgp.NonlinearFeedback(3, outputs=3, inducing=4, direct=2),
    "noise by the inputs": lambda: dgp.NonlinearFeedback(
        3, outputs=3, pairs=1, inducing=4, likelihood=dgp.Heteroscedastic(inducing=3)
    ),
    "independent motions": lambda: dgp.Cascade(
        3,
        (
            dgp.Dynamic(outputs=3, pairs=2, noise="independent", feedback=("f",), integrators=1),
            dgp.Static(outputs=2, inducing=4, sees=("g", "inputs"), name="f"),
        ),
        output="g",
    ),
    "a function that is measured": lambda: dgp.Cascade(
        3,
        (
            dgp.Dynamic(outputs=2, pairs=1, feedback=("f",)),
            dgp.Static(outputs=3, inducing=4, skip=("inputs",), name="f"),
        ),
    ),
    "a layer before": lambda: dgp.Cascade(
        3,
        (
            dgp.Static(outputs=2, inducing=4, name="a"),
            dgp.Dynamic(outputs=3, pairs=1, feedback=("f",), skip=("inputs",), name="g"),
            dgp.Static(outputs=1, inducing=4, name="f"),
        ),
        output="g",
    ),
    "function of outputs": lambda: dgp.Wiener(3, outputs=3, pairs=1, inducing=4),
    "function of inputs": lambda: dgp.Hammerstein(3, outputs=3, pairs=1, inducing=4),
}


def problem_of(name, records=None):
    records = [record()] if records is None else records
    if name == "direct inputs":  # the first drives, and the last is smoother than the one between
        records = [r.select(inputs=["u1", "u0", "u2"]) for r in records]
    return Problem.of(CASES[name](), records)


def potential(problem, seed=0):
    torch.manual_seed(seed)
    sites = problem.target.all_sites(problem.scaling, len(problem.records))
    start = {site.name: site.prior.sample() for site in sites}
    return Potential(problem.target, (problem.records,), start), start


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("several", [False, True])
def test_density_is_the_same_but_for_the_units(name, several):
    """log p(y) = log p(y / s) - N log s, at values of sites that are put back."""
    records = [record(), record(40, seed=1)] if several else [record()]
    canonical = Canonical.of(problem_of(name, records))
    assert canonical.inputs != (0, 1, 2)
    assert canonical.outputs == (1, 2, 0)
    there, values = potential(canonical.problem)
    scale = canonical.given.scaling.output_scale
    more = sum(float((~np.isnan(r.outputs)).sum(0) @ np.log(scale)) for r in records)
    given, _ = potential(canonical.given)
    back = canonical.values(values)
    found = float(there.energies_at([values])[0])
    expected = float(given.energies_at([dict(back)])[0])
    assert np.isfinite(found)
    assert expected == pytest.approx(found + more, rel=1e-6)


@pytest.mark.parametrize("name", CASES)
def test_each_place_matters(name):
    """Without the order of channels the density is another one."""
    canonical = Canonical.of(problem_of(name))
    _, values = potential(canonical.problem)
    given, _ = potential(canonical.given)
    back = canonical.values(values)
    moved = [k for k, x in back.items() if x.shape and not torch.equal(x, values[k])]
    assert moved
    right, wrong = given.energies_at([dict(back), dict(values)])
    assert abs(float(right - wrong)) > 1e-3


def test_signals_are_rounded_and_in_order():
    canonical = Canonical.of(problem_of("three inputs and outputs"))
    (there,), (given,) = canonical.problem.records, canonical.given.records
    assert there.record.output_names == ("y1", "y2", "y0")
    assert there.record.input_names == ("u1", "u2", "u0")
    expected = np.round(given.scaled_outputs.numpy()[:, [1, 2, 0]], DIGITS)
    np.testing.assert_array_equal(there.record.outputs, expected)
    again = Canonical.of(canonical.problem)
    assert again.outputs == again.inputs == (0, 1, 2)


@pytest.mark.parametrize("factor", [1000.0, 0.001, -3.7])
def test_units_are_gone(factor):
    r = record()
    other = dgp.Record(
        r.time,
        r.inputs * factor,
        r.outputs * abs(factor),
        input_names=r.input_names,
        output_names=r.output_names,
    )
    one, two = (Canonical.of(problem_of("hidden signals", [x])).problem for x in (r, other))
    np.testing.assert_array_equal(one.records[0].record.outputs, two.records[0].record.outputs)
    signed = np.sign(factor) * two.records[0].record.inputs
    np.testing.assert_array_equal(one.records[0].record.inputs, signed)
    assert one.scaling == two.scaling


class Own(RBFKernel):
    """A kernel of the user's."""


@pytest.mark.parametrize(
    "model",
    [
        dgp.LinearDynamicGP(3, outputs=3),
        dgp.Cascade(
            3,
            (
                dgp.Dynamic(outputs=3, pairs=1, feedback=("f",)),
                dgp.Known(lambda *y: y[0], outputs=1, name="f", sees=("inputs",)),
            ),
            output="g",
        ),
        dgp.NonlinearFeedback(3, outputs=3, kernel=Own(ard_num_dims=3)),
    ],
    ids=["linear", "known function", "kernel by place"],
)
def test_others_stay_as_they_are(model):
    problem = Problem.of(model, record())
    assert Canonical.of(problem).problem is problem


def test_a_known_function_in_units_keeps_them():
    def root(level):
        return level.clamp_min(1e-6).sqrt()

    layers = (dgp.Dynamic(pairs=1, feedback=("f",)), dgp.Known(root, name="f"))
    r = record(outputs=1)
    problem = Problem.of(dgp.Cascade(3, layers, output="g"), r)
    assert Canonical.of(problem).problem is problem
    scaled = dataclasses.replace(layers[1], scaled=True)
    problem = Problem.of(dgp.Cascade(3, (layers[0], scaled), output="g"), r)
    assert Canonical.of(problem).problem is not problem


def test_a_start_from_another_fit_keeps_its_order():
    problem = dataclasses.replace(problem_of("three inputs and outputs"), learnt={})
    assert Canonical.of(problem).problem is problem


def test_a_root_that_is_not_triangular_gets_so():
    root = torch.randn(2, 4, 4, dtype=torch.float64)
    found = _triangular(root)
    torch.testing.assert_close(found @ found.mT, root @ root.mT)
    torch.testing.assert_close(found, found.tril())
    assert bool((found.diagonal(dim1=-2, dim2=-1) > 0.0).all())


METHODS = {
    "map": {"method": "map"},
    "normal of functions": {"method": "svi", "draws": 6},
    "normal of all": {"method": "svi", "draws": 6, "hyperparameters": "multivariate normal"},
    "nuts": {"method": "nuts", "draws": 4, "warmup": 2, "chains": 1},
}


@pytest.mark.parametrize("options", METHODS.values(), ids=METHODS)
def test_fits_are_put_back(options):
    """Densities that a fit reports are those of its model, record and values."""
    r = record(40, inputs=2, outputs=2)
    model = dgp.NonlinearFeedback(2, outputs=2, pairs=1, inducing=3)
    fit = dgp.fit(model, r, **options, restarts=1, steps=6, **QUICK)
    assert fit.model.scaling.output_names == ("y0", "y1")
    assert fit.records[0] == r
    assert fit.start_energies[0] == pytest.approx(-fit.log_joint(r), rel=1e-6)
    if fit.method == "svi":  # its density of draws moves with them
        there = Canonical.of(Problem.of(model, r))
        assert there.inputs == there.outputs == (1, 0)
        moved = there.restored(dataclasses.replace(fit, model=there.problem.model))
        log_q = fit.posterior.log_prob(fit.draws)
        assert bool(torch.isfinite(log_q).all())
        torch.testing.assert_close(
            moved.posterior.log_prob(moved.draws), log_q, rtol=1e-8, atol=1e-8
        )


def test_the_evidence_lower_bound_is_in_units_of_the_record():
    """It is below log p(y), and higher by log(1000) a sample in units a thousand times larger."""
    r = record(40, inputs=1, outputs=1)
    small = r.with_outputs(r.outputs * 1000.0)
    model = dgp.NonlinearFeedback(1, pairs=1, inducing=3)
    options = {"method": "svi", "draws": 6, "restarts": 1, "steps": 6, **QUICK}
    one, two = (dgp.fit(model, x, **options) for x in (r, small))
    more = (~r.missing).sum() * np.log(1000.0)
    np.testing.assert_allclose(one.elbo - two.elbo, more, rtol=1e-9)
    assert one.diagnostics["elbo"] - two.diagnostics["elbo"] == pytest.approx(more, rel=1e-9)


def test_draws_with_their_densities_are_put_back():
    r = record(30, inputs=2, outputs=2)
    model = dgp.NonlinearFeedback(2, outputs=2, pairs=1, inducing=3)
    fit = dgp.fit(model, r, restarts=1, steps=6, draws=5, **QUICK)
    source = getattr(fit.posterior, "source", None)
    assert source is not None
    one = {name: value[:1] for name, value in source.values.items()}
    log_p = fit.with_draws(one)
    at = {name: value[0] for name, value in one.items()}
    log_joint = dataclasses.replace(log_p, mode=at).log_joint(r)
    assert float(source.log_p[0]) == pytest.approx(log_joint, rel=1e-6)


def test_a_distribution_of_a_parameter_is_not_touched():
    layers = (
        dgp.Dynamic(pairs=1, feedback=("f",)),
        dgp.Known(lambda y, w: (y / w).tanh(), {"w": dist.LogNormal(0.0, 1.0)}, name="f",
                  scaled=True),
    )  # fmt: skip
    canonical = Canonical.of(Problem.of(dgp.Cascade(2, layers, output="g"), record(40, 2, 1)))
    _, values = potential(canonical.problem)
    assert torch.equal(canonical.values(values)["f_w"], values["f_w"])
