"""The one criterion: log prediction error over horizons, on groups of windows that the values were
not fitted to.

evidence = Evidence(ahead, residual, columns)          # residual (W, T, nv), columns (W, T, nv, K)
score = evidence.score([0, 3], low, high, precision, pull)
score.loss, score.groups, score.amounts
gain = paired(score, other)

A hypothesis predicts residual - columns @ amounts. Its error counts per cell: a channel (a joint, a
free joint's position or rotation) in a band of time ahead, in a group of windows. The loss is the
sum over channels of the mean over bands and groups of log RMS, each group predicted with the
others' amounts.
"""

from dataclasses import dataclass

import numpy as np

from diagnosis.common.distributions import t_sf

# of a cell's median error over groups, that counts as none: one still window decides nothing
SHARE = 0.1
NOISE = 0.3  # of the noise, that counts as none
GROSS = 5.0  # a window's error over the median, from which on it counts no more
ITERATIONS = 3  # of reweighted least squares
INDEPENDENT = 1.0  # errors of a cell, as which it counts where a few groups decide
PRICE = 0.1  # nats of log RMS error, summed over channels, that a unit of complexity has to remove
PAIRS = ["einsum_path", (0, 1), (0, 1)]  # order of a product of three, worked out once


@dataclass(frozen=True)
class Score:
    """loss: sum over channels of mean log RMS; groups (G,): the same of each group; amounts (p,):
    fitted to all; cells: of a channel in a group."""

    loss: float
    groups: np.ndarray
    amounts: np.ndarray
    cells: float


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
    nats = INDEPENDENT * (d.sum() - d.max()) * before.cells
    return Comparison(gain, float(min(alike, np.exp(-max(nats, 0.0)))))


class Evidence:
    """Sums of products of the residual (first) and columns per group and cell: everything a
    hypothesis needs."""

    def __init__(self, ahead, residual, columns, reference=None):
        """reference (G, cells): floors of the squared error; None makes them of this residual."""
        groups, bands = ahead.group.max() + 1, range(ahead.band.max() + 1)
        stack = np.concatenate([residual[..., None], columns], -1)
        cells = [(dofs, b) for dofs in ahead.channels for b in bands]
        self.count = np.zeros((groups, len(cells)))
        self.channels = len(ahead.channels)
        least, rows = np.zeros(len(cells)), {}
        for j, (dofs, b) in enumerate(cells):
            inside = ahead.known[..., dofs] & (ahead.band == b)[..., None]
            noise = np.where(np.isfinite(ahead.noise[dofs]), ahead.noise[dofs], 0.0)
            least[j] = (NOISE**2) * np.mean(noise**2)
            weight = _weights(residual[..., dofs], inside)
            for g in range(groups):
                w = np.flatnonzero((ahead.group == g) & inside.any((1, 2)))
                if not len(w):
                    continue
                part, here = stack[w][:, :, dofs], inside[w]
                root = np.repeat(np.sqrt(weight[w]), here.sum((1, 2)))
                rows[g, j] = part[here] * root[:, None]
                self.count[g, j] = len(root)
        self._keep(rows, stack.shape[-1])
        square = self.own[:, :, 0] / np.maximum(self.count, 1)
        self.floor = reference
        if reference is None:
            middle = [
                np.median(s[c > 0]) if (c > 0).any() else 0.0
                for s, c in zip(square.T, self.count.T)
            ]
            self.floor = np.tile(least + SHARE**2 * np.array(middle) + 1e-30, (groups, 1))
        seen = (self.count > 0).any(0).sum()
        self.cells = max(seen / max(self.channels, 1), 1 / groups)  # of a channel in a group
        self.number = self.cells * groups

    def _keep(self, rows, width):
        """Keep weighted rows {(group, cell): (n, width)}, columns first, and their squares.

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

    def losses(self, square):
        """Loss of every group (G,) from mean squared errors (G, cells)."""
        log = np.where(self.count > 0, 0.5 * np.log(square + self.floor), 0.0)
        return log.sum(1) / np.maximum((self.count > 0).sum(1), 1) * self.channels

    def score(self, columns, low, high, precision, pull):
        """Score of a hypothesis.

        columns: indices (p,); low, high (p,): bounds of the amounts; precision, pull (p,): of a
        quadratic prior, precision/2 amount² - pull amount, in nats.
        """
        index = np.concatenate([[0], np.asarray(columns, int) + 1])
        p, amounts, g = len(index) - 1, np.zeros(len(index) - 1), self.products(index)
        if not p:
            groups = self.losses(self._square(g, amounts))
            return Score(float(groups.mean()), groups, amounts, self.cells)
        for _ in range(ITERATIONS):
            each = np.einsum("gc,gcij->gij", self._weight(g, amounts), g)
            whole = each.sum(0)
            amounts = bounded(whole[1:, 1:] + np.diag(precision), whole[1:, 0] + pull, low, high)
        each = np.einsum("gc,gcij->gij", self._weight(g, amounts), g)
        rest = each.sum(0) - each
        left = each_bounded(rest[:, 1:, 1:] + np.diag(precision), rest[:, 1:, 0] + pull, low, high)
        groups = self.losses(self._square(g, left))
        return Score(float(groups.mean()), groups, amounts, self.cells)

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


def _weights(residual, inside):
    """(W,): less than one for windows whose error is gross beside the others'."""
    square = np.where(inside, residual**2, 0.0).sum((1, 2)) / np.maximum(inside.sum((1, 2)), 1)
    some = square[inside.any((1, 2))]
    usual = np.median(some) if len(some) else 0.0
    return (
        np.minimum(1.0, GROSS**2 * usual / np.maximum(square, 1e-300))
        if usual
        else np.ones(len(square))
    )


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
