"""Densities of one model on versions of a record, beside each density by itself."""

from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Delayed
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.optimise.side_by_side import each_in_lockstep

DELAYS = (0.4, 1.0, 2.7)


def record_of(n, seed, gap=False):
    rng = np.random.default_rng(seed)
    u = np.cumsum(rng.standard_normal((n, 2)), 0)
    y = 0.3 * u[:, 0] + rng.standard_normal(n)
    if gap:
        y[5:9] = np.nan
    return dgp.Record(0.5 * np.arange(n), u, y, input_names=["a", "b"])


RECORDS = {
    "one": (record_of(60, 0),),
    "with a gap": (record_of(60, 1, gap=True),),
    "two": (record_of(40, 2), record_of(50, 3)),
}
MODELS = {
    "linear": dgp.LinearDynamicGP(2, pairs=2, feedthrough=True),
    "linear, a direct input": dgp.LinearDynamicGP(2, pairs=1, direct=1),
    "linear, state a site": dgp.LinearDynamicGP(2, pairs=1, initial_state="site"),
    "Wiener, filtered": dgp.Wiener(2, pairs=1, inducing=6),
    "Wiener, known trajectory": dgp.Wiener(
        2, pairs=1, inducing=6, process_noise=False, initial_state="zero"
    ),
    "Hammerstein": dgp.Hammerstein(2, pairs=1, inducing=6),
}


def potentials_of(model, records):
    """One for each delay of the first input, each in units of its own."""
    found = []
    for delay in DELAYS:
        delayed = replace(model, channels=(Delayed("a", delay),)).scaled_to(records).collapsed
        prepared = delayed.check(records)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            trace = pyro.poutine.trace(delayed).get_trace(prepared)
        values = {
            name: node["value"]
            for name, node in trace.nodes.items()
            if node["type"] == "sample" and not node["is_observed"]
        }
        found.append(Potential(delayed, (prepared,), values))
    return found


def asked(potentials, points):
    """What an optimiser of each potential is told about its points, one or more at a time."""
    return each_in_lockstep(potentials, [lambda own, z=z: own(z) for z in points], jacobian=True)


@pytest.mark.parametrize("records", RECORDS)
@pytest.mark.parametrize("model", MODELS)
def test_versions_have_the_densities_that_each_has_by_itself(model, records, monkeypatch):
    potentials = potentials_of(MODELS[model], RECORDS[records])
    rng = np.random.default_rng(4)
    points = [
        one.pack(one.at).numpy() + 0.1 * rng.standard_normal((count, one.size))
        for one, count in zip(potentials, (2, 1, 3), strict=True)
    ]
    expected = [one.with_jacobian(z) for one, z in zip(potentials, points, strict=True)]
    calls = []
    alone = Potential.values_and_gradients

    def counted(self, z, **options):
        calls.append(len(z))
        return alone(self, z, **options)

    monkeypatch.setattr(Potential, "values_and_gradients", counted)
    found = asked(potentials, points)
    assert calls == [6]  # all of them at once
    for (values, gradients), (own, own_gradients) in zip(found, expected, strict=True):
        np.testing.assert_allclose(values, own, rtol=1e-9)
        np.testing.assert_allclose(gradients, own_gradients, rtol=1e-6, atol=1e-6)
    # Versions differ: an evaluation that took one record for all would be found out.
    z = points[0][:1]
    energies = [one.with_jacobian(z)[0][0] for one in potentials]
    assert np.ptp(energies) > 1e-3


def test_batches_are_split_where_they_are_too_wide(monkeypatch):
    potentials = potentials_of(MODELS["linear"], RECORDS["one"])
    points = [one.pack(one.at).numpy()[None] for one in potentials]
    expected = asked(potentials, points)
    potentials[0].width = 2
    for found, whole in zip(asked(potentials, points), expected, strict=True):
        np.testing.assert_allclose(found[0], whole[0], rtol=1e-12)


def test_what_cannot_be_evaluated_is_found_among_versions(monkeypatch):
    potentials = potentials_of(MODELS["linear"], RECORDS["one"])
    points = [one.pack(one.at).numpy()[None] for one in potentials]
    points[1] = np.full_like(points[1], np.nan)
    expected = [one.with_jacobian(z) for one, z in zip(potentials, points, strict=True)]
    for (values, gradients), own in zip(asked(potentials, points), expected, strict=True):
        np.testing.assert_allclose(values, own[0], rtol=1e-9)
        np.testing.assert_allclose(gradients, own[1], rtol=1e-6, atol=1e-6)


def gain_model(scale):
    def model():
        pyro.sample("gain", dist.Normal(torch.tensor(0.0).double(), scale))

    return Potential(model, (), {"gain": torch.tensor(1.0).double()})


def test_models_that_are_no_versions_are_evaluated_one_by_one():
    linear = MODELS["linear"]
    others = [
        *potentials_of(linear, RECORDS["one"])[:1],
        *potentials_of(linear, RECORDS["with a gap"])[:1],  # other outputs
        *potentials_of(MODELS["linear, a direct input"], RECORDS["one"])[:1],  # another model
        gain_model(1.0),
        gain_model(2.0),
    ]
    points = [one.pack(one.at).numpy()[None] for one in others]
    for found, one, z in zip(asked(others, points), others, points, strict=True):
        expected = one.with_jacobian(z)
        np.testing.assert_allclose(found[0], expected[0], rtol=1e-12)
        np.testing.assert_allclose(found[1], expected[1], rtol=1e-9, atol=1e-12)
