"""Cascades that need no filter: against dense joint Gaussians, the filter, and differences."""

from dataclasses import replace

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential, denormals_flushed
from pyro_dynogp.layers.noise import Noise
from pyro_dynogp.models import outputs
from pyro_dynogp.models.exact_outputs import ExactOutputs, has_exact_density
from pyro_dynogp.models.wiring import Dynamic, Static
from tests.lti import oracles
from tests.lti.oracles import tensor
from tests.models.cascades import make_record
from tests.models.outputs import outputs_along
from tests.moments.joint import linear_cascade

QUIET, NOISY = Dynamic(pairs=2, process_noise=False), Dynamic(pairs=2)
LINEAR = {
    "noise in the last layer": (1, (QUIET, Static(), NOISY)),
    "unknown first state of the last layer": (2, (QUIET, Static(), QUIET)),
    "everything known": (1, (QUIET, Static())),
    "everything known, dynamic last": (1, (QUIET, Static(), replace(QUIET, name="end"))),
    "wide": (
        2,
        (
            replace(QUIET, outputs=3),
            Static(outputs=2),
            Dynamic(outputs=2, pairs=3, skip=("inputs",)),
        ),
    ),
    "one layer": (1, (NOISY,)),
    "static first": (1, (Static(), NOISY)),
}
N = 17


@pytest.mark.parametrize("name", LINEAR)
@pytest.mark.parametrize("gaps", [False, True])
def test_the_density_is_that_of_the_joint_gaussian(name, gaps):
    inputs, layers = LINEAR[name]
    time = oracles.irregular_times(N, 3)
    u = oracles.random_inputs(N, inputs, 4)
    start = ("g1", "g", "end") if name != "one layer" else ()
    system, joint, sd, offset = linear_cascade(inputs, layers, time, u, seed=5, known_start=start)
    assert has_exact_density(system)
    last = system.wires[-1].name
    i = joint.index(last)
    rng = np.random.default_rng(6)
    y = joint.mean[i] + offset + rng.standard_normal(i.shape)
    if gaps:
        y[[1, 8]] = np.nan
        y[12, -1] = np.nan
    expected = joint.log_density(last, sd, y - offset)
    value = tensor(y if i.shape[-1] > 1 else y[:, 0])
    found = outputs_along(system, time, tensor(u), engine=ExactOutputs).log_prob(value)
    assert float(found) == pytest.approx(expected, rel=1e-9)


def test_what_needs_the_filter():
    time, u = oracles.irregular_times(N, 3), oracles.random_inputs(N, 1, 4)

    def exact(*layers, start=("g1",)):
        return has_exact_density(linear_cascade(1, layers, time, u, known_start=start)[0])

    assert exact(QUIET, Static(), NOISY)
    assert not exact(NOISY, Static(), QUIET)
    assert not exact(QUIET, Static(), NOISY, start=())
    assert not exact(QUIET, Static(), NOISY, Static())
    heavy = replace(
        linear_cascade(1, (NOISY,), time, u)[0],
        noise=Noise(dgp.StudentT(), torch.ones(1).double(), None),
    )
    assert not has_exact_density(heavy)


MODELS = {
    "Wiener": dgp.Wiener(1, pairs=2, inducing=7, process_noise=False),
    "Hammerstein": dgp.Hammerstein(1, pairs=2, inducing=7),
    "Wiener-Hammerstein": dgp.WienerHammerstein(
        1, pairs=2, inducing=7, process_noise=(False, True)
    ),
    "no process noise": dgp.WienerHammerstein(1, pairs=2, inducing=7, process_noise=False),
    "several channels": dgp.WienerHammerstein(
        2, pairs=2, inducing=7, width=2, outputs=2, process_noise=(False, True)
    ),
    "direct inputs": replace(
        dgp.WienerHammerstein(1, pairs=2, inducing=7, process_noise=(False, True)),
        inputs=2, direct=1,
    ),
    "varying noise": dgp.WienerHammerstein(
        1, pairs=2, inducing=7, process_noise=(False, True), likelihood=dgp.Heteroscedastic(5)
    ),
    "noise of the output": dgp.WienerHammerstein(
        1, pairs=2, inducing=7, process_noise=(False, True),
        likelihood=dgp.Heteroscedastic(5, of="output"),
    ),
}  # fmt: skip


def potential_of(model, record):
    """The log joint density, and a point at which to look at it."""
    model = model.scaled_to(record).collapsed
    with torch.random.fork_rng():
        torch.manual_seed(3)
        trace = pyro.poutine.trace(model).get_trace(record)
    values = {
        name: node["value"] for name, node in trace.nodes.items()
        if node["type"] == "sample" and not node["is_observed"]
    }  # fmt: skip
    potential = Potential(model, (record,), values)
    return potential, 0.5 * potential.pack(values).numpy()


@pytest.mark.parametrize("name", MODELS)
def test_value_and_gradient(name, monkeypatch):
    model = MODELS[name]
    record = make_record(model.inputs, model.outputs, n=40, gaps=True)
    potential, z = potential_of(model, record)
    value, gradient = potential.value_and_gradient(z)
    for i in range(0, len(z), 3):
        step = np.zeros(len(z))
        step[i] = 1e-5
        up, down = (potential.value_and_gradient(z + s)[0] for s in (step, -step))
        assert gradient[i] == pytest.approx((up - down) / 2e-5, rel=1e-5, abs=1e-4)
    # The filter interpolates functions of one channel in a table of 801 points.
    monkeypatch.setattr(outputs, "has_exact_density", lambda system: False)
    assert value == pytest.approx(potential.value_and_gradient(z)[0], rel=1e-4, abs=1e-2)


def test_denormals_are_flushed_inside_only():
    tiny = torch.tensor(1e-310, dtype=torch.float64)
    with denormals_flushed():
        assert float(tiny * 1.0) == 0.0
        with denormals_flushed():
            pass
        assert float(tiny * 1.0) == 0.0
    assert float(tiny * 1.0) == 1e-310
