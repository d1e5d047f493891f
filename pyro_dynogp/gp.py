"""The stochastic LTI system as a GPyTorch kernel and mean, for use in any GPyTorch model."""

from __future__ import annotations

from typing import Any

import gpytorch
import torch
from torch import Tensor

from pyro_dynogp.lti.covariance import autocovariance
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import hold, mean_response
from pyro_dynogp.support.errors import instance, invalid
from pyro_dynogp.support.tensors import Numbers, as_tensor


class LTIParameters(gpytorch.Module):
    """Poles and gains of a system as unconstrained, trainable parameters.

    Give the same object to `LTIKernel` and `LTIMean` and they share it.

    Args:
        modes: starting values, one output, no batch dimensions, no integrators.

    Examples:
        >>> modes = dgp.Modes([-1.0 + 2.0j], [[1.0 + 0.0j]], [0.5 + 0.0j], [[0.3 + 0.0j]])
        >>> system = dgp.LTIParameters(modes)
        >>> kernel, mean = dgp.LTIKernel(system), dgp.LTIMean(system, [0.0, 0.1], [[1.0], [0.0]])
        >>> system.modes.pairs
        1
    """

    def __init__(self, modes: Modes) -> None:
        super().__init__()
        instance("modes", modes, Modes)
        if modes.batch_shape or modes.several_outputs or bool((modes.poles == 0).any()):
            expected = "one output, no batch dimensions, stable poles"
            raise invalid("modes", expected=expected, got=repr(modes))
        self.noise = modes.noise
        poles = modes.poles.detach()
        values = {
            "log_decay": (-poles.real).log(),
            "frequency": poles.imag,
            "input_gain": torch.view_as_real(modes.B.detach().resolve_conj()),
            "output_gain": torch.view_as_real(modes.C[0].detach().resolve_conj()),
            "noise_gain": torch.view_as_real(modes.L.detach().resolve_conj()),
            "feedthrough": modes.D[0].detach(),
        }
        for name, value in values.items():
            self.register_parameter(name, torch.nn.Parameter(value.clone()))

    @property
    def modes(self) -> Modes:
        """The system with the present values, differentiable in them."""
        return Modes(
            poles=torch.complex(-self.log_decay.exp(), self.frequency),
            input_gain=torch.view_as_complex(self.input_gain),
            output_gain=torch.view_as_complex(self.output_gain),
            noise_gain=torch.view_as_complex(self.noise_gain),
            feedthrough=self.feedthrough,
            noise=self.noise,
        )


def _parameters(system: Modes | LTIParameters) -> LTIParameters:
    if isinstance(system, LTIParameters):
        return system
    instance("system", system, Modes)
    return LTIParameters(system)


class LTIKernel(gpytorch.kernels.Kernel):
    """Covariance S(t, t') that the process noise of a system gives its output.

    Args:
        system: a `Modes` (starting values) or an `LTIParameters` to share with an `LTIMean`.

    The first column of the covariates is time [s]; further columns (inputs) are ignored. For the
    O(n) path use `LTIProcess`; this kernel is dense and serves GPyTorch models of any kind.

    Examples:
        >>> modes = dgp.Modes([-1.0 + 2.0j], [[1.0 + 0.0j]], [0.5 + 0.0j], [[0.3 + 0.0j]])
        >>> dgp.LTIKernel(modes)(torch.tensor([0.0, 0.1]).double()).to_dense().shape
        torch.Size([2, 2])
    """

    is_stationary = True
    has_lengthscale = False

    def __init__(self, system: Modes | LTIParameters, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.system = _parameters(system)

    @property
    def modes(self) -> Modes:
        """The system with the present parameter values."""
        return self.system.modes

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any) -> Tensor:
        """Covariance (..., n, m), or its diagonal (..., n)."""
        t1, t2 = x1[..., 0], x2[..., 0]
        lag = t1 - t2 if diag else t1.unsqueeze(-1) - t2.unsqueeze(-2)
        return autocovariance(self.modes, lag)


class LTIMean(gpytorch.means.Mean):
    """Mean response m(t) of a system to its inputs, held constant between samples.

    Args:
        system: a `Modes` (starting values) or an `LTIParameters` to share with an `LTIKernel`.
        time: (m,) times [s] at which the inputs are known. None: the covariates bring the inputs
            along, in columns [time, u_1, ..., u_{n_u}].
        inputs: (m, n_u) inputs at these times; the last one is held for ever.

    With `time` given the covariate is time alone, in any order, and m(t) is evaluated exactly
    between samples too. Without it the rows of the covariates are sorted by time, so that a
    prediction of `ExactGP`, which appends the test rows to the training rows, carries the state on.

    Examples:
        >>> modes = dgp.Modes([-1.0 + 2.0j], [[1.0 + 0.0j]], [0.5 + 0.0j], [[0.3 + 0.0j]])
        >>> mean = dgp.LTIMean(modes, [0.0, 0.1], [[1.0], [0.0]])
        >>> mean(torch.tensor([[0.0], [0.1]]).double()).shape
        torch.Size([2])
    """

    def __init__(
        self,
        system: Modes | LTIParameters,
        time: Numbers | None = None,
        inputs: Numbers | None = None,
    ) -> None:
        super().__init__()
        self.system = _parameters(system)
        if (time is None) != (inputs is None):
            raise invalid("time, inputs", expected="both or neither", got="one of them")
        self.time = None if time is None else time_grid(as_tensor(time, argument="time")).time
        self.inputs = None if inputs is None else as_tensor(inputs, argument="inputs")
        if self.inputs is not None and self.inputs.dim() == 1:
            self.inputs = self.inputs.unsqueeze(-1)

    @property
    def modes(self) -> Modes:
        """The system with the present parameter values."""
        return self.system.modes

    def forward(self, x: Tensor) -> Tensor:
        """Mean (n,) at covariates x (n, 1) or (n, 1 + n_u)."""
        if x.dim() == 1:
            x = x.unsqueeze(-1)
        if x.dim() != 2:
            raise invalid(
                "x", expected="covariates (n, d) without batches", got=f"shape {tuple(x.shape)}"
            )
        at = x[:, 0]
        if self.time is None or self.inputs is None:
            time, u = at, x[:, 1:]
        else:
            time = torch.cat([self.time.to(at), at])
            u = torch.cat([self.inputs, hold(self.time, self.inputs, at)])
        order = torch.argsort(time, stable=True)
        m = mean_response(self.modes, time[order], u[order]).output
        back = torch.argsort(order)
        return m[back][-at.shape[0] :]
