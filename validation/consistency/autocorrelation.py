"""How many independent samples a series in time is worth.

Errors of a filter are alike from one step to the next, so that T steps say less than T independent ones. For a sum of
squares of zero-mean Gaussian numbers e_t with covariances C_ts = E[e_t e_sᵀ], the mean and the variance are those of a
scaled χ² with

    ν = (Σ_t tr C_tt)² / Σ_ts ‖C_ts‖²

degrees of freedom (F. Satterthwaite, "An approximate distribution of estimates of variance components", 1946). The
covariances are estimated from the series itself, up to the first lag at which it is not correlated any more
(C. Geyer, "Practical Markov chain Monte Carlo", 1992).
"""

import numpy as np


def degrees_of_freedom(white: np.ndarray) -> float:
    """Effective degrees of freedom of Σ_t |e_t|².

    The mean of an honest series is known to be zero and is not subtracted: an error that never changes its sign is one
    sample, however long it lasts.

    Args:
        white: (T, d) errors, whitened by their own covariances.

    Returns:
        ν in [1, T·d]; 0 without any.
    """
    total = white.shape[0]
    power = float(np.square(white).sum())
    if not power > 0.0:
        return float(white.size)
    shared = float(np.square(white.T @ white).sum())
    for lag in range(1, total):
        lagged = white[:-lag].T @ white[lag:]
        if np.trace(lagged) <= 0.0:
            break
        shared += 2.0 * float(np.square(lagged).sum()) * total / (total - lag)
    return float(np.clip(total * power**2 / shared, 1.0, white.size))


def correlation_time(series: np.ndarray) -> float:
    """Integrated autocorrelation time of a series (T,): T of its values say as much as T / time independent ones.

    Sums of neighbouring autocorrelations are added up to the first that is not positive (Geyer 1992, §3.3).

    Returns:
        At least 1; 1 for a series too short to tell.
    """
    centred = series - series.mean() if series.size else series
    power = float(np.square(centred).sum())
    if series.size < 4 or not power > 0.0:
        return 1.0
    spectrum = np.abs(np.fft.rfft(centred, 2 * series.size)) ** 2
    correlation = np.fft.irfft(spectrum)[: series.size] / power
    pairs = correlation[: series.size // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0.0)
    kept = pairs[: negative[0]] if negative.size else pairs
    return max(1.0, 2.0 * float(kept.sum()) - 1.0)
