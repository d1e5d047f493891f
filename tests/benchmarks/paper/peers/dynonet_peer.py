"""dynoNet: linear transfer functions and static networks trained by simulation error."""

from __future__ import annotations

import copy
import math
import time

import numpy as np
import torch

from tests.benchmarks.paper.peers.lags import Scaled
from tests.benchmarks.paper.prediction import Outcome, Predicted, Task

STARTS = 3
# Shares of the time by which all starts have been tried, and by which the best of them has ended;
# the rest is for learning it once more from the whole record.
TRIAL, SEARCH = 0.3, 0.55
LEARNING_RATE = 2e-3
MOST_STEPS = 20_000
# Last part of the training record, which decides how many steps are taken, and how often it is
# looked at; training stops when it has been no better for PATIENCE steps.
VALIDATION = 0.2
EVERY, PATIENCE = 50, 1500
HIDDEN = 32


def network(task: Task) -> torch.nn.Sequential:
    """The task's architecture in dynoNet's blocks: twice the pairs are the order of a filter."""
    from dynonet.lti import MimoLinearDynamicalOperator
    from dynonet.static import MimoStaticNonLinearity

    blocks: list[torch.nn.Module] = []
    channels = task.train.n_inputs
    for i, layer in enumerate(task.architecture):
        outputs = 1 if i == len(task.architecture) - 1 else task.width
        if layer == "static":
            blocks.append(MimoStaticNonLinearity(channels, outputs, HIDDEN, "tanh"))
        else:
            order = 2 * int(layer)
            blocks.append(MimoLinearDynamicalOperator(channels, outputs, order, order, n_k=0))
        channels = outputs
    return torch.nn.Sequential(*blocks).double()


class Training:
    """One network on its way from one random start; it can be interrupted and continued.

    Attributes:
        seed: of the start.
        net: the network.
        steps: taken so far.
        best: smallest validation error so far and the step it was at.
        ended: why it cannot go on; empty while it can.
        busy: seconds spent in steps.
    """

    def __init__(self, task: Task, data: Scaled, seed: int) -> None:
        self.seed = seed
        torch.manual_seed(seed)
        self.net = network(task)
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=LEARNING_RATE)
        self.u, self.y = torch.as_tensor(data.u)[None], torch.as_tensor(data.y)
        self.learned = round((1 - VALIDATION) * len(self.y))
        self.known = torch.isfinite(self.y)
        self.steps, self.busy, self.ended = 0, 0.0, ""
        self.best, self.best_step = math.inf, 0
        self.state = copy.deepcopy(self.net.state_dict())

    def error(self, begin: int, end: int) -> torch.Tensor:
        """Mean squared error of [begin, end) in free run from the start of the record."""
        simulated = self.net(self.u[:, :end])[0, begin:end, 0]
        known = self.known[begin:end]
        return ((simulated - self.y[begin:end])[known] ** 2).mean()

    def validate(self) -> None:
        """Keep the parameters if the validation error is the smallest so far."""
        with torch.no_grad():
            error = float(self.error(self.learned, len(self.y)))
        # An unstable filter overflows; such parameters are never the best.
        if error < self.best:
            self.best, self.best_step = error, self.steps
            self.state = copy.deepcopy(self.net.state_dict())

    def step(self, end: int) -> bool:
        """One step on the first `end` samples; False if a filter has become unstable."""
        begin = time.perf_counter()
        self.optimiser.zero_grad()
        loss = self.error(0, end)
        if not torch.isfinite(loss):
            return False
        loss.backward()
        self.optimiser.step()
        self.steps += 1
        self.busy += time.perf_counter() - begin
        return True

    def advance(self, deadline: float) -> None:
        """Train until the deadline or the end."""
        while not self.ended and time.perf_counter() < deadline:
            if not self.step(self.learned):
                self.ended = "a filter became unstable"
            elif self.steps % EVERY == 0:
                self.validate()
            if self.ended:
                return
            if self.steps - self.best_step >= PATIENCE:
                self.ended = "validation error no longer fell"
            elif self.steps >= MOST_STEPS:
                self.ended = "most steps reached"

    def repeat(self, steps: int, deadline: float) -> bool:
        """Take this many steps on the whole record; False if it did not come to that."""
        for _ in range(steps):
            if time.perf_counter() >= deadline or not self.step(len(self.y)):
                return False
        return True


def predict(task: Task) -> Outcome:
    """Try some starts, go on with the best, learn it again from the whole record, and simulate.

    The validation error chooses the start and the number of steps. A test record that follows is
    simulated from the start of the training record on, so that the filters carry over.
    """
    begin = time.perf_counter()
    data = Scaled.of(task)
    with torch.random.fork_rng(devices=[]), np.errstate(over="ignore", invalid="ignore"):
        tried = []
        for i in range(STARTS):
            tried.append(Training(task, data, task.seed * STARTS + i))
            tried[-1].advance(begin + task.seconds * TRIAL * (i + 1) / STARTS)
            tried[-1].validate()
        best = min(tried, key=lambda training: training.best)
        best.advance(begin + task.seconds * SEARCH)
        best.validate()
        again = Training(task, data, best.seed)
        complete = again.repeat(best.best_step, begin + task.seconds)
        seconds = time.perf_counter() - begin
        net = again.net if complete else best.net
        if not complete:
            net.load_state_dict(best.state)
        predictions = [Predicted(data.unscaled(simulate(net, data, test))) for test in data.tests]
    searched = sum(training.steps for training in tried)
    busy = sum(training.busy for training in tried)
    note = (
        f"best of {STARTS} starts, step {best.best_step} of {best.steps} "
        f"({best.ended or 'time was up'}), "
        + ("learned again from the whole record" if complete else "from 80 % of the record")
    )
    whole = busy / max(searched, 1) / (1 - VALIDATION)
    figures = {"validation_rmse": data.sd * math.sqrt(best.best)}
    return Outcome(predictions, seconds, searched + again.steps, whole, note, figures)


def simulate(net: torch.nn.Module, data: Scaled, test: np.ndarray) -> np.ndarray:
    """Scaled output of one test record."""
    before = data.u if data.follows else data.u[:0]
    u = torch.as_tensor(np.concatenate([before, test]))[None]
    with torch.no_grad():
        return np.asarray(net(u)[0, len(before) :, 0])
