"""Charts: round ticks, readable times, curves that keep their shape when thinned."""

import re

import numpy as np
import pytest

from diagnosis.report import charts

EPOCH = 1.7e9  # s, of a clock that counts from 1970


@pytest.mark.parametrize("low, high", [(0, 1), (-3.2, 7.9), (1e-6, 3e-6), (-1e5, 2e5)])
def test_ticks_are_round_and_inside(low, high):
    found = charts.ticks(low, high)
    assert 3 <= len(found) <= 11 and all(
        low - 1e-9 * abs(low) <= t <= high + 1e-9 * abs(high) for t in found
    )
    assert len({round(b - a, 12) for a, b in zip(found, found[1:])}) == 1 or low == 1e-6


def test_times_since_1970_can_be_read_from_an_axis():
    time = EPOCH + np.linspace(0.5, 8, 50)
    chart = charts.chart([charts.Series(time, np.sin(time), "measured")], "time (s)", "force")
    assert "time (s), from 1700000000 on" in chart and re.findall(
        r'text-anchor="middle">([\d.]+)<', chart
    ) == ["2", "4", "6", "8"]
    assert "from" not in charts.chart(
        [charts.Series(time - EPOCH, np.sin(time), "measured")], "time (s)", "force"
    )


def test_thinned_curves_keep_extremes_and_gaps():
    x = np.linspace(0, 1, 20000)
    y = np.sin(40 * x)
    y[5000], y[12000:12010] = 9.0, np.nan
    a, b = charts.thin(x, y)
    assert (
        len(a) < 1600
        and np.nanmax(b) == 9.0
        and np.nanmin(b) == np.nanmin(y)
        and np.isnan(b).any()
        and (np.diff(a) > 0).all()
    )
