"""What a smoother locates of a change in the rows, against the smoother itself with that change in
what it reads."""

import mujoco
import numpy as np
from plants import DRIVEN_PENDULUM, recorded

from diagnosis.estimation.kalman import Response, smooth
from diagnosis.estimation.smoother import Smoother
from diagnosis.simulation.simulator import World

ROWS, CORE, BLOCKS, DOFS = 12, 8, 2, 2


def a_block(rng):
    """Arguments of smooth() for a few joints: positions and velocities read, in part."""
    n, dt = 3 * DOFS, 0.1
    A = np.tile(np.eye(n), (ROWS, BLOCKS, 1, 1))
    A[..., :DOFS, DOFS : 2 * DOFS] = np.eye(DOFS) * dt
    A[..., : 2 * DOFS, : 2 * DOFS] += 0.02 * rng.normal(size=(ROWS, BLOCKS, 2 * DOFS, 2 * DOFS))
    A[..., DOFS : 2 * DOFS, 2 * DOFS :] = dt * (np.eye(DOFS) + 0.2 * rng.normal(size=(DOFS, DOFS)))
    Q = np.zeros((ROWS, BLOCKS, n))
    Q[..., 2 * DOFS :] = rng.uniform(0.5, 2.0, (ROWS, BLOCKS, DOFS))
    y = rng.normal(size=(ROWS, BLOCKS, 2 * DOFS))
    y[3, 0, 1] = y[:, 1, DOFS:] = np.nan
    return {
        "A": A,
        "c": rng.normal(size=(ROWS, BLOCKS, n)),
        "Q": Q,
        "y": y,
        "R": rng.uniform(0.01, 0.1, 2 * DOFS),
        "start": np.zeros((BLOCKS, n)),
        "spread": np.ones((BLOCKS, n)),
    }


def test_it_is_what_the_smoother_finds_where_the_motion_has_changed_so():
    rng, m = np.random.default_rng(0), 2 * DOFS
    given = a_block(rng)
    # rows of two blocks that overlap
    index = np.arange(ROWS)[:, None] + [0, ROWS - CORE]
    own = (index < CORE) == [True, False]
    change = rng.normal(size=(2 * ROWS - CORE, m, 3))
    found = smooth(**given)
    located = Response(found.gains, index, own)(change)
    for k in range(3):
        moved, y = np.zeros((BLOCKS, 3 * DOFS)), given["y"].copy()
        for t in range(ROWS):
            y[t] += moved[:, :m]
            moved = (given["A"][t] @ moved[..., None])[..., 0]
            moved[:, :m] += change[index[t], :, k]
        more = (smooth(**{**given, "y": y}).state - found.state)[..., m:]
        expected = np.empty((len(change), DOFS))
        expected[index[own]] = more[own]
        np.testing.assert_allclose(located[..., k], expected, atol=1e-4)


def test_of_a_force_that_jumps_it_leaves_what_the_smoother_locates():
    """The hidden force in every row is not the located one, but what becomes of it is."""
    push = lambda time, q, v: 0.2 * np.sign(np.sin(2 * np.pi * (time + 0.0025) / 0.4))
    runs = [recorded(f"{k}.csv", k, push=push) for k in range(2)]
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    trajectory = Smoother(world, runs).locate({})
    hidden = np.concatenate([push(r.time, None, None) for r in runs])
    change = np.einsum("rij,rj->ri", trajectory.driven, hidden[:, None])
    located, whole = trajectory.force[:, 0], trajectory.response(change[..., None])[:, 0, 0]
    rms = lambda x: np.sqrt(np.mean(x**2))
    assert rms(located - hidden) > 0.25 * rms(located) > 2 * rms(located - whole)
