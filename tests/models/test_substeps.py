"""Feedback computed several times between samples: the same as with a sample missing there."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference import refit as refits
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.free_runs import free_run_error
from pyro_dynogp.inference.optimise.maximum import maximise
from pyro_dynogp.inference.run import Run
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.models.feedback_variants import with_feedback, with_usual_substeps
from pyro_dynogp.models.moment_outputs import quiet_last_steps
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.variants import have_same_parameters
from tests.models.closed_loops import (
    check_gradient,
    make_record,
    spring,
    system_at,
    values_of,
)

PARTS = 3


def with_parts(model, parts):
    layers = [replace(x, substeps=parts) if isinstance(x, dgp.Dynamic) else x for x in model.layers]
    return replace(model, layers=tuple(layers))


def finer(record, parts=PARTS):
    """The record with missing samples between, inputs held."""
    between = np.arange(parts) / parts
    time = record.time[:-1, None] + between * np.diff(record.time)[:, None]
    y = np.full((parts * (len(record) - 1) + 1, record.n_outputs), np.nan)
    y[::parts] = record.outputs
    u = np.repeat(record.inputs, parts, axis=0)[: len(y)]
    return dgp.Record(time=np.append(time.flatten(), record.time[-1]), inputs=u, outputs=y)


def pair(outputs=1, irregular=False, hidden=0, **options):
    """Output processes of one system: with substeps, and along the finer record."""
    record = make_record(1, outputs, irregular=irregular)
    coarse = with_parts(spring(outputs, hidden=hidden, **options), PARTS).scaled_to(record)
    fine = with_parts(coarse, 1)
    values = values_of(coarse, record, seed=outputs, linear=False)
    (few,), (many,) = coarse.prepare(record), fine.prepare(finer(record))
    many = replace(many, scaling=few.scaling)
    first = output_process(system_at(coarse, values), few)
    second = output_process(system_at(fine, values), replace(many, scaled_inputs=held(few)))
    return record, first, second


def held(few):
    return few.scaled_inputs.repeat_interleave(PARTS, 0)[: 1 - PARTS]


CASES = [(1, False, 0), (2, True, 0), (1, True, 1)]


@pytest.mark.parametrize(("outputs", "irregular", "hidden"), CASES)
def test_every_verb_is_that_of_the_finer_record(outputs, irregular, hidden):
    record, few, many = pair(outputs, irregular, hidden)
    y, wide = (r.tensors().observations for r in (record, finer(record)))
    close = {"rtol": 1e-9, "atol": 1e-11}
    torch.testing.assert_close(few.log_prob(y), many.log_prob(wide), **close)
    for one, other in zip(few.innovations(y), many.innovations(wide), strict=True):
        torch.testing.assert_close(one, other[::PARTS], equal_nan=True, **close)
    for name in ("mean", "variance", "log_density"):
        for found, fine in (
            (few.one_step(y), many.one_step(wide)),
            (few.ahead(y, 2), many.ahead(wide, 2 * PARTS)),
            (few.left_out(y), many.left_out(wide)),
        ):
            own, other = getattr(found, name), getattr(fine, name)[::PARTS]
            torch.testing.assert_close(own, other, equal_nan=True, **close)
    smoothed, fine = few.smooth(y), many.smooth(wide)
    assert smoothed.keys() == fine.keys()
    for name, layer in smoothed.items():
        np.testing.assert_allclose(layer.mean, fine[name].mean[:, ::PARTS], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(layer.sd, fine[name].sd[:, ::PARTS], rtol=1e-6, atol=1e-8)
    drawn, other = (process.components(samples=5, seed=3) for process in (few, many))
    # Times are rounded otherwise, which a loop through a rough function makes larger and larger.
    first = drawn.mean[:, :10], other.mean[:, ::PARTS][:, :10]
    # Outputs have a size of one; how they are rounded differs between processors.
    np.testing.assert_allclose(*first, rtol=1e-7, atol=1e-7)


def test_the_state_after_a_record():
    """One step on, and without process noise in it none in any of its parts."""
    record, few, many = pair(irregular=True)
    y = record.tensors().observations
    step = 0.3
    u = torch.zeros(1, dtype=torch.float64)
    found = few.state_after(y, step, u)
    # The finer record goes on with its last input held over two further missing samples.
    time = record.time[-1] + step / PARTS * np.arange(1, PARTS)
    longer = finer(record)
    longer = dgp.Record(
        np.append(longer.time, time),
        np.vstack([longer.inputs, np.repeat(longer.inputs[-1:], PARTS - 1, 0)]),
        np.vstack([longer.outputs, np.full((PARTS - 1, 1), np.nan)]),
    )
    other = output_process(many.system, PreparedRecord.of(longer, few.scaling))
    expected = other.state_after(longer.tensors().observations, step / PARTS, u)
    torch.testing.assert_close(found.mean, expected.mean, rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(found.covariance, expected.covariance, rtol=1e-8, atol=1e-12)
    silent = few.state_after(y, step, u, process_noise=False)
    quiet = quiet_last_steps(few.assembly.with_outputs(few.scaled(y)), PARTS)
    assert (quiet.layout.step[-PARTS:] == quiet.Q.shape[-3] - 1).all()
    assert not quiet.Q[..., -1, :, :].any()
    assert silent.covariance.trace() < found.covariance.trace()


def test_gradients_of_the_density():
    record = make_record(irregular=True)
    model = with_parts(spring(hidden=1), PARTS).scaled_to(record).collapsed
    values = values_of(model, record, linear=False)
    check_gradient(Potential(model, (model.prepare(record),), values))


def test_free_runs_through_blocks_are_those_of_the_finer_record():
    record = make_record(n=300, missing=False)
    coarse = with_parts(spring(process_noise=False), PARTS).scaled_to(record)
    values = values_of(coarse, record)
    own = free_run_error(coarse, values, coarse.prepare(record))
    assert np.isfinite(own)
    assert own != free_run_error(with_parts(coarse, 1), values, coarse.prepare(record))


class TestGrid:
    def test_every_part_of_a_step(self):
        grid = time_grid(torch.tensor([0.0, 0.1, 0.1, 0.4], dtype=torch.float64))
        fine = grid.divided(2)
        expected = torch.tensor([0.0, 0.05, 0.1, 0.1, 0.1, 0.25, 0.4], dtype=torch.float64)
        torch.testing.assert_close(fine.time, expected)
        torch.testing.assert_close(fine.steps, grid.steps / 2)
        assert fine.step_index.tolist() == [-1, 0, 0, -1, -1, 1, 1]
        assert grid.divided(1) is grid


class TestRefused:
    @pytest.mark.parametrize("parts", [0, -1, 1.5, "2", 65, True])
    def test_no_count(self, parts):
        with pytest.raises(ValueError, match=r"substeps of layer 'g': expected a whole number"):
            dgp.NonlinearFeedback(1, substeps=parts)

    def test_without_feedback(self):
        with pytest.raises(ValueError, match=r"substeps of layer 'g': expected 1, or feedback"):
            dgp.Cascade(1, (dgp.Dynamic(substeps=2), dgp.Static()))

    def test_beside_a_free_dead_time(self):
        channels = (dgp.Delayed("u"),)
        with pytest.raises(ValueError, match="substeps: expected 1 beside a dead time"):
            dgp.NonlinearFeedback(2, substeps=2, channels=channels)
        for hidden in (0, 1):
            assert dgp.NonlinearFeedback(2, hidden=hidden, channels=channels).substeps == 1
            late = with_feedback(dgp.LinearDynamicGP(2, channels=channels), hidden=bool(hidden))
            assert late.substeps == 1


def test_defaults():
    """Three parts where a step comes back, one else; the loop adds them where they are better."""

    def parts(model):
        return model.dynamic[0][1].substeps

    assert parts(dgp.NonlinearFeedback(1)) == 1
    assert parts(dgp.NonlinearFeedback(1, hidden=1)) == 3
    assert parts(dgp.NonlinearFeedback(1, step=True)) == 3
    assert parts(dgp.NonlinearFeedback(1, hidden=1, step=False)) == 1
    assert parts(dgp.NonlinearFeedback(1, hidden=1, substeps=2)) == 2
    linear = dgp.LinearDynamicGP(1)
    assert parts(with_feedback(linear)) == 1
    assert parts(with_feedback(linear, hidden=True)) == 1
    assert parts(with_feedback(dgp.NonlinearFeedback(1, substeps=5), hidden=True)) == 5


def test_usual_ones():
    """Those of a step that was added; a base that has fewer than is usual is as it should be."""

    def parts(model, base=None):
        return with_usual_substeps(model, base).dynamic[0][1].substeps

    added = with_feedback(dgp.LinearDynamicGP(1), hidden=True)
    assert parts(added) == parts(added, dgp.LinearDynamicGP(1)) == 3
    assert parts(with_feedback(dgp.LinearDynamicGP(1))) == 1
    late = dgp.LinearDynamicGP(1, channels=(dgp.Delayed("u"),))
    assert parts(with_feedback(late, hidden=True)) == 1
    coarse = dgp.NonlinearFeedback(1, hidden=1, substeps=1)
    assert parts(coarse) == 3
    assert parts(coarse, coarse) == 1
    assert parts(dgp.NonlinearFeedback(1, hidden=1, substeps=5), coarse) == 5


def test_models_with_the_same_parameters():
    """Units and substeps change none; sites, channels and process noise do."""
    one = dgp.NonlinearFeedback(1, hidden=1)
    two = dgp.NonlinearFeedback(1, hidden=1, substeps=1)
    scaled = replace(two, scaling=dgp.Scaling.from_records(make_record(n=60, missing=False)))
    for other in (one, two, scaled):
        assert have_same_parameters(one, other)
        assert have_same_parameters(other, one)
    few = dgp.NonlinearFeedback(1, hidden=1, substeps=1, inducing=4)
    quiet = dgp.NonlinearFeedback(1, hidden=1, process_noise=False)
    for other in (few, quiet, dgp.NonlinearFeedback(1), dgp.NonlinearFeedback(2, hidden=1)):
        assert not have_same_parameters(one, other)


def test_a_refit_with_others_begins_at_what_is_learnt_and_nowhere_else(monkeypatch):
    record = make_record(n=60, missing=False)
    model = dgp.NonlinearFeedback(1, hidden=1, substeps=1, inducing=4)
    quick = {"method": "map", "restarts": 1, "steps": 2, "workers": 1, "progress": False}
    fit = dgp.fit(model, record, **quick)
    climbs = []

    def climb(target, records, starts, run, **options):
        climbs.append((target.substeps, starts))
        return maximise(target, records, starts, run, **options)

    monkeypatch.setattr(refits, "maximise", climb)
    run = Run(0, workers=1, steps=2)
    other = dgp.NonlinearFeedback(1, hidden=1, substeps=3, inducing=4)
    finer = refits.refit(fit, record, model=other, run=run)
    ((parts, (start,)),) = climbs
    assert parts == finer.model.substeps == 3
    for name, value in fit.mode.items():
        assert torch.equal(start[name], value), name


def test_files_keep_them(tmp_path):
    record = make_record(n=60, missing=False)
    model = dgp.NonlinearFeedback(1, substeps=2, inducing=4)
    fit = dgp.fit(model, record, method="map", restarts=1, steps=2, workers=1, progress=False)
    fit.save(tmp_path / "fit.pt")
    again = dgp.load(tmp_path / "fit.pt")
    assert again.model.substeps == 2
    assert copy.deepcopy(again.model) == fit.model
