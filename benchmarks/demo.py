"""The example of the README: the demo's recordings diagnosed, as a table and as a picture.

python benchmarks/demo.py  # results/demo.csv and, with a Chromium, docs/report.png
"""

import contextlib
import io
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from diagnosis import command, demo  # noqa: E402
from diagnosis.common.atomic_files import write_table, write_together, write_whole  # noqa: E402

COLUMNS = "effect place parameter nominal value low high unit hidden before after floor".split()
HIDDEN = {
    ("coulomb_friction", "elbow"): demo.HIDDEN["elbow friction"],
    ("mass", "forearm"): demo.HIDDEN["forearm mass"],
}
SIZE, PIXELS = (760, 856), 2  # of the picture, in the page's own pixels, and pixels for each
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def rows(summary):
    """A row for each parameter of each finding, with the held-out errors in multiples of the
    noise."""
    errors = {key: summary["fit"]["held_out"][key] for key in ("before", "after", "floor")}
    for finding in summary["findings"]:
        place = finding["place"]["name"]
        for parameter in finding["parameters"]:
            named = {"effect": finding["effect"], "place": place, "parameter": parameter["name"]}
            hidden = HIDDEN.get((finding["effect"], place), "")
            yield {**parameter, **named, **errors, "hidden": hidden}


def picture(page, out):
    """The top of a page as a headless browser shows it, in 256 colours."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        print("no Chromium here: the picture stays as it was", file=sys.stderr)
        return
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "page.png"
        options = [f"--window-size={SIZE[0]},{SIZE[1]}", f"--force-device-scale-factor={PIXELS}"]
        options += ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command = [browser, *options, f"--screenshot={shot}", f"file://{page}"]
        subprocess.run(command, check=True, capture_output=True)
        small = io.BytesIO()
        Image.open(shot).convert("RGB").quantize(256).save(small, "PNG", optimize=True)
    write_whole(out, small.getvalue())


def main():
    """Diagnose the demo, and write what came out."""
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        write_together({folder / name: text for name, text in demo.files().items()})
        runs = sorted(map(str, folder.glob("run*.csv")))
        argv = ["--model", str(folder / "arm.xml"), "--recordings", *runs]
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            status = command.main([*argv, "--out", str(folder / "report")])
        if status:
            sys.exit(status)
        print(said.getvalue().replace(f"{folder}/", ""), end="")
        summary = json.loads((folder / "report/diagnosis.json").read_text(encoding="utf-8"))
        table = [
            {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()}
            for row in rows(summary)
        ]
        write_table(ROOT / "results/demo.csv", COLUMNS, table)
        picture(folder / "report/report.html", ROOT / "docs/report.png")


if __name__ == "__main__":
    main()
