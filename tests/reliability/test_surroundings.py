"""The same numbers whatever happens around a call: modes of torch, handlers of Pyro, threads."""

import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.isolation import alone
from tests.reliability.table import QUICK, World


@pytest.fixture(scope="module")
def world():
    return World()


def draws_of(world, *methods):
    """Of short fits: as far from converged as from a second of work."""
    short, bent = world.record[:40], dgp.Wiener(1, pairs=1, inducing=4)
    of = {
        "map": lambda: dgp.fit(world.linear, short, steps=4, **QUICK),
        "svi": lambda: dgp.fit(world.linear, short, method="svi", steps=4, **QUICK),
        "trajectories": lambda: dgp.fit(bent, short, guide="gauss-markov", steps=2, **QUICK),
        "inducing values": lambda: dgp.fit(bent, short, steps=3, **QUICK),
        "nuts": lambda: dgp.fit(
            world.linear, short, method=dgp.Nuts(chains=1, warmup=2, draws=4), **QUICK
        ),
    }
    found = {}
    for name in methods:
        fit = of[name]()
        found[name] = np.concatenate([x.numpy().ravel() for x in fit.draws.values()])
        found[f"{name} history"] = fit.history
    return found


LONG = ("inducing values", "nuts")


def numbers(world):
    """Of methods and verbs, to be compared to the last bit."""
    found = draws_of(world, "map", "svi", "trajectories")
    fit, record = world.fit, world.record
    found["log joint"] = fit.log_joint(record)
    found["log likelihood"] = fit.log_likelihood(record)
    for name, made in {
        "simulate": fit.simulate(record),
        "predict": fit.predict(record, horizon=3),
        "forecast": fit.forecast(world.past, world.future),
        "bent": world.bent.simulate(record),
    }.items():
        found[name] = np.concatenate(
            [made.mean.ravel(), made.samples.ravel(), made.quantile(0.3)[0]]
        )
        found[f"{name} parts"] = np.concatenate(list(made.parts.values()))
    found["layers"] = world.bent.layers(record)["g"].draw_mean
    found["function"] = world.bent.static_function("f", record).sd
    found["loo"] = dgp.loo(fit, target="missing sample", draws=20, **RUN).loo_i.values
    found["modes"] = dgp.fit(world.linear, record, **QUICK).modes.poles.numpy()
    return found


RUN = {"progress": False, "workers": 1}


@pytest.fixture(scope="module")
def expected(world):
    return numbers(world)


@contextlib.contextmanager
def default_dtype():
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@contextlib.contextmanager
def flushed():
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


@contextlib.contextmanager
def conditioned():
    with pyro.poutine.condition(data={"g_log_decay": torch.zeros(1), "y": torch.zeros(40)}):
        yield


AROUND = {
    "no gradients": torch.no_grad,
    "inference mode": torch.inference_mode,
    "autocast": lambda: torch.autocast("cpu"),
    "another default type": default_dtype,
    "another default device": lambda: torch.device("meta"),
    "errors of numpy": lambda: np.errstate(all="raise"),
    "denormals flushed": flushed,
    "a plate": lambda: pyro.plate("outer", 3),
    "a plate to the left": lambda: pyro.plate("outer", 3, dim=-4),
    "a trace": pyro.poutine.trace,
    "a trace of parameters": lambda: pyro.poutine.trace(param_only=True),
    "a condition": conditioned,
    "a scale": lambda: pyro.poutine.scale(scale=3.0),
    "a mask": lambda: pyro.poutine.mask(mask=False),
    "a seed": lambda: pyro.poutine.seed(rng_seed=3),
    "a block": pyro.poutine.block,
    "no validation": lambda: pyro.validation_enabled(False),
    "another seed of torch": lambda: torch.random.fork_rng(),
}


@pytest.mark.parametrize("around", AROUND)
def test_same_numbers(around, world, expected):
    with AROUND[around]():
        found = numbers(world)
    assert found.keys() == expected.keys()
    assert [k for k in expected if not np.array_equal(found[k], expected[k])] == []


def test_long_fits_with_much_around(world):
    expected = draws_of(world, *LONG)
    with contextlib.ExitStack() as all_of_them:
        for name in ("inference mode", "another default type", "a plate", "a trace", "a condition"):
            all_of_them.enter_context(AROUND[name]())
        found = draws_of(world, *LONG)
    assert [k for k in expected if not np.array_equal(found[k], expected[k])] == []


def test_what_is_around_is_left_as_it_was(world):
    store = pyro.get_param_store()
    store.clear()
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    with pyro.poutine.trace() as seen, pyro.plate("outer", 2), torch.no_grad():
        pyro.sample("mine", dist.Normal(0.0, 1.0), obs=torch.zeros(2))
        numbers(world)
        pyro.sample("after", dist.Normal(0.0, 1.0), obs=torch.zeros(2))
        assert not torch.is_grad_enabled()
    assert set(seen.trace.nodes) == {"outer", "mine", "after"}
    assert not list(store.keys())
    assert torch.equal(torch.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002


def test_threads(world, expected):
    """Three at once: Pyro's one list of handlers would mix them up."""
    with ThreadPoolExecutor(3) as pool:
        for found in pool.map(lambda _: numbers(world), range(3)):
            assert [k for k in expected if not np.array_equal(found[k], expected[k])] == []


def test_an_error_inside_leaves_the_handlers_and_lets_others_in():
    def fails():
        with alone():
            pyro.sample("inside", dist.Normal(0.0, 1.0))
            raise KeyError("stop")

    with pyro.poutine.trace() as seen, pytest.raises(KeyError, match="stop"):
        fails()
    assert not seen.trace.nodes
    entered = threading.Event()

    def enter():
        with alone():
            entered.set()

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join(10.0)
    assert entered.is_set()


def test_memory_layouts(world):
    """The numbers of a record are what counts, not how they lie in memory."""
    r = world.record
    t, u, y = r.time, r.inputs, r.outputs
    others = [
        (np.asfortranarray(t), u[::-1][::-1], y),
        tuple(map(torch.tensor, (t, u, y))),
        (list(t), u.tolist(), y.tolist()),
        tuple(x.astype(">f8") for x in (t, u, y)),
        (np.repeat(t, 2)[::2], np.repeat(u, 2, 0)[::2], y),
    ]
    for arrays in others:
        other = dgp.Record(*arrays, **named(r))
        assert other == r
        assert np.array_equal(world.fit.predict(other).mean, world.fit.predict(r).mean)


def named(record):
    names = ("input_names", "output_names", "input_units", "output_units")
    return {name: getattr(record, name) for name in names}
