"""Saved fits: exact round trip, and files that are refused."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors.torch import load_file

import pyro_dynogp as dgp
from pyro_dynogp.inference.storage import FORMAT
from pyro_dynogp.support.checkpoints import write_tensors


@pytest.mark.parametrize("name", ["map_fit", "svi_fit", "two_output_fit"])
def test_exact_round_trip(name, request, tmp_path, record, two_outputs):
    fit = request.getfixturevalue(name)
    path = tmp_path / "fit.safetensors"
    fit.save(path)
    again = dgp.load(path)
    assert again.model == fit.model
    assert again.method == fit.method
    assert dict(again.diagnostics) == dict(fit.diagnostics)
    assert again.records == fit.records
    assert again.training == fit.training
    for site in fit.draws:
        assert torch.equal(again.draws[site], fit.draws[site])
        assert torch.equal(again.mode[site], fit.mode[site])
    target = two_outputs if name == "two_output_fit" else record
    one, two = fit.forecast(target[:160], target[160:]), again.forecast(target[:160], target[160:])
    assert np.array_equal(one.mean, two.mean)
    assert np.array_equal(one.samples, two.samples)
    assert np.array_equal(again.history, fit.history)


def test_loaded_guide_is_the_same_distribution(svi_fit, tmp_path, record):
    import pyro

    svi_fit.save(tmp_path / "fit")
    again = dgp.load(tmp_path / "fit")
    for guide in (svi_fit.guide, again.guide):
        torch.manual_seed(3)
        trace = pyro.poutine.trace(guide).get_trace(record)
        trace.compute_log_prob()
        total = float(trace.log_prob_sum())
        if guide is svi_fit.guide:
            first = total
    assert total == first


def write(path, metadata, tensors=None):
    write_tensors(path, tensors or {"x": torch.zeros(1)}, metadata)


def test_files_that_are_refused(tmp_path, map_fit):
    with pytest.raises(ValueError, match="no file"):
        dgp.load(tmp_path / "absent")
    junk = tmp_path / "junk"
    junk.write_bytes(b"not a model at all, but long enough to have a header")
    with pytest.raises(ValueError, match="not a safetensors file, or it is damaged"):
        dgp.load(junk)
    foreign = tmp_path / "foreign"
    write(foreign, {"format": "pt"})
    with pytest.raises(ValueError, match="not a fit of pyro_dynogp"):
        dgp.load(foreign)
    future = tmp_path / "future"
    write(future, {FORMAT: json.dumps({"version": 99})})
    with pytest.raises(ValueError, match="format version 99"):
        dgp.load(future)
    broken = tmp_path / "broken"
    write(broken, {FORMAT: "{"})
    with pytest.raises(ValueError, match="header"):
        dgp.load(broken)
    whole = tmp_path / "whole"
    map_fit.save(whole)
    cut = tmp_path / "cut"
    cut.write_bytes(whole.read_bytes()[:-40])
    with pytest.raises(ValueError, match="damaged"):
        dgp.load(cut)


def test_saving_into_a_folder_that_is_not_there(tmp_path, map_fit):
    with pytest.raises(ValueError, match="path: expected a file in an existing folder"):
        map_fit.save(tmp_path / "absent" / "fit.safetensors")


def test_incomplete_and_unknown_models_are_refused(tmp_path, map_fit):
    from safetensors import safe_open

    whole = tmp_path / "whole"
    map_fit.save(whole)
    with safe_open(str(whole), framework="pt") as file:
        header = json.loads(file.metadata()[FORMAT])
    tensors = load_file(str(whole))
    missing = {k: v for k, v in tensors.items() if k != "draws/offset"}
    write(tmp_path / "missing", {FORMAT: json.dumps(header)}, missing)
    with pytest.raises(ValueError, match="incomplete or damaged"):
        dgp.load(tmp_path / "missing")
    header["model"] = "os.system"
    write(tmp_path / "unknown", {FORMAT: json.dumps(header)}, tensors)
    with pytest.raises(ValueError, match="unknown model"):
        dgp.load(tmp_path / "unknown")


def test_training_records_come_back_with_names_units_and_clock(map_fit, record, tmp_path):
    stamps = pd.date_range(
        "2024-03-31 00:30", periods=len(record), freq="10min", tz="Europe/Berlin"
    )
    full = dgp.Record(
        stamps,
        record.inputs,
        np.where(np.arange(len(record))[:, None] == 7, np.nan, record.outputs),
        input_names=["valve"],
        output_names=["level"],
        input_units=["V"],
        output_units=["m"],
        extra={"room": np.sin(record.time)},
        extra_units={"room": "degC"},
        name="night",
    )
    replace(map_fit, records=(full, full[:50])).save(tmp_path / "fit")
    again = dgp.load(tmp_path / "fit").records
    assert again == (full, full[:50])
    assert again[0].name == "night"
    assert again[0].timestamps.equals(full.timestamps)
