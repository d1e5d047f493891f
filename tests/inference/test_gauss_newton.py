"""Gauss-Newton climbs: energies, gradients, Fisher matrices, and where they end."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Trend
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.optimise.gauss_newton import FEW, FLAT, RIDGE, climb, climb_together
from pyro_dynogp.inference.optimise.innovation_energy import Innovations, Local, has_innovations
from pyro_dynogp.inference.optimise.lengths import Lengths
from pyro_dynogp.inference.optimise.maximum import maximise, optimizer_for, optimizer_near
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.linear import linear_starts
from pyro_dynogp.inference.starts.plans import starting_points
from pyro_dynogp.inference.starts.poles import starting_values
from tests.inference.test_log_joint import GAPS, ONE, TWO, UNEVEN

Linear = dgp.LinearDynamicGP
ALONE = Run(workers=1)
STUDENT = dgp.StudentT(3.0)
LIMITED = dgp.Static(mean="linear", limits=(0.0, None))
CASES = {
    "linear": (Linear(1, pairs=3), ONE),
    "uneven steps": (Linear(1, pairs=2), UNEVEN),
    "missing samples": (Linear(1, pairs=2), GAPS),
    "two outputs, records": (Linear(1, outputs=2, pairs=2), (TWO, TWO[:20])),
    "first state a site": (Linear(1, pairs=2, initial_state="site"), (ONE, GAPS[:25])),
    "known trajectory": (
        Linear(1, pairs=2, initial_state="zero", process_noise=False), GAPS,
    ),
    "two known trajectories": (
        Linear(1, outputs=2, pairs=2, initial_state="zero", process_noise=False), TWO,
    ),
    "direct": (Linear(2, pairs=1, direct=1, channels=(Trend(0.0, 4.0),)), ONE),
    "no inputs": (Linear(0, pairs=2), ONE.select(inputs=[])),
    "varying noise": (dgp.Cascade(1, (dgp.Dynamic(pairs=2),), dgp.Heteroscedastic(4)), GAPS),
    "varying noise, two outputs": (
        dgp.Cascade(1, (dgp.Dynamic(2, pairs=2),), dgp.Heteroscedastic(4)), TWO,
    ),
    "Hammerstein": (dgp.Hammerstein(1, pairs=2), GAPS),
    "Wiener": (dgp.Wiener(1, pairs=2), GAPS),
    "Wiener without process noise": (
        dgp.Cascade(1, (dgp.Dynamic(pairs=2, process_noise=False), dgp.Static())), (ONE, GAPS),
    ),
    "Wiener, two outputs": (dgp.Wiener(1, outputs=2, pairs=2), TWO),
    "Wiener-Hammerstein": (dgp.WienerHammerstein(1, pairs=1), ONE),
    "feedback": (dgp.NonlinearFeedback(1, pairs=1), GAPS),
    "Student-t": (Linear(1, outputs=2, pairs=2, likelihood=STUDENT), TWO),
    "Student-t, Wiener": (dgp.Wiener(1, pairs=2, likelihood=STUDENT), GAPS),
    "Student-t, feedback": (
        dgp.NonlinearFeedback(1, hidden=1, likelihood=STUDENT), (ONE, GAPS),
    ),
}  # fmt: skip


def prepared(name):
    """Innovations of a case, and a point near its start."""
    model, records = CASES[name]
    target = model.scaled_to(records).collapsed
    ready = target.prepare(records)
    if target.is_linear:
        (start,) = starting_values(target, ready, count=1, seed=0)
    else:
        (start,) = starting_points(target, ready, ALONE, count=1, steps=5)
    potential = Potential(target, (ready,), start)
    z = potential.pack(start).numpy()
    return Innovations(potential), z + 0.1 * np.random.default_rng(0).standard_normal(len(z))


@pytest.mark.parametrize("name", CASES)
def test_energy_and_gradient_are_those_of_the_density(name):
    innovations, z = prepared(name)
    energy, gradient = innovations.potential.value_and_gradient(z)
    more, further = Lengths(innovations.potential.sites).energies(z[None])
    energy, gradient = energy + more[0], gradient + further[0]
    here = innovations.local(z)
    assert here.energy == pytest.approx(energy, rel=1e-11)
    assert innovations.energies(z[None])[0] == pytest.approx(energy, rel=1e-11)
    size = np.abs(gradient).max()
    np.testing.assert_allclose(here.gradient, gradient, rtol=1e-4, atol=1e-4 * size)


@pytest.mark.parametrize("name", CASES)
def test_energy_and_gradient_of_the_vectors_density(name):
    plain, z = prepared(name)
    potential = plain.potential
    here = Innovations(potential, jacobian=True).local(z)
    energy, gradient = potential.value_and_gradient(z, jacobian=True)
    assert here.energy == pytest.approx(energy, rel=1e-11)
    size = np.abs(gradient).max()
    np.testing.assert_allclose(here.gradient, gradient, rtol=1e-4, atol=1e-4 * size)


@pytest.mark.parametrize("name", CASES)
def test_energy_and_gradient_with_the_slopes_of_another_point(name):
    """The same where the point is that one."""
    innovations, z = prepared(name)
    here = innovations.local(z)
    energy, gradient = innovations.beside(here, z)
    size = np.abs(here.gradient).max()
    # One point and several of them are added up in another order.
    assert energy == pytest.approx(here.energy, rel=1e-12)
    np.testing.assert_allclose(gradient, here.gradient, rtol=1e-9, atol=1e-9 * size)


def test_slopes_of_another_point_are_exact_where_predictions_are_linear():
    """In gains and levels, the noise being the same."""
    plain, z = prepared("known trajectory")
    free = plain.potential.places(("g_input_gain", "offset"))
    innovations = Innovations(plain.potential, free)
    here = innovations.local(z)
    other = z.copy()
    other[free] += 0.3 * np.random.default_rng(1).standard_normal(len(free))
    energy, gradient = innovations.beside(here, other)
    exact = innovations.local(other)
    assert energy == pytest.approx(exact.energy, rel=1e-12)  # as above
    np.testing.assert_allclose(gradient, exact.gradient, rtol=1e-5)  # differences over 1e-6
    assert np.abs(exact.gradient - here.gradient).max() > 1.0


def test_energy_and_gradient_with_fixed_sites():
    """Their priors count, and nothing moves along them."""
    whole, z = prepared("Wiener")
    values = {k: v.detach() for k, v in whole.potential.unpack(torch.tensor(z)).items()}
    free = {name: values.pop(name) for name in ("f_values", "noise_sd")}
    model, args = whole.density.model, whole.potential.args
    innovations = Innovations(Potential(model, args, free, values))
    x = innovations.potential.pack(free).numpy()
    here, there = innovations.local(x), whole.local(z)
    places = whole.potential.places(tuple(free))
    assert len(x) == len(places)
    assert here.energy == pytest.approx(there.energy, rel=1e-11)
    size = np.abs(there.gradient).max()
    np.testing.assert_allclose(here.gradient, there.gradient[places], atol=1e-6 * size)
    expected = there.fisher[np.ix_(places, places)]
    np.testing.assert_allclose(here.fisher, expected, atol=1e-6 * np.abs(expected).max())


def test_curvature_of_the_prior():
    innovations, z = prepared("linear")
    x = torch.tensor(z)[None]
    prior, unpack = innovations.density.prior, innovations.potential.unpack
    exact = torch.autograd.functional.hessian(lambda x: -prior.log_prob(unpack(x)).sum(), x)
    here = innovations.local(z)
    np.testing.assert_allclose(here.prior, exact[0, :, 0].numpy(), rtol=1e-5, atol=1e-4)


KNOWN = {"initial_state": "zero", "process_noise": False}


@pytest.mark.parametrize("options", [{}, {**KNOWN, "likelihood": STUDENT}], ids=["normal", "t"])
def test_fisher_matrix_is_the_covariance_of_scores(options):
    """Over outputs drawn from the model the score has the Fisher matrix as its covariance."""
    model = Linear(1, pairs=1, **options).scaled_to(ONE).collapsed
    (start,) = starting_values(model, model.prepare(ONE), count=1, seed=0)
    potential = Potential(model, (ONE,), {**start, "noise_sd": torch.tensor([0.2]).double()})
    innovations, z = Innovations(potential), potential.pack(potential.at).numpy()
    prior = innovations._prior(z[None])[1][0]
    (outputs,) = innovations.density.outputs(potential.at)
    count = 500
    with torch.random.fork_rng():
        torch.manual_seed(0)
        drawn = outputs.sample((count,))
    scores, fisher = [], np.zeros((len(z), len(z)))
    for y in drawn:
        again = Potential(model, (ONE.with_outputs(y.numpy()),), potential.at)
        here = Innovations(again).local(z)
        scores.append(here.gradient - prior)
        fisher += here.fisher / count
    root = np.linalg.inv(np.linalg.cholesky(fisher))
    white = np.array(scores) @ root.T
    assert np.abs(white.mean(0)).max() < 4.0 / np.sqrt(count)
    np.testing.assert_allclose(white.T @ white / count, np.eye(len(z)), atol=5.5 / np.sqrt(count))


def test_bends_are_second_derivatives():
    innovations, z = prepared("linear")
    here = innovations.local(z)
    move = 0.02 * np.random.default_rng(1).standard_normal((1, len(z)))

    def level(t):
        e, d, _ = (part[0] for part in innovations._innovations(z + t * move))
        return np.stack([e / here.sd, np.sqrt(0.5) * np.log(d)])

    h = 1e-2
    second = (level(h) - 2.0 * level(0.0) + level(-h)) / h**2
    expected = sum(J @ s for J, s in zip(here.slopes, second, strict=True))
    found = innovations.bends(here, z, move)[0]
    np.testing.assert_allclose(found, expected, atol=0.05 * np.abs(expected).max())


def test_a_point_without_density_leaves_the_others_alone():
    innovations, z = prepared("linear")
    points = np.stack([z, np.full_like(z, 800.0), z + 0.01])
    energies = innovations.energies(points)
    assert np.isinf(energies[1])
    assert energies[2] == pytest.approx(innovations.energies(points[2:])[0], rel=1e-12)
    assert innovations.local(points[1]) is None
    assert climb(innovations, points[1], 5)[1:] == ([], "no derivative")


def test_portions_are_the_whole():
    innovations, z = prepared("two outputs, records")
    points = z + 1e-3 * np.arange(7)[:, None]
    whole = innovations.energies(points)
    innovations.width = 3
    np.testing.assert_allclose(innovations.energies(points), whole, rtol=1e-13)


def test_a_climb_ends_where_no_gradient_is_left(record):
    model = Linear(1, pairs=1).scaled_to(record).collapsed
    (start,) = starting_values(model, model.prepare(record), count=1, seed=0)
    potential = Potential(model, (record,), start)
    z, history, message = climb(Innovations(potential), potential.pack(start).numpy(), 60)
    assert message == "nothing left to gain"
    assert (np.diff(history) <= 0.0).all()
    energy, gradient = potential.value_and_gradient(z)
    assert history[-1] == pytest.approx(energy, rel=1e-10)
    # By the exact Hessian there is less than twice the tolerance left.
    left = 0.5 * gradient @ np.linalg.solve(potential.hessian(z), gradient)
    assert abs(left) < 2.0 * FLAT


@pytest.mark.parametrize(("functions", "steps"), [(True, FEW + 1), (False, 20)])
def test_a_climb_with_functions_ends_on_a_ridge(monkeypatch, functions, steps):
    """Where `FEW` iterations gain less than `RIDGE`, though there is more to gain further on."""
    innovations, z = prepared("two outputs, records")
    gains = 0.9 * RIDGE / FEW
    local = Local(
        0.0, -np.ones(len(z)), np.eye(len(z)), np.zeros((len(z),) * 2), np.zeros((2, 3)),
        np.ones(3), np.zeros((2, len(z), 3)), np.zeros(len(z)),
    )  # fmt: skip
    level = [0.0]

    def energies(points):
        level[0] -= gains
        return np.full(len(points), level[0])

    monkeypatch.setattr(innovations, "has_functions", functions)
    monkeypatch.setattr(innovations, "local", lambda z: replace(local, energy=level[0]))
    monkeypatch.setattr(innovations, "bends", lambda here, z, moves: np.zeros_like(moves))
    monkeypatch.setattr(innovations, "energies", energies)
    _, history, message = climb(innovations, z, 20)
    assert len(history) == steps
    assert message == ("nothing left to gain" if functions else "all steps used")


@pytest.mark.parametrize("name", ["feedback", "Wiener", "known trajectory"])
def test_starts_that_climb_together_go_where_each_goes_alone(name):
    innovations, z = prepared(name)
    starts = [z, z + 0.1, z - 0.05]
    for start, (end, history, message) in zip(
        starts, climb_together(innovations, starts, 4), strict=True
    ):
        alone, steps, said = climb(innovations, start, 4)
        np.testing.assert_allclose(history, steps, rtol=1e-6, atol=1e-6)
        # Slopes are differences over 1e-6 of numbers that round to 1e-13: steps differ by 1e-4
        # along what hardly curves, energies do not.
        np.testing.assert_allclose(end, alone, rtol=1e-3, atol=1e-3)
        assert message == said


def test_points_of_starts_that_climb_together_are_evaluated_together(monkeypatch):
    """Twice as many starts, as many calls."""
    innovations, z = prepared("feedback")
    through, calls = innovations._portion, []
    monkeypatch.setattr(innovations, "_portion", lambda x: calls.append(len(x)) or through(x))
    climb_together(innovations, [z, z], 3)
    both, calls[:] = list(calls), []
    climb_together(innovations, [z, z, z, z], 3)
    assert calls == [2 * count for count in both]


def test_default_starts_end_at_least_as_high_as_random_ones_by_lbfgs(record):
    """With a pair to spare the density has several modes, which random starts miss."""
    model = Linear(1, pairs=2).scaled_to(record).collapsed
    ready = model.prepare(record)
    starts = linear_starts(model, ready, None, 0)
    new = maximise(model, ready, starts, ALONE, optimizer="gauss-newton", steps=60)
    random = starting_values(model, ready, count=6, seed=0)
    old = maximise(model, ready, random, ALONE, optimizer="lbfgs", steps=500)
    assert new[0].energy < old[0].energy + 0.1
    assert len(new[0].history) < len(old[0].history)


def test_which_models_have_innovations():
    assert has_innovations(Linear(1))
    assert has_innovations(CASES["varying noise"][0])
    assert has_innovations(dgp.Wiener(1))
    assert has_innovations(dgp.Wiener(1, likelihood=STUDENT))
    assert not has_innovations(dgp.Cascade(1, (dgp.Dynamic(), LIMITED)))
    assert not has_innovations(lambda: None)


def test_which_optimizer_climbs():
    two = dgp.Cascade(1, (dgp.Dynamic(), dgp.Dynamic()))
    models = Linear(1), dgp.Hammerstein(1), dgp.NonlinearFeedback(1), two
    assert {optimizer_for(m) for m in models} == {"gauss-newton"}
    assert optimizer_for(dgp.Wiener(1, process_noise=False)) == "gauss-newton"
    noisy = dgp.Wiener(1), dgp.Wiener(1, likelihood=dgp.StudentT()), dgp.WienerHammerstein(1)
    assert {optimizer_for(m) for m in noisy} == {"adam"}  # functions that see process noise
    assert {optimizer_near(m) for m in (*models, dgp.Wiener(1))} == {"gauss-newton"}
    for make in (Linear, dgp.NonlinearFeedback, dgp.Hammerstein):
        assert optimizer_for(make(1, likelihood=STUDENT)) == "gauss-newton"
    assert optimizer_near(dgp.Wiener(1, likelihood=STUDENT)) == "gauss-newton"
    limited = dgp.Cascade(1, (dgp.Dynamic(process_noise=False), LIMITED))
    assert (optimizer_for(limited), optimizer_near(limited)) == ("lbfgs", "preconditioned")


def test_climbs_under_heavy_tails_end_where_others_do(record):
    """One of twenty outputs is far off."""
    y = record.outputs.copy()
    y[::20] += 3.0 * y.std()
    spoiled = record.with_outputs(y)[:150]
    model = Linear(1, pairs=1, likelihood=STUDENT).scaled_to(spoiled).collapsed
    ready = model.prepare(spoiled)
    starts = linear_starts(model, ready, None, 0)
    new, old = (
        maximise(model, ready, starts, ALONE, optimizer=optimizer, steps=steps)[0]
        for optimizer, steps in (("gauss-newton", 60), ("lbfgs", 500))
    )
    assert new.energy < old.energy + 0.1
    assert len(new.history) < len(old.history)


def test_is_refused_where_there_are_none(record):
    with pytest.raises(ValueError, match=r"optimizer: expected .* got 'gauss-newton'"):
        dgp.fit(
            dgp.Cascade(1, (dgp.Dynamic(), LIMITED)), record, method="map",
            optimizer="gauss-newton", progress=False,
        )  # fmt: skip


def test_starts_of_one_seed_give_the_same_bits_by_any_number_of_processes(record):
    model = replace(Linear(1, pairs=1).scaled_to(record[:80]), integrate="all")
    starts = starting_values(model, model.prepare(record[:80]), count=3, seed=0)
    one, two = (
        maximise(
            model, record[:80], starts, Run(workers=workers), optimizer="gauss-newton", steps=10
        )
        for workers in (1, 2)
    )
    for a, b in zip(one, two, strict=True):
        assert a.energy == b.energy
        assert all(torch.equal(a.values[name], b.values[name]) for name in a.values)
