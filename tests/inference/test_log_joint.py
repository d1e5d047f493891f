"""The density without a trace is that of the trace, for every kind of model."""

from dataclasses import replace

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Trend
from pyro_dynogp.inference.density import Potential, joint_energy
from pyro_dynogp.inference.log_joint import Direct, Traced, density_of
from tests.conftest import simulate_record

Linear = dgp.LinearDynamicGP
ONE = simulate_record(dgp.Modes([-0.6 + 2.0j], [[0.8 + 0.3j]], [1.0], [[0.15]]), 1e-2, n=40)
TWO = simulate_record(
    dgp.Modes([-0.6 + 2.0j], [[0.8 + 0.3j]], [[1.0], [0.4 - 0.2j]], [[0.15]]), 1e-2, n=30
)
GAPS = ONE.with_outputs(np.where(np.arange(40)[:, None] % 7 == 3, np.nan, ONE.outputs))
LIMITED = ONE.with_outputs(np.clip(ONE.outputs, -0.3, 0.4))
WIDE = dgp.Record(ONE.time, np.column_stack([ONE.inputs, np.sin(ONE.time)]), ONE.outputs)
SENSOR = dgp.Static(inducing=5, limits=(-0.3, 0.4))
UNEVEN = dgp.Record(ONE.time + 0.03 * np.sin(np.arange(40)), ONE.inputs, ONE.outputs)
CASES = {
    "linear": (Linear(1, pairs=3), ONE),
    "uneven steps": (Linear(1, pairs=2), UNEVEN),
    "missing samples": (Linear(1, pairs=2), GAPS),
    "two outputs": (Linear(1, outputs=2, pairs=2), TWO),
    "two outputs, records": (Linear(1, outputs=2, pairs=2), (TWO, TWO[:20])),
    "independent noise": (Linear(1, pairs=2, noise="independent"), ONE),
    "no inputs": (Linear(0, pairs=2), ONE.select(inputs=[])),
    "first state a site": (Linear(1, pairs=2, initial_state="site"), (ONE, ONE[:25])),
    "first state zero": (Linear(1, pairs=2, initial_state="zero"), ONE),
    "no process noise": (Linear(1, pairs=2, process_noise=False), ONE),
    "no feedthrough": (Linear(1, pairs=2, feedthrough=False), ONE),
    "flat priors": (Linear(1, pairs=2, priors="paper"), ONE),
    "direct": (Linear(2, pairs=1, direct=1, channels=(Trend(0.0, 4.0),)), ONE),
    "Student-t": (dgp.Cascade(1, (dgp.Dynamic(pairs=2),), dgp.StudentT()), ONE),
    "varying noise": (dgp.Cascade(1, (dgp.Dynamic(pairs=2),), dgp.Heteroscedastic(4)), ONE),
    "varying with the output": (
        dgp.Cascade(1, (dgp.Dynamic(pairs=2),), dgp.Heteroscedastic(4, of="output")), ONE,
    ),
    "static": (dgp.Cascade(1, (dgp.Static(inducing=5),)), ONE),
    "Wiener": (dgp.Wiener(1, pairs=2, inducing=5), ONE),
    "Wiener, Student-t": (dgp.Wiener(1, pairs=1, inducing=5, likelihood=dgp.StudentT()), GAPS),
    "quiet Wiener": (dgp.Wiener(1, pairs=2, inducing=5, process_noise=False), (ONE, ONE[:25])),
    "at the limits": (dgp.Cascade(1, (dgp.Dynamic(pairs=1), SENSOR)), LIMITED),
    "Hammerstein": (dgp.Hammerstein(1, pairs=1, inducing=5), GAPS),
    "Wiener-Hammerstein": (dgp.WienerHammerstein(1, pairs=1, inducing=5), ONE),
    "Hammerstein-Wiener": (dgp.HammersteinWiener(1, pairs=1, inducing=5), ONE),
    "feedback": (dgp.NonlinearFeedback(1, pairs=1, inducing=5), ONE),
    "Wiener, two inputs": (dgp.Wiener(2, pairs=1, inducing=5), WIDE),
    "Wiener, two outputs": (dgp.Wiener(1, outputs=2, pairs=1, inducing=5), TWO),
    "two dynamic layers": (
        dgp.Cascade(1, (dgp.Dynamic(2, pairs=2), dgp.Dynamic(pairs=1, skip=("inputs",)))), ONE,
    ),
}  # fmt: skip


def prepared(name):
    """A model of a case with its scaling, what it is called with, and draws of its prior."""
    model, records = CASES[name]
    target = model.scaled_to(records).collapsed
    proper = replace(target, priors="default")  # which can be drawn from
    points = []
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(1)
        for _ in range(3):
            nodes = pyro.poutine.trace(proper).get_trace(records).nodes
            points.append({k: n["value"] for k, n in nodes.items()
                           if n["type"] == "sample" and not n["is_observed"]})  # fmt: skip
    return target, (records,), points


@pytest.mark.parametrize("name", CASES)
def test_equals_the_trace(name):
    target, args, points = prepared(name)
    direct, traced = density_of(target, args), Traced(target, args)
    assert isinstance(direct, Direct)
    latent, count = direct.latent(points[0])
    expected, observed = traced.latent(points[0])
    assert [one[0] for one in latent] == [one[0] for one in expected]
    assert count == observed
    potential = Potential(target, args, points[0])
    z = torch.stack([potential.pack(values) for values in points])
    for jacobian in (False, True):
        for at in (z[0], z):
            found = []
            energies = (
                lambda x: joint_energy(traced, potential.sites, x, jacobian=jacobian),  # noqa: B023
                lambda x: joint_energy(direct, potential.sites, x, jacobian=jacobian),  # noqa: B023
                # Priors, and of linear models all of it, as one vector.
                lambda x: potential.energy(x, jacobian=jacobian),  # noqa: B023
            )
            for energy in energies:
                x = at.clone().requires_grad_()
                value = energy(x)
                found.append((value.detach(), torch.autograd.grad(value.sum(), x)[0]))
            (exact, gradient), *others = found
            size = float(gradient.abs().max())
            for (value, slope), rounding in zip(others, (1e-10, 1e-8), strict=True):
                assert value.shape == exact.shape == at.shape[:-1]
                torch.testing.assert_close(value, exact, rtol=1e-10, atol=1e-10)
                torch.testing.assert_close(slope, gradient, rtol=rounding, atol=rounding * size)


@pytest.mark.parametrize("name", ["Wiener", "quiet Wiener", "Hammerstein", "feedback"])
def test_fixed_sites_are_those_of_a_conditioned_model(name):
    target, args, points = prepared(name)
    free = [site for site in points[0] if site.endswith(("_values", "_state"))]
    fixed = {k: v for k, v in points[0].items() if k not in free}
    rest = [{k: values[k] for k in free} for values in points]
    conditioned = Traced(pyro.poutine.condition(target, data=fixed), args)
    potential = Potential(target, args, rest[0], fixed)
    assert isinstance(potential.log_density, Direct)
    assert [site.name for site in potential.sites] == [
        n for n, _, _ in conditioned.latent(rest[0])[0]
    ]
    z = torch.stack([potential.pack(values) for values in rest])
    values, gradients = potential.with_jacobian(z.numpy())
    for at, value, gradient in zip(z, values, gradients, strict=True):
        x = at.clone().requires_grad_()
        exact = joint_energy(conditioned, potential.sites, x, jacobian=True)
        (slope,) = torch.autograd.grad(exact, x)
        assert value == pytest.approx(exact.item(), rel=1e-10)
        np.testing.assert_allclose(gradient, slope, rtol=1e-8, atol=1e-8 * float(slope.abs().max()))


def test_other_functions_are_traced():
    model = Linear(1, pairs=1).scaled_to(ONE)
    with_trajectories = dgp.Wiener(1, pairs=1, inducing=4).scaled_to(ONE)
    for target, args in (
        (with_trajectories, (ONE,)),
        (pyro.poutine.condition(model.collapsed, data={}), (ONE,)),
        (model.collapsed, (ONE, None)),
    ):
        assert isinstance(density_of(target, args), Traced)


def test_every_site_needs_a_value():
    target, args, points = prepared("linear")
    del points[0]["offset"]
    for log_joint in (density_of(target, args), Traced(target, args)):
        with pytest.raises(ValueError, match=r"values: expected a value .*'offset'"):
            log_joint.latent(points[0])
