"""Figures of the criticism: what they draw is what the numbers say."""

import re

import numpy as np
import pytest

from pyro_dynogp import plotting
from pyro_dynogp.criticism.calibration import calibration
from pyro_dynogp.criticism.predictive_checks import predictive_checks

from .known import measured, predicted


def line(axes, label):
    (found,) = [one for one in axes.lines if one.get_label() == label]
    return np.asarray(found.get_xdata(), float), np.asarray(found.get_ydata(), float)


def legend_texts(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_calibration_of_two_outputs():
    result = calibration(predicted(400, n_y=2, scale=0.5), measured(400, n_y=2))
    figure = plotting.calibration(result)
    assert len(figure.axes) == 6
    for a, name in enumerate(("level", "flow")):
        histogram, ecdf, coverage = figure.axes[3 * a : 3 * a + 3]
        assert histogram.get_title(loc="left").startswith(name)
        np.testing.assert_array_equal(histogram.patches[-1].get_data().values, result.density[:, a])
        for axes, at, values, low, high in (
            (ecdf, result.levels, result.ecdf, result.low, result.high),
            (coverage, result.nominal, result.coverage, result.coverage_low, result.coverage_high),
        ):
            x, y = line(axes, "measured")
            np.testing.assert_array_equal(x, [0, *at, 1])
            np.testing.assert_allclose(y, [0, *(values[:, a] - at), 0])
            corners = axes.collections[0].get_paths()[0].vertices
            assert corners[:, 1].max() == pytest.approx((high[:, a] - at).max())
            assert corners[:, 1].min() == pytest.approx((low[:, a] - at).min())
            outside = (values[:, a] > high[:, a]) | (values[:, a] < low[:, a])
            np.testing.assert_array_equal(line(axes, "outside the band")[0], at[outside])
            assert "[-]" in axes.get_xlabel()
            assert "[-]" in axes.get_ylabel()
        assert f"p = {result.p_value[a]:.2g}" in ecdf.get_title(loc="left")
    assert "95 % of calibrated records stay inside" in legend_texts(figure)
    assert figure.get_suptitle() == "Calibration of a simulation"


def test_calibrated_prediction_has_nothing_outside():
    made = predicted(100, kind="3-step prediction")
    figure = plotting.calibration(calibration(made, measured(100)))
    assert "outside the band" not in legend_texts(figure)
    assert "bands are too narrow" in figure.get_suptitle()


def test_predictive_checks():
    result = predictive_checks(predicted(200, scale=0.5), measured(200))
    figure = plotting.predictive_checks(result)
    shown = [axes for axes in figure.axes if axes.axison]
    assert len(shown) == len(result.statistics)
    out = "measured, stands out among all statistics"
    for j, axes in enumerate(shown):
        label = out if result.stands_out[j] else "measured"
        assert line(axes, label)[0].tolist() == [result.observed[j]] * 2
        assert axes.get_title(loc="left") == f"p = {result.p_value[j]:.2g}"
    assert result.stands_out.any()
    assert out in legend_texts(figure)
    assert shown[1].get_xlabel() == "standard deviation [m]"


def test_predictive_checks_of_two_outputs_and_of_one_statistic():
    made, record = predicted(60, n_y=2), measured(60, n_y=2)
    one = {"range [m]": lambda time, y: np.nanmax(y) - np.nanmin(y)}
    figure = plotting.predictive_checks(predictive_checks(made, record, one))
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert labels == ["level: range [m]", "flow: range [m]"]
    count = {"count": lambda time, y: float(np.sum(y > 3))}
    (axes, *_) = plotting.predictive_checks(predictive_checks(made, record, count)).axes
    assert axes.get_xlabel() == "level: count"


@pytest.mark.parametrize("figure", [plotting.calibration, plotting.predictive_checks])
def test_refuse_other_results(figure):
    with pytest.raises(ValueError, match=re.escape("result: expected a")):
        figure({"p": 1})
