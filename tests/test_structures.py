"""The worked examples of docs/structures.md."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "structures.md"


@pytest.fixture(scope="module")
def found():
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        exec(compile(code, str(PAGE), "exec"), names)
    return names


def test_a_spring_forecasts_where_a_line_does_not(found):
    assert found["errors"]["spring"] < 0.04  # twice the noise
    assert found["errors"]["spring"] < 0.2 * found["errors"]["line"]


def test_a_hidden_signal_forecasts_within_the_noise(found):
    assert found["errors"]["hidden"] < 0.018  # the noise is 0.02


def test_known_functions_forecast_near_the_noise(found):
    assert found["errors"]["friction"] < 0.03
    assert found["errors"]["tank"] < 0.01
    width = found["width"]
    assert abs(float(width.mean()) - 0.1) < 4.0 * float(width.std())


def test_two_branches_forecast_within_the_noise(found):
    assert found["errors"]["branches"] < 0.05
