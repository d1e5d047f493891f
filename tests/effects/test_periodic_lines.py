"""Gains of sines by Fourier transforms, against least squares with every column written out."""

from __future__ import annotations

import numpy as np
import pytest

from pyro_dynogp.effects.periodic_lines import lines
from pyro_dynogp.statistics.autoregression import Whitener
from pyro_dynogp.statistics.prewhitening import Projection, spanning
from pyro_dynogp.statistics.settings import LoopSettings

N, LENGTH = 240, 960
BINS = np.arange(12, LENGTH // 2)
SETTINGS = LoopSettings()


def series(gaps: bool, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Coloured noise with a sine in it (n,), NaN in gaps, and a nuisance (n, 3)."""
    rng = np.random.default_rng(seed)
    x = np.convolve(rng.standard_normal(N + 20), 0.8 ** np.arange(20), "valid")[:N]
    x += np.sin(2.0 * np.pi * 60 / LENGTH * np.arange(N))
    if gaps:
        x[[3, 70, 71, 200, N - 1]] = np.nan
    return x, spanning(np.cumsum(rng.standard_normal((N, 2)), axis=0))


def left(columns: np.ndarray, x: np.ndarray) -> float:
    """Sum of squares that columns leave of a series."""
    rest = x - columns @ np.linalg.lstsq(columns, x)[0]
    return float(rest @ rest)


def with_past(missing: np.ndarray, order: int) -> np.ndarray:
    """Samples that are there with all of their past."""
    return np.array([t for t in range(order, N) if not missing[t - order : t + 1].any()])


def sine(frequency: float) -> np.ndarray:
    angle = 2.0 * np.pi * frequency * np.arange(N)
    return np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("order", [0, 1, 4])
def test_gains_are_those_of_least_squares_beside_the_past(gaps: bool, order: int) -> None:
    """Of every bin alike, whichever order came before: what stands beside is kept by order."""
    kinds: dict[int, np.ndarray] = {}
    x, nuisance = series(gaps, seed=order)
    missing = np.isnan(x)
    variants = lines(BINS, LENGTH, nuisance, missing, SETTINGS)
    for p in (order, order + 1, order):
        under = Projection(Whitener(np.full(p, 0.1)), nuisance, missing, SETTINGS)
        gains, _ = variants.prepare(under)(x)
        assert np.array_equal(kinds.setdefault(p, gains), gains)
    rows = with_past(missing, order)
    past = [x[rows - k] for k in range(1, order + 1)]
    beside = np.column_stack([nuisance[rows], np.ones(len(rows)), *past])
    degrees = len(rows) - nuisance.shape[1] - order
    for place in (0, 48, 200, len(BINS) - 30):
        line = sine(BINS[place] / LENGTH)[rows]
        ratio = left(np.column_stack([beside, line]), x[rows]) / left(beside, x[rows])
        np.testing.assert_allclose(kinds[order][place], -degrees * np.log(ratio), rtol=1e-8)


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("order", [0, 2])
def test_what_a_line_explains_is_what_least_squares_give_it(gaps: bool, order: int) -> None:
    """With its harmonics and a frequency a little off, under the colour that is beside it."""
    x, nuisance = series(gaps, seed=7)
    missing = np.isnan(x)
    under = Projection(Whitener(np.full(order, 0.1)), nuisance, missing, SETTINGS)
    _, fit = lines(BINS, LENGTH, nuisance, missing, SETTINGS).prepare(under)(x)
    place = 48
    shift = np.linspace(-1.0, 1.0, N)[:, None]
    waves = [sine(h * BINS[place] / LENGTH) for h in (1, 2, 3, 4)]
    wave = np.column_stack([*waves, *(shift * one for one in waves)])
    both = np.column_stack([wave, nuisance])
    rows = with_past(missing, order)
    past = [x[rows - k] for k in range(1, order + 1)]
    colour = np.linalg.lstsq(np.column_stack([*past, both[rows]]), x[rows])[0][:order]

    def filtered(columns: np.ndarray) -> np.ndarray:
        return columns[rows] - sum(a * columns[rows - 1 - k] for k, a in enumerate(colour))

    weights = np.linalg.lstsq(filtered(both), filtered(x))[0]
    effect, whole = fit(place)
    expected = wave @ weights[: wave.shape[1]]
    np.testing.assert_allclose(effect, expected - expected.mean(), atol=1e-7)
    np.testing.assert_allclose(whole, both @ weights, atol=1e-7)
