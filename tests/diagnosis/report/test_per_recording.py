"""Values of each recording alone: those of runs whose friction differs are told apart, those of one
machine agree."""

import mujoco
import numpy as np
import pytest
from arm import ARM

from diagnosis import demo
from diagnosis.nominal.model import load_world
from diagnosis.recordings.recording import Recording
from diagnosis.report.constancy import constancy
from diagnosis.report.per_recording import estimates, with_each_recording

STIFF = 'solreffriction="0.004 1" solimpfriction="0.999 0.9999 0.001"'
NOISE = {"qpos:shoulder": 2e-4, "qpos:elbow": 2e-4}


def recorded(friction, seed, damping=0.05, stiffness=0.0):
    """A run of ARM with friction in its elbow, and a spring and another damping in its shoulder."""
    xml = ARM.replace('name="elbow" axis', f'name="elbow" frictionloss="{friction}" {STIFF} axis')
    xml = xml.replace(
        'name="shoulder" axis="0 1 0" damping="0.05"',
        f'name="shoulder" axis="0 1 0" damping="{damping}" stiffness="{stiffness}"',
    )
    model, rng = mujoco.MjModel.from_xml_string(xml), np.random.default_rng(seed)
    data, time = mujoco.MjData(model), 0.01 * np.arange(600)
    tones, phases = rng.uniform(0.4, 1.6, (2, 3)), rng.uniform(0, 6, (2, 3))
    waves = np.sin(2 * np.pi * tones * time[:, None, None] + phases).mean(axis=2)
    ctrl, qpos = waves * [1.5, 0.6], np.empty((600, 2))
    for row in range(600):
        qpos[row], data.ctrl[:] = data.qpos, ctrl[row]
        mujoco.mj_step(model, data, nstep=5)
    qpos += rng.normal(size=qpos.shape) * 2e-4
    return Recording(f"run{seed}", time, qpos, np.full(qpos.shape, np.nan), ctrl)


@pytest.fixture(scope="module")
def world():
    return load_world(mujoco.MjSpec.from_string(ARM))


def settings(world, friction=0.05, damping=0.06):
    return {
        world.candidate("coulomb_friction", "elbow"): (friction,),
        world.candidate("viscous_damping", "shoulder"): (damping,),
    }


def summary():
    def finding(effect, joint):
        return {"effect": effect, "place": {"kind": "joint", "name": joint}, "when": None}

    found = [finding("coulomb_friction", "elbow"), finding("viscous_damping", "shoulder")]
    return {"findings": found, "noise": NOISE}


def test_one_machine_agrees_with_itself(world):
    runs = [recorded(0.05, seed, damping=0.06) for seed in range(5)]
    told = with_each_recording(world, settings(world), runs, summary())
    for finding, true in zip(told["findings"], (0.05, 0.06)):
        assert finding["constancy"] > 0.01
        rows = finding["per_recording"]
        assert [row["recording"] for row in rows] == [r.name for r in runs]
        inside = [row["interval"][0] <= true <= row["interval"][1] for row in rows]
        assert sum(inside) >= 4
        assert all(abs(row["value"] / true - 1) < 0.2 for row in rows)


def test_a_step_finds_what_is_off(world):
    found = estimates(world, settings(world, 0.055, 0.05), [recorded(0.05, 7, 0.06)], NOISE)
    (friction, _), (damping, _) = found.values()
    assert abs(friction[0] - 0.05) < 0.003 and abs(damping[0] - 0.06) < 0.005


def test_friction_that_differs_between_runs_is_seen(world):
    runs = [recorded(0.05 + 0.01 * (seed % 2), seed, 0.06) for seed in range(4)]
    told = with_each_recording(world, settings(world), runs, summary())
    friction, damping = told["findings"]
    assert friction["constancy"] < 1e-3 < damping["constancy"]
    [line] = told["warnings"]
    assert line.startswith("elbow: coulomb_friction, frictionloss: not one value")
    values = [row["value"] for row in friction["per_recording"]]
    np.testing.assert_allclose(values, [0.05, 0.06, 0.05, 0.06], rtol=0.08)


def test_what_a_recording_does_not_show_is_null(world):
    still = recorded(0.05, 1, 0.06)
    still.qpos[:], still.ctrl[:] = np.random.default_rng(0).normal(size=still.qpos.shape) * 2e-4, 0
    runs = [recorded(0.05, 0, 0.06), still]
    friction, _ = with_each_recording(world, settings(world), runs, summary())["findings"]
    assert friction["per_recording"][0]["value"] is not None
    assert friction["per_recording"][1]["value"] is None
    assert friction["constancy"] is None  # one value has nothing to agree with
    alone = with_each_recording(world, settings(world), runs[:1], summary())
    assert "per_recording" not in alone["findings"][0]
    assert with_each_recording(world, {}, runs, summary()) == summary()


def test_noisy_starts_shift_no_recordings_value():
    """Three runs of the demo, in which friction turns: each one's values lie about the truth, by
    their own errors."""
    world = load_world(mujoco.MjSpec.from_string(demo.ARM))
    runs = []
    for seed in (1, 2, 4):
        rows = demo.run(demo.real_arm(), seed)
        unmeasured = np.full((len(rows), 2), np.nan)
        runs.append(Recording(f"run{seed}", rows[:, 0], rows[:, 1:3], unmeasured, rows[:, 3:]))
    truth = {
        world.candidate("coulomb_friction", "elbow"): (demo.HIDDEN["elbow friction"],),
        world.candidate("mass", "forearm"): (demo.HIDDEN["forearm mass"],),
    }
    noise = dict.fromkeys(("qpos:shoulder", "qpos:elbow"), demo.NOISE)
    for (candidate, k), (values, errors) in estimates(world, truth, runs, noise).items():
        assert (abs(values - truth[candidate][k]) < 4 * errors).all()
        assert constancy(values, errors) > 0.01


def test_a_force_without_a_name_stays_as_the_diagnosis_has_it(world):
    """Values beside it are those of the motion that it leaves; its own are not asked for."""
    curve = world.curve("shoulder", "position:shoulder", (-9.0, 9.0))
    runs = [recorded(0.05, seed, damping=0.06, stiffness=2.0) for seed in range(2)]
    found = settings(world) | {curve: (18.0, -18.0)}
    told = with_each_recording(world, found, runs, summary())["findings"]
    for finding, true in zip(told, (0.05, 0.06)):
        assert all(abs(row["value"] / true - 1) < 0.2 for row in finding["per_recording"])
    only = {curve: (18.0, -18.0)}
    assert with_each_recording(world, only, runs, summary()) == summary()
