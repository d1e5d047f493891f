"""Inputs times what the dynamics do: columns for tests, and what that does to the poles."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.criticism.posterior_draws import draws_of
from pyro_dynogp.data.channels import Product, prepared
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Parameters, centre_of
from pyro_dynogp.models.feedback_variants import with_products
from pyro_dynogp.models.product import factors
from pyro_dynogp.models.selection import signal_of
from pyro_dynogp.models.system import DynamicSystem
from pyro_dynogp.models.variants import Model, with_channels
from pyro_dynogp.models.wiring import HIDDEN, Wire
from pyro_dynogp.statistics.pictures import labelled
from pyro_dynogp.statistics.responses import standardised

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

# Around a mode.
DRAWS = 200
# Of which products by twos are made: six of four.
MOST_INPUTS = 4
# Low and high values of an input, as quantiles of the record.
ENDS = {"low": 0.02, "high": 0.98}


def products(inputs: np.ndarray, signal: np.ndarray) -> list[np.ndarray]:
    """Products (n, c) of each input (n, n_u), standardised, with a signal (n,) less its mean.

    Each by itself, and next to its products with the other inputs, where there are few.
    """
    given = standardised(inputs)
    alone = [u[:, None] * (signal - signal.mean())[:, None] for u in given.T]
    if not 2 <= given.shape[1] <= MOST_INPUTS:
        return alone
    others = [np.delete(given, place, axis=1) for place in range(given.shape[1])]
    mixed = [u[:, None] * other for u, other in zip(given.T, others, strict=True)]
    return [*alone, *(np.column_stack(pair) for pair in zip(alone, mixed, strict=True))]


def with_products_of_inputs(model: Model, record: Record) -> Model | None:
    """The model with products of inputs with the output that act back, and of inputs by twos.

    What flows carries heat in as well as out: flow times the difference of two temperatures. None
    where there are no two inputs, or too many, and where the model has no such products.
    """
    names = record.input_names
    extended = with_products(model)
    if extended is None or not 2 <= len(names) <= MOST_INPUTS:
        return None
    both = [
        Product(one, other, centre_of(record, one), centre_of(record, other))
        for one, other in itertools.combinations(names, 2)
    ]
    new = [channel for channel in both if channel not in model.channels]
    return with_channels(extended, new) if new else None


def dominant_rates(fit: Fit, fed: Wire, record: Record) -> Parameters:
    """Decay rate of the dominant mode where an input is low and where it is high [1 / time unit].

    With an input held at u, x' = A x + u F C x has the poles that are eigenvalues of A + u F C. The
    dominant mode is that which makes most of the steady response of C x to what comes through F:
    where the record is silent of others they are anywhere. Mean and standard deviation by the
    fit's draws; of the input that makes the largest difference, others at their mean.

    Args:
        fit: of a model whose dynamics get products alone back. fed: the layer that gets them.
        record: whose inputs are low and high, without the model's channels.
    """
    known = fit.draws
    if fit.method == "map":  # a mode has none
        known = draws_of(fit, count=DRAWS, seed=0, anneal=False).values
    system, scaling = fit.system_at(known), fit.scaling
    dynamic, (back,) = system.layer(fed.name), fed.feedback
    product = next(wire for wire in fit.model.wires if wire.name == back)
    assert isinstance(dynamic, DynamicSystem)
    inputs = factors(product.layer)
    hidden = signal_of(product.sources[-1]).endswith(HIDDEN)
    count = len(scaling.output_names)
    C = dynamic.modes.C if dynamic.modes.several_outputs else dynamic.modes.C.unsqueeze(-2)
    C = C[..., count:, :] if hidden else C[..., :count, :]
    F = dynamic.modes.B[..., fed.channels :]
    F = F.reshape(*F.shape[:-1], inputs, -1)
    poles = dynamic.modes.poles
    given = prepared(record, fit.model.channels).inputs
    products_of = (one for one in fit.model.channels if isinstance(one, Product))
    made = {name for one in products_of for name in one.names}
    found: list[tuple[float, Parameters]] = []
    for place, name in enumerate(scaling.input_names[:inputs]):
        if name in made:  # of the inputs that it multiplies
            continue
        at = np.quantile(given[:, place], list(ENDS.values()))
        low, high = (
            _dominant(poles, F[..., place, :], C, float(u))
            for u in (at - scaling.input_offset[place]) / scaling.input_scale[place]
        )
        whose = "decay rate of the dominant mode at {} " + name
        unit = f"1/{scaling.time_unit}"
        numbers = {
            labelled(whose.format(end), unit): (float(rate.mean()), float(rate.std()))
            for end, rate in zip(ENDS, (low, high), strict=True)
        }
        found.append((abs(float((high - low).mean())), numbers))
    return max(found, key=lambda one: one[0])[1]


def _dominant(poles: Tensor, F: Tensor, C: Tensor, u: float) -> np.ndarray:
    """Decay rate (b,) with poles (b, P) and u F (b, P, j) of products of outputs by C (b, j, P).

    The states are those of the poles and of their conjugates.
    """
    F, C = torch.cat([F, F.conj()], -2), torch.cat([C, C.conj()], -1)
    roots, V = torch.linalg.eig(torch.diag_embed(torch.cat([poles, poles.conj()], -1)) + u * F @ C)
    there, back = (C @ V).abs().square().sum(-2), torch.linalg.solve(V, F).abs().square().sum(-1)
    most = ((there * back).sqrt() / roots.abs()).argmax(-1, keepdim=True)
    rates: np.ndarray = -roots.real.gather(-1, most).squeeze(-1).numpy()
    return rates
