"""The README's code runs as printed, and its custom models are right in batches and in any unit."""

from __future__ import annotations

import contextlib
import os
import re
import runpy
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pyro
import pytest
import torch
from joblib.externals.loky import get_reusable_executor
from pyro.infer import Trace_ELBO

import pyro_dynogp as dgp
from tests import pages

LINES = 120


@contextlib.contextmanager
def told():
    """What warnings say meanwhile, here and on the error stream of new worker processes."""
    get_reusable_executor().shutdown()
    texts, before = [], os.dup(2)
    with tempfile.TemporaryFile("w+") as stream:
        os.dup2(stream.fileno(), 2)
        try:
            with warnings.catch_warnings(record=True) as caught:
                # More than the first of each line of code, which another test may have had.
                warnings.simplefilter("always", UserWarning)
                yield texts
        finally:
            os.dup2(before, 2)
            os.close(before)
        stream.seek(0)
        texts += [str(each.message) for each in caught if each.category is UserWarning]
        texts += [line for line in stream if "Warning:" in line]


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """What all blocks leave behind, run in order in an empty folder."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("readme"))
    pyro.set_rng_seed(0)
    try:
        with pyro.get_param_store().scope(), told() as texts:
            names = pages.run(pages.README)
        names["files"] = sorted(os.listdir())
        names["texts"] = texts
    finally:
        os.chdir(before)
    return names


def test_nothing_warns(found):
    assert not found["texts"]


def test_the_forecast_is_as_good_as_the_readme_says(found):
    assert found["fit"].method == "importance"
    scores = dgp.scores(found["forecast"], found["test"])
    assert scores["rmse"] == pytest.approx(0.31, abs=0.02)
    assert found["files"] == ["forecast.png", "report.html"]


def test_the_custom_model_follows_the_record(found):
    assert np.mean(found["losses"][-20:]) < np.mean(found["losses"][:20])
    assert found["volts"].shape == (100, 400)
    assert found["posterior"].draws.log_q is not None


def test_the_loop_finds_the_sensor(found):
    report = found["report"]
    assert report.effects[0].name in {"saturation", "output nonlinearity"}
    after, before = (dgp.scores(f.forecast(found["record"][:190], found["record"][190:]),
                                found["record"][190:])["rmse"]
                     for f in (found["better"], found["linear"]))  # fmt: skip
    assert after < 0.5 * before  # measured on the last block: 0.098 and 0.295


def on(record: dgp.Record) -> dict:
    """The block of the custom model, and that of the robust one, with another record to learn."""
    chosen = [code for code, _ in pages.blocks(pages.README) if "dist." in code]
    assert len(chosen) == 2
    names: dict = {"dgp": dgp, "train": record}
    pyro.set_rng_seed(0)
    with pyro.get_param_store().scope():
        for code in chosen:
            exec(code, names)
    return names


@pytest.fixture(scope="module")
def furnace():
    return on(dgp.datasets.load("gas_furnace").train)


def test_the_custom_model_is_right_far_from_unit_scale(furnace):
    """The gas furnace has a mean of 52.4 % and a standard deviation of 3.4 %."""
    outputs = furnace["train"].outputs[:, 0]
    error = np.sqrt(np.mean((np.asarray(furnace["volts"]).mean(0) - outputs) ** 2))
    assert error < 0.5 * outputs.std()


@pytest.mark.parametrize("name", ["system", "robust"])
def test_the_custom_models_are_right_in_batches(furnace, name):
    """The density of each particle of a batch is that of the particle alone."""
    model, y, particles = furnace[name], furnace["y"], 3
    with pyro.plate("particles", particles, dim=-1):
        batch = pyro.poutine.trace(model).get_trace(y)
    batch.compute_log_prob()
    latent = [s for s in batch.stochastic_nodes if s != "particles"]
    together = sum(batch.nodes[s]["log_prob"] for s in [*latent, "y"])
    assert together.shape == (particles,)
    for k in range(particles):
        values = {s: batch.nodes[s]["value"][k] for s in latent}
        alone = pyro.poutine.trace(pyro.poutine.condition(model, data=values)).get_trace(y)
        torch.testing.assert_close(alone.log_prob_sum(), together[k])
    assert batch.nodes["y"]["value"].shape == y.shape


def test_the_likelihood_of_the_robust_model_uses_its_trajectory(furnace):
    trace = pyro.poutine.trace(furnace["robust"]).get_trace(furnace["y"])
    values = {s: trace.nodes[s]["value"] for s in trace.stochastic_nodes}
    moved = pyro.poutine.condition(furnace["robust"], data={**values, "g": values["g"] + 1.0})
    other = pyro.poutine.trace(moved).get_trace(furnace["y"])
    for each in (trace, other):
        each.compute_log_prob()
    assert not torch.isclose(trace.nodes["y"]["log_prob_sum"], other.nodes["y"]["log_prob_sum"])


def test_vectorised_losses_have_the_same_mean(furnace):
    system, guide, y = furnace["system"], furnace["guide"], furnace["y"]
    pyro.set_rng_seed(1)
    losses = {
        vectorised: [
            Trace_ELBO(num_particles=40, vectorize_particles=vectorised).loss(system, guide, y)
            for _ in range(2)
        ]
        for vectorised in (True, False)
    }
    assert np.mean(losses[True]) == pytest.approx(np.mean(losses[False]), abs=15.0)


def test_every_public_name_in_the_readme_exists():
    for name in set(re.findall(r"\bdgp\.(\w+)", pages.README.read_text())):
        assert hasattr(dgp, name), name


def test_a_package_index_shows_it_without_pictures_and_links_that_it_cannot_resolve():
    pytest.importorskip("setuptools")
    setup = runpy.run_path(str(pages.ROOT / "setup.py"))
    text = pages.README.read_text()
    shown = setup["description"](text)
    assert "](https://pyro.ai)" in shown
    assert not re.search(r"\]\((?!https?:)", shown)
    assert "Two electric drives with a belt" in text  # the caption goes with its picture
    assert "Two electric drives with a belt" not in shown
    assert [line for line in shown.splitlines() if line.startswith("#")] == [
        line for line in text.splitlines() if line.startswith("#")
    ]
    assert re.findall(r"```.*?```", shown, re.DOTALL) == re.findall(r"```.*?```", text, re.DOTALL)


def test_it_is_short():
    assert len(pages.README.read_text().splitlines()) <= LINES
