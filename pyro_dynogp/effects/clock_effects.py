"""A clock that is wrong in part of the record: daylight saving, a changed logger, a moved file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pyro_dynogp.data.signals import shifted
from pyro_dynogp.effects.clocks import all_zones, clock_shares, in_zone
from pyro_dynogp.statistics.bootstrap import (
    Prepare,
    Score,
    log_ratio,
    projector,
    replicates,
    sieve,
    solved,
    spanning,
)
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.shares_of_inputs import check_inputs
from pyro_dynogp.statistics.time_pictures import instant, over_time
from pyro_dynogp.statistics.whitening import Whitener
from pyro_dynogp.support.errors import invalid

# Shifts that are tried [steps], both ways; and one hour where there are stamps.
SHIFTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
# Shifts of the whole record, which are none of the clock's, together with their sums [steps].
WHOLE = (-4, -2, -1, 0, 1, 2, 4)
# Instants of change on the first pass, and the share of the record kept on either side.
INSTANTS, END = 60, 0.05
# Channels of the largest share that are tried.
CHANNELS = 6
# A rule has no instant to choose: it wins unless another instant is this much better [nats]; so
# do summers beside winters.
PREFERENCE = 3.0


@dataclass(frozen=True, eq=False)
class Shifts:
    """All shifts of all channels.

    Attributes:
        changes: (n, J) what each shift adds to the mean where it holds [output].
        shifts: (J,) [time unit]. channels: (J,) index of a share.
        edges: (I,) samples at which a shift may begin, to last to the end.
        parts: (P, n) where rules of daylight saving have their hour, or do not have it.
    """

    changes: np.ndarray
    shifts: np.ndarray
    channels: np.ndarray
    edges: np.ndarray
    parts: np.ndarray

    def effect(self, variant: int) -> np.ndarray:
        """What a variant adds to the mean (n,): first all parts, then all edges."""
        place, j = divmod(variant, self.changes.shape[1])
        if place < len(self.parts):
            return self.parts[place] * self.changes[:, j]
        at = self.edges[place - len(self.parts)]
        return np.where(np.arange(len(self.changes)) >= at, self.changes[:, j], 0.0)


def clock_shift(residuals: Residuals, *, zones: Sequence[str] = (), seed: int = 0) -> Evidence:
    """An input's time stamps that are off by a constant in part of the record.

    Where they are, the output has the input's share of the mean at another time: s(t + shift) in
    place of s(t). Tried are shifts from a change at any instant to the end, and, with stamps, in
    the summers or the winters of the zones given and of the stamps' own (winters, where the model
    was fitted to a summer, whose hour it takes for right). The effect has no free size, which is
    what tells a shift from a change of gain. Inputs that are functions of the time of day or week
    are one clock, whose share is what the mean repeats.

    Args:
        residuals: of one output (n,).
        zones: IANA names of time zones whose daylight saving is tried.
        seed: of the replicates.

    Returns:
        where: channel (of several clocks the first), shift [time unit] (above zero: what the
        channel says at t + shift belongs to t, it is recorded too late), time of the (first) change
        [time unit], and rule (the zone whose daylight saving it follows) with season ("summers" or
        "winters": when the channel is off) where one fits as well as any instant.

    Raises:
        ValueError: where fewer than 30 samples are measured, there is no input that acts on the
            mean, or a zone is unknown.

    Source: likelihood ratio with an unknown instant of change, as Andrews, Econometrica 61(4):821
    (1993), in the whitened residual; the null by `sieve`.
    """
    r = residuals
    check_inputs(r)
    names, shares = clock_shares(r, zones, CHANNELS)
    if not names:
        raise invalid("residuals", expected="an input that acts on the mean", got="none")
    rules, parts = _rules(r, zones)
    tried = _tried(r, shares, parts)
    # A shift of the whole record is a dead time, and a wrong gain is not a matter of clocks.
    everywhere = [shifted(s, r.time, k * r.step) for s in shares.T for k in WHOLE]
    nuisance = spanning(np.column_stack([r.mean, *everywhere]))
    missing = ~np.isfinite(r.residual)
    count = tried.changes.shape[1] * (len(parts) + len(tried.edges))
    found = sieve(
        r.residual,
        _score(tried, nuisance, missing),
        np.ones(count),
        deviations=r.deviations,
        replicates=replicates(len(r), 2 * nuisance.shape[1] + tried.changes.shape[1]),
        seed=seed,
    )
    J, ruled = tried.changes.shape[1], len(parts) * tried.changes.shape[1]
    best = found.best
    if ruled and found.gains[:ruled].max() > found.gain - PREFERENCE:
        # Daylight saving is an hour of summers, unless winters are that much better.
        worse = PREFERENCE * np.array([season == "winters" for season, _ in rules])
        best = int(np.argmax(found.gains[:ruled] - np.repeat(worse, J)))
    place, j = divmod(best, J)
    name, shift = names[tried.channels[j]], float(tried.shifts[j])
    share = shares[:, tried.channels[j]]
    # Several inputs that are clocks are one effect; the first stands for them.
    where: dict[str, float | str] = {"channel": name[0]}
    if place < len(parts):
        at = int(np.flatnonzero(np.diff(parts[place]) != 0)[0]) + 1
        effect = tried.effect(best)
        where["season"], where["rule"] = rules[place]
        when = f"in the {where['season']} of {where['rule']}"
    else:
        first = int(tried.edges[place - len(parts)])
        at, shift, effect = _refined(r, found.whitener, nuisance, share, first, shift, tried.edges)
        when = f"from {instant(r, at)}"
    where |= {"shift": shift, "time": float(r.time[at]), "time_unit": r.time_unit}
    if r.stamps is not None:
        where |= {"stamp": r.stamps[at].isoformat(), "zone": str(r.stamps.tz)}
    size = float(np.std(effect))
    return Evidence(
        effect="clock shift",
        statistic=found.statistic,
        p_value=found.p_value,
        gain=float(found.gains[best]),
        size=size,
        where=where,
        sentence=f"{off(' and '.join(map(repr, name)), shift, f' {r.time_unit}')} {when}: "
        f"about {size:.2g} {r.output_unit} (rms) of {r.output_name!r}.",
        curve=over_time(r, effect - effect.mean()),
    )


def off(names: str, shift: float, unit: str) -> str:
    """By how much a clock is off, in words; the unit with a blank before it."""
    return f"The clock of {names} is {abs(shift):.4g}{unit} {'late' if shift > 0 else 'early'}"


def _rules(r: Residuals, zones: Sequence[str]) -> tuple[list[tuple[str, str]], np.ndarray]:
    """Seasons of zones whose daylight saving changes within the record, each once; their (P, n)."""
    if r.stamps is None or r.stamps.tz is None:
        return [], np.zeros((0, len(r)))
    rules: dict[bytes, tuple[tuple[str, str], np.ndarray]] = {}
    # Zones the caller names come first: of two with the same transitions that is the one meant.
    for zone in dict.fromkeys([*zones, *all_zones(r.stamps, ())]):
        local = in_zone(r.stamps, zone)
        ahead = local.tz_localize(None) - r.stamps.tz_convert("UTC").tz_localize(None)
        summer = np.asarray(ahead > ahead.min(), dtype=float)
        if 0.0 < summer.mean() < 1.0:
            for season, part in (("summers", summer), ("winters", 1.0 - summer)):
                rules.setdefault(part.tobytes(), ((season, zone), part))
    return [rule for rule, _ in rules.values()], np.array([p for _, p in rules.values()]).reshape(
        -1, len(r)
    )


def _tried(r: Residuals, shares: np.ndarray, parts: np.ndarray) -> Shifts:
    n = len(r)
    lengths = {float(k) * r.step for k in SHIFTS if k <= n // 10}
    if r.stamps is not None:
        seconds = (r.stamps[-1] - r.stamps[0]).total_seconds() / (r.time[-1] - r.time[0])
        hour = 3600.0 / seconds
        # A whole number of steps up to rounding is that number, and tried once.
        steps = round(hour / r.step, 6)
        if 0.25 <= steps <= n // 10:
            lengths.add(steps * r.step)
    shifts = np.array([sign * d for d in sorted(lengths) for sign in (1.0, -1.0)])
    changes = [shifted(s, r.time, -d) - s for s in shares.T for d in shifts]
    low, high = max(int(END * n), 5), n - max(int(END * n), 5)
    edges = np.unique(np.linspace(low, high, min(INSTANTS, high - low)).astype(int))
    return Shifts(
        changes=np.column_stack(changes),
        shifts=np.tile(shifts, shares.shape[1]),
        channels=np.repeat(np.arange(shares.shape[1]), len(shifts)),
        edges=edges,
        parts=parts,
    )


def _score(tried: Shifts, nuisance: np.ndarray, missing: np.ndarray) -> Prepare:
    """Score of all shifts from all edges, by sums over what lies between two edges.

    At an edge the whitened effect differs from the part of the whitened change for as many samples
    as the filter has coefficients; that is left out.
    """

    def prepare(whiten: Whitener) -> Score:
        there, Q, R = projector(whiten, nuisance, missing)
        rows = np.flatnonzero(there) + whiten.order
        w = whiten(tried.changes)[there]
        starts = np.searchsorted(rows, tried.edges)
        masks = tried.parts[:, rows]
        ends = [*starts[1:], len(rows)]
        blocks = [slice(a, b) for a, b in zip(starts, ends, strict=True)]

        def against(values: np.ndarray) -> np.ndarray:
            """Products of w with values (m, ...) over each place: rules, then edges to the end."""
            later = np.cumsum([w[b].T @ values[b] for b in blocks][::-1], axis=0)[::-1]
            ruled = [w.T @ (values.T * m).T for m in masks]
            return np.concatenate([np.array(ruled).reshape(-1, *later.shape[1:]), later])

        squares = np.square(w)
        later = np.concatenate([np.cumsum(squares[::-1], axis=0)[::-1], 0.0 * squares[:1]])[starts]
        beside = against(Q)
        norm = np.concatenate([masks @ squares, later]) - np.square(beside).sum(2)

        def score(x: np.ndarray):
            e0 = whiten(x)[there]
            q = Q.T @ e0
            e = e0 - Q @ q
            explained = np.maximum(2.0 * against(e) - norm, 0.0).ravel()
            gains = len(e) * log_ratio(explained, float(e @ e))

            def fit(variant: int) -> tuple[np.ndarray, np.ndarray]:
                effect = tried.effect(variant)
                also = beside.reshape(-1, Q.shape[1])[variant]
                return effect - effect.mean(), effect + nuisance @ solved(R, q - also)

            return gains, fit

        return score

    return prepare


def _refined(
    r: Residuals,
    whiten: Whitener,
    nuisance: np.ndarray,
    share: np.ndarray,
    at: int,
    shift: float,
    edges: np.ndarray,
) -> tuple[int, float, np.ndarray]:
    """Instant and shift near those on the grids, alternately, and their effect (n,)."""
    x = r.residual
    there, Q, _ = projector(whiten, nuisance, ~np.isfinite(x))
    e = whiten(x)[there]
    e = e - Q @ (Q.T @ e)

    def effect(at: int, shift: float) -> np.ndarray:
        change = shifted(share, r.time, -shift) - share
        return np.where(np.arange(len(x)) >= at, change, 0.0)

    def left(at: int, shift: float) -> float:
        w = whiten(effect(at, shift))[there]
        w = w - Q @ (Q.T @ w)
        return float(np.square(e - w).sum())

    stride = int(np.diff(edges).max(initial=1))
    for _ in range(2):
        finer = np.linspace(shift / 1.5, shift * 1.5, 31)
        shift = float(min([shift, *finer], key=lambda s: left(at, float(s))))
        near = range(max(at - stride, 1), min(at + stride + 1, len(x) - 1))
        at = min([at, *near], key=lambda k: left(k, shift))
    return at, shift, effect(at, shift)
