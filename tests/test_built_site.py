"""What `make docs` would find wrong with a site."""

import pytest

from tests import pages
from tests.built_site import faults, main

TUTORIAL = '<h1 id="top">One</h1><a href="../index.html#there">x</a><img src="picture.png">'
INDEX = (
    '<h1 id="there">Two</h1><a href="https://example.org">x</a><a href="tutorials/{}.html">y</a>'
)


@pytest.fixture
def site(tmp_path):
    (tmp_path / "tutorials").mkdir()
    (tmp_path / "tutorials" / "picture.png").touch()
    for notebook in pages.NOTEBOOKS:
        (tmp_path / "tutorials" / f"{notebook.stem}.html").write_text(TUTORIAL)
    (tmp_path / "index.html").write_text(INDEX.format(pages.NOTEBOOKS[0].stem))
    return tmp_path


def test_a_site_that_is_right(site):
    assert list(faults(site)) == []
    assert main(str(site)) == 0


@pytest.mark.parametrize(
    ("added", "fault"),
    {
        '<a href="gone.html">x</a>': "dead link gone.html",
        '<img src="gone.png">': "dead link gone.png",
        '<a href="#gone">x</a>': "no place #gone",
        '<a href="../index.html#gone">x</a>': "no place ../index.html#gone",
        '<script src="https://example.org/x.js"></script>': "needs a network for https://example",
        "<pre>x.py:1: RuntimeWarning: divide</pre>": "RuntimeWarning",
    }.items(),
)
def test_faults(added, fault, site, capsys):
    (site / "tutorials" / f"{pages.NOTEBOOKS[0].stem}.html").write_text(TUTORIAL + added)
    (found,) = faults(site)
    assert fault in found
    assert main(str(site)) == 1
    assert fault in capsys.readouterr().out


def test_tutorials_that_were_not_executed(site):
    (site / "tutorials" / f"{pages.NOTEBOOKS[-1].stem}.html").write_text("<h1>One</h1>")
    assert list(faults(site)) == [f"{pages.NOTEBOOKS[-1].stem}: a tutorial without pictures"]
