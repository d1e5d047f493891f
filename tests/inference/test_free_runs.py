"""Free runs over blocks: what they measure, and what is decided on them."""

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference import free_runs
from pyro_dynogp.inference.optimise.maximum import Optimum
from pyro_dynogp.models.outputs import output_process
from tests.models.closed_loops import ClosedLoop, make_record, spring, system_at, values_of


def test_without_process_noise_the_error_is_that_of_the_whole_run():
    """The filter learns nothing then: blocks go on where the one before them ended."""
    model = spring(process_noise=False)
    record = make_record(n=300, irregular=True)
    model = model.scaled_to(record)
    values = values_of(model, record, seed=1)
    loop = ClosedLoop(model, system_at(model, values), record)
    error = loop.scaled(record.outputs) - loop.filter()[1]
    found = free_runs.free_run_error(model, values, model.prepare(record))
    assert found == pytest.approx(np.sqrt(np.nanmean(error**2)), rel=1e-9)


def test_with_process_noise_blocks_begin_at_the_state_of_the_filter():
    """Nearer than a run from the first sample alone, on a record that the model makes."""
    model = spring()
    blank = make_record(n=600, missing=False)
    model = model.scaled_to(blank)
    values = values_of(model, blank, seed=2)
    values["g_noise_gain_unit"] = 2.0 + 0.0 * values["g_noise_gain_unit"]
    process = output_process(system_at(model, values), model.prepare(blank)[0])
    with torch.random.fork_rng():
        torch.manual_seed(0)
        record = blank.with_outputs(process.sample().numpy()[:, None])
    whole = process.components(samples=200, seed=0).mean.mean(0)
    error = np.sqrt(np.mean((record.outputs - whole) ** 2)) / float(model.scaling.output_scale[0])
    assert free_runs.free_run_error(model, values, model.prepare(record)) < 0.97 * error


@pytest.mark.parametrize(("with_noise", "pays"), [(0.985, True), (0.995, False), (1.2, False)])
def test_process_noise_has_to_better_free_runs_by_a_hundredth(monkeypatch, with_noise, pays):
    model = dgp.NonlinearFeedback(1)
    record = make_record()
    model = model.scaled_to(record)
    values = values_of(model, record, seed=3, linear=False)
    noisy = Optimum(-1.0, values, np.zeros(1), "")
    without = {k: v for k, v in values.items() if "noise_gain" not in k}
    quiet = Optimum(5.0, without, np.zeros(1), "")

    def error(model, at, records):
        return with_noise if at is values else 1.0

    monkeypatch.setattr(free_runs, "free_run_error", error)
    prepared = model.prepare(record)
    silent = free_runs.silenced(model, prepared, quiet, values)
    assert free_runs.noise_pays(model, prepared, noisy, silent) == pays
    left = silent.values["g_noise_gain_unit"] / values["g_noise_gain_unit"]
    assert float(left.max()) == pytest.approx(free_runs.SILENT)
    assert np.isfinite(silent.energy)
