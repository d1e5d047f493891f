"""Records that tests of several effects share."""

import pytest

from tests.effects.springs import spring_record


@pytest.fixture(scope="session")
def spring():
    return spring_record()
