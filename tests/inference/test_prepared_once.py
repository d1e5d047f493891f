"""A record is checked, scaled and put on its time grid once in a run, and once in a verb."""

from collections import Counter

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Step
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.lti.grid import TimeGrid
from pyro_dynogp.models import prepared
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.structure import Structure

ONCE = {"checked": 1, "scaled": 1, "grid": 1, "tensors": 1}
MODELS = {
    "linear": dgp.LinearDynamicGP(1, pairs=1),
    "Wiener": dgp.Wiener(1, pairs=1, inducing=4),
    "linear, a channel": dgp.LinearDynamicGP(2, pairs=1, direct=1, channels=(Step(4.0),)),
}


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(20), 4)
    y = np.convolve(u, 0.4 * 0.7 ** np.arange(12))[: len(u)]
    return dgp.Record(0.1 * np.arange(len(u)), u, y + 0.1 * rng.standard_normal(len(u)))


@pytest.fixture
def counts(monkeypatch):
    """How often a record was checked, scaled, copied to tensors, and its times made a grid."""
    found = Counter()

    def counted(owner, name, label):
        function = getattr(owner, name)

        def call(*args, **options):
            found[label] += 1
            return function(*args, **options)

        monkeypatch.setattr(owner, name, call)

    counted(Structure, "check", "checked")
    counted(prepared, "scaled_inputs", "scaled")
    counted(TimeGrid, "__init__", "grid")
    counted(Record, "tensors", "tensors")
    counted(Scaling, "from_records", "learnt")
    return found


@pytest.mark.parametrize("name", MODELS)
def test_once_a_run_and_once_a_verb(name, record, counts):
    fit = dgp.fit(
        MODELS[name], record, method="map", restarts=2, steps=10, workers=1, progress=False
    )
    times = 2 if name == "Wiener" else 1  # and in units of its own, see `inference.canonical`
    assert counts == {"checked": 1, "learnt": 1, "scaled": times, "grid": times, "tensors": times}
    past, future = record.split(60)
    for verb in (fit.predict, fit.simulate, fit.layers, fit.log_likelihood, fit.innovations):
        counts.clear()
        verb(record)
        assert counts == ONCE, verb
    if not fit.model.channels:
        counts.clear()
        fit.forecast(past, future)
        assert counts["checked"] == 2  # the past and the future


def test_several_records(record, counts):
    parts = record.split(40)
    dgp.fit(MODELS["linear"], parts, restarts=2, steps=5, workers=1, progress=False, method="map")
    assert counts == {"checked": 1, "scaled": 2, "grid": 2, "tensors": 2, "learnt": 1}


def test_what_is_prepared_is_taken_as_it_is(record, counts):
    model = MODELS["linear"].scaled_to(record)
    ready = model.prepare(record)
    counts.clear()
    assert model.prepare(ready) == ready
    assert not counts
    other = MODELS["linear"].scaled_to(record[:40])
    with pytest.raises(ValueError, match="records: expected records prepared with the model's sc"):
        other.prepare(ready)
    with pytest.raises(ValueError, match=r"records\[1\]: expected a Record, got Prepared"):
        model.prepare((record, *ready))


def test_signals_of_a_prepared_record(record):
    gap = record.with_outputs(np.where(np.arange(80) == 3, np.nan, record.outputs[:, 0]))
    scaling = Scaling.from_records(record)
    one = PreparedRecord.of(gap, scaling)
    u = (record.inputs - scaling.input_offset) / scaling.input_scale
    y = (gap.outputs - scaling.output_offset) / scaling.output_scale
    np.testing.assert_array_equal(one.scaled_inputs, u)
    np.testing.assert_array_equal(one.scaled_outputs, y)
    np.testing.assert_array_equal(one.grid.time, record.time)
    # Nothing is kept on the record that was given.
    assert "_prepared" not in record.__dict__
