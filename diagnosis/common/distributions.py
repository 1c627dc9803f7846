"""Tails and quantiles of the distributions that tests need.

From scipy.special, whose values scipy.stats returns as well: to import that takes as long as a
short diagnosis.
"""

from scipy import special


def t_sf(x, freedom):
    """Probability of a larger value than x under Student's t."""
    return special.stdtr(freedom, -x)


def t_ppf(p, freedom):
    """Quantile of Student's t."""
    return special.stdtrit(freedom, p)


def f_sf(x, above, below):
    """Probability of a larger value than x under F with degrees of freedom (above, below)."""
    return special.fdtrc(above, below, x)


def chi2_sf(x, freedom):
    """Probability of a larger value than x under chi-squared."""
    return special.chdtrc(freedom, x)


def chi2_ppf(p, freedom):
    """Quantile of chi-squared."""
    return 2 * special.gammaincinv(freedom / 2, p)
