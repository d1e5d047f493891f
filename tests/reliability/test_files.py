"""Model files and folders of checkpoints: damaged, foreign, without room, and raced for."""

import dataclasses
import os
import stat
import subprocess
import sys
import threading
import warnings
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Trend
from pyro_dynogp.inference.storage import FORMAT
from pyro_dynogp.support import checkpoints
from pyro_dynogp.support.checkpoints import Checkpoints
from tests.reliability.damage import KINDS, damaged, foreign, outcome, parts_of
from tests.reliability.table import QUICK, World

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def world():
    return World()


@pytest.fixture(scope="module")
def fits(world):
    bent, short = dgp.Wiener(1, pairs=1, inducing=4), world.record[:40]
    few = {"steps": 2, "draws": 5, **QUICK}
    two = short.with_outputs(np.column_stack([short.outputs, short.outputs**2]), names=["y", "z"])
    nuts = dgp.Nuts(chains=1, warmup=2, draws=4)
    delayed = (dgp.Delayed("valve"), Trend(0.0, 2.0))
    stamped = dataclasses.replace(short, start="2024-01-01T00:00:00+01:00", extra={"a": short.time})
    return {
        "map": world.fit,
        "svi": dgp.fit(world.linear, short, method="svi", **few),
        "bent": dgp.fit(bent, short, **few),
        "trajectories": dgp.fit(bent, short, guide="gauss-markov", **few),
        "importance": dgp.fit(world.linear, short, draws=20, **QUICK),
        "nuts": dgp.fit(world.linear, short, method=nuts, **QUICK),
        "two outputs": dgp.fit(dgp.LinearDynamicGP(1, outputs=2, pairs=1), two, **MODE),
        "two records": dgp.fit(world.linear, (short[:25], short[25:]), **MODE),
        "integrators": dgp.fit(dgp.LinearDynamicGP(1, pairs=1, integrators=1), short, **MODE),
        "Student's t": dgp.fit(
            dgp.LinearDynamicGP(1, pairs=1, likelihood=dgp.StudentT(4.0)), short, **MODE
        ),
        "varying noise": dgp.fit(
            dgp.LinearDynamicGP(1, pairs=1, likelihood=dgp.Heteroscedastic()), short, **MODE
        ),
        "channels": dgp.fit(
            dgp.LinearDynamicGP(2, pairs=1, direct=1, channels=delayed), stamped, **MODE
        ),
        "Hammerstein": dgp.fit(dgp.Hammerstein(1, pairs=1, inducing=4), short, **MODE),
        "Wiener-Hammerstein": dgp.fit(
            dgp.WienerHammerstein(1, pairs=1, inducing=4), short, **MODE
        ),
        "Hammerstein-Wiener": dgp.fit(
            dgp.HammersteinWiener(1, pairs=1, inducing=4), short, **MODE
        ),
        "branches": dgp.fit(
            dgp.ParallelWienerHammerstein(1, pairs=1, inducing=4), short, **MODE
        ),
        "feedback": dgp.fit(dgp.NonlinearFeedback(1, pairs=1, inducing=4), short, **MODE),
    }  # fmt: skip


# Those that are damaged more often.
EARLY = ("map", "svi", "bent", "trajectories")
MODE = {"method": "map", "steps": 2, **QUICK}
KINDS_OF_FITS = (
    "map", "svi", "bent", "trajectories", "importance", "nuts", "two outputs", "two records",
    "integrators", "Student's t", "varying noise", "channels", "Hammerstein", "Wiener-Hammerstein",
    "Hammerstein-Wiener", "branches", "feedback",
)  # fmt: skip


def test_all_kinds_are_tried(fits):
    assert set(fits) == set(KINDS_OF_FITS)


@pytest.mark.parametrize("name", KINDS_OF_FITS)
def test_damaged_files_are_refused_or_hold_the_same(name, fits, tmp_path):
    """A flipped bit in the names of the format's own header may change nothing that is read."""
    path = tmp_path / "fit.safetensors"
    fits[name].save(path)
    whole, generator, found = path.read_bytes(), np.random.default_rng(0), Counter()
    for turn in range(70 if name in EARLY else 28):
        path.write_bytes(damaged(whole, KINDS[turn % len(KINDS)], generator))
        found[outcome(path, fits[name])] += 1
    assert set(found) <= {"refused", "same"}, found
    assert found["refused"] >= (60 if name in EARLY else 22)


@pytest.mark.parametrize("name", KINDS_OF_FITS)
def test_what_nobody_wrote_never_crashes(name, fits, tmp_path):
    """With a right digest: what is no sense is refused, what makes sense is another fit."""
    path, other = tmp_path / "fit.safetensors", tmp_path / "other.safetensors"
    fits[name].save(path)
    generator = np.random.default_rng(1)
    for _ in range(60 if name in EARLY else 20):
        told = foreign(path, generator, other)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what a changed file warns of is no matter here
            assert outcome(other, fits[name]) in ("refused", "same", "another"), told


def test_every_number_is_under_the_digest(fits, tmp_path):
    path = tmp_path / "fit.safetensors"
    fits["map"].save(path)
    whole = path.read_bytes()
    _, tensors = parts_of(path)
    value = tensors["draws/noise_sd"].numpy().tobytes()
    at = whole.rindex(value)
    path.write_bytes(whole[: at + 6] + bytes([whole[at + 6] ^ 8]) + whole[at + 7 :])
    with pytest.raises(ValueError, match=r"fit\.safetensors.*is not what was written"):
        dgp.load(path)


def test_files_of_before_load_with_a_warning_and_are_checked(fits, tmp_path, monkeypatch):
    path = tmp_path / "old.safetensors"

    def without_digest(fit, change):
        header, tensors = parts_of(path)
        header["version"] = 5
        change(tensors)
        from safetensors.torch import save_file

        save_file(tensors, str(path), metadata={"pyro_dynogp.fit": checkpoints.json.dumps(header)})

    fit = fits["map"]
    fit.save(path)
    without_digest(fit, lambda tensors: None)
    with pytest.warns(UserWarning, match="written before files had a digest"):
        assert torch.equal(dgp.load(path).mode["noise_sd"], fit.mode["noise_sd"])
    for change in (
        lambda tensors: tensors.pop("mode/offset"),
        lambda tensors: tensors.update({"draws/offset": torch.full((1, 1), torch.nan).double()}),
        lambda tensors: tensors.update({"draws/offset": torch.zeros(1, 2).double()}),
    ):
        fit.save(path)
        without_digest(fit, change)
        with (
            pytest.warns(UserWarning, match="digest"),
            pytest.raises(ValueError, match="incomplete or damaged"),
        ):
            dgp.load(path)


def test_a_version_of_today_has_its_digest(fits, tmp_path):
    """Else a flipped bit in the digest's own name would do away with it."""
    path = tmp_path / "fit.safetensors"
    fits["map"].save(path)
    path.write_bytes(path.read_bytes().replace(b"pyro_dynogp.sha256", b"pyro_dynogp.sha257"))
    with pytest.raises(ValueError, match="no digest"):
        dgp.load(path)


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o027])
def test_files_are_readable_to_whom_the_mask_says(mask, fits, tmp_path):
    before = os.umask(mask)
    try:
        fits["map"].save(tmp_path / "fit.safetensors")
        Checkpoints.at(tmp_path / "kept", model=1).piece("a", lambda: {"x": torch.zeros(1)})
    finally:
        os.umask(before)
    for path in (tmp_path / "fit.safetensors", *(tmp_path / "kept").iterdir()):
        assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~mask


def test_a_failed_save_leaves_the_file_that_was_there(fits, tmp_path, monkeypatch):
    path = tmp_path / "fit.safetensors"
    fits["map"].save(path)
    whole = path.read_bytes()

    def half(tensors, path, metadata):
        Path(path).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoints, "save_file", half)
    with pytest.raises(ValueError, match=r"path: expected .*No space left on device"):
        fits["svi"].save(path)
    assert path.read_bytes() == whole
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


LOADED = """
import json, resource, sys, warnings
from pathlib import Path
import pyro_dynogp as dgp

warnings.simplefilter("ignore")  # memory alone is looked at

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

for small in Path(sys.argv[1]).glob("small*"):  # all that is imported and compiled for loading
    try:
        dgp.load(small)
    except ValueError:
        pass
before = peak()
try:
    dgp.load(sys.argv[2])
    ended = "loaded"
except ValueError as error:
    ended = "refused"
print(json.dumps([ended, peak() - before]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="peaks of memory in units of Linux")
@pytest.mark.parametrize("kind", ["whole", "long record", *KINDS])
def test_memory_is_twice_the_size_at_most(kind, fits, tmp_path):
    """Most memory that a process had more than before, for a file of 16 MB."""
    small, large = tmp_path / "small.safetensors", tmp_path / "large.safetensors"
    fits["svi"].save(small)
    header, tensors = parts_of(small)
    if kind == "long record":
        n = 600_000
        fresh = {"time": torch.arange(n), "inputs": torch.rand(n, 1), "outputs": torch.rand(n, 1)}
        tensors |= {f"record/0/{name}": value.double() for name, value in fresh.items()}
    else:
        draws = {k: v for k, v in tensors.items() if k.startswith("draws/")}
        tensors |= {k: v[:1].repeat(200_000, *[1] * (v.dim() - 1)) for k, v in draws.items()}
    checkpoints.write_tensors(large, tensors, {FORMAT: checkpoints.json.dumps(header)})
    size = large.stat().st_size
    generator = np.random.default_rng(3)
    if kind in KINDS:
        (tmp_path / "small-2.safetensors").write_bytes(
            damaged(small.read_bytes(), kind, np.random.default_rng(3))
        )
        large.write_bytes(damaged(large.read_bytes(), kind, generator))
    command = [sys.executable, "-c", LOADED, str(tmp_path), str(large)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    ended, more = checkpoints.json.loads(run.stdout)
    assert ended == ("refused" if kind in KINDS else "loaded")
    assert 14e6 < size < 22e6
    assert more <= 2.0 * max(size, large.stat().st_size) + ROOM


# Bytes that a process takes beside, as for what imports keep.
ROOM = 4e6


def ended(call):
    """What a call returns, and what the ValueError says in which it ends."""
    try:
        return call(), None
    except ValueError as error:
        return None, str(error)


class Reached(Exception):  # noqa: N818
    """The folder was accepted; nothing need be fitted."""


def stop(*_):
    raise Reached


class TestFolders:
    def test_one_of_several_that_race_for_a_new_folder_has_it(self, tmp_path):
        def begin(turn, number, barrier):
            barrier.wait()
            try:
                Checkpoints.at(tmp_path / str(turn), model=number)
            except ValueError as error:
                return str(error)
            return None

        for turn in range(20):
            barrier = threading.Barrier(4)
            with ThreadPoolExecutor(4) as pool:
                asked = [pool.submit(begin, turn, number, barrier) for number in range(4)]
                refused = [one.result() for one in asked if one.result() is not None]
            assert len(refused) == 3
            assert all("another model" in text for text in refused)
            assert [path.name for path in (tmp_path / str(turn)).iterdir()] == ["run.json"]

    @pytest.mark.parametrize("text", ["", "{", "[]", '{"other": 1}', "\x00", '"text"'])
    def test_a_note_that_cannot_be_read_ends_in_a_sentence(self, text, tmp_path):
        (tmp_path / "run.json").write_text(text)
        with pytest.raises(ValueError, match=r"checkpoint: expected a note .*Remove the folder"):
            Checkpoints.at(tmp_path, model=1)

    def test_parts_of_processes_that_are_gone_are_removed(self, tmp_path):
        with subprocess.Popen([sys.executable, "-c", ""]) as gone:
            gone.wait()
        stale = tmp_path / f"a.safetensors.{checkpoints.HOST}-{gone.pid}-0a.part"
        live = tmp_path / f"a.safetensors.{checkpoints.HOST}-{os.getpid()}-0b.part"
        elsewhere = tmp_path / "a.safetensors.elsewhere-1-0c.part"
        for path in (stale, live, elsewhere):
            path.touch()
        Checkpoints.at(tmp_path, model=1)
        assert not stale.exists()
        assert live.exists()
        assert elsewhere.exists()

    @pytest.mark.parametrize(
        ("name", "change"),
        [
            ("model", {"model": "dgp.Wiener(1, pairs=1, inducing=4, kernel=matern(2.5))"}),
            ("method", {"method": "dgp.Trajectories(guide(2.0), draws=5)"}),
            ("seed", {"seed": "1"}),
            ("record", {"record": "record[:39]"}),
        ],
    )
    def test_what_differs_is_named(self, name, change, world, tmp_path, monkeypatch):
        """The setting of a kernel and what a guide's closure holds are not in any `repr`."""
        import gpytorch

        def guide(scale):
            return lambda records: scale

        names = {
            "dgp": dgp, "matern": gpytorch.kernels.MaternKernel, "guide": guide,
            "record": world.record[:40],
        }  # fmt: skip
        given = {
            "model": "dgp.Wiener(1, pairs=1, inducing=4, kernel=matern(0.5))",
            "method": "dgp.Trajectories(guide(1.0), draws=5)", "seed": "0", "record": "record",
        }  # fmt: skip
        monkeypatch.setattr(dgp.Trajectories, "__call__", stop)

        def begin(texts):
            options = {key: eval(text, names) for key, text in texts.items()}
            dgp.fit(**options, checkpoint=tmp_path, progress=False)

        for _ in range(2):
            with pytest.raises(Reached):
                begin(given)
        with pytest.raises(ValueError, match=rf"holds another run \(another {name}\)"):
            begin({**given, **change})

    def test_damaged_pieces_are_refused_or_hold_the_same(self, tmp_path):
        kept = Checkpoints.at(tmp_path, model=1)
        made = {"x": torch.arange(40.0), "y": torch.zeros(0)}
        kept.piece("a", lambda: made)
        path, generator, found = tmp_path / "a.safetensors", np.random.default_rng(0), Counter()
        whole = path.read_bytes()
        for turn in range(210):
            path.write_bytes(damaged(whole, KINDS[turn % len(KINDS)], generator))
            piece, said = ended(lambda: kept.piece("a", dict))
            if said is None:
                assert torch.equal(piece["x"], made["x"])
                found["same"] += 1
            else:
                assert said.startswith(f"checkpoint: {path} is ")
                assert "Remove it: what it holds is computed again." in said
                found["refused"] += 1
        assert found["refused"] > 180, found

    @pytest.mark.parametrize("kind", KINDS)
    def test_damaged_notes_end_in_a_sentence(self, kind, tmp_path):
        Checkpoints.at(tmp_path, model=1)
        note, generator = tmp_path / "run.json", np.random.default_rng(0)
        whole = note.read_bytes()
        for _ in range(30):
            note.write_bytes(damaged(whole, kind, generator))
            _, said = ended(lambda: Checkpoints.at(tmp_path, model=1))
            assert said is None or said.startswith("checkpoint: expected ")

    def test_pieces_that_changed_places_are_refused(self, tmp_path):
        """Each is whole: only its name, or its folder, says that it is another."""
        one, other = (Checkpoints.at(tmp_path / str(k), model=k) for k in range(2))
        for kept in (one, other):
            kept.piece("a", lambda: {"x": torch.zeros(1)})
            kept.piece("b", lambda: {"x": torch.ones(1)})
        a, b = (tmp_path / "0" / f"{name}.safetensors" for name in "ab")
        before = a.read_bytes()
        for foreign_piece in (b.read_bytes(), (tmp_path / "1" / a.name).read_bytes()):
            a.write_bytes(foreign_piece)
            with pytest.raises(ValueError, match=r"a\.safetensors is another piece, or"):
                one.piece("a", lambda: {})
        a.write_bytes(before)
        assert float(one.piece("a", lambda: {})["x"]) == 0.0

    def test_versions_are_told_apart(self, tmp_path, monkeypatch):
        Checkpoints.at(tmp_path, model=1)
        monkeypatch.setattr(checkpoints, "versions", lambda: ["torch 99"])
        with pytest.raises(ValueError, match="another versions"):
            Checkpoints.at(tmp_path, model=1)

    def test_without_room_all_that_is_finished_is_kept(self, tmp_path):
        """The largest file of a process is limited, as a disk that is full limits it."""
        code = (
            "import resource, sys, torch; sys.path.insert(0, sys.argv[1])\n"
            "from pyro_dynogp.support.checkpoints import Checkpoints\n"
            "kept = Checkpoints.at(sys.argv[2], model=1)\n"
            "kept.piece('small', lambda: {'x': torch.zeros(8)})\n"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
            "kept.piece('large', lambda: {'x': torch.zeros(4096)})\n"
        )
        command = [sys.executable, "-c", code, str(ROOT), str(tmp_path)]
        ended = subprocess.run(command, capture_output=True, text=True)
        last = ended.stderr.strip().splitlines()[-1]
        assert last.startswith("OSError: ")
        assert f"checkpoint: {tmp_path} cannot be written to" in last
        assert {path.name for path in tmp_path.iterdir()} == {"run.json", "small.safetensors"}

    def test_a_folder_that_cannot_be_written_to_ends_in_a_sentence_before_any_work(self):
        with pytest.raises(OSError, match="checkpoint: /proc/here cannot be written to"):
            Checkpoints.at("/proc/here", model=1)
