"""The networks of the method: policy and value for TRPO, forward and inverse models to ground.

    policy = GaussianPolicy(nobs=11, nact=3)
    action = policy.act(obs)                       # (N, 3), sampled; .mean(obs) is deterministic
    torch.save(policy.checkpoint(), "policy.pt"); policy = GaussianPolicy.load("policy.pt")
    f_psi = ForwardModel(11, 3); f_psi.fit(s, a, s_next, guess, generator); f_psi(s, a, guess)

All are float32 MLPs that normalise their own inputs, and need torch alone.
"""

import math
from contextlib import contextmanager

import torch
from torch import nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

DEEP, SHALLOW = (64, 64), (4,)  # hidden layers of the paper's two target policies (section IV-B)
LOG_2PI_E = math.log(2 * math.pi * math.e)


@contextmanager
def torch_threads(n):
    """Meanwhile torch takes n threads. All numbers here are made with one: sums that several
    threads share round otherwise, and in a rollout torch's threads would fight the simulator's pool
    for the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(n)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def as_vector(network):
    """The parameters of a network as the one vector that they become views of: (n,).

    A network that was trained, one that was loaded and a copy of either lie in memory in the same
    way from here on: products round by where their factors lie, and a run that goes on would drift
    from the run it was.
    """
    vector = parameters_to_vector(network.parameters()).detach()
    vector_to_parameters(vector, network.parameters())
    return vector


class MLP(nn.Sequential):
    """Fully connected tanh layers, the last one linear; orthogonal
    weights, the last times last_gain.

    The derivatives that learning asks for most are written out. Autograd finds the same numbers,
    bit for bit, but in networks this small its bookkeeping takes as long as the arithmetic.
    """

    @torch_threads(1)
    def __init__(self, sizes, last_gain=1.0):
        layers = []
        for i, (n_in, n_out) in enumerate(zip(sizes, sizes[1:])):
            last = i == len(sizes) - 2
            layer = nn.Linear(n_in, n_out)
            nn.init.orthogonal_(layer.weight, last_gain if last else math.sqrt(2))
            nn.init.zeros_(layer.bias)
            layers += [layer] if last else [layer, nn.Tanh()]
        super().__init__(*layers)
        self.linear = layers[::2]
        as_vector(self)

    @torch.no_grad()
    def values(self, x):
        """What enters each linear layer, and the output: [x, h_1, ..., y], all (N, width)."""
        values = [x]
        for layer in self.linear:
            values.append(torch.addmm(layer.bias, values[-1], layer.weight.t()))
            if layer is not self.linear[-1]:
                values[-1].tanh_()
        return values

    @torch.no_grad()
    def gradient(self, values, g):
        """J' g for g (N, outputs), J the Jacobian of the output by the weights.

        Returns a list in the order of parameters()."""
        found = []
        for k, layer in reversed(list(enumerate(self.linear))):
            found = [g.t() @ values[k], g.sum(0), *found]
            if k:
                g = torch.ops.aten.tanh_backward(
                    g @ layer.weight, values[k]
                )  # (1 - h^2) times what arrives there
        return found

    @torch.no_grad()
    def tangent(self, values, v):
        """J v, (N, outputs), for v a list of changes of the weights, as parameters() has them."""
        moved = None
        for layer, x, weight, bias in zip(self.linear, values, v[::2], v[1::2]):
            through = torch.addmm(bias, x, weight.t())
            if moved is not None:
                through += torch.ops.aten.tanh_backward(moved, x) @ layer.weight.t()
            moved = through
        return moved


def adam(net, lr):
    """Adam on all weights of a network as one vector: the same numbers in fewer calls."""
    return torch.optim.Adam([nn.Parameter(as_vector(net))], lr=lr)


def tie(optimizer, net):
    """Make adam()'s vector the weights of net again, where a copy of either has parted them."""
    [weights] = optimizer.param_groups[0]["params"]
    weights.data = as_vector(net)
    moments = optimizer.state[weights]
    moments.update({k: v.to(weights.dtype) for k, v in moments.items() if k != "step"})


def least_squares_step(net, optimizer, x, y):
    """One step of adam(net, ...) on the mean of (net(x) - y)^2."""
    values, [weights] = net.values(x), optimizer.param_groups[0]["params"]
    error = values[-1] - y
    weights.grad = parameters_to_vector(net.gradient(values, (2 / error.numel()) * error))
    optimizer.step()


class Normalizer(nn.Module):
    """(x - mean) / std, the statistics kept as buffers: saved, but not trained by gradients."""

    def __init__(self, size, clip=10.0):
        super().__init__()
        self.clip = clip
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def forward(self, x):
        return torch.clamp((x - self.mean) / self.std, -self.clip, self.clip)

    @property
    def std(self):
        return torch.sqrt(self.var + 1e-8)

    def inverse(self, y):
        return y * self.std + self.mean

    @torch.no_grad()
    def update(self, x):
        """Merge the rows of x (N, size) into the running mean and variance."""
        n = len(x)
        total = self.count + n
        weight = float(n / total)
        delta = x.mean(0) - self.mean
        self.var.mul_(1 - weight).add_(
            weight * x.var(0, unbiased=False) + weight * (1 - weight) * delta**2
        )
        if self.count == 0:
            self.var.copy_(x.var(0, unbiased=False))
        self.mean.add_(weight * delta)
        self.count.copy_(total)


class GaussianPolicy(nn.Module):
    """pi(a|s) = N(mean_theta(s), diag(exp(log_std))^2): the mean an MLP, log_std the same anywhere.

    Args: nobs, nact: widths. hidden: hidden layer widths. log_std: initial
    value for every action dimension.
    low, high: the robot's bounds of an action, (nact,), which action() keeps; what is learnt from
    is unbounded.
    """

    def __init__(self, nobs, nact, hidden=DEEP, log_std=0.0, low=-math.inf, high=math.inf):
        super().__init__()
        for name, bound in (("low", low), ("high", high)):
            self.register_buffer(name, torch.as_tensor(bound).float().expand(nact).clone())
        self.sizes = (nobs, *hidden, nact)
        self.normalizer = Normalizer(nobs)
        self.net = MLP(self.sizes, last_gain=0.01)  # starts near mean 0 everywhere
        self.log_std = nn.Parameter(torch.full((nact,), float(log_std)))
        as_vector(self)

    def mean(self, obs):
        """The deterministic action, (N, nact), for obs (N, nobs)."""
        return self.net(self.normalizer(obs))

    @torch.no_grad()
    def action(self, obs):
        """What a robot should do, (N, nact), within its bounds, for obs (N, nobs)."""
        return torch.clamp(self.mean(obs), self.low, self.high)

    def forward(self, obs):
        """Mean (N, nact) and log_std (nact,)."""
        return self.mean(obs), self.log_std

    def act(self, obs, generator=None):
        """A sample for each row of obs: (N, nact)."""
        return self.sampler(generator)(obs)

    @torch.no_grad()
    def sampler(self, generator=None):
        """act() of the policy as it now is, with what depends on its
        weights alone worked out once."""
        center, std, clip, sigma = (
            self.normalizer.mean,
            self.normalizer.std,
            self.normalizer.clip,
            self.log_std.exp(),
        )
        *hidden, (bias, weight) = [(layer.bias, layer.weight.t()) for layer in self.net.linear]

        @torch.no_grad()
        def act(obs):
            x = torch.clamp((obs - center) / std, -clip, clip)
            for b, w in hidden:
                x = torch.addmm(b, x, w).tanh_()
            mean = torch.addmm(bias, x, weight)
            return mean + sigma * torch.randn(mean.shape, generator=generator)

        return act

    def checkpoint(self):
        """What load() needs to build this policy again."""
        return {"sizes": list(self.sizes), "state": self.state_dict()}

    @classmethod
    def load(cls, path):
        """The policy whose checkpoint() is in a file, of which no code is run.

        Raises ValueError for any other file."""
        saved = load_checkpoint(path)
        try:
            sizes = saved["sizes"]
            policy = cls(sizes[0], sizes[-1], tuple(sizes[1:-1]))
            policy.load_state_dict(saved["state"])
        except (KeyError, TypeError, IndexError, RuntimeError) as error:
            raise ValueError(
                f"no policy in this checkpoint ({str(error).splitlines()[0]})"
            ) from None
        return policy


def load_checkpoint(path):
    """torch.load with weights_only=True.

    Raises ValueError, in one line, for what it cannot read."""
    try:
        return torch.load(path, weights_only=True)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such checkpoint") from None
    except Exception as error:  # torch raises a dozen types for damaged files
        raise ValueError(
            f"{path}: not a checkpoint of this program, or a damaged one ({type(error).__name__})"
        ) from None


def gaussian_log_prob(mean, log_std, action):
    """log N(action; mean, exp(log_std)^2), summed over the action's dimensions: (N,)."""
    z = (action - mean) * torch.exp(-log_std)
    return -0.5 * (z**2).sum(-1) - log_std.sum() - 0.5 * math.log(2 * math.pi) * action.shape[-1]


def gaussian_kl(mean0, log_std0, mean1, log_std1):
    """KL(N0 || N1) of diagonal Gaussians, averaged over the rows: a scalar."""
    var0, var1 = torch.exp(2 * log_std0), torch.exp(2 * log_std1)
    per_dim = log_std1 - log_std0 + (var0 + (mean0 - mean1) ** 2) / (2 * var1) - 0.5
    return per_dim.sum(-1).mean()


def gaussian_entropy(log_std):
    """Entropy in nats of a diagonal Gaussian."""
    return log_std.sum() + 0.5 * LOG_2PI_E * len(log_std)


class Value(nn.Module):
    """V(s), predicted in units of the returns seen so far so that the loss keeps one scale."""

    def __init__(self, nobs, hidden=DEEP):
        super().__init__()
        self.normalizer = Normalizer(nobs)
        self.returns = Normalizer(1)
        self.net = MLP((nobs, *hidden, 1))

    def forward(self, obs):
        """Values (N,) of obs (N, nobs), in units of reward."""
        return self.returns.inverse(self.net(self.normalizer(obs)))[:, 0]


# --- supervised models of the dynamics ------------------------------------------------------------


class Regressor(nn.Module):
    """y = net(x) with inputs and outputs normalised by the training data's statistics."""

    def __init__(self, n_in, n_out, hidden=(128, 128)):
        super().__init__()
        self.inputs, self.outputs = Normalizer(n_in), Normalizer(n_out)
        self.net = MLP((n_in, *hidden, n_out))

    def forward(self, x):
        return self.outputs.inverse(self.net(self.inputs(x)))

    @torch_threads(1)
    def fit(self, x, y, generator, max_updates=5_000, patience=10, batch_size=256, lr=1e-3):
        """Least squares with Adam, for at most max_updates * batch_size samples.

        It stops earlier when the held-out fifth has not improved for `patience` epochs.

        Args: x (N, n_in), y (N, n_out) float32 tensors; generator: the split
        and the batches are drawn from it.
        Returns: the RMS error of each output on the held-out rows, (n_out,),
        which chose the epoch whose weights stay.
        """
        order = torch.randperm(len(x), generator=generator)
        held, train = order[: max(1, len(x) // 5)], order[max(1, len(x) // 5) :]
        for normalizer, data in ((self.inputs, x), (self.outputs, y)):
            normalizer.count.zero_()
            normalizer.update(data[train])
        x, target = self.inputs(x), (y - self.outputs.mean) / self.outputs.std
        optimizer = adam(self.net, lr)
        best, best_state, stale = math.inf, None, 0
        for _ in range(max(1, max_updates * batch_size // len(train))):
            for rows in train[torch.randperm(len(train), generator=generator)].split(batch_size):
                least_squares_step(self.net, optimizer, x[rows], target[rows])
            with torch.no_grad():
                error = float(((self.net(x[held]) - target[held]) ** 2).mean())
            stale += 1
            if error < best:
                best, best_state, stale = (
                    error,
                    {k: v.clone() for k, v in self.net.state_dict().items()},
                    0,
                )
            if stale >= patience:
                break
        self.net.load_state_dict(best_state)
        with torch.no_grad():
            return (
                ((self.outputs.std * (self.net(x[held]) - target[held])) ** 2).mean(0).sqrt()
            ).numpy()


class ForwardModel(Regressor):
    """f_psi(s, a) -> s', on top of a first guess: the state itself, or where the raw sim goes.

    With the sim as guess the network learns only what the sim gets wrong. That matters where
    contacts make s' jump: a network fitted on a few thousand Hopper transitions errs several times
    more than the raw sim does, and its errors would be all that R_AT shows the action transformer.
    """

    def __init__(self, nobs, nact, hidden=(128, 128)):
        super().__init__(2 * nobs + nact, nobs, hidden)

    def forward(self, s, a, guess):
        """s' (N, nobs) for s (N, nobs), a (N, nact) and the guess of s' (N, nobs)."""
        return guess + super().forward(torch.cat((s, a, guess - s), -1))

    def fit(self, s, a, s_next, guess, generator, **settings):
        """Fit to transitions and guesses, all (N, ...).

        Returns the held-out RMS error by dimension."""
        return super().fit(torch.cat((s, a, guess - s), -1), s_next - guess, generator, **settings)


class InverseModel(Regressor):
    """f^-1(s, s') -> a: the action that most likely led from s to s'."""

    def __init__(self, nobs, nact, hidden=(128, 128)):
        super().__init__(2 * nobs, nact, hidden)

    def forward(self, s, s_next):
        return super().forward(torch.cat((s, s_next - s), -1))

    def fit(self, s, s_next, a, generator, **settings):
        """Fit to (N, nobs), (N, nobs), (N, nact). Returns the held-out RMS error of each action."""
        return super().fit(torch.cat((s, s_next - s), -1), a, generator, **settings)
