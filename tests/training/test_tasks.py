"""Users' tasks: gymnasium's other robots bit for bit, a robot of one's own, files that are none."""

import csv

import gymnasium
import numpy as np
import pytest

import envs
import rgat
import train
from envs import BatchEnv
from training.run_folder import RunError
from training.settings import Settings, load_task

FOLDER = train.Path(train.__file__).parent / "training" / "tasks"
TINY = (
    "--pretrain-steps 512 --grounding-steps 1 --at-steps 512 --policy-steps 512 --num-envs 4 "
    "--real-trajectories 2 --eval-episodes 1 --threads 1"
).split()
ARM = """
from envs import Task
import numpy as np

class Arm(Task):
    def reward(self, env, actions, speed, ended):
        return -np.abs(env.qpos[:, 0] - 1.0) - 0.01 * np.square(actions).sum(axis=1)

TASK = Arm("arm.xml", 5, 0.1, real="elbow:damping=2", skip_root_x=0, time_limit=60)
DEFAULTS = {"pretrain_steps": 1234}
"""
MJCF = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
<body><joint name="shoulder" axis="0 0 1"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
<body pos=".3 0 0"><joint name="elbow" axis="0 0 1"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
</body></body></worldbody>
<actuator><motor joint="shoulder" ctrlrange="-1 1"/>
<motor joint="elbow" ctrlrange="-1 1"/></actuator>
</mujoco>"""


@pytest.mark.parametrize("name, theirs", [("walker2d", "Walker2d-v4"), ("ant", "Ant-v4")])
def test_gymnasiums_other_robots_bit_for_bit(name, theirs):
    ours = BatchEnv(load_task(FOLDER / f"{name}.py"), 3, nthread=1)
    stock = gymnasium.make_vec(
        theirs,
        num_envs=3,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP},
    )
    assert ours.action_space == stock.action_space
    np.testing.assert_array_equal(ours.reset(seed=5)[0], stock.reset(seed=5)[0])
    rng, ended = np.random.default_rng(0), 0
    for _ in range(150):
        action = rng.uniform(*stock.single_action_space.low[:1], 1, stock.action_space.shape)
        action = action.astype(np.float32)
        mine, other = ours.step(action), stock.step(action)
        for a, b in zip(mine[:4], other[:4]):
            np.testing.assert_array_equal(a, b)
        ended += other[2].sum()
    assert ended > 0 or name == "ant"
    stock.close()


def own(tmp_path, text=ARM, mjcf=MJCF):
    (tmp_path / "arm.xml").write_text(mjcf)
    (tmp_path / "my_arm.py").write_text(text)
    return tmp_path / "my_arm.py"


def test_a_robot_of_ones_own_is_grounded_and_resumed(tmp_path):
    task, out = own(tmp_path), tmp_path / "run"
    assert Settings(task=str(task)).completed().pretrain_steps == 1234
    assert train.main(["--task", str(task), "--out", str(out), *TINY]) == 0
    assert train.main(["--resume", str(out), "--grounding-steps", "2"]) == 0
    rows = list(csv.DictReader((out / "progress.csv").open(newline="")))
    assert len(rows) == 3 and all(float(r["real_return_stochastic"]) < 0 for r in rows)
    assert int(rows[1]["real_transitions"]) == 2 * 60


def test_a_run_of_a_file_with_a_hyphen_is_of_its_own_task_and_can_be_opened(tmp_path):
    task = own(tmp_path).rename(tmp_path / "Hopper-arm.py")
    assert Settings(task=str(task)).completed().pretrain_steps == 1234
    assert BatchEnv("Hopper-arm", 1).model.nq == 2 and BatchEnv("Hopper-v4", 1).model.nq == 6
    assert train.main(["--task", str(task), "--out", str(tmp_path / "run"), *TINY]) == 0
    (tmp_path / "run" / "step_01.pt").rename(tmp_path / "run" / "step_100.pt")
    for step in (10, 11):
        (tmp_path / "run" / f"step_{step}.pt").write_text("not the last one")
    envs.TASKS.pop("Hopper-arm")  # as in another process
    envs.ENV_IDS.remove("Hopper-arm")
    assert rgat.grounded_env(tmp_path / "run").reset(seed=0)[0].shape == (1, 4)
    task.unlink()
    with pytest.raises(envs.EnvError, match="Hopper-arm.py"):
        rgat.grounded_env(tmp_path / "run")


def test_a_run_does_not_go_on_with_another_task_or_model(tmp_path, capsys):
    task, out = own(tmp_path), tmp_path / "run"
    assert train.main(["--task", str(task), "--out", str(out), *TINY]) == 0
    own(tmp_path, mjcf=MJCF.replace('size=".02"', 'size=".03"'))
    assert train.main(["--resume", str(out), "--grounding-steps", "2"]) == 2
    own(tmp_path, ARM.replace("- 1.0", "- 0.5"))
    assert train.main(["--resume", str(out), "--grounding-steps", "2"]) == 2
    assert capsys.readouterr().err.count("begun by another version (task") == 2


DEFINE = "    def observe(self, qpos, qvel):\n        return {}\n\n    def reward"
BROKEN = {
    "does not import": ("import nothing_of_this_name", "nothing_of_this_name"),
    "no task": ("x = 1", "TASK"),
    "no model": (ARM.replace("arm.xml", "leg.xml"), "leg.xml"),
    "observes NaN": (ARM.replace("    def reward", DEFINE.format("qpos * np.nan")), "NaN"),
    "observes too little": (ARM.replace("    def reward", DEFINE.format("qpos[:, :1]")), "state()"),
    "rewards NaN": (ARM.replace("return -np.abs", "return np.nan * np.abs"), "reward()"),
    "rewards a number": (ARM.replace("return -np.abs", "return 1.0  # "), "float"),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_task_that_does_not_work_is_refused_in_one_line(how, tmp_path, capfd):
    text, says = BROKEN[how]
    task = own(tmp_path, text)
    assert train.main(["--task", str(task), "--out", str(tmp_path / "run"), *TINY]) == 2
    err = capfd.readouterr().err.strip().splitlines()
    assert len(err) == 1 and str(task) in err[0] and says in err[0], err
    assert not (tmp_path / "run").exists()
    with pytest.raises(RunError):
        load_task(tmp_path / "missing.py")
