"""What is handed over predicts better: every finding is kept only if the written files, in stock MuJoCo, need it.

handed = accepted(world, check, setting)            # Handed; check: a Check on kept-back recordings
handed.xml, handed.setting
"""

from dataclasses import dataclass

import numpy as np

from diagnosis.estimation import prediction_error
from diagnosis.estimation import windows as cut
from diagnosis.simulation import stock


@dataclass(frozen=True)
class Handed:
    """setting: what was kept; xml, python: the files' contents; model, step: compiled from them; nominal: the nominal
    model as MJCF holds it; written {Candidate: form}; without {Candidate: error of the files without it}."""

    setting: dict
    xml: str
    python: str
    model: object
    step: object
    nominal: object
    written: dict
    without: dict


class Check:
    """Windows of recordings, as the contract's error has them, with a smoothed trajectory for its floor."""

    def __init__(self, world, recordings, smoother, setting):
        self.world, self.recordings, self.smoother = world, recordings, smoother
        self.windows = prediction_error.consecutive(recordings, cut.HORIZON)
        self.noise = prediction_error.reporting_noise(smoother.position_noise)
        self.setting, self.trajectory, self.scatter = setting, None, 0.0

    def locate(self, setting):
        """Smooth the recordings under a setting, for the floor."""
        self.trajectory = self.smoother.locate(setting, passes=2)

    def gaps(self, model, step=None):
        """Measured less predicted of a stock model, (W, T - 1, nv), and what was measured."""
        qpos = stock.predicted(model, self.world.model, self.windows, step)
        return cut.gaps(self.world.model, self.windows, qpos)

    def rms(self, gaps):
        """(error over all channels in noises, {channel: SI})."""
        gap, known = gaps
        square, channels = gap**2, {}
        for name, dofs in cut.channels(self.world.model).items():
            if known[..., dofs].any():
                channels[name] = float(np.sqrt(square[..., dofs].sum() / known[..., dofs].sum()))
        return float(np.sqrt((square / self.noise**2).sum() / max(known.sum(), 1))), channels

    def error(self, model, step=None):
        """The contract's error of a stock model."""
        return self.rms(self.gaps(model, step))[0]


def written(world, setting):
    """(xml, python, model, step, forms) of a setting."""
    xml, forms = world.corrected_xml(setting)
    return xml, "", stock.compiled(xml), None, forms


def accepted(world, check, setting, log=lambda what: None):
    """The Handed of what of a setting earns its place on kept-back recordings: together better than the nominal
    model, and each finding better with than without."""
    nominal = stock.compiled(world.corrected_xml({})[0])
    before = check.error(nominal)
    while True:
        xml, python, model, step, forms = written(world, setting)
        after = check.error(model, step)
        without = {}
        for out in setting:
            rest = {c: v for c, v in setting.items() if c is not out}
            _, _, other, other_step, _ = written(world, rest)
            without[out] = check.error(other, other_step)
        held = [c for c in setting if forms[c] in ("mjcf", "python")]
        worst = min(held, key=lambda c: without[c], default=None)
        if worst is None or without[worst] > after and after < before:
            return Handed(setting, xml, python, model, step, nominal, forms, without)
        log(
            f"  not handed over: {worst}: {without[worst]:.4g} without, {after:.4g} with, {before:.4g} nominal"
        )
        setting = {c: v for c, v in setting.items() if c is not worst}
