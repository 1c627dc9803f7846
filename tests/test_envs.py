"""BatchEnv against gymnasium's own environments, perturbations against edited MJCF, grounding
against the raw sim."""

import xml.etree.ElementTree as ET

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import envs
from envs import ENV_IDS, BatchEnv, EnvError, parse_perturbation, perturb, task_of
from models import GaussianPolicy
from rgat import ActionTransformer, GroundedEnv, identity

pytestmark = pytest.mark.filterwarnings("ignore")  # gymnasium calls -v4 out of date

# balances the upright pole: position, angle, and their velocities -> force
BALANCE = np.array([0.5, 8.0, 0.7, 1.5])


def stock(env_id, n, **kwargs):
    """gymnasium's environments one by one, restarted within the step as BatchEnv does."""
    makers = [lambda: gymnasium.make(env_id, disable_env_checker=True, **kwargs)] * n
    return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)


def replay_both(env_id, policy, steps, n=3, seed=11, **kwargs):
    """Step both worlds through the same actions, requiring equality throughout.

    Returns (terminations, truncations)."""
    ours, theirs = BatchEnv(env_id, n, nthread=1), stock(env_id, n, **kwargs)
    obs, _ = ours.reset(seed=seed)
    np.testing.assert_array_equal(obs, theirs.reset(seed=seed)[0])
    falls = cuts = 0
    for t in range(steps):
        action = policy(t, obs)
        obs, reward, terminated, truncated, info = ours.step(action)
        their_obs, their_reward, their_terminated, their_truncated, their_info = theirs.step(action)
        np.testing.assert_array_equal(obs, their_obs)
        np.testing.assert_allclose(reward, their_reward, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(terminated, their_terminated)
        np.testing.assert_array_equal(truncated, their_truncated)
        done = terminated | truncated
        np.testing.assert_array_equal(info["next_obs"][~done], obs[~done])
        if done.any():
            np.testing.assert_array_equal(info["_final_obs"], their_info["_final_obs"])
            for i in np.flatnonzero(done):
                np.testing.assert_array_equal(info["next_obs"][i], their_info["final_obs"][i])
                np.testing.assert_array_equal(info["final_obs"][i], their_info["final_obs"][i])
                assert not np.array_equal(
                    info["next_obs"][i], obs[i]
                )  # not the next episode's first
        falls, cuts = falls + terminated.sum(), cuts + truncated.sum()
    theirs.close()
    return falls, cuts


def random_policy(env_id, n, scale=1.0, dtype=np.float32):
    space = BatchEnv(env_id, 1).single_action_space
    rng = np.random.default_rng(5)
    return lambda t, obs: (scale * rng.uniform(space.low, space.high, (n, len(space.low)))).astype(
        dtype
    )


def balance(t, obs):
    """Hold the pole up, through one time limit; after it, let go."""
    u = obs @ BALANCE if t < 1050 else np.full(len(obs), 3.0)
    return np.clip(u, -3, 3)[:, None]


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_equals_gymnasium_under_random_actions(env_id):
    falls, _ = replay_both(env_id, random_policy(env_id, 3), 300)
    assert falls > 0 or env_id.startswith("HalfCheetah")


@pytest.mark.parametrize("env_id", [i for i in ENV_IDS if i.startswith("InvertedPendulum")])
def test_equals_gymnasium_through_the_time_limit_of_a_balanced_pole(env_id):
    falls, cuts = replay_both(env_id, balance, 1100)
    assert falls > 0 and cuts == 3


@pytest.mark.parametrize("env_id", [i for i in ENV_IDS if i.startswith("HalfCheetah")])
def test_equals_gymnasium_through_the_time_limit_of_the_cheetah(env_id):
    falls, cuts = replay_both(env_id, random_policy(env_id, 2, dtype=np.float64), 1010, n=2)
    assert falls == 0 and cuts == 2


@pytest.mark.parametrize("env_id", [i for i in ENV_IDS if i.startswith("Hopper")])
def test_equals_gymnasium_where_falls_and_time_limits_mix(env_id, monkeypatch):
    monkeypatch.setattr(envs, "TIME_LIMIT", 17)
    falls, cuts = replay_both(env_id, random_policy(env_id, 6), 120, n=6, max_episode_steps=17)
    assert falls > 3 and cuts > 3


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_spaces_and_time_limit_equal_gymnasiums(env_id):
    ours, theirs = BatchEnv(env_id, 2), gymnasium.make(env_id)
    assert ours.single_action_space == theirs.action_space
    assert ours.single_observation_space.shape == theirs.observation_space.shape
    assert envs.TIME_LIMIT == theirs.spec.max_episode_steps
    assert ours.dt == theirs.unwrapped.dt


def test_results_do_not_depend_on_threads_or_batch_size():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (60, 5, 3))
    wide, narrow = BatchEnv("Hopper-v4", 5, nthread=2), BatchEnv("Hopper-v4", 2, nthread=1)
    np.testing.assert_array_equal(wide.reset(seed=3)[0][:2], narrow.reset(seed=3)[0])
    for action in actions:
        a, b = wide.step(action), narrow.step(action[:2])
        for x, y in zip(a[:4], b[:4]):
            np.testing.assert_array_equal(x[:2], y)


def test_the_returned_arrays_are_the_callers_own():
    env = BatchEnv("Hopper-v4", 2)
    first, _ = env.reset(seed=0)
    kept = first.copy()
    obs, _, _, _, info = env.step(np.zeros((2, 3)))
    np.testing.assert_array_equal(first, kept)
    kept, kept_next = obs.copy(), info["next_obs"].copy()
    for _ in range(30):
        env.step(np.ones((2, 3)))
    np.testing.assert_array_equal(obs, kept)
    np.testing.assert_array_equal(info["next_obs"], kept_next)


# --- the "real" world -----------------------------------------------------------------------------


def tree_of(env_id):
    return ET.parse(envs.model_path(env_id))


def compiled(tree):
    return mujoco.MjModel.from_xml_string(ET.tostring(tree.getroot(), encoding="unicode"))


def find(tree, tag, name):
    return next(e for e in tree.iter(tag) if e.get("name") == name)


def geoms_of(tree, body):
    return find(tree, "body", body).findall("geom")


def test_a_given_model_with_finer_steps_takes_more_of_them():
    fine = mujoco.MjModel.from_xml_path(str(envs.model_path("Hopper-v4")))
    fine.opt.timestep /= 4
    ours, theirs = (BatchEnv("Hopper-v4", 2, model=model, nthread=1) for model in (fine, None))
    assert ours.dt == theirs.dt == gymnasium.make("Hopper-v4").unwrapped.dt
    ends = []
    for env in (ours, theirs):
        env.reset(seed=0)
        ends.append(env.step(np.zeros((2, 3)))[0])
    np.testing.assert_allclose(*ends, atol=1e-4)


def states(env_id, steps, perturbation="", model=None, seed=2):
    """qpos and qvel along a fixed random action sequence, with no restarts: (steps, 4, nq + nv)."""
    env = BatchEnv(env_id, 4, parse_perturbation(perturbation), model=model, nthread=1)
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    path = []
    for _ in range(steps):
        env.batch.ctrl = rng.uniform(-1, 1, (4, env.model.nu))
        env.batch.step(nstep=env.task.frame_skip)
        path.append(np.concatenate((env.qpos, env.qvel), axis=1))
    return np.array(path)


def edited_pole(tree):
    geoms_of(tree, "pole")[0].set("mass", "100")


def edited_torso(tree):
    mass = float(BatchEnv("Hopper-v4", 1).model.body("torso").mass[0])
    geoms_of(tree, "torso")[0].set("mass", repr(mass * 1.27))


def edited_cheetah(tree):
    # undo the compiler's rescaling to 14 kg: give every geom the density that it leads to
    tree.getroot().find("compiler").attrib.pop("settotalmass")
    density = float(1000 * 14 / compiled(tree).body_mass.sum())
    for geom in tree.iter("geom"):
        geom.set("density", repr(density))
    for geom in geoms_of(tree, "torso"):
        geom.set("density", repr(density * 1.15))


def edited_gravity(tree):
    tree.getroot().find("option").set("gravity", f"0 0 {-9.81 * 0.5}")


def edited_joint(name, **attributes):
    def edit(tree):
        for key, value in attributes.items():
            find(tree, "joint", name).set(key, str(value))

    return edit


def edited_gear(joint, gear):
    def edit(tree):
        next(m for m in tree.iter("motor") if m.get("joint") == joint).set("gear", str(gear))

    return edit


EDITS = {
    "pole": ("InvertedPendulum-v4", "pole:mass=100", edited_pole),
    "hopper torso": ("Hopper-v4", "torso:mass*1.27", edited_torso),
    "cheetah torso": ("HalfCheetah-v4", "torso:mass*1.15", edited_cheetah),
    "damping": ("Hopper-v5", "foot_joint:damping=3.5", edited_joint("foot_joint", damping=3.5)),
    "frictionloss": (
        "Hopper-v4",
        "leg_joint:frictionloss=0.5",
        edited_joint("leg_joint", frictionloss=0.5),
    ),
    "armature": ("HalfCheetah-v4", "bshin:armature*2", edited_joint("bshin", armature=0.2)),
    "gain of an unnamed actuator": (
        "Hopper-v4",
        "thigh_joint:gain*0.8",
        edited_gear("thigh_joint", 160),
    ),
    "gain of a named actuator": (
        "InvertedPendulum-v4",
        "slide:gain*0.8",
        edited_gear("slider", 80),
    ),
    "gravity": ("InvertedPendulum-v5", "world:gravity*0.5", edited_gravity),
    "two at once": (
        "Hopper-v4",
        "torso:mass*1.27, foot_joint:frictionloss=0.5",
        lambda tree: (edited_torso(tree), edited_joint("foot_joint", frictionloss=0.5)(tree)),
    ),
}


@pytest.mark.parametrize("name", EDITS)
def test_perturbation_equals_an_edit_of_the_mjcf(name):
    env_id, perturbation, edit = EDITS[name]
    tree = tree_of(env_id)
    edit(tree)
    # the cheetah's contacts double the rounding error every few milliseconds
    steps = 10 if env_id.startswith("HalfCheetah") else 40
    ours, theirs = states(env_id, steps, perturbation), states(env_id, steps, model=compiled(tree))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * max(1, np.abs(theirs).max()))
    assert np.abs(ours - states(env_id, steps)).max() > 1e-3  # and it is a change


def test_cheetahs_total_mass_grows():
    env = BatchEnv("HalfCheetah-v4", 1, parse_perturbation(task_of("HalfCheetah-v4").real))
    assert BatchEnv("HalfCheetah-v4", 1).model.body_mass.sum() == pytest.approx(14, abs=1e-9)
    assert env.model.body_mass.sum() == pytest.approx(14.94, abs=5e-3)
    assert env.batch.model.body_subtreemass[0] == pytest.approx(
        env.model.body_mass.sum(), rel=1e-12
    )


def test_the_papers_worlds_are_the_defaults():
    mass = lambda env_id, body, p="": (
        BatchEnv(env_id, 1, parse_perturbation(p)).model.body(body).mass[0]
    )
    for env_id, body, factor in (("Hopper-v5", "torso", 1.27), ("HalfCheetah-v5", "torso", 1.15)):
        assert mass(env_id, body, task_of(env_id).real) == pytest.approx(
            factor * mass(env_id, body), rel=1e-12
        )
    assert mass(
        "InvertedPendulum-v4", "pole", task_of("InvertedPendulum-v4").real
    ) == pytest.approx(100, rel=1e-12)


def test_gravity_in_units_of_downward_acceleration():
    model = mujoco.MjModel.from_xml_path(str(envs.model_path("Hopper-v4")))
    moon = perturb(model, parse_perturbation("world:gravity=1.62"))
    np.testing.assert_array_equal(moon.opt.gravity, [0, 0, -1.62])


def test_the_callers_model_stays_as_it_was():
    model = mujoco.MjModel.from_xml_path(str(envs.model_path("Hopper-v4")))
    mass = model.body("torso").mass[0]
    perturb(model, parse_perturbation("torso:mass*2"))
    heavy = BatchEnv("Hopper-v4", 1, parse_perturbation("torso:mass*3"), model=model)
    assert model.body("torso").mass[0] == mass
    assert heavy.model.body("torso").mass[0] == 3 * mass


def test_a_servo_of_another_gain_still_goes_where_it_is_told():
    model = mujoco.MjModel.from_xml_string("""
      <mujoco><option gravity="0 0 0"/><worldbody><body><joint name="hinge" damping="1"/>
      <geom size=".1"/></body></worldbody>
      <actuator><position joint="hinge" kp="20"/></actuator></mujoco>""")
    strong = perturb(model, parse_perturbation("hinge:gain*3"))
    assert strong.actuator_gainprm[0, 0] == 60
    ends = []
    for m in (model, strong):
        data = mujoco.MjData(m)
        data.ctrl[:] = 0.5
        mujoco.mj_step(m, data, 5000)
        ends.append(data.qpos[0])
    np.testing.assert_allclose(ends, 0.5, atol=1e-3)


@pytest.mark.parametrize(
    "text, says",
    [
        ("torso", "NAME:FIELD"),
        ("torso:mass", "NAME:FIELD"),
        ("torso:mass+1", "NAME:FIELD"),
        ("torso:mass=", "NAME:FIELD"),
        (":mass=1", "NAME:FIELD"),
        ("torso:mass=heavy", "NAME:FIELD"),
        ("torso:mass*1.27;foot:mass=1", "NAME:FIELD"),
        ("torso:colour=1", "unknown field 'colour'"),
        ("torso:mass=0", "positive"),
        ("torso:mass*-1", "positive"),
        ("torso:mass=nan", "finite"),
        ("torso:mass=inf", "finite"),
        ("foot_joint:damping=-1", "damping"),
    ],
)
def test_perturbation_that_does_not_parse(text, says):
    with pytest.raises(EnvError) as error:
        parse_perturbation(text)
    assert says in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text, says",
    [
        ("tors:mass*1.27", "torso"),
        ("torso:damping=1", "rootx"),
        ("foot_joint:mass=1", "foot"),
        ("nobody:gain=1", "foot_joint"),
        ("torso:gravity=1", "world:gravity"),
        ("world:mass=1", "world"),
    ],
)
def test_perturbation_of_what_the_model_lacks(text, says):
    with pytest.raises(EnvError) as error:
        BatchEnv("Hopper-v4", 1, parse_perturbation(text))
    assert says in str(error.value) and "\n" not in str(error.value)


def test_unknown_environment_and_count():
    with pytest.raises(EnvError, match="Hopper-v4"):
        BatchEnv("Walker2d-v4", 1)
    with pytest.raises(EnvError, match="at least 1"):
        BatchEnv("Hopper-v4", 0)
    env = BatchEnv("Hopper-v4", 2)
    env.reset(seed=0)
    with pytest.raises(EnvError, match="shape"):
        env.step(np.zeros((2, 2)))


@pytest.mark.parametrize("perturbation, action", [("world:gravity=1e12", 0.0), ("", np.nan)])
def test_an_unstable_simulation_says_so(perturbation, action):
    env = BatchEnv("Hopper-v4", 2, parse_perturbation(perturbation))
    env.reset(seed=0)
    with pytest.raises(EnvError, match="unstable"):
        for _ in range(50):
            env.step(np.full((2, 3), action))


def test_an_unstable_step_ends_that_robots_episode_alone():
    env, twin = BatchEnv("Hopper-v4", 4, nthread=1), BatchEnv("Hopper-v4", 4, nthread=1)
    before = env.reset(seed=0)[0]
    twin.reset(seed=0)
    env.qvel[2] = 1e11
    a, others = np.zeros((4, 3)), [0, 1, 3]
    assert np.isfinite(env.peek(a)).all()
    obs, reward, terminated, truncated, info = env.step(a)
    np.testing.assert_array_equal(terminated, [False, False, True, False])
    assert reward[2] == 0 and not truncated.any()
    np.testing.assert_array_equal(info["next_obs"][2], before[2])
    assert np.abs(obs[2] - env.model.qpos0[[*range(1, 6), *[0] * 6]]).max() < 2
    expected = twin.step(a)
    np.testing.assert_array_equal(obs[others], expected[0][others])
    np.testing.assert_array_equal(reward[others], expected[1][others])
    for _ in range(5):
        assert np.isfinite(env.step(a)[0]).all()
    assert env.steps[2] == 5 and env.steps[0] == 6


def test_steps_that_are_not_taken_are_counted():
    env = BatchEnv("Hopper-v4", 4, nthread=1)
    obs, _ = env.reset(seed=0)
    assert env.counterfactual_steps == 0
    env.step(np.zeros((4, 3)))
    env.peek(np.zeros((4, 3)))
    env.peek(np.zeros((4, 3)))
    env.predict(obs, np.zeros((4, 3)))
    assert env.counterfactual_steps == 12


# --- the grounded simulator -----------------------------------------------------------------------


def silent_transformer(nobs, space):
    """An action transformer whose network says 0."""
    policy = GaussianPolicy(nobs + len(space.low), len(space.low))
    for p in policy.net.parameters():
        p.data.zero_()
    return ActionTransformer(policy, space.low, space.high)


@pytest.mark.parametrize("env_id", ["InvertedPendulum-v4", "Hopper-v4", "HalfCheetah-v4"])
@pytest.mark.parametrize("network", [False, True])
def test_identity_grounding_is_the_raw_sim_bit_for_bit(env_id, network):
    raw, sim = BatchEnv(env_id, 3), BatchEnv(env_id, 3)
    transformer = (
        silent_transformer(sim.single_observation_space.shape[0], sim.single_action_space)
        if network
        else identity
    )
    grounded = GroundedEnv(sim, transformer)
    actions = random_policy(env_id, 3)
    np.testing.assert_array_equal(raw.reset(seed=1)[0], grounded.reset(seed=1)[0])
    for t in range(150):
        action = actions(t, None)
        for ours, theirs in zip(grounded.step(action)[:4], raw.step(action)[:4]):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("env_id, weight", [("Hopper-v4", 1e-3), ("HalfCheetah-v5", 0.1)])
def test_reward_sees_the_policys_own_action(env_id, weight):
    raw, grounded = BatchEnv(env_id, 3), GroundedEnv(BatchEnv(env_id, 3), lambda obs, a: 0.5 * a)
    raw.reset(seed=1), grounded.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(20):
        a = rng.uniform(-1, 1, raw.action_space.shape)
        theirs, ours = raw.step(0.5 * a), grounded.step(a)
        np.testing.assert_array_equal(ours[0], theirs[0])  # the joints feel the transformed action
        own_cost = weight * (a**2).sum(1) - weight * (0.25 * a**2).sum(1)
        np.testing.assert_allclose(ours[1], theirs[1] - own_cost, rtol=0, atol=1e-12)


def test_the_transformer_sees_the_present_observation_even_after_a_restart():
    seen = []
    grounded = GroundedEnv(BatchEnv("Hopper-v4", 4), lambda obs, a: seen.append(obs.copy()) or a)
    obs, _ = grounded.reset(seed=0)
    restarts = 0
    for t in range(80):
        given = obs
        obs, _, terminated, _, _ = grounded.step(np.ones((4, 3)))
        np.testing.assert_array_equal(seen[-1], given)
        restarts += terminated.sum()
    assert restarts > 0


def test_a_transformer_before_a_transformer():
    inner = GroundedEnv(BatchEnv("Hopper-v4", 2, nthread=1), lambda obs, a: a + 0.1)
    outer, plain = GroundedEnv(inner, lambda obs, a: 0.5 * a), BatchEnv("Hopper-v4", 2, nthread=1)
    outer.reset(seed=0), plain.reset(seed=0)
    a = np.full((2, 3), 0.4)
    for _ in range(30):
        ours, theirs = outer.step(a), plain.step(a, applied=0.5 * a + 0.1)
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])


@pytest.mark.parametrize("env_id", envs.ENV_IDS)
def test_gymnasium_makes_and_checks_the_registered_robots(env_id):
    one = gymnasium.make(f"rgat/{env_id}")
    check_env(one.unwrapped, skip_render_check=True)
    many = gymnasium.make_vec(f"rgat/{env_id}", num_envs=3)
    assert isinstance(many, BatchEnv) and many.num_envs == 3
    obs, _ = one.reset(seed=4)
    np.testing.assert_array_equal(many.reset(seed=4)[0][0], obs)
    action = np.full(one.action_space.shape, 0.1, np.float32)
    for _ in range(40):
        obs, reward, terminated, truncated, _ = one.step(action)
        step = many.step(np.tile(action, (3, 1)))
        np.testing.assert_array_equal(obs, step[4]["next_obs"][0])
        assert (reward, terminated, truncated) == (step[1][0], step[2][0], step[3][0])
        if terminated:
            break


def test_sb3_checks_a_registered_robot():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(gymnasium.make("rgat/Hopper-v5"))


def test_a_registered_robot_can_be_the_real_one():
    real = gymnasium.make("rgat/Hopper-v5", real="torso:mass*1.27").unwrapped.batch.model
    sim = gymnasium.make("rgat/Hopper-v5").unwrapped.batch.model
    assert real.body("torso").mass[0] == pytest.approx(1.27 * sim.body("torso").mass[0])


def test_peek_sees_the_next_step_and_moves_nothing():
    env, other = BatchEnv("Hopper-v4", 4), BatchEnv("Hopper-v4", 4)
    env.reset(seed=0), other.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(60):
        a, elsewhere = rng.uniform(-1, 1, (2, 4, 3))
        seen = env.peek(a)
        env.peek(elsewhere)
        ours, theirs = env.step(a), other.step(a)
        np.testing.assert_array_equal(seen, theirs[4]["next_obs"])
        np.testing.assert_array_equal(ours[0], theirs[0])


@pytest.mark.parametrize("env_id", ["InvertedPendulum-v4", "Hopper-v4", "HalfCheetah-v4"])
def test_predict_starts_from_observations(env_id):
    walker, env = BatchEnv(env_id, 4), BatchEnv(env_id, 4)
    actions = random_policy(env_id, 4)
    obs, _ = walker.reset(seed=0)
    for t in range(15):
        a = actions(t, obs)
        before = obs
        obs, _, _, _, info = walker.step(a)
        clipped = np.abs(before[:, -env.model.nv :]).max(1) >= env.task.clip_velocity
        # where the robot stands on the x axis is not observed; it moves the last digits alone
        np.testing.assert_allclose(
            env.predict(before, a)[~clipped], info["next_obs"][~clipped], rtol=0, atol=1e-7
        )
