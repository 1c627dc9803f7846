"""The page: well-formed, self-contained, complete, and sound in a real browser."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from report_example import finding

from diagnosis.report import sections

BROWSER = next(
    (
        path
        for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))
        if path
    ),
    None,
)


class Tags(HTMLParser):
    """Checks that tags close in order, and gathers addresses."""

    def __init__(self):
        super().__init__()
        self.open, self.addresses = [], []

    def handle_starttag(self, tag, attrs):
        self.addresses += [
            value for key, value in attrs if key in ("src", "href", "action", "data")
        ]
        if tag not in ("meta", "link", "br", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.mark.parametrize("kind", ["diagnosis", "matched"])
def test_page_is_well_formed_and_self_contained(kind, request):
    page = sections.html_page(request.getfixturevalue(kind))
    tags = Tags()
    tags.feed(page)
    assert tags.open == [] and set(tags.addresses) == {"data:,"}
    assert not re.search(r"https?://|url\(|@import", page)
    assert len(page) < 2_000_000 and "nan" not in re.findall(r'd="([^"]*)"', page)
    assert "<stays>" not in page


def test_a_force_to_which_nothing_was_fitted(diagnosis):
    bare = finding("unknown", "joint", "elbow", 0, 0, 1, "", parameters=[], written_as="none")
    bare |= {"evidence": {"held_out_error_removed": 0.0, "p_value": None}, "adequate": False}
    diagnosis.summary["findings"], diagnosis.settings = [bare], {}
    page = sections.html_page(diagnosis)
    assert '<p class="facts">nothing was fitted, so nothing is written</p>' in page


def test_a_clock_that_counts_from_1970(diagnosis):
    [held] = diagnosis.held_out
    diagnosis.held_out = [replace(held, time=held.time - held.time[0] + 1.7e9, start=100)]
    page, begin = sections.html_page(diagnosis), diagnosis.held_out[0].time[100]
    assert f"{held.name} from {begin:.2f} s on" in page
    told = re.search(rf"{re.escape(held.name)} from (\S+) s: from the recorded state", page)
    assert 1.7e9 < float(told[1]) < 1.7e9 + 3


def test_page_says_it_all(diagnosis):
    page = sections.html_page(diagnosis)
    for words in (
        "joint elbow: Coulomb friction 0.120 ± 0.004 N·m was left out",
        "dead zone",
        "push the joint by hand with the actuator off",
        "has no plain MJCF form",
        "unexplained",
        "&lt;stays&gt;",
        "run5.csv",
        "error (× noise)",
        "force (N·m)",
        "a force that the catalogue has no name for",
        "force left at elbow (N·m)",
        "badmark",
        "gyro &lt;1&gt;",
        "3 of 40 windows blow up under the nominal model: from then on they are left out of its ",
    ):
        assert words in page, words


def test_what_was_found_is_among_the_candidates_whatever_its_rank(diagnosis):
    found, other = diagnosis.ranking
    weak = [
        {
            **other,
            "effect": "gain",
            "place": {"kind": "actuator", "name": f"motor{k}"},
            "error_removed": 0.7,
        }
        for k in range(20)
    ]
    diagnosis.ranking = [*weak, found]
    page = sections.html_page(diagnosis).partition("Candidates")[2]
    assert "motor14" in page and "motor15" not in page and "Coulomb friction<small>" in page


def test_page_of_a_match_claims_nothing(matched):
    page = sections.html_page(matched)
    assert (
        "Nothing is missing" in page
        and "What is wrong" not in page
        and 'class="badmark"' not in page
    )


PROBE = """<script>
const problems = [];
addEventListener("error", e => problems.push(String(e.message)), true);
addEventListener("unhandledrejection", e => problems.push(String(e.reason)));
const measure = () => {
  const all = [...document.querySelectorAll("main *")].filter(e => !e.closest(".scroll"));
  const wide = all.filter(e => e.getBoundingClientRect().right > innerWidth + 1);
  const names = performance.getEntriesByType("resource").map(r => r.name);
  const layers = [...document.querySelectorAll(".layer")];
  const result = {
    width: innerWidth,
    page: document.documentElement.scrollWidth,
    wide: wide.map(e => e.tagName + "." + e.className),
    fetched: names.filter(n => !n.startsWith("data:")),
    problems,
    charts: document.querySelectorAll("svg").length,
    layers: layers.map(e => e.getAttribute("d").length),
  };
  parent.postMessage("PROBE" + JSON.stringify(result) + "END", "*");
};
addEventListener("load", () => setTimeout(measure, 300));
</script>"""
# no window is as narrow as a phone, so the page stands in a frame
PHONE = """<!DOCTYPE html><body style="margin:0"><p></p>
<iframe src="page.html" width="390" height="844" style="border:0"></iframe>
<script>
addEventListener("message", e => { document.querySelector("p").textContent = e.data; });
</script>"""


@pytest.mark.skipif(BROWSER is None, reason="no browser")
@pytest.mark.parametrize("kind", ["diagnosis", "matched"])
def test_page_in_a_browser_on_a_phone(kind, request, tmp_path):
    page = sections.html_page(request.getfixturevalue(kind))
    (tmp_path / "page.html").write_text(
        page.replace("<style>", PROBE + "<style>", 1), encoding="utf-8"
    )
    (tmp_path / "phone.html").write_text(PHONE)
    done = subprocess.run(
        [
            BROWSER,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--enable-logging=stderr",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--window-size=800,900",
            "--virtual-time-budget=3000",
            "--dump-dom",
            f"file://{tmp_path / 'phone.html'}",
        ],
        capture_output=True,
        text=True,
        timeout=60,
    )
    found = re.search(r"PROBE(\{.*\})END", done.stdout)
    assert found, done.stderr[-2000:]
    result = json.loads(
        found.group(1).replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    )
    assert "CONSOLE" not in done.stderr, [
        line for line in done.stderr.splitlines() if "CONSOLE" in line
    ]
    assert result["problems"] == [] and result["fetched"] == []
    assert result["page"] <= result["width"] and result["wide"] == [], result
    assert result["width"] == 390 and result["charts"] > 4 and all(result["layers"]), result
