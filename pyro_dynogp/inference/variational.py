"""Stochastic variational inference: AutoMultivariateNormal, preconditioned by Laplace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro
import torch
from pyro.distributions import MultivariateNormal
from pyro.infer import SVI, Trace_ELBO
from pyro.infer.autoguide import AutoMultivariateNormal, init_to_value
from pyro.optim import ClippedAdam
from torch import Tensor
from tqdm import tqdm

from pyro_dynogp.inference.guides import GaussianGuide, gaussian_guide
from pyro_dynogp.inference.potential import Potential


class PreconditionedNormal(AutoMultivariateNormal):
    """AutoMultivariateNormal in coordinates in which the posterior is nearly standard normal.

    The latent vector is centre + root x; x has the multivariate normal that is learnt. The family
    is the same, but one learning rate suits all coordinates.
    """

    def __init__(self, model: Any, centre: Tensor, root: Tensor, **kwargs: Any) -> None:
        super().__init__(model, init_scale=1.0, **kwargs)
        self.centre, self.root = centre, root

    def _setup_prototype(self, *args: Any, **kwargs: Any) -> None:
        super()._setup_prototype(*args, **kwargs)
        self.loc = torch.nn.Parameter(torch.zeros_like(self.centre))

    def get_posterior(self, *args: Any, **kwargs: Any) -> MultivariateNormal:
        """Posterior of the unconstrained vector."""
        scale_tril = self.root @ (self.scale[..., None] * self.scale_tril)
        return MultivariateNormal(self.centre + self.root @ self.loc, scale_tril=scale_tril)


@dataclass(frozen=True)
class VariationalPosterior:
    """Result of `variational`.

    Attributes:
        guide: the fitted normal. elbo: (steps,) estimates, one a step.
        message: why the optimisation stopped.
    """

    guide: GaussianGuide
    elbo: np.ndarray
    message: str


def variational(
    model: Any,
    args: tuple[Any, ...],
    values: dict[str, Tensor],
    *,
    steps: int = 1000,
    particles: int = 8,
    learning_rate: float = 0.02,
    progress: bool = False,
) -> VariationalPosterior:
    """Fit a multivariate normal to the posterior by Pyro's SVI, from values near its mode.

    Stops early when the ELBO, averaged over 50 steps, has not risen by 0.05 nats in 200 steps. The
    parameters live in a scope of the parameter store of their own.
    """
    potential = Potential(model, args, values)
    centre, root = (torch.as_tensor(x) for x in potential.laplace(values, widest=2.0))
    start = {name: value.detach() for name, value in potential.unpack(centre).items()}
    guide = PreconditionedNormal(model, centre, root, init_loc_fn=init_to_value(values=start))
    order = [site.name for site in potential.sites]
    elbo: list[float] = []
    message = "all steps used"
    with pyro.get_param_store().scope(), pyro.validation_enabled(False):
        svi = SVI(
            model,
            guide,
            ClippedAdam({"lr": learning_rate, "lrd": 0.1 ** (1.0 / steps), "clip_norm": 10.0}),
            Trace_ELBO(num_particles=particles, vectorize_particles=True, max_plate_nesting=0),
        )
        best, best_step = -np.inf, 0
        bar = tqdm(range(steps), desc="SVI", disable=not progress)
        for step in bar:
            elbo.append(-svi.step(*args))
            if not np.isfinite(elbo[-1]):
                raise ValueError(
                    f"The ELBO became {elbo[-1]} at step {step}. Try a lower learning_rate, or "
                    "start from another optimum (more starts)."
                )
            if (step + 1) % 50 == 0:
                smoothed = float(np.mean(elbo[-50:]))
                bar.set_postfix(elbo=f"{smoothed:.2f}")
                if smoothed > best + 0.05:
                    best, best_step = smoothed, step
                elif step - best_step >= 200:
                    message = "the ELBO no longer rises"
                    break
        names = list(guide._unconstrained_shapes)
        if names != order:
            raise RuntimeError(f"The guide orders the sites {names}, the potential {order}.")
        posterior = guide.get_posterior()
        fitted = gaussian_guide(potential, posterior.loc, posterior.scale_tril)
    return VariationalPosterior(fitted, np.asarray(elbo), message)
