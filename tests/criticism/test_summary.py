"""Summaries and short texts: each number from the draws, nothing that fills a screen."""

import pickle

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.lti.views import steady_state_gain
from pyro_dynogp.support.shown import short, shown
from tests.inference.cascades import wiener_record

QUICK = {"restarts": 1, "workers": 1, "progress": False}


@pytest.fixture(scope="module")
def record():
    return wiener_record(n=60, input_units="V", output_units="m", input_names="valve")


@pytest.fixture(scope="module")
def fit(record):
    model = dgp.LinearDynamicGP(1, pairs=2)
    return dgp.fit(model, record, method="svi", draws=40, steps=4, **QUICK)


@pytest.fixture(scope="module")
def bent(record):
    model = dgp.WienerHammerstein(1, pairs=1, inducing=5)
    return dgp.fit(model, record, method="map", steps=3, **QUICK)


class TestTable:
    def test_numbers_are_those_of_the_draws(self, fit):
        table = fit.summary().table
        poles = fit.modes.poles.numpy()
        poles = np.take_along_axis(poles, np.argsort(np.abs(poles), axis=1), axis=1)
        gain = steady_state_gain(fit.modes)[:, 0, 0].numpy()
        noise = fit.scaling.output_scale[0] * fit.draws["noise_sd"][:, 0].numpy()
        expected = {
            "natural frequency 1": (np.abs(poles[:, 0]), "rad/s"),
            "damping ratio 1": (-poles[:, 0].real / np.abs(poles[:, 0]), "-"),
            "natural frequency 2": (np.abs(poles[:, 1]), "rad/s"),
            "damping ratio 2": (-poles[:, 1].real / np.abs(poles[:, 1]), "-"),
            "gain from valve to y": (gain, "m/V"),
            "noise sd of y": (noise, "m"),
        }
        assert list(table.index) == list(expected)
        for name, (values, unit) in expected.items():
            row = table.loc[name]
            numbers = [values.mean(), values.std(), *np.quantile(values, [0.025, 0.975])]
            np.testing.assert_allclose(row.iloc[:4].to_numpy(float), numbers, rtol=1e-9)
            assert row["unit"] == unit
        assert (table["sd"] > 0).all()

    def test_a_mode_has_no_spread(self, fit):
        table = fit.at_mode().summary().table
        assert np.isfinite(table["mean"].to_numpy(float)).all()
        assert table[["sd", "2.5 %", "97.5 %"]].isna().all(axis=None)
        assert "nan" not in fit.at_mode().summary()

    def test_lengthscales_are_in_the_unit_of_what_is_measured(self, record, bent):
        table = bent.summary().table
        assert [n for n in table.index if "lengthscale" in n] == ["f: lengthscale along g1"]
        assert table.loc["f: lengthscale along g1", "unit"] == "-"
        assert not [n for n in table.index if n.startswith("gain")]
        assert [n for n in table.index if "frequency" in n] == [
            "g1: natural frequency", "g2: natural frequency"
        ]  # fmt: skip
        model = dgp.Hammerstein(1, pairs=1, inducing=5)
        first = dgp.fit(model, record, method="map", steps=3, **QUICK)
        row = first.summary().table.loc["f: lengthscale along valve"]
        expected = float(first.draws["f_lengthscale"]) * first.scaling.input_scale[0]
        assert (row["mean"], row["unit"]) == (pytest.approx(expected), "V")
        model = dgp.NonlinearFeedback(1, inducing=5)
        looped = dgp.fit(model, record, method="map", steps=3, **QUICK)
        row = looped.summary().table.loc["f: lengthscale along y"]
        apart = 2.0 * float(looped.draws["f_half_width"]) / 4
        length = np.hypot(float(looped.draws["f_lengthscale"]), 2.0 * apart)
        expected = length * looped.scaling.output_scale[0]
        assert (row["mean"], row["unit"]) == (pytest.approx(expected), "m")

    def test_integrators_have_rates(self, record):
        model = dgp.LinearDynamicGP(1, pairs=1, integrators=1)
        found = dgp.fit(model, record, method="map", steps=3, **QUICK).summary().table
        assert found.loc["integrator rate from valve to y", "unit"] == "m/V/s"

    def test_scores_of_a_record(self, fit, record):
        found = fit.summary(record).scores
        expected = dgp.scores(fit.predict(record), record)
        assert found.loc["one step ahead of y", "rmse"] == pytest.approx(expected["rmse"])
        expected = dgp.scores(fit.simulate(record), record)
        assert found.loc["simulation of y", "crps"] == pytest.approx(expected["crps"])
        assert fit.summary().scores is None

    def test_text_page_and_copies(self, fit, record):
        summary = fit.summary(record)
        assert repr(summary) == str(summary)
        assert "natural frequency 1" in summary
        page = summary._repr_html_()
        assert page.count("<table") == 2
        assert "method &#x27;svi&#x27;" in page
        again = pickle.loads(pickle.dumps(summary))
        assert again == summary
        assert again.table.equals(summary.table)


class TestShort:
    def results(self, fit, bent, record):
        prediction = fit.predict(record)
        options = {"target": "forecast", "parameters": "mode", "refits": 0, "progress": False}
        elpd = dgp.loo(fit, **options)
        return [
            fit, bent, prediction, fit.posterior, fit.system, bent.system, fit.scaling, record,
            bent.static_function("f", record), *fit.layers(record).values(), fit.model, elpd,
            fit.model.prepare(record)[0], dgp.check(fit, forecasts=False, progress=False),
            dgp.calibration(prediction, record), dgp.predictive_checks(prediction, record),
            dgp.compare({"a": elpd, "b": elpd}, **options), dgp.LoopSettings(),
            dgp.stack({"a": fit, "b": fit}, weights={"a": 0.5, "b": 0.5}),
            dgp.datasets.load("gas_furnace"),
        ]  # fmt: skip

    def test_every_result(self, fit, bent, record):
        for result in self.results(fit, bent, record):
            assert len(repr(result)) <= 1000, type(result)
            page = result._repr_html_()
            assert page.startswith("<")
            assert len(page) <= 30_000, type(result)

    def test_numbers_of_a_fit(self, fit):
        assert repr(fit) == (
            "Fit(g, inputs=['valve'], outputs=['y'], method='svi', draws=40, samples=60, seed=0)"
        )

    @pytest.mark.parametrize(
        ("value", "text"),
        [(np.zeros((3, 2)), "<ndarray (3, 2)>"), (torch.zeros(2), "<Tensor (2,)>"),
         ({"a": 1, "b": 2}, "{a, b}"), (dict.fromkeys("abcdef"), "{a, b, c, d, ... 6 in all}"),
         ((1, 2.5), "(1, 2.5)"), (list(range(9)), "(0, 1, 2, 3, ... 9 in all)"),
         ("x" * 99, repr("x" * 57 + "...")), (None, "None"), (len, "<len>"), (True, "True")],
    )  # fmt: skip
    def test_values(self, value, text):
        assert short(value) == text

    def test_what_a_class_says_itself_stays(self):
        class Own:
            def __repr__(self):
                return "mine"

        assert repr(shown(Own)()) == "mine"


class TestXarray:
    def test_prediction(self, fit, record):
        prediction = fit.predict(record, samples=7)
        found = prediction.to_xarray(samples=True)
        np.testing.assert_array_equal(found["mean"].to_numpy(), prediction.mean)
        np.testing.assert_array_equal(found["sd"].sel(output="y").to_numpy(), prediction.sd[:, 0])
        upper = found["quantile"].sel(probability=0.975)
        np.testing.assert_array_equal(upper.to_numpy(), prediction.quantile(0.975))
        total = found["part"].sum("cause").to_numpy()
        np.testing.assert_allclose(total, prediction.variance, rtol=1e-9)
        np.testing.assert_array_equal(found["sample"].to_numpy(), prediction.samples)
        assert found["output_unit"].to_numpy().tolist() == ["m"]
        assert found.attrs["kind"] == prediction.kind
        assert "sample" not in prediction.to_xarray()
