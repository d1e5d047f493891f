r"""Compiled innovations of a semiseparable covariance in O(n P^2), and O(n P) where the gain rests.

A row is one output o at one time; y = 2 Re c_o' xi reads it from the P complex modes xi, and
q_o = E[xi y] is their covariance. A and M are the parts of E[xi xi^H] and E[xi xi^T] that the rows
so far explain, F the mean that they leave. Over a step of length s, with phi = exp(lambda s),

    A <- phi A phi^H,      M <- phi M phi^T,      F <- phi F,

and then the row's sample r, of noise variance v, is used:

    e = q - A conj(c) - M c,    d = 2 Re c' e + v,    z = r - 2 Re c' F,
    A <- A + w w^H,    M <- M + w w^T,    F <- F + w zeta,      w = e / sqrt(d), zeta = z / sqrt(d).

z are the innovations and d their variances. This is the Kalman filter, or the Cholesky
factorisation of Foreman-Mackey et al. (2017, AJ 154:220), with two complex matrices, of which the
upper triangles are enough, for the real one of twice the size. With one output the caller gives
states scaled by c, and no c. A missing row has v infinite, so that w = zeta = 0.

`innovation_layout` says how arrays lie in memory.
"""

from __future__ import annotations

from numba import njit

from pyro_dynogp.lti.lanes import choose, complex_exponential, get, put, root, splat
from pyro_dynogp.support.compiled import BORROWING, WITHIN


@njit(**WITHIN)
def set_propagators(phi, poles, length):
    """Write exp(lambda length) behind the propagators of no step."""
    P = poles.shape[0] // 2
    s = splat(length)
    for a in range(P):
        re, im = complex_exponential(get(poles, 2 * a) * s, get(poles, 2 * a + 1) * s)
        put(phi, 2 * P + 2 * a, re)
        put(phi, 2 * P + 2 * a + 1, im)


@njit(**WITHIN)
def move_mean(x, src, dst, phi, f):
    """F of the next row's record at dst from the record at src; phi begins at f."""
    P = phi.shape[0] // 4
    mean = 2 * P * (P + 1)
    gain = mean + 2 * P
    zeta = get(x, src + gain + 2 * P + 1)
    for a in range(0, 2 * P, 2):
        re = get(x, src + mean + a) + get(x, src + gain + a) * zeta
        im = get(x, src + mean + a + 1) + get(x, src + gain + a + 1) * zeta
        pr = get(phi, f + a)
        pi = get(phi, f + a + 1)
        put(x, dst + mean + a, pr * re - pi * im)
        put(x, dst + mean + a + 1, pr * im + pi * re)


@njit(**WITHIN)
def move_covariance(x, src, dst, phi, f, q, c, o, e):
    """A and M of the next row's record at dst from the record at src; e of its output o."""
    P = phi.shape[0] // 4
    w = src + 2 * P * (P + 1) + 2 * P
    o = 2 * P * o
    for j in range(2 * P):
        put(e, j, get(q, o + j))
    k = 0
    for a in range(0, 2 * P, 2):
        war = get(x, w + a)
        wai = get(x, w + a + 1)
        par = get(phi, f + a)
        pai = get(phi, f + a + 1)
        ear = get(e, a)
        eai = get(e, a + 1)
        for b in range(a, 2 * P, 2):
            wbr = get(x, w + b)
            wbi = get(x, w + b + 1)
            rr = war * wbr
            ii = wai * wbi
            ri = war * wbi
            ir = wai * wbr
            Ar = get(x, src + k) + (rr + ii)
            Ai = get(x, src + k + 1) + (ir - ri)
            Mr = get(x, src + k + 2) + (rr - ii)
            Mi = get(x, src + k + 3) + (ir + ri)
            pbr = get(phi, f + b)
            pbi = get(phi, f + b + 1)
            rr = par * pbr
            ii = pai * pbi
            ri = par * pbi
            ir = pai * pbr
            fr = rr + ii
            fi = ir - ri
            gr = rr - ii
            gi = ir + ri
            rr = fr * Ar - fi * Ai
            Ai = fr * Ai + fi * Ar
            Ar = rr
            rr = gr * Mr - gi * Mi
            Mi = gr * Mi + gi * Mr
            Mr = rr
            put(x, dst + k, Ar)
            put(x, dst + k + 1, Ai)
            put(x, dst + k + 2, Mr)
            put(x, dst + k + 3, Mi)
            k += 4
            if c is None:
                rr = Ar + Mr
                ear = ear - rr
                eai = eai - (Ai + Mi)
                if b > a:
                    put(e, b, get(e, b) - rr)
                    put(e, b + 1, get(e, b + 1) - (Mi - Ai))
            else:
                cr = get(c, o + b)
                ci = get(c, o + b + 1)
                rr = Ar + Mr
                ri = Mr - Ar
                ear = ear - (rr * cr + (Ai - Mi) * ci)
                eai = eai - ((Ai + Mi) * cr + ri * ci)
                if b > a:
                    cr = get(c, o + a)
                    ci = get(c, o + a + 1)
                    put(e, b, get(e, b) - (rr * cr - (Ai + Mi) * ci))
                    put(e, b + 1, get(e, b + 1) - ((Mi - Ai) * cr + ri * ci))
        put(e, a, ear)
        put(e, a + 1, eai)


@njit(**WITHIN)
def read(c, o, x, at, P):
    """2 Re c_o' x of the complex vector that begins at `at`."""
    total = splat(0.0)
    for a in range(0, 2 * P, 2):
        if c is None:
            total = total + get(x, at + a)
        else:
            k = 2 * P * o + a
            total = total + (get(c, k) * get(x, at + a) - get(c, k + 1) * get(x, at + a + 1))
    return total + total


@njit(**WITHIN)
def observe(x, at, c, o, r, d, work, settled):
    """Write the gain and zeta of the record at `at`; d given, or the gain kept where it rests."""
    P = work.e.shape[0] // 2
    mean = at + 2 * P * (P + 1)
    gain = mean + 2 * P
    own = o * (2 * P + 1)
    if settled:
        d = get(work.gain, own + 2 * P)
    inverse = splat(1.0) / root(d)
    for j in range(2 * P):
        w = get(work.gain, own + j)
        if not settled:
            w = choose(get(work.resting, 0), w, get(work.e, j) * inverse)
            put(work.gain, own + j, w)
        put(x, gain + j, w)
    put(work.gain, own + 2 * P, d)
    z = r - read(c, o, x, mean, P)
    put(x, gain + 2 * P, inverse)
    put(x, gain + 2 * P + 1, z * inverse)
    return z


@njit(**BORROWING)
def run_segment(x, stride, first, last, points, rows, work, settled):
    """Samples first to last - 1: records in x, innovations and variances.

    Record i goes to vector (i + 1) * stride; with stride 0 each takes the place of the one before.
    """
    P = work.e.shape[0] // 2
    n_y = points.q.shape[0] // (2 * P)
    current = -1
    i = 0
    for m in range(first, last):
        step = rows.step[m]
        if step >= 0 and step != current:
            current = step
            set_propagators(work.phi, points.poles, rows.length[step])
        for o in range(n_y):
            f = 2 * P if o == 0 and step >= 0 else 0
            src = i * stride
            dst = src + stride
            move_mean(x, src, dst, work.phi, f)
            variance = splat(0.0)
            if not settled:
                move_covariance(x, src, dst, work.phi, f, points.q, points.c, o, work.e)
                variance = read(points.c, o, work.e, 0, P) + get(work.v, i)
                kept = get(work.gain, o * (2 * P + 1) + 2 * P)
                variance = choose(get(work.resting, 0), kept, variance)
            put(work.z, i, observe(x, dst, points.c, o, get(work.r, i), variance, work, settled))
            put(work.d, i, get(work.gain, o * (2 * P + 1) + 2 * P))
            i += 1
