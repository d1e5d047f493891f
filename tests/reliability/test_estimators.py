"""Every public function and verb of the table: the same numbers wherever and however it is called.

In the manner of scikit-learn's `check_estimator`: modes of torch, handlers of Pyro, other threads
and processes, copies of results, other layouts of memory, any number of workers. An entry of the
table is checked here unless it says why it cannot be.
"""

import contextlib
import copy
import dataclasses
import pickle
import warnings
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pandas as pd
import pyro
import pytest
import torch
import xarray as xr

import pyro_dynogp as dgp
from tests.reliability.table import QUICK, TABLE, World
from tests.reliability.test_surroundings import AROUND, named

# Pyro models and distributions must see what is around them.
SEE = {"sample_modes", "sample_static", "static_gp"}
CHECKED = [name for name, entry in TABLE.items() if not entry.late and name not in SEE]
# What users build their own models of is made on the default device, as torch's own objects are.
ON_A_DEVICE = {"Modes", "LTIProcess", "LTIKernel", "LTIMean"}
# Modes and handlers together: one by one they are in `test_surroundings.py`.
TORCH = ("inference mode", "autocast", "another default type", "another default device",
         "denormals flushed")  # fmt: skip
PYRO = ("a plate", "a trace", "a condition", "a scale", "a mask", "a seed", "no validation")


def numbers(value, trail="", found=None):
    """Every number and text that a result consists of, by where it is."""
    found = {} if found is None else found
    if isinstance(value, torch.Tensor):
        value = value.detach().resolve_conj().numpy()
    if isinstance(value, np.ndarray) and value.dtype != object:
        found[trail] = (str(value.dtype), value.shape, value.tobytes())
    elif value is None or isinstance(value, bool | int | str | bytes | type):
        found[trail] = value
    elif isinstance(value, float | complex | np.generic):
        found[trail] = repr(value)
    elif isinstance(value, pd.DataFrame | pd.Series | pd.Index | pd.Timestamp):
        found[trail] = value.to_json() if isinstance(value, pd.DataFrame) else str(value)
    elif isinstance(value, xr.Dataset | xr.DataArray):
        inside = value.data_vars if isinstance(value, xr.Dataset) else {"": value}
        for name, one in inside.items():
            numbers(np.asarray(one.values), f"{trail}.{name}", found)
    elif hasattr(value, "groups") and callable(value.groups):
        for group in value.groups():
            numbers(value[group], f"{trail}.{group}", found)
    elif isinstance(value, Mapping):
        for key in value:
            numbers(value[key], f"{trail}[{key}]", found)
    elif isinstance(value, list | tuple | np.ndarray):
        for place, one in enumerate(value):
            numbers(one, f"{trail}[{place}]", found)
    elif isinstance(value, torch.nn.Module):
        numbers(dict(value.state_dict()), trail, found)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if field.name == "sampler":  # a function, which becomes its numbers in a pickle
                continue
            numbers(getattr(value, field.name), f"{trail}.{field.name}", found)
    else:
        found[trail] = type(value).__name__
    return found


def called(name, world, **changed):
    entry = TABLE[name]
    good = {**entry.good(world), **changed}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # fits of few steps say that they are poor
        return entry.call(world)(**good)


def result(name, world, **changed):
    """What a good call comes to, without what it cannot have twice."""
    found = numbers(called(name, world, **changed))
    return {trail: value for trail, value in found.items() if not trail.endswith(".seconds")}


def results(names):
    world = World()
    return {name: result(name, world) for name in names}


@pytest.fixture(scope="module")
def world():
    return World()


@pytest.fixture(scope="module")
def expected(world):
    return {name: result(name, world) for name in CHECKED}


def differing(found, expected):
    assert found.keys() == expected.keys()
    return [trail for trail in expected if found[trail] != expected[trail]]


def test_results_are_compared_by_their_numbers(expected):
    """Else nothing would be compared below."""
    for name in ("Fit.simulate", "Fit.predict", "fit", "loo", "compare", "Modes", "scores",
                 "Fit.summary", "Fit.to_arviz", "calibration"):  # fmt: skip
        assert len(repr(expected[name])) > 200, name
    assert len(CHECKED) > 50


@pytest.mark.parametrize("name", CHECKED)
def test_modes_of_torch_and_numpy(name, world, expected):
    with contextlib.ExitStack() as stack:
        for around in (*TORCH, "errors of numpy"):
            if around != "another default device" or name not in ON_A_DEVICE:
                stack.enter_context(AROUND[around]())
        found = result(name, world)
    assert differing(found, expected[name]) == []


@pytest.mark.parametrize("name", CHECKED)
def test_handlers_of_pyro(name, world, expected):
    store = pyro.get_param_store()
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    with contextlib.ExitStack() as stack:
        for around in PYRO:
            stack.enter_context(AROUND[around]())
        inside = torch.get_rng_state()
        with pyro.poutine.trace() as seen:
            found = result(name, world)
        assert torch.equal(torch.get_rng_state(), inside)
    assert differing(found, expected[name]) == []
    assert not seen.trace.nodes
    assert not list(store.keys())
    assert torch.equal(torch.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002


def test_threads(world, expected):
    """All of them, in three threads at once."""
    with ThreadPoolExecutor(3) as pool:
        found = dict(zip(CHECKED, pool.map(lambda name: result(name, world), CHECKED), strict=True))
    assert {name: differing(found[name], expected[name]) for name in CHECKED} == {
        name: [] for name in CHECKED
    }


def test_another_process(expected):
    """All of them, with fits of its own, in a process that is started anew."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        found = pool.submit(results, CHECKED).result()
    off = {name: differing(found[name], expected[name]) for name in CHECKED}
    assert {name: trails for name, trails in off.items() if trails} == {}


@pytest.mark.parametrize("name", CHECKED)
def test_results_survive_pickles_and_copies(name, world):
    made = called(name, world)
    whole = numbers(made)
    for other in (pickle.loads(pickle.dumps(made)), copy.deepcopy(made), copy.copy(made)):
        assert type(other) is type(made)
        assert differing(numbers(other), whole) == []


WORKERS = [name for name in CHECKED if "workers" in TABLE[name].bad]


@pytest.mark.parametrize("name", WORKERS)
def test_any_number_of_workers(name, world):
    """The bits do not depend on it; what was cut short to be quick has more to share here."""
    more = {"restarts": 3} if name == "fit" else {}
    more |= {"refits": 2} if name == "loo" else {}
    one, two = (result(name, world, workers=count, **more) for count in (1, 2))
    assert differing(two, one) == []


def laid_out(record):
    """The numbers of a record in other layouts of memory, and types of the same values."""
    t, u, y = record.time, np.repeat(record.inputs, 2, axis=1), record.outputs
    u[:, 1] = u[:, 1] ** 2
    yield t, u, y
    yield t[:], np.asfortranarray(u), np.asfortranarray(y)
    yield t[::-1][::-1], u[::-1, ::-1][::-1, ::-1], y[::-1][::-1]
    wide = np.full((len(t) * 3, 7), np.nan)
    wide[::3, 1:3], wide[::3, 5:6] = u, y
    yield np.repeat(t, 3)[::3], wide[::3, 1:3], wide[::3, 5:6]
    kept = [x.copy() for x in (t, u, y)]
    for x in kept:
        x.setflags(write=False)
    yield kept
    yield [x.astype(">f8") for x in (t, u, y)]
    yield [torch.tensor(x, requires_grad=True) for x in (t, u, y)]
    yield torch.tensor(t), torch.tensor(u.T.copy()).T, torch.tensor(y)
    yield list(t), u.tolist(), pd.DataFrame(y)


def test_layouts_of_memory(world):
    names = {**named(world.record), "input_names": ["u", "v"], "input_units": ["V", "V^2"]}
    model = dgp.LinearDynamicGP(2, pairs=1)
    whole = None
    for arrays in laid_out(world.record):
        record = dgp.Record(*arrays, **names)
        found = numbers(dgp.fit(model, record, method="map", **QUICK))
        whole = whole or found
        assert differing(found, whole) == []


def test_what_is_given_is_not_changed_nor_kept(world):
    t, u, y = (x.copy() for x in (world.record.time, world.record.inputs, world.record.outputs))
    record = dgp.Record(t, u, y)
    before = numbers(record)
    fit = dgp.fit(world.linear, record, method="map", **QUICK)
    simulated = numbers(fit.simulate(record))
    for x in (t, u, y):
        x[:] = -1.0
    assert differing(numbers(record), before) == []
    assert differing(numbers(fit.simulate(record)), simulated) == []
    with pytest.raises(ValueError, match="read-only"):
        record.outputs[0] = 0.0


@pytest.mark.parametrize("name", ["Fit", "Fit.log_likelihood", "Fit.predict", "Fit.innovations"])
def test_records_without_scores_are_refused_and_inputs_alone_are_simulated(name, world):
    argument = "records" if "records" in TABLE[name].bad else "record"
    with pytest.raises(ValueError, match="record: expected measured outputs"):
        called(name, world, **{argument: world.blank})
    assert np.isfinite(called("Fit.simulate", world, record=world.blank).mean).all()
