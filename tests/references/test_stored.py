"""Log joints of linear models at stored modes are those of the version before the one model."""

import json
from pathlib import Path

import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.base import Problem
from tests.references.cases import drives, furnace, two_outputs

STORED = json.loads((Path(__file__).parent / "values.json").read_text())
MODELS = {
    "linear, drives": (lambda: dgp.LinearDynamicGP(1, pairs=2), lambda: drives()[:240]),
    "linear, furnace": (lambda: dgp.LinearDynamicGP(1, pairs=2), furnace),
    "linear, furnace, no process noise": (
        lambda: dgp.LinearDynamicGP(1, pairs=2, process_noise=False), furnace,
    ),
    "linear, furnace, first state zero": (
        lambda: dgp.LinearDynamicGP(1, pairs=2, initial_state="zero"), furnace,
    ),
    "linear, furnace, no feedthrough": (
        lambda: dgp.LinearDynamicGP(1, pairs=2, feedthrough=False), furnace,
    ),
    "linear, two outputs": (lambda: dgp.LinearDynamicGP(1, outputs=2, pairs=1), two_outputs),
    "linear, two records": (
        lambda: dgp.LinearDynamicGP(1, pairs=2), lambda: (drives()[:100], drives()[120:260]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_log_joint_at_the_stored_mode(name):
    stored = STORED["fits"][name]
    make, records = MODELS[name]
    model, records = make(), records()
    problem = Problem.of(model, records)
    sites = problem.target.all_sites(problem.scaling, len(problem.records))
    assert {site.name for site in sites} == set(stored["mode"])
    values = {
        site.name: torch.tensor(stored["mode"][site.name]).double().reshape(site.shape)
        for site in sites
    }
    found = float(Potential(problem.target, (problem.records,), values).log_joint(values))
    assert found == pytest.approx(stored["log_joint"], rel=1e-9)
