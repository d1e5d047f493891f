r"""A problem in units, and an order of channels, that do not depend on those of the record.

Climbs of models with functions have several ends, and amplify rounding until it decides among them.
Volts and millivolts, or exchanged channels, round differently. Such a model is therefore fitted to
signals in standard deviations, rounded to `DIGITS` digits, with channels from the smoothest to the
roughest: the same numbers to the bit however the record states them. What is found is then put
back. Sites are in standard deviations in any case; with N_k measured samples of output k, whose
scale is s_k,

    log p(y) = log p(y / s) - sum_k N_k log s_k.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.density import Potential, parts
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.posteriors import Posterior, Sampled
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord, as_measured
from pyro_dynogp.models.selection import place_of
from pyro_dynogp.models.wiring import INPUTS, Known, Wire
from pyro_dynogp.support.frozen import FrozenMapping

# Digits after the point to which signals are rounded, in standard deviations. Rounding in other
# units differs by some 1e-16: about one number in a million ends at another digit.
DIGITS = 9


@dataclass(frozen=True, eq=False)
class Canonical:
    """A problem, and the same in canonical form.

    Attributes:
        given: as it is stated. problem: what is fitted; `given` where there is no canonical form.
        inputs, outputs: places in `given` of the channels of `problem`.
    """

    given: Problem
    problem: Problem
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]

    @classmethod
    def of(cls, given: Problem) -> Canonical:
        """The canonical form of models with functions that know no units or places of channels.

        Others, and those that start from another fit, stay as they are stated.
        """
        model, scaling = given.model, given.scaling
        if not model.has_function or given.learnt is not None or not _free(model):
            each = tuple(range(len(scaling.input_scale))), tuple(range(len(scaling.output_scale)))
            return cls(given, given, *each)
        driving = model.inputs - model.direct
        inputs = tuple(sorted(scaling.input_order, key=lambda place: place >= driving))
        outputs = scaling.output_order
        units = _scaling(scaling, inputs, outputs)
        records = tuple(_record(record, units, inputs, outputs) for record in given.records)
        problem = Problem(replace(model, scaling=units), records)
        return cls(given, problem, inputs, outputs)

    def restored(self, fit: Fitted) -> Fitted:
        """A fit of the canonical problem as one of the given one."""
        if self.problem is self.given:
            return fit
        more = self._log_scales
        diagnostics = dict(fit.diagnostics)
        if "elbo" in diagnostics:
            diagnostics["elbo"] -= more
        return replace(
            fit,
            model=self.given.model,
            posterior=self._posterior(fit.posterior),
            draws=self.values(fit.draws),
            mode=self.values(fit.mode),
            history=fit.history - more if fit.method == "svi" else fit.history + more,
            start_energies=fit.start_energies + more,
            diagnostics=FrozenMapping(diagnostics),
            records=as_measured(self.given.records),
        )

    def values(self, values: Mapping[str, Tensor]) -> FrozenMapping[str, Tensor]:
        """Values (*s, *shape) of sites of the canonical problem, in the order of the given one."""
        sites = self.given.target.all_sites(self.given.scaling, len(self.given.records))
        dims = {site.name: site.dims for site in sites}
        return FrozenMapping({
            name: value if name not in dims else self._placed(value, dims[name])
            for name, value in values.items()
        })  # fmt: skip

    def _placed(self, value: Tensor, dims: Sequence[str]) -> Tensor:
        """A value (*s, *shape) whose last dimensions have these names."""
        for axis, dim in enumerate(reversed(dims), start=1):
            places = self._places.get(dim)
            if places is not None:
                value = value.index_select(-axis, places)
        return value

    @cached_property
    def _places(self) -> dict[str, Tensor]:
        """By name of a dimension: where each of its entries is in the canonical problem.

        Signals that are as many as outputs go by the outputs, as in `order_of_signals`; others keep
        their places.
        """
        model = self.given.model
        driving = model.inputs - model.direct
        inputs, outputs = _inverse(self.inputs), _inverse(self.outputs)
        widths = {name: n for wire in model.wires for name, n in wire.signals.items()}
        signals = {
            name: outputs if n == len(outputs) else list(range(n)) for name, n in widths.items()
        }
        signals[INPUTS] = inputs[:driving]

        def joined(names: Sequence[str]) -> Tensor:
            found: list[int] = []
            for name in names:
                found += [len(found) + place for place in signals[name]]
            return torch.tensor(found)

        places = {"input": joined((INPUTS,)), "output": torch.tensor(outputs)}
        places["direct input"] = torch.tensor([place - driving for place in inputs[driving:]])
        for wire in model.wires:
            places[f"{wire.name}_input"] = joined((*wire.sources, *wire.feedback))
            places[f"{wire.name}_forward"] = joined(wire.sources)
            places[f"{wire.name}_output"] = joined(tuple(wire.signals))
        for wire, layer in model.dynamic:
            pairs, levels = torch.arange(layer.pairs), torch.arange(0)
            if layer.integrators:  # one of each output, between real and imaginary parts of pairs
                levels = layer.pairs + torch.tensor(signals[wire.name])
            imaginary = layer.pairs + len(levels) + pairs
            places[wire.dims["state"]] = torch.cat(
                [pairs, levels] if layer.real else [pairs, levels, imaginary]
            )
        return {dim: own for dim, own in places.items() if len(own)}

    @property
    def _log_scales(self) -> float:
        """Sum of log s_k over all measured samples [nats]."""
        logs = np.log(self.given.scaling.output_scale)
        records = as_measured(self.given.records)
        return float(sum((~record.missing).sum(0) @ logs for record in records))

    def _posterior(self, posterior: Posterior) -> Posterior:
        if isinstance(posterior, Sampled):
            source = posterior.source
            if source is not None:
                log_p = None if source.log_p is None else source.log_p - self._log_scales
                source = replace(source, values=self.values(source.values), log_p=log_p)
            return replace(posterior, values=self.values(posterior.values), source=source)
        points = self.values(posterior.points)
        if not posterior.sites:
            return replace(posterior, points=points)
        start = {**{name: x[0] for name, x in points.items()}, **self.values(posterior.centres[0])}
        potential = Potential(self.given.target, (self.given.records,), start)
        names = {site.name for site in posterior.sites}
        sites = tuple(site for site in potential.sites if site.name in names)
        entries = torch.arange(posterior.loc.shape[-1])
        by_name = {site.name: part for site, part in parts(posterior.sites, entries)}
        placed = self.values(by_name)
        order = torch.cat([placed[site.name].reshape(-1) for site in sites])
        return replace(
            posterior,
            points=points,
            loc=posterior.loc[:, order],
            scale_tril=_triangular(posterior.scale_tril[:, order]),
            sites=sites,
        )


def _free(model: Model) -> bool:
    """Whether nothing in a model is stated in units of the record or by the place of a channel."""
    return not model.late and all(_free_layer(wire) for wire in model.wires)


def _free_layer(wire: Wire) -> bool:
    layer = wire.layer
    if any(place_of(source) is not None for source in wire.sources):
        return False
    if isinstance(layer, Known):
        return layer.scaled and wire.channels == 1
    kernel, limits = getattr(layer, "kernel", None), getattr(layer, "limits", None)
    return limits is None and (kernel is None or wire.channels == 1)


def _scaling(scaling: Scaling, inputs: Sequence[int], outputs: Sequence[int]) -> Scaling:
    """That of signals in standard deviations, in a given order."""

    def names(given: Sequence[str], order: Sequence[int]) -> tuple[str, ...]:
        return tuple(given[place] for place in order)

    return Scaling(
        time_step=scaling.time_step,
        duration=scaling.duration,
        input_offset=np.zeros(len(inputs)),
        input_scale=np.ones(len(inputs)),
        output_offset=np.zeros(len(outputs)),
        output_scale=np.ones(len(outputs)),
        input_names=names(scaling.input_names, inputs),
        output_names=names(scaling.output_names, outputs),
        input_units=("",) * len(inputs),
        output_units=("",) * len(outputs),
        time_unit=scaling.time_unit,
        reference_output=list(outputs).index(scaling.reference_output),
    )


def _record(
    given: PreparedRecord, units: Scaling, inputs: Sequence[int], outputs: Sequence[int]
) -> PreparedRecord:
    """A record in standard deviations, rounded."""
    record = given.record
    scaled = Record(
        record.time,
        np.round(given.scaled_inputs.numpy()[:, inputs], DIGITS),
        np.round(given.scaled_outputs.numpy()[:, outputs], DIGITS),
        input_names=units.input_names,
        output_names=units.output_names,
        time_unit=record.time_unit,
        start=record.start,
        name=record.name,
    )
    return PreparedRecord.of(scaled, units)


def _inverse(places: Sequence[int]) -> list[int]:
    return [int(place) for place in np.argsort(places)]


def _triangular(root: Tensor) -> Tensor:
    """Lower triangular root (K, d, d), of a positive diagonal, of what is `root` root^T."""
    upper = torch.linalg.qr(root.mT).R
    return (upper * upper.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-1)).mT
