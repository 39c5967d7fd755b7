"""Fails when a wheel does not hold exactly the modules and templates of the source tree, all under softtwin/.

python ci/check_wheel.py build/wheel/softtwin-0.1.0-py3-none-any.whl
"""

from __future__ import annotations

import sys
from pathlib import Path
from zipfile import ZipFile

FOLDERS = ("meshes", "reference", "surrogate", "registration", "app")
SUFFIXES = {".py", ".html", ".toml", ".vtu", ".json", ".safetensors", ".npz"}


def expected(root: Path) -> set[str]:
    """The paths that the wheel of a source tree must hold."""
    files = (path for folder in FOLDERS for path in (root / folder).rglob("*") if path.suffix in SUFFIXES)
    return {f"softtwin/{path.relative_to(root)}" for path in files}


def main(wheel: str) -> int:
    """Prints what differs; 1 when something does."""
    with ZipFile(wheel) as archive:
        found = {name for name in archive.namelist() if ".dist-info/" not in name}
    wanted = expected(Path(__file__).resolve().parent.parent)
    for name in sorted(wanted - found):
        print(f"error: {name} is missing in the wheel")
    for name in sorted(found - wanted):
        print(f"error: {name} is in the wheel and not in the source tree")
    print(f"wheel: {len(found)} files")
    return int(found != wanted)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
