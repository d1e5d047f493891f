"""Effects of structure in the noise-free output of a plant, and the list of all such effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from tests.discrepancy.plant_disturbances import (
    HOUR,
    calendar,
    clock_shift,
    drift,
    gain_shift,
    level_shift,
    periodic_disturbance,
)
from tests.discrepancy.plant_dynamics import (
    Array,
    Function,
    System,
    joined,
    looped_response,
    play,
    response,
    varying_response,
)
from tests.discrepancy.plant_setting import (
    Generator,
    Setting,
    Wish,
    random_gains,
    random_pole,
    random_signal,
    standard,
)
from tests.discrepancy.planting import Planting, inside

Builder = Callable[[Setting, Generator], Planting]


def _extra_input(s: Setting, rng: Generator) -> Planting:
    channel = standard(random_signal(rng, len(s.u)), s.window)
    one = System(np.array([random_pole(rng, (8.0, 50.0))]), np.array([[1.0 + rng.normal() * 1j]]))
    added = standard(response(one, channel[:, None]), s.window)
    planting = inside(s, added, pole=complex(one.poles[0]))
    return replace(planting, extra=channel)


def _dead_time(s: Setting, rng: Generator) -> Planting:
    del rng
    return Planting(
        lambda amount, w: s.observe(response(s.system, s.u, delay=amount) + w),
        (0.3, 15.0),
        lambda amount: {"delay": amount},
        linear=False,
        starts=(s.system.poles, 0.7 * s.system.poles),
    )


def _unmodelled_dynamics(s: Setting, rng: Generator) -> Planting:
    taken = np.abs(s.system.poles)
    pole = random_pole(rng, (6.0, 60.0))
    while np.abs(np.log(taken / abs(pole))).min() < np.log(1.7):
        pole = random_pole(rng, (6.0, 60.0))
    one = System(np.array([pole]), random_gains(rng, s.u.shape[1]))
    one = one.scaled(1 / response(one, s.u)[s.window].std())
    # The model may take the further pair for one of its own.
    swapped = [np.where(taken == size, pole, s.system.poles) for size in taken]
    return Planting(
        lambda amount, w: s.observe(response(joined(s.system, one.scaled(amount)), s.u) + w),
        (0.02, 2.0),
        lambda amount: {"amount": amount, "pole": pole},
        linear=False,
        starts=(s.system.poles, *swapped),
    )


def _integrator(s: Setting, rng: Generator) -> Planting:
    """The integral of the first input beside the response; it leaks nowhere."""
    del rng
    first = s.u[:, 0] - s.u[s.window, 0].mean()
    integral = standard(np.concatenate([[0.0], np.cumsum(first)[:-1]]), s.window)
    slow = (-1.0 + 1.0j) / s.samples
    # The model may take a slow pole for it.
    swapped = [np.where(np.arange(len(s.system.poles)) == k, slow, s.system.poles)
               for k in range(len(s.system.poles))]  # fmt: skip
    return Planting(
        lambda amount, w: s.observe(response(s.system, s.u) + w + amount * integral),
        (0.02, 20.0),
        lambda amount: {"amount": amount, "channel": "input 0"},
        linear=False,
        starts=(s.system.poles, *swapped),
    )


def _curve(rng: Generator) -> tuple[str, Function]:
    """A static nonlinearity of a signal of standard deviation one."""
    curves: Mapping[str, Function] = {
        "square": lambda x: np.asarray(0.5 * x**2),
        "softening": lambda x: np.asarray(np.tanh(1.5 * x)),
        "kink": lambda x: np.asarray(np.maximum(x, 0.0)),
    }
    name = str(rng.choice(list(curves)))
    return name, curves[name]


def _output_nonlinearity(s: Setting, rng: Generator) -> Planting:
    name, curve = _curve(rng)
    sign = float(rng.choice([-1.0, 1.0]))

    def clean(amount: float, w: Array) -> Array:
        g = (s.linear + w)[s.window]
        return g + sign * amount * curve(g)

    return Planting(clean, (1e-4, 10.0), lambda amount: {"amount": sign * amount, "curve": name})


def _input_nonlinearity(s: Setting, rng: Generator) -> Planting:
    name, curve = _curve(rng)
    channel, sign = int(rng.integers(s.u.shape[1])), float(rng.choice([-1.0, 1.0]))
    bent = s.u.copy()
    bent[:, channel] = sign * curve(s.u[:, channel])
    bent[:, [j for j in range(s.u.shape[1]) if j != channel]] = 0.0
    return inside(s, response(s.system, bent), curve=name, channel=f"input {channel}")


def _nonlinear_feedback(s: Setting, rng: Generator) -> Planting:
    """A spring, a friction or a valve where the first input acts, against what it does."""
    curves: Mapping[str, Function] = {
        "hardening": lambda x: np.asarray(np.clip(x, -3.0, 3.0) ** 3 / 3.0),
        "friction": lambda x: np.asarray(np.tanh(4.0 * x)),
        "valve": lambda x: np.asarray(np.sqrt(np.maximum(x + 2.0, 0.0)) - np.sqrt(2.0)),
    }
    name = str(rng.choice(list(curves)))
    gains = s.system.gains[:, 0]
    static = -2 * (gains / s.system.poles).real.sum()
    back = -np.sign(static) * gains / max(abs(static), 0.2)
    return Planting(
        lambda amount, w: s.observe(looped_response(s.system, s.u, amount * back, curves[name], w)),
        (0.005, 1.5),
        lambda amount: {"amount": amount, "curve": name},
        linear=False,
    )


def _saturation(s: Setting, rng: Generator) -> Planting:
    """A sensor that ends at one or two limits; the amount is the share of samples beyond them."""
    ends = str(rng.choice(["upper", "lower", "both"]))
    g = s.observe(s.linear)

    def limits(amount: float) -> tuple[float, float]:
        share = amount / 2 if ends == "both" else amount
        low = -np.inf if ends == "upper" else float(np.quantile(g, share))
        return low, np.inf if ends == "lower" else float(np.quantile(g, 1 - share))

    return Planting(
        lambda amount, w: np.clip(s.observe(s.linear + w), *limits(amount)),
        (0.002, 0.7 if ends == "both" else 0.5),
        lambda amount: {"share": amount, "limits": limits(amount)},
        linear=False,
        limits=limits,
    )


def _at_an_input(s: Setting, rng: Generator, change: Callable[[Array, float], Array]) -> Planting:
    """What an actuator does to one input; the amount is half a width."""
    channel = int(rng.integers(s.u.shape[1]))

    def clean(amount: float, w: Array) -> Array:
        u = s.u.copy()
        u[:, channel] = change(u[:, channel], amount)
        return s.observe(response(s.system, u) + w)

    return Planting(
        clean,
        (0.01, 1.5),
        lambda amount: {"channel": f"input {channel}", "half_width": amount},
        linear=False,
    )


def _dead_zone(s: Setting, rng: Generator) -> Planting:
    """An actuator that does nothing around a centre."""
    centre = float(rng.uniform(-0.3, 0.3))
    return _at_an_input(s, rng, lambda u, half: u - centre - np.clip(u - centre, -half, half))


def _hysteresis(s: Setting, rng: Generator) -> Planting:
    """An actuator with backlash."""
    return _at_an_input(s, rng, play)


def _outside_catalogue(s: Setting, rng: Generator) -> Planting:
    """A product of two delayed inputs through dynamics, or poles that wander up and down."""
    if rng.uniform() < 0.5:
        d1, d2 = int(rng.integers(2, 8)), int(rng.integers(9, 18))
        product = np.roll(s.u[:, 0], d1) * np.roll(s.u[:, -1], d2)
        one = System(np.array([random_pole(rng, (8.0, 40.0))]), np.array([[1.0 + 0.5j]]))
        added = standard(response(one, product[:, None]), s.window)
        return inside(s, added, kind="product of delayed inputs", delays=(d1, d2))
    cycles, phase = rng.uniform(2.0, 5.0), rng.uniform(0, 2 * np.pi)
    wave = np.sin(2 * np.pi * cycles * np.arange(len(s.u)) / s.samples + phase)
    return Planting(
        lambda amount, w: s.observe(varying_response(s.system, s.u, np.exp(amount * wave)) + w),
        (0.02, 0.8),
        lambda amount: {"kind": "varying pole", "swing": amount, "cycles": cycles},
        linear=False,
    )


PLANTINGS: Mapping[str, Builder] = {
    "extra input": _extra_input,
    "dead time": _dead_time,
    "unmodelled dynamics": _unmodelled_dynamics,
    "integrator": _integrator,
    "output nonlinearity": _output_nonlinearity,
    "input nonlinearity": _input_nonlinearity,
    "nonlinear feedback": _nonlinear_feedback,
    "saturation": _saturation,
    "dead zone": _dead_zone,
    "hysteresis": _hysteresis,
    "drift": drift,
    "level shift": level_shift,
    "gain shift": gain_shift,
    "periodic disturbance": periodic_disturbance,
    "calendar": calendar,
    "clock shift": clock_shift,
    "outside catalogue": _outside_catalogue,
}
# What these and the noise effects ask of the plant around them.
WISHES: Mapping[str, Wish] = {
    "output nonlinearity": Wish(wiener=False),
    "nonlinear feedback": Wish(wiener=False),
    "saturation": Wish(wiener=False),
    "feedback": Wish(wiener=False),
    "calendar": Wish(stamps=True, step=HOUR),
    "clock shift": Wish(stamps=True, periods=(40.0, 120.0)),
}
