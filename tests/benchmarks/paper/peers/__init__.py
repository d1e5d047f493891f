"""Other methods on the paper's tasks; each imports its own package only when it is called."""

from __future__ import annotations

from collections.abc import Callable

from tests.benchmarks.paper.peers import deep_gp, dynonet_peer, gp_narx, narmax
from tests.benchmarks.paper.prediction import Outcome, Task

PEERS: dict[str, Callable[[Task], Outcome]] = {
    "dynoNet": dynonet_peer.predict,
    "GP-NARX": gp_narx.predict,
    "NARMAX": narmax.predict,
    "deep GP": deep_gp.predict,
}
