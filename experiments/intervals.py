"""Rates and differences with 95 % intervals, of one trained model or of several."""

from collections.abc import Iterable, Sequence

import numpy as np
from rows import Row, Scored

from ct_jax.evaluate import wilson_of

INTERVALS = (
    "Intervals are 95 % Wilson intervals. For several models, an interval also covers the 95 % interval of a bootstrap "
    "over models and pairs."
)


def pooled(rows: Sequence[Scored], name: str) -> str:
    """A rate over all models, in percent with its interval."""
    rate, low, high = rate_of(rows, name)
    return f"{rate:.1f} ({low:.0f} to {high:.0f})"


def rate_of(rows: Sequence[Scored], name: str) -> tuple[float, float, float]:
    """A rate over all models and the ends of its interval [%].

    Several models are evaluated on the same pairs, so their episodes are not independent. Each end of their interval
    is the outer one of two intervals: Wilson's, and a bootstrap over models and pairs.
    """
    n = sum(row.episodes for row in rows)
    low, high = wilson_of(sum(round(row.rate(name) * row.episodes) for row in rows), n)
    rate = sum(row.rate(name) * row.episodes for row in rows) / n
    if len(rows) > 1 and all(name in (row.outcomes or ()) for row in rows):
        ends = interval_of_mean(np.stack([row.flags(name) for row in rows]))
        low, high = min(low, ends[0]), max(high, ends[1])
    return 100 * rate, 100 * low, 100 * high


def interval_of_mean(values: np.ndarray) -> tuple[float, float]:
    """95 % interval of the mean of values [models, pairs]: a bootstrap over both models and pairs."""
    rng = np.random.default_rng(0)
    models, pairs = (rng.integers(n, size=(10_000, n)) for n in values.shape)
    means = [values[np.ix_(m, p)].mean() for m, p in zip(models, pairs, strict=True)]
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


Pair = tuple[Row, Row]  # the rows of one model before and after fine-tuning


def of_one_model(before: Iterable[Row], after: Iterable[Row]) -> list[Pair]:
    """Pairs of rows, CT and F-CT, with the same seed and the same low-level controller."""
    first = {(row.model_seed, row.controller): row for row in before}
    pairs = [(first.get((row.model_seed, row.controller)), row) for row in after]
    return [(ct, tuned) for ct, tuned in pairs if ct is not None]


def gain_of(models: Sequence[Pair]) -> str:
    """F-CT − CT in percentage points with its interval, computed for each pair and each model."""
    changes = [after.flags("success") - before.flags("success") for before, after in models]
    low, high = interval_of_mean(np.stack(changes))
    return f"{100 * np.mean(changes):+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"
