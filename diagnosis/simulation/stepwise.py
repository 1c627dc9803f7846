"""Simulations looked at before each step: forces and dry friction that depend on the state, and
conditions.

failed = Stepwise(batch, cases, recordings, (on, off), begin, step).run(out)

Their models differ in numbers alone, so each number that differs is a field of the Batch with a
value for every simulation, and all of them take a step in one call. The constraint solver sticks
and slips with a level of friction set anew before each step; a force −level·sign(v) would chatter.
"""

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, SimulationError

LOSS = "dof_frictionloss"
VELOCITY_STAGE = int(mujoco.mjtStage.mjSTAGE_VEL)
MOST_LEVEL = float(np.finfo(float).max)  # of friction, in place of infinity


class Side:
    """What acts in simulations while a condition holds, or while it does not.

    drives: (S,) Drives. ctrl (S, count, nu), qfrc (S, nv), xfrc (S, nbody, 6); forces, limits:
    [(members, function)] of what depends on the state; numbers {model field: (S, ...)}.
    """

    def __init__(self, model, drives):
        self.ctrl, self.qfrc, self.xfrc = (
            np.array([getattr(d, f) for d in drives]) for f in ("ctrl", "qfrc", "xfrc")
        )
        self.loaded = []  # simulations whose friction depends on the load
        self.forces = self._functions(model, drives, "force")
        self.limits = self._functions(model, drives, "limit")
        self.numbers = _numbers(model, [d.model for d in drives])
        if self.limits and LOSS not in self.numbers:
            self.numbers[LOSS] = np.tile(model.dof_frictionloss, (len(drives), 1))

    def _functions(self, model, drives, method):
        groups = {}
        for s, drive in enumerate(drives):
            for candidate, values in drive.items:
                if candidate.effect.overrides(method) and drive.model is not None:
                    groups.setdefault(candidate, []).append((s, values))
        found = []
        for candidate, members in groups.items():
            ids, values = map(np.array, zip(*members))
            i = candidate.effect.id(model, candidate.place.name)
            function = getattr(candidate.effect, method)([drives[s].model for s in ids], i, values)
            if function is None:
                continue
            if method == "limit" and candidate.effect.loaded:
                self.loaded += ids.tolist()
            together = len(ids) == ids[-1] - ids[0] + 1
            found.append((slice(ids[0], ids[-1] + 1) if together else ids, function))
        return found

    def push(self, state):
        """Forces (S, nv) at states ((S, nq), (S, nv), (S, nu), (S,))."""
        out = self.qfrc.copy()
        for members, function in self.forces:
            out[members] += function(*(x[members] for x in state))
        return out

    def levels(self, state):
        """Dry friction (S, nv) that the joints hold at states, as of push() and qfrc_bias
        (S, nv)."""
        more = np.zeros_like(self.qfrc)
        for members, function in self.limits:
            level = function(*(x[members] for x in state))
            more[members] += np.minimum(np.fmax(level, 0.0), MOST_LEVEL)
        return self.numbers[LOSS] + more


class Stepwise:
    """Simulations of a Batch, as many as it has, whose state is set. begin (S,): their times."""

    def __init__(self, batch, cases, recordings, drives, begin, step):
        """drives: lists of the Drives (S,) while the condition of each holds, and while not."""
        self.batch, self.begin, self.step = batch, begin, step
        self.low, self.high = np.array([_span(c.when, r) for c, r in zip(cases, recordings)]).T
        conditional = any(c.when for c in cases)
        self.sides = [Side(batch.model, side) for side in drives[: 1 + conditional]]
        self._complete()
        self.fields = {name: batch.expand(name) for name in self.sides[0].numbers}
        self.loaded = np.unique([s for side in self.sides for s in side.loaded]).astype(np.int32)
        self.bias = (
            batch.bind("qfrc_bias") if len(self.loaded) else np.zeros_like(self.sides[0].qfrc)
        )

    def _complete(self):
        """Every side has every number that one of them has."""
        model, every = self.batch.model, {name for side in self.sides for name in side.numbers}
        for side in self.sides:
            for name in sorted(every - set(side.numbers)):
                value = number(model, name)
                side.numbers[name] = np.tile(value, (len(side.qfrc), *[1] * value.ndim))

    def run(self, out):
        """Step until out {field: (S, count, ...)} is full; returns the steps (S,) at which
        simulations failed, `count` of those that did not."""
        batch, ids = self.batch, np.arange(len(self.begin), dtype=np.int32)
        live = {f: batch.bind(f) for f in {"ctrl", "qfrc_applied", "xfrc_applied", *out}}
        state = [batch.bind(f) for f in ("qpos", "qvel", "ctrl")]
        count, width = next(iter(out.values())).shape[1], self.sides[0].ctrl.shape[1]
        failed, active, warnings = np.full(len(ids), count), None, batch.warning[:, :, 1]
        for k in range(count):
            time = self.begin + k * self.step
            now = (self.low <= time) & (time < self.high)
            if active is None or (now != active).any():
                active = now
                live["xfrc_applied"][:] = self._chosen(active, lambda side: side.xfrc)
                for name, field in self.fields.items():
                    field[:] = self._chosen(active, lambda side: side.numbers[name])
            j = min(k, width - 1)
            live["ctrl"][:] = self._chosen(active, lambda side: side.ctrl[:, j])
            seen = *state, time
            live["qfrc_applied"][:] = self._chosen(active, lambda side: side.push(seen))
            if LOSS in self.fields:
                if len(self.loaded):
                    batch.forward(self.loaded, VELOCITY_STAGE)
                seen = *seen, self.bias
                self.fields[LOSS][:] = self._chosen(active, lambda side: side.levels(seen))
            try:
                batch.step(ids)
            except SimulationError as error:
                failed[error.ids] = np.minimum(failed[error.ids], k)
            if warnings.any():
                warned = warnings.any(axis=1)
                failed[warned] = np.minimum(failed[warned], k)
            for f, values in out.items():
                values[:, k] = live[f]
        return failed

    def _chosen(self, active, of):
        """of(side) of the side that each simulation is on."""
        if len(self.sides) == 1:
            return of(self.sides[0])
        on, off = map(of, self.sides)
        return np.where(active.reshape(-1, *[1] * (on.ndim - 1)), on, off)


def _span(when, recording):
    """(from, to) of a recording's time in which a condition holds, s; infinite where always."""
    if not when:
        return -np.inf, np.inf
    return when["time"] if when["recording"] in (None, recording.name) else (np.inf, np.inf)


def number(model, name):
    """A field of MODEL_FIELDS in a model, as an array."""
    of, _, field = name.rpartition(".")
    return np.asarray(getattr(model.opt if of else model, field))


def _numbers(model, others):
    """{field: (S, ...)} of what differs between a model and one of S others, or None for itself."""
    base = {name: number(model, name) for name in sorted(MODEL_FIELDS)}
    base = {name: value for name, value in base.items() if value.size}
    own, found = {}, {}
    for other in {id(o): o for o in others if o is not None}.values():
        own[id(other)] = values = {}
        for name, value in base.items():
            new = number(other, name)
            if (new != value).any():
                values[name] = found[name] = new
    return {
        name: np.array([own.get(id(o), {}).get(name, base[name]) for o in others]) for name in found
    }
