"""Random problems for the moment-matching filter, and the numbers in them as leaves."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from pyro_dynogp.layers.noise import student_components
from pyro_dynogp.moments.functions import KERNELS
from pyro_dynogp.moments.layout import Values
from pyro_dynogp.moments.problem import TABLE, FilterProblem, make_layout

# What may move: y is measured, but its gradient is used where outputs are scaled.
MOVABLE = Values._fields
SYMMETRIC = ("Q", "P0")
GRID = 60


class Block(NamedTuple):
    """A static function: its form, inputs d and outputs e."""

    form: str
    channels: int = 1
    outputs: int = 1


LINE = Block("table")
WIDE = Block("table", 1, 2)


def random_problem(
    blocks,
    *,
    n=40,
    pairs=2,
    n_y=1,
    student=False,
    distinct=2,
    repeated=True,
    missing=True,
    measured=False,
    seed=0,
):
    """Everything at random: layer i sees the states and all earlier layers, and so do outputs.

    measured: the only output is the last layer's, and its update that of `measured_function`.
    """
    rng = np.random.default_rng(seed)
    normal = rng.standard_normal
    N, D, S = 2 * pairs, sum(b.channels for b in blocks), len(blocks)
    E = sum(b.outputs for b in blocks)
    A, M, widest = N + E, 5, max((b.channels for b in blocks), default=1)
    step = rng.integers(-1 if repeated else 0, distinct, n)
    step[0] = -1
    share, multiple = student_components(4.0, 4) if student else (np.ones(1), np.ones(1))
    layout = make_layout(
        step,
        [b.channels for b in blocks],
        [b.outputs for b in blocks],
        [TABLE if b.form == "table" else KERNELS[b.form] for b in blocks],
        share,
        multiple,
        measured=measured,
    )
    G = np.zeros((D, A))
    row = column = 0
    for block in blocks:
        G[row : row + block.channels, : N + column] = 0.4 * normal((block.channels, N + column))
        row += block.channels
        column += block.outputs
    angle = normal((distinct, pairs))
    root, first = 0.2 * normal((distinct, N, N)), 0.3 * normal((N, N))
    grid = np.linspace(-6.0, 6.0, GRID)
    rough = np.cumsum(0.01 * normal((E, GRID)), -1)
    y = normal((n, n_y))
    if missing and n > 5:
        y[3] = np.nan
        y[5, -1] = np.nan
    values = {
        "re": 0.8 * np.cos(angle),
        "im": 0.8 * np.sin(angle),
        "Q": root @ root.swapaxes(-1, -2) + 0.05 * np.eye(N),
        "gamma": 0.3 * normal((distinct, N, E)),
        "m0": 0.1 * normal(N),
        "P0": first @ first.T + 0.1 * np.eye(N),
        "G": G,
        "offset": 0.5 * normal((n, D)),
        "table_mean": np.tanh(grid) + rough,
        "table_variance": 0.01 + 0.01 * rng.uniform(size=(E, GRID)),
        "low": np.full(S, -6.0),
        "spacing": np.full(S, 12.0 / (GRID - 1)),
        "weight": 0.5 * normal((E, M)),
        "Z": normal((S, M, widest)),
        "inverse": rng.uniform(0.5, 1.5, (S, widest)),
        "constant": 0.2 * normal(E),
        "slope": 0.3 * normal((E, widest)),
        "H": 0.5 * normal((n_y, A)),
        "y_offset": 0.2 * normal((n, n_y)),
        "y": y,
        "R": rng.uniform(0.1, 1.1, (n, n_y)),
    }
    return FilterProblem(layout, **{k: torch.from_numpy(np.array(v)) for k, v in values.items()})


def element(problem):
    """The one batch element, as arrays."""
    (values,), _ = problem.elements()
    return values


def leaves(problem):
    """The same problem with every number a leaf of the graph, and the leaves by name."""
    leaf = {name: getattr(problem, name).clone().requires_grad_() for name in MOVABLE}
    return replace(problem, **leaf), leaf


def direction(problem, name, rng):
    """A random direction in which a number may move and keep its meaning."""
    value = getattr(problem, name)
    move = torch.from_numpy(np.array(rng.standard_normal(tuple(value.shape))))
    if name in SYMMETRIC:
        return move + move.mT
    if name == "G":  # a layer cannot see those above it
        return torch.where(value != 0.0, move, 0.0)
    if name == "y":
        return torch.where(torch.isnan(value), 0.0, move)
    return move


def moved(problem, name, by):
    return replace(problem, **{name: getattr(problem, name) + by})
