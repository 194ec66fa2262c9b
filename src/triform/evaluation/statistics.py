"""How far a number from some runs may be from that of all runs, and whether two differ by more than chance.

All is exact but Wilson's interval and the signed-rank test of many pairs, and needs no library: times come in steps, so
ranks are tied, and SciPy's signed-rank test has no exact form for ties.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triform.types import FloatArray

#: What an interval leaves out on both sides together.
_OUTSIDE = 0.05
#: Pairs up to which the signed-rank test counts all signs; a normal distribution is as good beyond.
_MOST_COUNTED = 200
#: Differences are rounded to this many decimals, so that floats' own errors are no difference and break no tie.
_DECIMALS = 6


def wilson_interval(count: int, total: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a rate of which ``count`` of ``total`` were observed; NaN without any."""
    if total == 0:
        return np.nan, np.nan
    z_squared = 1.959963984540054**2
    share, spread = count / total, z_squared / total
    middle = (share + spread / 2) / (1 + spread)
    half = np.sqrt(spread * (share * (1 - share) + spread / 4)) / (1 + spread)
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def median_interval(values: NDArray[Any]) -> tuple[float, float]:
    """Return the 95 % interval of a median between two order statistics.

    A value is below the median of all runs with probability 1/2, whatever their distribution, so the k-th smallest and
    the k-th largest of n hold it between them unless fewer than k of n fair coins fall on one side.

    Args:
        values: Values of runs, shape (B,); those that are not finite are left out.

    Returns:
        Low and high, two of the values; ``NaN`` for fewer than six, whose extremes do not reach 95 %.
    """
    defined = np.sort(values[np.isfinite(values)])
    rank = int(np.searchsorted(_fair_coins(len(defined)), _OUTSIDE / 2, side="right"))
    return (float(defined[rank - 1]), float(defined[-rank])) if rank > 0 else (np.nan, np.nan)


def differences(first: NDArray[Any], second: NDArray[Any]) -> FloatArray:
    """Return by how much the values of runs differ (P,), over the P runs of which both are finite, to a millionth.

    Args:
        first: Values, or whether something happened, of runs one way, shape (B,).
        second: The same of the same runs the other way, shape (B,).
    """
    found = np.round(second.astype(np.float64) - first.astype(np.float64), _DECIMALS)
    return np.asarray(found[np.isfinite(found)])


def mcnemar(first: NDArray[Any], second: NDArray[Any]) -> float:
    """Return the p-value of McNemar's exact test: do two outcomes of the same runs have different rates?

    Args:
        first: Whether each run succeeded one way, shape (B,).
        second: Whether the same runs succeeded the other way, shape (B,).

    Returns:
        Probability of pairs as uneven as these if both rates are equal; 1 if no pair differs, ``NaN`` without any.
    """
    if len(first) == 0:
        return np.nan
    gains = differences(first, second)
    gained, lost = int((gains > 0).sum()), int((gains < 0).sum())
    return min(1.0, 2 * float(_fair_coins(gained + lost)[min(gained, lost)]))


def signed_rank(first: NDArray[Any], second: NDArray[Any]) -> float:
    """Return the p-value of Wilcoxon's signed-rank test: do two values of the same runs differ?

    Over the pairs of which both values are finite. Pairs that differ by less than a millionth are left out, and equal
    differences share their mean rank. All signs of up to 200 pairs are counted; the rank sum of more counts as normal.

    Args:
        first: Values of runs one way, shape (B,).
        second: Values of the same runs the other way, shape (B,).

    Returns:
        Probability of a rank sum as far off as this if a difference is as likely as its opposite; 1 if no pair
        differs, ``NaN`` without any pair.
    """
    gains = differences(first, second)
    if len(gains) == 0:
        return np.nan
    gains = gains[gains != 0]
    if len(gains) == 0:
        return 1.0
    _, inverse, counts = np.unique(np.abs(gains), return_inverse=True, return_counts=True)
    # Twice the mean ranks, which are whole numbers.
    ranks = (2 * np.cumsum(counts) - counts + 1)[inverse]
    positive, total = int(ranks[gains > 0].sum()), int(ranks.sum())
    smaller = min(positive, total - positive)
    if len(ranks) > _MOST_COUNTED:
        return math.erfc((total / 2 - smaller) / math.sqrt(float((ranks.astype(np.float64) ** 2).sum()) / 2))
    chances = np.zeros(total + 1)
    chances[0] = 1.0
    for rank in ranks:
        chances[rank:] += chances[:-rank].copy()
        chances /= 2
    return min(1.0, 2 * float(chances[: smaller + 1].sum()))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values for that many questions at once, by Holm's step-down method; ``NaN`` counts as no question.

    Taken together, the chance that any is below 0.05 although no difference is real is at most 5 %.
    """
    given = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(given)
    asked = int(np.isfinite(given).sum())
    factors = np.maximum(1, asked - np.arange(len(given)))
    adjusted = np.empty_like(given)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(factors * given[order]))
    return [float(value) for value in adjusted]


def _fair_coins(tosses: int) -> FloatArray:
    """Return the chances of at most 0, 1, ..., ``tosses`` heads of that many fair coins."""
    heads = np.arange(1, tosses + 1)
    ways = np.cumsum(np.log((tosses - heads + 1) / heads))
    return np.cumsum(np.exp(np.concatenate([[0.0], ways]) - tosses * math.log(2)))
