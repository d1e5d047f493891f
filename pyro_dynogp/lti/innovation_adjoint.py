r"""Reverse mode of `innovation_rows`: from gradients by z and d to those by all that enters.

A bar is the gradient by a number, dL/dRe + i dL/dIm by a complex one; upper triangles are the
variables. Row by row from the last, with bars of A, M and F after the row's sample,

    w_bar = 2 (A_bar w + M_bar conj w) + F_bar zeta,    zeta_bar = Re w^H F_bar,
    d_bar <- d_bar - (Re w^H w_bar + zeta zeta_bar) / 2 d,    z_bar <- z_bar + zeta_bar / sqrt(d),
    e_bar = w_bar / sqrt(d) + 2 d_bar conj(c) = q_bar = -s_bar,    s = A conj(c) + M c,
    F_bar <- F_bar - 2 z_bar conj(c),    A_bar, M_bar <- what s adds,

and over the step, with A, M and F behind it: log phi_bar = sum of A_bar conj(A), M_bar conj(M) and
F_bar conj(F) over what phi multiplies, lambda_bar = length log phi_bar.
"""

from __future__ import annotations

from numba import njit

from pyro_dynogp.lti.innovation_rows import set_propagators
from pyro_dynogp.lti.lanes import choose, get, put, splat
from pyro_dynogp.support.compiled import BORROWING, WITHIN


@njit(**WITHIN)
def add(array, k, x):
    """Add x to vector k of an array of lanes."""
    put(array, k, get(array, k) + x)


@njit(**WITHIN)
def gain_adjoint(x, w, state, bar):
    """Write 2 (A_bar u + M_bar conj u) to bar, u = the vector of x that begins at w."""
    pairs = bar.shape[0]
    for j in range(pairs):
        put(bar, j, splat(0.0))
    k = 0
    for a in range(0, pairs, 2):
        war = get(x, w + a)
        wai = get(x, w + a + 1)
        Ar = get(state, k)
        Mr = get(state, k + 2)
        Mi = get(state, k + 3)
        k += 4
        tr = (Ar + Mr) * war + Mi * wai
        tr = get(bar, a) + (tr + tr)
        ti = (Ar - Mr) * wai + Mi * war
        ti = get(bar, a + 1) + (ti + ti)
        for b in range(a + 2, pairs, 2):
            wbr = get(x, w + b)
            wbi = get(x, w + b + 1)
            Ar = get(state, k)
            Ai = get(state, k + 1)
            Mr = get(state, k + 2)
            Mi = get(state, k + 3)
            k += 4
            plus = Ar + Mr
            minus = Ar - Mr
            sums = Ai + Mi
            difference = Mi - Ai
            tr = tr + (plus * wbr + difference * wbi)
            ti = ti + (sums * wbr + minus * wbi)
            add(bar, b, plus * war + sums * wai)
            add(bar, b + 1, difference * war + minus * wai)
        put(bar, a, tr)
        put(bar, a + 1, ti)


@njit(**WITHIN)
def observe_adjoint(x, at, i, o, c, work, bars, injecting, settled):
    """Reverse of a row's sample but for A and M: e_bar is in bars.w, those of r and v in work."""
    size = bars.w.shape[0]
    covariances = bars.later.shape[0]
    zero = splat(0.0)
    half = splat(0.5)
    two = splat(2.0)
    mean = at + covariances
    gain = mean + size
    inverse = get(x, gain + size)
    zeta = get(x, gain + size + 1)
    own = o * (size + 1)
    resting = get(work.resting, 0)
    zeta_bar = zero
    quadratic = zero
    for j in range(size):
        w = get(x, gain + j)
        F_bar = get(bars.state, covariances + j)
        zeta_bar = zeta_bar + F_bar * w
        w_bar = F_bar * zeta
        if settled:
            add(bars.held, own + j, w_bar)
        else:
            w_bar = w_bar + get(bars.w, j)
            if injecting:
                w_bar = w_bar + choose(get(bars.inject, 0), get(bars.held, own + j), zero)
            add(bars.held, own + j, choose(resting, w_bar, zero))
            w_bar = choose(resting, zero, w_bar)
            quadratic = quadratic + w_bar * w
            put(bars.w, j, w_bar)
    d_bar = get(bars.d, i) - half * (quadratic + zeta_bar * zeta) * (inverse * inverse)
    if settled:
        add(bars.held, own + size, d_bar)
        d_bar = zero
    else:
        if injecting:
            d_bar = d_bar + choose(get(bars.inject, 0), get(bars.held, own + size), zero)
        add(bars.held, own + size, choose(resting, d_bar, zero))
        d_bar = choose(resting, zero, d_bar)
    z_bar = get(bars.z, i) + zeta_bar * inverse
    put(work.r, i, z_bar)
    put(work.v, i, d_bar)
    z_bar = two * z_bar
    d_bar = two * d_bar
    scale = choose(inverse, splat(1.0) / inverse, zero)
    for a in range(0, size, 2):
        F = covariances + a
        er = get(bars.w, a) * inverse
        ei = get(bars.w, a + 1) * inverse
        if c is None:
            add(bars.state, F, zero - z_bar)
            er = er + d_bar
        else:
            k = size * o + a
            cr = get(c, k)
            ci = get(c, k + 1)
            add(bars.state, F, zero - z_bar * cr)
            add(bars.state, F + 1, z_bar * ci)
            er = er + d_bar * cr
            ei = ei - d_bar * ci
            wr = get(x, gain + a) * scale
            wi = get(x, gain + a + 1) * scale
            add(bars.c, k, d_bar * wr - z_bar * get(x, mean + a))
            add(bars.c, k + 1, z_bar * get(x, mean + a + 1) - d_bar * wi)
        if not settled:
            put(bars.w, a, er)
            put(bars.w, a + 1, ei)
            add(bars.q, size * o + a, er)
            add(bars.q, size * o + a + 1, ei)


@njit(**WITHIN)
def _read_adjoint(bar, value, s, c, k, c_bar):
    """Bars of entries of A and M after s_a = A_ab conj(c_b) + M_ab c_b; k is the place of c_b."""
    cr = get(c, k)
    ci = get(c, k + 1)
    rr = s[0] * cr
    ii = s[1] * ci
    ri = s[0] * ci
    ir = s[1] * cr
    add(c_bar, k, (value[0] + value[2]) * s[0] + (value[1] + value[3]) * s[1])
    add(c_bar, k + 1, (value[1] - value[3]) * s[0] + (value[2] - value[0]) * s[1])
    return bar[0] + (rr - ii), bar[1] + (ir + ri), bar[2] + (rr + ii), bar[3] + (ir - ri)


@njit(**WITHIN)
def covariance_adjoint(x, at, o, phi, f, c, bars):
    """Reverse of e and of the step for A and M; what phi multiplies is added to bars.log_phi."""
    size = bars.w.shape[0]
    zero = splat(0.0)
    k = 0
    o = size * o
    for a in range(0, size, 2):
        sar = zero - get(bars.w, a)
        sai = zero - get(bars.w, a + 1)
        par = get(phi, f + a)
        pai = get(phi, f + a + 1)
        lr = zero
        li = zero
        for b in range(a, size, 2):
            Ar = get(bars.state, k)
            Ai = get(bars.state, k + 1)
            Mr = get(bars.state, k + 2)
            Mi = get(bars.state, k + 3)
            sbr = zero - get(bars.w, b)
            sbi = zero - get(bars.w, b + 1)
            vAr = get(x, at + k)
            vAi = get(x, at + k + 1)
            vMr = get(x, at + k + 2)
            vMi = get(x, at + k + 3)
            if c is None:
                if b == a:
                    Ar = Ar + sar
                    Mr = Mr + sar
                    Mi = Mi + sai
                else:
                    total = sar + sbr
                    Ar = Ar + total
                    Mr = Mr + total
                    Ai = Ai + (sai - sbi)
                    Mi = Mi + (sai + sbi)
            else:
                Ar, Ai, Mr, Mi = _read_adjoint(
                    (Ar, Ai, Mr, Mi), (vAr, vAi, vMr, vMi), (sar, sai), c, o + b, bars.c
                )
                if b > a:  # entry (b, a) is the conjugate of (a, b) in A
                    Ar, Ai, Mr, Mi = _read_adjoint(
                        (Ar, zero - Ai, Mr, Mi), (vAr, zero - vAi, vMr, vMi), (sbr, sbi), c, o + a,
                        bars.c,
                    )  # fmt: skip
                    Ai = zero - Ai
                else:
                    Ai = zero
            if f > 0:
                ar = Ar * vAr + Ai * vAi
                ai = Ai * vAr - Ar * vAi
                mr = Mr * vMr + Mi * vMi
                mi = Mi * vMr - Mr * vMi
                lr = lr + (ar + mr)
                li = li + (ai + mi)
                # Both factors of an entry on the diagonal are phi_a: for b = a it is added twice.
                add(bars.log_phi, b, ar + mr)
                add(bars.log_phi, b + 1, mi - ai)
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
                rr = Ar * fr + Ai * fi
                Ai = Ai * fr - Ar * fi
                Ar = rr
                rr = Mr * gr + Mi * gi
                Mi = Mi * gr - Mr * gi
                Mr = rr
            put(bars.state, k, Ar)
            put(bars.state, k + 1, Ai)
            put(bars.state, k + 2, Mr)
            put(bars.state, k + 3, Mi)
            k += 4
        add(bars.log_phi, a, lr)
        add(bars.log_phi, a + 1, li)


@njit(**WITHIN)
def mean_adjoint(x, at, phi, length, bars):
    """Reverse of the step for F; then the gradient by the poles."""
    size = bars.w.shape[0]
    F = bars.later.shape[0]
    s = splat(length)
    for a in range(0, size, 2):
        xr = get(x, at + F + a)
        xi = get(x, at + F + a + 1)
        re = get(bars.state, F + a)
        im = get(bars.state, F + a + 1)
        add(bars.poles, a, s * (get(bars.log_phi, a) + (re * xr + im * xi)))
        add(bars.poles, a + 1, s * (get(bars.log_phi, a + 1) + (im * xr - re * xi)))
        put(bars.log_phi, a, splat(0.0))
        put(bars.log_phi, a + 1, splat(0.0))
        pr = get(phi, size + a)
        pi = get(phi, size + a + 1)
        put(bars.state, F + a, re * pr + im * pi)
        put(bars.state, F + a + 1, im * pr - re * pi)


@njit(**BORROWING)
def reverse_segment(x, stride, first, last, points, rows, work, bars, settled):
    """Samples last - 1 to first, whose records are in x."""
    size = bars.w.shape[0]
    n_y = rows.noise.shape[2]
    current = -1
    i = (last - first) * n_y
    for m in range(last - 1, first - 1, -1):
        step = rows.step[m]
        if step >= 0 and step != current:
            current = step
            set_propagators(work.phi, points.poles, rows.length[step])
        for o in range(n_y - 1, -1, -1):
            at = i * stride
            i -= 1
            moving = o == 0 and step >= 0
            if not settled:
                gain_adjoint(x, at + bars.later.shape[0] + size, bars.state, bars.w)
            observe_adjoint(x, at, i, o, points.c, work, bars, m == last - 1, settled)
            if not settled:
                f = size if moving else 0
                covariance_adjoint(x, at, o, work.phi, f, points.c, bars)
            if moving:
                mean_adjoint(x, at, work.phi, rows.length[step], bars)
