"""The page in a browser, on a desk and on a telephone: nothing overflows, nothing hostile runs."""

import pytest

from pyro_dynogp.report.html.page import page
from tests.discrepancy import reports
from tests.report.browser import BROWSER, measured

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium or google-chrome on the PATH")
WIDTHS = (1280, 390)
TELL = "parent.ran.push(1)"
HOSTILE = (
    f"<script>{TELL}</script>",
    f"<img src=x onerror={TELL}>",
    f'"><svg onload="{TELL}"></svg>',
    f"'-{TELL}-'",
    f"</style></title><script>{TELL}</script><b>",
    f'" onmouseover="{TELL}" autofocus onfocus="{TELL}',
    f"<iframe srcdoc='<script>parent.{TELL}</script>'>",
    f"javascript:{TELL}",
    f"&lt;script&gt;{TELL}&lt;/script&gt;",
    f"{{{{{TELL}}}}} ${{{TELL}}} <!--",
    f"]]><marquee onstart={TELL}>",
    "x" * 300,
)


PAGES = {
    "usual": reports.report,
    "nothing missing": reports.nothing,
    "long words": lambda: reports.with_names(
        "a_channel_with_a_name_that_never_ends_" * 6, *["kg*m^2/s^3" * 4] * 2
    ),
}


def check(found, width):
    assert found["width"] <= width
    assert found["wide"] == []
    assert found["cut"] == 0  # tables that are wider can be moved sideways
    assert found["narrow"] == []
    assert found["broken"] == 0
    assert found["tables"] >= 3


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", PAGES)
def test_nothing_overflows_and_no_column_is_narrower_than_eight_characters(name, width):
    check(measured(page(PAGES[name]()), width), width)


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names_are_text(name):
    found = measured(page(reports.with_names(name, name, name)), WIDTHS[1])
    assert found["ran"] == []
    assert found["injected"] == 0
    check(found, WIDTHS[1])


def test_a_script_would_be_seen():
    """Or the test above says nothing."""
    hostile = page(reports.report()).replace("</body>", f"<img src=x onerror={TELL}></body>")
    found = measured(hostile, WIDTHS[1])
    assert found["ran"] == [1]
    hostile = page(reports.report()).replace("</body>", f"<script>{TELL}</script></body>")
    found = measured(hostile, WIDTHS[1])
    assert found["ran"] == [1]
    assert found["injected"] == 1


@pytest.mark.parametrize("width", WIDTHS)
def test_what_overflows_would_be_seen(width):
    wide = page(reports.report()).replace("</body>", '<div style="width:2000px">wide</div></body>')
    assert measured(wide, width)["width"] > width
    narrow = page(reports.report()).replace("min-width: 7rem", "max-width: 1rem")
    assert measured(narrow, width)["narrow"] != []
