"""Dead times that are parameters: their site, and systems along records with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Product, Trend
from pyro_dynogp.data.signals import delayed
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.lti.response import mean_response
from pyro_dynogp.models.late_systems import arrive, common_step, even_step
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.prediction.records import following

FINER, N = 50, 60
RNG = np.random.default_rng(3)
EVEN = np.arange(N) * FINER
UNEVEN = np.concatenate([[0], np.cumsum(RNG.integers(FINER // 2, 2 * FINER, N - 1))])
INPUTS = RNG.normal([1.0, -2.0], 1.0, (N, 2))
OUTPUTS = RNG.normal(size=(N, 1))
LATE = dgp.Delayed("u")


def record_at(at: np.ndarray, inputs: int = 1) -> dgp.Record:
    names = ("u", "v")[:inputs]
    return dgp.Record(at / FINER, INPUTS[:, :inputs], OUTPUTS, input_names=names, time_unit="s")


def made(model: dgp.Model, record: dgp.Record, *delays: float):
    """The model in the scale of the record, values of its sites, and the prepared record."""
    model = model.scaled_to(record).collapsed
    with torch.random.fork_rng(), torch.no_grad(), pyro.poutine.block():
        torch.manual_seed(1)
        sites = model.all_sites(model.scaling, 1)
        values = {site.name: site.prior.sample() for site in sites}
    values["delay"] = torch.tensor(delays, dtype=torch.float64)
    return model, values, model.prepare(record)[0]


def test_the_prior_is_half_cauchy_around_what_the_record_can_show():
    for n in (30, 300):
        at = 0.5 * np.arange(n)
        record = dgp.Record(at, RNG.normal(size=n), RNG.normal(size=n), input_names=("u",))
        model = dgp.LinearDynamicGP(1, channels=(LATE,)).scaled_to(record)
        prior = {site.name: site.prior for site in model.sites(model.scaling)}["delay"]
        median = np.sqrt(0.5 * at[-1] / np.pi)
        assert float(prior.base_dist.median) == pytest.approx(median)
        known = dist.HalfCauchy(torch.tensor([median])).log_prob(torch.tensor([2.0])).sum()
        assert float(prior.log_prob(torch.tensor([2.0]).double())) == pytest.approx(float(known))
    given = dgp.LinearDynamicGP(1, channels=(dgp.Delayed("u", median=4.0),)).scaled_to(record)
    (site,) = [site for site in given.sites(given.scaling) if site.name == "delay"]
    assert float(site.prior.base_dist.median) == 4.0
    assert site.dims == ("delayed input",)


def test_a_late_input_has_no_direct_path():
    record = record_at(EVEN, 2)
    shapes = {
        (): (2,), (LATE,): (1,), (dgp.Delayed("u", 1.0),): (2,), (LATE, dgp.Delayed("v")): None,
    }  # fmt: skip
    for channels, shape in shapes.items():
        model = dgp.LinearDynamicGP(2, pairs=1, channels=channels).scaled_to(record)
        sites = {site.name: tuple(site.shape) for site in model.sites(model.scaling)}
        assert sites.get("g_feedthrough") == shape
    model, values, _ = made(dgp.LinearDynamicGP(2, pairs=1, channels=(LATE,)), record, 1.0)
    (direct,) = model.system(values, model.scaling).layers[0].modes.D.tolist()
    assert direct == [0.0, float(values["g_feedthrough"])]


@pytest.mark.parametrize("at", [EVEN, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("options", [{}, {"integrators": 1}, {"pairs": 2}], ids=str)
@pytest.mark.parametrize("delay", [0.02, 2.4, 7.0])
def test_the_mean_is_that_of_a_simulation_fifty_times_finer(at, options, delay):
    record = record_at(at)
    options = {"pairs": 1, "process_noise": False, **options}
    model, values, prepared = made(
        dgp.LinearDynamicGP(1, channels=(LATE,), **options), record, delay
    )
    system = model.system(values, model.scaling)
    outputs = output_process(system, prepared)
    every = np.arange(at[-1] + 1)
    place = np.searchsorted(at, every - round(delay * FINER), side="right") - 1
    u = INPUTS[np.maximum(place, 0), :1]
    physical = system.physical(model.scaling)
    centred = u - model.scaling.input_offset
    expected = mean_response(physical.modes, every / FINER, centred).output[at] + physical.offset
    np.testing.assert_allclose(outputs.process.process.mean, expected, atol=1e-9)


def test_at_whole_steps_the_density_is_that_of_a_given_delay():
    record = record_at(EVEN, 2)
    shape = dgp.LinearDynamicGP(2, pairs=2, feedthrough=False)
    for delay in (0.0, 3.0, 11.0):
        model, values, prepared = made(replace(shape, channels=(LATE,)), record, delay)
        free = output_process(model.system(values, model.scaling), prepared)
        given = replace(model, channels=(dgp.Delayed("u", delay),))
        (known,) = given.prepare(record)
        del values["delay"]
        known = output_process(given.system(values, model.scaling), known)
        y = prepared.observations
        assert float(free.log_prob(y)) == pytest.approx(float(known.log_prob(y)), abs=1e-8)


ENGINES = {
    "Student-t": dgp.LinearDynamicGP(1, pairs=1, likelihood=dgp.StudentT(), channels=(LATE,)),
    "Wiener": dgp.Wiener(1, pairs=1, inducing=5, channels=(LATE,)),
    "Hammerstein": dgp.Hammerstein(1, pairs=1, inducing=5, channels=(LATE,)),
    "feedback": dgp.NonlinearFeedback(1, pairs=1, inducing=5, channels=(LATE,)),
    "noise of inputs": dgp.LinearDynamicGP(
        1, pairs=1, likelihood=dgp.Heteroscedastic(), channels=(LATE,)
    ),
    "branches": dgp.ParallelWienerHammerstein(1, pairs=1, inducing=4, channels=(LATE,)),
}


@pytest.mark.parametrize("at", [EVEN, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("name", ENGINES)
def test_other_models_at_whole_steps_and_their_gradients(name, at):
    """At whole steps of an even clock nothing is averaged; elsewhere gradients are right."""
    record = record_at(at)
    model, values, prepared = made(ENGINES[name], record, 3.0)
    potential = Potential(model, (record,), values)
    z = potential.pack(values).numpy()
    place = list(potential.unpack(torch.tensor(z))).index("delay")
    assert potential.sites[place].name == "delay"
    start = sum(site.unconstrained.numel() for site in potential.sites[:place])
    z[start] = np.log(3.407)  # no difference of two times, where there is a kink
    _, slope = potential.value_and_gradient(z)
    ends = []
    for step in (1e-5, -1e-5):
        moved = z.copy()
        moved[start] += step
        ends.append(potential.value_and_gradient(moved)[0])
    assert slope[start] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4, abs=1e-5)
    if at is EVEN:
        shifted = delayed(INPUTS[:, 0], at / FINER, 3.0)
        later = replace(
            prepared, inputs=torch.tensor(shifted[:, None]),
            scaled_inputs=torch.tensor((shifted[:, None] - model.scaling.input_offset)
                                       / model.scaling.input_scale),
        )  # fmt: skip
        system = model.system(values, model.scaling)
        here = model.begin(system, {k: torch.zeros(2 * 1).double() for k in
                                    [w.name for w in model.state_sites]})  # fmt: skip
        y = prepared.observations
        free = output_process(here, prepared).log_prob(y)
        known = output_process(replace(here, delays=None), later).log_prob(y)
        assert float(free) == pytest.approx(float(known), abs=1e-7)


def test_inputs_that_act_at_once_may_be_late():
    record = record_at(EVEN, 2)
    model, values, prepared = made(
        dgp.LinearDynamicGP(3, pairs=1, direct=1, channels=(LATE, Trend(0.0, 9.0))), record, 2.5
    )
    seen = arrive(model.system(values, model.scaling), prepared)
    assert seen.inputs.shape == (N, 4)  # the change stands between those of the layers and others
    np.testing.assert_allclose(seen.inputs[:, 3], record.time / 9.0)
    np.testing.assert_allclose(seen.inputs[5:, 2], INPUTS[2:-3, 0] - INPUTS[3:-2, 0])
    direct, values, prepared = made(
        dgp.LinearDynamicGP(2, pairs=1, direct=1, channels=(dgp.Delayed("v"),)), record, 2.5
    )
    seen = arrive(direct.system(values, direct.scaling), prepared)
    np.testing.assert_allclose(seen.inputs[:, 1], delayed(INPUTS[:, 1], record.time, 2.5))


@pytest.mark.parametrize("at", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_what_arrives_late_in_a_forecast_acted_before_it(at):
    record = record_at(at)
    model, values, whole = made(dgp.LinearDynamicGP(1, pairs=1, channels=(LATE,)), record, 4.3)
    system = model.system(values, model.scaling)

    class Fitted:
        pass

    fit = Fitted()
    fit.model = model
    along = arrive(system, whole).inputs
    for parts in ((record[:40], record[40:]), (model.check(record)[0][:40], record[40:])):
        before, after, gap = following(fit, *parts)
        assert gap == pytest.approx(at[40] / FINER - at[39] / FINER)
        found = torch.cat([arrive(system, part).inputs for part in (before, after)])
        np.testing.assert_allclose(found, along, atol=1e-10)


def test_clocks():
    even, uneven = (
        made(dgp.LinearDynamicGP(1, channels=(LATE,)), record_at(at), 1.0)[2]
        for at in (EVEN, UNEVEN)
    )
    assert even_step(even) == pytest.approx(1.0)
    assert even_step(uneven) is None
    assert common_step([even, even]) == pytest.approx(1.0)
    assert common_step([even, uneven]) is None


@pytest.mark.parametrize(
    "channels",
    [(LATE, dgp.Delayed("u delayed", 1.0)), (LATE, LATE), (LATE, Product("u delayed", "v", 0, 0))],
)
def test_what_is_made_from_a_late_input_is_refused(channels):
    with pytest.raises(ValueError, match="channels: expected"):
        dgp.LinearDynamicGP(2, channels=channels)


def test_numbers_of_a_delay():
    for bad in ({"delay": np.nan}, {"delay": "3"}, {"median": 0.0}, {"delay": 1.0, "median": 2.0}):
        with pytest.raises(ValueError, match=r"delay|median"):
            dgp.Delayed("u", **bad)
    assert dgp.Delayed("u").free
    assert not dgp.Delayed("u", 0.0).free


@pytest.mark.parametrize(
    "make",
    [
        dgp.LinearDynamicGP, dgp.Wiener, dgp.Hammerstein, dgp.WienerHammerstein,
        lambda inputs, **more: dgp.NonlinearFeedback(inputs, hidden=1, **more),
    ],
    ids=["linear", "Wiener", "Hammerstein", "Wiener-Hammerstein", "feedback"],
)  # fmt: skip
@pytest.mark.parametrize("at", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_the_dead_time_changes_the_likelihood(make, at):
    record = record_at(at)
    model, values, prepared = made(make(1, pairs=1, channels=(LATE,)), record, 3.3)

    def likelihood(delay: float) -> float:
        here = {**values, "delay": torch.tensor([delay], dtype=torch.float64)}
        system = model.begin(model.system(here, model.scaling), model.states_of(here, ""))
        return float(output_process(system, prepared).log_prob(prepared.observations))

    before = likelihood(3.3)
    for delay in (3.4, 3.8, 5.3):
        assert abs(likelihood(delay) - before) > 1e-3
