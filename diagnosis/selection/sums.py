"""Sums of products of columns, per group of windows and cell, from which start states take their
share: what hypotheses are worked out from.

sums = Sums(rows, counted, group, width)
products = sums.of(index).freed(square, floor)         # of columns index (..., p)
products.squares(amounts), products.weighed(weight)
"""

from dataclasses import dataclass, replace

import numpy as np

INDEPENDENT = 2.0  # errors as which the rows of a cell count, at most


class Sums:
    """Columns by windows and cells, the residual first.

    columns (K, N): all rows, cell after cell; first, cell: where each of these begins, and which
    it is (window by cells); starts (W, cells, m, m), crossed (W, cells, m, K): products of start
    states with each other and with columns.
    """

    def __init__(self, rows, counted, group, width):
        """rows {(window, cell): (n, K + m)}, columns first; counted (W, cells): how many; group
        (G, W): which windows belong to each; width: K."""
        where, self.rows, self.group = sorted(rows), counted, group.astype(float)
        self.shape, self.group_of = counted.shape, group.argmax(0)
        every = np.concatenate([rows[k] for k in where]).T if rows else np.zeros((width, 0))
        lengths = [len(rows[k]) for k in where]
        self.first = np.cumsum([0, *lengths[:-1]]) if rows else np.zeros(0, int)
        cells = np.array([w * self.shape[1] + j for w, j in where], int)
        self.cell = np.repeat(cells, lengths)
        self.columns, begun = np.ascontiguousarray(every[:width]), every[width:]
        m = len(begun)
        self.starts = np.zeros((*self.shape, m, m))
        self.crossed = np.zeros((*self.shape, m, width))
        for (w, j), a, n in zip(where, self.first, lengths):
            block = begun[:, a : a + n]
            self.starts[w, j] = block @ block.T
            self.crossed[w, j] = block @ self.columns[:, a : a + n].T
        # products of all columns with all would take the square of their number: those asked for
        # are worked out when they are
        self._known = np.zeros((width, width), bool)
        self._products = np.empty((width, width, len(group), self.shape[1]))

    def sum(self, product):
        """(..., W, cells) of products of columns (..., N)."""
        out = np.zeros((*product.shape[:-1], self.shape[0] * self.shape[1]))
        if product.shape[-1]:
            out[..., self.cell[self.first]] = np.add.reduceat(product, self.first, axis=-1)
        return out.reshape(*product.shape[:-1], *self.shape)

    def of(self, index):
        """The Products of columns index (..., p), 0 being the residual, start states as they
        are."""
        index = np.asarray(index, int)
        one, other = index[..., :, None], index[..., None, :]
        self._work_out(one, other)
        grouped = np.moveaxis(self._products[one, other], (-2, -1), (-4, -3))
        crossed = np.moveaxis(self.crossed[..., index], range(3), range(-4, -1))
        return Products(self, np.ascontiguousarray(grouped), np.ascontiguousarray(crossed))

    def _work_out(self, one, other):
        """Work out the products of columns that are not known yet."""
        asked = np.zeros_like(self._known)
        asked[one, other] = True
        new = np.triu((asked | asked.T) & ~self._known)
        for i in np.flatnonzero(new.any(1)):
            j = np.flatnonzero(new[i])
            each = self.group @ self.sum(self.columns[j] * self.columns[i])
            self._products[i, j] = self._products[j, i] = each
            self._known[i, j] = self._known[j, i] = True

    def beside(self, crossed, moved):
        """(..., W, cells, m): products with the starts that are left of some (..., W, cells, m)
        where start states are moved (..., W, m)."""
        return crossed - (self.starts @ moved[..., None, :, None])[..., 0]

    def moved(self, crossed, square, floor):
        """(..., W, m, p): how many standard deviations start states follow columns, from their
        products crossed (..., W, cells, m, p) with the starts, where errors are of mean squares
        (..., G, cells), floor (cells,) added."""
        # rows err alike where a model does: those of a cell count as few errors
        each = (1 / (square + floor))[..., self.group_of, :]
        weight = INDEPENDENT / np.maximum(self.rows, 1) * each
        inside = np.einsum("...wc,wcij->...wij", weight, self.starts)
        inside += np.eye(self.starts.shape[-1])
        return np.linalg.solve(inside, np.einsum("...wc,...wcip->...wip", weight, crossed))


@dataclass(frozen=True)
class Products:
    """Products of p columns, the residual first: grouped (..., G, cells, p, p), start states as
    they are; crossed (..., W, cells, m, p): with these; moved (..., W, m, p): how start states
    follow the columns, None where they do not."""

    sums: Sums
    grouped: np.ndarray
    crossed: np.ndarray
    moved: np.ndarray = None

    def freed(self, square, floor):
        """With start states that follow, where errors are of mean squares (..., G, cells)."""
        return replace(self, moved=self.sums.moved(self.crossed, square, floor))

    def squares(self, amounts):
        """Sums of squares (..., G, cells) of what amounts (..., p - 1), or (..., G, p - 1) of each
        group, leave."""
        z = np.concatenate([np.ones((*amounts.shape[:-1], 1)), -amounts], -1)
        z = z if amounts.ndim == self.grouped.ndim - 2 else z[..., None, :]
        out = ((self.grouped @ z[..., None, :, None])[..., 0] * z[..., None, :]).sum(-1)
        if self.moved is not None:
            z = z if z.shape[-2] == 1 else z[..., self.sums.group_of, :]
            crossed = (self.crossed @ z[..., None, :, None])[..., 0]  # (..., W, cells, m)
            moved = (self.moved @ z[..., None])[..., 0]  # (..., W, m)
            rest = self.sums.beside(crossed, moved)
            out -= self.sums.group @ ((crossed + rest) @ moved[..., None])[..., 0]
        return np.maximum(out, 0.0)

    def slopes(self):
        """Products (..., G, cells, p - 1) of the residual with the other columns."""
        moved, crossed = self.moved[..., 0], self.crossed[..., 0]
        rest = self.sums.beside(crossed, moved)
        taken = (moved[..., None, None, :] @ self.crossed)[..., 0, :] + rest @ self.moved
        taken = np.einsum("gw,...wcp->...gcp", self.sums.group, taken)
        return (self.grouped[..., 0, :] - taken)[..., 1:]

    def weighed(self, weight):
        """(..., G, p, p): sums over the cells of a group, each with its weight (..., G, cells)."""
        out = np.einsum("...gc,...gcij->...gij", weight, self.grouped)
        if self.moved is None:
            return out
        weight = weight[..., self.sums.group_of, :]
        crossed = np.einsum("...wc,...wcip->...wip", weight, self.crossed)
        starts = np.einsum("...wc,wcij->...wij", weight, self.sums.starts)
        shared = np.swapaxes(crossed - starts @ self.moved / 2, -1, -2) @ self.moved
        taken = shared + np.swapaxes(shared, -1, -2)
        return out - np.einsum("gw,...wij->...gij", self.sums.group, taken)
