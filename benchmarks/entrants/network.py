"""A residual network: accelerations that the nominal model lacks, learned from the recordings.

    python benchmarks/entrants/network.py {model} {recordings} {out}

The epoch that is best on the last quarter of the rows counts; where none is better than no network,
none is added. It names nothing: corrected.py adds the network's acceleration to every step. Needs
torch (requirements.txt) for training only; corrected.py is numpy.
"""

import copy
import sys
from pathlib import Path

import mujoco
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent))

from command_line import words  # noqa: E402
from common import opened, states, write  # noqa: E402

WIDTH, EPOCHS, RATE, DECAY = 48, 300, 3e-3, 1e-4

STEP = '''"""Nominal model plus a learned acceleration, by benchmarks/entrants/network.py."""

from pathlib import Path

import mujoco
import numpy as np

with np.load(Path(__file__).with_name("network.npz"), allow_pickle=False) as file:
    NET = dict(file)


def step(model, data):
    """One mj_step with the network's acceleration held over it."""
    x = np.concatenate([np.sin(data.qpos), np.cos(data.qpos), data.qvel, data.ctrl])
    x = np.clip((x - NET["mean"]) / NET["scale"], -4, 4)
    for k in range(2):
        x = np.tanh(NET[f"w{k}"] @ x + NET[f"b{k}"])
    more = (NET["w2"] @ x + NET["b2"]) * NET["size"]
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_mulM(model, data, data.qfrc_applied, more)
    mujoco.mj_step(model, data)
'''


def examples(model, recordings):
    """(inputs (N, k), lacking accelerations (N, nv))."""
    data, inputs, targets = mujoco.MjData(model), [], []
    for recording in recordings:
        for q, v, a, u in zip(*states(recording, model), recording.ctrl):
            data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, u
            mujoco.mj_forward(model, data)
            inputs.append(np.concatenate([np.sin(q), np.cos(q), v, u]))
            targets.append(a - data.qacc)
    return np.array(inputs), np.array(targets)


def train(inputs, targets):
    """Weights {name: array} of a network fitted to standardised examples."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    mean, scale = inputs.mean(0), inputs.std(0) + 1e-6
    size = np.sqrt(np.mean(targets**2, 0)) + 1e-9
    x = torch.tensor((inputs - mean) / scale, dtype=torch.float32)
    y = torch.tensor(np.clip(targets / size, -5, 5), dtype=torch.float32)
    layers = [
        torch.nn.Linear(x.shape[1], WIDTH),
        torch.nn.Tanh(),
        torch.nn.Linear(WIDTH, WIDTH),
        torch.nn.Tanh(),
        torch.nn.Linear(WIDTH, y.shape[1]),
    ]
    net = torch.nn.Sequential(*layers)
    optimizer = torch.optim.AdamW(net.parameters(), RATE, weight_decay=DECAY)
    loss, last = torch.nn.functional.mse_loss, len(x) - len(x) // 4  # the last quarter is kept back
    best, kept = float(loss(0 * y[last:], y[last:])), None
    for _ in range(EPOCHS):
        for part in torch.randperm(last).split(256):
            optimizer.zero_grad()
            loss(net(x[part]), y[part]).backward()
            optimizer.step()
        with torch.no_grad():
            now = float(loss(net(x[last:]), y[last:]))
        if now < best:
            best, kept = now, copy.deepcopy(net.state_dict())
    if kept is None:  # no network is better than none
        size = 0 * size
    else:
        net.load_state_dict(kept)
    out = {"mean": mean, "scale": scale, "size": size}
    for k, layer in enumerate(layers[::2]):
        out[f"w{k}"], out[f"b{k}"] = layer.weight.detach().numpy(), layer.bias.detach().numpy()
    return out


def main():
    """Learn, and write the nominal model with the network beside it."""
    spec, recordings, out = opened(words(main.__doc__))
    weights = train(*examples(spec.compile(), recordings))
    np.savez(out / "network.npz", **weights)
    write(out, spec)
    (out / "corrected.py").write_text(STEP)


if __name__ == "__main__":
    main()
