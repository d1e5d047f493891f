r"""Kullback-Leibler divergence of a trajectory given pseudo-observations from its prior.

A "Gauss-Markov" posterior (Khan & Lin 2017; Chang et al. 2020) is the prior p conditioned on
pseudo-observations y with noise V = diag(v). With K the prior covariance plus V, alpha = K^{-1}
(y - m) and sums over the rows that are there,

    KL(q || p) = E_q[sum_k log N(y_k; h_k, v_k)] - log N(y; m, K)
               = 1/2 [(y - m)' alpha - sum_k v_k alpha_k^2]
               + 1/2 [log det K - sum_k log v_k - sum_k (1 - v_k (K^{-1})_kk)],

each bracket nonnegative, everything O(n). The prior covariance is the one with the jitter of
`LTIProcess`: q and p are those that `rsample` and `log_prob` know, and the divergence between them
is exact. (`ConditionedLTIProcess.mean` and `variance` leave the jitter out.)
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import register_kl

from pyro_dynogp.distributions.process import ConditionedLTIProcess, LTIProcess
from pyro_dynogp.distributions.trajectory import apply
from pyro_dynogp.support.tensors import broadcast


@register_kl(ConditionedLTIProcess, LTIProcess)
def conditioned_divergence(q: ConditionedLTIProcess, p: LTIProcess) -> Tensor:
    """KL(q || p) [nats], of the batch shape of q, where q is p given pseudo-observations.

    Raises:
        NotImplementedError: where the prior of q is not p, so that Pyro takes a Monte Carlo
            estimate instead.
    """
    require_same(q.prior, p)
    K = q._jittered
    alpha = apply(K.solve, K, q.residual)
    there = ~K.missing
    v = q.observed.noise_rows
    d = torch.where(there, K.innovation_variance, 1.0)
    # Rows that are missing get one in every place: log 1 - log 1 - (1 - 1) = 0.
    present = torch.where(there, v, 1.0)
    known = torch.where(there, 1.0 - present * K.inverse_diagonal(), 0.0)
    terms = (
        (q.residual - v * alpha) * alpha  # alpha is zero where missing
        + (d / present).log()
        - known
    )
    return 0.5 * terms.sum(-1).expand(broadcast(q.batch_shape, p.batch_shape))


def require_same(prior: LTIProcess, p: LTIProcess) -> None:
    """Check that two processes are the same, up to their batch shape.

    Raises:
        NotImplementedError: where they are not.
    """
    if not same_process(prior, p):
        raise NotImplementedError("The posterior is not that of this LTIProcess.")


def same_process(a: LTIProcess, b: LTIProcess) -> bool:
    """Whether two processes are one and the same function of the same parameters.

    Pyro builds the prior twice, in the guide and in the model that is replayed on it: other
    objects, equal numbers. Equal numbers are not enough, since gradients of a divergence are taken
    as if there were one prior: tensors that are not one object must have been computed by the same
    operations from the same leaves, too.
    """
    if a is b:
        return True
    if type(a) is not type(b) or a.jitter != b.jitter:
        return False
    if a.modes is not b.modes and (
        a.modes.noise != b.modes.noise or a.modes.several_outputs != b.modes.several_outputs
    ):
        return False
    return all(_same(x, y) for x, y in zip(_tensors(a), _tensors(b), strict=True))


def _tensors(process: LTIProcess) -> tuple[Tensor | None, ...]:
    modes, state = process.modes, process.initial_state
    return (
        process.grid.time,
        process.inputs,
        modes.poles,
        modes.B,
        modes.output_gain,
        modes.L,
        modes.feedthrough,
        None if state is None else state.mean,
        None if state is None else state.covariance,
        process.offset,
    )


def _same(x: Tensor | None, y: Tensor | None) -> bool:
    if x is y:
        return True
    if x is None or y is None or x.shape != y.shape:
        return False
    return same_graph(x, y) and torch.equal(x, y)


def same_graph(x: Tensor, y: Tensor) -> bool:
    """Whether autograd has recorded the same operations, from the same leaves, for two tensors."""
    if not (x.requires_grad or y.requires_grad):
        return True
    if x.is_leaf or y.is_leaf:
        return False  # not one object, or the caller would have seen it
    if x.output_nr != y.output_nr:
        return False
    # The pairs are kept: an id is only that of one node for as long as the node is alive.
    seen: dict[tuple[int, int], Any] = {}
    pairs: list[tuple[Any, Any]] = [(x.grad_fn, y.grad_fn)]
    while pairs:
        a, b = pairs.pop()
        if a is b or (id(a), id(b)) in seen:
            continue
        seen[id(a), id(b)] = a, b
        if a is None or b is None or a.name() != b.name():
            return False
        if hasattr(a, "variable"):  # a leaf: equal only where it is one object
            if a.variable is not b.variable:
                return False
            continue
        after, other = a.next_functions, b.next_functions
        if [k for _, k in after] != [k for _, k in other]:
            return False
        pairs.extend((m, n) for (m, _), (n, _) in zip(after, other, strict=True))
    return True
