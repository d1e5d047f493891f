"""Parameters that stay at their optimum in bands of free runs, against block formulas."""

import dataclasses

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.examples.feedback import simulate_duffing
from pyro_dynogp.inference import held_parameters
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.free_runs import noise_sites
from pyro_dynogp.inference.function_evidence import kernel_sites
from pyro_dynogp.inference.laplace import fisher_root
from pyro_dynogp.models.draws import first_state
from pyro_dynogp.prediction import free_run_variance, predict
from pyro_dynogp.prediction.first_state import unknown_beginning
from pyro_dynogp.prediction.records import prepared
from tests.models.closed_loops import make_record

PLANT = simulate_duffing(4, samples=300, training_samples=200, noise_ratio=0.05)
QUICK = {"restarts": 1, "steps": 15, "workers": 1, "progress": False}


@pytest.fixture(scope="module")
def spring():
    return dgp.fit(dgp.NonlinearFeedback(1, inducing=8), PLANT.train, method="svi", **QUICK)


@pytest.fixture(scope="module")
def forms():
    return dgp.fit(dgp.NonlinearFeedback(1, parametric=True), PLANT.train, method="svi", **QUICK)


def runs_of(fit, values):
    """Runs along the test record from rest, without noise, at values of the sites."""
    other = fit.with_draws(values)
    along = prepared(fit, PLANT.test)
    return free_run_variance.mean_runs(other, along, first_state(unknown_beginning(other)))


def test_which_sites_are_held(spring, forms):
    poles = {"g_log_decay", "g_log_frequency", "g_input_gain", "offset"}
    for fit in (spring, forms):
        assert poles <= set(fit.held)
        never = {*kernel_sites(fit.model), *noise_sites(fit.model), "noise_sd"}
        assert never <= set(fit.mode)
        assert never.isdisjoint(fit.held)
        assert {site.name for site in fit.posterior.sites}.isdisjoint(fit.held)
        constant = {k for k, x in fit.draws.items() if torch.equal(x, x[:1].expand_as(x))}
        assert constant - never == set(fit.held)
        assert fit.at_mode().held == ()
        assert fit.moved.held == ()  # other draws have what is uncertain of them
        assert dataclasses.replace(fit, records=()).held == ()


@pytest.mark.parametrize(
    ("model", "method"),
    [
        (dgp.NonlinearFeedback(1, parametric=True), dgp.Normal(family="normal")),  # all are drawn
        (dgp.Wiener(1, pairs=1, inducing=6), "svi"),  # no feedback
        (dgp.NonlinearFeedback(1, inducing=6), "map"),
    ],
)
def test_others_hold_none(model, method):
    record = make_record(n=60, missing=False)
    fit = dgp.fit(model, record, method=method, restarts=1, steps=3, workers=1, progress=False)
    assert fit.held == ()
    found = fit.simulate(record, seed=0)
    assert np.isfinite(found.variance).all()


@pytest.mark.parametrize("which", ["spring", "forms"])
def test_the_variance_is_that_of_the_block_formula(which, request):
    """J S J', with J = J_h - J_f H_ff^-1 H_fh and S = (H_hh - H_hf H_ff^-1 H_fh)^-1."""
    fit = request.getfixturevalue(which)
    model = fit.model.collapsed
    kept = {k: fit.mode[k] for k in (*kernel_sites(model), *noise_sites(model), "noise_sd")}
    free = {k: x for k, x in fit.mode.items() if k not in kept}
    potential = Potential(model, (model.prepare(fit.records),), free, kept)
    root = fisher_root(potential, free)
    H = np.linalg.inv(root @ root.T)
    z = potential.pack(free).numpy()
    step = 1e-5
    points = np.concatenate([z + step * np.eye(len(z)), z - step * np.eye(len(z))])
    values = potential.unpack(torch.from_numpy(points))
    values |= {k: x.expand(len(points), *x.shape) for k, x in kept.items()}
    runs = runs_of(fit, values)[..., 0]
    J = (runs[: len(z)] - runs[len(z) :]).T / (2.0 * step)
    h = potential.places(fit.held)
    f = np.setdiff1d(np.arange(len(z)), h)
    follow = np.linalg.solve(H[np.ix_(f, f)], H[np.ix_(f, h)])
    S = np.linalg.inv(H[np.ix_(h, h)] - H[np.ix_(h, f)] @ follow)
    effective = J[:, h] - J[:, f] @ follow
    expected = np.einsum("np,pq,nq->n", effective, S, effective)
    moved = runs_of(fit, fit.moved.draws)
    found = held_parameters.slopes_of(moved)
    assert found.shape == (len(h), len(PLANT.test), 1)
    np.testing.assert_allclose((found**2).sum(0)[:, 0], expected, rtol=1e-3)


@pytest.mark.parametrize("which", ["spring", "forms"])
def test_bands_are_wider_and_means_the_same(which, request, monkeypatch):
    fit = request.getfixturevalue(which)

    def both():
        return fit.forecast(PLANT.train, PLANT.test, seed=0), fit.simulate(PLANT.test, seed=0)

    wide = both()
    monkeypatch.setattr(type(fit), "held", ())
    narrow = both()
    for more, less in zip(wide, narrow, strict=True):
        np.testing.assert_array_equal(more.mean, less.mean)
        extra = more.variance - less.variance
        assert extra.min() > 0.0
        ratio = (more.parts["parameters"] - less.parts["parameters"]) / extra
        np.testing.assert_allclose(ratio, 1.0, rtol=1e-6)
        np.testing.assert_allclose(sum(more.parts.values()), more.variance, rtol=1e-8)
        shift = more.samples - less.samples
        np.testing.assert_allclose(shift.var(0)[20:], extra[20:], rtol=0.5)  # 200 samples
        joint = np.corrcoef(shift[:, 50:, 0].T)
        assert np.diag(joint, 1).mean() > 0.9  # they move together


def test_runs_at_the_mode_are_those_of_the_mode(forms):
    """Of functions without a Gaussian process, one run from a known state without noise."""
    mode = forms.at_mode()
    expected = mode.forecast(PLANT.train, PLANT.test, process_noise=False).mean
    same = {name: x.expand(3, *x.shape) for name, x in forms.mode.items()}
    other = forms.with_draws(same)
    earlier, later, gap = predict.following(other, PLANT.train, PLANT.test)
    _, start = predict._after(other, earlier, later, gap, process_noise=False)
    found = free_run_variance.mean_runs(other, later, start)
    assert found.shape == (3, len(PLANT.test), 1)
    spread = float(PLANT.test.outputs.std())
    for run in found:
        assert np.sqrt(np.mean((run - expected) ** 2)) < 0.02 * spread


@pytest.mark.parametrize("where", ["matrix", "runs"])
def test_where_predictions_next_to_the_optimum_are_not_finite_this_is_said(
    forms, monkeypatch, where
):
    fit = dataclasses.replace(forms)  # nothing computed
    if where == "matrix":
        monkeypatch.setattr(held_parameters, "fisher_root", lambda *_: None)
    else:
        monkeypatch.setattr(free_run_variance, "slopes_of", lambda runs: np.inf * runs)
    with pytest.warns(UserWarning, match="Next to the optimum predictions are not finite"):
        found = fit.forecast(PLANT.train, PLANT.test, seed=0)
    monkeypatch.setattr(type(fit), "held", ())
    expected = fit.forecast(PLANT.train, PLANT.test, seed=0)
    np.testing.assert_array_equal(found.variance, expected.variance)


def test_several_outputs_at_irregular_times_with_missing_ones():
    record = make_record(outputs=2, n=200, irregular=True)
    model = dgp.NonlinearFeedback(1, outputs=2, inducing=6, process_noise=False)
    fit = dgp.fit(model, record[:160], method="svi", **QUICK)
    assert fit.held
    for found in (fit.forecast(record[:160], record[160:], seed=0), fit.simulate(record, seed=0)):
        assert np.isfinite(found.variance).all()
        assert found.samples.shape[1:] == found.mean.shape
        assert (found.parts["parameters"] > 0.0).all()


def test_directions_do_not_depend_on_the_order_of_sites(forms):
    model = forms.model.collapsed
    turned = {name: forms.mode[name] for name in reversed(list(forms.mode))}
    values = held_parameters.moved_along(model, forms.records, turned, forms.held[::-1])
    assert forms.moved is forms.moved  # computed once
    for name, x in forms.moved.draws.items():
        torch.testing.assert_close(values[name], x, rtol=1e-9, atol=1e-12)


def test_a_file_gives_the_same_bands(forms, tmp_path):
    forms.save(tmp_path / "fit.safetensors")
    again = dgp.load(tmp_path / "fit.safetensors")
    assert again.held == forms.held
    one, other = (f.forecast(PLANT.train, PLANT.test, seed=0) for f in (forms, again))
    np.testing.assert_array_equal(other.variance, one.variance)
