"""Coordinates, windows and states against MuJoCo and closed forms."""

from types import SimpleNamespace

import mujoco
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from diagnosis.estimation import windowing
from diagnosis.recordings.recording import Recording

FREE = """<mujoco><worldbody><body><freejoint name="f"/><geom size=".1"/>
  <body><joint name="b" type="ball"/><geom size=".1"/>
  <body pos="0 0 1"><joint name="h"/><geom size=".1"/></body></body></body></worldbody></mujoco>"""


@given(st.integers(0, 10**6))
@settings(max_examples=50, deadline=None)
def test_tangent_space_is_mujocos(seed):
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(FREE)
    start, step = np.zeros(model.nq), rng.normal(size=model.nv)
    mujoco.mj_integratePos(model, (start := model.qpos0.copy()), rng.normal(size=model.nv), 1.0)
    end, back = start.copy(), np.empty(model.nv)
    mujoco.mj_integratePos(model, end, step, 1.0)
    np.testing.assert_allclose(windowing.integrate(model, start, step), end, atol=1e-12)
    mujoco.mj_differentiatePos(model, back, 1.0, start, end)
    np.testing.assert_allclose(windowing.difference(model, start, end), back, atol=1e-9)


@given(st.integers(2, 200), st.floats(0.003, 0.2), st.floats(0.0, 0.4), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_windows_tile_the_recording(rows, sample, jitter, seed):
    time = sample * (np.arange(rows) + jitter * np.random.default_rng(seed).uniform(-1, 1, rows))
    found = windowing.consecutive(SimpleNamespace(time=time))
    assert found[0].first == 0 and found[-1].last <= rows - 1
    assert all(a.last == b.first for a, b in zip(found, found[1:]))
    assert all(w.first < w.last for w in found)
    if time[-1] - time[0] > 2 * windowing.HORIZON:
        assert all(
            time[w.last] - time[w.first]
            <= windowing.HORIZON
            + 0.011 * np.median(np.diff(time))
            + sample * (w.last == w.first + 1)
            for w in found
        )


def test_unmeasured_states_are_filled_from_velocity():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint type="slide"/><geom size=".1"/></body></worldbody>'
        "</mujoco>"
    )
    time = 0.1 * np.arange(11)
    recording = Recording(
        "r", time, np.full((11, 1), np.nan), np.full((11, 1), 2.0), np.zeros((11, 0)), {}
    )
    qpos, qvel = windowing.states(model, recording)
    np.testing.assert_allclose(qpos[:, 0], 2.0 * time, atol=1e-12)
    assert (qvel == 2.0).all()
