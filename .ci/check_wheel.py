"""Build the wheel and check what it holds: one package, with its templates, style, script and
schema.

python .ci/check_wheel.py
"""

import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DATA = {".css", ".js", ".html", ".json", ".svg"}


def main():
    """Ends with status 1 and a line for each fault."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "source"  # a build leaves folders behind that the next would pack
        for name in ("diagnosis", "training", "tests", "benchmarks"):
            shutil.copytree(ROOT / name, copy / name)
        for path in ROOT.iterdir():
            if path.is_file() and path.name != ".git":
                shutil.copy(path, copy)
        pip = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, str(copy)]
        subprocess.run(pip, check=True)
        (wheel,) = Path(folder).glob("*.whl")
        names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    source = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "diagnosis").rglob("*")
        if path.suffix in DATA | {".py"} and "__pycache__" not in path.parts
    }
    faults = [f"{top}: not ours to install" for top in sorted(tops - {"diagnosis"})]
    faults += [f"{name}: missing from the wheel" for name in sorted(source - set(names))]
    faults += [] if any("/licenses/LICENSE" in n for n in names) else ["no LICENSE in the wheel"]
    faults += [f"{n}: not in the source" for n in names if n.endswith(".py") and n not in source]
    print("\n".join(faults) or f"{wheel.name}: {len(names)} files, one package")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
