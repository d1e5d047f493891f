"""Approximate engine: outputs of any cascade by the moment-matching filter over its joint state."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.distributions.pointwise import Moments
from pyro_dynogp.lti.grid import TimeGrid, time_grid
from pyro_dynogp.models.assembly import Assembly, assemble
from pyro_dynogp.models.draws import JointState
from pyro_dynogp.models.output_process import LayerMoments, OutputProcess
from pyro_dynogp.models.system import System
from pyro_dynogp.models.wiring import INPUTS
from pyro_dynogp.moments import filtering, smoothing
from pyro_dynogp.moments.lane_passes import innovate_together, lanes_serve
from pyro_dynogp.moments.layout import Layout, Values
from pyro_dynogp.moments.problem import FilterProblem, each, log_density
from pyro_dynogp.support.tensors import as_tensor, broadcast

# Results (3, n, n_y) of a compiled pass: mean (or error), variance, log-density.
Pass = Callable[[Layout, Values], tuple[np.ndarray, np.ndarray, np.ndarray]]


class MomentOutputs(OutputProcess):
    """Measured outputs by moment matching; see `OutputProcess`.

    The log-density is that of a Gaussian assumed-density filter over the joint state of all dynamic
    layers: exact where the static layers are linear and the noise is Gaussian, else as good as
    Gaussian moments are: joint ones of a static layer's input and output inside the cascade; where
    the last layer is a function of one signal, those of the state given each sample.
    """

    @cached_property
    def assembly(self) -> Assembly:
        """The system along the record, written as a problem for the filter."""
        return self._assembled(self.system, self.grid, self.scaled_inputs)

    def _assembled(self, system: System, grid: TimeGrid, inputs: Tensor) -> Assembly:
        noise_sd = self.noise_sd if grid is self.grid else None
        if self.start is None:
            return assemble(system, grid, inputs, noise_sd)
        known = assemble(self.start.first_of(system), grid, inputs, noise_sd)
        return replace(known, problem=replace(known.problem, P0=self.start.covariance))

    def _problem(self, y: Tensor | None) -> FilterProblem:
        if y is None:
            return self.assembly.problem
        return self.assembly.with_outputs(self.scaled(y))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (*s, *batch) of outputs (*s, *batch, *event) [nats]."""
        problem = self._problem(value)
        if lanes_serve(problem) and not problem.wants_gradient:
            density = torch.from_numpy(innovate_together(problem)[2])
            # What is missing counts nothing; a point that breaks has no density.
            total = density.masked_fill(torch.isnan(problem.y), 0.0).sum((-2, -1))
        else:
            total = log_density(problem)
        there = (~torch.isnan(self.columns(value))).to(torch.float64)
        jacobian = (there * self.scale.log()).sum((-2, -1))
        lead = value.shape[: value.dim() - len(self.event_shape)]
        return (total - jacobian).expand(broadcast(lead, self.batch_shape))

    def _pass(self, problem: FilterProblem, compiled: Pass) -> tuple[Tensor, Tensor, Tensor]:
        """Results (*b, n, n_y) of a pass for each element of the batch, scaled."""
        elements, batch = problem.elements()
        found = each(lambda b: np.stack(compiled(problem.layout, elements[b])), len(elements))
        stacked = torch.from_numpy(np.stack(found))
        shaped = stacked.reshape(*batch, *stacked.shape[1:])[..., :: self.system.substeps, :]
        return shaped[..., 0, :, :], shaped[..., 1, :, :], shaped[..., 2, :, :]

    def _moments(self, mean: Tensor, variance: Tensor, density: Tensor) -> Moments:
        return Moments(
            self.shift + self.scale * mean,
            self.scale.square() * variance,
            density - self.scale.log(),
        )

    def innovations(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `OutputProcess`."""
        error, variance, excess = self._innovate(y)
        found = self.scale * error, self.scale.square() * variance, excess
        if self.several:
            return found
        error, variance, excess = (x.squeeze(-1) for x in found)
        return error, variance, excess

    def _innovate(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scaled innovations (*b, n, n_y), variances, and what log-densities have beyond normal."""
        problem = self._problem(y)
        error, variance, density = self._innovations_of(problem)
        normal = self.system.noise.likelihood.gaussian and problem.layout.measured < 0
        if lanes_serve(problem) and normal:
            return error, variance, torch.zeros_like(error)
        return error, variance, density - _normal_density(error, variance)

    def _innovations_of(self, problem: FilterProblem) -> tuple[Tensor, Tensor, Tensor]:
        """What `smoothing.innovate` has (*b, n, n_y) at each sample."""
        if not lanes_serve(problem):
            return self._pass(problem, smoothing.innovate)
        found = (torch.from_numpy(x) for x in innovate_together(problem))
        error, variance, density = (x[..., :: self.system.substeps, :] for x in found)
        return error, variance, density

    def one_step(self, y: Tensor) -> Moments:
        """See `OutputProcess`."""
        error, variance, density = self._innovations_of(self._problem(y))
        return self._moments(self.scaled(y) - error, variance, density)

    def ahead(self, y: Tensor, horizon: int) -> Moments:
        """See `OutputProcess`."""
        steps = horizon * self.system.substeps
        problem = self._problem(y)
        return self._moments(
            *self._pass(problem, lambda layout, v: smoothing.predict_ahead(layout, v, steps))
        )

    def left_out(self, y: Tensor) -> Moments:
        """See `OutputProcess`."""

        def compiled(layout: Layout, v: Values) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            _, track, _, _ = filtering.run(layout, v)
            mean, variance, density = smoothing.leave_one_out(layout, v, track)
            return mean, variance, density

        return self._moments(*self._pass(self._problem(y), compiled))

    def prediction_errors(self, y: Tensor, horizon: int, count: int) -> None:
        """None: errors are drawn independently of each other."""

    def state_after(
        self, y: Tensor, gap: float, next_inputs: Tensor, *, process_noise: bool = True
    ) -> JointState:
        """See `OutputProcess`; one grid over the past and that time: the filter carries on."""
        time = torch.cat([self.grid.time, self.grid.time[-1:] + gap])
        following = next_inputs
        if following.shape[-1]:
            centred = following - as_tensor(self.scaling.input_offset)
            following = centred / as_tensor(self.scaling.input_scale)
        inputs = torch.cat([self.scaled_inputs, following.unsqueeze(-2)], -2)
        assembly = self._assembled(self.system, time_grid(time), inputs)
        z = self.scaled(y)
        z = torch.cat([z, torch.full_like(z[..., :1, :], torch.nan)], -2)
        problem = assembly.with_outputs(z)
        if not process_noise:
            problem = quiet_last_steps(problem, self.system.substeps)
        elements, batch = problem.elements()
        N = problem.m0.shape[-1]
        ends = each(lambda b: filtering.run(problem.layout, elements[b]), len(elements))
        m = torch.from_numpy(np.stack([end[2][:N] for end in ends])).reshape(*batch, N)
        P = torch.from_numpy(np.stack([end[3][:N, :N] for end in ends])).reshape(*batch, N, N)
        return JointState(assembly.known_state + m, P)

    def smooth(self, y: Tensor | None) -> dict[str, LayerMoments]:
        """See `OutputProcess`."""
        problem = self._problem(y)
        elements, batch = problem.elements()
        A = problem.G.shape[-1]
        random = {k: s for k, s in self.assembly.signals.items() if s.rows is not None}
        rows = [
            s.rows.expand(*batch, *s.rows.shape[-2:]).reshape(-1, s.rows.shape[-2], A)
            for s in random.values()
            if s.rows is not None
        ]
        nothing = torch.zeros(len(elements), 0, A, dtype=torch.float64)
        joined = (torch.cat(rows, -2) if rows else nothing).contiguous().numpy()

        def compiled(b: int) -> tuple[np.ndarray, np.ndarray]:
            _, track, _, _ = filtering.run(problem.layout, elements[b])
            mean, variance = smoothing.smooth(problem.layout, elements[b], joined[b], track)
            return mean @ joined[b].T, variance

        found = each(compiled, len(elements))
        parts = self.system.substeps
        mean = np.stack([m for m, _ in found])[:, ::parts]
        sd = np.sqrt(np.stack([v for _, v in found])[:, ::parts])
        out, start = {}, 0
        for name, signal in self.assembly.signals.items():
            if name == INPUTS:
                continue
            sampled = signal.known[..., ::parts, :]
            n, w = sampled.shape[-2:]
            known = sampled.expand(*batch, n, w).reshape(-1, n, w).numpy()
            if signal.rows is None:
                out[name] = LayerMoments(known, np.zeros_like(known))
                continue
            own = slice(start, start + w)
            out[name] = LayerMoments(known + mean[..., own], sd[..., own])
            start += w
        return out


def _normal_density(error: Tensor, variance: Tensor) -> Tensor:
    return -0.5 * (error.square() / variance + torch.log(2.0 * math.pi * variance))


def quiet_last_steps(problem: FilterProblem, count: int) -> FilterProblem:
    """The problem with no process noise in its last steps, which are equally long."""
    step = problem.layout.step.copy()
    last = int(step[-1])
    step[-count:] = problem.Q.shape[-3]  # a step of its own

    def with_copy(x: Tensor, dim: int) -> Tensor:
        return torch.cat([x, x.select(dim, last).unsqueeze(dim)], dim)

    Q = with_copy(problem.Q, -3)
    Q[..., -1, :, :] = 0.0
    return replace(
        problem,
        layout=problem.layout._replace(step=step),
        re=with_copy(problem.re, -2),
        im=with_copy(problem.im, -2),
        gamma=with_copy(problem.gamma, -3),
        Q=Q,
    )
