"""Source and binary distributions, built, installed into a clean environment and used there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import venv
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

CSV = """
import pyro_dynogp as dgp
dgp.datasets.load("gas_furnace").full.to_frame().to_csv("furnace.csv")
"""
COLUMNS = ("furnace.csv", "--input", "InputGasRate", "--output", "CO2", "--time", "time")
SHELL = {
    "from a CSV file to figures": ("fit", *COLUMNS, "--train", "200", "--figures", "figures"),
    "from a CSV file to the page": ("close-loop", *COLUMNS, "--max-rounds", "1", "--out", "report"),
}


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


def run(folder: Path) -> str:
    """Seconds of each step; an error where one fails. It needs a package index."""
    rows: list[list[str]] = []

    def step(name: str, *command: str | Path, cwd: Path) -> str:
        begin = time.perf_counter()
        text = call(*command, cwd=cwd)
        rows.append([name, f"{time.perf_counter() - begin:.0f}"])
        return text

    with tempfile.TemporaryDirectory() as base:
        there = Path(base)
        venv.create(there / "build", with_pip=True)
        venv.create(there / "use", with_pip=True)
        builder, python = there / "build" / "bin" / "python", there / "use" / "bin" / "python"
        pip = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check")
        step("install the builder", builder, *pip, "build", cwd=there)
        dist = there / "dist"
        # The wheel is built from the source distribution, not from the checkout.
        step("build sdist and wheel", builder, "-m", "build", "--outdir", dist, cwd=pages.ROOT)
        (sdist,), (wheel,) = dist.glob("*.tar.gz"), dist.glob("*.whl")
        pins = ("-c", pages.ROOT / "constraints.txt")
        step("install the wheel", python, *pip, *pins, wheel, cwd=there)
        step("pip check", python, "-m", "pip", "check", cwd=there)
        code = [code for code, _ in pages.blocks(pages.README)]
        (there / "blocks.json").write_text(json.dumps(code))
        (there / "use.py").write_text(USE)
        command = there / "use" / "bin" / "pyro-dynogp"
        step("pyro-dynogp compile", command, "compile", "--quiet", cwd=there)
        step("blocks of the README", python, "use.py", pages.ROOT, cwd=there)
        call(python, "-c", CSV, cwd=there)
        for name, arguments in SHELL.items():
            step(name, command, *arguments, "--pairs", "1", "--quiet", cwd=there)
        assert any((there / "figures").glob("*.png"))
        assert (there / "report" / "report.html").is_file()
        step("install mypy", python, *pip, *pins, "mypy", cwd=there)
        (there / "typed.py").write_text(TYPED)
        seen = step("types of the wheel", python, "-m", "mypy", "typed.py", cwd=there)
        assert "pyro_dynogp.models.model.Model" in seen, seen
        sizes = [f"{path.name}: {path.stat().st_size / 1e6:.2f} MB" for path in (sdist, wheel)]
    return table(["step", "seconds"], rows) + "\n\n" + "; ".join(sizes)


if __name__ == "__main__":
    print(run(Path()))
    sys.exit(0)
