"""The density in numpy and compiled code against the path through torch, for every option."""

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Trend
from pyro_dynogp.inference.density import Potential, joint_energy
from pyro_dynogp.inference.linear_density import LinearEnergy, linear_density
from tests.conftest import simulate_record

ONE = simulate_record(dgp.Modes([-0.6 + 2.0j], [[0.8 + 0.3j]], [1.0], [[0.15]]), 1e-2, n=40)
TWO = simulate_record(
    dgp.Modes([-0.6 + 2.0j], [[0.8 + 0.3j]], [[1.0], [0.4 - 0.2j]], [[0.15]]), 1e-2, n=30
)
GAPS = ONE.with_outputs(np.where(np.arange(40)[:, None] % 7 == 3, np.nan, ONE.outputs))
UNEVEN = dgp.Record(ONE.time + 0.2 * ONE.time**2, ONE.inputs, ONE.outputs)
BOTH = dgp.Record(ONE.time, np.concatenate([ONE.inputs, ONE.inputs[::-1] ** 2], 1), ONE.outputs)
NONE = dgp.Record(ONE.time, None, ONE.outputs)
HALF = TWO.with_outputs(np.where(np.arange(60).reshape(30, 2) % 5 == 3, np.nan, TWO.outputs))
LATE = dgp.Delayed("u", median=0.4)  # four steps
Linear = dgp.LinearDynamicGP
CASES = {
    "one pair": (Linear(1, pairs=1), ONE),
    "three pairs": (Linear(1, pairs=3), ONE),
    "paper": (Linear(1, pairs=2, priors="paper"), ONE),
    "missing samples": (Linear(1, pairs=2), GAPS),
    "uneven steps": (Linear(1, pairs=2), UNEVEN),
    "no process noise": (Linear(1, pairs=2, process_noise=False), ONE),
    "independent noise": (Linear(1, pairs=2, noise="independent"), ONE),
    "two Brownian motions": (Linear(1, pairs=2, brownian=2), ONE),
    "no feedthrough": (Linear(1, pairs=2, feedthrough=False), ONE),
    "integrator": (Linear(1, pairs=2, integrators=1), ONE),
    "quiet integrator": (Linear(1, pairs=1, integrators=1, process_noise=False), ONE),
    "two inputs": (Linear(2, pairs=2), BOTH),
    "no inputs": (Linear(0, pairs=2), NONE),
    "integrator without inputs": (Linear(0, pairs=1, integrators=1), NONE),
    "two outputs": (Linear(1, outputs=2, pairs=2), TWO),
    "two outputs with gaps": (Linear(1, outputs=2, pairs=3, brownian=1), HALF),
    "two outputs, integrators": (Linear(1, outputs=2, pairs=2, integrators=1), HALF),
    "two outputs, independent": (Linear(1, outputs=2, pairs=2, noise="independent"), TWO),
    "direct": (Linear(2, pairs=1, direct=1, channels=(Trend(0.0, 4.0),)), ONE),
    "direct alone": (Linear(1, pairs=1, direct=1), ONE),
    "two records": (Linear(1, pairs=1), (ONE, GAPS[:25])),
    "late": (Linear(1, pairs=2, channels=(LATE,)), GAPS),
    "late, integrator": (Linear(1, pairs=2, integrators=1, channels=(LATE,)), ONE),
    "one of two late": (Linear(2, pairs=2, channels=(dgp.Delayed("u2"),)), BOTH),
    "two late": (Linear(2, pairs=1, channels=(dgp.Delayed("u2"), dgp.Delayed("u1"))), BOTH),
    "late at once": (Linear(2, pairs=1, direct=1, channels=(dgp.Delayed("u2"),)), BOTH),
    "late and direct": (Linear(2, pairs=1, direct=1, channels=(LATE, Trend(0.0, 4.0))), ONE),
    "late, two outputs": (Linear(1, outputs=2, pairs=2, channels=(LATE,)), HALF),
    "late, two records": (Linear(1, pairs=1, channels=(LATE,)), (ONE, GAPS[:25])),
}
# What the torch path keeps to itself.
OTHERS = {
    "first state": (Linear(1, pairs=2, initial_state="site"), ONE),
    "at rest": (Linear(1, pairs=2, initial_state="zero"), ONE),
    "Student-t": (Linear(1, pairs=2, likelihood=dgp.StudentT()), ONE),
    "varying noise": (Linear(1, pairs=2, likelihood=dgp.Heteroscedastic()), ONE),
    "late on uneven steps": (Linear(1, pairs=2, channels=(LATE,)), UNEVEN),
    "Wiener": (dgp.Wiener(1, pairs=2, inducing=5), ONE),
}


def drawn(name, count=5):
    """Potential, and unconstrained vectors around the middle of the prior."""
    model, records = {**CASES, **OTHERS}[name]
    target = model.scaled_to(records).collapsed
    with torch.random.fork_rng(), torch.no_grad(), pyro.poutine.block():
        torch.manual_seed(1)
        sites = target.all_sites(target.scaling, 2 if isinstance(records, tuple) else 1)
        values = {site.name: site.typical() for site in sites}
    potential = Potential(target, (records,), values)
    z = np.random.default_rng(3).normal(0.0, 0.5, (count, potential.size))
    return potential, torch.tensor(z)


def by_torch(potential, z, jacobian):
    x = z.clone().requires_grad_()
    with pyro.validation_enabled(False):
        energy = joint_energy(potential.log_density, potential.sites, x, jacobian=jacobian)
        (gradient,) = torch.autograd.grad(energy.sum(), x)
    return energy.detach().numpy(), gradient.numpy()


@pytest.mark.parametrize("jacobian", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_values_and_gradients_are_those_of_torch(name, jacobian):
    potential, z = drawn(name)
    lean = linear_density(potential.log_density)
    energy, gradient = by_torch(potential, z, jacobian)
    value, slope = lean.with_gradients(z.numpy(), jacobian=jacobian)
    np.testing.assert_allclose(value, energy, rtol=1e-10)
    largest = np.abs(gradient).max(1, keepdims=True)
    np.testing.assert_allclose(slope / largest, gradient / largest, atol=1e-8)
    np.testing.assert_array_equal(lean.energies(z.numpy(), jacobian=jacobian), value)


@pytest.mark.parametrize("name", CASES)
def test_innovations_are_those_of_torch(name):
    potential, z = drawn(name)
    lean = linear_density(potential.log_density)
    error, variance = lean.innovations(z.numpy())
    with torch.no_grad(), pyro.validation_enabled(False):
        outputs = potential.log_density.outputs(potential.unpack(z))
        ys = potential.log_density.observations
        found = [[x[:, ~y.isnan()].numpy() for x in o.innovations(y)[:2]] for o, y in
                 zip(outputs, ys, strict=True)]  # fmt: skip
    for ours, theirs in zip((error, variance), zip(*found, strict=True), strict=True):
        theirs = np.concatenate(theirs, 1)
        scale = np.abs(theirs).max(1, keepdims=True)
        np.testing.assert_allclose(ours / scale, theirs / scale, atol=1e-10)


@pytest.mark.parametrize("name", OTHERS)
def test_other_models_go_through_torch(name):
    assert linear_density(drawn(name)[0].log_density) is None


@pytest.mark.parametrize(
    "name", ["three pairs", "two outputs, integrators", "missing samples", "two late"]
)
def test_a_point_has_the_same_bits_in_any_batch(name):
    potential, _ = drawn(name)
    lean = linear_density(potential.log_density)
    z = np.random.default_rng(4).normal(0.0, 0.5, (37, potential.size))
    z[5], z[21] = 300.0, np.nan  # no density there
    value, slope = lean.with_gradients(z, jacobian=True)
    assert np.isinf(value[[5, 21]]).all()
    assert not slope[[5, 21]].any()
    assert np.isfinite(np.delete(value, [5, 21])).all()
    for count in (1, 3, 8, 20):
        for first in range(0, 37, count):
            part = slice(first, first + count)
            again, turned = lean.with_gradients(z[part], jacobian=True)
            np.testing.assert_array_equal(again, value[part])
            np.testing.assert_array_equal(turned, slope[part])
            np.testing.assert_array_equal(lean.energies(z[part], jacobian=True), value[part])


def test_the_prior_alone():
    potential, z = drawn("three pairs")
    lean = linear_density(potential.log_density)
    x = z.clone().requires_grad_()
    energy = -potential.log_density.prior.log_prob(potential.unpack(x))
    (gradient,) = torch.autograd.grad(energy.sum(), x)
    value, slope = lean.priors.energies(z.numpy(), jacobian=False)
    np.testing.assert_allclose(value, energy.detach().numpy(), rtol=1e-12)
    np.testing.assert_allclose(slope, gradient.numpy(), rtol=1e-9, atol=1e-12)


def test_as_a_node_of_a_graph():
    """Gradients of a composition are those of its chain rule."""
    potential, z = drawn("two inputs")
    lean = linear_density(potential.log_density)
    x = (0.5 * z).requires_grad_()
    energy = LinearEnergy.apply(2.0 * x, lean, True)
    weights = torch.arange(1.0, 6.0, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weights * energy).sum(), x)
    _, slope = lean.with_gradients(z.numpy(), jacobian=True)
    np.testing.assert_allclose(gradient.numpy(), 2.0 * weights[:, None].numpy() * slope)
    with torch.no_grad():
        assert torch.equal(LinearEnergy.apply(z, lean, True), energy.detach())
