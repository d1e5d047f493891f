"""An effect of one's own in one file, through the loop; its page says what the file does."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.effects.base import OUTSIDE, experiment

PAGE = (Path(__file__).parents[2] / "docs" / "effects.md").read_text()
N, STEP, TRUTH = 480, 0.5, 90.0


@pytest.fixture
def record() -> dgp.Record:
    """One pole; the actuator loses its force with a time constant of 90 s; noise of 5 %."""
    rng = np.random.default_rng(4)
    time = STEP * np.arange(N)
    u = np.repeat(rng.standard_normal(N // 6), 6)
    y = lfilter([0, 0.3], [1, -0.7], u * np.exp(-time / TRUTH)) + 0.03 * rng.standard_normal(N)
    return dgp.Record(time, u, y, input_names=("valve",), input_units=("V",), time_unit="s")


def blocks() -> list[str]:
    """Python code of the page, block by block."""
    return [part.partition("```")[0] for part in PAGE.split("```python\n")[1:]]


@pytest.fixture
def users_effect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's file, where Python finds it."""
    (tmp_path / "users_effect.py").write_text(blocks()[0])
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "users_effect", raising=False)


def test_the_file_is_short_and_the_package_names_the_page() -> None:
    assert len(blocks()[0].splitlines()) <= 61
    assert "docs/effects.md" in (effects.__doc__ or "")


@pytest.mark.usefixtures("users_effect")
def test_the_loop_names_it_adds_it_and_says_how_long_it_lasts(record: dgp.Record) -> None:
    model = dgp.LinearDynamicGP(1, pairs=1, process_noise=False)
    fit = dgp.fit(model, record[:240], restarts=2, workers=1, progress=False, method="map")
    names: dict[str, Any] = {"dgp": dgp, "fit": fit, "record": record}
    exec(blocks()[1], names)
    report = names["report"]
    first = report.effects[0]
    assert first.name == "ageing"
    assert "'valve' decays to 1/e in" in first.sentence
    mean, sd = first.parameters["time constant of ageing of valve [s]"]
    assert mean == pytest.approx(TRUTH, abs=3.0 * sd)
    assert 0.0 < sd < 0.2 * TRUTH
    assert "time constant" in first.block
    assert report.after["rmse"] < 0.5 * report.before["rmse"]


@pytest.mark.usefixtures("users_effect")
def test_its_experiment_is_found_from_either_side() -> None:
    from users_effect import Ageing  # type: ignore[import-not-found]

    known = (*effects.CATALOGUE, Ageing())
    said = "the same record once more with a new actuator"
    assert experiment("ageing", ("drift",), known) == said
    assert experiment("drift", ("ageing",), known) == said
    both = experiment("drift", ("ageing", "level shift"), known)
    assert both == f"{said}; a longer record at rest"
    assert experiment("ageing", ("hysteresis",), known).startswith("a record with inputs")
    assert experiment("ageing", (OUTSIDE,), known).startswith("the same input twice")
    assert experiment("ageing", (), known) == ""
