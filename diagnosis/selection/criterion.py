"""The one criterion: log prediction error over horizons, on groups of windows that the values were
not fitted to.

evidence = Evidence(ahead, residual, columns)          # residual (W, T, nv), columns (W, T, nv, K)
score = evidence.score([0, 3], low, high, precision, pull)
score.loss, score.groups, score.amounts
gain = paired(score, other)

A hypothesis predicts residual - columns @ amounts. Its error counts per cell: a channel (a joint, a
free joint's position or rotation) in a band of time ahead, in a group of windows. The loss is the
sum over channels of the mean over bands and groups of log RMS, each group predicted with the
others' amounts, above that of a reference. What is within the noise under both tells nothing of
either: groups count by how far the larger error exceeds it.
"""

from dataclasses import dataclass

import numpy as np

from diagnosis.common.distributions import t_sf

NOISE = 0.3  # of the noise, that counts as none
BEYOND = 1.5  # of the noise, from which on an error counts
ITERATIONS = 3  # of reweighted least squares
INDEPENDENT = 2.0  # errors of a cell, as which it counts where a few groups decide
PRICE = 0.1  # nats of log RMS error, summed over channels, that a unit of complexity has to remove
PAIRS = ["einsum_path", (0, 1), (0, 1)]  # order of a product of three, worked out once


@dataclass(frozen=True)
class Score:
    """loss: sum over channels of mean log RMS above the reference's; groups (G,): the part of each
    group, of which that is the mean; nats (G,): their logs summed; amounts (p,): fitted to all."""

    loss: float
    groups: np.ndarray
    nats: np.ndarray
    amounts: np.ndarray

    def plus(self, prior, number):
        """With the cost of a prior, nats, of so many independent errors."""
        cost = prior / number
        nats = self.nats + prior / len(self.nats)
        return Score(self.loss + cost, self.groups + cost, nats, self.amounts)


@dataclass(frozen=True)
class Comparison:
    """gain: loss removed, in nats of log RMS; p_value: one-sided, that it is none."""

    gain: float
    p_value: float


def complexity(candidates):
    """Of a set of effects: how far each is from the first things to think of, and its freedom."""
    return sum(c.effect.simplicity + (1 + len(c.parameters)) / 2 for c in candidates)


def paired(before, after):
    """Comparison of two Scores, differences paired by group.

    What is predicted better by as much everywhere is told by how little the differences scatter (a
    t-test). What is seen in a few groups alone is told by how much more likely it makes what was
    left out: by chance a ratio of likelihoods exceeds x in no more than one of x cases. The group
    that gains most is not counted: one odd window decides nothing.
    """
    d = before.groups - after.groups
    n, gain = len(d), float(before.loss - after.loss)
    if n < 2 or not np.isfinite(d).all():  # values that are impossible tell nothing
        return Comparison(gain, 1.0)
    spread = np.std(d, ddof=1) / np.sqrt(n)
    alike = t_sf(d.mean() / spread, n - 1) if spread > 0 else 1.0
    each = before.nats - after.nats
    nats = INDEPENDENT * (each.sum() - each.max())
    return Comparison(gain, float(min(alike, np.exp(-max(nats, 0.0)))))


class Evidence:
    """Sums of products of the residual (first) and columns per group and cell: everything a
    hypothesis needs."""

    def __init__(self, ahead, residual, columns, reference=None):
        """reference (G, cells): mean squared errors of what others are compared with; None takes
        this residual's."""
        groups, bands = ahead.group.max() + 1, range(ahead.band.max() + 1)
        stack = np.concatenate([residual[..., None], columns], -1)
        cells = [(dofs, b) for dofs in ahead.channels for b in bands]
        self.count = np.zeros((groups, len(cells)))
        self.channels = len(ahead.channels)
        self.noise, rows = np.zeros(len(cells)), {}
        for j, (dofs, b) in enumerate(cells):
            inside = ahead.known[..., dofs] & (ahead.band == b)[..., None]
            finite = np.isfinite(ahead.noise[dofs])
            self.noise[j] = np.sqrt(np.mean(np.where(finite, ahead.noise[dofs], 0.0) ** 2))
            for g in range(groups):
                w = np.flatnonzero((ahead.group == g) & inside.any((1, 2)))
                if len(w):
                    rows[g, j] = stack[w][:, :, dofs][inside[w]]
                    self.count[g, j] = len(rows[g, j])
        self._keep(rows, stack.shape[-1])
        self.floor = (NOISE * self.noise) ** 2 + 1e-30
        square = self.own[:, :, 0] / np.maximum(self.count, 1)
        self.reference = square if reference is None else reference
        seen = (self.count > 0).any(0).sum()
        self.cells = max(seen / max(self.channels, 1), 1 / groups)  # of a channel in a group
        counting = self._counting(self.reference).sum() / max(seen, 1)
        self.number = self.cells * max(counting, 1.0)

    def _keep(self, rows, width):
        """Keep rows {(group, cell): (n, width)}, columns first, and their squares.

        Products of all columns with all would take the square of their number: those asked for are
        worked out when they are.
        """
        where = sorted(rows)
        self.columns = np.empty((width, sum(len(rows[k]) for k in where)))
        self.cell = np.repeat(
            np.array([g * self.count.shape[1] + j for g, j in where], int),
            [len(rows[k]) for k in where],
        )
        self.first = np.flatnonzero(np.diff(self.cell, prepend=-1))
        for k, a in zip(where, self.first):
            self.columns[:, a : a + len(rows[k])] = rows[k].T
        self.own = np.stack([self._sums(c * c) for c in self.columns], -1)

    def _sums(self, product):
        """(G, cells) of a product of columns (N,)."""
        out = np.zeros(self.count.size)
        if len(product):
            out[self.cell[self.first]] = np.add.reduceat(product, self.first)
        return out.reshape(self.count.shape)

    def products(self, index):
        """(G, cells, p, p): sums of products of columns index (p,), 0 being the residual."""
        chosen = self.columns[index]
        out = np.empty((*self.count.shape, len(index), len(index)))
        for i, a in enumerate(chosen):
            out[:, :, i, i] = self.own[:, :, index[i]]
            for j in range(i):
                out[:, :, i, j] = out[:, :, j, i] = self._sums(a * chosen[j])
        return out

    def _square(self, g, amounts):
        """Mean squared error (G, cells) of amounts (p,) or (G, p), from products() g."""
        z = np.concatenate([np.ones((*amounts.shape[:-1], 1)), -amounts], -1)
        z = np.broadcast_to(z, (len(g), z.shape[-1]))
        square = np.einsum("gi,gcij,gj->gc", z, g, z, optimize=PAIRS)
        return np.maximum(square, 0.0) / np.maximum(self.count, 1)

    def _counting(self, square):
        """How much cells of mean squared errors (G, cells) count, 0 to 1: by their excess."""
        least = (BEYOND * self.noise) ** 2
        return np.where(self.count > 0, 1 - least / np.maximum(square, least + 1e-30), 0.0)

    def _scored(self, square, amounts):
        """The Score of mean squared errors (G, cells)."""
        log = 0.5 * np.log((square + self.floor) / (self.reference + self.floor))
        counting = self._counting(np.maximum(square, self.reference))
        each = counting * log
        groups = len(each) * (each / np.maximum(counting.sum(0), 1.0)).sum(1) / self.cells
        return Score(float(groups.mean()), groups, each.sum(1), amounts)

    def plain(self):
        """Mean log RMS over all groups, counted alike, summed over channels: what a fit lowers."""
        square = self.own[:, :, 0] / np.maximum(self.count, 1)
        log = np.where(self.count > 0, 0.5 * np.log(square + self.floor), 0.0)
        return float(log.sum() / max((self.count > 0).sum(), 1) * self.channels)

    def score(self, columns, low, high, precision, pull):
        """Score of a hypothesis.

        columns: indices (p,); low, high (p,): bounds of the amounts; precision, pull (p,): of a
        quadratic prior, precision/2 amount² - pull amount, in nats.
        """
        index = np.concatenate([[0], np.asarray(columns, int) + 1])
        p, amounts, g = len(index) - 1, np.zeros(len(index) - 1), self.products(index)
        if not p:
            return self._scored(self._square(g, amounts), amounts)
        for _ in range(ITERATIONS):
            each = np.einsum("gc,gcij->gij", self._weight(g, amounts), g)
            whole = each.sum(0)
            amounts = bounded(whole[1:, 1:] + np.diag(precision), whole[1:, 0] + pull, low, high)
        each = np.einsum("gc,gcij->gij", self._weight(g, amounts), g)
        rest = each.sum(0) - each
        left = each_bounded(rest[:, 1:, 1:] + np.diag(precision), rest[:, 1:, 0] + pull, low, high)
        return self._scored(self._square(g, left), amounts)

    def weight(self, index, amounts):
        """(G, cells): weights of squares at which least squares lowers the sum of logs."""
        return self._weight(self.products(index), amounts)

    def _weight(self, g, amounts):
        square = self._square(g, amounts)
        return np.where(
            self.count > 0, 1 / (np.maximum(self.count, 1) * (square + self.floor)), 0.0
        )

    def looks(self, columns, amounts, precision):
        """In-sample gain (K,) in nats of each further column beside some at their amounts: a first
        look."""
        index = np.concatenate([[0], np.asarray(columns, int) + 1])
        weight = self.weight(index, np.asarray(amounts, float))
        beside = self.columns @ (self.columns[index] * weight.ravel()[self.cell]).T
        own = np.einsum("gc,gck->k", weight, self.own)[1:]
        inside = beside[index[1:], 1:] + np.diag(precision)
        score = beside[1:, 0] - beside[1:, 1:] @ amounts
        curve = own.copy()
        if len(index) > 1:
            cross = beside[1:, 1:]
            inside += 1e-9 * np.diag(np.diag(inside))  # of two columns that are the same
            curve -= (cross * np.linalg.solve(inside, cross.T).T).sum(1)
        seen = curve > 1e-9 * np.maximum(own, 1e-300)
        return np.where(seen, score**2 / np.where(seen, curve, 1.0) / 2, 0.0)


def each_bounded(matrices, vectors, low, high):
    """bounded() of matrices (G, p, p) and vectors (G, p): those that meet no bound all at once."""
    scale = np.sqrt(np.maximum(np.einsum("gii->gi", matrices), 1e-300))
    even = matrices / (scale[:, :, None] * scale[:, None]) + 1e-9 * np.eye(len(low))
    start = np.clip(np.zeros(len(low)), low, high)
    free = np.linalg.solve(even, (vectors / scale)[..., None])[..., 0] / scale
    out = start + (free - start)
    for g in np.flatnonzero(~((free >= low) & (free <= high)).all(1)):
        out[g] = bounded(matrices[g], vectors[g], low, high)
    return out


def bounded(matrix, vector, low, high):
    """The minimum of x' matrix x / 2 - vector x between bounds, by an active set of those met."""
    p, fixed = len(vector), np.zeros(len(vector), bool)
    x = np.clip(np.zeros(p), low, high)
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    even = matrix / np.outer(scale, scale) + 1e-9 * np.eye(p)
    for _ in range(4 * p + 1):
        free = np.flatnonzero(~fixed)
        if len(free):
            push = vector[free] / scale[free] - even[np.ix_(free, fixed)] @ (x * scale)[fixed]
            step = np.linalg.solve(even[np.ix_(free, free)], push) / scale[free] - x[free]
            with np.errstate(divide="ignore", invalid="ignore"):
                room = np.where(step > 0, high[free] - x[free], low[free] - x[free]) / step
            share = np.min(np.where(step == 0, 1.0, room), initial=1.0)
            x[free] = np.clip(x[free] + share * step, low[free], high[free])
            if share < 1:
                fixed[free[room <= share]] = True
                continue
        slope = matrix @ x - vector
        inward = np.where(x - low < high - x, -slope, slope) / scale * (fixed & (low < high))
        if not fixed.any() or inward.max() <= 1e-9 * abs(vector / scale).max(initial=0.0):
            break
        fixed[np.argmax(inward)] = False
    return x
