"""Imports run one way: no circle between modules, no arrow from a room to one above it.

The arrows are read from the syntax trees: imports inside functions and those for type checkers
count like all others.
"""

import ast
import re
import tomllib
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = "pyro_dynogp"

# Arrows that run upwards today, each with its reason. An arrow that is gone has to leave the list.
UPWARD: dict[tuple[str, str], str] = {}
# Arrows that close a circle inside one room.
WITHIN: dict[tuple[str, str], str] = {}


def contract():
    """The layers of the contract in pyproject.toml, highest first, each a list of rooms."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    (rooms,) = (c for c in settings["contracts"] if c["id"] == "rooms")
    return [re.findall(r"\w+", layer) for layer in rooms["layers"]], rooms.get("ignore_imports", [])


def arrows_of(sources):
    """Module -> modules that it imports, all without the name of the package ("" is its root).

    Args:
        sources: name of a module without that of the package -> its source.
    """
    arrows = defaultdict(set)
    for module, source in sources.items():
        for node in ast.walk(ast.parse(source)):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, f"{module}: relative import, line {node.lineno}"
                deep = [f"{node.module}.{alias.name}" for alias in node.names]
                names = [
                    n if n.removeprefix(f"{PACKAGE}.") in sources else node.module for n in deep
                ]
            for name in names:
                if name.split(".")[0] == PACKAGE:
                    arrows[module].add(name.removeprefix(PACKAGE).removeprefix("."))
    return {module: targets - {module} for module, targets in arrows.items()}


def sources():
    found = {}
    for path in (ROOT / PACKAGE).rglob("*.py"):
        parts = path.relative_to(ROOT / PACKAGE).with_suffix("").parts
        if parts == ("__main__",):  # calls the command line, and nothing imports it
            continue
        found[".".join(p for p in parts if p != "__init__")] = path.read_text()
    return found


def circles(arrows):
    """Groups of modules from each of which an import leads to each other one (Tarjan)."""
    index, low, stack, groups = {}, {}, [], []

    def visit(module):
        index[module] = low[module] = len(index)
        stack.append(module)
        for target in sorted(arrows.get(module, ())):
            if target not in index:
                visit(target)
                low[module] = min(low[module], low[target])
            elif target in stack:
                low[module] = min(low[module], index[target])
        if low[module] == index[module]:
            k = stack.index(module)
            groups.append(sorted(stack[k:]))
            del stack[k:]

    for module in sorted(arrows):
        if module not in index:
            visit(module)
    return [group for group in groups if len(group) > 1]


def upward(arrows, layers):
    """Arrows from one room to another that is not below it; the root stands under the commands."""
    floor = {room: i for i, layer in enumerate(layers) for room in layer}
    floor[""] = 0.5
    pairs = [(a, b) for a, targets in arrows.items() for b in targets]
    rooms = {(a, b): (a.split(".")[0], b.split(".")[0]) for a, b in pairs}
    return {pair for pair, (a, b) in rooms.items() if a != b and floor[b] <= floor[a]}


@pytest.fixture(scope="module")
def arrows():
    return arrows_of(sources())


def test_every_room_has_its_floor():
    layers, _ = contract()
    rooms = {name.split(".")[0] for name in sources()} - {""}
    assert rooms - {room for layer in layers for room in layer} == set()


def test_no_arrow_runs_upwards(arrows):
    assert upward(arrows, contract()[0]) == set(UPWARD)


def test_no_circles(arrows):
    allowed = {*UPWARD, *WITHIN}
    others = {a: {b for b in targets if (a, b) not in allowed} for a, targets in arrows.items()}
    assert circles(others) == []


@pytest.mark.parametrize("arrow", WITHIN)
def test_a_circle_that_is_gone_leaves_the_list(arrows, arrow):
    a, b = arrow
    assert b in arrows[a]
    assert any({a, b} <= set(group) for group in circles(arrows))


def test_the_contract_ignores_what_is_allowed_here():
    _, ignored = contract()
    arrows = [arrow.replace(f"{PACKAGE}.", "").split(" -> ") for arrow in ignored]
    for a, b in UPWARD:
        assert any(a == x and re.fullmatch(y.replace("*", r"\w+"), b) for x, y in arrows)
    assert len(arrows) <= len(UPWARD)


class TestTheChecksNotice:
    def test_a_circle_of_late_imports(self):
        made = {"a": f"def f():\n    import {PACKAGE}.b", "b": f"from {PACKAGE} import c", "c": ""}
        assert circles(arrows_of(made)) == []
        made["c"] = f"if TYPE_CHECKING:\n    from {PACKAGE}.a import x"
        assert circles(arrows_of(made)) == [["a", "b", "c"]]

    def test_arrows_up_and_sideways(self):
        made = {"low.x": f"from {PACKAGE}.top.y import z", "top.y": f"import {PACKAGE}.low.x"}
        made["other.z"] = f"import {PACKAGE}.low.x"
        found = upward(arrows_of(made), [["top"], ["low", "other"]])
        assert found == {("low.x", "top.y"), ("other.z", "low.x")}


def test_the_page_lists_the_rooms_of_the_contract():
    text = (ROOT / "docs" / "architecture.md").read_text()
    section = text.split("## The rooms, highest first")[1].split("\n`support`")[0]
    heads = [item.split(":")[0] for item in section.split("\n- ")[1:]]
    assert [re.findall(r"`(\w+)`", head) for head in heads] == contract()[0]


def test_the_code_of_the_page_runs():
    (code,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "architecture.md").read_text(), re.S
    )
    names = {}
    exec(code, names)
    assert names["rational"].denominator.shape[-1] == 3
