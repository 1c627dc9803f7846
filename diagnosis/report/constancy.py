"""Many recordings, one machine: is a finding's value the same in all of them, and with what does it
change?

    p = constancy(values, standard_errors)              # Cochran's Q; small: it is not one value
    rows = table({"coulomb_friction at elbow": (values, standard_errors)}, names,
    between_runs(recordings, model))

Users ask which of three answers is right. Where p is not small all of them are, within their
intervals, and the pooled value is the best of them; where it is small none is, and the variable
that the values go along with says what to look at.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from diagnosis.common.distributions import chi2_sf, t_sf
from diagnosis.recordings.columns import WIDTHS

LEAST = 0.05  # p below which a value is not constant
FEWEST = 4  # recordings, from which on a line through values means something


@dataclass(frozen=True)
class Row:
    """One parameter over R recordings.

    name; recordings: their names; values, errors (R,): NaN where a recording does not show it;
    pooled, pooled_error: weighted mean, its standard error widened where the values scatter more
    than theirs; p: of constancy; scatter: standard deviation between recordings beyond their
    errors; along: (variable, slope, p) that the values go along with, or None.
    """

    name: str
    recordings: tuple
    values: np.ndarray
    errors: np.ndarray
    pooled: float
    pooled_error: float
    p: float
    scatter: float
    along: tuple | None


def constancy(values: Sequence[float], standard_errors: Sequence[float]) -> float:
    """p of Cochran's Q: how often values of one constant would scatter at least so much around
    their weighted mean.

    values, standard_errors (R,), in one unit; NaN in either leaves a recording out. 1 where fewer
    than two are left: nothing speaks against it.
    """
    values, weights = _known(values, standard_errors)
    if len(values) < 2:
        return 1.0
    mean = weights @ values / weights.sum()
    return float(chi2_sf(weights @ (values - mean) ** 2, len(values) - 1))


def _known(values, standard_errors):
    """Values and weights of the recordings that show them."""
    values, errors = (np.asarray(x, dtype=float) for x in (values, standard_errors))
    known = np.isfinite(values) & np.isfinite(errors) & (errors > 0)
    return values[known], errors[known] ** -2


def between(values: Sequence[float], standard_errors: Sequence[float]) -> float:
    """Standard deviation between recordings beyond their own errors (DerSimonian and Laird's moment
    estimate)."""
    values, weights = _known(values, standard_errors)
    if len(values) < 2:
        return 0.0
    mean = weights @ values / weights.sum()
    excess = weights @ (values - mean) ** 2 - (len(values) - 1)
    room = weights.sum() - (weights**2).sum() / weights.sum()
    return float(np.sqrt(max(0.0, excess / room)))


def pooled(values: Sequence[float], standard_errors: Sequence[float]) -> tuple[float, float]:
    """(weighted mean, its standard error), with the scatter between recordings as part of each
    one's error."""
    more = between(values, standard_errors)
    values, weights = _known(values, standard_errors)
    if not len(values):
        return float("nan"), float("nan")
    weights = 1 / (1 / weights + more**2)
    return float(weights @ values / weights.sum()), float(weights.sum() ** -0.5)


def goes_along(
    values: Sequence[float], standard_errors: Sequence[float], variables: Mapping[str, np.ndarray]
) -> tuple[str, float, float] | None:
    """(variable, change of the value per unit of it, p) of the variable between runs that values
    (R,) follow best, or None.

    Weighted lines with scatter about them; p is Student's, times the number of variables that were
    looked at (Bonferroni). Needs FEWEST recordings, and a p below LEAST.
    """
    values, errors = (np.asarray(x, dtype=float) for x in (values, standard_errors))
    known, best = np.isfinite(values) & np.isfinite(errors) & (errors > 0), None
    tried = {
        name: np.asarray(x, dtype=float)[known]
        for name, x in variables.items()
        if np.isfinite(np.asarray(x, dtype=float)[known]).all() and np.ptp(x) > 0
    }
    if known.sum() < FEWEST:
        return None
    weights = 1 / (errors[known] ** 2 + between(values, standard_errors) ** 2)
    for name, x in tried.items():
        x = x - weights @ x / weights.sum()
        y = values[known] - weights @ values[known] / weights.sum()
        if not (weights @ x**2 > 0):
            continue
        slope = (weights * x) @ y / (weights @ x**2)
        left = weights @ (y - slope * x) ** 2 / (len(x) - 2)
        error = np.sqrt(max(left, 1e-300) / (weights @ x**2))
        p = min(1.0, len(tried) * 2 * float(t_sf(abs(slope) / error, len(x) - 2)))
        if p < LEAST and (best is None or p < best[2]):
            best = name, float(slope), p
    return best


def between_runs(recordings, model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """What differs between recordings, {variable: (R,)}: their order, and of each joint the mean
    position (rad or m) and the RMS speed (rad/s or m/s), of each control the RMS."""
    out = {"the order of the recordings": np.arange(len(recordings), dtype=float)}
    for j in range(model.njnt):
        if model.jnt_type[j] in WIDTHS:
            continue
        name, q = model.joint(j).name or str(j), model.jnt_qposadr[j]
        known = [np.isfinite(r.qpos[:, q]) for r in recordings]
        out[f"mean position of {name}"] = np.array(
            [r.qpos[k, q].mean() if k.any() else np.nan for r, k in zip(recordings, known)]
        )
        out[f"speed of {name}"] = np.array(
            [_rms(np.diff(r.qpos[k, q]) / np.diff(r.time[k])) for r, k in zip(recordings, known)]
        )
    for a in range(model.nu):
        name = model.actuator(a).name if a < model.nactuator else str(a)
        out[f"control of {name or a}"] = np.array([_rms(r.ctrl[:, a]) for r in recordings])
    return out


def _rms(x):
    return float(np.sqrt(np.mean(x * x))) if len(x) else float("nan")


def table(
    findings: Mapping[str, tuple], recordings: Sequence[str], variables: Mapping[str, np.ndarray]
) -> list[Row]:
    """A Row for each {name: (values (R,), standard errors (R,))}."""
    rows = []
    for name, (values, errors) in findings.items():
        p = constancy(values, errors)
        rows.append(
            Row(
                name,
                tuple(recordings),
                np.asarray(values, dtype=float),
                np.asarray(errors, dtype=float),
                *pooled(values, errors),
                p,
                between(values, errors),
                goes_along(values, errors, variables) if p < LEAST else None,
            )
        )
    return rows


def words(row: Row) -> str:
    """What a row says, in one sentence."""
    shown = np.isfinite(row.values).sum()
    value = f"{row.pooled:.3g} ± {1.96 * row.pooled_error:.2g}"
    if shown < 2:
        return f"{row.name}: {value}, shown by {shown} of {len(row.values)} recordings"
    if row.p >= LEAST:
        return f"{row.name}: {value} in all {shown} recordings that show it (p {row.p:.2g})"
    line = (
        f"{row.name}: not one value: it scatters by {row.scatter:.2g} between recordings beyond "
        f"their errors (p {row.p:.1g}); {value} on average"
    )
    if row.along:
        variable, slope, p = row.along
        line += f"; it {'rises' if slope > 0 else 'falls'} with {variable} (p {p:.1g})"
    return line
