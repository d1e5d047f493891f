"""Measurement noise as Pyro distributions, and as the Gaussian mixtures that the filter uses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import pyro.distributions as dist
import torch
from scipy.special import gammainc, gammaincinv
from torch import Tensor

from pyro_dynogp.layers.functions import StaticFunction
from pyro_dynogp.layers.sites import Site, Values
from pyro_dynogp.layers.static import StaticPrior
from pyro_dynogp.support.errors import POSITIVE, invalid, one_of, verify_fields

# What varying noise is a function of.
Driver = Literal["inputs", "output"]
# Components of the Gaussian mixture that stands for a Student-t.
COMPONENTS = 16
# Prior of the standard deviation: log-normal around this share of the output's.
TYPICAL = 0.1
FLAT = 1e3


@dataclass(frozen=True)
class Likelihood:
    """Distribution of measured outputs given the noise-free ones; independent over time.

    Make one by `Gaussian`, `StudentT` or `Heteroscedastic`.

    Attributes:
        degrees_of_freedom: of a Student-t; None for a Gaussian.
        varying: whether the logarithm of the standard deviation is a Gaussian process, instead of
            constant.
        inducing: number of inducing values of that process.
        of: what it is a function of: "inputs", or "output", the model's output with neither
            process noise nor measurement noise.
    """

    degrees_of_freedom: float | None = None
    varying: bool = False
    inducing: int = 8
    of: Driver = "inputs"

    def __post_init__(self) -> None:
        verify_fields(self)
        one_of(get_args(Driver)).check("of", self.of)

    @property
    def gaussian(self) -> bool:
        """Whether the noise is Gaussian."""
        return self.degrees_of_freedom is None

    @property
    def follows_output(self) -> bool:
        """Whether the size of the noise is a function of the model's output."""
        return self.varying and self.of == "output"

    def sites(
        self,
        outputs: int,
        inputs: int,
        *,
        flat: bool = False,
        order: tuple[int, ...] | None = None,
    ) -> tuple[Site, ...]:
        """The sites of the noise of a model with so many outputs and inputs that drive it.

        `order`: of the channels that the noise varies with, see `StaticPrior`.

        ``noise_sd`` (n_y,), log-normal around a tenth of the output's standard deviation; with
        `varying`, ``log_noise_...`` instead, those of a static layer of what drives it, which
        gives log(sd / 0.1).

        Raises:
            ValueError: for noise that varies in a model without inputs.
        """
        if self.varying:
            driver = "input" if self.of == "inputs" else "output"
            dims = {"input": driver, "inducing": "log_noise_inducing"}
            return replace(self._function(outputs, inputs), order=order).sites(dims)
        zero = torch.zeros(outputs, dtype=torch.float64)
        prior = dist.LogNormal(zero + math.log(TYPICAL), zero + (FLAT if flat else 1.5))
        return (Site("noise_sd", prior.to_event(1), ("output",)),)

    def noise(self, values: Values, outputs: int, inputs: int) -> Noise:
        """The noise at values (*b, *shape) of its sites."""
        if self.varying:
            return Noise(self, None, self._function(outputs, inputs).function(values))
        return Noise(self, values["noise_sd"], None)

    def _function(self, outputs: int, inputs: int) -> StaticPrior:
        if not inputs:
            raise invalid(
                "likelihood",
                expected="constant noise for a model without inputs",
                got=f"noise that varies with the {self.of}",
            )
        channels = inputs if self.of == "inputs" else outputs
        return StaticPrior("log_noise", channels, outputs, self.inducing)

    def components(self) -> tuple[np.ndarray, np.ndarray]:
        """Shares and variance multiples (K,) of the Gaussian mixture, the widest first.

        One component if Gaussian.
        """
        if self.degrees_of_freedom is None:
            return np.ones(1), np.ones(1)
        return student_components(self.degrees_of_freedom)


def Gaussian() -> Likelihood:
    """White Gaussian measurement noise of constant standard deviation.

    Examples:
        >>> dgp.Wiener(1, likelihood=dgp.Gaussian()).likelihood == dgp.Gaussian()
        True
    """
    return Likelihood()


def StudentT(degrees_of_freedom: float = 4.0) -> Likelihood:
    """White Student-t measurement noise, for records with outliers.

    Examples:
        >>> dgp.Wiener(1, likelihood=dgp.StudentT(6.0)).likelihood == dgp.StudentT(6.0)
        True
    """
    return Likelihood(degrees_of_freedom=POSITIVE.check("degrees_of_freedom", degrees_of_freedom))


def Heteroscedastic(inducing: int = 8, of: Driver = "inputs") -> Likelihood:
    """White Gaussian noise whose log standard deviation is a Gaussian process.

    Args:
        inducing: number of its inducing values.
        of: "inputs", or "output" for noise that grows with what is measured: a function of the
            output that the inputs alone cause (no process noise, static layers at their mean).

    Raises:
        ValueError: on other values.

    Examples:
        >>> noise = dgp.Heteroscedastic(of="output")
        >>> dgp.LinearDynamicGP(1, likelihood=noise).likelihood == noise
        True
    """
    return Likelihood(varying=True, inducing=inducing, of=of)


def student_components(nu: float, count: int = COMPONENTS) -> tuple[np.ndarray, np.ndarray]:
    """Gaussian mixture for a Student-t of unit scale: shares and variances (count,).

    A Student-t is Gaussian with precision w ~ Gamma(nu/2, nu/2). Bins of w, even in log w where the
    mass is, each give a component with the bin's probability and its mean precision.
    """
    a = 0.5 * nu
    low, high = gammaincinv(a, 1e-9) / a, gammaincinv(a, 1.0 - 1e-6) / a
    inner = np.exp(np.linspace(math.log(low), math.log(high), count + 1)[1:-1])
    edges = np.concatenate([[0.0], inner, [np.inf]])
    mass = np.diff(gammainc(a, a * edges))
    precision = np.diff(gammainc(a + 1.0, a * edges)) / mass  # E[w | bin]: the gamma of shape a + 1
    return mass / mass.sum(), 1.0 / precision


@dataclass(frozen=True, eq=False)
class Noise:
    """Measurement noise given its parameters, in units of the scaled outputs.

    Attributes:
        likelihood: its kind. constant_sd: (*b, n_y), or None where it varies.
        log_sd: static function of what drives the noise, or None.
    """

    likelihood: Likelihood
    constant_sd: Tensor | None
    log_sd: StaticFunction | None

    @property
    def batch_shape(self) -> torch.Size:
        """Of the parameters."""
        if self.constant_sd is not None:
            return self.constant_sd.shape[:-1]
        assert self.log_sd is not None
        return self.log_sd.batch_shape

    def sd(self, driver: Tensor) -> Tensor:
        """Scale (*b, n, n_y) at each sample of the scaled driver (*b, n, d)."""
        if self.constant_sd is not None:
            n = driver.shape[-2]
            sd = self.constant_sd.unsqueeze(-2)
            return sd.expand((*sd.shape[:-2], n, sd.shape[-1]))
        assert self.log_sd is not None
        return TYPICAL * self.log_sd.mean(driver).exp()

    def distribution(self, mean: Tensor, sd: Tensor, missing: Tensor | None) -> dist.Distribution:
        """Of measured outputs (*b, *event) given mean and scale; missing ones are not scored."""
        nu = self.likelihood.degrees_of_freedom
        shape = torch.broadcast_shapes(mean.shape, sd.shape)
        mean, sd = mean.expand(shape), sd.expand(shape)
        one: dist.Distribution = (
            dist.Normal(mean, sd) if nu is None else dist.StudentT(nu, mean, sd)
        )
        if missing is not None:
            one = one.mask(~missing)
        return one
