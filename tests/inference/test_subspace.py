"""Starts from subspace identification."""

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.starts.linear import RANDOM, linear_starts
from pyro_dynogp.inference.starts.subspace import subspace_poles, subspace_starts
from pyro_dynogp.models.prepared import PreparedRecord
from tests.conftest import simulate_record

POLES = np.array([-0.4 + 2.0j, -1.0 + 5.0j])
MODES = dgp.Modes(POLES, [[1.0 + 0.3j], [-2.0 + 1.0j]], [1.0, 1.0], [[1e-4], [1e-4]])
CLEAN = simulate_record(MODES, 1e-4, n=400, step=0.1)


def prepared(*records):
    scaling = Scaling.from_records(records)
    return [PreparedRecord.of(record, scaling) for record in records]


def found(records, pairs, inputs=1):
    return subspace_poles(prepared(*records), pairs, inputs)


def near(poles, expected, error):
    return all(np.abs(poles - one).min() < error * abs(one) for one in expected)


def test_poles_of_a_record_without_noise():
    one, two, three = found((CLEAN,), 3)
    assert [len(poles) for poles in (one, two, three)] == [1, 2, 3]
    assert near(two, POLES, 2e-3)
    assert near(three, POLES, 0.05)
    assert (three.real < 0).all()
    assert (three.imag > 0).all()


def test_several_records_and_gaps():
    holes = CLEAN.outputs.copy()
    holes[[90, 91, 310]] = np.nan
    gaps = CLEAN.with_outputs(holes)
    assert near(found((gaps,), 2)[1], POLES, 5e-3)
    assert near(found((gaps[:180], CLEAN[200:]), 2)[1], POLES, 5e-3)


def test_two_outputs_share_poles():
    modes = dgp.Modes(POLES, [[1.0 + 0.3j], [-2.0 + 1.0j]], [[1.0, 0.3], [0.2j, 1.0]],
                      [[1e-4], [1e-4]])  # fmt: skip
    record = simulate_record(modes, torch.tensor([1e-4, 1e-4]).double(), n=400)
    assert near(found((record,), 2)[1], POLES, 5e-3)


def test_without_inputs_poles_are_those_of_the_noise():
    modes = dgp.Modes(POLES[:1], None, [1.0], [[1.0 + 0.5j]])
    record = simulate_record(modes, 1e-3, n=4000)
    assert near(found((record,), 1, inputs=0)[0], POLES[:1], 0.1)


def test_real_poles_make_pairs_and_unstable_ones_are_turned():
    from pyro_dynogp.inference.starts.subspace import _pairs

    scaling = Scaling.from_records((CLEAN,))
    step = scaling.time_step
    poles = _pairs(np.exp(step * np.array([-1.0, -3.0, -0.5, 0.2 + 4.0j, 0.2 - 4.0j])), scaling)
    np.testing.assert_allclose(poles, [-0.2 + 4.0j, -2.0 + 0.2j, -0.5 + 0.05j], rtol=1e-6)


def test_none_where_steps_differ_or_little_is_measured():
    time = CLEAN.time + 0.01 * np.sin(np.arange(400))
    assert found((dgp.Record(time, CLEAN.inputs, CLEAN.outputs),), 2) == []
    assert found((CLEAN[:30],), 2) == []
    every = np.where(np.arange(400)[:, None] % 10 == 0, np.nan, CLEAN.outputs)
    assert found((CLEAN.with_outputs(every),), 2) == []


def test_pairs_beyond_the_order_do_nothing():
    model = dgp.LinearDynamicGP(1, pairs=4).scaled_to(CLEAN)
    starts = subspace_starts(model, prepared(CLEAN), 0)
    assert len(starts) == 4
    for values in starts:
        gain = values["g_input_gain"].abs().sum((1, 2))
        assert gain.shape == (4,)
    silent = sorted(int((v["g_input_gain"].abs().sum((1, 2)) == 0).sum()) for v in starts)
    assert silent == [0, 1, 2, 3]


@pytest.mark.parametrize("count", [1, 2, 5, None])
def test_kinds_of_starts_take_turns(count):
    model = dgp.LinearDynamicGP(1, pairs=2).scaled_to(CLEAN)
    starts = linear_starts(model, prepared(CLEAN), count, 0)
    assert len(starts) == (count or 2 + RANDOM)
    best = subspace_starts(model, prepared(CLEAN), 0)[0]
    assert torch.equal(starts[0]["g_log_decay"], best["g_log_decay"])
