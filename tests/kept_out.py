"""Programs that refuse to import some packages: what must run where these are not there."""

from __future__ import annotations

from collections.abc import Sequence


def refusing(names: Sequence[str]) -> str:
    """The beginning of a program: whatever it or others import of these fails as if it were absent.

    Args:
        names: of packages.
    """
    return f"""
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {tuple(names)!r}:
            raise ModuleNotFoundError(f"kept out: {{name}}", name=name)

sys.meta_path.insert(0, Refuse())
"""
