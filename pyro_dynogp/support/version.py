"""The version of the package, for all that write it into a file."""

__version__ = "0.1.0"
