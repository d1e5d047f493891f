"""A dead zone of one input."""

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data import signals
from pyro_dynogp.data.channels import DeadZone
from pyro_dynogp.effects.dead_zone import dead_zone
from pyro_dynogp.effects.input_nonlinearity import input_nonlinearity
from pyro_dynogp.models.variants import with_channel
from pyro_dynogp.statistics.evidence import Evidence
from tests.discrepancy.made import SETTINGS, lag, residuals_of
from tests.effects.scenes import two_paths


@pytest.mark.parametrize(("low", "high"), [(-0.5, 0.4), (0.2, 1.0)])
def test_dead_zone_of_one_channel(low, high):
    u, a, b, e = two_paths(6, noise=0.05)
    y = a + lag(signals.dead_zone(u[:, 1], low, high), 0.8) + e
    found = dead_zone(residuals_of(y, a + 0.7 * b, u), SETTINGS)
    assert found.p_value < 1e-3
    assert found.where["channel"] == "v"
    assert found.where["low"] == pytest.approx(low, abs=0.2)
    assert found.where["high"] == pytest.approx(high, abs=0.2)
    refitted = with_channel(dgp.LinearDynamicGP(inputs=2, pairs=1), DeadZone("v", -8.0, 9.0))
    assert "from -8 to 9, about" in effects.DeadZoneOfInput().sentence(found, refitted)


def test_an_input_of_two_values_has_no_dead_zone_but_others_may():
    u, _, b, e = two_paths(6, noise=0.05)
    switch = (u[:, 0] > 0.0).astype(float)
    path = lag(switch, 0.5)
    y = path + lag(signals.dead_zone(u[:, 1], -0.5, 0.4), 0.8) + e
    found = dead_zone(residuals_of(y, path + 0.7 * b, np.column_stack([switch, u[:, 1]])), SETTINGS)
    assert found.p_value < 1e-3
    assert found.where["channel"] == "v"
    with pytest.raises(ValueError, match="expected an input of more than two values"):
        dead_zone(residuals_of(path + e, path, np.column_stack([switch, switch])), SETTINGS)


def test_an_input_that_saturates_has_no_dead_zone():
    u, a, b, e = two_paths(7, noise=0.05)
    r = residuals_of(a + lag(np.clip(u[:, 1], -0.7, 0.7), 0.8) + e, a + 0.7 * b, u)
    assert input_nonlinearity(r, SETTINGS).p_value < 1e-3
    assert dead_zone(r, SETTINGS).p_value > 0.05


def test_a_zone_moves_as_a_whole_and_is_told_as_refits_have_it():
    record = dgp.Record(np.arange(5.0), np.arange(5.0), np.ones(5), input_names=("u",))
    zone = DeadZone("u", -1.0, 1.0)
    model = with_channel(dgp.LinearDynamicGP(inputs=1, pairs=1), zone)
    finer = effects.DeadZoneOfInput().refine(model, record, 0)
    limits = {(round(one.channels[-1].low, 2), round(one.channels[-1].high, 2)) for one in finer}
    assert limits == {
        (-1.24, 1.0), (-1.0, 0.76), (-1.24, 0.76), (-0.76, 0.76),
        (-0.74, 1.0), (-1.0, 1.26), (-0.74, 1.26), (-1.26, 1.26),
    }  # fmt: skip
    said = "Channel 'u' has no effect on 'y' from -0.5 to 0.7, about 1 V (rms)."
    found = Evidence(
        "dead zone", 1.0, 0.01, 1.0, 1.0, {"channel": "u", "low": -0.5, "high": 0.7}, said, None
    )
    sentence = effects.DeadZoneOfInput().sentence(found, model)
    assert sentence == "Channel 'u' has no effect on 'y' from -1 to 1, about 1 V (rms)."
