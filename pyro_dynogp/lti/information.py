"""Compiled O(n) information of later rows on each row, and its reverse mode.

Arrays as in `factorisation`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pyro_dynogp.lti.arithmetic import (
    SEGMENT,
    add_outer,
    add_step_gradient,
    dot,
    move,
    rotate_columns,
    rotate_rows,
    times,
)
from pyro_dynogp.support.compiled import BORROWING, OPTIONS


@njit(**BORROWING)
def _information_row(info, re, back, k, h, e, inverse, u):
    """Move the information matrix of later rows across one row; return e' info e (before)."""
    times(info, e, u)
    kappa = dot(e, u)
    for j in range(u.shape[0]):
        u[j] *= inverse
    c = kappa * inverse * inverse + inverse
    add_outer(info, -1.0, u, h)
    add_outer(info, -1.0, h, u)
    add_outer(info, c, h, h)
    move(info, re, back, k)
    return kappa


@njit(**OPTIONS)
def later_information(re, im, step, out, h, e, d):
    """kappa_n = e_n' Lambda_n e_n, Lambda_n the information of the rows after n on the state at n.

    The backward recursion of the Bryson-Frazier smoother. With it [C^{-1}]_nn = 1/d + kappa/d^2.
    """
    batch, n = d.shape
    J = h.shape[2]
    kappa = np.empty((batch, n))
    info = np.empty((J, J))
    u = np.empty(J)
    back = -im
    for b in range(batch):
        info[:] = 0.0
        for i in range(n - 1, -1, -1):
            kappa[b, i] = _information_row(
                info, re[b], back[b], step[i], h[b, out[i]], e[b, i], 1.0 / d[b, i], u
            )
    return kappa


@njit(**OPTIONS)
def later_information_adjoint(re, im, step, out, h, e, d, kappa_bar):
    """Reverse mode of `later_information`: gradients for re, im, h, e and d."""
    batch, n = d.shape
    J = h.shape[2]
    re_bar = np.zeros_like(re)
    im_bar = np.zeros_like(im)
    h_bar = np.zeros_like(h)
    e_bar = np.zeros_like(e)
    d_bar = np.zeros_like(d)
    length = SEGMENT
    segments = (n + length - 1) // length
    ends = np.empty((segments, J, J))  # information after the last row of each segment
    later = np.empty((length, J, J))
    info = np.empty((J, J))
    moved = np.empty((J, J))
    bar = np.empty((J, J))
    u = np.empty(J)
    t = np.empty(J)
    back = -im
    for b in range(batch):
        info[:] = 0.0
        for i in range(n - 1, -1, -1):
            if (i + 1) % length == 0 or i == n - 1:
                ends[i // length] = info
            o = out[i]
            _information_row(info, re[b], back[b], step[i], h[b, o], e[b, i], 1.0 / d[b, i], u)
        bar[:] = 0.0
        for segment in range(segments):
            first = segment * length
            last = min(n, first + length)
            info[:] = ends[segment]
            for i in range(last - 1, first - 1, -1):
                later[i - first] = info
                o = out[i]
                _information_row(info, re[b], back[b], step[i], h[b, o], e[b, i], 1.0 / d[b, i], u)
            for i in range(first, last):
                o = out[i]
                Lambda = later[i - first]
                inverse = 1.0 / d[b, i]
                ei = e[b, i]
                hi = h[b, o]
                times(Lambda, ei, u)
                kappa = dot(ei, u)
                c = kappa * inverse * inverse + inverse
                k = step[i]
                if k >= 0:
                    # moved = information at the row, own sample included; Phi' moved Phi leaves it
                    moved[:] = Lambda
                    add_outer(moved, -inverse, u, hi)
                    add_outer(moved, -inverse, hi, u)
                    add_outer(moved, c, hi, hi)
                    # gradient of <bar, Phi' moved Phi>: 2 <moved Phi bar, Phi>
                    rotate_columns(bar, re[b, k], im[b, k])
                    for j in range(J):
                        for l in range(J):
                            moved[j, l] *= 2.0
                    add_step_gradient(moved, bar, re_bar[b, k], im_bar[b, k])
                    rotate_rows(bar, re[b, k], im[b, k])
                # own = Lambda - (u h' + h u') / d + c h h', adjoint `bar`
                times(bar, hi, t)
                hbh = dot(hi, t)
                ubh = dot(u, t)
                # gradient with respect to h
                times(bar, u, info[0])
                for j in range(J):
                    h_bar[b, o, j] += 2.0 * c * t[j] - 2.0 * inverse * info[0, j]
                # kappa enters through c as well as through the output
                kb = kappa_bar[b, i] + hbh * inverse * inverse
                d_bar[b, i] += 2.0 * ubh * inverse * inverse
                d_bar[b, i] -= hbh * (2.0 * kappa * inverse + 1.0) * inverse * inverse
                # u = Lambda e, adjoint -2 t / d; kappa = e' Lambda e
                for j in range(J):
                    t[j] *= -2.0 * inverse
                times(Lambda, t, info[0])
                for j in range(J):
                    e_bar[b, i, j] += info[0, j] + 2.0 * kb * u[j]
                add_outer(bar, 0.5, t, ei)
                add_outer(bar, 0.5, ei, t)
                add_outer(bar, kb, ei, ei)
    return re_bar, im_bar, h_bar, e_bar, d_bar
