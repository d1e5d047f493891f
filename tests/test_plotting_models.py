"""Figures of layers, of resonances, of several models on one record, of the law of errors."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy import optimize, stats

import pyro_dynogp as dgp
from pyro_dynogp import plotting
from pyro_dynogp.inference.posteriors import Sampled
from pyro_dynogp.lti.views import frequency_response, impulse_response
from pyro_dynogp.plotting.layers import Shown, frequency_grid
from tests.inference.cascades import wiener_record

QUICK = {"restarts": 1, "workers": 1, "progress": False, "method": "map", "steps": 3}


@pytest.fixture(scope="module")
def record():
    return wiener_record(n=60, input_units="V", output_units="m", input_names="valve")


@pytest.fixture(scope="module")
def wiener(record):
    return dgp.fit(dgp.Wiener(1, pairs=1, inducing=5), record, **QUICK)


@pytest.fixture(scope="module")
def sandwich(record):
    return dgp.fit(dgp.WienerHammerstein(1, pairs=1, inducing=5), record, **QUICK)


def lines(axes):
    return {line.get_label(): line.get_xydata() for line in axes.get_lines()}


def decibels(modes, omega):
    return 20.0 * np.log10(np.abs(frequency_response(modes, omega).numpy()))


class TestResonances:
    """A fixed grid of 600 frequencies cut a peak of damping 0.005 by 2.5 dB."""

    @pytest.mark.parametrize("damping", [0.0005, 0.005, 0.02, 0.05, 0.09, 0.12])
    @pytest.mark.parametrize("size", [396.0, 31.7, 1200.0])
    def test_the_grid_meets_the_peak(self, damping, size):
        pole = size * complex(-damping, np.sqrt(1.0 - damping**2))
        slow = complex(-1.0, 0.4)  # another mode, whose tail moves the peak
        modes = dgp.Modes([pole, slow], [[1.0 + 2.0j], [30.0]], [1.0, 1.0])
        shown = Shown("", modes, modes.poles.numpy(), (("u", ""),), (("y", ""),))
        grid = frequency_grid(shown, 0.3, 2500.0)
        assert (np.diff(grid) > 0).all()
        assert 0.3 <= grid[0] <= grid[-1] <= 2500.0
        half = max(3.0 * damping, 0.002) * size
        top = optimize.minimize_scalar(
            lambda omega: -float(decibels(modes, [omega]).item()),
            bounds=(size - half, size + half), method="bounded", options={"xatol": 1e-9},
        )  # fmt: skip
        near = grid[np.abs(grid - size) <= half]
        assert decibels(modes, near).max() >= -top.fun - 0.05
        even = np.geomspace(0.3, 2500.0, 600)
        lost = -top.fun - decibels(modes, even[np.abs(even - size) < 0.1 * size]).max()
        assert lost > 0.05 or damping >= 0.02  # else nothing would be shown by this

    def test_of_every_draw(self):
        rng = np.random.default_rng(0)
        damping = np.full(80, 0.003)
        size = 396.0 * (1.0 + 0.02 * rng.normal(size=80))
        poles = (size * (-damping + 1j * np.sqrt(1.0 - damping**2)))[:, None]
        modes = dgp.Modes(poles, np.ones((80, 1, 1)), np.ones((80, 1)))
        shown = Shown("", modes, poles[0], (("u", ""),), (("y", ""),))
        grid = frequency_grid(shown, 1.0, 2000.0)
        peaks = decibels(modes, grid)[..., 0, 0].max(axis=1)
        exact = np.sqrt(poles[:, 0].imag ** 2 - poles[:, 0].real ** 2)
        best = [decibels(modes[k], exact[[k]]).item() for k in range(80)]
        assert (peaks >= np.array(best) - 0.05).all()
        assert len(grid) < 3000

    def test_a_picture_has_it(self):
        rng = np.random.default_rng(0)
        time = np.arange(400) * 0.002
        system = dgp.Modes([-2.0 + 396.0j], [[1.0 + 0.3j]], [20.0])
        u = rng.normal(size=400)
        y = dgp.LTIProcess(system, time, u).mean.numpy()
        record = dgp.Record(time, u, y + 1e-3 * y.std() * rng.normal(size=400))
        options = {**QUICK, "steps": 60, "restarts": 3}
        fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **options)
        (pole,) = fit.modes.poles.tolist()
        assert -pole.real / abs(pole) < 0.01
        drawn = plotting.bode(fit).axes[0].get_lines()[0].get_xydata()
        fine = abs(pole) * np.linspace(0.98, 1.02, 20001)
        assert drawn[:, 1].max() >= decibels(fit.modes, fine).max() - 0.05


class TestLayers:
    def test_the_only_dynamic_layer_needs_no_name(self, wiener):
        for name in (None, "g"):
            figure = plotting.bode(wiener, layer=name)
            line = figure.axes[0].get_lines()[0].get_xydata()
            modes = wiener.system.layer("g").modes[0]
            np.testing.assert_allclose(line[:, 1], decibels(modes, line[:, 0])[:, 0, 0])
            assert "layer g" in figure.get_suptitle()
            assert figure.axes[0].get_title(loc="left") == "from valve [sd] to g [sd]"

    def test_each_of_two(self, sandwich):
        time = np.linspace(0.0, 3.0, 40)
        for name in ("g1", "g2"):
            modes = sandwich.system.layer(name).modes[0]
            figure = plotting.impulse_response(sandwich, time, layer=name)
            found = [x.get_ydata() for x in figure.axes[0].get_lines() if len(x.get_xdata()) == 40]
            np.testing.assert_allclose(found[0], impulse_response(modes, time)[:, 0, 0])
            cross = plotting.pole_map(sandwich, layer=name).axes[0].get_lines()
            crosses = [x.get_xydata() for x in cross if x.get_marker() == "x"]
            pole = modes.poles[0].item()
            np.testing.assert_allclose(crosses[0], [[pole.real, pole.imag]])

    def test_refusals(self, wiener, sandwich):
        for draw in (plotting.bode, plotting.impulse_response, plotting.pole_map):
            with pytest.raises(ValueError, match=r"layer: .*'g1', 'g2'.*None"):
                draw(sandwich)
            for layer in ("f", 3):
                with pytest.raises(ValueError, match="layer: expected a dynamic layer"):
                    draw(wiener, layer=layer)


class TestStaticFunctions:
    def test_band_and_data(self, wiener, record):
        band = wiener.static_function("f", record)
        figure = plotting.static_function(wiener, record)
        above, below = figure.axes
        np.testing.assert_array_equal(
            lines(above)["mean"], np.column_stack([band.x, band.mean[:, 0]])
        )
        wide = above.collections[0].get_datalim(above.transData)
        assert wide.y1 == pytest.approx((band.mean + stats.norm.ppf(0.975) * band.sd).max())
        area = sum(p.get_width() * p.get_height() for p in below.patches)
        assert area == pytest.approx(1.0)
        middle = np.average([p.get_x() + p.get_width() / 2 for p in below.patches],
                            weights=[p.get_height() for p in below.patches])  # fmt: skip
        assert middle == pytest.approx(band.inputs.mean(), abs=np.ptp(band.inputs) / 40)

    def test_refusals(self, wiener, record):
        linear = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **QUICK)
        with pytest.raises(ValueError, match=r"layer: .*\[\].*None"):
            plotting.static_function(linear, record)
        for layer in ("g", 3):
            with pytest.raises(ValueError, match="layer: expected a static layer"):
                plotting.static_function(wiener, record, layer)
        with pytest.raises(ValueError, match="channel"):
            plotting.static_function(wiener, record, channel=1)


class TestComparison:
    def test_means_bands_and_errors(self, wiener, record):
        linear = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **QUICK)
        models = {"linear": linear.predict(record), "bent": wiener.predict(record)}
        figure = plotting.compare(models, record, skip=5)
        above, below = figure.axes
        for k, (name, one) in enumerate(models.items()):
            error = record.outputs[5:, 0] - one.mean[5:, 0]
            rmse = f"{np.sqrt(np.mean(error**2)):.3g}"
            drawn = lines(above)[f"{name}: RMSE {rmse} m"]
            np.testing.assert_array_equal(drawn[:, 1], one.mean[:, 0])
            np.testing.assert_array_equal(
                below.get_lines()[k].get_ydata(), record.outputs[:, 0] - one.mean[:, 0]
            )
            band = above.collections[k].get_datalim(above.transData)
            assert band.y1 == pytest.approx(one.quantile(0.975).max())

    def test_refusals(self, wiener, record):
        one = wiener.predict(record)
        for wrong in ({}, [one], None, one):
            with pytest.raises(ValueError, match="predictions: expected"):
                plotting.compare(wrong, record)
        with pytest.raises(ValueError, match="predictions"):
            plotting.compare({"a": 3}, record)
        with pytest.raises(ValueError, match="prediction: expected the 50 times"):
            plotting.compare({"a": one}, record[:50])
        for skip in (-1, 60, True, "a"):
            with pytest.raises(ValueError, match="skip"):
                plotting.compare({"a": one}, record, skip=skip)


class TestQuantiles:
    def test_points_and_band(self, wiener, record):
        axes = plotting.quantiles(wiener, record).axes[0]
        errors = np.sort(wiener.innovations(record)[:, 0])
        found = lines(axes)["errors"]
        np.testing.assert_array_equal(found[:, 1], errors)
        np.testing.assert_allclose(stats.norm.cdf(found[:, 0]), (np.arange(60) + 0.5) / 60)

    def test_the_band_holds_ordered_errors_of_normal_ones(self, wiener, record):
        """Each with 95 %: counted over 400 replicates of 60 normal numbers."""
        axes = plotting.quantiles(wiener, record).axes[0]
        outline = axes.collections[0].get_paths()[0].vertices
        expected = lines(axes)["errors"][:, 0]
        ends = [outline[np.isclose(outline[:, 0], x), 1] for x in expected]
        low, high = (np.array([f(end) for end in ends]) for f in (np.min, np.max))
        drawn = np.sort(np.random.default_rng(0).normal(size=(400, 60)), axis=1)
        share = ((drawn >= low) & (drawn <= high)).mean(axis=0)
        assert np.abs(share - 0.95).max() < 0.05
        assert abs(share.mean() - 0.95) < 0.01

    def test_too_few(self, wiener, record):
        outputs = record.outputs.copy()
        outputs[9:] = np.nan
        with pytest.raises(ValueError, match="ten measured samples"):
            plotting.quantiles(wiener, record.with_outputs(outputs))


def test_draws_are_bands(wiener):
    rng = np.random.default_rng(0)
    draws = {k: v * torch.as_tensor(1 + 0.03 * rng.normal(size=(9, *v.shape[1:])))
             for k, v in wiener.draws.items()}  # fmt: skip
    several = dataclasses.replace(wiener, posterior=Sampled(draws), draws=draws)
    line = lines(plotting.bode(several).axes[0])["posterior median"]
    modes = several.system.layer("g").modes
    expected = np.median(decibels(modes, line[:, 0])[..., 0, 0], axis=0)
    np.testing.assert_allclose(line[:, 1], expected)
