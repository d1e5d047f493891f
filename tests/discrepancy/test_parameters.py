"""Posterior of what blocks have learnt."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import (
    DeadZone,
    Delayed,
    Play,
    Recorded,
    ShiftedClock,
    Sinusoid,
    Step,
    StepOfGain,
    Trend,
)
from pyro_dynogp.data.signals import dead_zone, delayed, play
from pyro_dynogp.discrepancy.parameters import _together, parameters_of
from pyro_dynogp.effects import OutputNonlinearity, Saturation
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.laplace import log_evidence
from pyro_dynogp.inference.optimise.maximum import maximise
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.delays import where_inputs_are_known
from pyro_dynogp.models.variants import with_channel
from pyro_dynogp.statistics.evidence import Evidence

N, STEP = 160, 0.5
TIME = STEP * np.arange(N)
PLAIN = dgp.LinearDynamicGP(inputs=1, pairs=1, process_noise=False)
# Two poles of natural frequency 1 rad/s and damping ratio 0.5; gain one.
NUMERATOR, DENOMINATOR, _ = cont2discrete(([1.0], [1.0, 1.0, 1.0]), STEP)


def signal(seed, n=N):
    return lfilter([0.6], [1, -0.8], np.random.default_rng(seed).standard_normal(n))


def record_of(seed, acting, **extra):
    """What acts goes through two poles; its steady-state gain is one. Noise of 5 %."""
    rng = np.random.default_rng(seed + 100)
    y = lfilter(NUMERATOR[0], DENOMINATOR, acting) + 0.05 * rng.standard_normal(N)
    options = {"input_names": ("valve",), "input_units": ("V",), "output_units": ("rpm",)}
    return dgp.Record(TIME, signal(seed), y, extra=extra, **options)


def fitted(model, record):
    return dgp.fit(model, record, restarts=2, workers=1, progress=False, method="map")


def late(u, delay):
    """What arrives `delay` late, held, goes through the two poles: y at the samples.

    By small steps, fifty to a sample; delays are whole numbers of them.
    """
    fine, many = STEP / 50, round(delay / STEP * 50)
    held = np.repeat(u, 50)
    arriving = np.concatenate([np.full(many, held[0]), held])[: len(held)]
    numerator, denominator, _ = cont2discrete(([1.0], [1.0, 1.0, 1.0]), fine)
    return lfilter(numerator[0], denominator, arriving)[::50]


def late_record(seed, delay, noise=0.05):
    record, rng = record_of(seed, 0.0 * TIME), np.random.default_rng(seed + 100)
    y = late(record.inputs[:, 0], delay) + noise * rng.standard_normal(N)
    return record.with_outputs(y)


def test_a_dead_time_has_the_posterior_that_fits_at_every_number_of_samples_give():
    record = late_record(0, 1.3)
    channel = Delayed("valve", 1.5)
    fit = fitted(with_channel(PLAIN, channel), record)
    ((label, (mean, sd)),) = parameters_of(fit, [channel], record).items()
    assert label == "dead time of valve [s]"
    delays, heights = STEP * np.arange(1, 7), []
    for delay in delays:
        model = replace(fit.model, channels=(replace(channel, delay=float(delay)),))
        (best,) = maximise(model, record, [dict(fit.mode)], Run(workers=1), steps=200)
        potential = Potential(model, (record,), best.values)
        heights.append(log_evidence(potential, best.values))
    share = np.exp(np.array(heights) - max(heights))
    share /= share.sum()
    # A number of samples stands for all delays in the step before it.
    middle = delays - 0.5 * STEP
    expected = share @ middle
    spread = np.sqrt(share @ (middle - expected) ** 2 + STEP**2 / 12.0)
    # Beside one curvature for all delays: the evidence has one of its own at each.
    assert mean == pytest.approx(expected, abs=0.2 * sd)
    assert sd == pytest.approx(spread, rel=0.15)


@pytest.mark.parametrize("fraction", [0.02, 0.4, 0.8, 1.0])
def test_a_delay_within_a_step_fits_as_well_as_one_of_a_whole_step(fraction):
    """The theory behind what a dead time is told to: the next step's numerator makes up for it."""
    record = late_record(7, (2.0 + fraction) * STEP, noise=0.003)
    record = where_inputs_are_known(record, 4 * STEP)  # the same samples count
    energies = {}
    for samples in (2, 3, 4):
        fit = fitted(with_channel(PLAIN, Delayed("valve", samples * STEP)), record)
        energies[samples] = float(fit.start_energies[0])
        if samples == 3:  # as well as what made the record
            noise = float(fit.mode["noise_sd"]) * fit.scaling.output_scale[0]
            assert noise == pytest.approx(0.003, rel=0.15)
    # Priors of the numerators differ by a few nats; those that cannot fit are far off.
    assert energies[3] < min(energies.values()) + 3.0
    if 0.3 < fraction < 0.9:
        assert min(energies[2], energies[4]) > energies[3] + 10.0


def test_dead_times_cover_the_truth_wherever_it_lies_in_a_step():
    """Truths uniform in a range: errors in standard deviations have a mean square of one."""
    errors = []
    for seed in range(8):
        delay = float(np.random.default_rng(seed).integers(50, 200)) / 100
        channel = Delayed("valve", STEP * np.ceil(delay / STEP + 1e-9))
        record = late_record(seed, delay)
        fit = fitted(with_channel(PLAIN, channel), record)
        ((mean, sd),) = parameters_of(fit, [channel], record).values()
        assert sd > 0.9 * STEP / np.sqrt(12.0)
        errors.append((mean - delay) / sd)
    # Uniform within a step: none is further off than the square root of three, where one step is.
    assert np.max(np.abs(errors)) < 3.0
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.6


CASES = {
    "dead zone": (
        lambda u, x: dead_zone(u, x - 0.8, x), lambda x: DeadZone("valve", x - 0.85, x - 0.05),
        {"lower limit of valve [V]": -0.8, "upper limit of valve [V]": 0.0},
    ),
    "play": (
        lambda u, x: play(u, 0.3 + x), lambda x: Play("valve", 0.25 + x),
        {"play of valve [V]": 0.3},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_numbers_cover_the_truth(name):
    """Over records and truths: errors in standard deviations are standard normal."""
    acts, start, truth = CASES[name]
    errors = []
    for seed in range(6 // len(truth)):
        x = float(np.random.default_rng(seed).uniform(0.0, 1.0))
        record, channel = record_of(seed, acts(signal(seed), x)), start(x)
        fit = fitted(with_channel(PLAIN, channel), record)
        found = parameters_of(fit, [channel], record)
        assert list(found) == list(truth)
        errors += [(found[k][0] - truth[k] - x) / found[k][1] for k in truth]
    assert np.max(np.abs(errors)) < 4.0
    # 99.9 % range of the root mean square of six standard normal numbers.
    assert 0.25 < np.sqrt(np.mean(np.square(errors))) < 1.95


def test_instant_and_period_of_what_acts_at_once():
    u = signal(3)
    y = 0.4 * (TIME >= 31.0)
    record = record_of(3, u)
    record = record.with_outputs(record.outputs[:, 0] + y)
    step = Step(30.0)
    fit = fitted(with_channel(PLAIN, step), record)
    found = parameters_of(fit, [step], record)
    assert list(found) == ["step at 30 [rpm]", "instant [s]"]
    assert found["instant [s]"][0] == pytest.approx(31.0, abs=1.0)
    assert found["instant [s]"][1] < 0.5
    record = record_of(4, signal(4))
    record = record.with_outputs(record.outputs[:, 0] + 0.3 * np.sin(2 * np.pi * TIME / 7.3))
    wave = Sinusoid(7.2)
    found = parameters_of(fitted(with_channel(PLAIN, wave), record), [wave], record)
    mean, sd = found["period [s]"]
    assert mean == pytest.approx(7.3, abs=4.0 * sd)
    # Cramer-Rao bound of a frequency in white noise (Rife & Boorstyn, 1974).
    amplitude, noise = 0.3, 0.05
    bound = np.sqrt(24.0) * noise / (amplitude * 2 * np.pi * TIME[-1] * np.sqrt(N)) * 7.3**2
    assert 0.7 * bound < sd < 2.5 * bound


def test_a_shifted_clock():
    u = signal(5)
    acting = np.where(TIME >= 40.0, delayed(u, TIME, -1.5), u)
    record = record_of(5, acting)
    channel = ShiftedClock("valve", 1.4, (40.0,))
    found = parameters_of(fitted(with_channel(PLAIN, channel), record), [channel], record)
    mean, sd = found["clock shift of valve [s]"]
    assert mean == pytest.approx(1.5, abs=4.0 * sd)
    assert sd < 0.2


def test_gain_of_an_extra_input():
    heat = signal(77)
    record = record_of(6, signal(6) + 0.5 * heat, heat=heat)
    channel = Recorded("heat")
    found = parameters_of(fitted(with_channel(PLAIN, channel), record), [channel], record)
    ((label, (mean, sd)),) = found.items()
    assert label == "steady-state gain of heat [rpm]"
    assert mean == pytest.approx(0.5, abs=4.0 * sd)
    assert 0.0 < sd < 0.1


def test_limits_of_a_sensor():
    u = signal(8)
    record = record_of(8, u)
    clipped = np.clip(record.outputs[:, 0], -np.inf, 0.6)
    record = record.with_outputs(clipped + 0.02 * np.random.default_rng(1).standard_normal(N))
    model = dgp.Wiener(1, pairs=1, inducing=16, process_noise=False)
    fit = dgp.fit(model, record, restarts=2, steps=150, workers=1, progress=False, method="map")
    nothing = np.inf
    found = Saturation().parameters(fit, evidence_of({"low": -nothing, "high": 0.61}), record)
    ((label, (mean, sd)),) = found.items()
    assert label == "upper limit [rpm]"
    assert mean == pytest.approx(0.6, abs=4.0 * sd + 0.01)
    assert 0.0 < sd < 0.05
    assert OutputNonlinearity().parameters(fit, evidence_of({}), record) == {}


def evidence_of(where, effect="saturation"):
    return Evidence(effect, 3.0, 0.01, 5.0, 0.1, where, "It stops.")


def test_an_instant_that_data_do_not_tell_stays_within_the_record():
    """A step of next to nothing: any instant does, none outside the record is one."""
    rng = np.random.default_rng(3)
    n = 120
    u = signal(3, n)
    y = lfilter([0.0, 0.2], [1.0, -0.8], u) + 0.1 * rng.standard_normal(n)
    record = dgp.Record(time=5.0 + 0.1 * np.arange(n), inputs=u, outputs=y, time_unit="s")
    step = Step(9.0)
    model = with_channel(dgp.LinearDynamicGP(1, pairs=1), step)
    fit = dgp.fit(model, record, method="map", workers=1, progress=False)
    mean, sd = parameters_of(fit, [step], record)["instant [s]"]
    assert record.time[0] <= mean <= record.time[-1]
    assert 0.5 < sd < record.duration


def test_weights_of_cascades_have_standard_deviations_too():
    """Their fits keep the weights of direct inputs at the mode."""
    rng = np.random.default_rng(4)
    n = 120
    u, flag = signal(3, n), np.arange(n) >= 60
    y = lfilter([0.0, 0.2], [1.0, -0.8], u) + 0.5 * flag + 0.1 * rng.standard_normal(n)
    record = dgp.Record(time=0.1 * np.arange(n), inputs=u, outputs=y)
    step = Step(6.0)
    model = with_channel(dgp.Wiener(1, pairs=1, inducing=4), step)
    fit = dgp.fit(model, record, restarts=1, steps=60, draws=20, workers=1, progress=False)
    found = parameters_of(fit, [step], record)
    (weight,) = (pair for label, pair in found.items() if label.startswith("step"))
    assert 0.003 < weight[1] < 0.5


def test_a_gain_and_the_level_that_step_at_once_have_one_instant():
    gain, other, level = StepOfGain("u", 0.0, 40.0), StepOfGain("v", 0.0, 40.0), Step(40.0)
    later, zone = Step(50.0), DeadZone("u", -1.0, 1.0)
    late = [Delayed("u", 3.0), Delayed("v", 3.0), Delayed("w", 4.0)]
    free = Delayed("x")
    groups = _together([gain, *late, other, Trend(0.0, 1.0), level, zone, later, free])
    assert groups == [[gain, other, level], late[:2], late[2:], [zone], [later]]
