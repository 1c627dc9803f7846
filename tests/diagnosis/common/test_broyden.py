"""Broyden's method, against systems whose solutions are known."""

import numpy as np

from diagnosis.common.broyden import nearest


def test_systems_of_their_own_are_solved_together_and_one_without_a_solution_ends_nearest():
    rng = np.random.default_rng(0)
    true, bent = rng.normal(size=(3, 4)), rng.normal(size=(3, 4, 4)) + 3 * np.eye(4)

    def missed(x):
        off = (bent @ (true - x + 0.1 * (true - x) ** 2)[..., None])[..., 0]
        off[2, 0] = 1.0  # whatever x is
        return off

    begun = true + 0.3 * rng.normal(size=true.shape)
    found = nearest(missed, begun, missed(begun), bent, np.ones((3, 4)), 12)
    np.testing.assert_allclose(found[:2], true[:2], atol=1e-8)
    miss = lambda x: np.linalg.norm(missed(x), axis=1)
    assert miss(found)[2] <= miss(begun)[2]


def test_what_cannot_be_worked_out_is_never_nearest():
    missed = lambda x: np.where(x > 0.5, np.nan, 1.0 - x)
    begun, one = np.zeros((1, 1)), np.ones((1, 1))
    found = nearest(missed, begun, missed(begun), one[None], one, 3)
    assert found[0, 0] <= 0.5
