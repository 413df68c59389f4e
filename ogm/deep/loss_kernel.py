"""Compiled kernel of `ogm.deep.losses.reverse_kl` for float32 on a processor, without torch.

It computes in float64, with the formulas of `ogm.evidence.dirichlet.dirichlet_kl_gradient`, its slow reference.
"""

from typing import Any

import numpy as np

from ogm.jit import inline, kernel

_SQRT_HALF = 0x3FE6A09E667F3BCD  # bits of sqrt(1/2)
_LOG_2 = 0.6931471805599453


@kernel
def fill_reverse_kl(
    evidence: Any, target: Any, strength: float, value: Any, gradient: Any, first: int, last: int
) -> None:
    """Fill value (batch, cells) and gradient (batch, 2, cells) of the cells from `first` to ``last - 1``.

    Evidence and target are (batch, 2, cells) float32. See `ogm.deep.losses.reverse_kl`.
    """
    scale, span = 1 / strength, slice(first, last)
    for b in range(len(evidence)):
        e0, e1, t0, t1 = evidence[b, 0, span], evidence[b, 1, span], target[b, 0, span], target[b, 1, span]
        values, gradient0, gradient1 = value[b, span], gradient[b, 0, span], gradient[b, 1, span]
        for i in range(len(values)):
            y0, y1 = 1.0 + e0[i], 1.0 + e1[i]
            x0, x1 = 1.0 + strength * t0[i], 1.0 + strength * t1[i]
            divergence0, product0, slope0 = _bregman(x0, y0)
            divergence1, product1, slope1 = _bregman(x1, y1)
            divergence, product, slope = _bregman(x0 + x1, y0 + y1)
            total = divergence0 + divergence1 - divergence + _log(product / product0 / product1)
            values[i] = 0.0 if total < 0 else scale * total  # NaN remains NaN
            gradient0[i], gradient1[i] = scale * (slope0 - slope), scale * (slope1 - slope)


@inline
def _bregman(x: float, y: float) -> tuple[float, float, float]:
    """Return parts of D(x, y) = ln Gamma(x) - ln Gamma(y) - (x - y) digamma(y), and its derivative in y.

    D is the first part minus the logarithm of the second part, without a multiple of x - y that cancels in the sum
    over the states.
    """
    d, product = x - y, y * (y + 1) * (y + 2)
    inverse, u, v = 1 / product, 1 / (x + 2.5), 1 / (y + 2.5)
    # Recurrence: the sums of 1 / (y + k) and of 1 / (y + k)^2 for k = 0, 1, 2; the second one from products of pairs
    p, q, r = (y + 1) * (y + 2) * inverse, y * (y + 2) * inverse, y * (y + 1) * inverse
    u2, v2 = u * u, v * v
    digamma = v2 * (1 / 24 - v2 * (7 / 960 - v2 * (31 / 8064))) - (p + q + r)
    trigamma = v - v * v2 * (1 / 12 - v2 * (7 / 240 - v2 * (31 / 1344))) + (p * p + q * q + r * r)
    series = v * (1 / 24 - v2 * (7 / 2880 - v2 * (31 / 40320))) - u * (1 / 24 - u2 * (7 / 2880 - u2 * (31 / 40320)))
    first = (x + 2.5) * _log((x + 2.5) * v) + series - d * digamma
    return first, x * (x + 1) * (x + 2) * inverse, -d * trigamma


@inline
def _log(x: float) -> float:
    """Return ln(x) of a normal number, with an error below 1e-10. A loop with `math.log` would not be vectorised."""
    bits = np.float64(x).view(np.int64)
    exponent = (bits - _SQRT_HALF) >> 52
    m = np.int64(bits - (exponent << 52)).view(np.float64)  # x = m 2^exponent, m from sqrt(1/2) to sqrt(2)
    s = (m - 1) / (m + 1)
    q = s * s
    series = 1 + q * (1 / 3 + q * (1 / 5 + q * (1 / 7 + q * (1 / 9 + q * (1 / 11)))))
    return exponent * _LOG_2 + 2 * s * series
