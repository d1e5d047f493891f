"""The README's code does what it says."""

import re
from pathlib import Path

import numpy as np
import pyro
import torch
from pyro.infer import SVI, Trace_ELBO
from pyro.infer.autoguide import AutoNormal

import pyro_dynogp as dgp
from tests.conftest import simulate_record

README = (Path(__file__).parent.parent / "README.md").read_text()


def block(content: str) -> str:
    """The one block of Python with this in it."""
    (found,) = (b for b in re.findall(r"```python\n(.*?)```", README, flags=re.S) if content in b)
    return str(found)


def test_fitting_a_record(tmp_path, monkeypatch, one_pair):
    monkeypatch.chdir(tmp_path)
    record = simulate_record(one_pair, 0.1, n=480)
    np.savetxt(
        "drives.csv",
        np.column_stack([record.inputs, record.outputs]),
        header="u,z",
        comments="",
        delimiter=",",
    )
    code = block("from_csv").replace("pairs=5", "pairs=1")
    code = code.replace("train)", "train, restarts=1, workers=1, progress=False)", 1)
    code = code.replace('"svi")', '"svi", restarts=1, steps=50, workers=1, progress=False)')
    names: dict = {}
    exec(code, names)
    assert names["fit"].method == "svi"
    assert len(names["forecast"]) == 80
    assert (tmp_path / "drives.safetensors").is_file()


def test_a_deep_model_is_fitted(tmp_path, monkeypatch, one_pair):
    monkeypatch.chdir(tmp_path)
    code = (
        block("dgp.Cascade(")
        .replace("pairs=3", "pairs=1, outputs=2")
        .replace("outputs=2, pairs", "pairs")
    )
    code = code.replace('skip=("inputs",)', 'pairs=1, skip=("inputs",)')
    quick = "restarts=1, steps=3, particles=1, workers=1, progress=False"
    code = code.replace('checkpoint="run1"', f'checkpoint="run1", {quick}')
    code = code.replace("dgp.Static(outputs=2)", "dgp.Static(outputs=2, inducing=6)")
    names: dict = {"dgp": dgp, "train": simulate_record(one_pair, 0.1, n=60)}
    exec(code, names)
    assert names["fit"].method == "svi"
    assert 1 <= len(names["fit"].elbo) <= 3  # one where Laplace's approximation will do
    assert (tmp_path / "run1").is_dir()


def test_a_fit_is_criticised(one_pair):
    record = simulate_record(one_pair, 0.1, n=100)
    quick = {"workers": 1, "progress": False}
    train, test = record.split(70)
    names: dict = {
        "dgp": dgp,
        "train": train,
        "test": test,
        "linear": dgp.fit(dgp.LinearDynamicGP(1, pairs=1), train, restarts=1, **quick),
        "fit": dgp.fit(
            dgp.Wiener(1, pairs=1, inducing=6), train, restarts=1, steps=20, draws=50, **quick
        ),
    }
    code = block("dgp.check(")
    for target in ("missing sample", "forecast"):
        fast = f'target="{target}", draws=100, refits=0, workers=1, progress=False'
        code = code.replace(f'target="{target}"', fast)
    exec(code, names)
    assert names["data"].predictions["y"].shape[-2:] == (30, 1)
    assert names["elpd"]["target"] == "missing sample"
    assert set(names["table"].weights) == {"linear", "wiener"}


def test_any_pyro_model_is_criticised(one_pair):
    record = simulate_record(one_pair, 0.1, n=50)

    def model(record):
        data = record.tensors()
        scale = dgp.TimeScale(step=record.sampling_time, duration=record.duration)
        modes = dgp.sample_modes("g", inputs=1, pairs=1, time_scale=scale)
        sigma = pyro.sample("sigma", pyro.distributions.HalfNormal(torch.tensor(1.0).double()))
        process = dgp.LTIProcess(modes, data.time, data.inputs)
        pyro.sample("y", process.observed(sigma), obs=data.outputs[:, 0])

    with pyro.get_param_store().scope():
        guide = AutoNormal(model)
        svi = SVI(model, guide, pyro.optim.Adam({"lr": 0.05}), Trace_ELBO())
        for _ in range(20):
            svi.step(record)
        names: dict = {"dgp": dgp, "model": model, "guide": guide, "record": record}
        exec(block("from_pyro"), names)
    assert names["posterior"].draws.log_q is not None


def test_custom_model_trains(one_pair):
    names: dict = {}
    exec(block("def model(record)"), names)
    model, record = names["model"], simulate_record(one_pair, 0.1, n=60)
    pyro.set_rng_seed(0)
    with pyro.get_param_store().scope():
        guide = AutoNormal(model)
        svi = SVI(model, guide, pyro.optim.Adam({"lr": 0.05}), Trace_ELBO())
        losses = [svi.step(record) for _ in range(150)]
    assert np.mean(losses[-20:]) < np.mean(losses[:20])
    trace = pyro.poutine.trace(model).get_trace(record)
    changed = pyro.poutine.condition(model, data={"g": trace.nodes["g"]["value"] + 1.0})
    other = pyro.poutine.trace(
        pyro.poutine.condition(changed, data={"sigma": trace.nodes["sigma"]["value"]})
    ).get_trace(record)
    trace.compute_log_prob()
    other.compute_log_prob()
    assert not torch.isclose(trace.nodes["y"]["log_prob_sum"], other.nodes["y"]["log_prob_sum"])


def test_every_public_name_in_the_readme_exists():
    for name in set(re.findall(r"\bdgp\.(\w+)", README)):
        assert hasattr(dgp, name), name
