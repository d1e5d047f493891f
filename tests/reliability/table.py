"""Every public name with calls that are good, and for each argument values that are bad.

A new public name, or a new argument of one, is entered here or `test_bad_input.py` fails.
"""

from __future__ import annotations

import dataclasses
import functools
import tempfile
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gpytorch
import numpy as np
import pandas as pd
import scipy.io
import torch

import pyro_dynogp as dgp
from pyro_dynogp import effects, guides, plotting
from pyro_dynogp.examples import datasets
from tests.inference.cascades import wiener_record


class World:
    """A record, its fits and predictions, made when they are first asked for."""

    @functools.cached_property
    def record(self):
        units = {"input_units": "V", "output_units": "m", "input_names": "valve"}
        return wiener_record(n=60, **units)

    @functools.cached_property
    def blank(self):
        return self.record.with_outputs(np.zeros((60, 0)), names=())

    @functools.cached_property
    def others(self):
        """Records that a fit to `record` cannot take."""
        r = self.record
        two = np.column_stack([r.inputs, r.inputs])
        return [
            dgp.Record(r.time, two, r.outputs),
            dataclasses.replace(r, input_units=("kV",)),
            dataclasses.replace(r, input_names=("other",)),
            dataclasses.replace(r, output_units=("km",)),
            dataclasses.replace(r, time_unit="h"),
            r.with_outputs(two, names=["y", "z"]),
        ]

    @functools.cached_property
    def linear(self):
        return dgp.LinearDynamicGP(1, pairs=1)

    @functools.cached_property
    def fit(self):
        return dgp.fit(self.linear, self.record, method="map", **QUICK)

    @functools.cached_property
    def bent(self):
        model = dgp.Wiener(1, pairs=1, inducing=5)
        return dgp.fit(model, self.record, method="map", steps=4, **QUICK)

    @functools.cached_property
    def prediction(self):
        return self.fit.predict(self.record)

    @functools.cached_property
    def modes(self):
        return dgp.Modes([-0.5 + 2.0j], [[0.5 + 0.15j]], [1.0], [[0.03]])

    @functools.cached_property
    def stamped(self):
        return dgp.Record(pd.date_range("2024-01-01", periods=9, tz="UTC"), outputs=np.zeros(9))

    @functools.cached_property
    def frame(self):
        return pd.DataFrame({"t": [0.0, 1.0, 2.0], "u": [1.0, 2.0, 4.0], "y": [0.5, 1.0, 2.0]})

    @functools.cached_property
    def text(self):
        path = tempfile.mkdtemp() + "/data.csv"
        self.frame.to_csv(path, index=False)
        return path

    @functools.cached_property
    def matlab(self):
        path = tempfile.mkdtemp() + "/data.mat"
        scipy.io.savemat(path, {name: self.frame[name].to_numpy() for name in self.frame})
        return path

    @functools.cached_property
    def past(self):
        return self.record[:40]

    @functools.cached_property
    def future(self):
        return self.record[40:]


QUICK = {"restarts": 1, "workers": 1, "progress": False}
NOTHING = object()
# What is bad for any argument of a kind. None is left out where it means "none given".
JUNK = ("text", b"bytes", [1], {"a": 1}, 1 + 2j, object)
COUNT = (0, -1, 1.5, np.nan, np.inf, True, "2", [2], 2j)
NUMBER = (-1, 1.5, np.nan, True, "2", [2])
SEED = (-1, 1.5, None, 2**70, True, "a", [1], np.nan)
BOTH = (-1, 2, 0.5, "one", None, np.nan, [1])
SWITCH = (2, "no", None, 0.5, [True])
SHARE = (0.0, 1.0, -0.1, 1.5, np.nan, "a", None, True)
POSITIVE = (0.0, -1.0, np.nan, np.inf, "a", [1.0])
NAME = ("nonsense", 3, True, b"map", ["map"])
RECORD = (None, 3, "text", np.zeros(3), {}, [], [3])
KERNEL = ("matern", 3, gpytorch.kernels.MaternKernel(batch_shape=torch.Size([2])))
LIKELIHOOD = ("gaussian", 3, dgp.Gaussian)
ARRAY = ("text", [[1.0], [1.0, 2.0]], {"a": 1}, np.array(["a"]), np.zeros((2, 3, 4)))


@dataclass(frozen=True)
class Entry:
    """One public function or class, or one verb of what it returns.

    Attributes:
        call: makes the callable of a world. good: arguments with which it works, of a world.
        bad: for each argument values that are refused; of a world where a function is given.
        free: arguments of which any value is good, or that another entry has.
        late: whether a call with good arguments is too long to be tried.
    """

    call: Callable[[World], Callable[..., Any]]
    good: Callable[[World], Mapping[str, Any]]
    bad: Mapping[str, Sequence[Any] | Callable[[World], Sequence[Any]]]
    free: tuple[str, ...] = ()
    late: bool = False


def plain(function, bad, free=(), late=False, **good):
    return Entry(lambda world: function, lambda world: good, bad, tuple(free), late)


OPTIONS = {
    "initial_state": NAME, "integrate": NAME, "priors": NAME, "direct": (-1, 1.5, 5, "a", True),
    "output": ("nonsense", 3), "likelihood": LIKELIHOOD,
}  # fmt: skip
LAYER = {"inputs": NUMBER, "outputs": COUNT, "pairs": COUNT, "process_noise": SWITCH, **OPTIONS}
CURVED = {**LAYER, "inducing": COUNT, "kernel": KERNEL}
RUN = {"seed": SEED, "workers": COUNT, "progress": SWITCH}
SAMPLES = {"samples": COUNT, "seed": SEED}
AXIS = ("text", [1.0], [1.0, np.nan], 3.0, [[1.0, 2.0]])
LAYERS = (3, "nonsense", "y")
VARIATIONAL = {"draws": COUNT, "particles": COUNT, "learning_rate": POSITIVE}

NAMES = (3, 1.5, True, b"valve", {"valve": 1}, ["absent"], [3], [None], object(), np.zeros(2))
TEXT = (3, True, b"text", ["time"], {"a": 1}, object())
UNITS = (3, True, b"V", {"V": 1}, ["a", "b", "c"], [3])
FRAMES = (None, 3, "text", b"frame", {"valve": [1.0]}, [1.0], np.zeros(3), [], dict)
READ = {
    "inputs": NAMES,
    "outputs": NAMES,
    "output": ("y", *NAMES),
    "time": ("absent", *TEXT),
    "sampling_time": (*POSITIVE, True),
    "timezone": TEXT,
    "time_unit": TEXT,
    "extra": NAMES,
    "input_units": UNITS,
    "output_units": UNITS,
    "extra_units": (3, True, "V", b"V", ["V"], {"absent": "V"}, {3: "V"}),
    "name": TEXT,
    "nonsense": (1,),
}


def foreign(world):
    return [*RECORD, *world.others]


def measured(world):
    return [*foreign(world), world.blank]


def unlike(world):
    """What is no record of a prediction: it knows its outputs, not the inputs."""
    return [*RECORD, world.others[3], world.others[5], world.blank, world.record[1:]]


def of_model(layer, **options):
    """A layer in a model: layers are checked where they are placed."""

    def made(**arguments):
        below = [] if layer is dgp.Dynamic else [dgp.Dynamic(pairs=1)]
        return dgp.Cascade(1, [*below, layer(**{**options, **arguments})])

    return made


def of_product():
    """A product of the input and the output, which comes back."""

    def made(**arguments):
        given = {"sees": ("inputs", "g"), "name": "f", **arguments}
        loop = dgp.Dynamic(pairs=1, feedback=("f",))
        return dgp.Cascade(1, [loop, dgp.Product(**given)], output="g")

    return made


TABLE: dict[str, Entry] = {
    "LinearDynamicGP": plain(dgp.LinearDynamicGP, {**LAYER, "noise": NAME, "brownian": COUNT,
                             "feedthrough": SWITCH, "integrators": BOTH}, inputs=1, pairs=1),
    "Wiener": plain(dgp.Wiener, CURVED, inputs=1, pairs=1),
    "Hammerstein": plain(dgp.Hammerstein, CURVED, inputs=1, pairs=1),
    "WienerHammerstein": plain(dgp.WienerHammerstein, {**CURVED, "width": COUNT}, inputs=1,
                               pairs=1),
    "HammersteinWiener": plain(dgp.HammersteinWiener, CURVED, inputs=1, pairs=1),
    "NonlinearFeedback": plain(dgp.NonlinearFeedback, {**CURVED, "hidden": NUMBER,
                                "step": ("yes", 2, 0.5, [True]),
                                "parametric": ("square", "hysteresis", 2, ["cube"]),
                                "substeps": (*COUNT, 65)},
                               inputs=1),
    "Compartments": plain(dgp.Compartments, {"inputs": NUMBER, "count": COUNT,
                          "process_noise": SWITCH, "substeps": (*COUNT, 65), **OPTIONS}, inputs=1),
    "ParallelWienerHammerstein": plain(dgp.ParallelWienerHammerstein,
                                       {**CURVED, "branches": (*COUNT, None)}, inputs=1, pairs=1),
    "Cascade": plain(dgp.Cascade, {"inputs": NUMBER, "layers": ((), ["g"], [3], "g", None),
                     **OPTIONS}, inputs=1, layers=[dgp.Dynamic(pairs=1)]),
    "Model": plain(dgp.Model, {"inputs": NUMBER, "layers": ((), ("g",), (3,), "g", None), **OPTIONS,
                   "channels": (("a",), 3), "scaling": ("a", 3)}, inputs=1,
                   layers=(dgp.Dynamic(pairs=1),)),
    "Delayed": plain(dgp.Delayed, {"channel": (3, None),
                     "delay": ("a", np.nan, np.inf, True, [1.0]), "median": (*POSITIVE, [1.0])},
                     channel="u"),
    "Dynamic": plain(of_model(dgp.Dynamic, pairs=1), {
        "outputs": COUNT, "pairs": COUNT, "noise": NAME, "brownian": COUNT, "feedthrough": SWITCH,
        "process_noise": SWITCH, "integrators": BOTH, "skip": (("g",), "inputs", 3),
        "sees": (("g",), "inputs", 3), "feedback": (("f",), "f", 3), "hidden": (*NUMBER, 1),
        "substeps": (*COUNT, 2, None), "real": (*SWITCH, True),
        "name": ("y", "inputs", 3, "a b")}),
    "Static": plain(of_model(dgp.Static), {
        "outputs": COUNT, "inducing": COUNT, "kernel": KERNEL, "mean": NAME,
        "limits": ((1.0, 0.0), (None, None), (0.0,), 3, "ab", (np.nan, 1.0)),
        "skip": (("x",), 3), "sees": (("x",), 3), "learn_locations": SWITCH,
        "support": COUNT, "name": ("y", 3), "smoothness": (1, 2.0, None, "rbf", np.nan, [1.5]),
        "least_lengthscale": (-0.1, np.nan, np.inf, "2", [1.0])}),
    "Known": plain(of_model(dgp.Known, function=torch.sqrt), {
        "function": (3, None, "text"), "parameters": (3, {"a": 3}, {3: None}), "outputs": COUNT,
        "range": ((1.0, 0.0), 3, "text", (0.0, np.nan)), "scaled": SWITCH, "skip": (("x",), 3),
        "sees": (("x",), 3), "name": ("y", 3)}),
    "Product": plain(of_product(), {"first": COUNT, "others": COUNT, "skip": (("x",), 3),
                                  "sees": (("x",), 3), "name": ("y", 3)}),
    "Form": plain(of_model(dgp.Form, form="root"), {
        "form": NAME, "skip": (("x",), 3), "sees": (("x",), 3), "name": ("y", 3)}),
    "Gaussian": plain(dgp.Gaussian, {}),
    "StudentT": plain(dgp.StudentT, {"degrees_of_freedom": (0, -1.0, np.nan, np.inf, "a", None)}),
    "Heteroscedastic": plain(dgp.Heteroscedastic, {"inducing": COUNT, "of": NAME}),
    "TimeScale": plain(dgp.TimeScale, {"step": (*POSITIVE, None), "duration": (*POSITIVE, None)},
                       step=1.0, duration=100.0),
    "Mode": plain(dgp.Mode, {"optimizer": NAME}),
    "Importance": plain(dgp.Importance, {"draws": (*COUNT, None), "longest": COUNT,
                                         "optimizer": NAME}),
    "Normal": plain(dgp.Normal, {"family": (*NAME, None), **VARIATIONAL, "optimizer": NAME}),
    "Nuts": plain(dgp.Nuts, {"chains": COUNT, "warmup": COUNT, "draws": (*COUNT, 3),
                             "optimizer": NAME}),
    "Trajectories": plain(dgp.Trajectories, {"guide": (torch.nn.Linear(1, 1),), **VARIATIONAL}),
    "LoopSettings": plain(dgp.LoopSettings, {
        f.name: (0, -1, np.nan, "a", None, *((1.5, True) if isinstance(f.default, int) else ()))
        for f in dataclasses.fields(dgp.LoopSettings)}),
    "Record": plain(dgp.Record, {
        "time": (None, "text", [0.0, 0.0, 1.0], [2.0, 1.0, 0.0], [0.0, np.nan, 1.0], [],
                 [[0.0, 1.0, 2.0]], [0j, 1j, 2j], 3.0),
        "inputs": (*ARRAY, [1.0, 2.0], [1.0, np.nan, 2.0], [1.0, np.inf, 2.0], [1j, 2, 3], 1.0),
        "outputs": (*ARRAY, [1.0, 2.0], [1.0, np.inf, 2.0], [1j, 2, 3], 1.0),
        "input_names": (["a", "b"], [""], [3], 3), "output_names": (["a", "b"], [""], [3], 3),
        "input_units": (["a", "b"], [3], 3), "output_units": (["a", "b"], [3], 3),
        "time_unit": (3, None, ["s"]), "start": ("nonsense", "2020-01-01", [1]),
        "extra": ({"a": [1.0]}, {3: [1.0, 2.0, 3.0]}, {"a": "text"}, {"y": [1.0, 2.0, 3.0]}, 3),
        "extra_units": ({"a": "m"}, 3)}, free=("name",),
        time=[0.0, 1.0, 2.0], inputs=[1.0, 2.0, 4.0], outputs=[0.0, 1.0, 2.0]),
    "Record.from_csv": Entry(lambda w: dgp.Record.from_csv,
        lambda w: {"path": w.text, "inputs": "u", "outputs": "y", "time": "t"},
        {"path": ("/absent", "/proc", 3, None), **READ, "header": (3, "a"), "names": (["a"], 3),
         "delimiter": ("ab", "", 3), "decimal": ("'", 3, "ab"), "encoding": ("nonsense", 3),
         "skip_rows": (-1, 1.5, True, "a", None, 50), "units_row": (3, "a"),
         "missing": (True, object(), [None], [[1]]), "thousands": ("x", 3, "", "ab"),
         "time_format": (3, "%Q", "%d.%m.%Y")}),
    "Record.from_frame": Entry(lambda w: dgp.Record.from_frame,
        lambda w: {"frame": w.frame, "inputs": "u", "outputs": "y", "time": "t"},
        {"frame": FRAMES, **READ}),
    "Record.from_xarray": Entry(lambda w: dgp.Record.from_xarray,
        lambda w: {"dataset": w.frame.set_index("t").rename_axis("time").to_xarray(), "inputs": "u",
                   "outputs": "y"}, {"dataset": FRAMES, **READ}),
    "Record.from_mat": Entry(lambda w: dgp.Record.from_mat,
        lambda w: {"path": w.matlab, "inputs": "u", "outputs": "y", "time": "t"},
        {"path": ("/absent", "/proc", __file__, 3, None), **READ}),
    "Record.from_benchmark": Entry(lambda w: dgp.Record.from_benchmark,
        lambda w: {"data": types.SimpleNamespace(u=[1.0, 2.0], y=[1.0, 2.0]), "sampling_time": 1},
        {"data": (None, 3, "text"), "sampling_time": (0, -1.0, np.nan, "a", True, [1.0])}),
    "Record.with_holidays": Entry(lambda w: w.stamped.with_holidays, lambda w: {"country": "AT"},
        {"country": (3, None), "subdivision": (3,)}, free=("name",), late=True),
    "Record.select": Entry(lambda w: w.record.select, lambda w: {},
        {"inputs": (3, 1.5, True, b"valve", {"valve": 1}, ["absent"], [3], object()),
         "outputs": (3, 1.5, True, b"y", {"y": 1}, ["absent"], [3], object())}),
    "Record.with_extra_as_input": Entry(
        lambda w: dataclasses.replace(w.record, extra={"rain": np.ones(60)}).with_extra_as_input,
        lambda w: {"name": "rain"}, {"name": ("absent", "y", 3, None, ["rain"], b"rain")}),
    "Record.split": Entry(lambda w: w.record.split, lambda w: {"at": 30},
        {"at": (0, -1, 60, 0.5, None, True, "2020-01-01", [3])}),
    "Record.with_outputs": Entry(lambda w: w.record.with_outputs,
        lambda w: {"outputs": w.record.outputs},
        {"outputs": (*ARRAY, [1.0], None), "names": (3, True, b"y", {"y": 1}, ["a", "b"], [3]),
         "units": (3, True, b"m", {"m": 1}, ["a", "b"], [3])}),
    "Scaling": Entry(lambda w: dgp.Scaling.from_records, lambda w: {"records": w.record},
                     {"records": RECORD}),
    "Scaling.apply": Entry(lambda w: dgp.Scaling.from_records(w.record).apply,
                           lambda w: {"record": w.record}, {"record": RECORD}),
    "Scaling.invert": Entry(lambda w: dgp.Scaling.from_records(w.record).invert,
                            lambda w: {"outputs": [[0.5]]}, {"outputs": ("text", None, [["a"]])}),
    "Prediction": Entry(lambda w: w.prediction.quantile, lambda w: {"q": 0.5},
                        {"q": (0.0, 1.0, -1.0, np.nan, "a", None, [0.5, 2.0])}),
    "Prediction.log_density": Entry(lambda w: w.prediction.log_density,
        lambda w: {"outputs": w.record.outputs}, {"outputs": (*ARRAY, [1.0], None)}),
    "Prediction.normal_scores": Entry(lambda w: w.prediction.normal_scores,
        lambda w: {"outputs": w.record.outputs}, {"outputs": (*ARRAY, [1.0], None)}),
    "Prediction.probability_integral": Entry(lambda w: w.prediction.probability_integral,
        lambda w: {"outputs": w.record.outputs}, {"outputs": (*ARRAY, [1.0], None)}),
    "scores": Entry(lambda w: dgp.scores,
        lambda w: {"prediction": w.prediction, "record": w.record},
        {"prediction": (None, 3, "text"), "record": unlike,
         "skip": (-1, 60, 1.5, "a", None, True)}),
    "calibration": Entry(lambda w: dgp.calibration,
        lambda w: {"prediction": w.prediction, "record": w.record},
        {"prediction": (None, 3, "text"), "record": unlike, "seed": SEED, "level": SHARE,
         "skip": (-1, 60, 1.5, "a", None, True)}),
    "predictive_checks": Entry(lambda w: dgp.predictive_checks,
        lambda w: {"prediction": w.prediction, "record": w.record},
        {"prediction": (None, 3, "text"), "record": unlike,
         "skip": (-1, 60, 1.5, "a", None, True), "statistics": (3, {}, {"a": 3}, "mean")}),
    "fit": Entry(lambda w: dgp.fit, lambda w: {"model": w.linear, "record": w.record, **QUICK},
        {"model": (None, 3, "text", dgp.Wiener), "record": lambda w: [*RECORD, w.blank,
         w.record[:2], *w.others[:1], w.others[-1]], "method": (*NAME, dgp.Mode), "start": (3, "a"),
         **RUN, "restarts": COUNT, "steps": COUNT, "checkpoint": (3, "/proc/absent/folder"),
         "draws": COUNT, "particles": COUNT, "learning_rate": POSITIVE, "warmup": COUNT,
         "chains": COUNT, "optimizer": NAME, "hyperparameters": NAME, "nonsense": (1,)},
        free=("options",)),
    "load": plain(dgp.load, {"path": ("/absent", "/proc", __file__, 3, None)}, late=True),
    "Fit": Entry(lambda w: w.fit.log_joint, lambda w: {"records": w.record}, {"records": measured}),
    "Fit.log_likelihood": Entry(lambda w: w.fit.log_likelihood, lambda w: {"records": w.record},
                                {"records": measured}),
    "Fit.simulate": Entry(lambda w: w.fit.simulate, lambda w: {"record": w.record},
        {"record": lambda w: foreign(w), "process_noise": SWITCH, **SAMPLES}),
    "Fit.predict": Entry(lambda w: w.fit.predict, lambda w: {"record": w.record},
        {"record": measured, "horizon": (*COUNT, None), **SAMPLES}),
    "Fit.forecast": Entry(lambda w: w.fit.forecast, lambda w: {"past": w.past, "future": w.future},
        {"past": lambda w: [*measured(w), w.future], "future": lambda w: [*foreign(w), w.past],
         "process_noise": SWITCH, **SAMPLES}),
    "Fit.innovations": Entry(lambda w: w.fit.innovations, lambda w: {"record": w.record},
                             {"record": measured}),
    "Fit.layers": Entry(lambda w: w.fit.layers, lambda w: {"record": w.record},
                        {"record": foreign}),
    "Fit.static_function": Entry(lambda w: w.bent.static_function,
        lambda w: {"name": "f", "record": w.record},
        {"name": (3, "g", "nonsense", None), "record": foreign, "points": (*COUNT, None),
         "channel": (*NUMBER, 1, None)}),
    "Fit.save": Entry(lambda w: w.fit.save,
        lambda w: {"path": tempfile.mkdtemp() + "/fit.safetensors"},
        {"path": ("/absent/fit", "/proc/fit", "/proc", 3, None)}),
    "Fit.to_arviz": Entry(lambda w: w.fit.to_arviz, lambda w: {},
        {"future": lambda w: [3, "a", w.past, *w.others], **SAMPLES, "prior_samples": NUMBER}),
    "Fit.summary": Entry(lambda w: w.fit.summary, lambda w: {"record": w.record},
                         {"record": lambda w: [x for x in measured(w) if x is not None]}),
    "Fit.thinned": Entry(lambda w: w.fit.thinned, lambda w: {"number": 1}, {"number": COUNT}),
    "Fit.to_control": Entry(lambda w: w.fit.to_control, lambda w: {},
        {"kind": (*NAME, None), "step": POSITIVE, "draws": COUNT,
         "layer": (3, "nonsense", "f")}, late=True),
    "Prediction.to_xarray": Entry(lambda w: w.prediction.to_xarray, lambda w: {},
                                  {"samples": SWITCH}),
    "loo": Entry(lambda w: dgp.loo, lambda w: {"fit": w.fit, "target": "forecast",
                 "progress": False, "refits": 0, "parameters": "mode"},
        {"fit": (None, 3, "text"), "record": lambda w: [3, "text", [], w.record[:50], *w.others],
         "target": (*NAME, None), "horizon": (*COUNT, None),
         "begin": (0, -1, 1.5, "a", None, np.nan, True),
         "draws": (*COUNT, None), "parameters": (*NAME, None), "refits": (*NUMBER, None), **RUN},
        free=("folds",)),
    "loo of folds": Entry(lambda w: dgp.loo, lambda w: {"fit": w.fit, "target": "new record",
                          "progress": False, "workers": 1, "folds": 2},
        {"folds": (0, 1, -1, 2.5, "a", None, 60, True)}, free=("fit", "record", "target", "horizon",
        "begin", "draws", "parameters", "refits", "seed", "workers", "progress"), late=True),
    "compare": Entry(lambda w: dgp.compare, lambda w: {"models": {"a": w.fit, "b": w.fit},
        "target": "forecast", "parameters": "mode", "refits": 0, "progress": False},
        {"models": lambda w: [None, 3, {}, {"a": w.fit}, [w.fit, w.fit]],
         "target": (*NAME, None), "method": (*NAME, None)}, free=("options",)),
    "stack": Entry(lambda w: dgp.stack, lambda w: {"fits": {"a": w.fit, "b": w.fit},
        "weights": {"a": 0.5, "b": 0.5}},
        {"fits": (None, 3, {}, [1], {"a": 3, "b": 4}),
         "weights": ({"a": 1.0}, {"a": -1.0, "b": 2.0}, {"a": 0.0, "b": 0.0}, 3, "a",
                     {"a": np.nan, "b": 1.0}, {"a": "x", "b": "y"})},
        free=("target", "options")),
    "check": Entry(lambda w: dgp.check, lambda w: {"fit": w.fit, "progress": False},
        {"fit": (None, 3, "text"), "twin": (1, -1, "a", 10**6, True), "forecasts": ("no", 2, None),
         "draws": (*COUNT, None),
         **RUN}),
    "simulation_based_calibration": Entry(lambda w: dgp.simulation_based_calibration,
        lambda w: {"model": w.linear.scaled_to(w.record), "record": w.record, "replicates": 2,
                   "draws": 9, "workers": 1, "progress": False, "method": "map", "restarts": 1},
        {"model": lambda w: [None, 3, w.linear], "record": lambda w: [*RECORD, *w.others[1:4]],
         "method": (*NAME, None), "replicates": (*COUNT, 1, None), "draws": (*COUNT, 8, None),
         "level": (*SHARE, 0.4), **RUN}, free=("fit_options",), late=True),
    "from_pyro": Entry(lambda w: functools.partial(dgp.from_pyro, observed={}),
        lambda w: {"model": lambda: None, "posterior": {}, "draws": 4},
        {"model": (None, 3, "text"), "posterior": (None, 3, "text", {}), "draws": (*COUNT, None),
         "seed": SEED, "observed": (3, "a"), "coords": (3,), "dims": (3,), "units": (3,)},
        free=("args",), late=True),
    "close_loop": Entry(lambda w: dgp.close_loop, lambda w: {"fit": w.fit, "record": w.record},
        {"fit": (None, 3, "text"), "record": lambda w: [*RECORD, *w.others, w.blank],
         "candidates": (3, "a"), "seed": SEED, "max_rounds": (*COUNT, None),
         "level": SHARE, "tries": (*COUNT, None), "effects": (3, ["a"], "a"), "settings": (3, {}),
         "workers": COUNT, "progress": SWITCH, "time_limit": POSITIVE}, late=True),
    "Modes": plain(dgp.Modes, {
        "poles": ([], ["a"], [1.0], [np.nan], None, "text", 3.0),
        "input_gain": ([[1.0, 2.0], [1.0, 2.0]], "text", [np.nan], [["a"]]),
        "output_gain": ([1.0, 2.0], "text", [np.nan], None), "noise_gain": ([[1.0], [2.0]], "text"),
        "feedthrough": ([1j], "text", [1.0, 2.0], [np.nan]),
        "drift": ("text", [1.0, 2.0], [np.nan]), "noise": (*NAME, None)},
        poles=[-1.0 + 1j], input_gain=[[1.0]], output_gain=[1.0]),
    "sample_modes": plain(dgp.sample_modes, {
        "name": (3, None), "inputs": (*NUMBER, None), "pairs": (*COUNT, None), "outputs": COUNT,
        "brownian": (*COUNT, None), "noise": (*NAME, None), "feedthrough": SWITCH,
        "process_noise": SWITCH, "time_scale": (3, "a"), "gain_scale": (*POSITIVE, None),
        "priors": (*NAME, None)}, name="g", inputs=1, pairs=1),
    "sample_static": plain(dgp.sample_static, {
        "name": (3, None), "channels": (*COUNT, None), "outputs": (*COUNT, None),
        "inducing": (*COUNT, None), "kernel": KERNEL, "mean": (*NAME, None),
        "learn_locations": SWITCH, "locations": ("text", [np.nan] * 32)},
        name="f", channels=1, outputs=1),
    "static_gp": plain(dgp.static_gp, {
        "name": (3, None), "x": ("text", [np.nan, 1.0], None, {}), "outputs": COUNT,
        "channels": COUNT, "inducing": (*COUNT, None), "kernel": KERNEL, "mean": (*NAME, None),
        "pathwise": SWITCH, "support": (0, -1, 1.5, "a", None, True), "learn_locations": SWITCH,
        "locations": ("text", [np.nan] * 32)}, name="f", x=[0.0, 1.0, 2.0], pathwise=True),
    "LTIProcess": Entry(lambda w: dgp.LTIProcess,
        lambda w: {"modes": w.modes, "time": w.record.time, "inputs": w.record.inputs},
        {"modes": (None, 3, "a"), "time": (None, "text", [1.0, 0.0], [np.nan, 1.0], []),
         "inputs": (None, "text", np.zeros((60, 2)), np.zeros((59, 1)), np.full((60, 1), np.nan)),
         "initial_state": ("a", [1.0, 2.0]), "jitter": (-1.0, np.nan, "a", None), "offset": ("a",)},
        free=("validate_args",)),
    "InnovationReparam": plain(dgp.InnovationReparam, {}),
    "LayerGuide": plain(dgp.LayerGuide, {"model": (None, 3), "families": (3, {"a": 3}),
        "joint_scale": (*POSITIVE, None)},
        free=("default", "values", "joint", "observed"), late=True, model=lambda: None),
    "FullRank": plain(dgp.FullRank, {"init_scale": (*POSITIVE, None)}, free=("init", "at")),
    "GaussMarkov": plain(dgp.GaussMarkov, {}, free=("init_mean", "init_sd", "at")),
    "InducingTimes": plain(dgp.InducingTimes, {"count": (*COUNT, None), "seed": SEED,
        "init_scale": (*POSITIVE, None)}, free=("init", "at"), count=3),
    "LTIKernel": Entry(lambda w: dgp.LTIKernel, lambda w: {"system": w.modes},
                       {"system": (None, 3, "a")}, free=("kwargs",)),
    "LTIMean": Entry(lambda w: dgp.LTIMean,
        lambda w: {"system": w.modes, "time": w.record.time, "inputs": w.record.inputs},
        {"system": (None, 3, "a"), "time": (None, "text", [1.0, 0.0]), "inputs": ("text",)}),
    "LTIParameters": Entry(lambda w: dgp.LTIParameters, lambda w: {"modes": w.modes},
                           {"modes": (None, 3, "a")}),
    "plotting.bode": Entry(lambda w: plotting.bode, lambda w: {"fit": w.fit},
        {"fit": (None, 3), "omega": (*AXIS, [0.0, 1.0]), "layer": LAYERS}),
    "plotting.impulse_response": Entry(lambda w: plotting.impulse_response,
        lambda w: {"fit": w.fit}, {"fit": (None, 3), "time": AXIS, "layer": LAYERS}),
    "plotting.pole_map": Entry(lambda w: plotting.pole_map, lambda w: {"fit": w.fit},
        {"fit": (None, 3), "layer": LAYERS}),
    "plotting.static_function": Entry(lambda w: plotting.static_function,
        lambda w: {"fit": w.bent, "record": w.record},
        {"fit": (None, 3), "record": foreign, "layer": LAYERS, "channel": (*NUMBER, 1, None)}),
    "plotting.compare": Entry(lambda w: plotting.compare,
        lambda w: {"predictions": {"a": w.prediction}, "record": w.record},
        {"predictions": (None, 3, {}, {"a": 3}), "record": unlike,
         "skip": (-1, 60, 1.5, "a", None, True)}),
    "plotting.quantiles": Entry(lambda w: plotting.quantiles,
        lambda w: {"fit": w.fit, "record": w.record},
        {"fit": (None, 3), "record": lambda w: [*measured(w), w.record[:9]]}),
    "datasets": plain(datasets.load, {"name": (*NAME, None), "nonsense": (1,)}, free=("options",),
                      name="gas_furnace"),
}  # fmt: skip
# Names without a call of their own: classes that others make, errors, and modules of the above.
WITHOUT = {"TrainingDivergedError", "effects", "guides", "plotting"}
MODULES = (effects, guides, plotting)


@dataclass(frozen=True)
class Case:
    """One bad call."""

    name: str
    argument: str
    value: Any = field(repr=False)


def cases(world: World) -> list[Case]:
    """Every bad call of the table."""
    found = []
    for name, entry in TABLE.items():
        for argument, values in entry.bad.items():
            given = values(world) if callable(values) else values
            found += [Case(name, argument, value) for value in given]
    return found
