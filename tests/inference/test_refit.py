"""Fits made again on other data: same scaling and family, near the old optimum, refusals."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Delayed, Recorded
from pyro_dynogp.inference import refit as refits
from pyro_dynogp.inference.function_evidence import kernel_sites
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.inference.refit import optima_of, refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.feedback_variants import with_feedback
from pyro_dynogp.models.variants import with_channel
from tests.inference.cascades import FAST, wiener
from tests.models.closed_loops import make_record


def test_on_the_same_data_a_mode_stays(map_fit):
    again = refit(map_fit, map_fit.records)
    for name, value in map_fit.mode.items():
        torch.testing.assert_close(again.mode[name], value, atol=0.05, rtol=0.05)
    assert again.log_joint(map_fit.records[0]) == pytest.approx(
        map_fit.log_joint(map_fit.records[0]), abs=0.1
    )


def test_on_other_data_the_scaling_stays_and_the_mode_moves(map_fit, record):
    rest = record[:80]
    again = refit(map_fit, rest)
    assert again.scaling == map_fit.scaling
    assert again.records == (rest,)
    assert not torch.equal(again.mode["g_log_decay"], map_fit.mode["g_log_decay"])
    assert again.log_joint(rest) > map_fit.log_joint(rest)


def test_svi_keeps_its_family(svi_fit, record):
    again = refit(svi_fit, record[: len(svi_fit.records[0]) - 20])
    assert again.method == "svi"
    assert type(again.posterior) is type(svi_fit.posterior)
    assert again.draws["noise_sd"].shape == svi_fit.draws["noise_sd"].shape


def test_a_cascade_keeps_its_optima(bent):
    fit = dgp.fit(wiener(), bent, **{**FAST, "restarts": 3, "steps": 20, "draws": 20})
    assert isinstance(fit.posterior, Mixture)
    optima = optima_of(fit)
    assert len(optima) == len(fit.posterior.weights)
    torch.testing.assert_close(optima[0]["g_log_decay"], fit.mode["g_log_decay"])
    y = bent.outputs.copy()
    y[30:40] = np.nan
    again = refit(fit, bent.with_outputs(y))
    assert isinstance(again.posterior, Mixture)
    assert len(again.draws["f_values"]) == 20


@pytest.mark.parametrize("method", ["map", "svi"])
def test_kernels_are_held_while_gauss_newton_climbs_and_not_by_adam(bent, monkeypatch, method):
    fit = dgp.fit(wiener(), bent, **{**FAST, "method": "svi"})
    fit = fit if method == "svi" else fit.at_mode()
    climbs = []
    maximise = refits.maximise

    def spied(*args, **options):
        climbs.append((options["optimizer"], bool(options["held"])))
        return maximise(*args, **options)

    monkeypatch.setattr(refits, "maximise", spied)
    refit(fit, bent, run=Run(0, workers=1, steps=3))
    assert climbs == [("gauss-newton", True) if method == "map" else ("adam", False)]


def test_kernels_of_the_evidence_are_held_whatever_climbs():
    for make in (dgp.NonlinearFeedback, dgp.Hammerstein):
        for options in ({}, {"likelihood": dgp.StudentT()}):
            model = make(1, **options)
            held = refits._held(model, refits.optimizer_near(model))
            assert held == refits.kernel_sites(model) != ()
    noisy = dgp.Wiener(1)
    assert refits._held(noisy, refits.optimizer_near(noisy)) == refits.kernel_sites(noisy)
    assert refits._held(noisy, "adam") == ()
    assert refits._held(dgp.LinearDynamicGP(1), "gauss-newton") == ()


def test_what_is_refused(map_fit, layered_fit, record):
    with pytest.raises(ValueError, match="fit: expected a fit whose trajectories are integrated"):
        refit(layered_fit, layered_fit.records)
    with pytest.raises(ValueError, match="records: expected 1, as before"):
        refit(replace(map_fit), (record, record))


def test_the_mode_of_a_fit(map_fit, svi_fit, layered_fit):
    assert map_fit.at_mode() is map_fit
    mode = svi_fit.at_mode()
    assert (mode.method, mode.records) == ("map", svi_fit.records)
    for name, value in svi_fit.mode.items():
        torch.testing.assert_close(mode.draws[name], value.unsqueeze(0))
    # The middle of a posterior with trajectories as sites is another number than a mode.
    with pytest.raises(ValueError, match="fit: expected a fit whose trajectories are integrated"):
        layered_fit.at_mode()


ROBUST = dgp.Wiener(1, likelihood=dgp.StudentT())
LIMITED = dgp.Cascade(1, (dgp.Dynamic(), dgp.Static(mean="linear", limits=(0.0, None))))
NEWTON, OTHER = [14, 14, 14, 14, 20, 20, 20], [8, 8, 8, 8, 32, 32, 32]


@pytest.mark.parametrize(
    ("base", "model", "steps"),
    [
        (dgp.LinearDynamicGP(1), dgp.LinearDynamicGP(1), NEWTON),
        (dgp.Wiener(1), dgp.Wiener(1), NEWTON),
        (dgp.LinearDynamicGP(1), dgp.Wiener(1), [8, 8, 8, 8, 20, 20, 20]),  # Adam first
        (dgp.LinearDynamicGP(1), dgp.NonlinearFeedback(1), NEWTON),
        (ROBUST, ROBUST, NEWTON),
        (LIMITED, LIMITED, OTHER),
    ],
)
def test_races_count_the_steps_of_the_optimizer_that_runs(monkeypatch, base, model, steps):
    given = []

    def again(fit, records, *, run, model=None):
        given.append(run.steps)
        return SimpleNamespace(model=model or fit.model, records=records, start_energies=[0.0])

    monkeypatch.setattr(refits, "refit", again)
    refits.race(SimpleNamespace(model=base), [model] * 4, None, Run(0))
    assert given == steps


@pytest.mark.parametrize("long", [60, 200])
def test_what_is_new_in_feedback_is_looked_for_along_an_excerpt_of_long_records(monkeypatch, long):
    """Then the best optimum goes on along the whole; short records are climbed as they are."""
    monkeypatch.setattr(refits, "LONG", long)
    monkeypatch.setattr(refits, "EXCERPT", 40)
    record, model = make_record(n=80, missing=False), dgp.LinearDynamicGP(1, pairs=1)
    fit = dgp.fit(model, record, method="map", restarts=1, workers=1, progress=False)
    climbs = []
    for name in ("climb", "maximise"):
        climbed = getattr(refits, name)

        def watched(model, records, starts, *rest, climbed=climbed, **options):
            climbs.append((len(records[0]), len(starts)))
            return climbed(model, records, starts, *rest, **options | {"steps": 2})

        monkeypatch.setattr(refits, name, watched)
    monkeypatch.setattr(refits, "kernels_by_evidence", lambda model, records, optima, run: optima)
    again = refit(fit, record, model=with_feedback(model, output=False, hidden=True))
    several = climbs[0][1]
    assert several > 1
    assert climbs == ([(40, several), (80, 1)] if long == 60 else [(80, several)])
    assert len(again.records[0]) == 80
    climbs.clear()
    refit(again, record, model=again.model)  # nothing is new
    assert climbs == [(80, 1)]


@pytest.mark.parametrize("more", [False, True])
def test_with_feedback_what_is_learnt_keeps_its_units_next_to_other_data(monkeypatch, more):
    """In units of other data a cubic spring is another one, and climbs begin far from the fit."""
    record = make_record(n=80, missing=False)
    louder = record.outputs * np.where(np.arange(80) < 50, 1.0, 1.6)[:, None] + 0.3
    record = replace(record.with_outputs(louder), extra={"w": np.sin(np.arange(80.0))})
    part, model = record[:50], with_feedback(dgp.LinearDynamicGP(1, pairs=1))
    base = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), part, method="map", restarts=1, workers=1,
                   progress=False)  # fmt: skip
    fit = refit(base, part, model=model, run=Run(0, workers=1, steps=2))
    larger = with_channel(replace(fit.model, scaling=None), Recorded("w")) if more else fit.model
    begun = []

    def watched(target, records, starts, *rest, **_):
        begun.append(starts[0])
        return [Optimum(0.0, start, np.zeros(1), "") for start in starts]

    monkeypatch.setattr(refits, "maximise", watched)
    again = refit(fit, record, model=larger, run=Run(0, workers=1, steps=1))
    system, learnt = (one.model.system(at, one.scaling) for one, at in
                      ((again, begun[0]), (fit, fit.mode)))  # fmt: skip
    torch.testing.assert_close(*(one.dynamic[0][1].modes.poles for one in (system, learnt)))
    found = again.scaling
    assert found.output_scale == fit.scaling.output_scale
    assert found.output_offset == fit.scaling.output_offset
    assert found.duration == fit.scaling.duration
    assert found.input_scale[0] == fit.scaling.input_scale[0]
    assert len(found.input_scale) == 1 + more
    linear = refit(base, record, model=replace(base.model, scaling=None))
    assert linear.scaling.output_scale != base.scaling.output_scale


@pytest.mark.parametrize(
    ("make", "options", "fresh"),
    [
        (dgp.LinearDynamicGP, {"output": False, "hidden": True, "step": False}, [refits.FRESH]),
        (dgp.LinearDynamicGP, {"output": False, "hidden": True}, []),
        (dgp.LinearDynamicGP, {}, []),
        (dgp.Wiener, {"output": False, "hidden": True, "step": False}, [refits.FRESH]),
        (dgp.Wiener, {}, [refits.FRESH_BACK]),
    ],
)
def test_functions_that_have_no_place_or_others_beside_start_afresh_as_well(
    monkeypatch, make, options, fresh
):
    """A spring between two masses was 70 nats lower where only what the line knew was a start.

    A function of the output of a motor with a sensor that is not linear was 120.
    """
    record, model = make_record(n=60, missing=False), make(1, pairs=1)
    fit = dgp.fit(model, record, method="map", restarts=1, workers=1, progress=False)
    asked, climb = [], refits.climb

    def starts(model, records, run, *, count, steps):
        asked.append(count)
        return []

    def shortly(*given, **named):
        return climb(*given, **named | {"steps": 2})

    monkeypatch.setattr(refits, "starting_points", starts)
    monkeypatch.setattr(refits, "climb", shortly)
    monkeypatch.setattr(refits, "kernels_by_evidence", lambda model, records, optima, run: optima)
    refit(fit, record, model=with_feedback(model, **options))
    assert asked == fresh


def late_and_bent(seed: int) -> dgp.Record:
    """A bent input, seven samples late, through a well damped second order."""
    rng = np.random.default_rng(seed)
    n, step, late = 900, 0.1, 7
    u = np.repeat(1.5 * rng.standard_normal(n // 6), 6)
    force = np.tanh(np.concatenate([np.zeros(late), u[:-late]]))
    x = v = 0.0
    y = np.zeros(n)
    for k, f in enumerate(force):
        y[k] = x
        for _ in range(10):
            v += 0.1 * step * (4.0 * f - 1.2 * v - 4.0 * x)
            x += 0.1 * step * v
    y += 0.03 * y.std() * rng.standard_normal(n)
    return dgp.Record(step * np.arange(n), u[:, None], y[:, None], input_names=("u",))


def test_kernels_are_learnt_again_next_to_what_was_lacking():
    """A function that was learnt without the dead time is rough; the right one is not."""
    record = late_and_bent(1)
    fit = dgp.fit(dgp.Hammerstein(1, pairs=1), record[:600], method="map", workers=1,
                  progress=False)  # fmt: skip
    model = replace(fit.model, scaling=None)
    late = refit(fit, record[:600], model=with_channel(model, Delayed("u", 0.7)))
    error = late.forecast(record[:600], record[600:]).mean - record.outputs[600:]
    noise = 0.03 * record.outputs.std()
    assert np.sqrt(np.mean(error**2)) < 1.5 * noise  # with the old kernels 3.7 times
    # The same model on other data keeps them.
    again = refit(late, record[:590])
    for name in kernel_sites(late.model):
        assert torch.equal(again.mode[name], late.mode[name])
