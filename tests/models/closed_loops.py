"""Models with feedback, and the linear system that a linear function in feedback makes, densely."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.layers.sites import sample
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.wiring import Dynamic, Static


def springs(outputs, hidden=0, pairs=2, inputs=1, process_noise=True, **options):
    """A layer g whose outputs and hidden signals come back through a function of each."""
    seen = [*(f"g[{k}]" for k in range(outputs)), *(f"g_hidden[{k}]" for k in range(hidden))]
    functions = [
        Static(inducing=6, mean="linear", sees=(signal,), name=f"f{place}")
        for place, signal in enumerate(seen)
    ]
    dynamic = Dynamic(
        outputs=outputs, pairs=pairs, process_noise=process_noise, hidden=hidden,
        feedback=tuple(one.name for one in functions),
    )  # fmt: skip
    return dgp.Cascade(inputs, (dynamic, *functions), output="g", **options)


def spring(outputs=1, pairs=2, inputs=1, process_noise=True, hidden=0, both=True, **options):
    """A layer g whose output comes back through a function f of all of it.

    With hidden signals through a function h of them, too; or, unless `both`, through f of them.
    """
    back = ("f", "h") if hidden and both else ("f",)
    dynamic = Dynamic(
        outputs=outputs, pairs=pairs, process_noise=process_noise, feedback=back, hidden=hidden
    )
    layers = [dynamic, Static(outputs=outputs, inducing=6, mean="linear", name="f")]
    unseen = Static(outputs=hidden or 1, inducing=6, mean="linear", sees=("g_hidden",))
    if hidden:
        layers[1 + both :] = [replace(unseen, name=back[-1])]
    return dgp.Cascade(inputs, layers, output="g", **options)


def make_record(inputs=1, outputs=1, n=40, seed=0, irregular=False, missing=True):
    rng = np.random.default_rng(seed)
    step = rng.choice([0.05, 0.1, 0.17], n) if irregular else np.full(n, 0.1)
    y = 2.0 + 0.5 * np.cumsum(rng.standard_normal((n, outputs)), 0)
    if missing:
        y[[3, 8]] = np.nan
        y[11, -1] = np.nan
    u = np.repeat(rng.standard_normal((n // 3 + 1, inputs)), 3, axis=0)[:n]
    return dgp.Record(time=np.cumsum(step), inputs=u, outputs=y)


def values_of(model, record, seed=0, linear=True):
    """Values of all sites at random; with `linear` those of a straight line for f."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        values = sample(model.all_sites(model.scaling, 1))
    values["noise_sd"] = values["noise_sd"].clamp(0.05, 1.0)
    values["g_input_gain"] = 0.4 * torch.tanh(values["g_input_gain"])
    if linear:
        for f in model.dynamic[0][0].feedback:
            if f"{f}_slope" in values:  # of several signals, whose loops explode where it is steep
                values[f"{f}_slope"] = 0.3 * torch.tanh(values[f"{f}_slope"])
            values[f"{f}_values"] = torch.zeros_like(values[f"{f}_values"])
            if f"{f}_half_width" in values:  # a line as far as any run goes
                values[f"{f}_half_width"] = torch.full_like(values[f"{f}_half_width"], 60.0)
            values[f"{f}_output_scale"] = 1e-13 + torch.zeros_like(values[f"{f}_output_scale"])
    return values


def system_at(model, values):
    return model.begin(model.system(values, model.scaling), model.states_of(values, ""))


def check_free_run(model, values, record, back, rtol):
    """Free runs without process noise against a plain simulation, in scaled outputs.

    back: what comes back, of a list of the output, with its offset, and of the hidden signals.
    """
    system = system_at(model, values)
    modes, scaling = system.layer("g").modes, model.scaling
    lam, B = (np.concatenate([x, x.conj()]) for x in (modes.poles.numpy(), modes.B.numpy()))
    C = np.concatenate([modes.C.numpy(), modes.C.numpy().conj()], -1)
    first = system.layer("g").first_state.numpy()
    x = np.concatenate([first, first.conj()])
    u = (record.inputs[:, 0] - scaling.input_offset) / scaling.input_scale
    expected = []
    for k, step in enumerate(np.diff(record.time, append=record.time[-1] + 0.1)):
        signals = np.atleast_1d((C @ x).real)
        signals[0] += float(values["offset"])
        expected.append(signals[0])
        gain = (np.expm1(lam * step) / lam)[:, None] * B
        x = np.exp(lam * step) * x + gain[:, 0] * float(u[k]) + gain[:, 1] * back(list(signals))
    (prepared,) = model.prepare(record)
    # Without process noise outputs say nothing of the state.
    found = output_process(system, prepared).one_step(prepared.observations).mean.numpy()
    found = ((found - scaling.output_offset) / scaling.output_scale).ravel()
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol)


def plain_loop(model, system, record, slope=0.0, constant=0.0):
    """The loop in numpy, with another function in the place of the known one."""
    slope, constant = (torch.tensor(x, dtype=torch.float64) for x in ([[slope]], [constant]))
    line = SimpleNamespace(slope=slope, constant=constant)
    parts = {"g": system.layer("g"), "f": SimpleNamespace(function=line)}
    plain = SimpleNamespace(layer=parts.get, offset=system.offset, noise=system.noise)
    return ClosedLoop(model, plain, record)


class ClosedLoop:
    """x[k + 1] = F_k x[k] + drive_k + N(0, Q_k), y = H x + level_k + noise, complex modal states.

    Everything from poles and gains, in numpy; outputs scaled.
    """

    def __init__(self, model, system, record):
        layer = system.layer("g")
        modes, scaling = layer.modes, model.scaling
        P = modes.pairs
        lam = np.concatenate([modes.poles.numpy(), modes.poles.numpy().conj()])
        B = np.concatenate([modes.B.numpy(), modes.B.numpy().conj()])
        self.signals = np.concatenate([modes.C.numpy(), modes.C.numpy().conj()], -1)
        d, n_y = model.inputs, model.outputs
        self.H = self.signals[:n_y]
        u = (record.inputs - scaling.input_offset) / scaling.input_scale
        wires = {w.name: w for w in model.wires}
        slopes, constants = [], []
        for name in wires["g"].feedback:  # each function's slope by all signals of the layer
            f = system.layer(name).function
            own, count = f.slope.numpy(), len(f.constant)
            row = {signal: np.zeros((count, width)) for signal, width in wires["g"].signals.items()}
            for source in wires[name].sources:
                signal, _, place = source.rstrip("]").partition("[")
                there = [int(place)] if place else list(range(row[signal].shape[1]))
                row[signal][:, there], own = own[:, : len(there)], own[:, len(there) :]
            slopes.append(np.concatenate(list(row.values()), 1))
            constants.append(f.constant.numpy())
        slope, constant = np.concatenate(slopes), np.concatenate(constants)
        D = modes.D.numpy()[:, :d]
        self.level = u @ D[:n_y].T + system.offset.numpy()
        self.F, self.drive, self.Q, self.back = [], [], [], []
        L = np.zeros((2 * P, 1))
        if modes.has_process_noise:
            L = np.concatenate([modes.noise_gain.numpy(), modes.noise_gain.numpy().conj()])
        rates = lam[:, None] + lam.conj()[None]
        sigma = -(L @ L.conj().T) / rates
        for k, step in enumerate(np.diff(record.time)):
            gain = (np.expm1(lam * step) / lam)[:, None] * B
            self.F.append(np.diag(np.exp(lam * step)) + gain[:, d:] @ slope @ self.signals)
            seen = slope @ (u[k] @ D.T) + constant  # f sees the layer's output, u acts at once
            self.drive.append(gain[:, :d] @ u[k] + gain[:, d:] @ seen)
            self.back.append(gain[:, d:])
            self.Q.append(-sigma * np.expm1(rates * step))
        first = layer.first_state.numpy()
        self.m0 = np.concatenate([first, first.conj()])
        self.P0 = sigma
        self.noise = system.noise.constant_sd.numpy() ** 2
        self.scale, self.shift = scaling.output_scale, scaling.output_offset

    def filter(self, y=None, n=None):
        """Log density of scaled outputs, mean and covariance of each before its own sample."""
        n = len(self.level) if y is None else len(y)
        m, P, total, means, covariances = self.m0, self.P0, 0.0, [], []
        for k in range(n):
            if k:
                m = self.F[k - 1] @ m + self.drive[k - 1]
                P = self.F[k - 1] @ P @ self.F[k - 1].conj().T + self.Q[k - 1]
            means.append((self.H @ m).real + self.level[k])
            covariances.append((self.H @ P @ self.H.conj().T).real)
            there = np.zeros(0, int) if y is None else np.flatnonzero(~np.isnan(y[k]))
            if not len(there):
                continue
            H = self.H[there]
            S = (H @ P @ H.conj().T).real + np.diag(self.noise[there])
            e = y[k, there] - means[-1][there]
            total += -0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2 * np.pi * S)[1])
            K = P @ H.conj().T @ np.linalg.inv(S)
            m, P = m + K @ e, P - K @ H @ P
        return total, np.array(means), np.array(covariances)

    def simulate(self, functions, rng, seen=0):
        """Scaled outputs (S, n, n_y) of runs, each with a function of its own of signal `seen`.

        Process and measurement noise act; the output is one, and no input acts on it at once.
        """
        half = len(self.m0) // 2
        eye = np.eye(half)
        real = 0.5 * np.block([[eye, eye], [-1j * eye, 1j * eye]])
        count = len(functions(np.zeros(1)))

        def noise(Q):
            w = rng.multivariate_normal(np.zeros(2 * half), (real @ Q @ real.conj().T).real, count)
            w = w[:, :half] + 1j * w[:, half:]
            return np.concatenate([w, w.conj()], 1)

        x, out = self.m0 + noise(self.P0), []
        for k in range(len(self.level)):
            g = (x @ self.H.T).real
            e = rng.standard_normal((count, 1)) * np.sqrt(self.noise)
            out.append(g + self.level[k] + e)
            if k < len(self.F):
                back = functions((x @ self.signals[seen]).real)[:, None] * self.back[k][:, 0]
                x = x @ self.F[k].T + self.drive[k] + back + noise(self.Q[k])
        return np.stack(out, 1)

    def scaled(self, y):
        return (y - self.shift) / self.scale


def check_gradient(potential):
    """The gradient at the potential's point, along four directions, against differences."""
    z = potential.pack(potential.at).numpy()
    value, gradient = potential.value_and_gradient(z)
    assert np.isfinite(value)
    rng = np.random.default_rng(0)
    for _ in range(4):
        move = rng.standard_normal(len(z))
        h = 1e-5 / np.linalg.norm(move)
        ends = potential.values_and_gradients(np.stack([z + h * move, z - h * move]))[0]
        assert (ends[0] - ends[1]) / (2.0 * h) == pytest.approx(gradient @ move, rel=1e-5)
