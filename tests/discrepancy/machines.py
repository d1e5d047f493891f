"""Machines with planted effects: a second generator of plants for the benchmark of naming.

A machine is simulated in physical units from its differential equations, with inputs that are
partly pieces of measured ones. It shares nothing with the search for effects, nor with the first
generator, `plants`. Two or three channels that do not act lie beside the input.

The strength of an effect sets the measurement noise: the effect's size in the output
(`machine_sizes`) is 1, 2 or 4 times the standard deviation of the noise. Of two or three effects at
once, each has that strength alone. Of two outputs, the one in which an effect is largest counts;
the noise is the same share of both outputs. Effects of the noise have strengths of their own:

- heavy tails: Student-t noise with 8, 4 or 2.5 degrees of freedom;
- heteroscedastic noise: the logarithm of its standard deviation has a standard deviation of 0.25,
  0.5 or 1 along the input or the output;
- process noise: 1, 2 or 4 times the measurement noise, at the output;
- feedback: of the input's standard deviation, noise and disturbances cause 0.1, 0.2 or 0.3. A
  loop without this effect has the input that the controller makes without any noise.

The amount of an effect is chosen for a noise between 1.5 and 10 % of the output; machines whose
noise is not between 1 and 12 % of the output's standard deviation are drawn again.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import pyro_dynogp as dgp
from tests.discrepancy.machine_drafts import NOISE_EFFECTS, Draft, draft, outside_draft
from tests.discrepancy.machine_effects import BUILDERS
from tests.discrepancy.machine_inputs import HALVES

Array = NDArray[np.float64]
STRENGTHS = ("weak", "middle", "strong")
OUTSIDE = "outside catalogue"
KINDS: Mapping[str, tuple[str, ...]] = {
    kind: (*NOISE_EFFECTS.get(kind, ()), *builders) for kind, builders in BUILDERS.items()
}
# Measurement noise over the standard deviation of the output.
NOISE, ATTEMPTS = (0.01, 0.12), 40
SAMPLES, FEWEST, MOST_EFFECTS = (400, 1500), 200, 3


@dataclass(frozen=True, eq=False)
class Machine:
    """A record and what is behind it; only `record` and `model` are for the search.

    Attributes:
        record: inputs that the base model uses, outputs, and in `extra` the other channels.
        training: samples that the model to start from is fitted to, half of the record.
        model: to start from, not fitted.
        kind: which machine.
        effects: what was planted, () for nothing.
        accepted: for each planted effect, every name of the catalogue that says it right.
        channel: the extra channel that acts, or None.
        strength: "weak", "middle" or "strong". seed: which machine.
        noise_free: (n, n_y) output of a free run with the true machine and effects [output].
        noise_sd: (n_y,) root mean square of the measurement noise, before limits of a sensor.
    """

    record: dgp.Record
    training: int
    model: dgp.Model
    kind: str
    effects: tuple[str, ...]
    accepted: Mapping[str, tuple[str, ...]]
    channel: str | None
    strength: str
    seed: int
    noise_free: Array
    noise_sd: Array

    def floor(self, part: dgp.Record) -> float:
        """Root mean square error of `noise_free`, over all outputs, on a part of the record.

        Raises:
            ValueError: where `part` is no part of the record.
        """
        rows = rows_of(self.record, part)
        return float(np.sqrt(np.nanmean((part.outputs - self.noise_free[rows]) ** 2)))


def rows_of(record: dgp.Record, part: dgp.Record) -> NDArray[np.intp]:
    """Samples of a machine's record that a part of it consists of.

    Raises:
        ValueError: where `part` is no part of the record.
    """
    rows = np.searchsorted(record.time, part.time)
    inside = rows < len(record)
    if not inside.all() or not np.array_equal(record.time[rows], part.time):
        raise ValueError("part: expected samples of the machine's record, got other times.")
    return rows


def machine(
    kind: str, seed: int, *, effects: Sequence[str] = (), strength: str = "strong",
    samples: int | None = None, split: str = "development",
) -> Machine:  # fmt: skip
    """One machine; the same arguments give the same bits.

    Args:
        kind: one of KINDS. seed: which machine, a whole number >= 0.
        effects: up to three of those of the kind, () for nothing.
        strength: of each effect; it has no meaning without one.
        samples: length of the record, by default drawn between 400 and 1500.
        split: "development" or "final"; their machines have nothing in common.

    Raises:
        ValueError: for an unknown kind, effect, strength or split, too few samples, or where no
            machine is found in which the effects have that strength.
    """
    made, source = drawn(
        kind, seed, effects=effects, strength=strength, samples=samples, split=split
    )
    return _machine(made, kind, tuple(effects), strength, seed, source)


def drawn(
    kind: str, seed: int, *, effects: Sequence[str] = (), strength: str = "strong",
    samples: int | None = None, split: str = "development",
) -> tuple[Draft, np.random.SeedSequence]:  # fmt: skip
    """What `machine` makes its record of, and the source of the places of the channels."""
    _among("kind", kind, tuple(KINDS))
    chosen = tuple(effects)
    for effect in chosen:
        _among("effects", effect, KINDS[kind])
    if len(set(chosen)) < len(chosen) or len(chosen) > MOST_EFFECTS:
        raise ValueError(f"effects: expected up to {MOST_EFFECTS}, each once, got {chosen}.")
    _check(seed, strength, samples, split)
    if samples is None:
        samples = _length(kind, chosen, seed, split)
    # By name: another effect leaves the machines of the others as they are. No order matters.
    key = [HALVES[split], zlib.crc32(kind.encode()), zlib.crc32("+".join(sorted(chosen)).encode())]
    key += [STRENGTHS.index(strength) if chosen else 0, seed]
    for attempt in range(ATTEMPTS):
        source = np.random.SeedSequence([*key, attempt])
        made = draft(kind, chosen, strength, samples, split, source)
        if made is not None and _noise_fits(made):
            return made, source
    raise ValueError(
        f"effects: expected some that can be made {strength} in {kind!r} with {samples} samples, "
        f"got {chosen} with seed {seed}, which {ATTEMPTS} draws did not give."
    )


def outside(
    seed: int, *, strength: str = "strong", samples: int | None = None, split: str = "development"
) -> Machine:
    """One machine whose effect no block of the catalogue stands for; see `machine`.

    In turn, by seed: a valve that a second input moves, a spring that changes with a hidden switch,
    a gain times the product of two channels, an input times the past of another. `kind` says which.
    """
    _check(seed, strength, samples, split)
    if samples is None:
        samples = _length(OUTSIDE, (), seed, split)
    key = [HALVES[split], zlib.crc32(OUTSIDE.encode()), STRENGTHS.index(strength), seed]
    for attempt in range(ATTEMPTS):
        source = np.random.SeedSequence([*key, attempt])
        made = outside_draft(seed, strength, samples, split, source)
        if made is not None and _noise_fits(made):
            return _machine(made, made.what, (OUTSIDE,), strength, seed, source)
    raise ValueError(
        f"seed: expected one that can be made {strength} with {samples} samples, got {seed}, which "
        f"{ATTEMPTS} draws did not give."
    )


def _among(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name}: expected among {known}, got {value!r}.")


def _check(seed: int, strength: str, samples: int | None, split: str) -> None:
    _among("strength", strength, STRENGTHS)
    _among("split", split, tuple(HALVES))
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed: expected a whole number >= 0, got {seed!r}.")
    if samples is not None and samples < FEWEST:
        raise ValueError(f"samples: expected at least {FEWEST}, got {samples}.")


def _length(kind: str, effects: tuple[str, ...], seed: int, split: str) -> int:
    """Samples of a record, log-uniform; the same for all strengths."""
    key = zlib.crc32("+".join([kind, *sorted(effects)]).encode())
    rng = np.random.default_rng([HALVES[split], key, seed, 1])
    return int(np.exp(rng.uniform(*np.log(SAMPLES))))


def _noise_fits(made: Draft) -> bool:
    least, most = (share * made.clean.std(axis=0) for share in NOISE)
    return bool((made.noise_sd >= least).all() and (made.noise_sd <= most).all())


def _machine(
    made: Draft, kind: str, effects: tuple[str, ...], strength: str, seed: int,
    source: np.random.SeedSequence,
) -> Machine:  # fmt: skip
    rng = np.random.default_rng(source.spawn(1)[0])
    rig, n = made.rig, len(made.clean)
    channels = [*made.acting, *made.decoys]
    names = [f"channel {k + 1}" for k in rng.permutation(len(channels))]
    extra = dict(sorted(zip(names, channels, strict=True)))
    if made.loop is not None:
        extra["set point"] = made.loop.wanted[-n:]
    n_u = made.u.shape[1]
    record = dgp.Record(
        np.arange(n) * rig.step if rig.stamps is None else rig.stamps,
        made.u, made.y, input_names=list(rig.names[:n_u]), output_names=list(rig.names[n_u:]),
        input_units=list(rig.units[:n_u]), output_units=list(rig.units[n_u:]), extra=extra,
        name=f"{kind} {seed}",
    )  # fmt: skip
    return Machine(
        record, n // 2, made.model, kind, effects, made.accepted,
        names[0] if len(made.acting) == 1 else None, strength, seed, made.clean, made.noise_sd,
    )  # fmt: skip
