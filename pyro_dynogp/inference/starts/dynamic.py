"""Starting values of one dynamic layer: a linear fit's, or its input passed on."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from pyro_dynogp.data.scaling import Scaling, TimeScale
from pyro_dynogp.inference.starts.poles import WALKS, random_poles
from pyro_dynogp.layers.functions import in_place
from pyro_dynogp.models.arrival import prompt_columns
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.wiring import INPUTS, Dynamic, Known, Wire
from pyro_dynogp.support.tensors import at_places

Values = dict[str, Tensor]
# Size of gains that are there to be learnt.
SMALL = 0.05
# Size of gains of signals beside the first, and of hidden ones beside what they begin as.
OTHERS, AROUND = 0.7, 0.3
# Sites of integrators, a row for each output.
INTEGRATORS = ("integrator_gain", "integrator_drift", "integrator_noise")
# Standard deviation of the logarithms by which poles are moved for a layer beside another.
MOVED = 0.5
# Of layers with real poles: the share of a level's decay that is not by feedback, and standard
# deviations of the logarithms of rates and gains.
UNFED, RATES, GAINS = 0.5, 0.5, 0.3


def with_late_inputs(direct: Tensor, model: Model, scaling: Scaling, count: int) -> Tensor:
    """Direct paths (..., count), none from late inputs, where those of the others are given."""
    if direct.shape[-1] == count:
        return direct
    return at_places(direct, prompt_columns(model.late, scaling, count), count)


class DynamicStart:
    """Starting values of one dynamic layer.

    Args:
        model: the cascade. one, layer: the dynamic layer and its place in it.
        scaling: of the records. generator: of everything random.
    """

    def __init__(
        self,
        model: Model,
        one: Wire,
        layer: Dynamic,
        scaling: Scaling,
        generator: np.random.Generator,
    ) -> None:
        self.model, self.one, self.layer = model, one, layer
        self.scaling, self.generator = scaling, generator

    def _key(self, name: str) -> str:
        return f"{self.one.name}_{name}"

    def _random(self, *shape: int, scale: float = SMALL) -> Tensor:
        return torch.tensor(scale * self.generator.standard_normal(shape), dtype=torch.float64)

    @property
    def _inputs(self) -> tuple[int, ...]:
        """Places of what a layer sees and what comes back: the same whatever the record's order."""
        model, d = self.model, self.one.channels
        order = list(model.order_of(self.one, self.scaling) or range(d))
        widths = {wire.name: wire.layer.outputs for wire in model.wires}
        for name in self.one.feedback:
            order += [len(order) + i for i in model.order_of_signals(widths[name], self.scaling)]
        return tuple(order)

    @property
    def _signals(self) -> tuple[int, ...]:
        """Places of the layer's signals, likewise."""
        order = self.model.order_of_signals(self.layer.outputs, self.scaling)
        return (*order, *range(self.layer.outputs, self.layer.width))

    def from_linear(
        self, linear: Mapping[str, Tensor], moved: bool = False, ahead: bool = True
    ) -> Values:
        """The linear optimum's values under this layer's names.

        Args:
            linear: values. moved: whether its poles are moved at random.
            ahead: of hidden signals, see `Plan`.
        """
        values = {
            self.one.name + name[1:]: value for name, value in linear.items() if name[:2] == "g_"
        }
        layer = self.layer
        for name in ("log_decay", "log_frequency") if moved else ():
            values[self._key(name)] = values[self._key(name)] + self._random(
                layer.pairs, scale=MOVED
            )
        direct, shape = self._key("feedthrough"), self._direct_shape()
        if direct in values and shape is not None:
            values[direct] = with_late_inputs(values[direct], self.model, self.scaling, shape[-1])
        if self.one.fed:
            none = torch.zeros(layer.pairs, 0, 2, dtype=torch.float64)
            gain = values.get(self._key("input_gain"), none)
            values[self._key("input_gain")] = self._fed_back(gain)
            if self._key("integrator_gain") in values:
                level = values[self._key("integrator_gain")]
                values[self._key("integrator_gain")] = pad(level, (0, self.one.fed))
        gains = values.get(self._key("output_gain"))  # of one signal there is none
        known = 1 if gains is None else len(gains)
        if layer.width > known:
            values.update(self._more_signals(values, known, ahead))
            if layer.process_noise:
                values.update(self._small_noise())
        if layer.process_noise and self._key("noise_gain_unit") not in values:
            values.update(self._small_noise())
        if not layer.process_noise:
            noise = ("_noise_gain", "_integrator_noise")
            values = {k: v for k, v in values.items() if not any(part in k for part in noise)}
        return values

    def _more_signals(self, values: Values, known: int, ahead: bool) -> Values:
        """Sites of the layer's signals where the first ones are known: all see the same modes.

        Those that are not hidden see them with other gains, at random.
        """
        layer, P = self.layer, self.layer.pairs
        own = torch.tensor([1.0, 0.0], dtype=torch.float64).expand(1, P, 2)
        if self._key("output_gain") in values:  # as a direction
            own = values[self._key("output_gain")]
            own = own / own.square().sum((0, -1), keepdim=True).sqrt()
        rest = layer.width - known
        # Drawn for all, so that a signal's gains do not depend on how many are known.
        gain = torch.cat([own, self._random(layer.width, P, 2, scale=OTHERS)[known:]])
        if layer.hidden:
            # As many as outputs go by these, in their order.
            alike = known in (1, layer.hidden)
            places = range(known) if alike else self._signals[:known]
            measured = torch.stack([own[place] for place in places[: layer.hidden]])
            gain[-layer.hidden :] = self._hidden(values, measured, ahead)
        length = gain.square().sum((0, -1)).sqrt()  # directions have unit length
        found = {
            self._key("output_gain"): gain,
            self._key("input_gain"): values[self._key("input_gain")] * length[:, None, None],
        }
        if self._key("feedthrough") in values:
            D = values[self._key("feedthrough")]
            more = self._random(rest, D.shape[-1], scale=0.1)
            found[self._key("feedthrough")] = torch.cat([D.reshape(known, -1), more])
        for site in map(self._key, INTEGRATORS):
            if site in values:
                more = self._random(layer.levels - known, *values[site].shape[1:])
                found[site] = torch.cat([values[site], more])
        return found

    def _hidden(self, values: Values, measured: Tensor, ahead: bool) -> Tensor:
        """Gains (h, P, 2) of outputs' derivatives by time, over the middle of the poles' sizes.

        That is a velocity where a position is measured. `ahead`, of no more signals than outputs:
        with the output itself added, it is that of a first-order lag before: a level in the tank
        above. Of more signals than outputs the others are about the first output itself, as a force
        that the position makes.

        Args:
            measured: (c, P, 2), gains of outputs, at most h: real and imaginary part.
        """
        decay, frequency = (values[self._key(x)].exp() for x in ("log_decay", "log_frequency"))
        pole = torch.complex(-decay, frequency)
        more = self.layer.hidden - len(measured)
        share = pole / pole.abs().median() + float(ahead and more == 0)
        derivatives = torch.view_as_real(share * torch.view_as_complex(measured.contiguous()))
        others = measured[0] + self._random(more, *measured.shape[1:], scale=AROUND)
        return torch.cat([derivatives, others])

    def _fed_back(self, gain: Tensor) -> Tensor:
        """Gains (P, d + fed, 2): what comes back acts somewhat as the inputs do, sign at random.

        What comes back from known functions is not nothing at first: their gains are small.
        """
        wires = {wire.name: wire for wire in self.model.wires}
        sign = float(self.generator.choice([-1.0, 1.0]))
        like = gain.mean(1, keepdim=True) if gain.shape[1] else gain.new_ones(len(gain), 1, 2)
        layers = (wires[name].layer for name in self.one.feedback)
        share = [
            0.0 if isinstance(layer, Known) else 0.5 * sign
            for layer in layers
            for _ in range(layer.outputs)
        ]
        own = self._back(len(gain), self.one.fed, 2)
        return torch.cat([gain, gain.new_tensor(share)[:, None] * like + own], 1)

    def _back(self, pairs: int, fed: int, parts: int) -> Tensor:
        """Small numbers (P, fed, 2) at random, each for its channel wherever that is."""
        own = [place - self.one.channels for place in self._inputs[self.one.channels :]]
        return in_place(self._random(pairs, fed, parts).mT, own).mT

    def near_identity(self) -> Values:
        """Each output is an input, beside small random dynamics."""
        layer, d = self.layer, self.one.channels
        P, several = layer.pairs, layer.width > 1
        rate = TimeScale.of(self.scaling).typical_rate
        poles = random_poles(P, self.scaling, self.generator)
        values = {
            self._key("log_decay"): torch.tensor(np.log(-poles.real / rate)),
            self._key("log_frequency"): torch.tensor(np.log(poles.imag / rate)),
        }
        if d + self.one.fed:
            gain = self._random(P, d + self.one.fed, 2)
        if d:
            shape = self._direct_shape()
            if shape is not None:
                D = torch.eye(layer.width, shape[-1], dtype=torch.float64)
                D = D + self._random(layer.width, shape[-1])
                D = in_place(in_place(D, self._inputs[: shape[-1]]).mT, self._signals).mT
                values[self._key("feedthrough")] = D if several else D[0]
            else:  # the fastest pair passes the first input on
                fastest = int(np.argmax(np.abs(poles)))
                gain[fastest, 0, 1] = 1.0
        if d + self.one.fed:
            values[self._key("input_gain")] = in_place(gain.mT, self._inputs).mT
        if several:
            gain = self._random(layer.width, P, 2, scale=OTHERS)
            gain[0] = gain[0] + torch.tensor([1.0, 0.0], dtype=torch.float64)
            values[self._key("output_gain")] = in_place(gain.movedim(0, -1), self._signals).movedim(
                -1, 0
            )
        for site in self.model.sites(self.scaling):  # levels stay where they begin
            if site.name in map(self._key, INTEGRATORS):
                values[site.name] = torch.zeros(site.shape, dtype=torch.float64)
        if layer.process_noise:
            values.update(self._small_noise())
        return values

    def lags(self, linear: Mapping[str, Tensor] | None) -> Values:
        """Real poles: levels that all they see raises, and all that comes back lowers.

        Rates are around those of a linear fit, and inputs of the model have the signs of its
        steady-state gains; all at random, as there is no best guess.
        """
        layer, d, rate = self.layer, self.one.channels, TimeScale.of(self.scaling).typical_rate
        sizes = torch.tensor(np.abs(random_poles(layer.pairs, self.scaling, self.generator)) / rate)
        signs = torch.ones(d, dtype=torch.float64)
        if linear is not None:
            sizes = torch.complex(*(linear[f"g_log_{x}"].exp() for x in ("decay", "frequency")))
            sizes = sizes.abs()
            if self.one.sources == (INPUTS,) and "g_input_gain" in linear:
                signs = torch.where(linear["g_input_gain"][..., 1].sum(0) < 0.0, -1.0, signs)
        signs = torch.cat([signs, signs.new_full((self.one.fed,), UNFED - 1.0)]) / UNFED
        decay = sizes.log() + np.log(UNFED) + self._random(layer.pairs, scale=RATES)
        own = self._random(layer.pairs, len(signs), scale=GAINS).exp() / layer.pairs
        own = own * decay.exp()[:, None]
        values = {
            self._key("log_decay"): decay,
            self._key("input_gain"): (in_place(own, self._inputs) * signs).unsqueeze(-1),
        }
        direct = self._direct_shape()
        if direct is not None:
            values[self._key("feedthrough")] = torch.zeros(direct, dtype=torch.float64)
        return values | (self._small_noise() if layer.process_noise else {})

    def _direct_shape(self) -> torch.Size | None:
        """Shape of the site of direct paths; None where there is none."""
        sites = self.model.sites(self.scaling)
        return next((x.shape for x in sites if x.name == self._key("feedthrough")), None)

    def _small_noise(self) -> Values:
        layer = self.layer
        count = layer.brownian or layer.outputs
        walk = {self._key("integrator_noise"): torch.full((layer.levels, count), WALKS).double()}
        return {
            **(walk if layer.integrators else {}),
            self._key("noise_gain_local_scale"): torch.full((layer.pairs,), 0.5).double(),
            self._key("noise_gain_unit"): self._random(
                layer.pairs, count, 1 if layer.real else 2, scale=0.3
            ).abs()
            + 0.05,
        }

    def response(self, values: Values, record: PreparedRecord, x: Tensor) -> Tensor:
        """Mean trajectory (n, w) of the layer."""
        with torch.no_grad():
            layer = self.model.dynamic_system(self.one, self.layer, values, self.scaling)
            silent = x.new_zeros((*x.shape[:-1], self.one.fed))
            return layer.mean(torch.cat([x, silent], -1), record.grid)

    def scale(self, values: Values, factor: float) -> None:
        """Multiply the layer's output; of real poles what it sees, where functions come back."""
        if self.layer.real:
            seen = torch.arange(self.one.channels)
            gain = values[self._key("input_gain")]
            values[self._key("input_gain")] = gain.index_copy(1, seen, factor * gain[:, seen])
            return
        for name in ("input_gain", "feedthrough", "noise_gain_unit", *INTEGRATORS):
            if self._key(name) in values:
                values[self._key(name)] = values[self._key(name)] * factor
