"""Carries what the pages link to outside docs/ (pictures, tables, source) into the site.

A hook of mkdocs: a link to ../results/trpo.csv becomes one to source/results/trpo.csv.
"""

import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent
OUTSIDE = re.compile(r"\]\(\.\./([^)#\s]+)")


def on_files(files, config):
    """Add every file outside docs/ that a page links to."""
    linked = set()
    for page in files.documentation_pages():
        linked.update(OUTSIDE.findall(Path(page.abs_src_path).read_text(encoding="utf-8")))
    for name in sorted(linked):
        if (ROOT / name).is_file():
            source = str(ROOT / name)
            files.append(File.generated(config, f"source/{name}", abs_src_path=source))
    return files


def on_page_markdown(markdown, page, config, files):
    """Point the links at what was added."""
    return OUTSIDE.sub(r"](source/\1", markdown)
