"""A beam over sets of effects on one matrix of sums: the sets worth a refit in the simulator.

starts = likely(missing, starts)        # in a first look, those worth a column in every window
start, nodes = Beam(columns, evidence).nodes()
"""

from dataclasses import dataclass

import numpy as np

from diagnosis.selection.columns import Columns
from diagnosis.selection.criterion import PRICE, Score, complexity, paired
from diagnosis.selection.judge import moved_setting, nominal, problem
from diagnosis.selection.plausibility import cost

WIDTH, LOOKS = 16, 10  # sets that are carried on, and further effects tried in each in full
DEPTH = 4  # effects added in one round
LEAST = 0.01  # loss that an effect must remove in the search
GLANCES = 8, 0.3  # beginnings of windows that are looked at first, and their length, s
MORE, EACH = 2, 10  # looks beside the best of those before, more than joints; new ones in each


@dataclass(frozen=True, eq=False)
class Node:
    """A set of options. Effects that are in the model already and not in it are nominal."""

    options: tuple
    score: Score
    unpriced: float  # what the search goes by: a price paid early hides what two do together
    loss: float  # with the price of its complexity, what sets are ranked by


class Beam:
    """Looks for sets of options that lower the loss, with priors and the price of complexity."""

    def __init__(self, columns, evidence):
        self.columns, self.evidence, self.known = columns, evidence, {}
        inside = columns.setting
        self.kept = tuple(k for k, o in enumerate(columns.options) if o.candidate in inside)
        self.free = [k for k, o in enumerate(columns.options) if o.candidate not in inside]
        limit = lambda k: not np.isfinite(nominal(columns.options[k])).all()
        self.stay = set(filter(limit, self.kept))  # of which small changes tell nothing

    def leave(self, candidates):
        """Look for sets without the options of some candidates from now on."""
        options = self.columns.options
        self.free = [k for k in self.free if options[k].candidate not in candidates]

    def node(self, options):
        """The Node of some options, those kept included."""
        return self.nodes_of([options])[0]

    def nodes_of(self, sets):
        """The Nodes of some sets of options."""
        keys = [tuple(sorted(each)) for each in sets]
        new = {k: tuple(options) for k, options in zip(keys, sets) if k not in self.known}
        given = [self._problem(options) for options in new.values()]
        for key, score in zip(new, self.evidence.scores(given)):
            self.known[key] = self._node(new[key], score)
        return [self.known[k] for k in keys]

    def _problem(self, options):
        return problem(self.columns, options, [k for k in self.kept if k not in options])

    def _node(self, options, score):
        """The Node of options with a Score."""
        setting = moved_setting(self.columns, score.amounts, options)
        chosen = [self.columns.options[k] for k in options]
        nats = sum(cost(o.candidate, setting[o.candidate], o.prior) for o in chosen)
        unpriced = score.loss + nats / self.evidence.number
        loss = unpriced + PRICE * complexity(o.candidate for o in chosen)
        return Node(options, score, unpriced, loss)

    def nodes(self):
        """(node of the model as it is, all nodes met, best first)."""
        start = self.node(self.kept)
        met, beam, before = {start: None}, [start], np.inf
        for _ in range(DEPTH):
            grown, each = self._joined(beam, met), {}
            for node in sorted(grown, key=lambda n: n.unpriced):
                each.setdefault(self._candidates(node), node)
            # the best of each set of candidates; of two that make up for each other neither is
            # better alone, so single effects are all carried on
            beam = list(each.values())[: None if beam == [start] else WIDTH]
            for node in beam:
                self._reduced(node, met)
            best = min(node.loss for node in met)
            if best >= before or not beam:
                break
            before = best
        return start, sorted(met, key=lambda n: n.loss)

    def ranking(self):
        """[(candidate, loss removed alone, p-value)], most first."""
        start, met, best = self.node(self.kept), {}, {}
        self._joined([start], met)
        for node in sorted(met, key=lambda n: n.loss):
            candidate = self.columns.options[node.options[-1]].candidate
            p = paired(start.score, node.score).p_value
            best.setdefault(candidate, (candidate, start.loss - node.loss, p))
        return list(best.values())

    def _joined(self, beam, met):
        """[Node] of sets with one effect more than some nodes that are better; all are met."""
        # first every option in full: what lowers squares most is not what lowers their logarithm
        # most, and what comes first decides what is tried beside it
        first, grown = beam[0].options == self.kept, []
        tries = [(beam[0], k) for k in self.free] if first else self._tries(beam)
        every = self.nodes_of([(*node.options, k) for node, k in tries])
        for (node, k), new in zip(tries, every):
            met[new] = None
            better = first or new.unpriced < node.unpriced - LEAST
            if better and not self._unnamed(k):
                grown.append(new)
        return grown

    def _tries(self, beam):
        """[(node, option)] that promise most in a first look: LOOKS of each of the best nodes, and
        as many of all the others together."""
        each = [[(promised, node, k) for promised, k in self._looks(node)] for node in beam]
        rest = sorted(sum(each[WIDTH:], []), key=lambda one: one[0])
        return [(node, k) for _, node, k in sum(each[:WIDTH], []) + rest[: WIDTH * LOOKS]]

    def _unnamed(self, k):
        """Whether an option is a curve: it leaves so little that what stands beside it would fill
        the beam. The next round looks for that."""
        return self.columns.options[k].unnamed

    def _candidates(self, node):
        return frozenset(self.columns.options[k].candidate for k in node.options)

    def _reduced(self, node, met):
        """Meet the sets that are left when effects go again, those of the model too, the one that
        is missed least first, as long as that is better."""
        while len(node.options) > 1:
            goes = [k for k in node.options if k not in self.stay]
            fewer = self.nodes_of([[k for k in node.options if k != out] for out in goes])
            met.update(dict.fromkeys(fewer))
            less = min(fewer, key=lambda n: n.loss, default=node)
            if less.loss >= node.loss:
                break
            node = less

    def others(self, node):
        """Indices of the options of effects that a node does not hold."""
        options = self.columns.options
        held = {c.lasting for c in self._candidates(node)}
        return [k for k in self.free if options[k].candidate.lasting not in held]

    def gains(self, node):
        """{k: nats} that options of effects which a node does not hold promise, in a first look."""
        low, high = map(np.concatenate, zip(*((o.low, o.high) for o in self.columns.options)))
        given = self._problem(node.options)
        [gain] = self.evidence.looks(given, node.score.amounts, low, high)
        return {k: gain[list(self.columns.options[k].columns)].sum() for k in self.others(node)}

    def _looks(self, node):
        """[(loss promised, index)] of the further options that promise most for their price in a
        first look."""
        gain, number = self.gains(node), self.evidence.number
        price = lambda k: PRICE * complexity([self.columns.options[k].candidate])
        promised = {k: node.unpriced - gain[k] / number + price(k) for k in gain}
        best, seen = [], {}
        for k in sorted(promised, key=promised.get):
            candidate = self.columns.options[k].candidate
            seen[candidate] = seen.get(candidate, 0) + 1
            if seen[candidate] <= 2 and not self._unnamed(k):  # starts of one candidate
                best.append((promised[k], k))
        return best[:LOOKS]

    def setting(self, node):
        """The setting {Candidate: values} of a node."""
        moved = moved_setting(self.columns, node.score.amounts, node.options)
        inside = self._candidates(node)
        return {c: v for c, v in moved.items() if c in inside}


def likely(missing, starts, alone=False):
    """Of Starts, the best ones of those candidates that explain most, alone or beside the best, a
    row ahead, or in the beginnings of windows: a row tells of no sensor, and little of a force that
    comes and goes within a few; a beginning tells little of one that builds up slowly. Kept are the
    effects of the setting as well, and waves, which the located force has chosen. alone: nothing
    beside the best is asked for."""
    chain, setting = missing.chain, missing.setting
    chosen = lambda start: start.candidate in setting or start.merges
    kept = [start for start in starts if chosen(start)]
    new = [start for start in starts if not chosen(start)]
    rounds = 1 if alone else len(chain.channels) + MORE
    bases = {} if chain.touches else {start: missing.basis(start) for start in new}
    bases = {start: basis for start, basis in bases.items() if basis is not None}
    some = _by_rows(missing.force, bases, rounds) if bases else []
    if new:
        some += _by_windows(chain.beginnings(*GLANCES), setting, kept, new, rounds)
    return [*dict.fromkeys([*kept, *some])]  # a wave may be among the best as well


def _best(gains, kept):
    """(the best of {Start: gain}, further Starts to be kept beside some): of the best candidates
    that are not kept yet the best in proportion and the best of its whole values."""
    order = sorted(gains, key=lambda start: -gains[start])
    best, known = {}, {start.candidate for start in kept}
    for start in order:
        if start.candidate not in known:
            best.setdefault(start.candidate, {}).setdefault(start.whole, start)
    return order[0], [start for each in list(best.values())[:EACH] for start in each.values()]


def _by_rows(target, bases, rounds):
    """The Starts whose bases (n, dofs, p) explain most of a target (n, dofs)."""
    kept, target = {}, target.ravel()
    bases = {start: basis.reshape(len(target), -1) for start, basis in bases.items()}
    for _ in range(rounds):
        gains = {start: explained(basis, target) for start, basis in bases.items()}
        best, further = _best(gains, kept)
        kept |= dict.fromkeys(further)
        beside = np.linalg.qr(bases[best])[0]
        rest = lambda x: x - beside @ (beside.T @ x)
        target, bases = rest(target), {start: rest(basis) for start, basis in bases.items()}
    return list(kept)


def _by_windows(short, setting, inside, starts, rounds):
    """The Starts that gain most in the windows of a short Chain, beside those inside a setting."""
    columns = Columns(short, setting, inside + starts)
    beam = Beam(columns, columns.evidence())
    starts = [o.start for o in columns.options]
    node, kept, index = beam.node(beam.kept), {}, {s: k for k, s in enumerate(starts)}

    def look(some):  # within the bounds of their amounts: columns tell of no values far from these
        grown = beam.nodes_of([(*node.options, index[start]) for start in some])
        return {start: node.unpriced - new.unpriced for start, new in zip(some, grown)}

    for _ in range(rounds):
        others = beam.others(node)
        if not others:
            break
        if kept:
            gains, number = beam.gains(node), beam.evidence.number
            gains = {starts[k]: gain / number for k, gain in gains.items()}
            _renew(gains, kept, look)
        else:  # every start in full: what lowers squares most may lower their logarithm less
            gains = look([starts[k] for k in others])
        best, further = _best(gains, kept)
        kept |= dict.fromkeys(further)
        node = beam.node((*node.options, index[best]))
    return list(kept)


def _renew(gains, kept, look):
    """Look in full at those of {Start: gain} that are the best, of a first look, until no other
    one promises more."""
    known = set()
    while True:
        best, further = _best(gains, kept)
        some = [start for start in dict.fromkeys((best, *further)) if start not in known]
        if not some:
            break
        gains |= look(some)
        known |= {*some}


def explained(basis, target):
    """Share of the squares of a target (n,) that columns (n, k) explain."""
    left = target - basis @ np.linalg.lstsq(basis, target, rcond=None)[0]
    return 1 - left @ left / (target @ target + 1e-300)
