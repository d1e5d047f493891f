import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from pyro_dynogp.effects.noise_effects import (
    feedback,
    heavy_tails,
    heteroscedastic_noise,
    process_noise,
    student_t,
)
from pyro_dynogp.statistics import bootstrap as sieve

from .series import check_rate, in_other_units, residuals


def with_noise(r, x):
    """The same record with one-step errors x (n,)."""
    return dataclasses.replace(r, output=r.mean + x, innovations=x / x.std())


def growing_with_input(seed, n=400):
    r = residuals(seed, n, pole=0.0, inputs=2)
    u = r.inputs[:, 1] / r.inputs[:, 1].std()
    return with_noise(r, r.residual * np.exp(0.5 * u))


def closed_loop(seed, n=400):
    """A controller that answers one sample later; the model is right."""
    generator = np.random.default_rng(seed)
    e = 0.6 * lfilter([1.0], [1.0, -0.8], generator.standard_normal(n))
    reference = lfilter([1.0], [1.0, -0.9], generator.standard_normal(n))
    u, mean = np.zeros(n), np.zeros(n)
    for t in range(1, n):
        mean[t] = 0.7 * mean[t - 1] + 0.3 * u[t - 1]
        u[t] = 0.5 * (reference[t] - mean[t - 1] - e[t - 1])
    r = residuals(seed, n, inputs=2)
    inputs = np.column_stack([r.inputs[:, 0], u])
    return dataclasses.replace(r, inputs=inputs, mean=mean, output=mean + e)


class TestWithoutEffect:
    def test_level_is_kept_by_tails_and_process_noise(self):
        series = [residuals(s) for s in range(100)]
        for detector in (heavy_tails, process_noise):
            check_rate([detector(r, seed=s).p_value for s, r in enumerate(series)])

    def test_level_is_kept_by_sizes(self, monkeypatch):
        monkeypatch.setattr(sieve, "REPLICATES", 19)
        monkeypatch.setattr(sieve, "FEWEST", 19)
        check_rate([heteroscedastic_noise(residuals(s, 150), seed=s).p_value for s in range(100)])

    def test_level_is_kept_by_feedback(self):
        series = (residuals(s, deviation=0.02) for s in range(100))
        check_rate([feedback(r, seed=s)[0].p_value for s, r in enumerate(series)])


class TestHeavyTails:
    def test_degrees_of_freedom(self):
        r = residuals(0, 600, draw=lambda g, m: g.standard_t(4.0, m))
        found = heavy_tails(r)
        assert found.p_value < 1e-4
        assert found.gain > 10.0
        assert 3.0 < found.where["degrees_of_freedom"] < 6.0

    def test_outliers_are_counted(self):
        r = residuals(1, 400)
        v = r.innovations.copy()
        v[[30, 130, 230, 330]] = 8.0, -8.0, 9.0, 7.0
        assert heavy_tails(dataclasses.replace(r, innovations=v)).where["outliers"] == 4

    def test_normal_noise_has_no_student_t(self):
        nu, location, scale, gain = student_t(np.random.default_rng(0).standard_normal(2000))
        assert nu > 30.0
        assert gain < 2.0
        assert location == pytest.approx(0.0, abs=0.1)
        assert scale == pytest.approx(1.0, abs=0.1)

    def test_coloured_noise_does_not_look_heavy(self):
        x = lfilter([1.0], [1.0, -0.95], np.random.default_rng(3).standard_normal(400))
        assert heavy_tails(with_noise(residuals(0, 400), x)).p_value > 0.05


class TestHeteroscedasticNoise:
    def test_driver_is_named(self):
        found = [heteroscedastic_noise(growing_with_input(s), seed=s) for s in range(3)]
        assert all(e.p_value < 1e-4 and e.where["driver"] == "u2" for e in found)

    def test_time_is_named(self):
        r = residuals(0, 500, pole=0.0)
        found = heteroscedastic_noise(with_noise(r, r.residual * np.linspace(0.5, 2.0, 500)))
        assert found.p_value < 1e-4
        assert found.where["driver"] == "time"

    def test_heavy_tails_are_no_driver(self):
        series = (residuals(s, draw=lambda g, m: g.standard_t(4.0, m)) for s in range(5))
        assert np.median([heteroscedastic_noise(r).p_value for r in series]) > 0.05


class TestProcessNoise:
    def test_time_constant(self):
        decay = np.exp(-0.5 / 1.5)
        x = lfilter([1.0], [1.0, -decay], np.random.default_rng(0).standard_normal(600))
        found = process_noise(with_noise(residuals(0, 600), x))
        assert found.p_value < 1e-4
        assert found.where["time_constant"] == pytest.approx(1.5, rel=0.35)

    def test_changing_size_does_not_look_coloured(self):
        check_rate([process_noise(growing_with_input(s), seed=s).p_value for s in range(40)])

    def test_missing_samples(self):
        x = lfilter([1.0], [1.0, -0.7], np.random.default_rng(1).standard_normal(400))
        r = with_noise(residuals(0, 400), x)
        v = r.innovations.copy()
        v[::7] = np.nan
        assert process_noise(dataclasses.replace(r, innovations=v)).p_value < 1e-4


class TestFeedback:
    def test_loop_is_found_and_its_input_named(self):
        for s in range(3):
            other, own = feedback(closed_loop(s), seed=s)
            assert (own.where["channel"], other.where["channel"]) == ("u2", "u1")
            assert own.p_value < 1e-4
            assert other.p_value > 1e-3
            assert "after 0.5 s" in own.sentence

    def test_dynamics_that_the_model_lacks_are_no_feedback(self):
        def slower(t, mean, u):
            return lfilter([0.0, 0.1], [1.0, -0.9], mean)

        check_rate([feedback(residuals(s, effect=slower))[0].p_value for s in range(30)])


@pytest.mark.parametrize("detector", [heavy_tails, heteroscedastic_noise, process_noise, feedback])
def test_units_and_order_do_not_matter(detector):
    r = growing_with_input(0)
    one, other = detector(r), detector(in_other_units(r))
    one, other = (one, other[::-1]) if isinstance(one, list) else ([one], [other])
    for a, b in zip(one, other, strict=True):
        assert b.p_value == pytest.approx(a.p_value, rel=1e-6)
        assert b.size == pytest.approx(1e-3 * a.size, rel=1e-5)
        for key, value in a.where.items():
            scale = 60.0 if key == "time_constant" else 1.0
            assert b.where[key] == (
                value if isinstance(value, str) else pytest.approx(scale * value, rel=1e-6)
            )


def test_too_few_samples_are_refused():
    r = residuals(0)
    few = dataclasses.replace(r, held_out=np.arange(300) < 20)
    for detector in (heavy_tails, heteroscedastic_noise, process_noise, feedback):
        with pytest.raises(ValueError, match="30"):
            detector(few)
