"""Each finding's value from each recording alone: which of three answers is right?

    summary = with_each_recording(world, settings, recordings, summary)

From the values of all, one step of Gauss and Newton towards what each recording alone asks for, all
parameters together, on windows of WINDOW seconds, begun where they themselves ask for it. What
another start would change is left out of the comparison, to first order. Errors come from the
scatter between windows, so that they hold for motion that no finding explains, too.
"""

import numpy as np

from diagnosis.common.distributions import t_ppf
from diagnosis.recordings.columns import WIDTHS
from diagnosis.report.constancy import between_runs, constancy, table, words
from diagnosis.report.text import UNSTEADY
from diagnosis.simulation.simulator import Window

WINDOW = 0.4  # s
MOST, LEAST = 80, 6  # windows in all; of one recording, below which it says nothing by itself
STEP = 0.02  # of a value, or of its parameter's own step where that is more
MOVE = 3.0  # noises, by which starts are moved
UNSEEN = 3.0  # its error over the value of all, above which a recording does not show it


def with_each_recording(world, settings: dict, recordings: list, summary: dict) -> dict:
    """The summary whose findings have `per_recording` and `constancy`, those that can be simulated,
    and whose warnings name what is not one value, with the variable that it goes along with.

    settings: {Candidate: values} of the findings; recordings: those fitted, R of them. Forces
    without a name stay as they are, and have neither.
    """
    known = {c: v for c, v in settings.items() if not c.when}
    if len(recordings) < 2 or not any(map(_named, known)):
        return summary
    found = estimates(world, known, recordings, summary["noise"])
    names = [r.name for r in recordings]
    findings = []
    for finding in summary["findings"]:
        entries, p = _entries(finding, found, names, known)
        more = {"per_recording": entries, "constancy": p} if entries else {}
        findings.append({**finding, **more})
    labelled = {
        f"{c.place.name}: {c.effect.name}, {c.parameters[k].name}": v for (c, k), v in found.items()
    }
    rows = table(labelled, names, between_runs(recordings, world.model))
    told = [words(row) for row in rows if row.p < UNSTEADY]
    return {**summary, "findings": findings, "warnings": summary.get("warnings", []) + told}


def _named(candidate):
    return candidate.effect.name != "unknown"


def _entries(finding, found, names, settings):
    """(rows of per_recording, p of constancy: the smallest of its parameters', None where no two
    recordings show one) of one finding."""
    rows, p = [], []
    for (candidate, k), (values, errors) in found.items():
        place = candidate.place.kind, candidate.place.name
        if finding.get("when") or (finding["effect"], finding["place"]) != (
            candidate.effect.name,
            {"kind": place[0], "name": place[1]},
        ):
            continue
        size = np.maximum(abs(settings[candidate][k]), abs(values) - 2 * errors)
        known = np.isfinite(values) & (errors < UNSEEN * size)
        p += [constancy(values, errors)] if known.sum() > 1 else []
        for name, value, error, shown in zip(names, values, errors, known):
            rows.append(
                {
                    "recording": name,
                    "parameter": candidate.parameters[k].name,
                    "value": float(value) if shown else None,
                    "interval": [float(value - 1.96 * error), float(value + 1.96 * error)]
                    if shown
                    else None,
                }
            )
    return rows, min(1.0, min(p) * len(p)) if p else None


def estimates(world, settings: dict, recordings: list, noise: dict) -> dict:
    """{(Candidate, parameter's index): (values (R,), standard errors (R,))}, NaN where not
    shown."""
    labels, cases = _cases(settings)
    out = {
        label: (np.full(len(recordings), np.nan), np.full(len(recordings), np.nan))
        for label in labels
    }
    share = max(LEAST, MOST // len(recordings))
    for r, recording in enumerate(recordings):
        residual, slopes = _compared(world, recording, cases, noise, share)
        if len(residual) < LEAST:
            continue
        change, spread = _step(residual, slopes)
        for n, (candidate, k) in enumerate(labels):
            size = cases[n + 1][1]
            out[candidate, k][0][r] = settings[candidate][k] + size * change[n]
            out[candidate, k][1][r] = abs(size) * spread[n]
    return out


def _cases(settings):
    """(labels, [(setting, step)]): that of all, then with a step in each parameter with a name."""
    labels, cases = [], [(settings, 0.0)]
    for candidate, values in settings.items():
        if not _named(candidate):
            continue
        for k, (parameter, value) in enumerate(zip(candidate.parameters, values)):
            if not np.isfinite(value):
                continue
            step = max(STEP * abs(value), 0.1 * parameter.step)
            step = step if value + step <= parameter.high else -step
            moved = (*values[:k], value + step, *values[k + 1 :])
            cases.append(({**settings, candidate: moved}, step))
            labels.append((candidate, k))
    return labels, cases


def _compared(world, recording, cases, noise, most):
    """(residual (W, N), slopes (W, N, P)) of windows of a recording, in noises, 0 where unknown,
    without what another start of each window would change.

    The starts are first moved to where each window asks for them. Where friction turns depends on
    them, and the slopes at a start as noisy as the recording do not tell how."""
    windows, qpos, qvel = _windows(recording, most)
    if not windows or not _sizes(world.model, noise):
        return np.zeros((0, 0)), np.zeros((0, 0, 0))
    seen = np.stack([recording.qpos[w.first : w.last + 1] for w in windows])
    moves = _moves(world.model, noise, np.median(np.diff(recording.time)))
    settings = [setting for setting, _ in cases]
    told = _told(world, settings[:1], windows, (qpos, qvel), moves)
    residual, slopes = _gaps(world.model, noise, told, seen)
    amounts = np.clip((np.linalg.pinv(slopes) @ residual[..., None])[..., 0], -1.0, 1.0)
    for amount, (dq, dv) in zip(amounts.T, moves):
        qpos, qvel = qpos + np.outer(amount, dq), qvel + np.outer(amount, dv)
    told = _told(world, settings, windows, (qpos, qvel), moves)
    fine = np.isfinite(told).all(axis=(0, 2, 3))
    residual, slopes = _gaps(world.model, noise, told[:, fine], seen[fine])
    slopes, starts = np.split(slopes, [len(cases) - 1], axis=2)
    basis = np.linalg.qr(starts)[0]
    rest = lambda x: x - basis @ (np.swapaxes(basis, 1, 2) @ x)
    return rest(residual[..., None])[..., 0], rest(slopes)


def _moves(model, noise, step):
    """[(nq,), (nv,)] by which starts are moved: each joint's position by MOVE noises, then each
    one's velocity by as many a row of `step` seconds."""
    moves = []
    for j, size in _sizes(model, noise):
        moves.append((MOVE * size * np.eye(model.nq)[model.jnt_qposadr[j]], np.zeros(model.nv)))
    for j, size in _sizes(model, noise):
        speed = MOVE * size / step
        moves.append((np.zeros(model.nq), speed * np.eye(model.nv)[model.jnt_dofadr[j]]))
    return moves


def _sizes(model, noise):
    """[(joint, noise)] of the joints of one coordinate that were measured."""
    names = {j: f"qpos:{model.joint(j).name}" for j in range(model.njnt) if _single(model, j)}
    return [(j, noise[name]) for j, name in names.items() if noise.get(name)]


def _told(world, settings, windows, starts, moves):
    """(S + M, W, T, nq) of the windows under each setting, and under the first from starts that
    each of M moves has moved."""
    begun = [starts] * len(settings) + [(starts[0] + dq, starts[1] + dv) for dq, dv in moves]
    settings = [*settings, *settings[:1] * len(moves)]
    qpos, _ = world.simulate(
        [setting for setting in settings for _ in windows],
        *(np.concatenate(some) for some in zip(*begun)),
        windows * len(settings),
    )
    return qpos.reshape(len(settings), len(windows), -1, world.model.nq)


def _gaps(model, noise, told, seen):
    """(residual (W, N), slopes (W, N, P)) in noises: what was seen (W, T, nq) beyond told[0], and
    each further one of told (1 + P, W, T, nq) beyond it; 0 where nothing was measured."""
    joints, sizes = zip(*_sizes(model, noise))
    column = model.jnt_qposadr[list(joints)]
    seen, told = seen[..., column], told[..., column]
    parts = np.concatenate([seen[None] - told[:1], told[1:] - told[:1]]) / sizes
    parts = np.where(np.isfinite(parts), parts, 0.0)
    parts = parts.reshape(len(told), len(seen), -1)
    return parts[0], np.moveaxis(parts[1:], 0, -1)


def _single(model, j):
    return model.jnt_type[j] not in WIDTHS


def _windows(recording, most):
    """(windows, qpos (W, nq), qvel (W, nv)): at most so many, whose start is known."""
    rows = max(5, int(round(WINDOW / np.median(np.diff(recording.time)))))
    firsts = np.arange(1, len(recording.time) - rows - 1, rows)
    starts = [(first, *_start(recording, first)) for first in firsts]
    starts = [s for s in starts if np.isfinite(s[1]).all() and np.isfinite(s[2]).all()]
    if not starts:
        return [], None, None
    few = np.unique(np.linspace(0, len(starts) - 1, most).astype(int))
    firsts, qpos, qvel = zip(*(starts[n] for n in few))
    return [Window(recording, f, f + rows) for f in firsts], np.array(qpos), np.array(qvel)


def _start(recording, row):
    """(qpos, qvel) recorded at a row, velocities by central differences where not measured."""
    span = recording.time[row + 1] - recording.time[row - 1]
    velocity = recording.qvel[row]
    if recording.qpos.shape[1] == len(velocity):
        between = (recording.qpos[row + 1] - recording.qpos[row - 1]) / span
        velocity = np.where(np.isfinite(velocity), velocity, between)
    return recording.qpos[row], velocity


def _step(residual, slopes):
    """(change (P,), standard error (P,)) in steps: least squares, and the jackknife over windows,
    widened as Student's t asks for so few."""
    grams = np.einsum("wnp,wnq->wpq", slopes, slopes)
    scores = np.einsum("wnp,wn->wp", slopes, residual)

    def solved(gram, score):
        return np.linalg.pinv(gram, rcond=1e-10, hermitian=True) @ score

    gram, score = grams.sum(axis=0), scores.sum(axis=0)
    without = np.array([solved(gram - g, score - s) for g, s in zip(grams, scores)])
    count = len(residual)
    spread = (count - 1) / count * ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    return solved(gram, score), np.sqrt(spread) * t_ppf(0.975, count - 1) / 1.96
