"""What a smoother makes of what happens in the rows: the force that it would locate.

response = Response(gains, index, own, nv)       # of a Smoother's last pass
force = response(change)                         # (rows, nv, k) of (rows, 2 nv, k)

A located force is smooth: what changes within a few rows is spread over its neighbours, and the
less of it is located the noisier the positions are. Beside such a force, what an effect does in the
same rows has to go through the same filter; as both are linear, its gains are enough.
"""

import numpy as np


class Response:
    """Of all rows of recordings, cut into the blocks of a Smoother."""

    def __init__(self, gains, index, own, nv):
        """gains: a Smoother's last Gains; index (T, blocks): the rows of its blocks, own (T,
        blocks): which of them are taken from a block."""
        self.index, self.own, self.nv = index, own, nv
        onward = gains.transition @ gains.keep  # (T, blocks, n, n), of errors
        self.onward = np.float32(onward)
        self.precision = np.float32(gains.precision)  # (T, blocks, 2 nv, 2 nv)
        self.variance = np.float32(gains.variance[..., 2 * nv :, :])  # (T, blocks, nv, n)

    def __call__(self, change):
        """Force (rows, nv, k) that is located more, where in every row the motion changes by change
        (rows, 2 nv, k) more until the next one, of which the model knows nothing."""
        (T, blocks, _, n), m = self.onward.shape[:3] + self.onward.shape[-1:], 2 * self.nv
        error = np.zeros((T, blocks, n, change.shape[-1]), np.float32)
        for t in range(T - 1):
            error[t + 1] = self.onward[t] @ error[t]
            error[t + 1, :, :m] += change[self.index[t]]
        out = np.zeros((len(change), self.nv, change.shape[-1]))
        back = np.zeros_like(error[0])
        for t in range(T - 1, -1, -1):
            back = self.onward[t].transpose(0, 2, 1) @ back
            back[:, :m] += self.precision[t] @ error[t, :, :m]
            own = self.own[t]
            located = self.variance[t] @ back - error[t, :, m:]
            out[self.index[t, own]] = located[own]
        return out
