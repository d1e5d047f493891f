"""Deep Gaussian process of GPyTorch on lagged inputs: a nonlinear finite impulse response."""

from __future__ import annotations

import time

import gpytorch
import numpy as np
import torch
from gpytorch.models.deep_gps import DeepGP, DeepGPLayer

from tests.benchmarks.paper.peers.lags import Scaled, lagged
from tests.benchmarks.paper.prediction import Outcome, Predicted, Task

# Lags of each input; fewer where there are many inputs.
LAGS, FEW_LAGS, MOST_INPUTS = 20, 5, 5
HIDDEN, INDUCING = 2, 64
BATCH, LEARNING_RATE, PARTICLES = 512, 0.01, 10
# Training stops when the mean loss of the last WINDOW steps is not GAIN below that of those before.
WINDOW, GAIN = 300, 1e-3
DRAWS = 200


class Layer(DeepGPLayer):
    """One layer: sparse variational GPs, one for each output (None: a single one)."""

    def __init__(self, inducing: torch.Tensor, outputs: int | None, mean: gpytorch.means.Mean):
        batch = torch.Size([] if outputs is None else [outputs])
        points = inducing.expand(*batch, *inducing.shape).clone()
        variational = gpytorch.variational.CholeskyVariationalDistribution(len(inducing), batch)
        super().__init__(
            gpytorch.variational.VariationalStrategy(self, points, variational),
            inducing.shape[1],
            outputs,
        )
        self.mean_module = mean
        rbf = gpytorch.kernels.RBFKernel(ard_num_dims=inducing.shape[1], batch_shape=batch)
        rbf.lengthscale = inducing.shape[1] ** 0.5
        self.covar_module = gpytorch.kernels.ScaleKernel(rbf, batch_shape=batch)

    def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


class TwoLayers(DeepGP):
    """Two layers with a linear mean in the first; that mean starts at the principal components.

    Attributes:
        likelihood: normal noise of the output.
    """

    def __init__(self, x: torch.Tensor) -> None:
        super().__init__()
        directions = torch.linalg.svd(x - x.mean(0), full_matrices=False).Vh[:HIDDEN]
        directions = directions / (x @ directions.T).std(0)[:, None]
        linear = gpytorch.means.LinearMean(x.shape[1], batch_shape=torch.Size([HIDDEN]))
        linear.weights.data = directions[:, :, None].to(linear.weights)
        chosen = x[torch.randperm(len(x))[:INDUCING]]
        self.hidden = Layer(chosen, HIDDEN, linear)
        self.last = Layer(chosen @ directions.T, None, gpytorch.means.ConstantMean())
        self.likelihood = gpytorch.likelihoods.GaussianLikelihood()
        self.likelihood.noise = 0.1

    def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
        return self.last(self.hidden(x))


def learn(x: torch.Tensor, y: torch.Tensor, deadline: float) -> tuple[TwoLayers, int, str]:
    """Maximise the doubly stochastic lower bound on mini-batches by Adam.

    Returns:
        Model, number of steps, why it stopped.
    """
    model = TwoLayers(x).double()
    bound = gpytorch.mlls.DeepApproximateMLL(
        gpytorch.mlls.VariationalELBO(model.likelihood, model, num_data=len(y))
    )
    optimiser = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)
    model.train()
    losses: list[float] = []
    waiting = torch.empty(0, dtype=torch.long)
    with gpytorch.settings.num_likelihood_samples(PARTICLES):
        while time.perf_counter() < deadline:
            if len(waiting) == 0:
                waiting = torch.randperm(len(y))
            rows, waiting = waiting[:BATCH], waiting[BATCH:]
            optimiser.zero_grad()
            loss = -bound(model(x[rows]), y[rows])
            loss.backward()
            optimiser.step()
            losses.append(loss.item())
            if len(losses) % WINDOW == 0 and len(losses) >= 2 * WINDOW:
                gained = np.mean(losses[-2 * WINDOW : -WINDOW]) - np.mean(losses[-WINDOW:])
                if gained < GAIN:
                    return model, len(losses), "bound no longer rose"
    return model, len(losses), "time was up"


def draw(model: TwoLayers, x: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Mean (n,) and draws (S, n) of the scaled output, noise included.

    Draws are independent from sample to sample, as GPyTorch draws hidden layers that way.
    """
    model.eval()
    means, draws = [], []
    with torch.no_grad(), gpytorch.settings.num_likelihood_samples(DRAWS):
        for rows in x.split(BATCH):
            out = model.likelihood(model(rows))
            means.append(out.mean.mean(0))
            draws.append(out.mean + out.variance.sqrt() * torch.randn_like(out.mean))
    return np.asarray(torch.cat(means)), np.asarray(torch.cat(draws, dim=1))


def predict(task: Task) -> Outcome:
    """Learn the output from lagged inputs alone, so that nothing is fed back."""
    begin = time.perf_counter()
    data = Scaled.of(task)
    lags = LAGS if data.u.shape[1] <= MOST_INPUTS else FEW_LAGS
    # The inputs before the training record are unknown: its first samples are not learned from.
    past = data.u[: lags - 1]
    x = lagged(data.u[lags - 1 :], range(lags), past)
    known = np.isfinite(data.y[lags - 1 :])
    y = torch.as_tensor(data.y[lags - 1 :][known])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(task.seed)
        started = time.perf_counter()
        model, steps, why = learn(torch.as_tensor(x[known]), y, begin + task.seconds)
        seconds = time.perf_counter() - begin
        epoch = (time.perf_counter() - started) / max(steps, 1) * -(-len(y) // BATCH)
        predictions = []
        for test in data.tests:
            u_past, _ = data.past(lags - 1)
            rows = torch.as_tensor(lagged(test, range(lags), u_past))
            mean, draws = draw(model, rows)
            predictions.append(Predicted(data.unscaled(mean), data.unscaled(draws)))
    return Outcome(predictions, seconds, steps, epoch, f"{lags} lags of each input; {why}")
