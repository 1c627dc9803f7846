"""One-line faults put into the paper's files, and the test that catches each.

    python benchmarks/mutants.py                   # results/mutants.csv; a few minutes each where
    all is quiet
    python benchmarks/mutants.py --only envs.py    # those of one file
    python benchmarks/mutants.py --check           # does every edit still fit the code?

Each fault is made in a copy of the code, in which the named tests run until one fails. A row that
is there already for the same edit is not made again.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from training.results import read  # noqa: E402

CSV = ROOT / "results" / "mutants.csv"
TESTS = {
    "train.py": "test_algorithm_1.py",
    "training/settings.py": "test_algorithm_1.py",
    "trpo.py": "test_trpo.py",
    "rgat.py": "test_rgat.py",
    "models.py": "test_models.py test_trpo.py",
    "envs.py": "test_envs.py",
}
MUTANTS = [  # file, what is wrong, the code, the fault
    ("train.py", "the policy improves in the raw sim", "GroundedEnv(grounding.sim, grounding.transformer)", "GroundedEnv(sim, identity)"),
    ("train.py", "the policy improves on real", "GroundedEnv(grounding.sim, grounding.transformer)", "GroundedEnv(real, grounding.transformer)"),
    ("train.py", "f_psi sees the newest data alone", "tau_real += tau_new", "tau_real = tau_new"),
    ("train.py", "tau_real is collected in the sim", "tau, episodes = rollouts(policy, real, s.real_trajectories, seed)[1]", "tau, episodes = rollouts(policy, grounding.sim, s.real_trajectories, seed)[1]"),
    ("train.py", "judged in the sim", "rollouts(policy, real, s.eval_episodes, seed, deterministic=True)", "rollouts(policy, BatchEnv(s.env, s.num_envs), s.eval_episodes, seed, deterministic=True)"),
    ("train.py", "the deterministic column is stochastic", "rollouts(policy, real, s.eval_episodes, seed, deterministic=True)", "rollouts(policy, real, s.eval_episodes, seed)"),
    ("train.py", "errors on the seeds of tau_real", 'seeds("held out")', 'seeds("collect")'),
    ("train.py", "the reference line is trained in the sim", 'pretrained(s, "real", real, s.reference_steps, bar)', 'pretrained(s, "real", BatchEnv(s.env, s.num_envs), s.reference_steps, bar)'),
    ("train.py", "the verdict judges on the episodes that chose", 'seed_for(s.seed, step, "best")', 'seed_for(s.seed, step, "evaluate")'),
    ("train.py", "the policy is not improved", "learner.learn(\n            grounded_sim, s.policy_steps", "learner.learn(\n            grounded_sim, 0"),
    ("train.py", "g_phi is trained with the policy's budget", "grounding.update(policy, s.at_steps", "grounding.update(policy, s.policy_steps"),
    ("train.py", "held-out rows without the transformer", "one_step_error(grounding.sim, grounding.transformer, held_out)", "one_step_error(grounding.sim, identity, held_out)"),
    ("train.py", "a bad policy is rolled back to the first, not the best", "learner.load(run.checkpoint(run.best())", "learner.load(run.checkpoint(0)"),
    ("train.py", "normaliser frozen while pretraining", "freeze_normalizer=False, on_update=log", "on_update=log"),
    ("training/settings.py", "the same seeds in every grounding step", "SeedSequence([seed, step, PURPOSES", "SeedSequence([seed, 0, PURPOSES"),
    ("training/settings.py", "--at-gamma is ignored", "gamma=self.at_gamma, ", ""),
    ("training/settings.py", "--forward-model is ignored", 'residual=self.forward_model == "residual"', "residual=True"),
    ("training/settings.py", "--ane-width is ignored", "ane_width=self.ane_width,", ""),
    ("trpo.py", "the entropy's sign", "+ config.entropy * gaussian_entropy(log_std)", "- config.entropy * gaussian_entropy(log_std)"),
    ("trpo.py", "KL of new and old exchanged in the line search", "kl = gaussian_kl(old_mean, old_log_std, mean, log_std)", "kl = gaussian_kl(mean, log_std, old_mean, old_log_std)"),
    ("trpo.py", "GAE without lambda", "gamma * lam * ~done[t] * running", "gamma * ~done[t] * running"),
    ("trpo.py", "GAE runs on over a time limit", "gamma * lam * ~done[t] * running", "gamma * lam * ~terminated[t] * running"),
    ("trpo.py", "1.5 times the trust region is taken", "and kl <= config.max_kl", "and kl <= 1.5 * config.max_kl"),
    ("trpo.py", "a worse surrogate is taken", "and new_surrogate > old_surrogate", "and True"),
    ("trpo.py", "the step's 2 is forgotten", "torch.sqrt(2 * config.max_kl / curvature)", "torch.sqrt(config.max_kl / curvature)"),
    ("trpo.py", "advantages keep their scale", "(advantage - advantage.mean()) / spread if", "(advantage - advantage.mean()) if"),
    ("trpo.py", "the critic learns the advantage", "returns = advantage + value\n", "returns = advantage\n"),
    ("trpo.py", "the scale of returns is never measured", "value.returns.update(returns[:, None])", "pass"),
    ("trpo.py", "values bootstrap over a time limit's reset", 'edge = batch["done"].copy()', 'edge = batch["terminated"].copy()'),
    ("trpo.py", "collect's successor is the next episode's", "successors(obs, info).astype(np.float32),", "np.asarray(obs, np.float32),"),
    ("trpo.py", "rollouts' successor is the next episode's", "successors(obs, info)[alive].astype(np.float32)", "np.asarray(obs, np.float32)[alive]"),
    ("trpo.py", "gymnasium's final observations are left out", 'after[i] = info["final_obs"][i]', "pass"),
    ("trpo.py", "rollouts do not clip", "action, before = np.clip(action.numpy(), low, high), obs", "action, before = action.numpy(), obs"),
    ("trpo.py", "statistics of observations never freeze", "adapt = self.config.normalize_obs and not freeze_normalizer", "adapt = self.config.normalize_obs"),
    ("trpo.py", "a copied critic does not learn", "        tie(self.optimizer, self.value.net)\n", ""),
    ("trpo.py", "Hopper's discount", '"Hopper": TRPOConfig(gamma=0.995', '"Hopper": TRPOConfig(gamma=0.9'),
    ("trpo.py", "the damping is added twice", "+ damping * v", "+ 2 * damping * v"),
    ("rgat.py", "no baseline", "(distance(guess) if self.baseline else 0.0)", "0.0"),
    ("rgat.py", "a baseline for any discount", "self.real_model.residual and self.settings.at.gamma == 0", "self.real_model.residual"),
    ("rgat.py", "both noises are one stream", "self.scale, seed + 1, baseline", "self.scale, seed, baseline"),
    ("rgat.py", "a_hat leaves the bounds", "np.clip(action + (self.high - self.low) * output, self.low, self.high)", "action + (self.high - self.low) * output"),
    ("rgat.py", "g_phi's falls are ends", "reward, np.zeros_like(done), done, {", "reward, terminated, truncated, {"),
    ("rgat.py", "g_phi's successor is the next episode's", 'next_sa = self._with_action(info["next_obs"])', "next_sa = self._with_action(obs)"),
    ("rgat.py", "exploration is not renewed", "self.learner.policy.log_std.fill_(np.log(self.settings.at_std))", "pass"),
    ("rgat.py", "g_phi begins anew in every step", "if not self.learner.value.normalizer.count:", "if True:"),
    ("rgat.py", "units are measured anew in every step", "if self.settings.per_step and (self.scale == 1).all():", "if self.settings.per_step:"),
    ("rgat.py", "the inverse is fitted to the real data", "s, a, s_next = tau_sim.tensors()", "s, a, s_next = self.seen.tensors()"),
    ("rgat.py", "g_phi is trained against the policy's mean", "a = self.policy.act(torch.from_numpy(s), self.generator).numpy()", "a = self.policy.mean(torch.from_numpy(s)).detach().numpy()"),
    ("rgat.py", "solved towards the sim's own step", "self.real_model(self.sim.observe(), action)[0] / self.scale", "self.real_model(self.sim.observe(), action)[1] / self.scale"),
    ("rgat.py", "labels are a_hat, not delta_a", "a_hat - action))", "a_hat))"),
    ("models.py", "a network's memory depends on its past", "        as_vector(self)\n\n    def mean", "\n    def mean"),
    ("models.py", "a fit takes torch's threads", "    @torch_threads(1)\n    def fit", "    def fit"),
    ("models.py", "the last weights are kept, not the best", "self.net.load_state_dict(best_state)", "pass"),
    ("models.py", "KL without the change of the mean", "(var0 + (mean0 - mean1) ** 2)", "var0"),
    ("envs.py", "mass without inertia", "            model.body_inertia[body] *= change.of(old) / old\n", ""),
    ("envs.py", "mass without mj_setConst", "    mujoco.mj_setConst(model, mujoco.MjData(model))\n", ""),
    ("envs.py", "next_obs after the restart", "            self.obs = self.observe()\n        return self.obs.copy(), reward", '            self.obs = self.observe()\n            info["next_obs"] = self.obs\n        return self.obs.copy(), reward'),
    ("envs.py", "every simulation has the same seed", "[seed + i for i in range(self.num_envs)]", "[seed for i in range(self.num_envs)]"),
    ("envs.py", "the caller's model is changed", "    model = copy.copy(model)\n", ""),
    ("envs.py", "a servo's bias keeps its gain", "model.actuator_biasprm[i, :3] *=", "0 *"),
    ("envs.py", "an unstable robot's episode goes on", "self.task.unhealthy(self.qpos, self.qvel) | lost", "self.task.unhealthy(self.qpos, self.qvel)"),
    ("envs.py", "the reward sees a_hat", "reward = self._reward(actions,", "reward = self._reward(actions if applied is None else applied,"),
]  # fmt: skip


def faulty(file, code, fault):
    """The text of a file with a fault in it. Raises SystemExit where the code has changed under the
    edit."""
    text = (ROOT / file).read_text()
    if text.count(code) != 1:
        sys.exit(f"{file}: {text.count(code)} places hold {code!r}: renew this edit in {__file__}")
    return text.replace(code, fault)


def caught_by(file, code, fault):
    """The first test that fails with the fault, or ""."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "code"
        leave_out = shutil.ignore_patterns(
            ".git", "results", "docs", "runs", "__pycache__", ".venv"
        )
        shutil.copytree(ROOT, copy, ignore=leave_out)
        (copy / file).write_text(faulty(file, code, fault))
        tests = [f"tests/{name}" for name in TESTS[file].split()]
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests],
            cwd=copy,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
        )
    failed = [line.split()[1] for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]  # fmt: skip
    return failed[0] if failed else ""


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", help="a file")
    parser.add_argument("--check", action="store_true", help="run nothing")
    args = parser.parse_args()
    from benchmarks.rows import append

    done = {(row["file"], row["fault"]) for row in read(CSV)}
    for file, what, code, fault in MUTANTS:
        faulty(file, code, fault)
        if args.check or (file, what) in done or args.only not in (None, file):
            continue
        test = caught_by(file, code, fault)
        append(CSV, [{"file": file, "fault": what, "caught": bool(test), "by": test}])
        print(f"{file}: {what}: {test or 'NOT CAUGHT'}", flush=True)
    rows = read(CSV)
    print(f"{sum(row['caught'] == 'True' for row in rows)} of {len(rows)} faults are caught")


if __name__ == "__main__":
    main()
