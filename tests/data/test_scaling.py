"""Scaling: statistics of the training data alone, and the check of later records against them."""

import json
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling


def refused(*parts):
    return pytest.raises(ValueError, match=".*".join(map(re.escape, parts)))


def example(n=5, seed=0, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "time": np.arange(n) * 0.1,
        "inputs": rng.normal(3, 2, (n, 2)),
        "outputs": rng.normal(-5, 0.1, n),
        "input_names": ["a", "b"],
        "output_names": ["y"],
        "input_units": ["V", "A"],
        "output_units": ["m"],
    }
    return Record(**(fields | changes))


def test_statistics():
    record = Record([0, 1, 2, 4], [0, 0, 2, 2], [1, np.nan, 3, 5], time_unit="h")
    scaling = Scaling.from_records(record)
    assert scaling.input_offset.tolist() == [1.0]
    assert scaling.input_scale.tolist() == [1.0]
    assert scaling.output_offset.tolist() == [3.0]
    assert scaling.output_scale[0] == pytest.approx(np.sqrt(8 / 3), rel=1e-15)
    assert (scaling.time_step, scaling.duration, scaling.time_unit) == (1.0, 4.0, "h")


def test_records_are_pooled():
    one, two = example(4, seed=1), example(9, seed=2)
    scaling = Scaling.from_records([one, two])
    pooled = np.concatenate([one.inputs, two.inputs])
    np.testing.assert_allclose(scaling.input_offset, pooled.mean(0), rtol=1e-14)
    np.testing.assert_allclose(scaling.input_scale, pooled.std(0), rtol=1e-14)
    assert scaling.duration == two.duration
    assert scaling.time_step == pytest.approx(0.1)


@given(
    arrays(np.float64, 8, elements=st.floats(-10, 10), unique=True),
    st.floats(0.1, 1e3),
    st.floats(-100, 100),
)
@settings(max_examples=60, deadline=None)
def test_affine_change_of_units(values, gain, shift):
    if np.std(values) < 1e-3:
        return
    plain = Scaling.from_records(Record(np.arange(8), outputs=values))
    moved = Scaling.from_records(Record(np.arange(8), outputs=values * gain + shift))
    np.testing.assert_allclose(moved.output_scale, plain.output_scale * gain, rtol=1e-6)
    np.testing.assert_allclose(
        moved.output_offset, plain.output_offset * gain + shift, rtol=1e-9, atol=1e-9
    )


def test_no_inputs_is_fine():
    assert Scaling.from_records(Record([0, 1], outputs=[1, 2])).input_scale.shape == (0,)


def test_arrays_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        Scaling.from_records(example()).output_scale[0] = 1


@pytest.mark.parametrize("size", [0.0, 3.0, 1e-30, 1e30])
def test_constant_output(size):
    with refused("output 'y'", "a signal that varies", f"{size:g}", "nothing to identify"):
        Scaling.from_records(example(outputs=np.full(5, size)))


def test_constant_up_to_rounding():
    wiggle = 1e6 + 1e-9 * np.arange(5)
    with refused("output 'y'", "varies", "differ by rounding alone", "less the level"):
        Scaling.from_records(example(outputs=wiggle))
    assert Scaling.from_records(example(outputs=wiggle - 1e6)).output_scale[0] > 0


@pytest.mark.parametrize("size", [1e-310, 1e-200, 1e160, 1e300])
@pytest.mark.parametrize("role", ["inputs", "outputs"])
def test_numbers_whose_squares_are_none(role, size):
    """They are no constants, and what is made of them has no variance, or an infinite one."""
    wave = size * np.sin(np.arange(5.0))
    signal = {"inputs": np.column_stack([np.arange(5), wave]), "outputs": wave}[role]
    name = {"inputs": "input 'b'", "outputs": "output 'y'"}[role]
    with refused(name, "numbers of a size between 1e-100 and 1e+100", "another unit"):
        Scaling.from_records(example(**{role: signal}))


def test_constant_input():
    inputs = np.column_stack([np.arange(5), np.full(5, 2.5)])
    with refused("input 'b'", "the constant 2.5", "Leave the input out", "offset"):
        Scaling.from_records(example(inputs=inputs))


def test_constant_within_each_record_is_no_constant():
    records = [example(inputs=np.full((5, 2), level)) for level in (1.0, 2.0)]
    assert Scaling.from_records(records).input_scale.tolist() == [0.5, 0.5]


def test_scales_of_another_for_the_channels_that_it_has():
    short, long = (Scaling.from_records(example(n, seed=n)) for n in (5, 9))
    assert long.with_scales_of(short) == short
    wider = Scaling.from_records(
        example(9, seed=9, inputs=np.arange(27.0).reshape(9, 3) ** 2, input_names=["a", "w", "b"],
                input_units=["V", "", "A"])
    )  # fmt: skip
    found = wider.with_scales_of(short)
    assert (found.time_step, found.duration) == (short.time_step, short.duration)
    for field in ("offset", "scale"):
        (a, b), (_, w, _) = (getattr(s, f"input_{field}") for s in (short, wider))
        assert getattr(found, f"input_{field}").tolist() == [a, w, b]
        assert getattr(found, f"output_{field}") == getattr(short, f"output_{field}")
    assert found.input_names == ("a", "w", "b")
    assert found.input_order == wider.input_order


def test_nothing_to_learn_from():
    with refused("output 'y'", "missing samples alone"):
        Scaling.from_records(example(outputs=np.full(5, np.nan)))
    with refused("records", "an output to learn from"):
        Scaling.from_records(Record([0, 1], [1, 2]))
    with refused("records", "two samples"):
        Scaling.from_records(Record([0], outputs=[1]))
    with refused("records", "ndarray"):
        Scaling.from_records(np.zeros(3))


class TestCheck:
    def test_the_same_channels_pass(self):
        Scaling.from_records(example()).check(example(9, seed=3))

    @pytest.mark.parametrize(
        ("changes", "parts"),
        [
            ({"input_names": ["b", "a"]}, ["input_names", "['a', 'b']", "['b', 'a']", "select"]),
            ({"output_names": ["z"]}, ["output_names", "['y']", "['z']"]),
            ({"input_units": ["V", "mA"]}, ["input 'b'", "'A'", "'mA'", "Convert", "mismatch"]),
            ({"output_units": ["mm"]}, ["output 'y'", "'m'", "'mm'", "Convert"]),
            ({"time_unit": "h"}, ["time_unit", "'s'", "'h'", "Convert"]),
            (
                {"inputs": np.ones((5, 1)), "input_names": ["a"], "input_units": ["V"]},
                ["input_names", "['a', 'b']", "['a']"],
            ),
        ],
    )
    def test_any_difference_is_refused(self, changes, parts):
        with refused(*parts):
            Scaling.from_records(example()).check(example(**changes))

    def test_simulation_needs_no_outputs(self):
        scaling = Scaling.from_records(example())
        inputs_alone = example(outputs=None, output_names=None, output_units=None)
        scaling.check(inputs_alone, outputs=False)
        with refused("output_names"):
            scaling.check(inputs_alone)


class TestDict:
    @given(arrays(np.float64, (6, 1), elements=st.floats(-1e9, 1e9), unique=True))
    @settings(max_examples=40, deadline=None)
    def test_json_round_trip_to_the_bit(self, outputs):
        try:
            scaling = Scaling.from_records(Record(np.arange(6) / 3, outputs=outputs))
        except ValueError:
            assert np.std(outputs) <= 1e-11 * np.abs(outputs).max()
            return
        again = Scaling.from_dict(json.loads(json.dumps(scaling.to_dict())))
        assert again == scaling
        assert hash(again) == hash(scaling)
        assert again.output_scale.tobytes() == scaling.output_scale.tobytes()

    def test_names_and_units_survive(self):
        scaling = Scaling.from_records(example())
        again = Scaling.from_dict(json.loads(json.dumps(scaling.to_dict())))
        assert again.input_units == ("V", "A")
        again.check(example())

    def test_equality(self):
        assert Scaling.from_records(example()) != Scaling.from_records(example(seed=1))
        assert Scaling.from_records(example()) != "scaling"

    def test_refusals(self):
        plain = Scaling.from_records(example()).to_dict()
        with refused("plain", "time_unit"):
            Scaling.from_dict({k: v for k, v in plain.items() if k != "time_unit"})
        with refused("plain", "surplus"):
            Scaling.from_dict(plain | {"surplus": 1})
        with refused("plain", "float.hex"):
            Scaling.from_dict(plain | {"time_step": "zero"})
        with refused("plain", "float.hex"):
            Scaling.from_dict(plain | {"input_scale": [1.0, 2.0]})
