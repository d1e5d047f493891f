"""The worked example of docs/structures.md."""

import re
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "structures.md"


def test_a_spring_forecasts_where_a_line_does_not():
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    found: dict = {}
    exec(compile(code, str(PAGE), "exec"), found)
    assert found["errors"]["spring"] < 0.04  # twice the noise
    assert found["errors"]["spring"] < 0.2 * found["errors"]["line"]
