"""How the last fits of a loop begin."""

from types import SimpleNamespace

import pytest

import pyro_dynogp as dgp
from pyro_dynogp.report import loop


@pytest.mark.parametrize(("model", "fresh"), [(dgp.Wiener(1), 1), (dgp.LinearDynamicGP(1), None)])
def test_last_fits_have_fresh_starts_too(monkeypatch, model, fresh):
    """From what is learnt alone functions can end where they fit noise, poles at poor optima."""
    given = {}

    def fit(model, record, **options):
        given.update(options)
        return model

    monkeypatch.setattr(loop, "fit_model", fit)
    found = SimpleNamespace(model=model, seed=3)
    user = SimpleNamespace(model=dgp.LinearDynamicGP(1), method="map", draws={"a": [0.0]})
    loop._final([found], user, None, 1, False)
    assert given["restarts"] == fresh
    assert given["start"] is found
