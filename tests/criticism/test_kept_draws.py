"""Draws are computed once for a fit, and go nowhere without it."""

import copy
import gc
import weakref
from dataclasses import replace

import cloudpickle
import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.criticism import posterior_draws
from pyro_dynogp.criticism.kept_draws import NAME, kept
from pyro_dynogp.criticism.posterior_draws import DRAWS, draws_of
from pyro_dynogp.criticism.subjects import FitSubject

QUIET = {"workers": 1, "progress": False}


@pytest.fixture
def fit(svi_fit):
    """Nothing kept yet."""
    return replace(svi_fit)


def test_the_same_draws_come_again(fit):
    first = draws_of(fit, count=50, anneal=False)
    assert draws_of(fit, count=50, anneal=False) is first
    assert draws_of(fit, count=51, anneal=False) is not first
    other = draws_of(fit, count=50, seed=1, anneal=False)
    assert not np.array_equal(other.log_p, first.log_p)
    assert np.array_equal(draws_of(replace(fit), count=50, anneal=False).log_p, first.log_p)


def test_annealing_is_done_once(fit, monkeypatch):
    runs = []

    def annealed(fit, own, k, count, seed, progress):
        runs.append(count)
        return replace(own, log_q=None, kind="annealed")

    monkeypatch.setattr(posterior_draws, "_annealed", annealed)
    monkeypatch.setattr(posterior_draws.arviz_bridge, "good_k", lambda draws: -1.0)
    options = {"target": "missing sample", "draws": 60, "refits": 0, **QUIET}
    for _ in range(2):
        assert dgp.loo(fit, **options)["draws_from"] == "annealed"
    dgp.loo(fit, **{**options, "target": "forecast"})
    assert runs == [60]
    # The fit's own draws stay what they are for whoever asks for them.
    assert draws_of(fit, count=60, anneal=False).log_q is not None


def test_check_and_loo_agree_on_k(fit):
    k = dgp.check(fit)["posterior k"].value
    found = dgp.loo(fit, target="missing sample", refits=0, **QUIET)
    assert found["n_samples"] == DRAWS
    assert found["posterior_k"] == k


def test_they_stay_with_their_fit(fit, tmp_path):
    draws_of(fit, count=100, anneal=False)
    assert fit.__dict__.get(NAME, {})
    assert NAME not in replace(fit).__dict__
    assert not cloudpickle.loads(cloudpickle.dumps(fit)).__dict__.get(NAME, {})
    assert not copy.deepcopy(fit.__dict__.get(NAME, {}))
    subject = FitSubject(fit, fit.records, 100, 0)
    whole = len(cloudpickle.dumps(subject))
    assert len(subject.draws) == 100
    assert len(cloudpickle.dumps(subject)) == whole
    fit.save(tmp_path / "with.safetensors")
    replace(fit).save(tmp_path / "without.safetensors")
    sizes = {one.stat().st_size for one in tmp_path.iterdir()}
    assert len(sizes) == 1


def test_they_go_when_the_fit_goes(svi_fit):
    fit = replace(svi_fit)
    seen = weakref.ref(draws_of(fit, count=30, anneal=False))
    assert seen() is not None
    del fit
    gc.collect()
    assert seen() is None


def test_an_error_is_not_kept(fit):
    def fails():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        kept(fit, "x", fails)
    assert kept(fit, "x", lambda: 3) == 3
    assert kept(fit, "x", fails) == 3
