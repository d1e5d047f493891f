"""Columns of responses that no linear time-invariant system has, beside formulas."""

import dataclasses

import numpy as np
import pytest

from pyro_dynogp.statistics.interactions import COSINES, DELAYS, INPUTS, SINES, interactions
from pyro_dynogp.statistics.omnibus import beyond_catalogue
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.series import in_other_units, residuals, share


def spans(block, x):
    """Whether a block's columns and a constant make up the signal x (n,), once it has begun."""
    x, A = x[100:], np.column_stack([block, np.ones(len(x))])[100:]
    rest = x - A @ np.linalg.lstsq(A, x, rcond=None)[0]
    return rest.std() < 0.02 * x.std()


@pytest.mark.parametrize("inputs", [1, 2])
def test_products_go_the_way_of_the_model(inputs):
    """The model's path is a lag of one pole; products of any two inputs go through it."""
    r = residuals(1, 600, inputs=inputs)
    u = (r.inputs - r.inputs.mean(0)) / r.inputs.std(0)
    blocks = interactions(r)
    for i in range(inputs):
        for j in range(inputs):
            late = np.concatenate([np.full(3, u[0, j]), u[:-3, j]])
            assert any(spans(b, share(u[:, i] * late)) for b in blocks)
    if inputs == 2:
        assert any(spans(b, share(u[:, 0] * u[:, 1])) for b in blocks)


def test_changing_responses_are_there():
    """An input whose gain turns slowly, along the stretch that is looked at, as waves do."""
    r = residuals(2, 600, held_out=np.arange(600) >= 300)
    u = (r.inputs[:, 0] - r.inputs[:, 0].mean()) / r.inputs[:, 0].std()
    s = np.clip((np.arange(600) - 300) / 299, 0.0, 1.0)
    blocks = interactions(r)
    for wave in (np.cos(np.pi * s), np.sin(4.0 * np.pi * s)):
        assert any(spans(b, share(u * wave)) for b in blocks)


def test_how_many_there_are_does_not_grow_with_the_inputs():
    """At most so many inputs are multiplied, those that do most; one that rests does nothing."""
    r = residuals(3, 400, inputs=6)
    blocks = interactions(r)
    waves = len(COSINES) + len(SINES)
    most = INPUTS * (INPUTS - 1) // 2 + INPUTS**2 * DELAYS + (INPUTS + 1) * waves
    assert len(blocks) <= most
    assert all(b.shape == (400, 4) and np.isfinite(b).all() for b in blocks)
    still = dataclasses.replace(r, inputs=np.zeros((400, 1)), input_names=("u1",))
    assert len(interactions(still)) == waves


def test_units_do_not_matter():
    """Scales and shifts of inputs, and their order, change no block but for its sign."""
    r = residuals(4, 300, inputs=2)
    a, b = interactions(r), interactions(in_other_units(r))
    assert len(a) == len(b)
    for block in a:
        assert any(all(spans(other, x) for x in block.T) for other in b)


@pytest.mark.parametrize("moves", [False, True])
def test_without_inputs_only_a_mean_that_moves_may_change(moves):
    """A model whose inputs act at once (a calendar) has a mean, but no input with dynamics."""
    p_values = []
    for seed in range(5):
        r = residuals(seed, 300)
        mean = r.mean if moves else np.full(300, 2.0)
        r = dataclasses.replace(r, inputs=np.zeros((300, 0)), input_names=(), mean=mean)
        assert len(interactions(r)) == (len(COSINES) + len(SINES) if moves else 0)
        p_values.append(beyond_catalogue(r, SETTINGS).p_value)
    assert np.median(p_values) > 0.05


def test_waves_are_slow():
    """A short stretch shows few of them: what turns faster would pass for the noise's colour."""
    r = residuals(6, 400)
    for samples, waves in ((300, 12), (150, 6), (20, 1)):
        still = dataclasses.replace(
            r, held_out=np.arange(400) < samples, inputs=np.zeros((400, 0)), input_names=()
        )
        assert len(interactions(still)) == waves
