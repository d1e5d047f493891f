"""Figures of a report: what they draw is what the report says."""

import re

import numpy as np
import pytest

from pyro_dynogp.report import figures
from pyro_dynogp.statistics.evidence import Evidence
from tests.discrepancy import reports


def line(axes, label):
    (found,) = [one for one in axes.lines if one.get_label() == label]
    return np.asarray(found.get_xdata(), float), np.asarray(found.get_ydata(), float)


def refused(*parts):
    return pytest.raises(ValueError, match=".*".join(map(re.escape, parts)))


def test_evidence():
    curve = reports.curve()
    shuffled = np.random.default_rng(0).permutation(25)
    mixed = reports.curve(x=curve.x[shuffled], y=curve.y[shuffled], fitted=curve.fitted[shuffled])
    (axes,) = figures.evidence(reports.effect(curve=mixed)).axes
    for label, y in (("data", curve.y), ("fitted effect", curve.fitted)):
        np.testing.assert_array_equal(line(axes, label), (curve.x, y))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("ambient [°C]", "residual [m]")
    assert axes.lines[0].get_linestyle() == "None"


def test_evidence_without_a_fitted_effect_or_points():
    figure = figures.evidence(reports.delay())
    (axes,) = figure.axes
    assert [one.get_label() for one in axes.lines] == ["data"]
    assert axes.lines[0].get_linestyle() == "-"
    assert not figure.legends
    figures.evidence(Evidence("drift", 3.0, 0.1, 2.0, 0.1, curve=reports.curve()))
    nothing = reports.curve(y=np.full(25, np.nan))
    for curve in (None, nothing):
        with refused("effect", "'extra input' without points"):
            figures.evidence(reports.effect(curve=curve))


def test_forecasts_before_and_after():
    report = reports.report()
    before, after = figures.before_after(report).axes
    for axes, made, scores in (
        (before, report.forecast_before, report.before),
        (after, report.forecast_after, report.after),
    ):
        x, mean = line(axes, "predictive mean")
        np.testing.assert_array_equal(x, report.sealed.time)
        np.testing.assert_allclose(mean, made.mean[:, 0])
        np.testing.assert_array_equal(line(axes, "measured")[1], report.sealed.outputs[:, 0])
        assert f"RMSE {scores['rmse']:.3g} m" in axes.get_title(loc="left")
        assert axes.get_ylabel() == "level [m]"
        band = axes.collections[0].get_paths()[0].vertices[:, 1]
        assert band.min() == pytest.approx(made.quantile(0.025).min(), rel=1e-9)
        assert band.max() == pytest.approx(made.quantile(0.975).max(), rel=1e-9)
    assert before.get_ylim() == after.get_ylim()
    part = figures.before_after(report, slice(10, 30))
    np.testing.assert_array_equal(line(part.axes[0], "measured")[0], report.sealed.time[10:30])
    with refused("part", "empty"):
        figures.before_after(report, slice(10, 10))


def test_residuals_have_one_scale_and_their_size():
    report = reports.report(outputs=2)
    axes = figures.residuals_before_after(report).axes
    assert len(axes) == 4
    assert axes[0].get_ylim() == axes[1].get_ylim()
    assert axes[2].get_ylim() == axes[3].get_ylim() != axes[0].get_ylim()
    residual = report.sealed.outputs[:, 1] - report.forecast_after.mean[:, 1]
    np.testing.assert_array_equal(line(axes[3], "measured less mean")[1], residual)
    assert f"{np.sqrt(np.nanmean(residual**2)):.3g} m" in axes[3].get_title(loc="left")


def test_one_panel_where_nothing_was_added():
    report = reports.nothing()
    assert len(figures.before_after(report).axes) == 1
    assert len(figures.residuals_before_after(report).axes) == 1


def test_a_long_record_keeps_its_extremes_and_gaps():
    report = reports.report(80_000)
    y = report.sealed.outputs.copy()
    y[7000:9000] = np.nan
    y[12_345] = 9.0
    report = reports.report(80_000, sealed=report.sealed.with_outputs(y))
    for axes in (
        *figures.before_after(report).axes,
        *figures.residuals_before_after(report).axes,
    ):
        drawn = axes.lines[-1] if axes.lines[-1].get_label() == "measured" else axes.lines[0]
        x, shown = np.asarray(drawn.get_xdata()), np.asarray(drawn.get_ydata())
        assert len(x) < 4000
        assert np.nanmax(shown) > 7.0
        inside = (x > report.sealed.time[7200]) & (x < report.sealed.time[8800])
        assert inside.any()
        assert np.isnan(shown[inside]).all()


def test_forecasts_of_other_times():
    report = reports.report()
    other = reports.prediction(report.known)
    with refused("report.forecast_after", "sealed block", "300 times"):
        figures.before_after(reports.report(forecast_after=other))
