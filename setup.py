"""The description on a package index: the README without pictures and links of the repository.

A package index resolves neither; everything else about the package is in pyproject.toml.
"""

import re
from pathlib import Path

from setuptools import setup

# A paragraph that is a picture, and the caption under it.
PICTURE = re.compile(r"!\[[^\]]*\]\((?!https?:)[^)]*\)\n\n(\*[^*]+\*\n\n)?")
LINK = re.compile(r"\[([^\]]*)\]\((?!https?:)[^)]*\)")


def description(readme: str) -> str:
    """Text of the README that stands alone."""
    return LINK.sub(r"\1", PICTURE.sub("", readme))


if __name__ == "__main__":
    readme = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
    setup(long_description=description(readme), long_description_content_type="text/markdown")
