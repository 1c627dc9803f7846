"""Dry friction whose level depends on the state: each simulation's own frictionloss, set anew
before each step.

The constraint solver then sticks and slips as with a constant frictionloss; a force −level·sign(v)
would chatter.
"""

from copy import copy

import numpy as np

MOST_CLONES = 4096  # models of their own kept for the next call


class VariableFriction:
    """The levels of simulations that share a working model.

    drives: (S,) Drives. groups: [(members, function)] as of Effect.limit. pool: clones, kept by
    the caller. models: the model each simulation runs on, a clone of its own where its friction
    varies.
    """

    def __init__(self, drives, groups, nominal, pool):
        self.groups = [(np.asarray(ids), function) for ids, function in groups]
        self.models = [drive.model or nominal for drive in drives]
        self.varying = sorted({int(s) for ids, _ in self.groups for s in ids})
        used = {}
        for s in self.varying:
            base = self.models[s]
            _, clones = pool.setdefault(
                id(base), (base, [])
            )  # holding the base keeps its id its own
            k = used[id(base)] = used.get(id(base), -1) + 1
            if k == len(clones):
                clones.append(copy(base))
            self.models[s] = clones[k]
            clones[k].dof_frictionloss[:] = base.dof_frictionloss
        self._fields = [self.models[s].dof_frictionloss for s in self.varying]
        self._dofs = set()  # those whose level has been other than the model's
        self._least = np.array(
            [(drives[s].model or nominal).dof_frictionloss for s in self.varying]
        )
        if sum(len(clones) for _, clones in pool.values()) > MOST_CLONES:
            pool.clear()

    def set(self, qpos, qvel, ctrl, time, qfrc_bias):
        """Write the levels at these states, (S, ·) each, into the models."""
        levels = np.zeros_like(qvel)
        for members, function in self.groups:
            state = (x[members] for x in (qpos, qvel, ctrl, time, qfrc_bias))
            levels[members] += np.maximum(np.nan_to_num(function(*state)), 0.0)
        self._dofs |= set(np.flatnonzero(levels.any(axis=0)).tolist())
        levels = self._least + levels[self.varying]
        for d in self._dofs:  # one number at a time: quicker than rows of an array
            for field, level in zip(self._fields, levels[:, d].tolist()):
                field[d] = level
