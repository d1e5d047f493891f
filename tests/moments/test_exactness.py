"""Where all layers are linear the filter is exact: against dense joint Gaussians."""

from functools import lru_cache

import numpy as np
import pytest
import torch

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.models.assembly import assemble
from pyro_dynogp.models.moment_outputs import MomentOutputs
from pyro_dynogp.models.wiring import Dynamic, Static
from pyro_dynogp.moments import filtering, smoothing
from tests.lti import oracles
from tests.lti.oracles import NOISES, assert_close, tensor
from tests.models.outputs import outputs_along
from tests.moments.joint import linear_cascade
from tests.moments.problems import element

G, F = Dynamic(pairs=2), Static()
CASES = {
    "one dynamic layer": (2, (G,)),
    "no inputs": (0, (G,)),
    "two outputs": (1, (Dynamic(outputs=2, pairs=3),)),
    "two dynamic layers": (1, (G, G)),
    "two wide dynamic layers": (2, (Dynamic(outputs=2, pairs=2), Dynamic(outputs=3, pairs=1))),
    "three in a row, the first skips": (1, (G, G, Dynamic(pairs=1, skip=("g1",)))),
    "inputs skip": (2, (G, Dynamic(pairs=2, skip=("inputs",)))),
    "line at the end": (1, (G, F)),
    "line first": (1, (F, G)),
    "line first and last": (1, (F, G, Static())),
    "line between": (1, (G, F, Dynamic(pairs=2))),
    "two lines between": (1, (G, F, Static(), Dynamic(pairs=2))),
    "planes between": (
        1,
        (Dynamic(outputs=2, pairs=2), Static(outputs=2), Dynamic(outputs=2, pairs=2)),
    ),
    "plane at the end": (1, (Dynamic(outputs=2, pairs=2), Static(outputs=2))),
    "trajectory skips the line": (1, (G, F, Dynamic(pairs=2, skip=("g1",)))),
    "everything skips": (2, (G, Static(skip=("inputs",)), Dynamic(pairs=1, skip=("inputs", "g1")))),
    "last line sees a line and inputs": (1, (F, G, Static(skip=("inputs", "f1")))),
    "cubature of five channels": (
        1,
        (Dynamic(outputs=5, pairs=3), Static(outputs=2), Dynamic(pairs=1)),
    ),
}
N = 18


def times(seed):
    """Irregular, some steps equal, one time repeated."""
    t = oracles.irregular_times(N, seed)
    t[5:9] = t[4] + 0.25 * np.arange(1, 5)
    t[9:] += max(t[8] - t[9], 0.0) + 0.1
    t[12] = t[11]
    return t


class Case:
    """A linear cascade with outputs drawn from its own joint Gaussian, some missing."""

    def __init__(self, name, noise="shared", seed=None, known_start=("g1",)):
        inputs, layers = CASES[name]
        seed = len(name) if seed is None else seed
        self.time = times(seed)
        self.inputs = oracles.random_inputs(N, inputs, seed)
        self.system, self.joint, self.sd, self.offset = linear_cascade(
            inputs, layers, self.time, self.inputs, seed=seed, noise=noise, known_start=known_start
        )
        self.last = self.system.wires[-1].name
        rng = np.random.default_rng([seed, 5])
        i = self.joint.index(self.last)
        signal = self.joint.covariance[np.ix_(i.reshape(-1), i.reshape(-1))]
        root = np.linalg.cholesky(signal + np.diag(np.tile(self.sd**2, N)))
        draw = root @ rng.standard_normal(i.size)
        self.y = self.joint.mean[i] + self.offset + draw.reshape(i.shape)
        self.y[[2, 7, N - 1], -1] = np.nan
        self.assembly = assemble(self.system, time_grid(self.time), tensor(self.inputs))
        self.problem = self.assembly.with_outputs(tensor(self.y))
        self.values = element(self.problem)

    def given(self, until=N, outputs=None):
        """Everything given outputs of the first samples, and some of the next one's."""
        seen = ~np.isnan(self.y)
        seen[until:] = False
        if outputs is not None:
            seen[until, :outputs] = ~np.isnan(self.y[until, :outputs])
        return self.joint.given(self.last, self.sd, self.y - self.offset, seen)


@lru_cache
def case_of(name, noise="shared"):
    """Built once for all tests: the dense joint Gaussian is most of their time."""
    return Case(name, noise)


def every_case(test):
    independent = ("one dynamic layer", "two wide dynamic layers", "planes between")
    both = [(name, "shared") for name in CASES] + [(name, "independent") for name in independent]
    return pytest.mark.parametrize(("name", "noise"), both)(test)


@every_case
def test_log_density(name, noise):
    case = case_of(name, noise)
    scale, shift = np.linspace(2.0, 3.0, len(case.sd)), np.full(len(case.sd), -1.0)
    y = shift + scale * case.y
    observed = outputs_along(
        case.system, case.time, tensor(case.inputs), scale, shift, engine=MomentOutputs
    )
    expected = case.joint.log_density(case.last, case.sd, case.y - case.offset)
    expected -= ((~np.isnan(y)) * np.log(scale)).sum()
    value = tensor(y if len(case.sd) > 1 else y[:, 0])
    assert float(observed.log_prob(value)) == pytest.approx(expected, rel=1e-9)


@every_case
def test_smoothed_signals(name, noise):
    case = case_of(name, noise)
    layout, values = case.problem.layout, case.values
    signals = {k: s for k, s in case.assembly.signals.items() if s.rows is not None}
    rows = torch.cat([s.rows for s in signals.values()]).numpy().copy()
    _, track, _, _ = filtering.run(layout, values)
    mean, variance = smoothing.smooth(layout, values, rows, track)
    exact_mean, exact = case.given()
    start = 0
    for signal, s in signals.items():
        own = slice(start, start + s.rows.shape[-2])
        start = own.stop
        i = case.joint.index(signal)
        found = s.known.numpy() + mean @ rows[own].T
        assert_close(found, exact_mean[i], rtol=1e-8)
        assert_close(variance[:, own], np.diag(exact)[i], rtol=1e-8)


@every_case
def test_leave_one_out(name, noise):
    """Each noise-free output given all samples but its own, with those of the same time."""
    case = case_of(name, noise)
    _, track, _, _ = filtering.run(case.problem.layout, case.values)
    mean, variance, _ = smoothing.leave_one_out(case.problem.layout, case.values, track)
    there = ~np.isnan(case.y)
    assert np.array_equal(~np.isnan(mean), there)
    assert np.array_equal(~np.isnan(variance), there)
    i = case.joint.index(case.last)
    for k, o in zip(*np.nonzero(there), strict=True):
        seen = there.copy()
        seen[k, o] = False
        exact, P = case.joint.given(case.last, case.sd, case.y - case.offset, seen)
        assert mean[k, o] == pytest.approx(exact[i[k, o]] + case.offset[o], rel=1e-7, abs=1e-9)
        assert variance[k, o] == pytest.approx(P[i[k, o], i[k, o]], rel=1e-7)


@every_case
def test_predictions_and_innovations(name, noise):
    case = case_of(name, noise)
    layout, values = case.problem.layout, case.values
    i = case.joint.index(case.last)
    for horizon in (1, 3):
        mean, variance, _ = smoothing.predict_ahead(layout, values, horizon)
        expected = [case.given(max(k - horizon + 1, 0)) for k in range(N)]
        at = [m[i[k]] + case.offset for k, (m, _) in enumerate(expected)]
        of = [np.diag(P)[i[k]] for k, (_, P) in enumerate(expected)]
        assert_close(mean, np.array(at), rtol=1e-8)
        assert_close(variance, np.array(of), rtol=1e-8)
    innovation, variance, _ = smoothing.innovate(layout, values)
    assert np.array_equal(np.isnan(innovation), np.isnan(case.y))
    # Outputs of one time are used one after the other.
    for k, o in zip(*np.nonzero(~np.isnan(case.y)), strict=True):
        m, P = case.given(k, outputs=o)
        j = i[k, o]
        assert innovation[k, o] == pytest.approx(
            case.y[k, o] - m[j] - case.offset[o], rel=1e-7, abs=1e-8
        )
        assert variance[k, o] == pytest.approx(P[j, j] + case.sd[o] ** 2, rel=1e-8)


@pytest.mark.parametrize("name", CASES)
def test_last_state(name):
    """What the last state says of each signal at the last time is what all outputs say of it."""
    case = case_of(name)
    _, _, m, P = filtering.run(case.problem.layout, case.values)
    exact_mean, exact = case.given()
    for signal, s in case.assembly.signals.items():
        if s.rows is None:
            continue
        i = case.joint.index(signal)[-1]
        rows = s.rows.numpy()
        assert_close(s.known[-1].numpy() + rows @ m, exact_mean[i], rtol=1e-8)
        assert_close(rows @ P @ rows.T, exact[np.ix_(i, i)], rtol=1e-8)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("known_start", [(), ("g",)])
def test_last_state_goes_on(noise, known_start):
    """Known and filtered parts of the state together carry on as the record itself would."""
    case = Case("two outputs", noise, known_start=known_start)
    cut = 13
    head = assemble(case.system, time_grid(case.time[:cut]), tensor(case.inputs[:cut]))
    problem = head.with_outputs(tensor(case.y[:cut]))
    _, _, m, P = filtering.run(problem.layout, element(problem))
    system = oracles.random_system(len("two outputs"), pairs=3, inputs=1, outputs=2, noise=noise)
    J = 6
    z = head.known_state.numpy() + m[:J]
    rest = slice(cut - 1, N)
    mean, _ = oracles.mean(system, case.time[rest], case.inputs[rest], z)
    S = oracles.covariance(system, case.time[rest], case.time[rest], P[:J, :J], case.time[cut - 1])
    exact_mean, exact = case.given(cut)
    i = case.joint.index("g")[rest].reshape(-1)
    assert_close(mean.reshape(-1), exact_mean[i], rtol=1e-8)
    assert_close(S, exact[np.ix_(i, i)], rtol=1e-8)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("name", ["one dynamic layer", "no inputs", "two outputs"])
def test_one_dynamic_layer_is_the_linear_gaussian_process(name, noise):
    case = Case(name, noise, known_start=())
    (layer,) = case.system.layers
    several = len(case.sd) > 1
    offset, sd = (tensor(x if several else x[0]) for x in (case.offset, case.sd))
    driven = tensor(case.inputs) if layer.modes.inputs else None
    process = LTIProcess(layer.modes, case.time, driven, layer.prior_state(), offset=offset)
    y = tensor(case.y if several else case.y[:, 0])
    observed = outputs_along(case.system, case.time, tensor(case.inputs), engine=MomentOutputs)
    exact = process.observed(sd).log_prob(y)
    torch.testing.assert_close(observed.log_prob(y), exact, rtol=1e-9, atol=0.0)
    noiseless = process.condition(y, sd)
    _, track, _, _ = filtering.run(case.problem.layout, case.values)
    signal = case.assembly.signals["g"]
    rows = signal.rows.numpy()
    mean, variance = smoothing.smooth(case.problem.layout, case.values, rows, track)
    found = signal.known.numpy() + mean @ rows.T + case.offset
    shape = noiseless.mean.shape
    assert_close(found.reshape(shape), noiseless.mean, rtol=1e-8)
    assert_close(variance.reshape(shape), noiseless.variance, rtol=1e-6)
