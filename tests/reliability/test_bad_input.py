"""More than two thousand bad calls: each is refused in a sentence that names the argument."""

import inspect
import warnings

import pytest

import pyro_dynogp as dgp
from tests.reliability.table import MODULES, TABLE, WITHOUT, World, cases

# Of 2298 today; more than four times what is promised.
FEWEST = 2600


@pytest.fixture(scope="module")
def world():
    return World()


def test_every_public_name_is_in_the_table():
    assert WITHOUT | {name.split(".")[0].split()[0] for name in TABLE} == set(dgp.__all__)
    assert all(inspect.ismodule(module) for module in MODULES)


# Entered by the name of their class alone; parts of the package's own work, no verbs of a user's.
ENTERED = {"Fit.log_joint", "Prediction.quantile"}
OWN = {"Fit.of", "Fit.system_at", "Fit.with_draws", "Prediction.check"}
REFUSED = {"Record.resample"}  # whatever it is given


@pytest.mark.parametrize("kind", [dgp.Record, dgp.Fit, dgp.Prediction])
def test_every_verb_is_in_the_table(kind):
    """Methods that take arguments, readers too."""
    found = set()
    for name, verb in inspect.getmembers(kind, callable):
        if name.startswith("_") or not verb.__module__.startswith("pyro_dynogp"):
            continue
        if set(inspect.signature(verb).parameters) - {"self"}:
            found.add(f"{kind.__name__}.{name}")
    assert found - ENTERED - OWN - REFUSED <= set(TABLE)


@pytest.mark.parametrize("name", TABLE)
def test_every_argument_is_in_the_table(name, world):
    entry = TABLE[name]
    call = entry.call(world)
    if getattr(call, "__name__", "") in ("made",):  # a layer in a model
        layer = getattr(dgp, name)
        assert set(entry.bad) == set(inspect.signature(layer).parameters)
        return
    arguments = set(inspect.signature(call).parameters)
    arguments -= {"args", "kwargs", "options"}
    entered = set(entry.bad) | set(entry.free) | set(entry.good(world))
    assert arguments <= entered, arguments - entered


@pytest.mark.parametrize("name", [name for name, entry in TABLE.items() if not entry.late])
def test_good_calls_are_good(name, world):
    entry = TABLE[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        entry.call(world)(**entry.good(world))


def unclear(case, world):
    """What is wrong with how a bad call ends; None where it is clear."""
    entry = TABLE[case.name]
    call, good = entry.call(world), entry.good(world)
    try:
        call(**{**good, case.argument: case.value})
    except (ValueError, TypeError, OSError) as error:
        trace = error.__traceback__
        while trace.tb_next is not None:
            trace = trace.tb_next
        module = str(trace.tb_frame.f_globals.get("__name__"))
        if not module.startswith("pyro_dynogp"):
            return f"a {type(error).__name__} from within {module}: {error}"
        text = str(error)
        named = case.argument.removesuffix("s") in text or str(case.value) in text
        return None if named else f"does not name the argument: {text}"
    except Exception as error:
        return f"crashes: {error!r}"
    return "is taken"


@pytest.mark.parametrize("name", TABLE)
def test_bad_calls_end_in_a_sentence(name, world):
    own = [case for case in cases(world) if case.name == name]
    found = {(c.argument, repr(c.value)[:60]): unclear(c, world) for c in own}
    assert {key: text for key, text in found.items() if text is not None} == {}


def test_there_are_many(world):
    assert len(cases(world)) >= FEWEST
