"""Plants of textbook equations, on which the loop is measured."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.benchmarks.textbook import NOISE, PLANTS, N, pendulum, plant


def test_a_plant_solves_its_equation() -> None:
    step, u, y = pendulum(np.random.default_rng(4))
    state, found = np.zeros(2), []
    for drive in u[:200, 0]:
        found.append(state[0])
        solved = solve_ivp(
            lambda t, x, u=drive: [x[1], u - 9.0 * np.sin(x[0]) - 0.6 * x[1]],
            (0.0, step), state, rtol=1e-10, atol=1e-12,
        )  # fmt: skip
        state = solved.y[:, -1]
    # Steps of fourth order err by 1e-8 or so.
    np.testing.assert_allclose(y[:200, 0], found, atol=1e-6)


@pytest.mark.parametrize("kind", PLANTS)
def test_a_seed_is_a_record(kind: str) -> None:
    record, sd = plant(kind, 1)
    again, _ = plant(kind, 1)
    other, _ = plant(kind, 2)
    assert len(record) == N
    assert np.isfinite(record.outputs).all()
    np.testing.assert_array_equal(record.outputs, again.outputs)
    assert (record.outputs != other.outputs).any()
    # Of the outputs without noise, which is not quite uncorrelated with them: 0.1 %.
    np.testing.assert_allclose(sd, NOISE * record.outputs.std(0), rtol=0.01)
