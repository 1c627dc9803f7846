"""README and docs: links lead somewhere, tables say what made them, sentences are short."""

import ast
import re
from pathlib import Path

import pytest

from diagnosis.trials.page import parse, rates
from diagnosis.trials.table import read_rows

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "results/README.md"]
PAGES += sorted((ROOT / "docs").glob("*.md"))
WORDS = 25  # of a sentence
SHORT = [ROOT / name for name in ("README.md", "CONTRIBUTING.md")]
SHORT += [ROOT / "docs" / f"{name}.md" for name in ("index", "diagnosis-json", "limits")]
SHORT += [ROOT / "docs" / f"{name}.md" for name in ("recordings", "paper", "results", "validation")]
LINK = re.compile(r"(?:\]\(|<img src=\")([^)\"\s]+)")


def prose(page):
    """The text of a page without fenced blocks, where brackets mean something else."""
    return re.sub(r"(?ms)^```.*?^```", "", page.read_text(encoding="utf-8"))


def anchors(page):
    """The fragments that a page's headings answer to: lower case, words joined by hyphens."""
    heads = re.findall(r"(?m)^#+ (.+)$", prose(page))
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def broken(page):
    """Relative links of a page that lead nowhere."""
    found = []
    for link in LINK.findall(prose(page)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, fragment = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (fragment and fragment not in anchors(target)):
            found.append(link)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_relative_links_lead_somewhere(page):
    assert broken(page) == []


def test_a_broken_link_is_seen(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# One two\n[a](gone.md) [b](#one-two) [c](#three) [d](https://e.org/f)\n")
    assert broken(page) == ["gone.md", "#three"]


def test_every_page_is_in_the_navigation():
    listed = re.findall(r"(?m)^  - .+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text())
    assert sorted(listed) == sorted(page.name for page in (ROOT / "docs").glob("*.md"))


def test_the_readme_is_short_and_has_its_test_command():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    marker = lines.index("<!-- test -->")
    assert lines[marker + 1] == "```bash" and "pytest" in lines[marker + 2]


SEALED = {
    "something hidden: all right, by strict rules": "strict success, something hidden",
    "one effect above three times the noise: named": "one effect > 3 × noise: named, "
    "or in a class of ≤ 3",
    "nothing hidden: a false claim": "nothing hidden: a false claim",
    "any trial: a false claim": "any trial: a false claim",
    "any trial: a prediction worse than the nominal model's": "held-out error above the nominal "
    "model's",
}  # what the README says, and what a table is asked


def test_the_readmes_sealed_numbers_are_those_of_the_table_that_it_links():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table, commit = re.search(r"\[(proof_\w+\.csv)\]\(results/\S+, (\w+) \|", text).groups()
    rows = read_rows(ROOT / "results" / table)
    assert {row["version"][:7] for row in rows} == {commit}
    asked = {what: rate for _, what, rate in rates([parse(row) for row in rows])}
    lines = re.findall(r"(?m)^\| sealed, (.+?) \| (\d+) of (\d+) \| (\d+)–(\d+) % \|", text)
    assert [what for what, *_ in lines] == list(SEALED)
    for what, *told in lines:
        rate = asked[SEALED[what]]
        percent = [round(100 * end) for end in rate.interval]
        assert [int(n) for n in told] == [rate.hits, rate.trials, *percent], what


def test_every_table_says_what_made_it():
    """results/README.md lists each table, and the scripts it names are there."""
    index = (ROOT / "results/README.md").read_text(encoding="utf-8")
    tables = {path.name for path in (ROOT / "results").glob("*.csv")}
    assert {name for name in tables if f"`{name}`" not in index} == set(), (
        "list it, with its command"
    )
    scripts = set(re.findall(r"`python (\S+\.py)", index))
    assert {name for name in scripts if not (ROOT / name).exists()} == set()


ROOMS = "train|rgat|trpo|models|envs|training|diagnosis"
NAME = re.compile(rf"`((?:{ROOMS})(?:\.\w+)+)(?<!\.py)(?<!\.csv)(?<!\.json)`")
PATH = re.compile(r"`((?:tests|docs|results|benchmarks|training|diagnosis)/[\w/.-]*)`")

OLD = {"benchmarks/grounding.py"}  # of commits that docs/results.md names


def is_there(name):
    """Does a dotted name lead to a module, or to what one defines?"""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:k])
        file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        if file.is_file():
            return defined(ast.parse(file.read_text(encoding="utf-8")), parts[k:])
    return False


def defined(tree, names):
    """Does a module define names[0], and that in turn what follows?"""
    if not names:
        return True
    for node in getattr(tree, "body", ()):
        if isinstance(node, ast.Assign | ast.AnnAssign):
            told = {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
        else:
            told = {getattr(node, "name", None)}
        if names[0] in told:
            return defined(node, names[1:])
    return False


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_names_is_in_the_code(page):
    text = page.read_text(encoding="utf-8")
    assert [name for name in NAME.findall(text) if not is_there(name)] == []
    paths = set(PATH.findall(text)) - OLD
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_a_name_that_is_gone_is_seen():
    assert is_there("trpo.TRPO.learn") and is_there("rgat.AT_CONFIG") and is_there("diagnosis")
    assert not is_there("trpo.TRPO.unlearn") and not is_there("rgat.Gone") and not is_there("gone")


def sentences(text):
    """Sentences of Markdown prose: no code, no tables' frames, links as their words."""
    text = re.sub(r"(?m)^ {4}.*$|<!--.*?-->", "", text)
    text = re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]*`", "X", text))
    for block in re.split(r"\n\s*\n|\n(?=[-*|#]|\d+\. )", text):
        for cell in block.split("|") if block.startswith("|") else [block]:
            yield from filter(None, re.split(r"(?<=[.!?:;])\s+", " ".join(cell.split())))


@pytest.mark.parametrize("page", SHORT, ids=lambda page: page.name)
def test_sentences_are_short(page):
    assert [s for s in sentences(prose(page)) if len(s.split()) > WORDS] == []


def test_a_long_sentence_is_seen():
    long = "word " * 26
    found = [len(s.split()) for s in sentences(f"Short. {long}end.\n\n    {long}")]
    assert found == [1, 27]
