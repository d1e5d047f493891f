"""Many points through a model at once give what each gives alone."""

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Trend
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.optimise.maximum import Effort, maximise
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.poles import starting_values
from tests.conftest import simulate_record

ONE = simulate_record(dgp.Modes([-0.6 + 2.0j], [[0.8 + 0.3j]], [1.0], [[0.15]]), 1e-2, n=40)
TWO = simulate_record(
    dgp.Modes([-0.6 + 2.0j], [[0.8 + 0.3j]], [[1.0], [0.4 - 0.2j]], [[0.15]]), 1e-2, n=30
)
GAPS = ONE.with_outputs(np.where(np.arange(40)[:, None] % 7 == 3, np.nan, ONE.outputs))
Linear = dgp.LinearDynamicGP
CASES = {
    "linear": (Linear(1, pairs=3), ONE),
    "missing samples": (Linear(1, pairs=2), GAPS),
    "two outputs": (Linear(1, outputs=2, pairs=2), TWO),
    "independent noise": (Linear(1, pairs=2, noise="independent"), ONE),
    "first state": (Linear(1, pairs=2, initial_state="site"), ONE),
    "no process noise": (Linear(1, pairs=2, process_noise=False), ONE),
    "direct": (Linear(2, pairs=1, direct=1, channels=(Trend(0.0, 4.0),)), ONE),
    "two records": (Linear(1, pairs=1), (ONE, ONE[:25])),
    "Wiener": (dgp.Wiener(1, pairs=2, inducing=5), ONE),
    "quiet Wiener": (dgp.Wiener(1, pairs=2, inducing=5, process_noise=False), ONE),
    "Hammerstein": (dgp.Hammerstein(1, pairs=1, inducing=5), GAPS),
    "Wiener-Hammerstein": (dgp.WienerHammerstein(1, pairs=1, inducing=5), ONE),
    "Hammerstein-Wiener": (dgp.HammersteinWiener(1, pairs=1, inducing=5), ONE),
    "two records, cascade": (dgp.Wiener(1, pairs=1, inducing=4), (ONE, ONE[:25])),
}


def drawn(name, count=3):
    """Potential of a case, and unconstrained vectors of draws from the prior."""
    model, records = CASES[name]
    target = model.scaled_to(records).collapsed
    points = []
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        for _ in range(count):
            trace = pyro.poutine.trace(target).get_trace(records)
            points.append({k: node["value"] for k, node in trace.nodes.items()
                           if node["type"] == "sample" and not node["is_observed"]})  # fmt: skip
    potential = Potential(target, (records,), points[0])
    return potential, np.stack([potential.pack(values).numpy() for values in points])


@pytest.mark.parametrize("jacobian", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_values_and_gradients_of_a_batch(name, jacobian):
    potential, z = drawn(name)
    assert potential.width >= len(z)
    values, gradients = potential.values_and_gradients(z, jacobian=jacobian)
    for value, gradient, point in zip(values, gradients, z, strict=True):
        alone, slope = potential.value_and_gradient(point, jacobian=jacobian)
        assert np.isfinite(alone)
        # Vectorised sums round by the shape of what they add.
        assert value == pytest.approx(alone, rel=1e-11)
        np.testing.assert_allclose(gradient, slope, rtol=1e-6, atol=1e-8 * np.abs(slope).max())


def test_a_point_out_of_range_leaves_the_others_alone():
    potential, z = drawn("linear")
    z[1] = 800.0
    values, gradients = potential.values_and_gradients(z)
    assert values[1] == 1e15
    assert not gradients[1].any()
    assert values[2] == pytest.approx(potential.value_and_gradient(z[2])[0], rel=1e-11)


def test_other_models_are_evaluated_point_by_point():
    def model():
        x = pyro.sample("x", pyro.distributions.Normal(torch.zeros(2).double(), 1.0).to_event(1))
        assert x.shape == (2,)

    potential = Potential(model, (), {"x": torch.zeros(2).double()})
    assert potential.width == 1
    values, gradients = potential.values_and_gradients(np.array([[1.0, 2.0], [0.0, 0.5]]))
    np.testing.assert_allclose(values, [2.5 + np.log(2 * np.pi), 0.125 + np.log(2 * np.pi)])
    np.testing.assert_allclose(gradients, [[1.0, 2.0], [0.0, 0.5]])


@pytest.mark.parametrize("optimizer", ["lbfgs", "preconditioned", "adam"])
def test_starts_end_together_where_they_end_alone(optimizer):
    model = Linear(1, pairs=2).scaled_to(ONE)
    starts = starting_values(model, model.prepare(ONE), count=3, seed=0)
    options = {"optimizer": optimizer, "steps": 20}
    alone = maximise(model, ONE, starts, Run(workers=1), effort=Effort(1.0, together=1), **options)
    both = maximise(model, ONE, starts, Run(workers=1), effort=Effort(1.0, together=3), **options)
    for one, other in zip(alone, both, strict=True):
        assert other.energy == pytest.approx(one.energy, abs=1e-4)
        # Later ones went through differences of gradients, which enlarge rounding.
        np.testing.assert_allclose(other.history[:4], one.history[:4], rtol=1e-8)
