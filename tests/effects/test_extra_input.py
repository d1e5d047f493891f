"""A channel that acts: found with its form and delay, and not taken for what inputs do."""

from dataclasses import replace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data import signals
from pyro_dynogp.data.channels import Delayed, Recorded
from pyro_dynogp.effects.dynamics import unmodelled_dynamics
from pyro_dynogp.effects.extra_input import extra_input
from pyro_dynogp.statistics.evidence import Evidence
from tests.discrepancy.made import SETTINGS, coloured, lag, residuals_of
from tests.effects.scenes import first_extra, step_inputs

N = 400
STEP = 0.1
TIME = STEP * np.arange(N)


@pytest.mark.parametrize(
    ("form", "function"),
    [
        ("linear", lambda w, u: 0.6 * w),
        ("square", lambda w, u: 0.3 * w**2),
        ("absolute", lambda w, u: 0.7 * np.abs(w)),
        ("product with v", lambda w, u: 0.4 * w * u[:, 1]),
    ],
)
def test_a_missing_channel_is_found_with_its_form(form, function):
    rng, u, parts, e = step_inputs(1)
    w, other = coloured(rng, (2, N), 0.0), coloured(rng, N, 0.9)
    w = lag(w[0], 0.5) * 3.0
    y = parts.sum(1) + e + lag(function(w, u), 0.3)
    r = residuals_of(y, parts.sum(1), u, {"ambient": 20.0 + 3.0 * w, "other": other})
    found, none = extra_input(r, SETTINGS)
    assert found.p_value < 1e-4
    assert found.where == {"channel": "ambient", "form": form, "delay": 0.0}
    assert none.p_value > 0.01
    assert found.sentence.startswith("Channel 'ambient' acts on 'speed'")
    assert found.sentence.endswith("rpm (rms).")


def test_the_delay_of_a_missing_channel():
    rng, u, parts, e = step_inputs(2)
    w = coloured(rng, N, 0.7)
    y = parts.sum(1) + e + 0.8 * lag(signals.delayed(w, TIME, 1.25), 0.3)
    found = first_extra(residuals_of(y, parts.sum(1), u, {"w": w}), SETTINGS)
    assert found.p_value < 1e-4
    assert found.where["delay"] == pytest.approx(1.25, abs=0.1)
    late = (Recorded("w"), Delayed("w", 9.0))
    refitted = dgp.LinearDynamicGP(inputs=3, pairs=1, channels=late)
    assert ", 9 s later, about" in effects.ExtraInput().sentence(found, refitted)


def test_what_used_inputs_explain_is_not_ascribed_to_a_candidate():
    """The candidate goes with an input whose dynamics are wrong."""
    rng, u, parts, e = step_inputs(3)
    y = parts.sum(1) + e + lag(u[:, 0], 2.0, gain=1.5)
    w = u[:, 0] + 0.3 * coloured(rng, N, 0.5)
    r = residuals_of(y, parts.sum(1), u, {"w": w})
    assert unmodelled_dynamics(r, SETTINGS).p_value < 1e-3
    assert first_extra(r, SETTINGS).p_value > 0.05


def test_a_candidate_with_gaps_and_no_candidates():
    rng, u, parts, e = step_inputs(4)
    w = coloured(rng, N, 0.8)
    y = parts.sum(1) + e + lag(w, 0.3)
    w[rng.random(N) < 0.05] = np.nan
    assert first_extra(residuals_of(y, parts.sum(1), u, {"w": w}), SETTINGS).p_value < 1e-4
    assert extra_input(residuals_of(y, parts.sum(1), u), SETTINGS) == []


@pytest.mark.parametrize(
    ("channels", "late"),
    [
        ((Recorded("w"),), ""),
        ((Recorded("w"), Delayed("w", 0.25)), ", 0.25 s later"),
        ((Delayed("u", 0.5), Recorded("w")), ""),
    ],
)  # fmt: skip
def test_its_delay_is_told_as_refits_have_it(channels, late):
    model = dgp.LinearDynamicGP(inputs=2, pairs=1, channels=channels)
    said, told = (f"Channel 'w' acts on 'y'{x}, about 2 V (rms)." for x in (", 0.3 s later", late))
    where = {"channel": "w", "form": "linear", "delay": 0.3}
    found = Evidence("extra input", 1.0, 0.01, 1.0, 1.0, where, said, None)
    assert effects.ExtraInput().sentence(found, model) == told
    at_once = replace(found, where={**where, "delay": 0.0}, sentence="Channel 'w' acts on 'y'.")
    assert effects.ExtraInput().sentence(at_once, model) == at_once.sentence
