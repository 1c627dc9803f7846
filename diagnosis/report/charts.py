"""Charts as inline SVG: they follow the page's light or dark colours, stay sharp on any screen, and need nothing else.

    chart([Series(x, y, "nominal")], "time (s)", "elbow (rad)")

Colours come from the page's style sheet through the class of a series: measured, nominal, corrected, noise, bad.
"""

import html
import math
from dataclasses import dataclass

import numpy as np

from diagnosis.report import text as wording

FAR = 1e4  # of an axis from zero, over its length: its ticks count from its beginning then


@dataclass(frozen=True)
class Series:
    """x, y (n,): one curve; NaN breaks a line. kind: line, dots, or band (then y is (n, 2): low, high)."""

    x: np.ndarray
    y: np.ndarray
    look: str  # class in the style sheet
    kind: str = "line"


def ticks(low, high, count=5):
    """Round numbers that span [low, high], about `count` of them."""
    if not high > low:
        return [low]
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 2.5, 5, 10) if power * m >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low, high):
    """1, 2, 5 times powers of ten within [low, high]."""
    found = [
        m * 10.0**k
        for k in range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        for m in (1, 2, 5)
    ]
    inside = [t for t in found if low * 0.999 <= t <= high * 1.001]
    return (
        inside
        if len(inside) < 7
        else [t for t in inside if abs(math.log10(t) - round(math.log10(t))) < 1e-6]
    )


def thin(x, y, most=700):
    """Fewer points of a curve that look the same: the extremes of every stretch, in order, with gaps (NaN) kept."""
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


def chart(series, x_label, y_label, width=380, height=230, log_y=False, zero=False, label=""):
    """An SVG chart. label: what a screen reader says. zero: include y = 0. Returns "" where nothing is finite."""
    series = [s for s in series if len(s.x) and np.isfinite(s.y).any()]
    if not series:
        return ""
    xs = np.concatenate([np.asarray(s.x, float)[np.isfinite(s.x)] for s in series])
    ys = np.concatenate([np.asarray(s.y, float)[np.isfinite(s.y)].ravel() for s in series])
    if log_y:
        ys = ys[ys > 0]
    x0, x1 = xs.min(), xs.max()
    y0, y1 = (min(ys.min(), 0) if zero and not log_y else ys.min()), ys.max()
    x0, x1 = (x0, x1) if x1 > x0 else (x0 - 0.5, x0 + 0.5)
    if log_y:
        y0, y1 = y0 / 1.25, y1 * 1.25
    else:
        pad = 0.06 * (y1 - y0) or abs(y0) * 0.1 or 1.0
        y0, y1 = (y0 if zero and y0 == 0 else y0 - pad), y1 + pad
    left, right, top, bottom = 52, 10, 10, 40
    shift = float(math.floor(x0)) if abs(x0) > FAR * (x1 - x0) else 0.0
    x_label += f", from {shift:.15g} on" if shift else ""

    def px(x):
        return left + (np.asarray(x, float) - x0) / (x1 - x0) * (width - left - right)

    def py(y):
        y = np.asarray(y, float)
        share = np.log(np.maximum(y, y0) / y0) / np.log(y1 / y0) if log_y else (y - y0) / (y1 - y0)
        return height - bottom - share * (height - top - bottom)

    parts = [
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{html.escape(label, quote=True)}" class="chart">'
    ]
    for t in log_ticks(y0, y1) if log_y else ticks(y0, y1, 4):
        y = float(py(t))
        parts.append(
            f'<path class="grid" d="M{left} {y:.1f}H{width - right}"/>'
            f'<text class="tick" x="{left - 5}" y="{y + 3.5:.1f}" text-anchor="end">{_tick(t)}</text>'
        )
    for t in ticks(x0, x1, 5 if width < 500 else 9):
        x = float(px(t))
        parts.append(
            f'<path class="grid" d="M{x:.1f} {top}V{height - bottom}"/>'
            f'<text class="tick" x="{x:.1f}" y="{height - bottom + 14}" text-anchor="middle">{_tick(t - shift)}</text>'
        )
    for s in series:
        x, y = np.asarray(s.x, float), np.asarray(s.y, float)
        if s.kind == "band":
            edge = [f"{a:.1f} {b:.1f}" for a, b in zip(px(x), py(y[:, 1]))] + [
                f"{a:.1f} {b:.1f}" for a, b in zip(px(x)[::-1], py(y[::-1, 0]))
            ]
            parts.append(f'<path class="{s.look} band" d="M{"L".join(edge)}Z"/>')
        elif s.kind == "dots":
            stride = max(1, len(x) // 600)
            d = "".join(
                f"M{a:.1f} {b:.1f}h0"
                for a, b in zip(px(x[::stride]), py(y[::stride]))
                if math.isfinite(a + b)
            )
            parts.append(f'<path class="{s.look} dots" d="{d}"/>')
        else:
            x, y = thin(x, y)
            d, pen = [], "M"
            for a, b in zip(px(x), py(y)):
                if math.isfinite(a) and math.isfinite(b):
                    d.append(f"{pen}{a:.1f} {b:.1f}")
                    pen = "L"
                else:
                    pen = "M"
            parts.append(f'<path class="{s.look} line" d="{"".join(d)}"/>')
    middle = (top + height - bottom) / 2
    parts.append(
        f'<text class="axis" x="{(left + width - right) / 2}" y="{height - 8}" text-anchor="middle">'
        f'{html.escape(x_label)}</text><text class="axis" x="12" y="{middle}" text-anchor="middle" '
        f'transform="rotate(-90 12 {middle})">{html.escape(y_label)}</text></svg>'
    )
    return "".join(parts)


def _tick(value):
    if value == 0 or abs(value) < 1e-12:
        return "0"
    if not 1e-3 <= abs(value) < 1e5:
        return f"{value:.2g}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:.6g}".replace("-", "−")


def binned(x, y, bins=24):
    """Median of y in equally filled bins of x: (centres, medians), the shape that scattered points hide."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y = np.asarray(x)[good], np.asarray(y)[good]
    if len(x) < 2 * bins:
        return x[:0], y[:0]
    order = np.argsort(x, kind="stable")
    groups = np.array_split(order, bins)
    return np.array([np.median(x[g]) for g in groups]), np.array([np.median(y[g]) for g in groups])


def whisker(parameter, width=220, height=34):
    """A parameter's estimate and 95 % interval beside its nominal value, as a small SVG."""
    value, low, high, nominal = (parameter.get(key) for key in ("value", "low", "high", "nominal"))
    marks = [m for m in (value, low, high, nominal) if m is not None and math.isfinite(m)]
    if not marks or value is None:
        return ""
    a, b = min(marks), max(marks)
    pad = 0.08 * (b - a) or abs(a) * 0.1 or 1.0
    a, b = a - pad, b + pad

    def px(x):
        return 6 + (x - a) / (b - a) * (width - 12)

    parts = [
        f'<svg viewBox="0 0 {width} {height}" class="whisker" role="img" aria-label="nominal {wording.number(nominal)}, '
        f'estimate {wording.number(value)}"><path class="grid" d="M6 12H{width - 6}"/>'
    ]
    if nominal in marks:
        x = min(max(px(nominal), 24), width - 24)
        parts.append(
            f'<path class="nominal tickmark" d="M{px(nominal):.1f} 5V19"/>'
            f'<text class="tick" x="{x:.1f}" y="31" text-anchor="middle">{wording.number(nominal)}</text>'
        )
    if low is not None and high is not None:
        parts.append(f'<path class="corrected whisk" d="M{px(low):.1f} 12H{px(high):.1f}"/>')
    parts.append(f'<circle class="corrected point" cx="{px(value):.1f}" cy="12" r="4.5"/></svg>')
    return "".join(parts)
