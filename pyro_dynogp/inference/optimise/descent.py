"""L-BFGS in coordinates that are round where it is: the Hessian there, again and again.

Posteriors of dynamic systems have long ridges (a gain against a pole, a function against the scale
of its input). In plain coordinates L-BFGS stops on them, sometimes hundreds of nats below the top.
A Hessian by differences of gradients costs as much as a few iterations where a batch of points is
evaluated at once. In coordinates x of z = centre + root x, root root' the inverse Hessian, the
density is round: a few iterations end at the top, and half the squared gradient is what is left to
gain, in nats.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from pyro_dynogp.inference.optimise.lockstep import Functions

# Iterations between two Hessians, at least; gradient in round coordinates at which to stop.
LEAST, FLAT = 15, 0.01
# Largest standard deviation of a direction of Laplace's approximation, in unconstrained units. The
# priors are about as wide there, so that no posterior is wider; where the density is flat or curves
# upwards at the mode a wider normal has draws tens of nats off (two outputs with one pair: Pareto's
# k of the ratios 1.2 with 1.5, 1.9 with 2, 3.2 with 3).
WIDEST = 1.5
# How far a unit step of a climb goes in directions without curvature.
FOLLOWED = 3.0
# Change of the unconstrained vector over which a gradient's change is its derivative.
STEP = 1e-4
# Of `polished`: least curvature of a direction that is followed, longest step, and a step after
# which rounding is all that is left. A Hessian serves another step that has at most a share `FAST`
# of the gain of the one before; the method ends after so many steps that have more than half of it.
# Near a regular minimum none does. Five pairs for a system that has one: curvature changes its sign
# from step to step, and sixty of them gain 0.1 to 2 nats in two thirds of the fit's time.
CURVED, LONGEST, DONE = 1e-5, 1.0, 1e-6
FAST, SLOW, SLOW_STEPS = 0.1, 0.5, 3
# Shares of a step that are tried where the whole of it leads no lower.
SHORTER: np.ndarray = 0.25 ** np.arange(1.0, 6.0)


def hessian(
    functions: Functions, z: np.ndarray, some: Sequence[int] | None = None, *, step: float = STEP
) -> np.ndarray:
    """Hessian (d, d) at z (d,), or of some entries of z, by central differences of the gradient."""
    places = list(range(len(z)) if some is None else some)
    shifts = np.zeros((len(places), len(z)))
    shifts[np.arange(len(places)), places] = step
    both = np.concatenate([z + shifts, z - shifts])
    up, down = np.split(functions(both)[1], 2)
    H = ((up - down) / (2.0 * step))[:, places]
    return np.asarray(0.5 * (H + H.T))


def bounded_root(hessian: np.ndarray) -> np.ndarray:
    """Root (d, d), lower, of the inverse Hessian.

    Where the density curves upwards the scale on which it changes is 1 / sqrt(|curvature|), too.
    Directions in which it is flat get the standard deviation `WIDEST`, so that the result is always
    a usable scale. (Three Wiener models with 100 samples, 57 dimensions: the middle half of the
    ratios of the posterior over draws is spread by 107 to 293 nats, and by 680 to 1060 where upward
    curvature counts as none.)
    """
    eigenvalues, vectors = np.linalg.eigh(hessian)
    covariance = (vectors / np.maximum(np.abs(eigenvalues), WIDEST**-2)) @ vectors.T
    return np.linalg.cholesky(0.5 * (covariance + covariance.T))


def newton(
    functions: Functions, starts: np.ndarray, *, steps: int = 60, gap: float = 1e-8
) -> tuple[np.ndarray, np.ndarray]:
    """Minima (k, d) from starts (k, d), side by side, and the values there, infinite where none is.

    Newton's method with Hessians by one-sided differences, curvature taken as positive and at least
    `FOLLOWED`^-2; a step that leads no lower is tried again with a quarter of its length. For few
    dimensions: each try evaluates d + 1 points.

    Args:
        functions: values and gradients. steps: most tries.
        gap: what a step has to gain at least by its quadratic model, in units of the values; the
            last step is then taken, so that the end is far nearer than that.
    """
    shifts = np.concatenate([np.zeros((1, starts.shape[1])), STEP * np.eye(starts.shape[1])])
    z, tried = starts.copy(), starts.copy()
    best, gain = np.full(len(z), np.inf), np.full(len(z), np.inf)
    direction, length = np.zeros_like(z), np.ones(len(z))
    active = np.arange(len(z))
    for _ in range(steps):
        values, gradients = functions((tried[active, None] + shifts).reshape(-1, z.shape[1]))
        each = zip(
            active,
            values.reshape(len(active), -1)[:, 0],
            gradients.reshape(len(active), *shifts.shape),
            strict=True,
        )
        for i, value, g in each:
            with np.errstate(all="ignore"):
                H = (g[1:] - g[0]) / STEP
            finite = np.isfinite(value) and np.isfinite(g).all() and np.isfinite(H).all()
            if not (finite and value < best[i]):
                length[i] *= 0.25
                continue
            curvature, axes = np.linalg.eigh(0.5 * (H + H.T))
            along = (g[0] @ axes) / np.maximum(np.abs(curvature), FOLLOWED**-2)
            z[i], best[i], length[i] = tried[i], value, 1.0
            direction[i], gain[i] = -axes @ along, 0.5 * along @ (g[0] @ axes)
        active = active[(length[active] > 1e-4) & (gain[active] > gap)]
        tried = z + length[:, None] * direction
        if not len(active):
            break
    return np.where(gain[:, None] <= gap, z + direction, z), best


def polished(functions: Functions, z: np.ndarray) -> tuple[np.ndarray, float, bool]:
    """Minimum near z (d,), the value there, and whether it is to rounding: Newton's method.

    A Hessian serves for as long as each step leaves at most a tenth of the gain of the one before.
    Directions that hardly curve are left alone: along them nothing is to be found, as where
    different points are the same model. A step that leads no lower is tried with a quarter of it.
    Where the method does not converge, the point that it has got to is as good as another.
    """
    values, gradients = functions(z[None])
    value, gradient = float(values[0]), gradients[0]
    curvature, axes = np.empty(0), np.empty((len(z), 0))
    known, done, expected, slow = False, False, np.inf, 0
    while slow < SLOW_STEPS and np.isfinite(gradient).all():
        fresh = not known
        if fresh:
            curvature, axes = np.linalg.eigh(hessian(functions, z))
            if not np.isfinite(curvature).all():
                break
            some = curvature > CURVED
            curvature, axes, known = curvature[some], axes[:, some], True
        along = gradient @ axes
        gain = 0.5 * float(np.square(along) @ (1.0 / curvature))
        move = -axes @ (along / curvature)
        longest = float(np.abs(move).max(initial=0.0))
        done = longest <= (DONE if fresh else 0.01 * DONE)
        if gain > FAST * expected and not (fresh or done):
            known = False
            continue
        slow += gain > SLOW * expected
        move *= min(1.0, LONGEST / max(longest, LONGEST))
        lengths: np.ndarray = np.ones(1)
        values, gradients = functions((z + move)[None])
        if not values[0] <= value + 1e-12 * abs(value) and fresh and not done:
            lengths = SHORTER
            values, gradients = functions(z + np.multiply.outer(lengths, move))
        lower = np.flatnonzero(values <= value + 1e-12 * abs(value))
        if len(lower):
            first = lower[0]
            z, value, gradient = z + lengths[first] * move, float(values[first]), gradients[first]
            expected = gain
        elif fresh:
            break
        known = bool(len(lower)) and lengths[0] == 1.0
        if done:
            break
    return z, value, done


def _round(functions: Functions, z: np.ndarray) -> np.ndarray | None:
    """Root (d, d) in whose coordinates curvature at z is one, upwards or downwards.

    One-sided differences will do: coordinates may be a little off, and take half the evaluations.
    None where they are not finite, at the edge of what can be evaluated.
    """
    shifts = np.concatenate([np.zeros((1, len(z))), STEP * np.eye(len(z))])
    gradients = functions(z + shifts)[1]
    H = (gradients[1:] - gradients[0]) / STEP
    if not np.isfinite(H).all():
        return None
    eigenvalues, vectors = np.linalg.eigh(0.5 * (H + H.T))
    return np.asarray(vectors / np.sqrt(np.maximum(np.abs(eigenvalues), FOLLOWED**-2)))


def descend(
    functions: Functions, z: np.ndarray, steps: int, *, every: int, first: int | None = None
) -> tuple[np.ndarray, list[float], str]:
    """Lowest point from z (d,) on, the energy after each iteration, and why it ended.

    Args:
        functions: values and gradients at several points.
        steps: most iterations.
        every: iterations from one Hessian to the next, `LEAST` at least.
        first: iterations before the first Hessian; 0 near the optimum, by default as many as
            between others.
    """
    every = max(every, LEAST)
    history: list[float] = []
    root: np.ndarray | None = None
    count = every if first is None else first
    message = "all steps used"
    while len(history) < steps:
        if count:
            before = len(history)
            left = steps - before
            z, _, status = piece(
                functions, z, root, count if left - count >= LEAST else left, history
            )
            if status == "flat" or (root is not None and len(history) - before <= 1):
                return z, history, "nothing left to gain" if status == "flat" else status
            if steps - len(history) < LEAST:  # too few for another Hessian to pay
                break
        root = _round(functions, z)
        if root is None:
            return z, history, "no Hessian"
        count = every
    return z, history, message


def piece(
    functions: Functions,
    z: np.ndarray,
    root: np.ndarray | None,
    steps: int,
    history: list[float],
    *,
    flat: float = FLAT,
) -> tuple[np.ndarray, float, str]:
    """L-BFGS from z on, in the coordinates of a root, until its gradient there is `flat`.

    Returns the point, the energy there, and why it ended.
    """
    if root is None:
        result = lbfgs(functions, z, steps, history, maxfun=3 * steps, ftol=1e-10, gtol=0.0)
        return result.x, float(result.fun), str(result.message)

    def rounded(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values, gradients = functions(z + x @ root.T)
        return values, gradients @ root

    start = np.zeros(len(z))
    result = lbfgs(rounded, start, steps, history, maxfun=3 * steps, ftol=1e-10, gtol=flat)
    ended = float(np.abs(result.jac).max()) <= flat
    return z + root @ result.x, float(result.fun), "flat" if ended else str(result.message)


def lbfgs(
    functions: Functions, z: np.ndarray, steps: int, history: list[float], **options: float
) -> OptimizeResult:
    """Scipy's L-BFGS from z (d,) on; the energy after each iteration is added to the history."""

    def function(x: np.ndarray) -> tuple[float, np.ndarray]:
        values, gradients = functions(x[None])
        return float(values[0]), gradients[0]

    return minimize(
        function,
        z,
        jac=True,
        method="L-BFGS-B",
        callback=lambda intermediate_result: history.append(float(intermediate_result.fun)),
        options={"maxiter": steps, "maxcor": 20, **options},
    )
