"""The command line in tests."""

from click.testing import CliRunner

from pyro_dynogp.cli import main


def run(*arguments):
    """What a command printed and how it ended; arguments as text."""
    return CliRunner().invoke(main, list(map(str, arguments)), prog_name="pyro-dynogp")
