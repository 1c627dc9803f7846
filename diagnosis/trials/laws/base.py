"""What a law of the true machine is, when it acts, and how it is remembered."""

import copy


class Law:
    """One hidden law. Each hook does nothing unless a law needs it.

    effect: its name in the catalogue, or None where the catalogue has none.
    needs: variables that the force cannot be told without, e.g. ("velocity",), of this joint, or
    ("position", other link) of another.
    """

    effect = None
    needs = ()

    def __init__(self, link, **parameters):
        self.link, self.parameters, self.state = link, parameters, None
        self.__dict__.update(parameters)

    def reset(self, s):
        """Forget, at the start of a recording."""

    def control(self, s, u):
        """Return what the drives get of the control u (nu,)."""
        return u

    def drive(self, s, tau):
        """Change the drives' force tau (links,) in place."""

    def force(self, s):
        """Add to s.force (links,)."""

    def friction(self, s):
        """Add to the dry friction's limit s.limit (links,), at least zero."""

    def bodies(self, s):
        """Add to s.data.xfrc_applied."""

    def couple(self, joints):
        """MJCF of a tendon that couples joints, of which these are the names, by link."""

    def measure(self, s, q, v):
        """Change what ideal sensors of these faults read, (links,) each, in place."""


class Gate(Law):
    """A law that acts in some recordings only, from `start` on (s), or within a part of the travel.

    runs: numbers of the recordings, None for all; within: (low, high) of the joint's position.
    """

    HOOKS = ("drive", "force", "friction", "bodies")

    def __init__(self, law, start=0.0, runs=None, within=None):
        self.law, self.start, self.runs, self.within = law, start, runs, within
        super().__init__(law.link, **law.parameters)
        self.effect, self.needs = law.effect, law.needs
        for name in self.HOOKS:
            setattr(self, name, self._gated(getattr(law, name)))

    def acts(self, s):
        """Does the law act now?"""
        if s.time < self.start or (self.runs is not None and s.run not in self.runs):
            return False
        return self.within is None or self.within[0] <= s.q[self.link] <= self.within[1]

    def _gated(self, hook):
        def call(s, *more):
            if self.acts(s):
                hook(s, *more)

        return call

    def reset(self, s):
        self.law.reset(s)

    @property
    def state(self):
        return self.law.state

    @state.setter
    def state(self, value):
        self.law.state = value


def snapshot(laws):
    """What the laws remember, to be put back by `restore`."""
    return [copy.copy(law.state) for law in laws]


def restore(laws, states):
    """Put back what `snapshot` took, of the same laws."""
    for law, state in zip(laws, states, strict=True):
        law.state = copy.copy(state)
