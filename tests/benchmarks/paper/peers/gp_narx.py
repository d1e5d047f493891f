"""GP-NARX: a Gaussian process on lagged outputs and inputs, run freely with its uncertainty."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import gpytorch
import numpy as np
import torch
from scipy.cluster.vq import kmeans2

from tests.benchmarks.paper.peers.lags import Scaled, filled, lagged, missing_note
from tests.benchmarks.paper.prediction import Outcome, Predicted, Task

LAGS = 5
TRAJECTORIES = 100
# More rows than this are learned with inducing points.
MOST_EXACT, INDUCING = 2500, 400
LEARNING_RATE = 0.1
# Training stops when this many steps have gained less than GAIN in log likelihood per sample.
WINDOW, GAIN = 30, 1e-4


class Model(gpytorch.models.ExactGP):
    """Constant mean and an RBF kernel with a length scale of each regressor."""

    def __init__(
        self,
        x: torch.Tensor,
        y: torch.Tensor,
        likelihood: gpytorch.likelihoods.GaussianLikelihood,
        inducing: torch.Tensor | None,
    ) -> None:
        super().__init__(x, y, likelihood)
        self.mean_module = gpytorch.means.ConstantMean()
        rbf = gpytorch.kernels.RBFKernel(ard_num_dims=x.shape[1])
        # Standardised regressors lie about this far apart.
        rbf.lengthscale = math.sqrt(x.shape[1])
        self.scaled_rbf = gpytorch.kernels.ScaleKernel(rbf)
        self.covar_module = self.scaled_rbf
        if inducing is not None:
            self.covar_module = gpytorch.kernels.InducingPointKernel(
                self.scaled_rbf, inducing, likelihood
            )

    def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


@dataclass(frozen=True, eq=False)
class Posterior:
    """Predictive distribution in a form that is quick to evaluate step by step.

    With k the prior covariances of a new point with the basis points, the mean is
    constant + k weights and the variance is prior + noise - k reduction k'.

    Attributes:
        basis: (m, d) training rows or inducing points, divided by the length scales.
        weights: (m,).
        reduction: (m, m).
        length: (d,) length scales.
        prior, noise: variances.
        constant: prior mean.
    """

    basis: torch.Tensor
    weights: torch.Tensor
    reduction: torch.Tensor
    length: torch.Tensor
    prior: float
    noise: float
    constant: float

    def at(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and variance (noise included) of the output at rows x (s, d)."""
        k = _rbf(x / self.length, self.basis, self.prior)
        variance = self.prior + self.noise - ((k @ self.reduction) * k).sum(1)
        return self.constant + k @ self.weights, variance.clamp(min=self.noise)


def _rbf(a: torch.Tensor, b: torch.Tensor, prior: float) -> torch.Tensor:
    square = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
    return prior * torch.exp(-0.5 * square.clamp(min=0))


def posterior(model: Model, x: torch.Tensor, y: torch.Tensor) -> Posterior:
    """Condition on the training rows, once; with inducing points by the collapsed bound's optimum.

    A jitter of 1e-8 of the prior variance keeps the Cholesky factors of inducing points stable.
    """
    length = model.scaled_rbf.base_kernel.lengthscale.detach()[0]
    prior, noise = float(model.scaled_rbf.outputscale), float(model.likelihood.noise)
    constant = float(model.mean_module.constant)
    rows, target = x / length, y - constant
    if model.covar_module is model.scaled_rbf:
        K = _rbf(rows, rows, prior) + noise * torch.eye(len(rows), dtype=x.dtype)
        factor = torch.linalg.cholesky(K)
        weights = torch.cholesky_solve(target[:, None], factor)[:, 0]
        reduction = torch.cholesky_inverse(factor)
        return Posterior(rows, weights, reduction, length, prior, noise, constant)
    basis = model.covar_module.inducing_points.detach() / length
    eye = torch.eye(len(basis), dtype=x.dtype)
    factor = torch.linalg.cholesky(_rbf(basis, basis, prior) + 1e-8 * prior * eye)
    inverse = torch.linalg.solve_triangular(factor, eye, upper=False)
    A = inverse @ _rbf(basis, rows, prior)
    B = torch.linalg.cholesky(eye + A @ A.T / noise)
    weights = inverse.T @ torch.cholesky_solve((A @ target)[:, None], B)[:, 0] / noise
    reduction = inverse.T @ (eye - torch.cholesky_inverse(B)) @ inverse
    return Posterior(basis, weights, reduction, length, prior, noise, constant)


def learn(
    x: torch.Tensor, y: torch.Tensor, inducing: torch.Tensor | None, deadline: float
) -> tuple[Model, int, str]:
    """Maximise the marginal likelihood (its lower bound with inducing points) by Adam.

    Returns:
        Model with the best parameters seen, number of steps, why it stopped.
    """
    floor = gpytorch.constraints.GreaterThan(1e-8)
    likelihood = gpytorch.likelihoods.GaussianLikelihood(noise_constraint=floor)
    likelihood.noise = 0.1
    model = Model(x, y, likelihood, inducing).double()
    bound = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
    optimiser = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)
    model.train()
    losses: list[float] = []
    best, state, why = math.inf, model.state_dict(), "time was up"
    # Nothing iterative: Cholesky factors of all rows, or of the inducing points by Woodbury's
    # identity, which the package uses in its fast mode alone.
    fast = inducing is not None
    with gpytorch.settings.fast_computations(fast, fast, fast):
        while time.perf_counter() < deadline:
            optimiser.zero_grad()
            loss = -bound(model(x), y)
            losses.append(loss.item())
            if losses[-1] < best:
                best = losses[-1]
                state = {name: value.clone() for name, value in model.state_dict().items()}
            if len(losses) > 2 * WINDOW:
                gained = min(losses[:-WINDOW]) - min(losses)
                if gained < GAIN:
                    why = "likelihood no longer rose"
                    break
            loss.backward()
            optimiser.step()
    model.load_state_dict(state)
    return model, len(losses), why


def free_run(
    at: Posterior, test: np.ndarray, past: tuple[np.ndarray, np.ndarray], rng: np.random.Generator
) -> np.ndarray:
    """Trajectories (S, n) of the scaled output; each feeds back its own draws."""
    u = torch.as_tensor(lagged(test, range(LAGS), past[0]))
    recent = torch.as_tensor(past[1][::-1].copy()).expand(TRAJECTORIES, LAGS)
    draws = torch.as_tensor(rng.standard_normal((len(test), TRAJECTORIES)))
    out = torch.empty_like(draws)
    for t in range(len(test)):
        mean, variance = at.at(torch.cat([recent, u[t].expand(TRAJECTORIES, -1)], dim=1))
        out[t] = mean + variance.sqrt() * draws[t]
        recent = torch.cat([out[t, :, None], recent[:, :-1]], dim=1)
    return np.asarray(out.T)


def predict(task: Task) -> Outcome:
    """Learn one-step predictions, then run freely with the uncertainty fed back.

    A hundred trajectories draw each output, noise included, from the predictive normal at their
    own lags; their mean is the point prediction.
    """
    begin = time.perf_counter()
    data = Scaled.of(task)
    y = filled(data.y)
    u_rows = lagged(data.u[LAGS:], range(LAGS), data.u[:LAGS])
    y_rows = lagged(y[LAGS:, None], range(1, LAGS + 1), y[:LAGS, None])
    known = np.isfinite(data.y[LAGS:])
    x = torch.as_tensor(np.concatenate([y_rows, u_rows], axis=1)[known])
    target = torch.as_tensor(y[LAGS:][known])
    rng = np.random.default_rng(task.seed)
    notes = [missing_note(data.y)]
    inducing = None
    if len(x) > MOST_EXACT:
        # Standardised rows clustered; the centres then move with the other parameters.
        centres, _ = kmeans2(np.asarray(x), INDUCING, iter=10, minit="points", rng=rng)
        inducing = torch.as_tensor(centres)
        notes.append(f"sparse, {INDUCING} inducing points")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(task.seed)
        started = time.perf_counter()
        model, steps, why = learn(x, target, inducing, begin + task.seconds)
        step = (time.perf_counter() - started) / max(steps, 1)
    notes.append(why)
    with torch.no_grad():
        at = posterior(model, x, target)
        seconds = time.perf_counter() - begin
        predictions = []
        for test in data.tests:
            samples = data.unscaled(free_run(at, test, data.past(LAGS), rng))
            predictions.append(Predicted(samples.mean(0), samples))
    return Outcome(predictions, seconds, steps, step, "; ".join(filter(None, notes)))
