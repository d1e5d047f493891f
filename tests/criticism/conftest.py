"""Fits that criticism is tried on."""

import pytest

from tests.inference.cascades import wiener_record


@pytest.fixture(scope="session")
def bent():
    return wiener_record()
