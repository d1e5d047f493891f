r"""Coordinates in which a posterior has no bent ridges, for samplers and for normals around a mode.

Some parameters make up for each other along curves that no mass matrix straightens:

- the size of a signal g = G u + ... and everything in a static function f(g) that is measured in
  units of it (lengthscale, grid of inducing locations), with the process noise. Here the largest
  gain is a logarithm, s = log |G_r|, and the others are relative to it, G_k / G_r; so are the
  function's numbers and the noise. Along s alone the likelihood is constant.
- the whitened inducing values v, their locations and the kernel's parameters. What the data say is
  about the function where the signal is, and only in some directions; elsewhere the prior of v
  rules. The coordinates are standardised values of v given the other parameters, by a likelihood
  that is quadratic in the function's values. (Of these and v each would serve one of the two;
  Papaspiliopoulos, Roberts & Skold 2007.)
- in models without static functions the scale of a pair's noise gains and the gains in units of it:
  the data know their product, or nothing where the pair has no noise. The same standardised values
  serve there.

The sign of G_r stays that of the start: with gains of the other sign, and all functions of g turned
about zero, prior and likelihood are the same, so that nothing is lost but a mirror image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy

import torch
from torch import Tensor

from pyro_dynogp.inference.cascade_coordinate_steps import (
    Affine,
    GivenOthers,
    Parts,
    RelativeToGain,
    Step,
    affine,
)
from pyro_dynogp.inference.density import Potential, Site, parts
from pyro_dynogp.layers.functions import StaticFunction
from pyro_dynogp.layers.sites import Arguments, Program
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.wiring import Dynamic, Static, Wire

# Directions of v of which the data say less than this share of what its prior says count as unseen.
LEAST = 0.1


class StraightPotential(Potential):
    """A model's `Potential` in the coordinates of this module; trajectories integrated out."""

    nearly_normal = True

    def __init__(self, model: Model, args: Arguments, values: Mapping[str, Tensor]) -> None:
        super().__init__(model, args, values)
        self.steps = steps_of(model, Potential(model, args, values))

    def on(self, args: Arguments) -> StraightPotential:
        """The density of other data in the same coordinates."""
        other = copy(self)
        Potential.__init__(other, self.model, args, self.at)
        return other

    def pack(self, values: Mapping[str, Tensor]) -> Tensor:
        """Constrained values (*s, *shape) of every site to coordinates (*s, d)."""
        plain = super().pack(values)
        z = by_name(self.sites, plain)
        with torch.no_grad():
            for step in reversed(self.steps):
                step.backward(z)
        lead = plain.shape[:-1]
        return torch.cat([z[site.name].reshape(*lead, -1) for site in self.sites], -1)

    def unpack(self, x: Tensor) -> dict[str, Tensor]:
        """Coordinates (*s, d) to constrained values (*s, *shape) of every site."""
        return super().unpack(self._unconstrained(x)[0])

    def log_jacobian(self, z: Tensor) -> Tensor:
        """Log |d values / dz| (*s) at coordinates z (*s, d)."""
        plain, log_det = self._unconstrained(z)
        return super().log_jacobian(plain) + log_det

    def energy(self, z: Tensor, *, jacobian: bool) -> Tensor:
        """-log density at z (d,): of the values, or with `jacobian` of the coordinates."""
        plain, log_det = self._unconstrained(z)
        energy = super().energy(plain, jacobian=jacobian)
        return energy - log_det if jacobian else energy

    def _unconstrained(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Unconstrained vectors (*s, d), and log |det dz/dx| (*s)."""
        z = by_name(self.sites, x)
        log_det = torch.zeros(x.shape[:-1], dtype=x.dtype)
        for step in self.steps:
            log_det = log_det + step.forward(z)
        flat = [z[site.name].reshape(*x.shape[:-1], -1) for site in self.sites]
        return torch.cat(flat, -1), log_det


def by_name(sites: Sequence[Site], z: Tensor) -> Parts:
    """The parts (*s, *unconstrained) of vectors z (*s, d)."""
    return {site.name: part for site, part in parts(sites, z)}


def potential_for_sampling(
    model: Program, args: Arguments, values: Mapping[str, Tensor]
) -> Potential:
    """The potential of a model in the coordinates that chains are best run in."""
    if isinstance(model, Model) and model.has_function and model.integrate == "all":
        return StraightPotential(model, args, values)
    return Potential(model, args, values)


def steps_of(model: Model, plain: Potential) -> list[Step]:
    """The changes of coordinates that a model's layers ask for, in the order of `forward`."""
    named = {site.name: site for site in plain.sites}
    if not model.has_function:
        units = {wire.name: f"{wire.name}_noise_gain_unit" for wire in model.wires}
        return [
            given_others(unit, plain, _noise_gains(name), rank=3)
            for name, unit in units.items()
            if unit in named and not _is_exponential(named[unit])
        ]
    sizes: dict[str, RelativeToGain] = {}
    for one in model.wires:
        if isinstance(one.layer, Dynamic) and f"{one.name}_input_gain" in named:
            readers = [other for other in model.wires if one.name in other.reads]
            if one.layer.width == 1 and len(readers) == 1:
                found = _relative(one, readers[0], named, plain.at)
                if found is not None:
                    sizes[readers[0].name] = found
    steps: list[Step] = list(sizes.values())
    for one in model.wires:
        if isinstance(one.layer, Static):
            layer = _layer(model, one, one.layer, plain, sizes.get(one.name))
            steps.append(given_others(f"{one.name}_values", plain, layer))
    return steps


def _relative(
    one: Wire, reader: Wire, sites: Mapping[str, Site], values: Mapping[str, Tensor]
) -> RelativeToGain | None:
    """For a signal that one static layer of one channel reads, and nothing else."""
    along = [f"{reader.name}_{part}" for part in ("lengthscale", "half_width", "center")]
    alone = isinstance(reader.layer, Static) and reader.sources == (one.name,)
    # A linear mean is not symmetric, and other kernels or locations have other sites.
    if not alone or f"{reader.name}_slope" in sites or not all(name in sites for name in along):
        return None
    if not all(_is_exponential(sites[name]) for name in along[:2]):
        return None
    gains = [f"{one.name}_{part}" for part in ("input_gain", "feedthrough")]
    gains = [name for name in gains if name in sites]
    start = torch.cat([values[name].detach().reshape(-1) for name in gains])
    place = int(start.abs().argmax())
    if float(start[place]) == 0.0:
        return None
    local, unit = f"{one.name}_noise_gain_local_scale", f"{one.name}_noise_gain_unit"
    noisy = local in sites
    return RelativeToGain(
        tuple(gains),
        place,
        1.0 if float(start[place]) > 0.0 else -1.0,
        tuple(along[:2]),
        tuple(along[2:]),
        local if noisy else None,
        unit,
        noisy and _is_exponential(sites[unit]),
    )


def _is_exponential(site: Site) -> bool:
    """Whether the site's unconstrained value is its logarithm, however the transform is put."""
    probe = torch.linspace(-1.0, 2.0, max(site.unconstrained.numel(), 1), dtype=torch.float64)
    z = probe[: site.unconstrained.numel()].reshape(site.unconstrained)
    return z.shape == site.shape and torch.allclose(site.transform(z), z.exp())


def _layer(
    model: Model, one: Wire, layer: Static, plain: Potential, relative: RelativeToGain | None
) -> Affine:
    """Mean values of a static function by its inducing values.

    The points are the inducing locations at the start, in units of the signal's size.
    """
    own = [site for site in plain.sites if site.name.startswith(f"{one.name}_")]

    def function(z: Parts) -> StaticFunction:
        given = {site.name: site.transform(z[site.name]) for site in own}
        return model.static_function(one, layer, given)

    start = by_name(plain.sites, plain.pack(plain.at))
    fixed = function(start).locations.detach()
    if relative is not None:
        fixed = fixed / relative.size(start)

    def at(z: Parts) -> tuple[Tensor, Tensor]:
        points = fixed if relative is None else fixed * relative.size(z)[..., None, None]
        return affine(function(z), points)

    return at


def _noise_gains(name: str) -> Affine:
    """Noise gains of a dynamic layer, up to a factor, by those in units of their pair's scale."""

    def at(z: Parts) -> tuple[Tensor, Tensor]:
        scale = z[f"{name}_noise_gain_local_scale"].exp()  # (*s, P)
        unit = z[f"{name}_noise_gain_unit"]
        each = scale[..., None, None].expand_as(unit).flatten(-3)
        return torch.zeros_like(each), torch.diag_embed(each)

    return at


def given_others(name: str, plain: Potential, layer: Affine, rank: int = 2) -> Step:
    """The coordinates of one site, see `GivenOthers`, from derivatives at the start."""
    z = plain.pack(plain.at)
    own = by_name(plain.sites, torch.arange(plain.size))[name].flatten().tolist()
    hessian = plain.hessian_of(z.numpy(), own)
    gradient = plain.value_and_gradient(z.numpy(), jacobian=True)[1][own]
    v = z[own]
    # The prior of v is standard normal; the rest of the energy is the likelihood's.
    eigenvalues, vectors = torch.linalg.eigh(torch.tensor(hessian) - torch.eye(len(v)))
    known = torch.where(eigenvalues > LEAST, eigenvalues, 0.0)
    by_v = (vectors * known) @ vectors.mT
    linear = v - torch.tensor(gradient) + by_v @ v
    linear = vectors @ (torch.where(known > 0.0, 1.0, 0.0) * (vectors.mT @ linear))
    with torch.no_grad():
        mean, W = layer(by_name(plain.sites, z))
        back = torch.linalg.inv(W)
    precision = back.mT @ by_v @ back
    return GivenOthers(name, layer, precision, back.mT @ linear + precision @ mean, rank)
