"""MuJoCo's own warnings, kept off the terminal."""

import warnings
from contextlib import contextmanager

import mujoco


@contextmanager
def quiet():
    """No warnings on the terminal or in MUJOCO_LOG.TXT, from MuJoCo's compiler or from unstable
    simulations."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        mujoco.set_mju_user_warning(before)
