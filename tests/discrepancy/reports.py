"""Made-up reports: records and predictions of known numbers, and no fit."""

from types import SimpleNamespace

import numpy as np
import pandas as pd

from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.result import Attempt, EffectTest, FoundEffect
from pyro_dynogp.models.description import Part
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.report.report import Report
from pyro_dynogp.statistics.evidence import Curve, Evidence

GIVEN = (
    Part("inputs", "Inputs", "valve [V]", separator=": "),
    Part("dynamics", "Dynamics", "3 pairs of poles, process noise", separator=": "),
    Part("noise", "Noise", "Gaussian", joins=True, separator=": "),
)
EXTENDED = (
    Part("inputs", "Inputs", "valve [V], delayed by 2.1 s", separator=": "),
    Part("extra input", "Extra input", "ambient [°C]", joins=True, separator=": "),
    *GIVEN[1:],
)
EXPERIMENT = "step the valve while the ambient temperature is constant."


def record(n=400, *, outputs=1, seed=0, **changes):
    """A slow signal with noise; the last output has a gap."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 0.5
    y = np.sin(t[:, None] / 12.0 + np.arange(outputs)) + 0.2 * rng.normal(size=(n, outputs))
    y[n // 3 : n // 3 + max(n // 30, 2), -1] = np.nan
    options = {
        "input_names": ["valve"], "input_units": ["V"],
        "output_names": [f"level{a}" if a else "level" for a in range(outputs)],
        "output_units": ["m"] * outputs, "name": "plant",
        "extra": {"ambient": rng.normal(size=n)}, "extra_units": {"ambient": "°C"},
    }  # fmt: skip
    return Record(t, np.sign(np.sin(t / 7.0)), y, **(options | changes))


def prediction(of, offset=0.0, sd=0.2, draws=5):
    """A forecast that is off by a slow wave, with a few draws."""
    n, n_y = of.outputs.shape
    mean = np.sin(of.time[:, None] / 12.0 + np.arange(n_y)) + offset * np.cos(of.time[:, None] / 9)
    spread = 0.02 * np.linspace(-1, 1, draws)[:, None, None]
    return Prediction(
        time=of.time,
        output_names=of.output_names,
        component_mean=mean + spread,
        component_variance=np.full((draws, n, n_y), 0.01),
        noise_variance=np.full((draws, n_y), sd**2),
        parts={},
        sampler=lambda: np.zeros((0, n, n_y)),
        kind="forecast",
    )


def curve(m=25, **changes):
    x = np.linspace(-8.0, 31.0, m)
    y = 0.012 * (x - 10) + 0.02 * np.sin(3 * x)
    options = {
        "x": x, "y": y, "fitted": 0.012 * (x - 10), "x_label": "ambient [°C]",
        "y_label": "residual [m]",
    }  # fmt: skip
    return Curve(**(options | changes))


def effect(**changes):
    options = {
        "name": "extra input",
        "sentence": "Channel 'ambient' acts on 'level', 3.5 s later, about 0.31 m (rms).",
        "p_value": 2e-5, "q_value": 0.0004, "gain": 84.31, "gain_error": 12.7, "size": 0.4,
        "parameters": {"gain of ambient [m/°C]": (0.0121, 0.0009), "time constant [s]": (4.2, 0.6)},
        "block": "ambient as an input of the dynamics", "curve": curve(),
        "ties": ("drift", "calendar"), "experiment": EXPERIMENT,
    }  # fmt: skip
    return FoundEffect(**(options | changes))


def delay(**changes):
    grid = np.linspace(-4, 8, 30)
    gains = 40 * np.exp(-0.5 * ((grid - 2.1) / 1.2) ** 2) - 6
    options = {
        "name": "dead time", "sentence": "'level' follows channel 'valve' 2.1 s later than the "
        "model says, about 0.12 m (rms).", "p_value": 0.0031, "q_value": 0.021, "gain": 21.0,
        "gain_error": 6.1, "size": 0.12, "parameters": {}, "block": "valve delayed by 2.1 s",
        "curve": curve(
            x=grid, y=gains, fitted=np.full(30, np.nan), x_label="additional delay [s]",
            y_label="gain [nats]",
        ), "ties": (), "experiment": "",
    }  # fmt: skip
    return FoundEffect(**(options | changes))


def attempt(number, name, p, decision, reason, size=0.31, **changes):
    evidence = Evidence(
        name, 4.0, p, 11.0, size, {"channel": "ambient"}, f"What the test for {name} says."
    )
    return Attempt(**({"round": number, "evidence": evidence, "q_value": min(4 * p, 1.0),
                       "decision": decision, "reason": reason} | changes))  # fmt: skip


def attempts():
    return (
        attempt(1, "calendar", 0.31, "not tried", "q-value above 0.1"),
        attempt(1, "extra input", 2e-5, "accepted", "largest elpd gain of the round",
                gain=84.31, gain_error=12.7, seconds=14.2),
        attempt(1, "drift", 0.002, "rejected", "elpd gain below two standard errors",
                gain=3.1, gain_error=4.4, seconds=9.0),
        attempt(1, "feedback", 0.004, "reported", "no block can add it"),
        attempt(2, "dead time", 0.0031, "accepted", "largest elpd gain of the round",
                gain=21.0, gain_error=6.1, seconds=130.0, size=0.12),
    )  # fmt: skip


def tests():
    return (
        EffectTest(1, "extra input", "level", "ambient", 2e-5, 0.0004, "accepted"),
        EffectTest(1, "level shift", "level", "time 31.5", 0.31, 1.0, "not significant"),
        EffectTest(2, "any structure", "level", "", 0.74, 0.74, "not significant"),
    )


def report(n=400, outputs=1, seed=0, **changes):
    """Two effects found."""
    whole = record(n, outputs=outputs, seed=seed)
    known, sealed = whole.split(3 * n // 4)
    forecasts = prediction(sealed, 0.4), prediction(sealed, 0.05)
    errors = [sealed.outputs - made.mean for made in forecasts]
    rmse, mae = ([float(np.nanmean(np.abs(e) ** k) ** (1 / k)) for e in errors] for k in (2, 1))
    options = {
        "effects": (effect(), delay()),
        "outcome": "effects added",
        "before": {"rmse": rmse[0], "mae": mae[0], "nrmse": 0.55, "crps": 0.21, "coverage_50": 0.31,
                   "coverage_95": 0.74},
        "after": {"rmse": rmse[1], "mae": mae[1], "nrmse": 0.29, "crps": 0.12, "coverage_50": 0.49,
                  "coverage_95": 0.94},
        "elpd_gain": 61.2, "elpd_gain_error": 9.8,
        "fit": SimpleNamespace(), "base": SimpleNamespace(), "extended": SimpleNamespace(),
        "attempts": attempts(), "tests": tests(),
        "left": (),
        "warnings": ("The inputs hardly excite frequencies above 0.2 rad/s.",),
        "data": "Fitted to 200 samples, searched on the 100 after them, reported on the last 100.",
        "last_block_tests": {"extra input: ambient": (0.0004, 0.41), "dead time": (0.02, 0.33),
                  "process noise": (0.01, 0.02), "calendar": (0.6, 0.5),
                  "heavy tails": (0.2, 0.04)},
        "sealed": sealed, "known": known,
        "forecast_before": forecasts[0], "forecast_after": forecasts[1],
        "model_before": GIVEN, "model_after": EXTENDED,
        "seconds": {"fit of the model given": 31.2, "tests": 12.0, "refits": 153.0},
    }  # fmt: skip
    return Report(**(options | changes))


def nothing(**changes):
    """Nothing found: every stage has its say all the same."""
    made = report()
    same = {
        "effects": (), "outcome": "nothing missing", "after": made.before, "elpd_gain": 0.0,
        "elpd_gain_error": 0.0, "attempts": made.attempts[:1], "warnings": (),
        "last_block_tests": {"calendar": (0.6, 0.6)}, "forecast_after": made.forecast_before,
        "model_after": GIVEN,
    }  # fmt: skip
    return report(**(same | changes))


def with_names(name, input_unit="m", output_unit="m"):
    """A report in which a name is everywhere where a file can put one."""
    w = record(240)
    stamps = pd.date_range("2024-03-30", periods=240, freq="1h", tz="Europe/Vienna")
    named = Record(
        stamps, w.inputs, w.outputs, input_names=["u" + name], output_names=[name],
        input_units=[input_unit], output_units=[output_unit], extra={name + "c": w.outputs[:, 0]},
        name=name,
    )  # fmt: skip
    known, sealed = named.split(180)
    forecast = prediction(sealed)
    found = effect(
        name=name, sentence=name, block=name, parameters={name: (1.0, 0.1)}, ties=(name,),
        experiment=name, curve=curve(x_label=name, y_label=name),
    )  # fmt: skip
    return report(
        known=known, sealed=sealed, forecast_before=forecast, forecast_after=forecast,
        effects=(found,), warnings=(name,), data=name, model_before=(Part(name, name),),
        model_after=(Part(name, name), Part("long", name * 3)),
        last_block_tests={name: (0.1, 0.2)}, seconds={name: 1.0},
        attempts=(attempt(1, name, 0.01, "rejected", name),
                  attempt(1, name, 0.1, "not tried", name)),
    )  # fmt: skip
