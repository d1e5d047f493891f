"""Source and binary distributions, built, installed into a clean environment and used there.

What a newcomer does: README, notebooks, the shell from a CSV file to a page. All of it without a
warning.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import tempfile
import time
import venv
import zipfile
from pathlib import Path

from tests import pages
from tests.benchmarks.markdown import table

TYPED = """
import pyro_dynogp as dgp

reveal_type(dgp.fit)
reveal_type(dgp.Record)
"""
USE = """
import importlib.resources, json, sys
import pyro_dynogp as dgp
assert (importlib.resources.files("pyro_dynogp") / "py.typed").is_file()
assert sys.argv[1] not in dgp.__file__, dgp.__file__
names = {}
for code in json.load(open("blocks.json")):
    exec(code, names)
"""

COLUMNS = ("gas_furnace.csv", "--input", "InputGasRate", "--output", "CO2", "--time", "time")
SHELL = {
    "a shipped record as a CSV file": ("example", "gas_furnace"),
    "from a CSV file to figures": (
        "fit", *COLUMNS, "--pairs", "1", "--train", "200", "--figures", "figures", "--quiet",
        "--save", "furnace.safetensors",
    ),
    "a forecast": (
        "forecast", "furnace.safetensors", "gas_furnace.csv", "--time", "time", "--past", "200",
        "--out", "forecast.csv",
    ),
    "a check": ("check", "furnace.safetensors", "--quiet"),
    "from a CSV file to the page": (
        "close-loop", *COLUMNS, "--pairs", "1", "--max-rounds", "1", "--out", "report", "--quiet",
    ),
}  # fmt: skip
WRITTEN = ("figures/forecast.png", "forecast.csv", "report/report.html")
# Executes a notebook as it is; bars are widgets, so that nothing is left on the error stream.
NOTEBOOK = """
import sys, nbformat
from nbclient import NotebookClient
book = nbformat.read(sys.argv[1], as_version=4)
NotebookClient(book, timeout=1200, extra_arguments=["--log-level=40"]).execute()
outputs = [out for cell in book.cells for out in cell.get("outputs", [])]
errors = [out["text"] for out in outputs if out.get("name") == "stderr"]
assert not errors, errors
assert any("image/png" in out.get("data", {}) for out in outputs)
"""
LINK = re.compile(r"\]\((?!https?:)([^)]*)\)")


def call(*command: str | Path, cwd: Path | None = None) -> str:
    """Run a command that sees no other Python; its output, also where it fails."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, text=True, env=clean,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, command))}\n{done.stdout}")
    return done.stdout


def description(wheel: Path) -> str:
    """What a package index shows of a wheel."""
    with zipfile.ZipFile(wheel) as files:
        (name,) = (name for name in files.namelist() if name.endswith(".dist-info/METADATA"))
        return files.read(name).decode()


def run(folder: Path) -> str:
    """Seconds of each step; an error where one fails or warns. It needs a package index."""
    rows: list[list[str]] = []

    def step(name: str, *command: str | Path, cwd: Path) -> str:
        begin = time.perf_counter()
        text = call(*command, cwd=cwd)
        rows.append([name, f"{time.perf_counter() - begin:.0f}"])
        print(f"{name}: {rows[-1][1]} s", flush=True)
        if "pip" not in command and "Warning:" in text:  # pip's are about the machine
            raise RuntimeError(f"{name}\n{text}")
        return text

    with tempfile.TemporaryDirectory() as base:
        there = Path(base)
        venv.create(there / "build", with_pip=True)
        venv.create(there / "use", with_pip=True)
        builder, python = there / "build" / "bin" / "python", there / "use" / "bin" / "python"
        pip = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check")
        step("install the builder", builder, *pip, "build", "twine", cwd=there)
        dist = there / "dist"
        # The wheel is built from the source distribution, not from the checkout.
        step("build sdist and wheel", builder, "-m", "build", "--outdir", dist, cwd=pages.ROOT)
        (sdist,), (wheel,) = dist.glob("*.tar.gz"), dist.glob("*.whl")
        step("twine check", builder, "-m", "twine", "check", "--strict", sdist, wheel, cwd=there)
        dead = LINK.findall(description(wheel))
        assert not dead, f"links of the description that lead nowhere: {dead}"
        pins = ("-c", pages.ROOT / "constraints.txt")
        step("install the wheel", python, *pip, *pins, f"{wheel}[notebooks]", cwd=there)
        step("pip check", python, "-m", "pip", "check", cwd=there)
        code = [code for code, _ in pages.blocks(pages.README)]
        (there / "blocks.json").write_text(json.dumps(code))
        (there / "use.py").write_text(USE)
        command = there / "use" / "bin" / "pyro-dynogp"
        step("pyro-dynogp compile", command, "compile", "--quiet", cwd=there)
        step("blocks of the README", python, "use.py", pages.ROOT, cwd=there)
        for name, arguments in SHELL.items():
            step(name, command, *arguments, cwd=there)
        for name in WRITTEN:
            assert (there / name).is_file(), name
        (there / "notebook.py").write_text(NOTEBOOK)
        for notebook in pages.NOTEBOOKS:
            step(f"notebook {notebook.stem}", python, "notebook.py", notebook, cwd=there)
        step("install mypy", python, *pip, *pins, "mypy", cwd=there)
        (there / "typed.py").write_text(TYPED)
        typed = (python, "-m", "mypy", "typed.py")
        seen = [step("types of the wheel", *typed, cwd=there)]
        step("editable install", python, *pip, "--no-deps", "-e", pages.ROOT, cwd=there)
        seen.append(step("types of an editable install", *typed, cwd=there))
        assert all("pyro_dynogp.models.model.Model" in types for types in seen), seen
        sizes = [f"{path.name}: {path.stat().st_size / 1e6:.2f} MB" for path in (sdist, wheel)]
    return table(["step", "seconds"], rows) + "\n\n" + "; ".join(sizes)


if __name__ == "__main__":
    print(run(Path()).splitlines()[-1])
