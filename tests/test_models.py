"""Networks against torch.distributions and numpy; regressors on systems with a known answer;
checkpoints good and bad."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

ROOT = str(Path(__file__).resolve().parents[1])
from models import (
    DEEP,
    MLP,
    SHALLOW,
    ForwardModel,
    GaussianPolicy,
    InverseModel,
    Normalizer,
    Regressor,
    Value,
    adam,
    gaussian_entropy,
    gaussian_kl,
    gaussian_log_prob,
    least_squares_step,
    load_checkpoint,
)
from trpo import TRPOConfig, policy_update

seeds = st.integers(0, 2**31 - 1)


def gaussians(seed, n=7, k=3):
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(shape, generator=g, dtype=torch.float64)
    return (draw(n, k), draw(k)), (draw(n, k), draw(k)), draw(n, k)


def stock(mean, log_std):
    return torch.distributions.Independent(
        torch.distributions.Normal(mean, log_std.exp().expand_as(mean)), 1
    )


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_densities_equal_torch_distributions(seed):
    p, q, action = gaussians(seed)
    kl = torch.distributions.kl_divergence(stock(*p), stock(*q)).mean()
    torch.testing.assert_close(gaussian_kl(*p, *q), kl)
    torch.testing.assert_close(gaussian_log_prob(*p, action), stock(*p).log_prob(action))
    torch.testing.assert_close(gaussian_entropy(p[1]), stock(*p).entropy().mean())


def test_policy_samples_its_own_distribution():
    torch.manual_seed(0)
    policy = GaussianPolicy(4, 2, log_std=-0.5)
    policy.net[-1].bias.data = torch.tensor([0.3, -1.0])
    obs = torch.randn(1, 4).expand(40_000, 4)
    sample = policy.act(obs, torch.Generator().manual_seed(1))
    torch.testing.assert_close(sample.mean(0), policy.mean(obs[:1])[0], atol=0.01, rtol=0)
    torch.testing.assert_close(
        sample.std(0), torch.full((2,), float(np.exp(-0.5))), atol=0.01, rtol=0
    )
    again = policy.act(obs, torch.Generator().manual_seed(1))
    torch.testing.assert_close(sample, again, atol=0, rtol=0)


@pytest.mark.parametrize(
    "hidden, count",
    [(DEEP, 11 * 64 + 64 + 64 * 64 + 64 + 64 * 3 + 3 + 3), (SHALLOW, 11 * 4 + 4 + 4 * 3 + 3 + 3)],
)
def test_the_papers_policies(hidden, count):
    policy = GaussianPolicy(11, 3, hidden)
    assert sum(p.numel() for p in policy.parameters()) == count
    obs = torch.randn(5, 11)
    layers = list(policy.net)
    x = obs
    for linear in layers[:-1:2]:
        x = torch.tanh(x @ linear.weight.T + linear.bias)
    torch.testing.assert_close(policy.mean(obs), x @ layers[-1].weight.T + layers[-1].bias)


widths = st.lists(st.integers(1, 9), min_size=2, max_size=5)


def small_network(seed, widths, rows=7):
    """A network in double precision, its input, and noise in the shape of each of its weights."""
    torch.manual_seed(seed)
    net = MLP(widths).double()
    for p in net.parameters():
        p.data += 0.3 * torch.randn_like(p)
    return (
        net,
        torch.randn(rows, widths[0], dtype=torch.float64),
        [torch.randn_like(p) for p in net.parameters()],
    )


@given(seeds, widths)
@settings(max_examples=30, deadline=None)
def test_written_out_derivatives_equal_autograds(seed, widths):
    net, x, v = small_network(seed, widths)
    values, g = net.values(x), torch.randn(len(x), widths[-1], dtype=torch.float64)
    torch.testing.assert_close(values[-1], net(x).detach())
    for ours, theirs in zip(
        net.gradient(values, g), torch.autograd.grad(net(x), list(net.parameters()), g), strict=True
    ):
        torch.testing.assert_close(ours, theirs)
    names = [name for name, _ in net.named_parameters()]
    at = lambda *weights: torch.func.functional_call(net, dict(zip(names, weights)), x)
    Jv = torch.autograd.functional.jvp(at, tuple(p.detach() for p in net.parameters()), tuple(v))[1]
    torch.testing.assert_close(net.tangent(values, v), Jv)


@given(seeds, widths)
@settings(max_examples=20, deadline=None)
def test_least_squares_steps_are_those_of_autograd_and_adam(seed, widths):
    nets = [small_network(seed, widths)[0] for _ in range(2)]
    x, y = (
        torch.randn(11, widths[0], dtype=torch.float64),
        torch.randn(11, widths[-1], dtype=torch.float64),
    )
    ours, theirs = adam(nets[0], 0.1), torch.optim.Adam(nets[1].parameters(), lr=0.1)
    for _ in range(3):
        least_squares_step(nets[0], ours, x, y)
        theirs.zero_grad()
        torch.nn.functional.mse_loss(nets[1](x), y).backward()
        theirs.step()
    for a, b in zip(*(net.parameters() for net in nets)):
        torch.testing.assert_close(a, b)


@given(seeds, st.lists(st.integers(1, 40), min_size=1, max_size=6))
@settings(max_examples=30, deadline=None)
def test_normalizer_equals_numpy_however_the_data_arrive(seed, sizes):
    rng = np.random.default_rng(seed)
    data = (rng.normal(size=(sum(sizes), 3)) * [1, 10, 0.1] + [0, -5, 2]).astype(np.float32)
    normalizer = Normalizer(3)
    for part in np.split(data, np.cumsum(sizes)[:-1]):
        normalizer.update(torch.from_numpy(part))
    wide = data.astype(float)
    np.testing.assert_allclose(normalizer.mean, wide.mean(0), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(normalizer.var, wide.var(0), rtol=1e-3, atol=1e-4)
    assert float(normalizer.count) == len(data)
    expected = np.clip((wide - wide.mean(0)) / np.sqrt(wide.var(0) + 1e-8), -10, 10)
    if len(data) > 1:
        np.testing.assert_allclose(normalizer(torch.from_numpy(data)), expected, atol=0.02)
    inside = torch.from_numpy(data[np.abs(expected).max(1) < 10])
    torch.testing.assert_close(normalizer.inverse(normalizer(inside)), inside, rtol=1e-3, atol=1e-3)


def test_normalizer_is_not_trained():
    assert not list(Normalizer(3).parameters())
    assert {"mean", "var", "count"} <= set(Normalizer(3).state_dict())


def test_value_speaks_in_units_of_reward():
    torch.manual_seed(0)
    value = Value(3)
    value.returns.update(torch.tensor([[100.0], [300.0]]))
    obs = torch.randn(6, 3)
    torch.testing.assert_close(
        value(obs), 200 + 100 * value.net(value.normalizer(obs))[:, 0], rtol=1e-5, atol=1e-3
    )


# --- supervised models ----------------------------------------------------------------------------


def linear_system(n=3000, seed=0):
    """s' = A s + B a with a well-conditioned B: float32 tensors s, a, s'."""
    rng = np.random.default_rng(seed)
    A, B = np.eye(4) + 0.3 * rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    s, a = rng.normal(size=(n, 4)) * [1, 5, 0.2, 1], rng.uniform(-1, 1, (n, 2))
    return tuple(torch.from_numpy(x.astype(np.float32)) for x in (s, a, s @ A.T + a @ B.T))


def test_forward_model_learns_a_linear_system():
    s, a, s_next = linear_system()
    torch.manual_seed(0)
    model = ForwardModel(4, 2)
    error = model.fit(s, a, s_next, s, torch.Generator().manual_seed(0), max_updates=800)
    fresh = linear_system(500, seed=0)  # the same system: its matrices are drawn first
    with torch.no_grad():
        miss = ((model(*fresh[:2], fresh[0]) - fresh[2]) ** 2).mean(0).sqrt().numpy()
    spread = ((s_next - s) ** 2).mean(0).sqrt().numpy()
    assert (miss < 0.1 * spread).all()
    assert (0.3 < error / miss).all() and (
        error / miss < 3
    ).all()  # what fit says of itself is right


def test_forward_model_that_starts_from_a_right_guess_stays_there():
    s, a, s_next = linear_system(600)
    torch.manual_seed(0)
    model = ForwardModel(4, 2)
    assert (
        model.fit(s, a, s_next, s_next, torch.Generator().manual_seed(0), max_updates=50) < 1e-3
    ).all()


def test_inverse_model_learns_a_linear_system():
    s, a, s_next = linear_system()
    torch.manual_seed(0)
    model = InverseModel(4, 2)
    error = model.fit(s, s_next, a, torch.Generator().manual_seed(0), max_updates=800)
    with torch.no_grad():
        miss = ((model(s, s_next) - a) ** 2).mean(0).sqrt().numpy()
    assert (
        error.shape == (2,) and (error < 0.1).all() and (miss < 0.1).all()
    )  # the actions reach from -1 to 1


def test_fit_keeps_the_best_weights_and_repeats():
    s, a, s_next = linear_system(400)
    results = []
    for _ in range(2):
        torch.manual_seed(3)
        model = ForwardModel(4, 2, hidden=(16,))
        error = model.fit(s, a, s_next, s, torch.Generator().manual_seed(5), max_updates=100)
        results.append((error, [p.detach().clone() for p in model.parameters()]))
    np.testing.assert_array_equal(results[0][0], results[1][0])
    assert all(torch.equal(p, q) for p, q in zip(results[0][1], results[1][1]))
    # the reported error is that of the held-out rows under the weights that are kept
    order = torch.randperm(400, generator=torch.Generator().manual_seed(5))[:80]
    with torch.no_grad():
        held_out = ((model(s, a, s) - s_next)[order] ** 2).mean(0).sqrt()
    np.testing.assert_allclose(error, held_out, rtol=1e-3)


def test_fit_normalises_by_the_training_rows():
    s, a, s_next = linear_system(400)
    model = InverseModel(4, 2)
    model.fit(s, s_next, a, torch.Generator().manual_seed(5), max_updates=5)
    train = torch.randperm(400, generator=torch.Generator().manual_seed(5))[80:]
    np.testing.assert_allclose(model.inputs.mean[:4], s[train].double().mean(0), atol=1e-4)
    np.testing.assert_allclose(
        model.outputs.var, a[train].double().var(0, unbiased=False), atol=1e-4
    )


# --- checkpoints ----------------------------------------------------------------------------------


def test_a_network_lies_in_memory_as_one_vector_whatever_became_of_it():
    """Trained, loaded or new: rounding depends on where the factors of a product lie."""
    fresh, trained = GaussianPolicy(5, 2), GaussianPolicy(5, 2)
    policy_update(trained, torch.randn(50, 5), torch.randn(50, 2), torch.randn(50), TRPOConfig())
    loaded = GaussianPolicy(5, 2)
    loaded.load_state_dict(trained.state_dict())
    starts = np.cumsum([0, *(p.numel() for p in fresh.parameters())])[:-1]
    for policy in (fresh, trained, loaded):
        parameters = list(policy.parameters())
        assert [p.storage_offset() for p in parameters] == list(starts)
        assert len({p.untyped_storage().data_ptr() for p in parameters}) == 1


def test_a_fit_ends_with_its_best_epoch_not_its_last():
    """Noise alone: what is learnt of it makes the held-out rows worse."""
    torch.manual_seed(0)
    x, y = torch.randn(60, 3), torch.randn(60, 1)
    model = Regressor(3, 1)
    reported = model.fit(x, y, torch.Generator().manual_seed(0), patience=200, lr=1e-2)
    held = torch.randperm(60, generator=torch.Generator().manual_seed(0))[:12]
    with torch.no_grad():
        miss = float(((model(x[held]) - y[held]) ** 2).mean().sqrt())
    assert miss == pytest.approx(float(reported[0]), rel=1e-4)
    assert miss < 0.9 * float(y[held].std())  # the last epoch: above 1


def test_policy_survives_saving(tmp_path):
    torch.manual_seed(0)
    policy = GaussianPolicy(5, 2, (8, 6), log_std=-1)
    policy.normalizer.update(torch.randn(100, 5) * 4 + 1)
    torch.save(policy.checkpoint(), tmp_path / "policy.pt")
    loaded = GaussianPolicy.load(tmp_path / "policy.pt")
    obs = torch.randn(9, 5)
    torch.testing.assert_close(loaded.mean(obs), policy.mean(obs), rtol=0, atol=0)
    torch.testing.assert_close(loaded.log_std, policy.log_std, rtol=0, atol=0)
    assert torch.load(tmp_path / "policy.pt", weights_only=True)["sizes"] == [5, 8, 6, 2]


def test_policy_loads_with_torch_alone(tmp_path):
    torch.save(GaussianPolicy(5, 2).checkpoint(), tmp_path / "policy.pt")
    program = (
        "import sys\n"
        "for name in ('mujoco', 'gymnasium', 'matplotlib', 'tqdm', 'PIL'): sys.modules[name] = "
        "None\n"
        "import torch\n"
        "from models import GaussianPolicy\n"
        f"policy = GaussianPolicy.load({str(tmp_path / 'policy.pt')!r})\n"
        "print(tuple(policy.mean(torch.zeros(3, 5)).shape))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "(3, 2)", done.stderr


class Trap:
    """Unpickling this would make a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def bad_files(folder):
    policy = GaussianPolicy(5, 2)
    good = folder / "good.pt"
    torch.save(policy.checkpoint(), good)
    data = good.read_bytes()
    (folder / "empty.pt").write_bytes(b"")
    (folder / "text.pt").write_text("return,seed\n1,2\n")
    (folder / "truncated.pt").write_bytes(data[: len(data) // 2])
    (folder / "flipped.pt").write_bytes(
        data[:200] + bytes(b ^ 255 for b in data[200:400]) + data[400:]
    )
    (folder / "folder.pt").mkdir()
    torch.save(Trap(folder / "sprung"), folder / "trap.pt")
    torch.save(
        {"sizes": [5, 64, 64, 2], "state": Trap(folder / "sprung")}, folder / "inner trap.pt"
    )
    torch.save([1, 2, 3], folder / "list.pt")
    torch.save({"state": policy.state_dict()}, folder / "no sizes.pt")
    torch.save({"sizes": [5, 64, 2], "state": policy.state_dict()}, folder / "other sizes.pt")
    torch.save({"sizes": [], "state": policy.state_dict()}, folder / "empty sizes.pt")
    torch.save({"sizes": "deep", "state": policy.state_dict()}, folder / "worded sizes.pt")
    torch.save({"sizes": [5, -1, 2], "state": policy.state_dict()}, folder / "negative sizes.pt")
    torch.save({"sizes": [5, 64, 64, 2], "state": None}, folder / "no state.pt")
    torch.save(policy.state_dict(), folder / "bare state.pt")
    return sorted(p for p in folder.glob("*.pt") if p != good) + [folder / "missing.pt"]


def test_broken_and_foreign_files_are_refused_in_one_line(tmp_path):
    paths = bad_files(tmp_path)
    assert len(paths) == 16
    for path in paths:
        with pytest.raises(ValueError) as error:
            GaussianPolicy.load(path)
        assert "\n" not in str(error.value) and len(str(error.value)) > 15, path
    assert not (tmp_path / "sprung").exists()


def test_a_missing_checkpoint_is_named(tmp_path):
    with pytest.raises(ValueError, match="no such checkpoint"):
        load_checkpoint(tmp_path / "missing.pt")
