r"""A stochastic linear time-invariant system in modal (complex diagonal) form.

For pair ``j = 1..P`` of complex-conjugate modes, with white noise ``beta`` of unit diffusion,

    dx_j = lambda_j x_j dt + B_j u dt + L_j dbeta,     y_a = 2 Re sum_j c_aj x_j + D_a u.

The stacked system (lambda, B, c, L and their conjugates) is equation (9) of the paper.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import Numbers, as_tensor, broadcast

NoiseStructure = Literal["shared", "independent"]


@dataclass(frozen=True, eq=False)
class Modes:
    """Poles and gains of a stochastic LTI system with one or several inputs and outputs.

    Arrays or tensors; complex ones become complex128, real ones float64. Leading batch dimensions
    ``*b`` (particles, posterior draws) broadcast. The number of outputs is read off
    ``output_gain``: of as many dimensions as ``poles`` for one output, of one more for several.

    Attributes:
        poles: lambda (*b, P) [1/s], complex, one of each conjugate pair, real parts negative; or
            exactly zero, an integrator, whose noise gain is zero and whose other gains are real.
        input_gain: B (*b, P, n_u) [state/(input s)], complex; None for a system without input.
        output_gain: c (*b, P) or (*b, n_y, P) [output/state], complex.
        noise_gain: L (*b, P, n_l) [state/sqrt(s)], complex; None for no process noise.
        feedthrough: D (*b, n_u) or (*b, n_y, n_u) [output/input], real; None for zero.
        drift: (*b, P) [state/s], complex: what drives the states beside the inputs, at any time the
            same; None for nothing. (The input that keeps an integrator where it is is not zero.)
        noise: "shared", the same n_l Brownian motions drive all pairs; or "independent", each
            pair has n_l of its own.

    Raises:
        ValueError: where shapes disagree, a number is not finite, or a pole is not stable (an
            integrator that noise drives is not, either).

    Examples:
        >>> modes = dgp.Modes([-1.0 + 2.0j], [[1.0 + 0.0j]], [0.5 + 0.0j], [[0.3 + 0.0j]])
        >>> modes.pairs, modes.inputs
        (1, 1)
    """

    poles: Tensor
    input_gain: Tensor | None = None
    output_gain: Tensor | None = None
    noise_gain: Tensor | None = None
    feedthrough: Tensor | None = None
    noise: NoiseStructure = "shared"
    drift: Tensor | None = None

    def __post_init__(self) -> None:
        if self.noise not in ("shared", "independent"):
            raise invalid("noise", expected="'shared' or 'independent'", got=repr(self.noise))
        poles = as_tensor(self.poles, torch.complex128, argument="poles")
        if poles.dim() == 0 or poles.shape[-1] == 0:
            raise invalid(
                "poles", expected="shape (..., P) with P >= 1", got=f"shape {tuple(poles.shape)}"
            )
        P = poles.shape[-1]
        if self.output_gain is None:
            raise invalid("output_gain", expected="shape (..., P) or (..., n_y, P)", got="None")
        c = as_tensor(self.output_gain, torch.complex128, poles.device, argument="output_gain")
        B = self._gain("input_gain", self.input_gain, poles)
        L = self._gain("noise_gain", self.noise_gain, poles)
        if c.dim() == 0 or c.shape[-1] != P or c.dim() > poles.dim() + 1:
            raise invalid(
                "output_gain",
                expected=f"shape (..., {P}) or (..., n_y, {P}) for {P} poles",
                got=f"shape {tuple(c.shape)}",
            )
        several = c.dim() == poles.dim() + 1
        n_u = B.shape[-1]
        tail = (c.shape[-2], n_u) if several else (n_u,)
        if self.feedthrough is None:
            D = torch.zeros(tail, dtype=torch.float64, device=poles.device)
        else:
            given = self.feedthrough
            if given.is_complex() if torch.is_tensor(given) else np.iscomplexobj(given):
                raise invalid("feedthrough", expected="real numbers", got="complex ones")
            D = as_tensor(self.feedthrough, torch.float64, poles.device, argument="feedthrough")
            if D.shape[D.dim() - len(tail) :] != tail:
                raise invalid(
                    "feedthrough", expected=f"shape (..., {tail})", got=f"shape {tuple(D.shape)}"
                )
        fields = {
            "poles": poles,
            "input_gain": B,
            "output_gain": c,
            "noise_gain": L,
            "feedthrough": D,
        }
        if self.drift is not None:
            drift = as_tensor(self.drift, torch.complex128, poles.device, argument="drift")
            fields["drift"] = self._gain("drift", drift.unsqueeze(-1), poles).squeeze(-1)
        # One number tells whether anything is not finite; which field it is, only an error asks.
        total = sum(value.detach().abs().sum() for value in fields.values())
        if not math.isfinite(float(total)):
            for name, value in fields.items():
                if not bool(torch.isfinite(value.abs()).all()):
                    raise invalid(
                        name,
                        expected="finite numbers",
                        got="NaN or infinity",
                        advice="If this came up in training, lower the learning rate or rescale.",
                    )
        if not bool((poles.real < 0).all()) and not _integrates(poles, L):
            worst = float(poles.real.detach().max())
            raise invalid(
                "poles",
                expected="stable poles, every real part below zero, or zeros without noise",
                got=f"a real part of {worst:.6g} 1/s",
                advice="A stationary Gaussian process needs a stable system.",
            )
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "_several", several)
        try:
            batch = broadcast(
                poles.shape[:-1],
                B.shape[:-2],
                c.shape[: c.dim() - 1 - several],
                L.shape[:-2],
                D.shape[: D.dim() - 1 - several],
                () if self.drift is None else self.drift.shape[:-1],
            )
        except ValueError as error:
            raise invalid(
                "Modes", expected="batch dimensions that broadcast", got=str(error)
            ) from error
        object.__setattr__(self, "_batch", torch.Size(batch))

    @staticmethod
    def _gain(name: str, value: Numbers | None, poles: Tensor) -> Tensor:
        P = poles.shape[-1]
        if value is None:
            return torch.zeros(P, 0, dtype=torch.complex128, device=poles.device)
        gain = as_tensor(value, torch.complex128, poles.device, argument=name)
        if gain.dim() < 2 or gain.shape[-2] != P:
            raise invalid(
                name,
                expected=f"shape (..., {P}, n), a row for each of the {P} poles",
                got=f"shape {tuple(gain.shape)}",
            )
        return gain

    # Validated fields, with the type that they have after construction.
    @property
    def B(self) -> Tensor:
        """Input gain (*b, P, n_u), complex."""
        return cast(Tensor, self.input_gain)

    @property
    def C(self) -> Tensor:
        """Output gain with an explicit output dimension (*b, n_y, P), complex."""
        c = cast(Tensor, self.output_gain)
        return c if self.several_outputs else c.unsqueeze(-2)

    @property
    def L(self) -> Tensor:
        """Noise gain (*b, P, n_l), complex."""
        return cast(Tensor, self.noise_gain)

    @property
    def D(self) -> Tensor:
        """Feedthrough with an explicit output dimension (*b, n_y, n_u), real."""
        D = cast(Tensor, self.feedthrough)
        return D if self.several_outputs else D.unsqueeze(-2)

    @property
    def several_outputs(self) -> bool:
        """Whether trajectories have an output dimension, (n, n_y) instead of (n,)."""
        return bool(self.__dict__["_several"])

    @property
    def has_process_noise(self) -> bool:
        """Whether any Brownian motion drives the states (its gain may still be zero)."""
        return self.L.shape[-1] > 0

    @property
    def batch_shape(self) -> torch.Size:
        """The common batch shape *b."""
        return cast(torch.Size, self.__dict__["_batch"])

    @property
    def pairs(self) -> int:
        """P, the number of conjugate pairs."""
        return int(self.poles.shape[-1])

    @property
    def inputs(self) -> int:
        """n_u, the number of inputs."""
        return int(self.B.shape[-1])

    @property
    def outputs(self) -> int:
        """n_y, the number of outputs."""
        return int(self.C.shape[-2])

    @property
    def natural_frequency(self) -> Tensor:
        """|lambda| (*b, P) [rad/s]."""
        return self.poles.abs()

    @property
    def damping(self) -> Tensor:
        """Damping ratio -Re lambda / |lambda| (*b, P), dimensionless."""
        return -self.poles.real / self.poles.abs()

    def without_process_noise(self) -> Modes:
        """The deterministic system: the same poles and gains, L = 0."""
        return replace(self, noise_gain=None)

    def _map(self, function: Callable[[Tensor, int], Tensor]) -> Modes:
        several = int(self.several_outputs)
        return Modes(
            poles=function(self.poles, 1),
            input_gain=function(self.B, 2),
            output_gain=function(cast(Tensor, self.output_gain), 1 + several),
            noise_gain=function(self.L, 2),
            feedthrough=function(cast(Tensor, self.feedthrough), 1 + several),
            noise=self.noise,
            drift=None if self.drift is None else function(self.drift, 1),
        )

    def expand(self, batch_shape: torch.Size | tuple[int, ...]) -> Modes:
        """Broadcast every gain to the given batch shape."""
        shape = torch.Size(batch_shape)
        return self._map(lambda x, k: x.expand(shape + x.shape[x.dim() - k :]))

    def __getitem__(self, index: Any) -> Modes:
        """Index the batch dimensions, and only these.

        Raises:
            ValueError: where there are none. IndexError: where the index reaches beyond them.
        """
        if not self.batch_shape:
            raise invalid("Modes", expected="batch dimensions to index", got="none")
        numbers = torch.arange(self.batch_shape.numel()).reshape(self.batch_shape)[index]
        full = self.expand(self.batch_shape)
        count = self.batch_shape.numel()
        return full._map(lambda x, k: x.reshape((count, *x.shape[x.dim() - k :]))[numbers])

    def detach(self) -> Modes:
        """The same values without gradient history."""
        return self._map(lambda x, k: x.detach())

    def rescale(
        self,
        *,
        time: float = 1.0,
        inputs: Tensor | float = 1.0,
        outputs: Tensor | float = 1.0,
    ) -> Modes:
        """The same system in other units.

        Args:
            time: one unit of the old time in new units (old hours to new seconds: 3600).
            inputs: scalar or (n_u,), one unit of each old input in new units.
            outputs: scalar or (n_y,), one unit of each old output in new units.
        """
        si = as_tensor(inputs)
        so = as_tensor(outputs)
        row = so if so.dim() == 0 else so.unsqueeze(-1)
        C = self.C * row
        D = self.D * row / si
        several = self.several_outputs
        return Modes(
            poles=self.poles / time,
            input_gain=self.B / (time * si),
            output_gain=C if several else C.squeeze(-2),
            noise_gain=self.L / time**0.5,
            feedthrough=D if several else D.squeeze(-2),
            noise=self.noise,
            drift=None if self.drift is None else self.drift / time,
        )

    def __repr__(self) -> str:
        shape = f", batch {tuple(self.batch_shape)}" if self.batch_shape else ""
        return (
            f"Modes({self.pairs} pairs, {self.inputs} inputs, {self.outputs} outputs, "
            f"{self.L.shape[-1]} {self.noise} noise{shape})"
        )


def _integrates(poles: Tensor, noise_gain: Tensor) -> bool:
    """Whether all poles that are not stable are zero, and not driven by noise."""
    zero = poles == 0
    driven = bool((zero.unsqueeze(-1) & (noise_gain != 0)).any())
    return bool(((poles.real < 0) | zero).all()) and not driven
