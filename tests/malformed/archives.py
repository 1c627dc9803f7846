"""Recordings as NPZ that must be refused."""

import pickle

import numpy as np
from arm import archive, whole

from malformed.case import CTRL, QPOS, QVEL, Exploit, zipped


def broken_archives(add):
    """NPZ files that are damaged or dangerous."""
    sound = archive(**whole(add.good))
    add.npz("NPZ with a pickle", "pickled", qpos=np.array([Exploit(), None], dtype=object))
    ragged = np.array([[0.0], [0.0, 1.0]], dtype=object)
    add.npz("NPZ with a ragged list", "pickled", ctrl=ragged)
    add.npz("a bare pickle", "NPZ", pickle.dumps(Exploit()))
    add.npz("NPZ rubbish", "NPZ", b"\x00\x01\x02" * 300)
    add.npz("NPZ cut off", "NPZ", sound[:-200])
    add.npz("NPZ empty", "empty", b"")
    add.npz("NPZ of nothing", "missing", archive())
    add.npz("NPZ with text", "time", zipped("time.npy", "not an array"))
    damaged = bytearray(sound)
    damaged[400:440] = bytes(40)
    add.npz("NPZ damaged", "NPZ", bytes(damaged))
    shape = b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999,), }"
    huge = b"\x93NUMPY\x01\x00\x76\x00" + shape.ljust(117) + b"\n"
    add.npz("NPZ that claims terabytes", "NPZ", zipped("time.npy", huge))


def other_archives(add):
    """NPZ files of other arrays than the model's."""
    good = add.good
    add.npz("NPZ without time", "'time' is missing", time=None)
    add.npz("NPZ without positions", "'qpos' is missing", qpos=None)
    add.npz("NPZ without control", "'ctrl' is missing", ctrl=None)
    add.npz("NPZ misspelt", "did you mean 'qvel'", qvels=good[:, QVEL])
    add.npz("NPZ positions too wide", "(400, 3)", qpos=good[:, 1:4])
    add.npz("NPZ velocity too narrow", "qvel", qvel=good[:, 3:4])
    add.npz("NPZ control one row short", "repeat the last row", ctrl=good[:-1, CTRL])
    add.npz("NPZ transposed", "transpose", qpos=good[:, QPOS].T)
    add.npz("NPZ times as a table", "'time'", time=good[:, :2])
    add.npz("NPZ of words", "real numbers", qpos=good[:, QPOS].astype(str))
    add.npz("NPZ complex", "real numbers", qpos=good[:, QPOS] + 1j)
    dates = np.array(["2024-01-01"] * len(good), dtype="datetime64[s]")
    add.npz("NPZ of dates", "real numbers", time=dates)
    seventh = np.arange(len(good))[:, None] == 7
    add.npz("NPZ control nan", "row 7", ctrl=np.where(seventh, np.nan, good[:, CTRL]))
    add.npz("NPZ unknown sensor", "sensor", **{"sensor:gyro": good[:, :3]})
