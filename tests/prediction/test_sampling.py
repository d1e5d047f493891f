"""Trajectories drawn forwards: which cause acts in a draw, and from which state it begins."""

from dataclasses import replace

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.models import draws as sampling
from pyro_dynogp.models.draws import (
    JointState,
    Randomness,
    Switches,
    draw_layers,
    first_state,
    fresh_noise,
)
from pyro_dynogp.models.wiring import Dynamic, Static
from tests.lti import oracles
from tests.lti.oracles import NOISES, assert_close, random_system, tensor
from tests.models.cascades import case, draw, parameters
from tests.moments.joint import linear_cascade

OFF = Switches(initial_state=False, process_noise=frozenset(), functions=False)
LAYERS = (
    Dynamic(outputs=2, pairs=2),
    Static(outputs=1, skip=("inputs",)),
    Dynamic(pairs=2, skip=("g1",)),
)


def cascade(seed=0, known=()):
    time = oracles.irregular_times(14, seed)
    u = oracles.random_inputs(14, 1, seed)
    system, joint, _, offset = linear_cascade(1, LAYERS, time, u, seed=seed,
                                              known_start=known)  # fmt: skip
    start = first_state(system)
    return system, joint, offset, time_grid(time), tensor(u), start


def random_numbers(system, n, *shape, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Randomness.draw(system, n, torch.Size(shape))


def test_draws_have_the_joint_moments_of_a_linear_cascade():
    """All causes on: mean and covariance of every layer are those of the dense joint Gaussian."""
    system, joint, offset, grid, u, start = cascade(known=("g2",))
    count = 6000
    random = random_numbers(system, len(grid), count)
    drawn = draw_layers(system, grid, u, start, random, Switches.all_on(system))
    names = [one.name for one in system.wires]
    h = torch.cat([drawn.signals[name].reshape(count, -1) for name in names], -1).numpy()
    i = np.concatenate([joint.index(name).reshape(-1) for name in names])
    exact = joint.covariance[np.ix_(i, i)]
    sd = np.sqrt(np.diag(exact))
    assert np.abs((h.mean(0) - joint.mean[i]) / sd).max() < 5.0 / np.sqrt(count)
    error = (np.cov(h.T) - exact) / np.outer(sd, sd)
    assert np.abs(error).max() < 6.0 * np.sqrt(2.0 / count)
    # Mean and variance of the last layer given those below: they make up its own.
    last = joint.index("g2").reshape(-1)
    total = drawn.mean.var(0)[:, 0] + drawn.variance.mean(0)[:, 0]
    np.testing.assert_allclose(total, np.diag(joint.covariance)[last], rtol=0.12)
    np.testing.assert_allclose(
        drawn.mean.mean(0)[:, 0], joint.mean[last] + offset, atol=0.1 * sd.max()
    )


def test_with_all_causes_off_there_is_one_trajectory():
    """The response of the mean: from the known start, without noise, functions at their mean."""
    system, joint, offset, grid, u, start = cascade(known=("g1", "g2"))
    drawn = draw_layers(system, grid, u, start, random_numbers(system, len(grid), 3), OFF)
    for one in system.wires:
        expected = joint.mean[joint.index(one.name)]
        assert_close(drawn.signals[one.name], np.stack([expected] * 3), rtol=1e-9)
    assert not drawn.variance.any()
    assert_close(drawn.mean[0], joint.mean[joint.index("g2")] + offset, rtol=1e-9)


@pytest.mark.parametrize("cause", ["initial_state", "g1", "g2", "functions"])
def test_each_switch_acts_on_its_own_layers_only(cause):
    model, record = case("Wiener-Hammerstein")
    values = parameters(model, draw(model, record))
    with pyro.poutine.condition(data=values):
        system = model.sample_system(model.scaling)
    grid = time_grid(record.time)
    u = torch.zeros(len(record), 1, dtype=torch.float64)
    start = first_state(system)
    random = random_numbers(system, len(grid))
    on = {
        "initial_state": Switches(True, frozenset(), False),
        "functions": Switches(False, frozenset(), True),
    }.get(cause, Switches(False, frozenset({cause}), False))
    none, one = (draw_layers(system, grid, u, start, random, s) for s in (OFF, on))
    moves = {
        name: bool((one.signals[name] != none.signals[name]).any()) for name in ("g1", "f", "g2")
    }
    first = {"initial_state": "g1", "functions": "f"}.get(cause, cause)
    names = ["g1", "f", "g2"]
    assert moves == {name: names.index(name) >= names.index(first) for name in names}
    # The same numbers give the same draw.
    again = draw_layers(system, grid, u, start, random, on)
    assert all(torch.equal(again.signals[name], one.signals[name]) for name in names)


def test_runs_that_grow_without_bound_leave_the_other_draws_as_they_are():
    """Those are lost alone: not a number, or far out on the function's straight end."""
    model, record = case("Wiener-Hammerstein")
    values = parameters(model, draw(model, record))
    with pyro.poutine.condition(data=values):
        system = model.sample_system(model.scaling)
    ((place, layer),) = [
        x for x in zip(system.wires, system.layers, strict=True) if x[0].name == "f"
    ]
    residual = random_numbers(system, len(record), 4).residual["f"]
    x = layer.function.locations.mean() + 0.3 * torch.randn(
        4, len(record), 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    far = x.clone()
    far[1, 5:] = torch.nan
    far[2, 5:] = 1e60
    far[3, 5:] = -torch.inf
    drawing = Switches(False, frozenset(), True)
    for switches in (OFF, drawing):
        plain, beside = (
            sampling.draw_static(place.layer.support, layer, signal, residual, switches)
            for signal in (x, far)
        )
        for a, b in zip(plain, beside, strict=True):
            # Both are read off a grid, the latter off one up to seven times as wide.
            there = torch.isfinite(far).expand(a.shape) & (far.abs() < 1e3)
            torch.testing.assert_close(b[there], a[there], rtol=0.0, atol=5e-3)
        assert torch.isnan(beside[0][1, 5:]).all()


def test_all_on_names_the_layers_that_have_process_noise():
    model, _ = case("Wiener-Hammerstein")
    system = model.sample_system(model.scaling)
    assert Switches.all_on(system).process_noise == {"g1", "g2"}
    assert Switches.all_on(system.without_process_noise).process_noise == frozenset()


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("outputs", [None, 2])
def test_fresh_noise_starts_from_nothing(noise, outputs):
    """Process noise from a known state on: the covariance that grows from zero, no mean."""
    system = random_system(1, outputs=outputs, noise=noise)
    time = oracles.irregular_times(8, 1)
    process = fresh_noise(system.modes, time_grid(time))
    nothing = np.zeros((6, 6))
    exact = np.diag(oracles.covariance(system, time, time, nothing, time[0]))
    assert not process.mean.any()
    assert_close(process.variance.reshape(-1), exact, rtol=1e-8)
    assert process.variance[0].abs().max() < 1e-12 * exact.max()


def test_root_of_a_singular_covariance():
    x = torch.randn(3, 4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    P = x @ x.mT
    root = JointState(torch.zeros(4), P).root()
    assert_close(root @ root.mT, P, rtol=1e-12)


def test_known_start_orders_real_parts_before_imaginary_ones():
    system, *_ = cascade(known=("g2",))
    start = first_state(system).mean
    state = system.layer("g2").first_state
    assert start.shape == (8,)
    assert torch.equal(start, torch.cat([0 * state.real, state.real, 0 * state.imag, state.imag]))


def test_functions_of_several_channels_stretch_by_stretch(monkeypatch):
    """Small kernel matrices of a few samples each give what one large matrix gives."""
    system, _, _, grid, u, start = cascade()
    random = random_numbers(system, len(grid), 5)
    on = Switches.all_on(system, several_channels=True)
    whole = draw_layers(system, grid, u, start, random, on)
    sizes = []
    kernel = type(system.layer("f").function).moments
    monkeypatch.setattr(
        type(system.layer("f").function),
        "moments",
        lambda self, x: sizes.append(x.shape[-2]) or kernel(self, x),
    )
    monkeypatch.setattr(sampling, "KERNEL_ENTRIES", 400)
    parts = draw_layers(system, grid, u, start, random, on)
    assert max(sizes) < len(grid) == sum(sizes)
    for name, value in whole.signals.items():
        assert_close(parts.signals[name], value, rtol=1e-9)
    assert_close(parts.mean, whole.mean, rtol=1e-9)
    assert_close(parts.variance, whole.variance, rtol=1e-9)


def test_functions_of_several_channels_are_at_their_mean_as_in_the_filter():
    """Far from the inducing points too, where they are all but unknown."""
    model = dgp.Cascade(1, [dgp.Dynamic(outputs=2, pairs=1), dgp.Static(outputs=2), dgp.Dynamic()])
    record = dgp.Record(np.arange(20.0), np.sin(np.arange(20.0)), np.cos(np.arange(20.0)))
    model = model.scaled_to(record)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(3)
        system = model.collapsed.sample_system(model.scaling)
    grid = time_grid(record.time)
    u = 30.0 * torch.sin(grid.time).unsqueeze(-1)
    start = first_state(system)
    random = random_numbers(system, len(grid), 4)
    plain = Switches(False, frozenset(), True)
    by_filter = draw_layers(system, grid, u, start, random, plain).signals["f"]
    assert torch.equal(by_filter, by_filter[:1].expand_as(by_filter))
    whole = replace(plain, several_channels=True)
    assert draw_layers(system, grid, u, start, random, whole).signals["f"].std(0).max() > 0.1
