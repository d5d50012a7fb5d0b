"""Print the sizes of the project, and fail where one exceeds its limit by more than 5 %: growth is a decision.

    python tools/sizes.py            # compare with tools/sizes.json
    python tools/sizes.py --write    # make today's sizes the limits

Python, C++ and templates are counted in lines, documents in words.
"""

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIMITS = Path(__file__).with_suffix(".json")
PACKAGE = ROOT / "python" / "radarsdf"
SOURCES = {".py", ".cpp", ".hpp", ".html"}
TOLERANCE = 1.05


def lines(folder: Path, *, deep: bool = True) -> int:
    """Number of lines of the sources below a folder."""
    found = folder.rglob("*") if deep else folder.glob("*")
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in found if file.suffix in SOURCES)


def sizes() -> dict[str, int]:
    """Size of each part of the project."""
    subpackages = sorted(folder for folder in PACKAGE.iterdir() if (folder / "__init__.py").exists())
    found = {f"package: {folder.name}": lines(folder) for folder in subpackages}
    found["package: modules"] = lines(PACKAGE, deep=False)
    found["package"] = lines(PACKAGE)
    found["core"] = lines(ROOT / "csrc")
    found["tests"] = lines(ROOT / "tests")
    found["bench"] = lines(ROOT / "bench") + lines(ROOT / "scenes")
    documents = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "bench").rglob("*.md")]
    found["documents, words"] = sum(len(file.read_text(encoding="utf-8").split()) for file in documents)
    return found


def main() -> int:
    """Compare, or write the limits."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="make today's sizes the limits")
    found = sizes()
    if parser.parse_args().write:
        LIMITS.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
        return 0
    limits = json.loads(LIMITS.read_text(encoding="utf-8"))
    exceeded = [name for name, size in found.items() if size > TOLERANCE * limits.get(name, 0)]
    for name, size in found.items():
        print(f"{name:24} {size:7,} of {limits.get(name, 0):7,}{'  exceeded' if name in exceeded else ''}")
    return 1 if exceeded else 0


if __name__ == "__main__":
    sys.exit(main())
