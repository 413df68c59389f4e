"""Entropy and Kullback-Leibler divergence of Dirichlet densities, stable from alpha = 1e-3 to 1e6 and beyond.

The textbook formula subtracts numbers of the size of ln Gamma(alpha), 1e7 for alpha = 1e6, to get one that
may be 1e-13. Here ln Gamma and digamma are split into Stirling's part and a small remainder (Binet's
function),

    ln Gamma(x) = (x - 1/2) ln x - x + ln(2 pi) / 2 + r(x),     digamma(x) = ln x - 1 / (2 x) + r'(x),

the large parts are cancelled on paper, and what is left is a sum of numbers about as small as the result.
Computed in float64 whatever the input; the result has the caller's dtype.
"""

from typing import Any

import numpy as np

from ogm.evidence.arrays import Array, check_alike, dtype_name, maybe_any, namespace

__all__ = ["dirichlet_entropy", "dirichlet_kl"]

_HALF_LOG_2PI = 0.9189385332046727
_SERIES_FROM = 10.0  # from here on six terms of the asymptotic series are exact to 1e-15
_CLOSE = 1e-4  # relative difference of two alphas, below which the series in it is the better one


def dirichlet_kl(alpha: Array, other: Array) -> Array:
    """Return KL[Dir(alpha) || Dir(other)] in nats, never negative.

    The other direction is ``dirichlet_kl(other, alpha)``; the two differ much. With the truth in `other`, a
    missed cell costs E - ln(1 + E) and a false claim ln(1 + E) - E / (1 + E) for an evidence of E.

    Parameters
    ----------
    alpha, other : (..., K) float32 or float64, numpy or torch
        Dirichlet parameters, greater than 0, K >= 2; see `evidence_to_alpha`.

    Returns
    -------
    (...), in [0, inf)

    Notes
    -----
    ln B(other) - ln B(alpha) + sum (alpha - other) digamma(alpha) - (S - S') digamma(S), regrouped; where all
    relative differences are below 1e-4, the series of it to third order. Against 60 digits, for alpha from
    1e-3 to 1e7: the error is below 1e-11 (1 + value), and below 1 % of the value down to a value of 1e-15.
    """
    xp = _check_alpha(alpha, "alpha")
    _check_alpha(other, "other")
    check_alike(alpha, other, ("alpha", "other"))
    if alpha.shape[-1] != other.shape[-1]:  # type: ignore[attr-defined]
        raise ValueError(
            f"alpha and other must have the same number of states on their last axis, "
            f"got shapes {tuple(alpha.shape)} and {tuple(other.shape)}"  # type: ignore[attr-defined]
        )
    x, y = _double(xp, other), _double(xp, alpha)  # KL[Dir(y) || Dir(x)]: the density moves from y to x
    x_sum, y_sum = x.sum(-1), y.sum(-1)
    ratio, t = x / y, (x - y) / y
    ratio_sum, t_sum = x_sum / y_sum, (x_sum - y_sum) / y_sum
    # Stirling's leading part: sum(other) times the categorical KL of the means.
    mean_ratio = ratio / ratio_sum[..., None]
    small = abs(t_sum) < 0.5
    tau = xp.where(small[..., None], (t - t_sum[..., None]) / ratio_sum[..., None], mean_ratio - 1)
    means = x_sum * (y / y_sum[..., None] * (mean_ratio * _log(xp, mean_ratio, tau) - tau)).sum(-1)
    # Stirling's part -1/2 ln x.
    spread = 0.5 * ((t - _log(xp, ratio, t)).sum(-1) - (t_sum - _log(xp, ratio_sum, t_sum)))
    # The remainder, as the Bregman divergence of r.
    rest = _bregman_of_remainder(xp, x, y).sum(-1) - _bregman_of_remainder(xp, x_sum, y_sum)
    divergence = means + spread + rest
    # Very near densities: two terms of the series in the difference, the first one the Fisher information.
    close = (abs(t) < _CLOSE).all(-1)
    if maybe_any(xp, close):
        near = _series(xp, x, y).sum(-1) - _series(xp, x_sum, y_sum)
        divergence = xp.where(close, near, divergence)
    return _cast(xp, divergence.clip(0), alpha)


def dirichlet_entropy(alpha: Array) -> Array:
    """Return the differential entropy of Dir(alpha) in nats.

    It is 0 for the uniform Beta density and below 0 for all others.

    Parameters
    ----------
    alpha : (..., K) float32 or float64, numpy or torch
        Dirichlet parameters, greater than 0, K >= 2.

    Returns
    -------
    (...)

    Notes
    -----
    ln B(alpha) + (S - K) digamma(S) - sum (alpha - 1) digamma(alpha), regrouped.
    """
    xp = _check_alpha(alpha, "alpha")
    x = _double(xp, alpha)
    total = x.sum(-1)
    k = x.shape[-1]
    logs = 0.5 * xp.log(x).sum(-1) - (k - 0.5) * xp.log(total)
    halves = (0.5 - 0.5 / x).sum(-1) - 0.5 + 0.5 * k / total + (k - 1) * _HALF_LOG_2PI
    remainders = (_remainder(xp, x) - (x - 1) * _remainder_slope(xp, x)).sum(-1)
    whole = _remainder(xp, total) - (total - k) * _remainder_slope(xp, total)
    entropy = logs + halves + remainders - whole
    return _cast(xp, entropy, alpha)


def _check_alpha(alpha: Any, name: str) -> Any:
    xp = namespace(alpha, name)
    if dtype_name(alpha) not in ("float32", "float64"):
        raise TypeError(f"{name} must be float32 or float64, got {dtype_name(alpha)}")
    if alpha.ndim == 0 or alpha.shape[-1] < 2:
        raise ValueError(
            f"{name} must have at least 2 states on its last axis, got shape {tuple(alpha.shape)}"
        )
    if xp is np and alpha.size and not (alpha.min() > 0 and np.isfinite(alpha.max())):
        bad = ~((alpha > 0) & np.isfinite(alpha))
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name} must be finite and greater than 0, but {name}{list(index)} is {alpha[index]}"
        )
    return xp


def _double(xp: Any, values: Any) -> Any:
    return values.astype(np.float64) if xp is np else values.double()


def _cast(xp: Any, values: Any, alpha: Any) -> Any:
    return values.astype(alpha.dtype) if xp is np else values.to(alpha.dtype)


def _log(xp: Any, ratio: Any, t: Any) -> Any:
    """Return ln(ratio) for ratio = 1 + t, from whichever of the two is the more exact."""
    small = abs(t) < 0.5
    return xp.where(small, xp.log1p(xp.where(small, t, 0 * t)), xp.log(ratio))


def _series(xp: Any, x: Any, y: Any) -> Any:
    """Return ln Gamma(x) - ln Gamma(y) - (x - y) digamma(y) to third order in x - y."""
    d = x - y
    return d**2 * (_polygamma(xp, 1, y) / 2 + d * _polygamma(xp, 2, y) / 6)


def _bregman_of_remainder(xp: Any, x: Any, y: Any) -> Any:
    return _remainder(xp, x) - _remainder(xp, y) - (x - y) * _remainder_slope(xp, y)


def _remainder(xp: Any, x: Any) -> Any:
    """Return r(x) = ln Gamma(x) minus Stirling's part: 1/(12 x) - 1/(360 x^3) + ... for large x."""
    large = x >= _SERIES_FROM
    big, small = xp.where(large, x, _SERIES_FROM + 0 * x), xp.where(large, 1 + 0 * x, x)
    s = 1 / big**2
    series = (
        1 / 12 - s * (1 / 360 - s * (1 / 1260 - s * (1 / 1680 - s * (1 / 1188 - s * 691 / 360360))))
    ) / big
    exact = _log_gamma(xp, small) - (small - 0.5) * xp.log(small) + small - _HALF_LOG_2PI
    return xp.where(large, series, exact)


def _remainder_slope(xp: Any, x: Any) -> Any:
    """Return r'(x) = digamma(x) - ln x + 1 / (2 x): -1/(12 x^2) + 1/(120 x^4) - ... for large x."""
    large = x >= _SERIES_FROM
    big, small = xp.where(large, x, _SERIES_FROM + 0 * x), xp.where(large, 1 + 0 * x, x)
    s = 1 / big**2
    series = -s * (1 / 12 - s * (1 / 120 - s * (1 / 252 - s * (1 / 240 - s * (1 / 132 - s * 691 / 32760)))))
    exact = _digamma(xp, small) - xp.log(small) + 0.5 / small
    return xp.where(large, series, exact)


def _special(xp: Any) -> Any:
    """Return the module of special functions; scipy's is loaded here, as it would double the import time."""
    if xp is not np:
        return xp.special
    from scipy import special

    return special


def _log_gamma(xp: Any, x: Any) -> Any:
    return _special(xp).gammaln(x)


def _digamma(xp: Any, x: Any) -> Any:
    return _special(xp).digamma(x)


def _polygamma(xp: Any, order: int, x: Any) -> Any:
    return _special(xp).polygamma(order, x)
