"""A guide that runs the model itself, a variational family in the place of each latent site."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from pyro.infer.autoguide.initialization import InitMessenger
from pyro.ops.tensor_utils import periodic_repeat
from pyro.poutine.trace_messenger import TraceMessenger
from pyro.poutine.util import prune_subsample_sites, site_is_subsample
from torch import Tensor

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.guides.coordinates import joint_normal, middle, to_support, unconstrained
from pyro_dynogp.guides.families import Family, default_family
from pyro_dynogp.guides.normal import PlacedDelta
from pyro_dynogp.support.errors import RULES, instance, invalid
from pyro_dynogp.support.tensors import as_tensor, broadcast

# The auxiliary site of the joint normal, and the prefix of its parameters.
JOINT = "_joint"

Choice = Callable[[str, Any], Family]


@dataclass(frozen=True)
class _Part:
    """The place of one site in the vector of the joint normal."""

    start: int
    stop: int
    shape: torch.Size  # unconstrained, with the dimensions of its plates


class LayerGuide:
    """Guide of a model: every latent site gets the posterior that its family makes of its prior.

    The guide runs the model, so that a family sees each site's prior given all sites drawn before
    it. That is what makes posteriors such as a trajectory given pseudo-observations possible, whose
    prior depends on sampled hyperparameters. Sites with data, factors and deterministic values are
    computed but not seen from outside, and do not count.

    Use it as any guide: in SVI, with `poutine.trace`, in `Predictive(model, guide=guide)`, with
    vectorised particles. Parameters are created by the first call in the parameter store in scope;
    names start with the site's. The sites are those of the first call.

    Args:
        model: a Pyro function.
        families: a `Family` for each latent site named.
        default: family of all other sites, or a function (name, prior) -> Family. By default
            `GaussMarkov` for an `LTIProcess` and `MeanField` for everything else.
        values: starting values of sites, of their shape; for trajectories the first
            pseudo-observations. By default the prior's mean (or median).
        joint: sites that share one multivariate normal in unconstrained coordinates: their names;
            a function (name, prior) -> bool; or True, every site without a family of its own but
            trajectories. It is drawn first, at the auxiliary site ``_joint``.
        joint_scale: first standard deviation of the joint normal.
        observed: names of sites that hold data, needed only if the first call has none: sites with
            data are recognised then, and stay no business of the guide in calls without.

    Raises:
        ValueError: when first called, for names that are no latent sites, and families or starting
            values that do not fit their sites.

    Examples:
        >>> def model():
        ...     pyro.sample("x", dist.Normal(torch.zeros(3).double(), 1.0).to_event(1))
        >>> guide = dgp.LayerGuide(model, {"x": dgp.guides.MeanField()})
        >>> guide()["x"].shape
        torch.Size([3])
    """

    def __init__(
        self,
        model: Callable[..., Any],
        families: Mapping[str, Family] | None = None,
        default: Family | Choice = default_family,
        *,
        values: Mapping[str, Any] | None = None,
        joint: Sequence[str] | bool | Callable[[str, Any], bool] = (),
        joint_scale: float = 0.05,
        observed: Sequence[str] = (),
    ) -> None:
        if not callable(model):
            raise invalid("model", expected="a Pyro model", got=type(model).__name__)
        for name, family in (families or {}).items() if isinstance(families, Mapping) else ():
            instance(f"families[{name!r}]", family, Family)
        if families is not None:
            instance("families", families, Mapping)
        RULES["joint_scale"].check("joint_scale", joint_scale)
        self.model = model
        self.given, self.default = dict(families or {}), default
        self.values = {name: as_tensor(x) for name, x in (values or {}).items()}
        if isinstance(joint, str):
            raise invalid("joint", expected="names of several sites", got=repr(joint))
        self.joint, self.joint_scale = joint, joint_scale
        self.observed = set(observed)
        both = set(self.given) & set(() if isinstance(joint, bool) or callable(joint) else joint)
        if both:
            raise invalid(
                "joint", expected="sites without a family of their own", got=str(sorted(both))
            )
        self.families: dict[str, Family] = {}
        self._parts: dict[str, _Part] = {}
        self._joint_start: Tensor | None = None
        self._ready = False

    def __call__(self, *args: Any, **kwargs: Any) -> dict[str, Tensor]:
        """Draw every latent site; returns their values by name."""
        handler = SinglePass(self)
        with poutine.block(hide_fn=self._hidden):
            return handler(*args, **kwargs)

    def single_pass(self) -> SinglePass:
        """The same guide for an ELBO that runs the model once a step instead of twice.

        ``SVI(model, guide.single_pass(), ...)`` takes the densities of the model from the guide's
        own run of it. The model given to SVI is then not used at all: handlers (scale, condition)
        have to be around the model that the guide was made with.
        """
        return SinglePass(self)

    def _hidden(self, msg: Any) -> bool:
        if msg["type"] != "sample" or site_is_subsample(msg):
            return False
        return bool(msg["is_observed"]) or msg["name"] in self.observed

    # The first run

    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Find the sites, choose their families and starting values; done by the first call."""
        if self._ready:
            return
        joint: list[str] = []

        def initial(msg: Any) -> Tensor:
            name, prior = msg["name"], msg["fn"]
            if name in self.observed:
                return prior.sample()
            if self._is_joint(name, prior):
                joint.append(name)
                return self._first(name, prior, None)
            family = self._choose(name, prior)
            self.families[name] = family
            return self._first(name, prior, family.start)

        # What the model does here is nobody else's business: no particles, no outer trace.
        with poutine.block(), torch.no_grad(), InitMessenger(initial):
            trace = poutine.trace(self.model).get_trace(*args, **kwargs)
        sites = {n: s for n, s in trace.nodes.items() if s["type"] == "sample"}
        latent = {n: s for n, s in sites.items() if n in joint or n in self.families}
        wanted = {"families": set(self.given), "values": set(self.values)}
        if not (isinstance(self.joint, bool) or callable(self.joint)):
            wanted["joint"] = set(self.joint)
        for argument, names in wanted.items():
            if names - set(latent):
                raise invalid(
                    argument,
                    expected=f"names of latent sites of the model, {list(latent)}",
                    got=str(sorted(names - set(latent))),
                )
        for name, family in self.families.items():
            self.families[name] = _started(family, name, latent[name])
        self._lay_out({name: latent[name] for name in joint})
        self.observed |= {n for n, s in sites.items() if s["is_observed"]}
        self._ready = True

    def _is_joint(self, name: str, prior: dist.TorchDistribution) -> bool:
        if name in self.given:
            return False
        if isinstance(self.joint, bool):
            return self.joint and not isinstance(prior, LTIProcess)
        return bool(self.joint(name, prior)) if callable(self.joint) else name in self.joint

    def _choose(self, name: str, prior: dist.TorchDistribution) -> Family:
        family = self.given.get(name)
        if family is None:
            default = self.default
            family = default if isinstance(default, Family) else default(name, prior)
        if not isinstance(family, Family):
            raise invalid(f"family of site '{name}'", expected="a Family", got=repr(family))
        return family

    def _first(self, name: str, prior: dist.TorchDistribution, own: Tensor | None) -> Tensor:
        value = self.values.get(name) if own is None else own
        standard = middle(prior)
        if value is None:
            return standard
        shape = prior.batch_shape + prior.event_shape
        where = f"starting value of site '{name}'"
        try:
            value = value.to(standard).expand(shape).detach()
        except RuntimeError as error:
            raise invalid(
                where, expected=f"shape {tuple(shape)}", got=f"shape {tuple(value.shape)}"
            ) from error
        if not bool(prior.support.check(value).all()):
            raise invalid(where, expected=f"values in {prior.support}", got="others")
        return value

    def _lay_out(self, sites: Mapping[str, Any]) -> None:
        """Give every site of the joint normal its place."""
        at, starts = 0, []
        for name, site in sites.items():
            if any(f.full_size not in (None, f.size) for f in site["cond_indep_stack"]):
                raise invalid(
                    "joint", expected="sites in plates that are not subsampled", got=repr(name)
                )
            z = unconstrained(name, site["fn"], site["value"])
            self._parts[name] = _Part(at, at + z.numel(), z.shape)
            at += z.numel()
            starts.append(z.reshape(-1))
        if starts:
            self._joint_start = torch.cat(starts)

    # Every run

    def run(self, *args: Any, **kwargs: Any) -> None:
        """Draw the joint normal, then run the model."""
        if self._joint_start is not None:
            normal = joint_normal(JOINT, self._joint_start, self.joint_scale)
            pyro.sample(JOINT, normal, infer={"is_auxiliary": True})
        self.model(*args, **kwargs)

    def posterior(self, name: str, prior: dist.TorchDistribution, joint: Tensor | None) -> Any:
        """Posterior of one site, given the joint vector (*particles, d)."""
        part = self._parts.get(name)
        if part is not None and joint is not None:
            return _placed(name, prior, part, joint)
        family = self.families.get(name)
        if family is None:
            raise invalid(
                f"site '{name}'",
                expected=f"one of the latent sites of the first call, {list(self.families)}",
                got="a new one",
                advice="Make a new LayerGuide, or name it in `observed` if it holds data.",
            )
        return family.posterior(name, prior)


class SinglePass(TraceMessenger):
    """Handler that replaces the sites of a model; as a Pyro guide it yields both traces at once."""

    def __init__(self, guide: LayerGuide) -> None:
        super().__init__()
        self.guide = guide
        self.priors: dict[str, Any] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> dict[str, Tensor]:
        """Draw every latent site; returns their values by name."""
        self.guide.prepare(*args, **kwargs)
        self.priors = {}
        with self:
            self.guide.run(*args, **kwargs)
        return {name: self.trace.nodes[name]["value"] for name in self.priors}

    def _pyro_sample(self, msg: Any) -> None:
        name, prior = msg["name"], msg["fn"]
        if name == JOINT or site_is_subsample(msg) or self.guide._hidden(msg):
            return
        joint = self.trace.nodes[JOINT]["value"] if JOINT in self.trace.nodes else None
        posterior = self.guide.posterior(name, prior, joint)
        batch = broadcast(prior.batch_shape, posterior.batch_shape)
        self.priors[name] = prior
        msg["fn"] = posterior if posterior.batch_shape == batch else posterior.expand(batch)

    def get_traces(self) -> tuple[Any, Any]:
        """Traces of model and guide of the last run."""
        both = prune_subsample_sites(self.trace)
        model, guide = both.copy(), both.copy()
        for name, site in both.nodes.items():
            if name not in self.priors:
                if name == JOINT:
                    del model.nodes[name]
                else:
                    del guide.nodes[name]
                continue
            prior, batch = self.priors[name], site["fn"].batch_shape
            prior = prior if prior.batch_shape == batch else prior.expand(batch)
            model.nodes[name] = {**site, "fn": prior}
        return model, guide


def _started(family: Family, name: str, site: Any) -> Family:
    """The family with the site's starting value, repeated where plates are subsampled."""
    prior = site["fn"]
    family = family.started(name, prior, site["value"].detach())
    at = getattr(family, "at", None)
    if at is None:
        return family
    event_dim = at.dim() - len(prior.batch_shape)
    for frame in site["cond_indep_stack"]:
        if frame.vectorized and frame.full_size not in (None, frame.size):
            at = periodic_repeat(at, frame.full_size, frame.dim - event_dim).contiguous()
    return replace(cast(Any, family), at=at.detach())


def _placed(name: str, prior: dist.TorchDistribution, part: _Part, joint: Tensor) -> dist.Delta:
    """The site's value, computed from its part of the joint vector (*particles, d)."""
    transform = to_support(name, prior)
    ones = torch.Size([1] * transform.domain.event_dim)
    shape = broadcast(part.shape, joint.shape[:-1] + ones)
    z = joint[..., part.start : part.stop].reshape(shape)
    value = transform(z)
    jacobian = transform.log_abs_det_jacobian(z, value)
    return PlacedDelta(value, log_density=-jacobian, event_dim=prior.event_dim)
