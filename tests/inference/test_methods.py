"""Methods as objects, their short names, and options that do not go together."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.methods.choose import method_of
from tests.inference.cascades import wiener

FILES = Path(__file__).parent / "files"
QUICK = {"restarts": 1, "steps": 3, "workers": 1, "progress": False}
LINEAR = dgp.LinearDynamicGP(1, pairs=1)


class TestShortNames:
    @pytest.mark.parametrize(
        ("model", "method", "options", "expected"),
        [
            (LINEAR, None, {}, dgp.Importance()),
            (LINEAR, None, {"draws": 9}, dgp.Importance(9)),
            (wiener(), None, {}, dgp.Importance()),
            (wiener(), None, {"guide": "collapsed", "draws": None}, dgp.Importance()),
            (wiener(), None, {"particles": 2}, dgp.Normal(particles=2)),
            (wiener(), None, {"hyperparameters": "map"}, dgp.Normal("map")),
            (wiener(), "map", {"optimizer": "lbfgs"}, dgp.Mode("lbfgs")),
            (LINEAR, "svi", {"hyperparameters": "normal", "draws": 7}, dgp.Normal("normal", 7)),
            (LINEAR, "nuts", {"chains": 2, "warmup": 3}, dgp.Nuts(2, 3)),
            (wiener(), None, {"guide": "inducing times"}, dgp.Trajectories("inducing times")),
            (wiener(), dgp.Nuts(3), {}, dgp.Nuts(3)),
        ],
    )
    def test_stand_for_objects(self, model, method, options, expected):
        assert method_of(method, model, options) == expected

    def test_give_the_same_fit(self, record):
        loose = dgp.fit(LINEAR, record[:60], method="svi", draws=5, particles=2, **QUICK)
        bound = dgp.fit(LINEAR, record[:60], method=dgp.Normal(draws=5, particles=2), **QUICK)
        assert all(torch.equal(loose.draws[name], bound.draws[name]) for name in loose.draws)


@pytest.mark.parametrize(
    ("model", "options", "message"),
    [
        (LINEAR, {"method": "svi", "chains": 2}, "chains: expected nothing .* Nuts takes it"),
        (
            LINEAR,
            {"method": "map", "draws": 2},
            "draws: .* Importance and Normal and Nuts and Trajectories take",
        ),
        (LINEAR, {"particles": 2}, "particles: expected nothing with Importance"),
        (LINEAR, {"method": "nuts", "particles": 2}, "particles: .* Normal and Trajectories take"),
        (wiener(), {"guide": "gauss-markov", "optimizer": "adam"}, "optimizer"),
        (wiener(), {"guide": "gauss-markov", "method": "nuts"}, "method: expected 'svi' with this"),
        (LINEAR, {"method": dgp.Nuts(), "chains": 2}, r"chains: .* Give it to Nuts\(...\)"),
        (LINEAR, {"method": "svi", "hyperparameters": "map"}, "hyperparameters: expected 'normal'"),
        (LINEAR, {"method": "svi", "draws": 0}, "draws: expected a whole number >= 1"),
        (wiener(), {"guide": "nothing"}, "guide: expected 'collapsed', one of"),
    ],
)
def test_what_does_not_go_together_is_refused_before_any_work(
    model, options, message, record, monkeypatch
):
    def work(*args, **others):
        raise AssertionError("work began")

    monkeypatch.setattr(dgp.Model, "check", work)
    with pytest.raises(ValueError, match=message):
        dgp.fit(model, record[:60], progress=False, **options)


def test_an_option_that_no_method_has(record):
    with pytest.raises(TypeError, match="no argument 'chain'"):
        dgp.fit(LINEAR, record, chain=2)


class TestDefaults:
    def test_a_cascade_of_one_dynamic_layer_is_a_linear_model(self, record):
        """Linear dynamics with outliers: its default is that of linear models."""
        model = dgp.Cascade(1, (dgp.Dynamic(pairs=1),), dgp.StudentT())
        fit = dgp.fit(model, record[:60], **QUICK)
        assert fit.method == "importance"
        svi = dgp.fit(model, record[:60], method="svi", draws=3, **QUICK)
        assert not svi.posterior.points  # one normal of all sites
        assert {site.name for site in svi.posterior.sites} == set(svi.draws)

    def test_six_starts(self, record):
        model = dgp.Cascade(1, (dgp.Dynamic(pairs=1),))
        fit = dgp.fit(model, record[:60], steps=2, workers=1, progress=False)
        assert len(fit.start_energies) == 6


def the_record_of_the_files():
    """As it was when the files were written."""
    generator = np.random.default_rng(0)
    time = np.arange(60) * 0.5
    inputs = np.repeat(generator.normal(size=12), 5)[:, None]
    state = np.zeros(60)
    for k in range(1, 60):
        state[k] = 0.8 * state[k - 1] + 0.3 * inputs[k - 1, 0]
    outputs = (state + 0.02 * generator.normal(size=60))[:, None]
    return dgp.Record(time, inputs, outputs, input_names=("u",), output_names=("y",))


@pytest.mark.parametrize("name", ["linear", "wiener"])
def test_files_of_version_4_are_read(name, tmp_path):
    expected = json.loads((FILES / "version_4.json").read_text())[name]
    record = the_record_of_the_files()
    # The filter of models with functions sums up its nodes in another order than version 4 did.
    same = {"rtol": 1e-12 if name == "linear" else 1e-10}
    fit = dgp.load(FILES / f"{name}_version_4.safetensors")
    fit.save(tmp_path / "fit")
    for again in (fit, dgp.load(tmp_path / "fit")):
        found = again.forecast(record[:40], record[40:])
        np.testing.assert_allclose(found.mean[:, 0], expected["mean"], **same, atol=1e-12)
        np.testing.assert_allclose(found.sd[:, 0], expected["sd"], **same)
        np.testing.assert_allclose(again.log_likelihood(record), expected["log_likelihood"], **same)
        assert again.method == "svi"
        assert bool(again.posterior.points) == (name == "wiener")
        assert torch.isfinite(again.posterior.log_prob(again.draws)).all()
