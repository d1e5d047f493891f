"""How the last fits of a loop begin."""

from types import SimpleNamespace

import pytest

import pyro_dynogp as dgp
from pyro_dynogp.report import loop


@pytest.mark.parametrize(
    ("model", "fresh"),
    [(dgp.Wiener(1), 1), (dgp.NonlinearFeedback(1), 1), (dgp.LinearDynamicGP(1), None)],
)
def test_last_fits_have_fresh_starts_too(monkeypatch, model, fresh):
    """From what is learnt alone functions can end where they fit noise, poles at poor optima.

    What is learnt of a model with feedback is first refitted in the units of all data.
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
    assert given["start"] is (near if model.has_feedback else found)
