"""Pages that fetch nothing: templates that share one frame, one style and one table.

    pages = environment("diagnosis.report")  # its templates, and those beside this file
    html = pages.get_template("page.html").render(style=inlined("diagnosis.report", "style.css"))

A page extends frame.html, which puts frame.css before the page's own style.
"""

from importlib.resources import files

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup


def environment(package: str) -> Environment:
    """Templates of a package, then the shared ones. Everything is escaped unless it is Markup."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("diagnosis.common")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def inlined(package: str, name: str) -> Markup:
    """A style sheet or script of a package, to stand in a page."""
    return Markup((files(package) / name).read_text(encoding="utf-8"))
