"""Charts as inline SVG: they follow the page's light or dark colours, stay sharp on any screen, and
need nothing else.

    chart([Series(x, y, "nominal")], "time (s)", "elbow (rad)")

Colours come from style.css through the class of a series: measured, nominal, corrected, missing,
noise. The markup is templates/chart.svg.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.report.page import path, render

FAR = 1e4  # of an axis from zero, over its length: its ticks count from its beginning then
DOTS = 600  # points that are drawn of a cloud


@dataclass(frozen=True)
class Series:
    """x, y (n,): one curve; NaN breaks a line. kind: line, dots, or band (then y is (n, 2): low,
    high). look: class in the style sheet."""

    x: np.ndarray
    y: np.ndarray
    look: str
    kind: str = "line"


@dataclass(frozen=True)
class Frame:
    """The axes of a chart: the data's box (x0, x1, y0, y1) in the pixels that margins leave."""

    box: tuple
    width: int
    height: int
    log_y: bool
    left: int = 52
    top: int = 10

    @property
    def right(self) -> int:
        """Pixel of the right end."""
        return self.width - 10

    @property
    def bottom(self) -> int:
        """Pixel of the lower end."""
        return self.height - 40

    @property
    def origin(self) -> float:
        """What is taken off the words at x ticks: 0, unless the axis lies far from it."""
        x0, x1 = self.box[:2]
        return float(math.floor(x0)) if abs(x0) > FAR * (x1 - x0) else 0.0

    def px(self, x) -> np.ndarray:
        """Data to horizontal pixels."""
        x0, x1 = self.box[:2]
        return self.left + (np.asarray(x, float) - x0) / (x1 - x0) * (self.right - self.left)

    def py(self, y) -> np.ndarray:
        """Data to vertical pixels."""
        y, (y0, y1) = np.asarray(y, float), self.box[2:]
        if self.log_y:
            share = np.log(np.maximum(y, y0) / y0) / np.log(y1 / y0)
        else:
            share = (y - y0) / (y1 - y0)
        return self.bottom - share * (self.bottom - self.top)

    @property
    def x_ticks(self) -> list[tuple[float, str]]:
        """[(pixel, words)]."""
        marks = ticks(*self.box[:2], 5 if self.width < 500 else 9)
        return [(float(self.px(t)), _tick(t - self.origin)) for t in marks]

    @property
    def y_ticks(self) -> list[tuple[float, str, bool]]:
        """[(pixel, words, whether it is zero)]."""
        low, high = self.box[2:]
        marks = log_ticks(low, high) if self.log_y else ticks(low, high, 4)
        return [(float(self.py(t)), _tick(t), abs(t) < 1e-12) for t in marks]


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers that span [low, high], about `count` of them."""
    if not high > low:
        return [low]
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 2.5, 5, 10) if power * m >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2, 5 times powers of ten within [low, high]; powers alone where those are many."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    found = [m * 10.0**k for k in powers for m in (1, 2, 5)]
    inside = [t for t in found if low * 0.999 <= t <= high * 1.001]
    if len(inside) < 7:
        return inside
    return [t for t in inside if abs(math.log10(t) - round(math.log10(t))) < 1e-6]


def thin(x: np.ndarray, y: np.ndarray, most: int = 700) -> tuple[np.ndarray, np.ndarray]:
    """Fewer points of a curve that look the same: the extremes of every stretch, in order, with
    gaps (NaN) kept."""
    if len(x) <= most:
        return x, y
    edges = np.linspace(0, len(x), most // 2 + 1).astype(int)
    keep = set()
    for a, b in zip(edges[:-1], edges[1:]):
        part = y[a:b]
        if np.isnan(part).all():
            keep.add(a)
        else:
            keep.update((a + int(np.nanargmin(part)), a + int(np.nanargmax(part))))
            keep.update((a + np.flatnonzero(np.isnan(part))[:1]).tolist())
    order = np.array(sorted(keep))
    return x[order], y[order]


def chart(
    series: list[Series],
    x_label: str,
    y_label: str,
    width: int = 380,
    height: int = 230,
    log_y: bool = False,
    zero: bool = False,
    label: str = "",
) -> str:
    """An SVG chart as Markup. label: what a screen reader says. zero: include y = 0. "" where
    nothing is finite."""
    series = [s for s in series if len(s.x) and np.isfinite(s.y).any()]
    if not series:
        return ""
    frame = Frame(_box(series, log_y, zero), width, height, log_y)
    if frame.origin:
        x_label += f", from {frame.origin:.15g} on"
    paths = [(s.look, s.kind, _drawn(s, frame)) for s in series]
    return render(
        "chart.svg", frame=frame, paths=paths, x_label=x_label, y_label=y_label, label=label
    )


def _box(series, log_y, zero):
    """(x0, x1, y0, y1) that holds every series, with some air."""
    xs = np.concatenate([np.asarray(s.x, float)[np.isfinite(s.x)] for s in series])
    ys = np.concatenate([np.asarray(s.y, float)[np.isfinite(s.y)].ravel() for s in series])
    if log_y:
        ys = ys[ys > 0]
    x0, x1, y0, y1 = xs.min(), xs.max(), ys.min(), ys.max()
    if not x1 > x0:
        x0, x1 = x0 - 0.5, x0 + 0.5
    if log_y:
        return x0, x1, y0 / 1.25, y1 * 1.25
    y0 = min(y0, 0) if zero else y0
    pad = 0.06 * (y1 - y0) or abs(y0) * 0.1 or 1.0
    return x0, x1, (y0 if zero and y0 == 0 else y0 - pad), y1 + pad


def _drawn(series, frame):
    """The `d` of a series' path."""
    x, y = np.asarray(series.x, float), np.asarray(series.y, float)
    if series.kind == "band":
        sound = np.isfinite(x) & np.isfinite(y).all(axis=1)
        gaps = np.flatnonzero(np.diff(sound.astype(int))) + 1
        runs = [run for run in np.split(np.arange(len(x)), gaps) if len(run) and sound[run[0]]]
        return "".join(_band(frame.px(x[run]), frame.py(y[run])) for run in runs)
    if series.kind == "dots":
        stride = max(1, len(x) // DOTS)
        points = zip(frame.px(x[::stride]), frame.py(y[::stride]))
        return "".join(f"M{a:.1f} {b:.1f}h0" for a, b in points if math.isfinite(a + b))
    x, y = thin(x, y)
    return path(zip(frame.px(x), frame.py(y)))


def _band(x, y):
    """A closed path along the upper edge y[:, 1] and back along the lower."""
    upper, lower = zip(x, y[:, 1]), zip(x[::-1], y[::-1, 0])
    return path([*upper, *lower], closed=True)


def _tick(value):
    if value == 0 or abs(value) < 1e-12:
        return "0"
    if not 1e-3 <= abs(value) < 1e5:
        return f"{value:.2g}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:.6g}".replace("-", "−")


def binned(x: np.ndarray, y: np.ndarray, bins: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Median of y in equally filled bins of x: (centres, medians), the shape that scattered points
    hide. Empty where there are fewer than two points for each bin."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y = np.asarray(x)[good], np.asarray(y)[good]
    if len(x) < 2 * bins:
        return x[:0], y[:0]
    groups = np.array_split(np.argsort(x, kind="stable"), bins)
    return tuple(np.array([np.median(values[g]) for g in groups]) for values in (x, y))


def whisker(parameter: dict, span: Sequence[float] = (), width: int = 220, height: int = 34) -> str:
    """A parameter's estimate and 95 % interval beside its nominal value, as a small SVG. span:
    further values for which the axis has room, where several are compared."""
    value, low, high, nominal = (parameter.get(key) for key in ("value", "low", "high", "nominal"))
    marks = [m for m in (value, low, high, nominal) if m is not None and math.isfinite(m)]
    if not marks or value is None:
        return ""
    a, b = min([*marks, *span]), max([*marks, *span])
    pad = 0.08 * (b - a) or abs(a) * 0.1 or 1.0

    def px(x):
        return 6 + (x - a + pad) / (b - a + 2 * pad) * (width - 12)

    at_nominal = px(nominal) if nominal in marks else None
    return render(
        "whisker.svg",
        width=width,
        height=height,
        nominal=nominal,
        value=value,
        at_nominal=at_nominal,
        at_words=None if at_nominal is None else min(max(at_nominal, 24), width - 24),
        bounds=None if low is None or high is None else (px(low), px(high)),
        at_value=px(value),
    )
