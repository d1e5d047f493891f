"""Non-centred form of a trajectory: the sample site becomes its standard normal innovations."""

from __future__ import annotations

from typing import Any

import pyro
import pyro.distributions as dist
import torch
from pyro.infer.reparam.reparam import Reparam

from pyro_dynogp.distributions.trajectory import Trajectory
from pyro_dynogp.support.errors import invalid


class InnovationReparam(Reparam):
    """Replace a latent `LTIProcess` site by standard normal innovations.

    The trajectory is m + L D^{1/2} e with e ~ N(0, I) at the new site ``<name>_innovations``; its
    value is exact for any hyperparameters, and the posterior of e is far better conditioned for
    NUTS than that of the trajectory. Use it as
    ``pyro.poutine.reparam(model, config={"g": InnovationReparam()})``.

    Examples:
        >>> modes = dgp.Modes([-1.0 + 2.0j], [[1.0 + 0.0j]], [0.5 + 0.0j], [[0.3 + 0.0j]])
        >>> def model():
        ...     pyro.sample("g", dgp.LTIProcess(modes, [0.0, 0.1], [[1.0], [0.0]]))
        >>> standard = pyro.poutine.reparam(model, config={"g": dgp.InnovationReparam()})
        >>> "g_innovations" in pyro.poutine.trace(standard).get_trace().nodes
        True
    """

    def apply(self, msg: Any) -> Any:
        """Rewrite one sample message (called by Pyro)."""
        fn, event_dim = self._unwrap(msg["fn"])
        where = f"InnovationReparam for site '{msg['name']}'"
        if not isinstance(fn, Trajectory) or not fn.has_innovations:
            raise invalid(where, expected="an LTIProcess", got=type(fn).__name__)
        if msg["is_observed"]:
            raise invalid(
                where,
                expected="a latent site",
                got="an observed one",
                advice="Condition the model on the innovations, or condition without the reparam.",
            )
        value = msg["value"]
        noise = None if value is None else fn.to_innovations(value)
        zero = torch.zeros((), dtype=torch.float64, device=fn.modes.poles.device)
        shape = fn.batch_shape + fn.event_shape
        noise = pyro.sample(
            f"{msg['name']}_innovations",
            dist.Normal(zero, zero + 1.0).expand(shape).to_event(event_dim),
            obs=noise,
            infer={"is_observed": False},
        )
        if value is None:
            value = fn.from_innovations(noise)
        return {
            "fn": dist.Delta(value, event_dim=event_dim).mask(False),
            "value": value,
            "is_observed": True,
        }
