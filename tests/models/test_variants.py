"""Models with one block more."""

from __future__ import annotations

from dataclasses import replace

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import DeadZone, Play, Recorded, Trend
from pyro_dynogp.models.feedback_variants import with_feedback
from pyro_dynogp.models.variants import with_channel, with_channels_of, with_pairs

BASE = with_channel(dgp.LinearDynamicGP(1, pairs=1), Recorded("w"))
ZONE, LINE = DeadZone("u", -1.0, 1.0), Trend(0.0, 9.0)
SPRING = with_feedback(BASE)


def test_channels_of_one_model_go_to_another() -> None:
    other = with_channel(with_channel(BASE, ZONE), LINE)
    found = with_channels_of(SPRING, other, BASE)
    assert found == with_channel(with_channel(SPRING, ZONE), LINE)
    assert found.inputs == SPRING.inputs + 1  # a dead zone replaces its input
    assert found.direct == 1
    assert found.layers == SPRING.layers


def test_what_is_no_channel_of_its_own_does_not() -> None:
    zone = with_channel(BASE, ZONE)
    # Play of the same input would be of one that the dead zone has replaced.
    assert with_channels_of(with_channel(BASE, Play("u", 0.1)), zone, BASE) is None
    assert with_channels_of(SPRING, with_pairs(zone, 1), BASE) is None
    assert with_channels_of(SPRING, SPRING, BASE) is None
    assert with_channels_of(SPRING, BASE, BASE) is None
    # One of the channels of the base is gone.
    swapped = replace(BASE, channels=(ZONE,))
    assert with_channels_of(SPRING, swapped, BASE) is None
