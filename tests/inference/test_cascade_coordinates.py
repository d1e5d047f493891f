"""Coordinates for chains: a bijection, its Jacobian, and the ridge that they make straight."""

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.cascade_coordinate_steps import RelativeToGain
from pyro_dynogp.inference.cascade_coordinates import (
    StraightPotential,
    by_name,
    potential_for_sampling,
)
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.laplace import laplace
from pyro_dynogp.inference.starts.plans import Plan, starting_point
from tests.benchmarks import reference
from tests.conftest import simulate_record

RECORD = simulate_record(dgp.Modes([-0.6 + 2.0j], [[0.8 + 0.3j]], [1.0], [[0.15]]), 1e-2, n=40)
MODELS = {
    "Wiener": dgp.Wiener(inputs=1, pairs=1, inducing=6),
    "two pairs": dgp.Wiener(inputs=1, pairs=2, inducing=5),
    "no process noise": dgp.Cascade(
        1, (dgp.Dynamic(pairs=1, process_noise=False), dgp.Static(inducing=5))
    ),
    "Wiener-Hammerstein": dgp.WienerHammerstein(inputs=1, pairs=1, inducing=5),
    "Hammerstein": dgp.Hammerstein(inputs=1, pairs=1, inducing=5),
    "two signals": dgp.Cascade(1, (dgp.Dynamic(outputs=2, pairs=1), dgp.Static(inducing=6))),
}  # fmt: skip


def potentials(name, seed=0):
    """The plain potential, the straight one, and an unconstrained vector near a start."""
    model = MODELS[name].scaled_to(RECORD)
    values = starting_point(model, model.prepare(RECORD), Plan(None, None, False, 0))
    target = model.collapsed
    plain = Potential(target, (RECORD,), values)
    generator = torch.Generator().manual_seed(seed)
    z = plain.pack(values)
    z = z + 0.2 * torch.randn(z.shape, generator=generator, dtype=torch.float64)
    return plain, potential_for_sampling(target, (RECORD,), plain.unpack(z)), z


@pytest.mark.parametrize("name", MODELS)
def test_coordinates_are_a_bijection(name):
    plain, straight, z = potentials(name)
    assert isinstance(straight, StraightPotential)
    values = plain.unpack(z)
    x = straight.pack(values)
    assert x.shape == z.shape
    back = straight.unpack(x)
    for site, value in values.items():
        np.testing.assert_allclose(back[site], value, rtol=1e-9, atol=1e-9)
    assert not torch.allclose(x, z)


@pytest.mark.parametrize("name", MODELS)
def test_density_of_coordinates_has_their_jacobian(name):
    plain, straight, z = potentials(name, seed=1)
    x = straight.pack(plain.unpack(z))
    J = torch.autograd.functional.jacobian(lambda x: straight._unconstrained(x)[0], x)
    log_det = torch.linalg.slogdet(J).logabsdet
    with torch.no_grad():
        expected = plain.energy(z, jacobian=True) - log_det
        assert float(straight.energy(x, jacobian=True)) == pytest.approx(float(expected), rel=1e-9)
        expected = plain.energy(z, jacobian=False)
        assert float(straight.energy(x, jacobian=False)) == pytest.approx(float(expected), rel=1e-9)


@pytest.mark.parametrize("name", MODELS)
def test_gradient_by_finite_differences(name):
    plain, straight, z = potentials(name, seed=2)
    x = straight.pack(plain.unpack(z)).numpy()
    gradient = straight.value_and_gradient(x, jacobian=True)[1]
    for i in range(len(x)):
        h = 1e-5 * np.eye(len(x))[i]
        # Central differences of energies of some 1e2: rounding leaves 1e-9, third derivatives more.
        ends = [straight.value_and_gradient(x + side * h, jacobian=True)[0] for side in (1, -1)]
        assert gradient[i] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-5, abs=1e-5)


def place_of_the_size(straight):
    """Index among the coordinates of the logarithm of the largest gain."""
    (step,) = [s for s in straight.steps if isinstance(s, RelativeToGain)]
    index = by_name(straight.sites, torch.arange(straight.size))
    return int(torch.cat([index[name].flatten() for name in step.gains])[step.place])


def log_likelihood(target, values):
    """Log-density of the observed sites."""
    trace = pyro.poutine.trace(pyro.poutine.condition(target, data=values)).get_trace(RECORD)
    trace.compute_log_prob()
    seen = [x for k, x in trace.nodes.items() if x["type"] == "sample" and k not in values]
    return float(sum(node["log_prob_sum"] for node in seen if node["is_observed"]))


@pytest.mark.parametrize("name", ["Wiener", "two pairs", "no process noise", "Wiener-Hammerstein"])
def test_likelihood_is_constant_along_the_size_of_a_signal(name):
    plain, straight, z = potentials(name, seed=3)
    x = straight.pack(plain.unpack(z))
    here, other, twice = x.clone(), x.clone(), x.clone()
    place = place_of_the_size(straight)
    twice[place] += np.log(2.0)
    other[0] += np.log(2.0)
    before = log_likelihood(plain.model, straight.unpack(here))
    assert log_likelihood(plain.model, straight.unpack(twice)) == pytest.approx(before, abs=1e-4)
    assert abs(log_likelihood(plain.model, straight.unpack(other)) - before) > 0.1
    sizes = [
        straight.unpack(x)["g_feedthrough" if "g_feedthrough" in plain.at else "g1_feedthrough"]
        for x in (here, twice)
    ]
    np.testing.assert_allclose(sizes[1], 2.0 * sizes[0], rtol=1e-12)  # rounding of exp and log


def test_other_models_keep_their_coordinates():
    model = dgp.LinearDynamicGP(inputs=1, pairs=1).scaled_to(RECORD)
    fit = dgp.fit(model, RECORD, method="map", restarts=1, workers=1, progress=False)
    found = potential_for_sampling(model, (RECORD,), fit.mode)
    assert type(found) is Potential


def test_curvature_is_nearly_that_at_the_mode():
    """A standard deviation from the mode no direction is much stiffer than Laplace has it."""
    data = reference.record()[:60]
    model = dgp.Wiener(inputs=1, pairs=1, inducing=6).scaled_to(data)
    fit = dgp.fit(model, data, method="map", restarts=1, workers=1, progress=False)
    stiffest = []
    for kind in (Potential, StraightPotential):
        potential = kind(model.collapsed, (data,), fit.mode)
        centre, root = laplace(potential, fit.mode)
        rng = np.random.default_rng(0)
        found = []
        for _ in range(2):
            x = centre + 0.7 * root @ rng.standard_normal(len(centre))
            found.append(np.linalg.eigvalsh(root.T @ potential.hessian(x) @ root)[-1])
        stiffest.append(max(found))
    assert stiffest[1] < 10.0
    assert stiffest[0] > 10.0 * stiffest[1]


def test_noise_gains_and_their_scale_are_straight_around_a_mode():
    """Draws of a normal there weigh alike; in plain coordinates next to none has any weight."""
    modes = dgp.Modes(
        [-0.5 + 2.0j, -0.2 + 0.7j], [[1.0 + 0.3j], [0.3 - 0.5j]], [1.0, 0.6 + 0.2j],
        [[0.2 + 0.1j], [0.1 + 0.05j]],
    )  # fmt: skip
    data = simulate_record(modes, 0.1, n=200, seed=1)
    model = dgp.LinearDynamicGP(inputs=1, pairs=2)
    fit = dgp.fit(model, data, restarts=2, workers=1, progress=False)
    spread = []
    for kind in (Potential, StraightPotential):
        potential = kind(fit.model.collapsed, (data,), fit.mode)
        centre, root = map(torch.as_tensor, laplace(potential, fit.mode))
        generator = torch.Generator().manual_seed(0)
        x = torch.randn(300, len(centre), generator=generator, dtype=torch.float64)
        with torch.no_grad():
            energy = potential.energy(centre + x @ root.mT, jacobian=True)
        log_ratio = 0.5 * x.square().sum(-1) - energy
        spread.append(float(log_ratio.quantile(0.9) - log_ratio.quantile(0.1)))
    assert 0.0 < spread[1] < 15.0
    assert spread[0] > 5.0 * spread[1]
    # A bijection, and its Jacobian.
    z = potential.pack(fit.mode) + 0.3
    back = potential.unpack(z)
    torch.testing.assert_close(potential.pack(back), z)
    J = torch.autograd.functional.jacobian(lambda x: potential._unconstrained(x)[0], z)
    log_det = potential._unconstrained(z)[1]
    torch.testing.assert_close(torch.linalg.slogdet(J).logabsdet, log_det)
    assert abs(float(log_det)) > 0.1
