"""The first state of a record that a fitted cascade is used on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.models.model import Cascade
from pyro_dynogp.models.outputs import collapsed_of
from pyro_dynogp.models.system import CascadeSystem
from pyro_dynogp.models.wiring import Dynamic

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fit

# Samples from which a first state is estimated: it is forgotten soon after.
SAMPLES = 400


def cascade_of(fit: Fit) -> Cascade:
    """The fitted cascade."""
    assert isinstance(fit.model, Cascade)
    return fit.model


def beginning(fit: Fit, record: Record) -> CascadeSystem:
    """The fitted cascade at the beginning of a record, ready for the filter.

    On a training record the first state is that of the posterior draws. On another record it is
    estimated from the record's first samples: the mode of the numbers that describe it, at the
    mode of the parameters.
    """
    model = cascade_of(fit)
    sites = model.state_sites
    if not sites or not record.n_outputs:
        return model.begin(fit.system, {})
    if record.fingerprint in fit.training:
        index = fit.training.index(record.fingerprint)
        suffix = "" if len(fit.training) == 1 else f"_{index}"
        names = {one.name: f"{one.name}_initial_state{suffix}" for one in sites}
        return model.begin(fit.system, {k: fit.draws[v] for k, v in names.items()})
    return model.begin(fit.system, estimate(fit, record))


def estimate(fit: Fit, record: Record) -> dict[str, Tensor]:
    """Most probable first state of a record, as standard normal numbers (2P,) by layer."""
    model = cascade_of(fit)
    head = record[: min(SAMPLES, len(record))]
    system = fit._system_at(fit.mode)
    y = head.tensors().observations
    sizes = {}
    for one in model.state_sites:
        assert isinstance(one.layer, Dynamic)
        sizes[one.name] = 2 * one.layer.pairs
    total = sum(sizes.values())

    def split(z: Tensor) -> dict[str, Tensor]:
        return dict(zip(sizes, torch.split(z, list(sizes.values())), strict=True))

    def energy(x: np.ndarray) -> tuple[float, np.ndarray]:
        with torch.enable_grad():  # predictions are made without
            z = torch.tensor(x, requires_grad=True)
            here = model.begin(system, split(z))
            value = 0.5 * z.square().sum() - collapsed_of(here, fit.scaling, head).log_prob(y)
            (gradient,) = torch.autograd.grad(value, z)
        return float(value.detach()), gradient.numpy()

    generator = np.random.default_rng(0)
    found = []
    for start in (np.zeros(total), *(0.5 * generator.standard_normal((2, total)))):
        found.append(minimize(energy, start, jac=True, method="L-BFGS-B", options={"maxiter": 60}))
    best = min(found, key=lambda result: float(result.fun))
    return {name: z.detach() for name, z in split(torch.tensor(best.x)).items()}
