"""The command line as ``python -m pyro_dynogp``."""

from pyro_dynogp.cli import main

if __name__ == "__main__":
    main(prog_name="python -m pyro_dynogp")
