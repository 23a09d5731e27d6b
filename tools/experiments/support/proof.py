"""What a count of failures in random trials proves of their share."""

from scipy.stats import beta


def proved_share(wrong: int, n: int) -> float:
    """The largest share of which so few of ``n`` would still be seen once in twenty times (Clopper-Pearson)."""
    return float(beta.ppf(0.95, wrong + 1, n - wrong)) if wrong < n else 1.0
