"""Fits whose parameters are given, not fitted, and records simulated from them."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pyro
import torch

import pyro_dynogp as dgp
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.posteriors import Sampled
from pyro_dynogp.lti.state import ModalState
from pyro_dynogp.models.prepared import PreparedRecord


def steps_record(n=120, step=0.1, seed=0, hold=8):
    """Random steps as input, white outputs; standardised, so that scaling changes nothing."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal(n // hold + 1), hold)[:n]
    y = rng.standard_normal(n)
    return dgp.Record(
        time=step * np.arange(n), inputs=(u - u.mean()) / u.std(), outputs=(y - y.mean()) / y.std()
    )


def fit_of(model, draws, scaling):
    """A fit with the given posterior draws (S, ...) of every site."""
    return Fit(
        model=replace(model, scaling=scaling),
        posterior=Sampled(draws, "map" if len(next(iter(draws.values()))) == 1 else "svi"),
        draws=MappingProxyType(dict(draws)),
        mode=MappingProxyType({k: v[0] for k, v in draws.items()}),
        history=np.zeros(1),
        start_energies=np.zeros(1),
        diagnostics=MappingProxyType({}),
        seed=0,
        records=(),
    )


def prior_draws(model, scaling, count, **fixed):
    """Draws (count, ...) of a model's parameters, some of them fixed."""
    found = []
    with torch.random.fork_rng(), torch.no_grad(), pyro.poutine.block():
        torch.manual_seed(5)
        for _ in range(count):
            sample = pyro.poutine.condition(model.sample_system, data=fixed)
            trace = pyro.poutine.trace(sample).get_trace(scaling)
            found.append({n: s["value"] for n, s in trace.nodes.items() if s["type"] == "sample"})
    return {name: torch.stack([one[name] for one in found]) for name in found[0]}


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def saturation(x):
    """The static function of the known Wiener system."""
    return np.tanh(1.2 * x) + 0.1 * x


def wiener_fit(*, noise_sd=0.05, drift=0.3, **options):
    """A Wiener system with one resonant pair and `saturation`; drift scales its process noise."""
    model = dgp.Wiener(1, pairs=1, inducing=25, **options)
    scaling = dgp.Scaling.from_records(steps_record())
    rate = dgp.TimeScale.of(scaling).typical_rate
    values = {
        "g_input_gain": tensor(0.4, 0.8).reshape(1, 1, 2),
        "g_feedthrough": tensor(0.0),
        "g_log_decay": tensor(np.log(1.0 / rate)),
        "g_log_frequency": tensor(np.log(3.0 / rate)),
        "f_center": tensor(0.0),
        "f_half_width": tensor(5.0),
        "f_constant": tensor(0.0),
        "f_output_scale": tensor(1.0),
        "f_lengthscale": tensor(4.0),
        "f_values": torch.zeros(1, 25, dtype=torch.float64),
        "noise_sd": tensor(noise_sd),
    }
    if options.get("likelihood", dgp.Gaussian()).varying:
        del values["noise_sd"]
    draws = prior_draws(model, scaling, 1, **values)
    if "g_noise_gain_unit" in draws:
        g = fit_of(model, draws, scaling).system.layer("g").modes
        sd = float(dgp.LTIProcess(g, [0.0], torch.zeros(1, 1)).variance.sqrt())
        draws["g_noise_gain_unit"] = draws["g_noise_gain_unit"] * (drift / sd)
    # Least squares: the function is linear in its whitened values.
    at = np.linspace(-4.8, 4.8, 200)
    columns = []
    for one in torch.eye(25, dtype=torch.float64):
        f = fit_of(model, {**draws, "f_values": one.reshape(1, 1, -1)}, scaling).system
        columns.append(f.layer("f").function.mean(torch.tensor(at)[:, None]).reshape(-1).numpy())
    Phi = np.stack(columns, 1)
    v = np.linalg.lstsq(Phi, saturation(at), rcond=1e-4)[0]
    assert np.abs(Phi @ v - saturation(at)).max() < 0.01
    draws["f_values"] = torch.tensor(v).reshape(1, 1, -1)
    return fit_of(model, draws, scaling)


def wiener_data(fit, n=120, seed=0, x0=None, **names):
    """A record simulated from a known Wiener system at rest, and its g (n,)."""
    layer = fit.system.layer("g")
    record = steps_record(n, seed=seed + 100)
    u = PreparedRecord.of(record, fit.scaling).scaled_inputs
    start = torch.zeros_like(layer.modes.poles[0]) if x0 is None else x0
    state = ModalState(start, layer.prior_state().covariance[0] - layer.past_inputs[0])
    rng = np.random.default_rng([seed, 7])
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        g = dgp.LTIProcess(layer.modes[0], record.time, u, state).sample().numpy()
    sd = fit.system.noise.sd(u)[0, :, 0].numpy()
    y = saturation(g) + sd * rng.standard_normal(n)
    y = fit.scaling.output_offset + fit.scaling.output_scale * y
    return record.with_outputs(y[:, None]), g
