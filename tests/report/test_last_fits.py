"""How the last fits of a loop begin."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.models.feedback_variants import with_feedback, with_usual_substeps
from pyro_dynogp.models.forms import SUBSTEPS
from pyro_dynogp.report import loop


@pytest.mark.parametrize(
    ("model", "fresh"),
    [(dgp.Wiener(1), 1), (dgp.LinearDynamicGP(1), None)],
)
def test_last_fits_have_fresh_starts_too(monkeypatch, model, fresh):
    """From what is learnt alone functions can end where they fit noise, poles at poor optima.

    What is learnt of a model with functions is first refitted in the units of all data.
    """
    given, near = {}, SimpleNamespace()

    def fit(model, record, **options):
        given.update(options)
        return model

    def refit(found, record, *, model, run):
        assert (record, model.scaling, run.seed) == ("record", None, 3)
        return near

    monkeypatch.setattr(loop, "fit_model", fit)
    monkeypatch.setattr(loop, "refit", refit)
    found = SimpleNamespace(model=model, seed=3)
    user = SimpleNamespace(model=dgp.LinearDynamicGP(1), method="map", n_draws=1)
    loop._final([found], user, "record", 1, False)
    assert given["restarts"] == fresh
    assert given["start"] is (near if model.has_function else found)


def test_those_with_feedback_keep_the_units_of_block_a():
    """In others the mean of the input is another one, which an integrator adds up."""
    generator = np.random.default_rng(0)
    u = np.concatenate([np.full(60, 1.0), generator.normal(3.0, 1.0, 60)])
    y = np.cumsum(0.1 * u) + generator.normal(0.0, 0.01, 120)
    record = dgp.Record(np.arange(120.0), u, y)
    model = dgp.NonlinearFeedback(1, parametric="cube", substeps=1)
    options = {"method": "map", "restarts": 1, "steps": 3, "workers": 1, "progress": False}
    fit = dgp.fit(model, record[40:100], **options)
    line = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record[40:100], **options)
    (found,) = loop._final([fit], fit, record, 1, False)
    assert found.model.scaling == fit.model.scaling
    assert len(found.records[0].time) == 120
    (found,) = loop._final([line], line, record, 1, False)
    assert found.model.scaling == dgp.Scaling.from_records(record)


def test_a_step_that_was_added_gets_its_substeps(monkeypatch):
    """The search does without them; what the user gave keeps what it has."""
    fitted, refitted = [], []

    def fit(start, model, record, run, **options):
        assert run.restarts == 1
        fitted.append(model.substeps)
        return model

    def refit(found, record, *, run):
        refitted.append(found.model.substeps)
        return found

    monkeypatch.setattr(loop, "fit_in_units", fit)
    monkeypatch.setattr(loop, "refit", refit)
    added = with_feedback(dgp.LinearDynamicGP(1), hidden=True)
    smooth = with_feedback(dgp.LinearDynamicGP(1))
    assert added.substeps == smooth.substeps == 1
    user = SimpleNamespace(model=added, method="map", n_draws=1)
    line, fine, coarse, other = (
        SimpleNamespace(model=model, seed=3) for model in (smooth, added, replace(added), smooth)
    )
    loop._final([line, fine], user, "record", 1, False)
    loop._final([line, other], user, "record", 1, False)
    loop._final([fine, coarse], user, "record", 1, False)  # whose step was there without any
    assert fitted == [1, SUBSTEPS, 1, 1, 1, 1]
    assert refitted == [1] * 6
    wider = with_usual_substeps(dgp.NonlinearFeedback(1, hidden=1, substeps=5))
    assert wider.substeps == 5
