"""Pieces of a fit kept on disk: whole or not at all, and a killed fit resumes to the same bits."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyro
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.methods import svi
from pyro_dynogp.support import checkpoints
from pyro_dynogp.support.checkpoints import Checkpoints, tensor_text, text_tensor
from tests.inference.cascades import FAST, same, wiener
from tests.inference.conftest import LAYERED, TRAINED


class Counter:
    def __init__(self, value=1.0):
        self.calls, self.value = 0, value

    def __call__(self):
        self.calls += 1
        return {"x": torch.full((2,), self.value, dtype=torch.float64), "n": torch.tensor(3)}


class TestPiece:
    def test_is_computed_once_and_read_back(self, tmp_path):
        compute = Counter(0.1)
        kept = Checkpoints.at(tmp_path / "deep" / "run", model="identity")
        first = kept.piece("a", compute)
        second = Checkpoints.at(tmp_path / "deep" / "run", model="identity").piece("a", compute)
        assert compute.calls == 1
        assert first.keys() == second.keys()
        assert all(torch.equal(first[k], second[k]) for k in first)
        assert second["x"].dtype == torch.float64
        kept.piece("b", compute)
        assert compute.calls == 2

    def test_nothing_is_kept_without_a_folder(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        compute = Counter()
        kept = Checkpoints.at(None, model="identity")
        kept.piece("a", compute)
        kept.piece("a", compute)
        assert compute.calls == 2
        assert not list(tmp_path.iterdir())

    def test_no_gradient_and_no_memory_is_shared(self, tmp_path):
        x = torch.ones(3, requires_grad=True)
        # Two views of one storage: safetensors refuses them unless they are copied.
        kept = Checkpoints.at(tmp_path, seed=1).piece("a", lambda: {"x": x[:2], "y": x[1:]})
        assert not kept["x"].requires_grad
        kept["x"][0] = 9.0
        assert x[0] == 1.0

    def test_a_damaged_piece_is_named(self, tmp_path):
        kept = Checkpoints.at(tmp_path, model="identity")
        kept.piece("a", Counter())
        path = tmp_path / "a.safetensors"
        path.write_bytes(path.read_bytes()[:-9])
        with pytest.raises(ValueError, match=r"a\.safetensors is .* damaged .* Remove it"):
            kept.piece("a", Counter())
        path.unlink()
        assert kept.piece("a", Counter(2.0))["x"][0] == 2.0

    def test_the_folder_of_another_run_is_refused(self, tmp_path):
        Checkpoints.at(tmp_path, model="model", seed=0)
        Checkpoints.at(tmp_path, model="model", seed=0)
        with pytest.raises(ValueError, match="checkpoint: expected a new folder"):
            Checkpoints.at(tmp_path, model="model", seed=1)

    def test_what_fails_or_is_cut_off_leaves_no_piece(self, tmp_path, monkeypatch):
        kept = Checkpoints.at(tmp_path, model="identity")

        def fails():
            raise RuntimeError("no result")

        with pytest.raises(RuntimeError, match="no result"):
            kept.piece("a", fails)
        assert not (tmp_path / "a.safetensors").exists()

        def half(tensors, path, metadata):  # the disk is full, or the process dies, in the middle
            Path(path).write_bytes(b"half")
            raise OSError("disk full")

        with monkeypatch.context() as patch:
            patch.setattr(checkpoints, "save_file", half)
            with pytest.raises(OSError, match="disk full"):
                kept.piece("a", Counter())
        assert [path.name for path in tmp_path.iterdir()] == ["run.json"]
        assert kept.piece("a", Counter(5.0))["x"][0] == 5.0

    def test_text_survives(self):
        assert tensor_text(text_tensor("CONVERGENCE: λ → 0")) == "CONVERGENCE: λ → 0"


SCRIPT = """
import pyro_dynogp as dgp
from pyro_dynogp.inference.methods import svi
from tests.inference import conftest
from tests.inference.cascades import wiener, wiener_record

svi.CHUNK = {chunk}
if __name__ == "__main__":
    dgp.fit(wiener(), wiener_record(), checkpoint={folder!r}, **conftest.{options})
"""


def kill_when_there_is(path, folder, **script):
    """Start a fit in a process of its own and kill it, with no chance to tidy up."""
    root = Path(__file__).parents[2]
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT.format(folder=str(folder), **script)],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        stderr=subprocess.PIPE,
    ) as process:
        while not path.exists() and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        _, error = process.communicate()
    assert process.returncode == -signal.SIGKILL, error.decode()


def stamps(folder):
    return {p.name: p.stat().st_mtime_ns for p in folder.glob("*.safetensors")}


@pytest.mark.parametrize(
    ("options", "name", "chunk", "piece", "rest"),
    [
        # Small pieces, since the starts and their optima take as many steps.
        ("TRAINED", "trained_fit", 4, "posterior-svi-{:07d}", range(8, 25, 4)),
        ("LAYERED", "layered_fit", 50, "start-0-{:07d}", (75,)),
    ],
)
def test_a_killed_fit_goes_on_to_the_same_bits(
    options, name, chunk, piece, rest, tmp_path, request, bent, monkeypatch
):
    """Parameters, state of Adam and random numbers are put back, and nothing is done twice."""
    whole = request.getfixturevalue(name)  # in one go, in pieces of 50 steps
    awaited = f"{piece.format(chunk)}.safetensors"
    kill_when_there_is(tmp_path / awaited, tmp_path, options=options, chunk=chunk)
    before = stamps(tmp_path)
    assert awaited in before
    monkeypatch.setattr(svi, "CHUNK", chunk)
    settings = TRAINED if options == "TRAINED" else LAYERED
    resumed = dgp.fit(wiener(), bent, checkpoint=tmp_path, **settings)
    assert same(resumed, whole)
    after = stamps(tmp_path)
    assert {k: after[k] for k in before} == before  # read, not computed again
    # The kill may come a moment late, but at most the pieces after the one awaited are new.
    names = [piece.format(step) for step in rest] + ["start-0-result"]
    assert set(after) - set(before) <= {f"{one}.safetensors" for one in names}
    again = dgp.fit(wiener(), bent, checkpoint=tmp_path, **settings)
    assert same(again, whole)
    assert stamps(tmp_path) == after


@pytest.mark.parametrize(("method", "guide"), [("map", None), ("svi", "inducing times")])
def test_keeping_pieces_changes_nothing(method, guide, tmp_path, bent):
    options = {**FAST, "method": method, "guide": guide, "steps": 3}
    if method == "map":
        del options["draws"], options["particles"]
    plain = dgp.fit(wiener(), bent[:60], **options)
    kept = dgp.fit(wiener(), bent[:60], checkpoint=tmp_path, **options)
    assert same(plain, kept)
    assert not list(tmp_path.glob("*.part"))
    assert json.loads((tmp_path / "run.json").read_text()).keys() == {"fingerprint", "parts"}


class Reached(Exception):  # noqa: N818
    """The folder was accepted; nothing need be fitted."""


def test_a_folder_serves_one_fit(tmp_path, bent, monkeypatch):
    """Whatever changes the numbers makes another run, above all another guide of the same type."""

    def stop(*args, **kwargs):
        raise Reached

    monkeypatch.setattr("pyro_dynogp.inference.methods.trajectories.Trajectories.__call__", stop)

    def one(record):
        pyro.sample("noise_sd", dist.Delta(torch.ones(1)))

    def two(record):
        pyro.sample("noise_sd", dist.LogNormal(torch.zeros(1), 1.0))

    def start(folder, guide, record=bent, model=None, **options):
        folder = tmp_path / folder
        dgp.fit(model or wiener(), record, guide=guide, checkpoint=folder, **{**FAST, **options})

    first = {"g": dgp.InducingTimes(20)}
    for folder, guide in (("a", first), ("b", one)):
        for _ in range(2):
            with pytest.raises(Reached):
                start(folder, guide)
        others = ("gauss-markov", {"g": dgp.InducingTimes(30)}, {"f_values": first["g"]}, two)
        for other in others:
            with pytest.raises(ValueError, match="another run"):
                start(folder, other)
        for different in (
            {"seed": 1},
            {"particles": 2},
            {"learning_rate": 0.1},
            {"record": bent[:50]},
            {"model": wiener(likelihood=dgp.StudentT())},
        ):
            with pytest.raises(ValueError, match="another run"):
                start(folder, guide, **different)
    # How many processes share the work, and whether bars are shown, changes no number.
    with pytest.raises(Reached):
        start("a", first, workers=2, progress=True)
