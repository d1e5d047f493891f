"""Figures: what they draw is what the numbers say, with names and units on every axis."""

import dataclasses
import re

import matplotlib.dates as mdates
import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure

import pyro_dynogp as dgp
from pyro_dynogp import plotting
from pyro_dynogp.inference.posteriors import Sampled
from pyro_dynogp.lti import views
from pyro_dynogp.plotting.diagnostics import cross_correlation, prewhitened
from pyro_dynogp.plotting.systems import _unwrapped

UNITS = {
    "input_names": ["valve"], "output_names": ["level"],
    "input_units": ["V"], "output_units": ["m"],
}  # fmt: skip


def refused(*parts):
    return pytest.raises(ValueError, match=".*".join(map(re.escape, parts)))


def tank(n=120, seed=0, **changes):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=n // 4 + 1), 4)[:n]
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.8 * y[k - 1] + 0.3 * u[k - 1]
    y += 0.05 * rng.normal(size=n)
    return dgp.Record(**({"time": np.arange(n) * 0.5, "inputs": u, "outputs": y} | UNITS | changes))


def with_draws(fit, count=25, seed=0):
    """A fit with a posterior of known draws around the optimum, without any sampling."""
    rng = np.random.default_rng(seed)
    draws = {
        site: value * torch.as_tensor(1 + 0.03 * rng.normal(size=(count, *value.shape)))
        for site, value in fit.mode.items()
    }
    return dataclasses.replace(fit, posterior=Sampled(draws), draws=draws)


@pytest.fixture(scope="module")
def record():
    return tank()


@pytest.fixture(scope="module")
def map_fit(record):
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    return dgp.fit(
        model, record[:80], restarts=1, steps=25, workers=1, progress=False, method="map"
    )


@pytest.fixture(scope="module")
def fit(map_fit):
    return with_draws(map_fit)


@pytest.fixture(scope="module")
def wide_fit():
    """Two inputs, two outputs."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=(60, 2))
    y = np.cumsum(u, axis=0) * 0.2 + rng.normal(size=(60, 2))
    model = dgp.LinearDynamicGP(inputs=2, outputs=2, pairs=1)
    record = dgp.Record(np.arange(60.0), u, y)
    return dgp.fit(
        model, record, restarts=1, steps=3, workers=1, progress=False, method="map"
    ), record


def line(axes, label):
    (found,) = [one for one in axes.lines if one.get_label() == label]
    return np.asarray(found.get_xdata(), float), np.asarray(found.get_ydata(), float)


def band(axes, label):
    """Lower and upper limit of a filled band, as drawn."""
    (found,) = [one for one in axes.collections if one.get_label() == label]
    corners = found.get_paths()[0].vertices
    n = (len(corners) - 3) // 2
    return corners[1 : n + 1, 1], corners[n + 2 : 2 * n + 2, 1][::-1]


def legend_texts(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def every_axis_is_labelled(figure):
    for axes in figure.axes:
        if not axes.axison:
            continue
        assert axes.get_ylabel()
        assert axes.get_xlabel() or not axes.xaxis.get_tick_params()["labelbottom"]


# Signals


def test_record(record):
    y = record.outputs.copy()
    y[[7, 8, 50]] = np.nan
    figure = plotting.record(record.with_outputs(y))
    top, bottom = figure.axes
    assert (top.get_ylabel(), bottom.get_ylabel()) == ("level [m]", "valve [V]")
    assert bottom.get_xlabel() == "time [s]"
    x, drawn = line(top, "output")
    np.testing.assert_array_equal(x, record.time)
    np.testing.assert_array_equal(drawn, y[:, 0])
    np.testing.assert_array_equal(line(top, "missing output sample")[0], record.time[[7, 8, 50]])
    np.testing.assert_array_equal(bottom.lines[0].get_ydata(), record.inputs[:, 0])
    assert bottom.lines[0].get_drawstyle() == "steps-post"
    assert "missing output sample" in legend_texts(figure)
    every_axis_is_labelled(figure)


def test_record_without_gaps_or_units():
    figure = plotting.record(dgp.Record([0, 1, 2], None, [1.0, 2.0, 3.0], time_unit="h"))
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time [h]", "y")
    assert legend_texts(figure) == ["output"]
    with refused("record", "inputs or outputs"):
        plotting.record(dgp.Record([0, 1]))


def test_dates():
    stamps = pd.date_range("2024-03-30", periods=60, freq="1h", tz="Australia/Melbourne")
    record = dgp.Record(stamps, np.arange(60.0), np.arange(60.0))
    figure = plotting.record(record[10:])
    x, _ = line(figure.axes[0], "output")
    expected = mdates.date2num(stamps[10:].tz_convert("UTC").tz_localize(None).to_numpy())
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-9)
    assert figure.axes[-1].get_xlabel() == "time [date, Australia/Melbourne]"
    figure.draw_without_rendering()
    assert "Mar" in "".join(text.get_text() for text in figure.axes[-1].get_xticklabels())


def test_prediction(fit, record):
    past, future = record.split(80)
    made = fit.forecast(past, future)
    figure = plotting.prediction(made, future, skip=3, past=past[-20:])
    top, bottom = figure.axes
    assert (top.get_ylabel(), bottom.get_ylabel()) == ("level [m]", "residual [m]")
    assert bottom.get_xlabel() == "time [s]"
    for label, levels in (("95 % band", [0.025, 0.975]), ("50 % band", [0.25, 0.75])):
        np.testing.assert_allclose(band(top, label), made.quantile(levels)[:, :, 0], rtol=1e-12)
    np.testing.assert_array_equal(line(top, "predictive mean")[1], made.mean[:, 0])
    np.testing.assert_array_equal(line(top, "measured"), [future.time, future.outputs[:, 0]])
    np.testing.assert_array_equal(line(top, "measured before")[0], past.time[-20:])
    residual = future.outputs[:, 0] - made.mean[:, 0]
    np.testing.assert_array_equal(line(bottom, "measured")[1], residual)
    assert "not scored" in legend_texts(figure)
    shaded = next(patch for patch in top.patches if patch.get_label() == "not scored")
    assert shaded.get_x() == future.time[0]
    assert shaded.get_width() == pytest.approx(2.5 * 0.5)
    every_axis_is_labelled(figure)


def test_wide_bands_of_skipped_samples_set_no_limits(fit, record):
    made = fit.predict(record)
    limits = plotting.prediction(made, record, skip=5).axes[1].get_ylim()
    residual = record.outputs[5:, 0] - made.mean[5:, 0]
    low, high = made.quantile([0.025, 0.975])[:, 5:, 0] - made.mean[5:, 0]
    assert limits[0] < min(residual.min(), low.min())
    assert limits[1] < 1.2 * max(residual.max(), high.max())


def test_prediction_alone(fit, record):
    figure = plotting.prediction(fit.simulate(record))
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time", "level")
    assert "measured" not in legend_texts(figure)


def test_prediction_on_dates(map_fit):
    stamps = pd.date_range("2024-01-01", periods=120, freq="500ms", tz="UTC")
    record = tank(time=stamps)
    past, future = record.split(100)
    figure = plotting.prediction(map_fit.forecast(past, future), future, past=past)
    zero = mdates.date2num(stamps[0].tz_localize(None))
    x = np.concatenate([line(figure.axes[0], "measured before")[0],
                        line(figure.axes[0], "predictive mean")[0]])  # fmt: skip
    np.testing.assert_allclose((x - zero) * 86400, np.arange(120) * 0.5, atol=1e-4)


def test_prediction_refuses(fit, record):
    made = fit.simulate(record)
    with refused("prediction", "60 times", "120 times"):
        plotting.prediction(made, record[:60])
    with refused("prediction", "other times of the same number"):
        plotting.prediction(made, dataclasses.replace(record, time=record.time + 1))
    with refused("skip", "0 to 119", "120"):
        plotting.prediction(made, record, skip=120)
    renamed = dataclasses.replace(record, output_names=("flow",))
    with refused("record", "['level']", "['flow']"):
        plotting.prediction(made, renamed)
    with refused("past", "['level']", "['flow']"):
        plotting.prediction(made, record, past=renamed)
    stamped = dataclasses.replace(record, start=pd.Timestamp("2024-01-01", tz="UTC"))
    with refused("past", "same kind of clock"):
        plotting.prediction(made, record, past=stamped)


def test_two_outputs(wide_fit):
    fit, record = wide_fit
    figure = plotting.prediction(fit.predict(record), record)
    assert [axes.get_ylabel() for axes in figure.axes] == ["y1", "residual", "y2", "residual"]
    figure = plotting.bode(fit)
    assert len(figure.axes) == 8
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[:2] == ["from u1 to y1", "from u2 to y1"]
    every_axis_is_labelled(figure)
    response = np.asarray(views.impulse_response(fit.modes, np.array([0.0, 1.0])))
    figure = plotting.impulse_response(fit, time=[0.0, 1.0])
    for k, axes in enumerate(figure.axes):
        drawn = line(axes, "posterior mode (MAP fit: no band)")[1]
        np.testing.assert_allclose(drawn, response[:, k // 2, k % 2], rtol=1e-12)
    assert len(plotting.residuals(fit, record).axes) == 8


# Systems


def test_impulse_response(fit):
    time = np.linspace(0, 5, 40)
    figure = plotting.impulse_response(fit, time)
    (axes,) = figure.axes
    draws = views.impulse_response(fit.modes, time).numpy()[:, :, 0, 0]
    np.testing.assert_allclose(
        band(axes, "95 % credible band"), np.quantile(draws, [0.025, 0.975], axis=0), rtol=1e-12
    )
    np.testing.assert_allclose(
        band(axes, "50 % credible band"), np.quantile(draws, [0.25, 0.75], axis=0), rtol=1e-12
    )
    np.testing.assert_allclose(line(axes, "posterior median")[1], np.median(draws, axis=0))
    assert axes.get_xlabel() == "time since the impulse [s]"
    assert axes.get_ylabel() == "response [m/(V s)]"
    (note,) = axes.texts
    assert f"{float(fit.modes.D.mean()):.2g}" in note.get_text()


def test_default_times_reach_until_the_response_has_died_down(fit):
    x, _ = line(plotting.impulse_response(fit).axes[0], "posterior median")
    assert x[0] == 0
    assert x[-1] <= fit.scaling.duration
    size = np.abs(views.impulse_response(fit.modes, x).numpy()[:, :, 0, 0])
    assert np.median(size[:, -1]) <= 0.02 * np.median(size, axis=0).max()


def test_map_has_no_band_and_says_so(map_fit):
    for figure in (plotting.impulse_response(map_fit), plotting.bode(map_fit)):
        assert "posterior mode (MAP fit: no band)" in legend_texts(figure)
        assert not figure.axes[0].collections
    assert "posterior mode (MAP fit: no draws)" in legend_texts(plotting.pole_map(map_fit))


def test_bode(fit):
    omega = np.geomspace(0.05, 10, 80)
    figure = plotting.bode(fit, omega)
    magnitude, phase = figure.axes
    G = views.frequency_response(fit.modes, omega).numpy()[:, :, 0, 0]
    decibel = 20 * np.log10(np.abs(G))
    np.testing.assert_allclose(
        band(magnitude, "95 % credible band"),
        np.quantile(decibel, [0.025, 0.975], axis=0), rtol=1e-10,
    )  # fmt: skip
    turns = (line(phase, "posterior median")[1] - np.median(np.degrees(np.angle(G)), 0)) / 360
    np.testing.assert_allclose(turns[0], np.round(turns[0]), atol=1e-6)
    for axes in figure.axes:
        assert line(axes, "Nyquist frequency")[0] == pytest.approx([np.pi / 0.5] * 2)
        assert axes.get_xscale() == "log"
    assert magnitude.get_ylabel() == "magnitude [dB]"
    assert phase.get_ylabel() == "phase [degrees]"
    assert phase.get_xlabel() == "angular frequency [rad/s]"
    assert magnitude.get_title(loc="left") == "from valve [V] to level [m]"


def test_phase_is_continuous_and_draws_agree():
    omega = np.geomspace(0.01, 100, 400)
    triple_lag = 1 / (1 + 1j * omega) ** 3
    # Two draws on either side of a half turn: -1 plus a little, and -1 less a little.
    draws = np.stack([-triple_lag * np.exp(0.05j), -triple_lag * np.exp(-0.05j)])
    phase = _unwrapped(draws)
    assert np.abs(np.diff(phase, axis=1)).max() < 10
    np.testing.assert_allclose(phase[0] - phase[1], np.degrees(0.1), atol=1e-9)
    assert np.ptp(phase[0]) == pytest.approx(270, abs=5)
    assert -180 <= np.median(phase[:, 0]) <= 180


@pytest.mark.parametrize("figure", [plotting.bode, plotting.impulse_response])
def test_system_figures_refuse(figure, map_fit):
    without = dataclasses.replace(map_fit, model=dgp.LinearDynamicGP(inputs=0))
    with refused("fit", "with inputs"):
        figure(without)
    with refused("shape (m,)"):
        figure(map_fit, 3.0)
    with refused("shape (m,)"):
        figure(map_fit, [1.0, np.nan])


def test_bode_refuses_frequencies_out_of_order(map_fit):
    for omega in ([0.0, 1.0], [2.0, 1.0]):
        with refused("omega", "increasing positive"):
            plotting.bode(map_fit, omega)


def test_pole_map(fit, map_fit):
    figure = plotting.pole_map(fit)
    (axes,) = figure.axes
    poles = fit.modes.poles.numpy().ravel()
    np.testing.assert_allclose(line(axes, "posterior draws"), [poles.real, poles.imag])
    (best,) = map_fit.modes.poles.numpy()
    np.testing.assert_allclose(line(axes, "best optimum"), [[best.real], [best.imag]])
    assert axes.get_ylabel() == "imaginary part [rad/s]"
    (left, right), (low, top) = axes.get_xlim(), axes.get_ylim()
    outside = int(((poles.real < left) | (poles.imag > top)).sum())
    assert (right > 0, low) == (True, 0)
    assert axes.get_xlabel().startswith("real part [1/s]")
    assert (f"({outside} of 25 draws lie outside)" in axes.get_xlabel()) == (outside > 0)
    rays = [one for one in axes.lines if one.get_color() == "#CFCFCF"]
    for ray, text in zip(rays, axes.texts, strict=True):
        x, y = np.asarray(ray.get_xdata())[1], np.asarray(ray.get_ydata())[1]
        assert -x / np.hypot(x, y) == pytest.approx(float(text.get_text()))


# Diagnostics


def test_residuals(fit, record):
    y = record.outputs.copy()
    y[30:33] = np.nan
    gappy = record.with_outputs(y)
    figure = plotting.residuals(fit, gappy)
    over_time, shape, auto, cross = figure.axes
    e = fit.innovations(gappy)[:, 0]
    np.testing.assert_array_equal(over_time.lines[0].get_ydata(), e)
    assert np.isnan(e).sum() == 3
    areas = [bar.get_width() * bar.get_height() for bar in shape.patches]
    assert sum(areas) == pytest.approx(1)
    x, density = line(shape, "standard normal")
    assert density.sum() * (x[1] - x[0]) == pytest.approx(1, abs=1e-3)
    lags, heights = (np.asarray(v) for v in auto.lines[0].get_data())
    assert lags.tolist() == list(range(1, 26))
    label = "95 % of each lag, if the errors are white"
    pairs = [np.isfinite(e[k:] * e[:-k]).sum() for k in lags]
    np.testing.assert_allclose(band(auto, label)[1], 1.96 / np.sqrt(pairs))
    np.testing.assert_allclose(band(auto, label)[0], -1.96 / np.sqrt(pairs))
    centred = e - np.nanmean(e)
    first = np.nanmean(centred[1:] * centred[:-1]) / np.nanvar(e)
    assert heights[0] == pytest.approx(first)
    np.testing.assert_allclose(
        cross.lines[0].get_ydata(),
        cross_correlation(prewhitened(record.inputs[:, 0]), e, np.arange(-25, 26))[0],
    )
    every_axis_is_labelled(figure)
    with refused("record", "ten measured samples", "5 of 'level'"):
        plotting.residuals(fit, record[:5])


def test_residuals_with_a_constant_input(fit, record):
    constant = dataclasses.replace(record, inputs=np.ones_like(record.inputs))
    title = plotting.residuals(fit, constant).axes[3].get_title(loc="left")
    assert title == "no cross-correlation with constant valve"


def test_cross_correlation_finds_a_delay():
    rng = np.random.default_rng(0)
    u = rng.normal(size=3000)
    e = np.roll(u, 4) + 0.5 * rng.normal(size=3000)
    lags = np.arange(-10, 11)
    correlation, pairs = cross_correlation(u, e, lags)
    assert lags[np.argmax(correlation)] == 4
    assert correlation.max() == pytest.approx(1 / np.sqrt(1.25), abs=0.02)
    assert pairs.tolist() == [3000 - abs(k) for k in lags]
    assert np.isnan(cross_correlation(np.array([1.0, np.nan]), np.array([np.nan, 2.0]), [0])[0][0])


def test_bands_hold_what_they_promise_for_a_slow_input():
    """Prewhitened, 95 % of the correlations with independent errors lie inside, lag by lag."""
    rng = np.random.default_rng(1)
    n, lags, inside, neighbours = 400, np.arange(-20, 21), [], []
    for _ in range(60):
        u, e = np.zeros(n), np.zeros(n)
        for k in range(1, n):
            u[k] = 0.97 * u[k - 1] + rng.normal()
            e[k] = 0.6 * e[k - 1] + rng.normal()
        correlation, pairs = cross_correlation(prewhitened(u), e, lags)
        inside.append(np.abs(correlation) < 1.96 / np.sqrt(pairs))
        raw, count = cross_correlation(u, e, lags)
        neighbours.append(np.abs(raw) < 1.96 / np.sqrt(count))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)
    assert np.mean(neighbours) < 0.85  # what the prewhitening is there for


def test_prewhitening():
    rng = np.random.default_rng(2)
    u = np.zeros(1000)
    for k in range(2, 1000):
        u[k] = 1.5 * u[k - 1] - 0.7 * u[k - 2] + rng.normal()
    white = prewhitened(u)
    assert len(white) == 1000
    correlation, pairs = cross_correlation(white, white, np.arange(1, 11))
    assert (np.abs(correlation) < 3 / np.sqrt(pairs)).all()
    assert np.nanstd(white) == pytest.approx(1, abs=0.08)
    periodic = prewhitened(np.tile([0.0, 1.0], 50))
    assert np.nanstd(periodic) > 0


def test_history(map_fit):
    (axes,) = plotting.history(map_fit).axes
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), map_fit.history)
    assert axes.get_ylabel() == "-log p(outputs, parameters) [nats]"
    noisy = dataclasses.replace(
        map_fit,
        posterior=Sampled(map_fit.draws, "svi"),
        history=np.r_[-1e6, np.linspace(-5, 0, 199)],
    )
    (axes,) = plotting.history(noisy).axes
    x, mean = line(axes, "mean of the last 50")
    assert (x[0], x[-1]) == (50, 200)
    assert mean[-1] == pytest.approx(noisy.history[-50:].mean())
    assert axes.get_ylim()[0] > -6
    assert axes.get_title(loc="left") == "begins at -1e+06, off the axis"
    with refused("fit", "history"):
        plotting.history(dataclasses.replace(map_fit, history=np.empty(0)))


def test_starts(map_fit):
    energies = np.array([-20.0, -19.5, 3.0])
    figure = plotting.starts(dataclasses.replace(map_fit, start_energies=energies))
    np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), [0, 0.5, 23])
    assert figure.axes[0].get_ylabel().endswith("[nats]")


def test_figures_belong_to_nobody(record, tmp_path):
    import matplotlib.pyplot as plt

    figure = plotting.record(record)
    assert isinstance(figure, Figure)
    assert plt.get_fignums() == []
    assert figure._repr_png_().startswith(b"\x89PNG")  # what a notebook shows
    figure.savefig(tmp_path / "record.png")
    assert (tmp_path / "record.png").stat().st_size > 5000
