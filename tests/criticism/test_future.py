"""Leave-future-out: which samples a forecast may see, one step ahead and several."""

import numpy as np
import pytest

from pyro_dynogp.criticism.left_out import forecast
from pyro_dynogp.inference.posterior_draws import PosteriorDraws

N, DRAWS = 24, 40


class Recording:
    """A subject whose densities differ from draw to draw; it notes what is left out of fits."""

    def __init__(self, seen, outputs=1, seed=0):
        self.seen, self.outputs, self.seed = seen, outputs, seed

    @property
    def draws(self):
        return PosteriorDraws({}, None, None, np.zeros(DRAWS, dtype=int), "stub")

    @property
    def places(self):
        sample, output = np.divmod(np.arange(N * self.outputs), self.outputs)
        return {"record": 0 * sample, "sample": sample, "output": output}

    def pointwise(self, kind, horizon=1):
        rng = np.random.default_rng([self.seed, horizon])
        return 0.1 * rng.standard_normal((DRAWS, N * self.outputs))

    def without(self, left_out):
        self.seen.append(int((~left_out).sum()))
        assert not left_out[: self.seen[-1]].any()  # the past, and nothing after it
        return Recording(self.seen, self.outputs, seed=len(self.seen))


@pytest.mark.parametrize("horizon", [1, 2, 5])
@pytest.mark.parametrize("outputs", [1, 2])
def test_a_forecast_sees_nothing_within_its_horizon(horizon, outputs):
    """The first forecast is fitted to exactly what comes at least `horizon` samples before it."""
    seen = []
    found = forecast(Recording(seen, outputs), horizon, 10, 1000, False)
    places = found.index // outputs
    assert places[0] == 10 + horizon - 1
    assert seen[0] == 10 * outputs
    assert len(seen) == found.refits


def test_ratios_take_in_what_came_since_and_no_more():
    """With draws that are the same in every fit, weights are those of the samples in between."""
    horizon, density = 3, np.zeros((DRAWS, N))
    density[0] = 0.2  # this draw finds every sample more likely by 0.2 nats

    class Plain(Recording):
        def pointwise(self, kind, horizon=1):
            return density

        def without(self, left_out):
            self.seen.append(int((~left_out).sum()))
            return self

    found = forecast(Plain([]), horizon, 10, 1, False)
    for place, i in enumerate(found.index):
        known = i - horizon + 1 - 10  # samples since the fit
        weight = np.exp(0.2 * known) / (np.exp(0.2 * known) + DRAWS - 1)
        expected = np.log(weight * np.exp(0.2) + 1.0 - weight)
        assert found.elpd[place] == pytest.approx(expected, rel=0.1)
