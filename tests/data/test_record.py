"""Record: what it refuses, and that no operation on it moves a sample off its clock."""

import copy
import dataclasses
import datetime
import pickle
import re

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import as_records


def example(n=6, **changes):
    fields = {
        "time": np.arange(n) * 0.5,
        "inputs": np.column_stack([np.arange(n), -np.arange(n)]),
        "outputs": np.arange(n) ** 2.0,
        "input_names": ["flow", "heat"],
        "output_names": ["level"],
        "input_units": ["l/s", "W"],
        "output_units": ["m"],
        "extra": {"rain": np.arange(n) + 0.25},
        "extra_units": {"rain": "mm"},
        "name": "tank",
    }
    return Record(**(fields | changes))


def refused(*parts):
    return pytest.raises(ValueError, match=".*".join(map(re.escape, parts)))


def stamps(n=4, zone="Europe/Vienna", start="2024-10-27 00:00", step="1h"):
    return pd.date_range(start, periods=n, freq=step, tz=zone)


class TestContents:
    def test_types_and_shapes(self):
        record = example()
        assert record.time.dtype == record.inputs.dtype == record.outputs.dtype == np.float64
        assert (record.inputs.shape, record.outputs.shape) == ((6, 2), (6, 1))
        assert (len(record), record.n_inputs, record.n_outputs) == (6, 2, 1)

    def test_none_is_no_channel(self):
        record = Record(time=[0.0, 1.0])
        assert record.inputs.shape == record.outputs.shape == (2, 0)

    def test_default_names(self):
        record = Record([0, 1], np.zeros((2, 1)), np.zeros((2, 2)))
        assert record.input_names == ("u",)
        assert record.output_names == ("y1", "y2")
        assert record.input_units == ("",)

    def test_one_name_as_text(self):
        assert Record([0, 1], [1, 2], input_names="flow").input_names == ("flow",)

    def test_source_arrays_are_copied(self):
        source = np.zeros(3)
        record = Record([0, 1, 2], source)
        source[0] = 7
        assert record.inputs[0, 0] == 0

    @pytest.mark.parametrize("field", ["time", "inputs", "outputs"])
    def test_arrays_are_read_only(self, field):
        with pytest.raises(ValueError, match="read-only"):
            getattr(example(), field)[0] = 1

    def test_extra_is_read_only(self):
        with pytest.raises(TypeError):
            example().extra["rain"] = np.zeros(6)
        with pytest.raises(ValueError, match="read-only"):
            example().extra["rain"][0] = 1

    def test_fields_are_frozen(self):
        with pytest.raises(dataclasses.FrozenInstanceError):
            example().name = "other"

    @pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.int64, torch.bool])
    def test_tensors_of_any_real_type(self, dtype):
        record = Record([0, 1], torch.tensor([0, 1]).to(dtype))
        np.testing.assert_array_equal(record.inputs[:, 0], [0.0, 1.0])

    def test_tensor_with_gradient(self):
        assert Record([0], torch.ones(1, requires_grad=True)).inputs[0, 0] == 1

    def test_masked_and_nullable_values_are_missing(self):
        masked = np.ma.masked_array([1.0, 2.0], mask=[False, True])
        nullable = pd.Series([1, None], dtype="Int64")
        for outputs in (masked, nullable, [1, None]):
            assert Record([0, 1], outputs=outputs).missing[:, 0].tolist() == [False, True]

    def test_tensors_are_fresh_float64_copies(self):
        record = example()
        record.tensors().outputs[0] = 9.0
        tensors = record.tensors()
        assert tensors.inputs.dtype == tensors.time.dtype == torch.float64
        assert tensors.outputs[0] == 0.0
        np.testing.assert_array_equal(tensors.inputs.numpy(), record.inputs)

    @pytest.mark.parametrize(("outputs", "shape"), [(0, (3, 0)), (1, (3,)), (2, (3, 2))])
    def test_observations_of_one_output_are_a_series(self, outputs, shape):
        record = Record([0, 1, 2], outputs=np.arange(3.0 * outputs).reshape(3, outputs))
        found = record.tensors().observations
        assert found.shape == shape
        np.testing.assert_array_equal(found.reshape(3, -1).numpy(), record.outputs)


class TestRefusals:
    def test_empty(self):
        with refused("time", "one sample or more", "empty record"):
            Record([])
        with refused("time", "empty record"):
            Record(stamps(4)[:0])

    @pytest.mark.parametrize("values", [np.zeros(3), np.zeros((3, 2)), np.zeros((4, 1, 1)), 1.0])
    def test_wrong_shape(self, values):
        with refused("inputs", "(4,) or (4, channels)", str(np.shape(values))):
            Record(np.arange(4), values)

    def test_transposed(self):
        with refused("outputs", "(2, 4)", "Transpose it"):
            Record(np.arange(4), outputs=np.zeros((2, 4)))

    def test_extra_of_two_columns(self):
        with refused("extra['rain']", "shape (6,)"):
            example(extra={"rain": np.zeros((6, 2))})

    @pytest.mark.parametrize(
        "values",
        [["1", "2"], [1, "b"], [1j, 2], np.array(["2020"] * 2, "M8[D]"), torch.ones(2) * 1j],
    )
    def test_not_numbers(self, values):
        with refused("outputs: expected real numbers"):
            Record([0, 1], outputs=values)

    def test_ragged(self):
        with refused("inputs: expected real numbers"):
            Record([0, 1], [[1, 2], [3]])

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_inputs_with_gaps(self, bad):
        inputs = np.zeros((9, 2))
        inputs[1:8, 1] = bad
        with refused(f"got {bad}", "'heat'", "7 rows: 1, 2, 3, 4, 5, ...", "Fill", "slicing"):
            Record(np.arange(9), inputs, input_names=["flow", "heat"])

    def test_infinite_outputs_and_extra(self):
        with refused("outputs", "NaN (missing)", "inf in column 'y'", "1 rows: 1."):
            Record([0, 1], outputs=[0, np.inf])
        with refused("extra['a']", "inf"):
            Record([0, 1], extra={"a": [0, np.inf]})

    def test_time_goes_back(self):
        with refused("strictly increasing", "a step back at index 2: 1.0 then 0.5", "Sort"):
            Record([0, 1, 0.5, 0.2])

    def test_time_repeats(self):
        with refused("a repeated time stamp at index 3: 2.0 then 2.0"):
            Record([0, 1, 2, 2])
        with refused("a repeated time stamp at index 1", "2024-10-27 00:00:00+02:00"):
            Record(stamps(2).repeat(2)[:3])

    def test_time_not_finite(self):
        with refused("time", "finite", "nan in row 1"):
            Record([0, np.nan])

    def test_time_of_two_columns(self):
        with refused("time", "shape (n,)", "(2, 1)"):
            Record([[0], [1]])

    @pytest.mark.parametrize("field", ["input_names", "input_units"])
    def test_wrong_number_of_names_or_units(self, field):
        with refused(field, "2", "got 1: ['a']"):
            example(**{field: ["a"]})

    @pytest.mark.parametrize("names", [["a", ""], ["a", 3]])
    def test_names_that_are_none(self, names):
        with refused("input_names", "2 non-empty texts"):
            example(input_names=names)

    @pytest.mark.parametrize(
        "changes",
        [
            {"input_names": ["a", "a"]},
            {"output_names": ["flow"]},
            {"extra": {"level": np.zeros(6)}, "extra_units": None},
        ],
    )
    def test_name_collisions(self, changes):
        with refused("names", "each channel name once", "2 times"):
            example(**changes)

    def test_unit_of_unknown_extra(self):
        with refused("extra_units", "['rain']", "['snow']"):
            example(extra_units={"snow": "mm"})

    def test_time_unit(self):
        with refused("time_unit", "text"):
            Record([0], time_unit=1)
        with refused("time_unit", '"s" with time stamps', "'h'"):
            Record(stamps(), time_unit="h")


class TestTimeStamps:
    def test_seconds_since_the_first(self):
        record = Record(stamps(4))
        # The clocks of Vienna go back on this night: four stamps, still an hour apart.
        assert record.time.tolist() == [0.0, 3600.0, 7200.0, 10800.0]
        assert record.start == pd.Timestamp("2024-10-27 00:00+02:00")
        assert [t.hour for t in record.timestamps] == [0, 1, 2, 2]
        assert str(record.timestamps.tz) == "Europe/Vienna"
        assert Record([0.0]).timestamps is None

    def test_list_series_and_index_agree(self):
        index = stamps(4)
        same = {Record(t) for t in (index, pd.Series(index), list(index), index.to_pydatetime())}
        assert len(same) == 1

    def test_timestamps_are_exact_over_years(self):
        index = pd.date_range("2012-01-01", periods=52608, freq="30min", tz="UTC")
        assert (Record(index).timestamps == index).all()

    def test_fractions_of_a_second_after_years(self):
        # Float64 seconds are off by some nanoseconds here; the stamps must not be.
        index = pd.DatetimeIndex(["2012-01-01T00:00:00.300000Z", "2019-01-01T00:00:00.700001Z"])
        assert (Record(index).timestamps == index).all()

    def test_nanoseconds_survive_short_records(self):
        index = pd.DatetimeIndex(
            pd.to_datetime([10**18, 10**18 + 1, 10**18 + 5 * 10**15], unit="ns", utc=True)
        )
        assert (Record(index).timestamps == index).all()

    @pytest.mark.parametrize(
        "naive",
        [
            pd.date_range("2024-01-01", periods=2, freq="1h"),
            np.array(["2024-01-01", "2024-01-02"], "M8[ns]"),
            [datetime.datetime(2024, 1, 1), datetime.datetime(2024, 1, 2)],
        ],
    )
    def test_naive_stamps(self, naive):
        with refused("time zone", "ambiguous", 'tz_localize("UTC")', "zone of the plant"):
            Record(naive)

    def test_a_missing_stamp(self):
        with refused("time", "a time stamp for each sample", "row 1"):
            Record(pd.DatetimeIndex([stamps(1)[0], pd.NaT]))

    def test_start_without_zone(self):
        with refused("start", "time zone"):
            Record([0.0], start="2024-01-01")
        with refused("start", "a time stamp", "'noon'"):
            Record([0.0], start="noon")

    def test_numbers_with_a_start(self):
        record = Record([5.0, 6.0], start=pd.Timestamp("2024-01-01", tz="UTC"))
        assert record.timestamps[0] == pd.Timestamp("2024-01-01 00:00:05", tz="UTC")


class TestSlices:
    def test_clock_goes_on(self):
        train, test = example(6).split(4)
        assert test.time.tolist() == [2.0, 2.5]
        train, test = Record(stamps(4)).split(3)
        assert test.start == train.start
        assert test.time.tolist() == [10800.0]
        assert test.timestamps[0] == stamps(4)[3]

    @pytest.mark.parametrize("at", ["2024-10-27 02:00+02:00", "2024-10-27T00:00Z"])
    def test_split_at_an_instant(self, at):
        first, second = Record(stamps(4)).split(at)
        assert (len(first), len(second)) == (2, 2)
        assert Record(stamps(4)).split(pd.Timestamp(at)) == (first, second)

    @pytest.mark.parametrize("at", [0, 6, 7, -1])
    def test_split_without_samples_on_one_side(self, at):
        with refused("at", "both sides, 1 to 5", repr(at)):
            example(6).split(at)

    @pytest.mark.parametrize("at", [2.0, True, None])
    def test_split_at_what_is_no_index(self, at):
        with refused("at", "an int", repr(at), "searchsorted"):
            example().split(at)

    def test_split_at_an_instant_without_stamps(self):
        with refused("at", "a sample index"):
            example().split("2024-10-27T00:00Z")
        with refused("at", "time zone"):
            Record(stamps()).split("2024-10-27 01:00")

    @pytest.mark.parametrize("key", [3, [1, 2], np.array([True] * 6), (slice(2), 0), "flow"])
    def test_only_slices(self, key):
        with refused("record[...]", "a slice such as", type(key).__name__, "with_outputs"):
            example()[key]

    def test_wrong_slices(self):
        with refused("positive step", "step -1"):
            example()[::-1]
        with refused("holds a sample", "The record has 6 samples"):
            example()[6:]
        with refused("sample numbers", "record.split takes time stamps"):
            example()[0.5:2.0]
        with refused("sample numbers"):
            example()[::0]

    @given(st.data())
    @settings(max_examples=50, deadline=None)
    def test_split_and_concatenate(self, data):
        n = data.draw(st.integers(2, 20))
        record = example(n)
        parts = record.split(data.draw(st.integers(1, n - 1)))
        again = dataclasses.replace(
            record,
            time=np.concatenate([p.time for p in parts]),
            inputs=np.concatenate([p.inputs for p in parts]),
            outputs=np.concatenate([p.outputs for p in parts]),
            extra={"rain": np.concatenate([p.extra["rain"] for p in parts])},
        )
        assert again == record
        assert again.fingerprint == record.fingerprint

    @given(
        st.integers(1, 20), st.integers(-25, 25) | st.none(), st.integers(-25, 25) | st.none(),
        st.integers(1, 4),
    )  # fmt: skip
    @settings(max_examples=100, deadline=None)
    def test_channels_stay_together(self, n, a, b, step):
        record, rows = example(n), np.arange(n)[a:b:step]
        if not len(rows):
            with refused("holds a sample"):
                record[a:b:step]
            return
        part = record[a:b:step]
        np.testing.assert_array_equal(part.time, rows * 0.5)
        np.testing.assert_array_equal(part.inputs[:, 1], -rows)
        np.testing.assert_array_equal(part.outputs[:, 0], rows**2)
        np.testing.assert_array_equal(part.extra["rain"], rows + 0.25)
        assert (part.extra_units, part.input_units, part.name) == (
            record.extra_units, record.input_units, record.name,
        )  # fmt: skip


class TestChannels:
    def test_select_orders_and_keeps_the_rest(self):
        record = example().select(inputs=["heat"])
        assert record.input_names == ("heat",)
        assert record.input_units == ("W",)
        np.testing.assert_array_equal(record.inputs[:, 0], -np.arange(6))
        assert list(record.extra) == ["flow", "rain"]
        assert dict(record.extra_units) == {"flow": "l/s", "rain": "mm"}

    def test_select_swaps(self):
        record = example()
        swapped = record.select(inputs=["heat", "flow"])
        np.testing.assert_array_equal(swapped.inputs, record.inputs[:, ::-1])
        assert swapped.select(inputs=["flow", "heat"]) == record

    def test_select_no_outputs(self):
        record = example().select(outputs=[])
        assert record.n_outputs == 0
        assert "level" in record.extra

    def test_select_refuses(self):
        with refused("inputs", "['flow', 'heat', 'level', 'rain']", "'wind'"):
            example().select(inputs=["wind"])
        with refused("names", "'level' 2 times"):
            example().select(inputs=["level"])

    def test_extra_becomes_input(self):
        record = example().with_extra_as_input("rain")
        assert record.input_names == ("flow", "heat", "rain")
        assert record.input_units[2] == "mm"
        assert not record.extra
        with refused("name", "['rain']", "'flow'"):
            example().with_extra_as_input("flow")
        with refused("inputs", "nan in column 'rain'"):
            example(extra={"rain": [0, np.nan, 0, 0, 0, 0]}).with_extra_as_input("rain")

    def test_with_outputs(self):
        new = example().with_outputs(np.full(6, np.nan))
        assert new.missing.all()
        assert (new.output_names, new.output_units) == (("level",), ("m",))
        two = example().with_outputs(np.ones((6, 2)), names=["a", "b"])
        assert (two.output_names, two.output_units) == (("a", "b"), ("", ""))
        with refused("outputs", "1 columns", "got 2", "names="):
            example().with_outputs(np.ones((6, 2)))

    def test_resample_is_refused(self):
        with refused("resample", "aliases", "invents inputs", "Irregular", "decimate"):
            example().resample(0.1)


class TestClock:
    def test_regular(self):
        record = Record(np.arange(8192) / 78125)
        assert record.is_regular
        assert record.sampling_time == pytest.approx(1 / 78125, rel=1e-13)
        assert record.duration == 8191 / 78125

    def test_regular_at_a_late_time(self):
        # Stamps near 1e9 s carry 1e-7 s of rounding, which is no irregularity.
        assert Record(1e9 + np.arange(1000) * 0.01).is_regular
        assert not Record(1e9 + np.arange(1000) * 0.01 + 1e-5 * (np.arange(1000) == 7)).is_regular

    def test_irregular(self):
        record = Record([0, 1, 2, 4])
        assert not record.is_regular
        assert record.sampling_time == 1.0
        assert not Record([0, 1, 2 + 3e-9]).is_regular

    def test_one_sample_has_no_step(self):
        record = Record([3.0])
        assert (record.duration, record.is_regular) == (0.0, True)
        with refused("two samples or more"):
            _ = record.sampling_time
        assert "step=none" in repr(record)


class TestIdentity:
    def test_equality_is_by_content(self):
        assert example() == example(name="other name")
        assert hash(example()) == hash(example())
        assert example() != "record"

    @pytest.mark.parametrize(
        "changes",
        [
            {"time": np.arange(6) * 0.25},
            {"inputs": np.ones((6, 2))},
            {"outputs": np.ones(6)},
            {"input_names": ["flow", "cold"]},
            {"input_units": ["l/s", "kW"]},
            {"time_unit": "h"},
            {"extra": {"rain": np.zeros(6)}},
            {"extra_units": {"rain": "cm"}},
            {"start": pd.Timestamp("2024-01-01", tz="UTC")},
        ],
    )
    def test_any_difference_counts(self, changes):
        assert example() != example(**changes)

    def test_missing_samples_are_equal(self):
        outputs = [np.nan] + [0.0] * 5
        assert example(outputs=outputs) == example(outputs=outputs)

    def test_fingerprint(self):
        same = example(input_units=["", ""], name="z", extra=None,
                       extra_units=None)  # fmt: skip
        assert same.fingerprint == example().fingerprint
        assert len(same.fingerprint) == 64
        assert example(outputs=np.arange(6) ** 2.0 + 1e-15).fingerprint != same.fingerprint
        assert example(output_names=["z"]).fingerprint != same.fingerprint

    def test_fingerprint_tells_inputs_from_outputs(self):
        one = Record([0, 1], inputs=[1, 2], input_names=["a"])
        other = Record([0, 1], outputs=[1, 2], output_names=["a"])
        assert one.fingerprint != other.fingerprint

    def test_equal_records_hash_alike(self):
        plus, minus = (Record([0, 1], [zero, 1.0]) for zero in (0.0, -0.0))
        assert plus == minus
        assert hash(plus) == hash(minus)

    @pytest.mark.parametrize("record", [example(), Record(stamps())[1:]])
    def test_pickle_and_copy(self, record):
        for again in (pickle.loads(pickle.dumps(record)), copy.deepcopy(record)):
            assert again == record
            assert again.name == record.name
            assert not again.inputs.flags.writeable

    def test_repr_and_summary(self):
        record = example(outputs=[np.nan, 1, 2, 3, 4, 10])
        assert repr(record).count("\n") == 0
        for part in ("'tank'", "n=6", "0.5 s", "'flow', 'heat'", "'level'", "missing=1", "rain"):
            assert part in repr(record)
        assert "irregular" in repr(Record([0, 1, 3]))
        rows = {line.split()[0]: line.split()[1:] for line in record.summary().splitlines()[2:]}
        assert rows["level"] == ["output", "m", "1", "4", "10", "1"]
        assert rows["heat"] == ["input", "W", "-5", "-2.5", "0", "0"]
        assert rows["rain"][0] == "extra"

    def test_summary_without_a_sample_of_a_channel(self):
        assert "nan" in Record([0, 1], outputs=[np.nan, np.nan]).summary()


class TestSequences:
    def test_one_and_several(self):
        assert as_records(example()) == (example(),)
        assert as_records([example(4), example(6)]) == (example(4), example(6))

    def test_refusals(self):
        with refused("records", "one Record or more", "empty"):
            as_records([])
        with refused("records", "a Record or a sequence", "ndarray", "Build one"):
            as_records(np.zeros(3))
        with refused("records[1]", "a Record", "int"):
            as_records([example(), 3])

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("input_names", ("heat", "flow")),
            ("output_names", ("z",)),
            ("input_units", ("l/h", "W")),
            ("output_units", ("cm",)),
            ("time_unit", "h"),
        ],
    )
    def test_mismatch_is_named(self, field, value):
        with refused(f"records[1].{field}", "as in records[0]", str(value)):
            as_records([example(), example(**{field: value})])


@pytest.mark.parametrize(
    "cells",
    [
        np.array([1.0, None, 3.0], dtype=object),
        pd.array([1, None, 3], dtype="Int64"),
        pd.array([1.0, None, 3.0], dtype="Float64"),
        np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False]),
        [1.0, None, 3.0],
    ],
    ids=["object", "Int64", "Float64", "masked", "list"],
)
def test_a_missing_cell_is_missing_in_whatever_it_comes(cells):
    """Of an output; an input has to be known."""
    record = Record([0.0, 1.0, 2.0], [1.0, 2.0, 4.0], cells)
    np.testing.assert_array_equal(record.outputs[:, 0], [1.0, np.nan, 3.0])
    with refused("inputs", "finite numbers", "nan", "rows: 1"):
        Record([0.0, 1.0, 2.0], cells, [1.0, 2.0, 4.0])
