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

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from diagnosis.common.distributions import t_sf
from diagnosis.common.quadratic import bounded
from diagnosis.selection.sums import INDEPENDENT, Sums

NOISE = 0.3  # of the noise, that counts as none
BEYOND = 1.5  # of the noise, from which on an error counts
LIGHTEST = 0.01  # share of its inertia that a joint is taken to have at least
ITERATIONS = 4  # of reweighted least squares
TOGETHER = 16  # hypotheses that are worked out at once
PRICE = 0.1  # nats of log RMS error, summed over channels, that a unit of complexity has to remove
MOMENT = 1  # units of complexity of acting for a while only


@dataclass(frozen=True)
class Score:
    """loss: sum over channels of mean log RMS above the reference's; groups (G,): the part of each
    group, of which that is the mean; logs (G,): its logs summed; amounts (p,): fitted to all;
    independent: errors of a cell that are; prior: its cost, nats."""

    loss: float
    groups: np.ndarray
    logs: np.ndarray
    amounts: np.ndarray
    independent: float = INDEPENDENT
    prior: float = 0.0

    def plus(self, prior, number):
        """With the cost of a prior, nats, of so many independent errors."""
        loss, groups = self.loss + prior / number, self.groups + prior / number
        return replace(self, loss=loss, groups=groups, prior=self.prior + prior)


@dataclass(frozen=True)
class Comparison:
    """gain: loss removed, in nats of log RMS; p_value: one-sided, that it is none."""

    gain: float
    p_value: float


def complexity(candidates):
    """Of a set of effects: how far each is from the first things to think of, and its freedom."""
    at_times = lambda c: MOMENT if c.when and not c.effect.timed else 0.0
    each = lambda c: c.effect.simplicity + at_times(c) + (1 + len(c.parameters)) / 2
    return sum(map(each, candidates))


def paired(before, after):
    """Comparison of two Scores, differences paired by group: the lesser p-value of a t-test and of
    the ratio of likelihoods of independent errors, which by chance exceeds x in one of x cases. In
    that the group that gains most is not counted: one odd window decides nothing."""
    d = before.groups - after.groups
    n, gain = len(d), float(before.loss - after.loss)
    if n < 2 or not np.isfinite(d).all():  # values that are impossible tell nothing
        return Comparison(gain, 1.0)
    spread = np.std(d, ddof=1) / np.sqrt(n)
    alike = t_sf(d.mean() / spread, n - 1) if spread > 0 else 1.0
    each = before.logs - after.logs
    nats = before.independent * (each.sum() - each.max()) + before.prior - after.prior
    return Comparison(gain, float(min(alike, np.exp(-max(nats, 0.0)))))


class Evidence:
    """Sums of products of the residual (first) and columns per group and cell. Each window's start
    state is free within what the smoother knows of it: under every hypothesis the likeliest one,
    given the errors that this leaves."""

    def __init__(self, ahead, residual, columns=None, reference=None, heavier=None):
        """columns: none by default; reference (G, cells): mean squared errors of what others are
        compared with; None takes this residual's. heavier (K, nv): see Ahead; none by default."""
        columns = np.zeros((*residual.shape, 0)) if columns is None else columns
        groups, bands = ahead.group.max() + 1, range(ahead.band.max() + 1)
        cells = [(dofs, b) for dofs in ahead.channels for b in bands]
        stack = np.concatenate([residual[..., None], columns, ahead.freedom()], -1)
        self.channels = len(ahead.channels)
        heavier = np.zeros((columns.shape[-1], residual.shape[-1])) if heavier is None else heavier
        each = [heavier[:, dofs].mean(1) for dofs in ahead.channels for _ in bands]
        self.heavier = np.stack(each, -1)  # (K, cells)
        self.noise, rows, positions = np.zeros(len(cells)), {}, {}
        position = np.arange(residual[0].size).reshape(residual[0].shape)
        counted = np.zeros((len(residual), len(cells)))
        for j, (dofs, b) in enumerate(cells):
            finite = np.isfinite(ahead.noise[dofs])  # of what never moves no noise is known
            inside = ahead.known[..., dofs] & finite & (ahead.band == b)[..., None]
            self.noise[j] = np.sqrt(np.mean(np.where(finite, ahead.noise[dofs], 0.0) ** 2))
            counted[:, j] = inside.sum((1, 2))
            for w in np.flatnonzero(counted[:, j]):
                rows[w, j] = stack[w][:, dofs][inside[w]]
                positions[w, j] = position[:, dofs][inside[w]]
        self.group = np.arange(groups)[:, None] == ahead.group  # (G, W)
        self.count = self.group @ counted
        self.floor = (NOISE * self.noise) ** 2 + 1e-30
        self.sums = Sums(rows, counted, self.group, columns.shape[-1] + 1)
        empty = [np.zeros(0, int)]  # of no rows
        self.position = np.concatenate([positions[k] for k in sorted(positions)] or empty)
        self.window_size = position.size  # rows by degrees of freedom
        self.square = self.squares((), np.zeros(0))
        self.reference = self.square if reference is None else reference
        seen = (self.count > 0).any(0).reshape(self.channels, -1)
        self.told = max(seen.any(1).sum(), 1)  # channels that are measured, and move
        self.cells = max(seen.sum() / self.told, 1 / groups)  # of a channel in a group
        # what a prior weighs against: errors where something is missing, not of joints that lack
        # nothing, of which a large machine has many
        counting = self._counting(self.reference).sum(0)
        self.number = self.cells * max((counting**2).sum() / max(counting.sum(), 1e-300), 1.0)

    @cached_property
    def independent(self):
        """Independent errors of a cell, INDEPENDENT at most: were those of a window of d
        dimensions, the squared cosine between two windows' would be 1 / d in the mean. Windows
        weigh by how many cells count in them."""
        counting = self.group.T @ self._counting(self.square)  # (W, cells)
        sums, residual = self.sums, self.sums.columns[0]
        size = np.sqrt(counting / np.maximum(sums.sum(residual**2), 1e-300))
        scaled = np.zeros((len(counting), self.window_size))
        scaled[sums.cell // sums.shape[1], self.position] = residual * size.ravel()[sums.cell]
        products = scaled @ scaled.T
        count, others = np.diag(products), ~np.eye(len(products), dtype=bool)
        alike = (products[others] ** 2).sum()
        if not alike > 0:
            return INDEPENDENT
        dimensions = np.outer(count, count)[others].sum() / alike
        windows = len(products) / len(self.group)  # that a group's cell holds
        return min(windows * dimensions * count.sum() / (count**2).sum(), INDEPENDENT)

    def freed(self, columns, amounts):
        """Products of the residual and columns (p,), start states free, where these have amounts
        (p,)."""
        index = np.concatenate([[0], np.asarray(columns, int) + 1])
        products = self.sums.of(index)
        for _ in range(ITERATIONS):
            products = products.freed(self.square_of(products, amounts), self.floor)
        return products

    def squares(self, columns, amounts):
        """Mean squared error (G, cells) at amounts (p,) of columns (p,)."""
        return self.square_of(self.freed(columns, amounts), amounts)

    def square_of(self, products, amounts):
        """Mean squared error (..., G, cells) of amounts (p,) or (..., G, p), from Products."""
        return products.squares(amounts) / np.maximum(self.count, 1)

    def _counting(self, square):
        """How much cells of mean squared errors (G, cells) count, 0 to 1: by their excess."""
        least = (BEYOND * self.noise) ** 2
        return np.where(self.count > 0, 1 - least / np.maximum(square, least + 1e-30), 0.0)

    def _logs(self, square):
        """(logs of mean squared errors (G, cells) over the reference's, as far as they count; their
        shares of the loss)."""
        log = 0.5 * np.log((square + self.floor) / (self.reference + self.floor))
        counting = self._counting(np.maximum(square, self.reference))
        each = counting * log
        shares = each / np.maximum(counting.sum(-2, keepdims=True), 1.0) / self.cells
        return each, shares

    def each_channel(self, square):
        """[Score] of each channel alone, of mean squared errors (G, cells)."""
        parts = (np.split(x, self.channels, axis=1) for x in self._logs(square))
        return [self._scored(*part, np.zeros(0)) for part in zip(*parts)]

    def _scored(self, each, shares, amounts):
        """The Score of some cells, of what _logs() tells of them (G, some)."""
        groups = len(each) * shares.sum(1)
        return Score(float(groups.mean()), groups, each.sum(1), amounts, self.independent)

    def different(self):
        """How many columns are different: the effective number of independent tests, of their
        correlations' eigenvalues (Galwey 2009, doi:10.1002/gepi.20408)."""
        weight = self.group.T @ self.weighed(self.reference)
        x = self.sums.columns[1:] * np.sqrt(weight.ravel()[self.sums.cell])
        size = np.linalg.norm(x, axis=1)
        x = x[size > 0] / size[size > 0, None]
        values = np.maximum(np.linalg.eigvalsh(x @ x.T), 0.0)
        return np.sqrt(values).sum() ** 2 / max(values.sum(), 1e-300)

    def plain(self, columns=(), amounts=np.zeros(0)):
        """Mean log RMS over all groups, counted alike, summed over channels, at amounts (p,) of
        columns (p,): what a fit lowers."""
        square = self.squares(columns, amounts)
        log = np.where(self.count > 0, 0.5 * np.log(square + self.floor), 0.0)
        return float(log.sum() / max((self.count > 0).sum(), 1) * self.told)

    def at(self, columns, amounts):
        """Score of given amounts (p,) of columns (p,)."""
        return self._scored(*self._logs(self.squares(columns, amounts)), amounts)

    def score(self, columns, low, high, precision, pull):
        """Score of columns (p,) between bounds low, high (p,) of their amounts, under a quadratic
        prior, precision/2 amount² - pull amount (p,), nats."""
        return self.scores([(columns, low, high, precision, pull)])[0]

    def scores(self, hypotheses):
        """[Score] of hypotheses, each as score() takes it, of which those of as many columns are
        worked out together."""
        out, alike = [None] * len(hypotheses), {}
        for i, given in enumerate(hypotheses):
            alike.setdefault(len(given[0]), []).append(i)
        for p, every in alike.items():
            for first in range(0, len(every), TOGETHER):
                some = every[first : first + TOGETHER]
                given = [np.array(x) for x in zip(*(hypotheses[i] for i in some))]
                found = self._scores(*given) if p else [self.at((), np.zeros(0))] * len(some)
                for i, score in zip(some, found):
                    out[i] = score
        return out

    def _scores(self, columns, low, high, precision, pull):
        """[Score] of hypotheses, arguments (B, p)."""
        index = np.concatenate([np.zeros((len(columns), 1), int), columns + 1], -1)
        prior = precision[:, :, None] * np.eye(columns.shape[1]), pull, low, high
        products, amounts, square = self._fitted(self.sums.of(index), prior)
        each = products.weighed(self.weighed(square))
        rest = each.sum(1, keepdims=True) - each
        matrix, vector, low, high = (x[:, None] for x in prior)
        matrix, vector = rest[..., 1:, 1:] + matrix, rest[..., 1:, 0] + vector
        squares = self.square_of(products, bounded(matrix, vector, low, high))
        # of a heavier joint it is left out: noise in torques would speak for it
        inertia = 1 + np.einsum("bp,bpc->bc", amounts, self.heavier[columns])
        more = np.clip(inertia, LIGHTEST, 1.0)[:, None] ** -2 - 1
        squares = squares + more * np.maximum(squares - self.noise**2, 0.0)
        return [self._scored(*self._logs(square), own) for square, own in zip(squares, amounts)]

    def _fitted(self, products, prior):
        """(Products, start states free, amounts (B, p), mean squares (B, G, cells)) of the lowest
        sums of logs, of the fits begun at the nominal model's errors, which keeps what that happens
        to do well, and where all groups weigh alike."""
        precision, pull, low, high = prior
        found = []
        square = products.grouped[..., 0, 0] / np.maximum(self.count, 1)
        alike = (square * self.count).sum(-2, keepdims=True) / np.maximum(self.count.sum(0), 1)
        for begun in (square, np.broadcast_to(alike, square.shape)):
            free = products
            for _ in range(ITERATIONS):
                whole = free.weighed(self.weighed(begun)).sum(1)
                matrix, vector = whole[:, 1:, 1:] + precision, whole[:, 1:, 0] + pull
                amounts = bounded(matrix, vector, low, high)
                free = products.freed(self.square_of(free, amounts), self.floor)
                begun = self.square_of(free, amounts)
            cost = np.einsum("bi,bij,bj->b", amounts, precision / 2, amounts)
            cost -= (amounts * pull).sum(-1)
            loss = 0.5 * np.log(begun + self.floor)[:, self.count > 0].sum(-1) + cost
            found.append((loss, free.moved, amounts, begun))
        (first, *one), (second, *other) = found
        lower = lambda a: (second < first).reshape(-1, *[1] * (a.ndim - 1))
        moved, amounts, square = (np.where(lower(a), b, a) for a, b in zip(one, other))
        return replace(products, moved=moved), amounts, square

    def weighed(self, square):
        """(G, cells): weights of squares at which least squares lowers the sum of logs, where
        errors are of mean squares (G, cells)."""
        each = 1 / (np.maximum(self.count, 1) * (square + self.floor))
        return np.where(self.count > 0, each, 0.0)

    def looks(self, given, amounts, low, high, inside=None):
        """In-sample gain (C, K) in nats of each further column, between bounds (K,) of its amount,
        beside some, given as score() takes them, that move along from amounts (p,): a first look.
        inside (C, W): in which windows further columns act; by default, once, in all."""
        columns, lowest, highest, precision, pull = given
        columns, amounts = np.asarray(columns, int), np.asarray(amounts, float)
        beside, own = self._by_window(columns, amounts)
        within = beside[:, columns, 1:].sum(0) + np.diag(precision)
        within += 1e-9 * np.diag(np.diag(within))  # of two columns that are the same
        # the least squares of these weights are not quite where the amounts are
        steep = beside[:, columns, 0].sum(0) + pull - within @ amounts
        stuck = (amounts <= lowest) & (steep <= 0) | (amounts >= highest) & (steep >= 0)
        goes = np.flatnonzero(~stuck)
        inside = np.ones((1, len(own))) if inside is None else inside
        beside, own = np.einsum("cw,wkp->ckp", inside, beside), inside @ own
        cross = beside[..., 1 + goes]
        share = np.linalg.solve(within[np.ix_(goes, goes)], np.swapaxes(cross, 1, 2))
        score = beside[..., 0] - beside[..., 1:] @ amounts - np.swapaxes(share, 1, 2) @ steep[goes]
        curve = own - (np.swapaxes(share, 1, 2) * cross).sum(-1)
        seen = curve > 1e-9 * np.maximum(own, 1e-300)
        amount = np.clip(score / np.where(seen, curve, np.inf), low, high)
        return np.where(seen, amount * (score - amount * curve / 2), 0.0)

    def _by_window(self, columns, amounts):
        """Products of every column with the residual and some columns (W, K, 1 + p), and with
        itself (W, K), start states free, weighed where the errors are those of amounts (p,)."""
        sums, index = self.sums, np.concatenate([[0], columns + 1])
        square = self.squares(columns, amounts)
        weight = self.group.T @ self.weighed(square)  # (W, cells)
        moved = sums.moved(sums.crossed, square, self.floor)
        crossed = np.einsum("wc,wcik->wik", weight, sums.crossed)
        # of each column what start states leave of it: x - S moved
        taken = crossed - np.einsum("wc,wcij->wij", weight, sums.starts) @ moved / 2
        beside = -np.einsum("wik,wip->wkp", taken, moved[..., index])
        beside -= np.einsum("wik,wip->wkp", moved, taken[..., index])
        own = -2 * np.einsum("wik,wik->wk", taken, moved)
        row, windows = weight.ravel()[sums.cell], sums.cell // sums.shape[1]
        ends = np.searchsorted(windows, np.arange(len(weight) + 1))
        for w, (a, b) in enumerate(zip(ends[:-1], ends[1:])):
            some = sums.columns[:, a:b]
            beside[w] += some @ (some[index] * row[a:b]).T
            own[w] += np.einsum("kn,n,kn->k", some, row[a:b], some)
        return beside[:, 1:], own[:, 1:]
