"""From values to markup: the templates beside this file, their style sheet and their script.

    html = render("page.html", title="Diagnosis", sections=[...])

Everything is escaped unless it is Markup, which is what `render` returns. Style and script are
inlined: the page fetches nothing.
"""

from collections.abc import Iterable
from functools import cache

from markupsafe import Markup

from diagnosis.common import pages
from diagnosis.report import text


@cache
def _environment():
    environment = pages.environment("diagnosis.report")
    environment.filters |= {
        "number": text.number,
        "sentence": text.sentence,
        "effect": text.effect_words,
        "place": text.place_words,
        "finding": text.finding_words,
        "p_value": text.p_value,
        "pixels": lambda value: f"{value:.1f}",
        "path": path,
    }
    inlined = {"style": "style.css", "script": "page.js"}
    for key, name in inlined.items():
        environment.globals[key] = pages.inlined("diagnosis.report", name)
    return environment


def render(template: str, **values) -> Markup:
    """A template of `templates/` filled in, as Markup."""
    return Markup(_environment().get_template(template).render(**values))


def path(points: Iterable, closed: bool = False, digits: int = 1) -> str:
    """(n, 2) pixels as the `d` of an SVG path. Rows that are not finite break the line."""
    parts, pen = [], "M"
    for x, y in points:
        if x - x == 0 and y - y == 0:  # finite, both
            parts.append(f"{pen}{x:.{digits}f} {y:.{digits}f}")
            pen = "L"
        else:
            pen = "M"
    return "".join(parts) + ("Z" if closed and parts else "")
