"""Data sets: the numbers of the originals, their protocols and their clocks."""

import re
from importlib import resources

import numpy as np
import pandas as pd
import pytest

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import as_records
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.examples import datasets


def refused(*parts):
    return pytest.raises(ValueError, match=".*".join(map(re.escape, parts)))


@pytest.fixture(scope="module")
def demand():
    return datasets.load("vic_elec")


# Samples, training samples, step, first and last output, as read off the original files.
FACTS = {
    "coupled_drives": (500, 400, 0.02, -0.021978, 2.5177),
    "coupled_drives_prbs": (500, 400, 0.02, 0.031746, 1.8779),
    "gas_furnace": (296, 148, 9.0, 53.8, 57.0),
    "heat_exchanger": (4000, 2000, 1.0, 98.6281, 95.5231),
    "robot_arm": (1024, 512, 1.0, -0.17703630, -0.16716420),
    "actuator": (1024, 512, 1.0, -0.00026240399999988284, -2.9190443000000004),
}


@pytest.mark.parametrize("name", FACTS)
def test_measured(name):
    n, k, step, first, last = FACTS[name]
    data = datasets.load(name)
    assert (len(data.full), len(data.train), len(data.test)) == (n, k, n - k)
    assert data.full.sampling_time == pytest.approx(step, rel=1e-12)
    assert data.full.outputs[0, 0] == first
    assert data.full.outputs[-1, 0] == last
    assert data.full.split(k) == (data.train, data.test)
    assert data.name == name
    assert data.truth is None
    assert not data.full.missing.any()


@pytest.mark.parametrize("name", datasets.names())
def test_every_data_set_is_usable(name, demand):
    data = demand if name == "vic_elec" else datasets.load(name)
    assert data.source
    assert str(len(data.test)) in data.protocol or name == "wh_process_noise"
    Scaling.from_records(data.train).check(data.test)
    assert 0 <= data.skip < len(data.test)


def test_drives_records():
    first, second = datasets.load("coupled_drives", record=1), datasets.load("coupled_drives")
    # The published records: the input of the second is that of the first, 0.5 V higher at first.
    assert first.full.inputs[0, 0] == 1.6961
    assert second.full.inputs[0, 0] == 2.1961
    assert first.full.outputs[-1, 0] == 1.5849
    assert second.skip == 4
    assert second.train.input_units == ("V",)
    assert len(as_records([first.train, second.train])) == 2
    amplitudes = [
        np.abs(datasets.load("coupled_drives_prbs", record=k).full.inputs).max() for k in (1, 2, 3)
    ]
    assert amplitudes == [1.0, 1.5, 0.5]


def test_gas_furnace_blanks():
    full = datasets.load("gas_furnace").full
    assert full.inputs[:3, 0].tolist() == [-0.109, 0.0, 0.178]
    assert full.output_units == ("%",)


def test_steps_that_are_not_stated():
    for name in ("robot_arm", "actuator"):
        assert datasets.load(name).full.time_unit == "sample"


def test_demand(demand):
    full = demand.full
    assert len(full) == 52608
    assert (len(demand.train), len(demand.test)) == (35040 - 8736, 8736)
    assert full.split(26304)[1][:8736] == demand.test
    assert full.outputs[[0, -1], 0].tolist() == [4382.825174, 3809.414586]
    assert full.inputs[1, 0] == 21.05
    assert (full.input_units, full.output_units) == (("degC",), ("MW",))
    assert full.timestamps[0] == pd.Timestamp("2012-01-01", tz="Australia/Melbourne")
    assert full.is_regular
    assert full.sampling_time == 1800


def test_holidays_are_local_days(demand):
    holiday = pd.Series(demand.full.extra["Holiday"], index=demand.full.timestamps)
    assert set(holiday) == {0.0, 1.0}
    by_day = holiday.groupby(holiday.index.date).nunique()
    assert (by_day == 1).all()  # a wrong zone would split days
    christmas = holiday[holiday.index.strftime("%m-%d") == "12-25"]
    assert christmas.all()


def test_later_test_of_demand(demand):
    later = datasets.load("vic_elec", test="2014")
    assert later.train == demand.train
    assert len(later.test) == 52608 - 35040
    assert later.test.timestamps[-1] == pd.Timestamp("2014-12-31 23:30", tz="Australia/Melbourne")
    assert later.test.time[0] == demand.test.time[-1] + 1800


def test_circuit():
    sine = datasets.load("wh_process_noise", test="swept sine")
    multi = datasets.load("wh_process_noise")
    assert len(multi.train) == 8192
    assert len(multi.test) == len(sine.test) == 16384
    assert multi.train.sampling_time == pytest.approx(1 / 78125)
    assert multi.train.inputs[0, 0] == 0.0025825
    assert multi.train.outputs[0, 0] == -0.038448
    assert multi.train.extra["r"][0] == -0.81494
    assert (multi.test.inputs[0, 0], multi.test.outputs[0, 0]) == (1.0325, -0.035855)
    assert (sine.test.inputs[0, 0], sine.test.outputs[0, 0]) == (0.02082, 0.013777)
    assert (sine.test.extra["r"][1], multi.test.extra["r"][1]) == (0.00044673, 0.1664)
    # The reference repeats after half the record; process noise makes the output differ.
    r, y = multi.train.extra["r"], multi.train.outputs[:, 0]
    np.testing.assert_array_equal(r[:4096], r[4096:])
    assert np.abs(y[:4096] - y[4096:]).max() > 0.1


def test_circuit_in_full(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"path: expected a folder with WH_Est.*realisation 0"
    ):
        datasets.load("wh_process_noise", path=tmp_path)
    header = ",".join(f'"{c}"' + "," * 9 for c in "ruy") + ',"fs",'
    values = np.arange(90).reshape(3, 30)
    rows = [
        ",".join(map(str, row)) + ("," if i else ",78125") + "," for i, row in enumerate(values)
    ]
    (tmp_path / "WH_EstimationExample.csv").write_text("\n".join([header, *rows]) + "\n")
    data = datasets.load("wh_process_noise", path=tmp_path)
    assert len(as_records(data.train)) == 10
    assert data.train[7].inputs[:, 0].tolist() == [17.0, 47.0, 77.0]
    assert data.train[7].outputs[:, 0].tolist() == [27.0, 57.0, 87.0]
    assert data.train[7].extra["r"].tolist() == [7.0, 37.0, 67.0]
    Scaling.from_records(data.train).check(data.test)


@pytest.mark.parametrize("name", ["lti", "wiener"])
def test_simulated(name):
    data = datasets.load(name, seed=5, samples=300, training_samples=200)
    assert len(data.test) == 100
    assert data.truth.clean_test.shape == (100,)
    assert data.train != datasets.load(name, samples=300, training_samples=200).train
    assert isinstance(data.full, Record)


def test_refusals():
    with refused("name", "'coupled_drives'", "'wiener'", "'nothing'"):
        datasets.load("nothing")
    with refused("options", "none", "'seed'"):
        datasets.load("gas_furnace", seed=1)
    with refused("options", "'record'", "'seed'"):
        datasets.load("coupled_drives", seed=1)
    with refused("options", "'samples'", "'length'"):
        datasets.load("lti", length=3)
    for record in (0, 3, True, "1"):
        with refused("record", "[1, 2]", repr(record)):
            datasets.load("coupled_drives", record=record)
    with refused("record", "[1, 2, 3]", "4"):
        datasets.load("coupled_drives_prbs", record=4)
    with refused("test", "'2014'", "'2015'"):
        datasets.load("vic_elec", test="2015")
    with refused("test", "'swept sine'", "'sine'"):
        datasets.load("wh_process_noise", test="sine")


def test_size_of_the_data():
    folder = resources.files("pyro_dynogp.examples").joinpath("records")
    files = [f for f in folder.iterdir() if f.name.endswith(".xz")]
    assert len(files) == 9
    assert sum(len(f.read_bytes()) for f in files) < 1.9e6
    readme = folder.joinpath("README.md").read_text(encoding="utf-8")
    assert all(f"`{f.name}`" in readme for f in files)
