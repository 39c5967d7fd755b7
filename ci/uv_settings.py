"""What pip is told on this machine (indexes, wheels on disk, constraints, certificates), as uv's environment variables.

    eval "$(python ci/uv_settings.py < <(python -m pip config list))"

uv reads none of pip's settings. A mirror, an index of CPU builds of torch or a folder of wheels must count for both.
"""

from __future__ import annotations

import ast
import re
import shlex
import sys
from collections.abc import Iterable

NAMES = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "constraint": "UV_CONSTRAINT",
    "cert": "SSL_CERT_FILE",
    "default-timeout": "UV_HTTP_TIMEOUT",
    "timeout": "UV_HTTP_TIMEOUT",
    "proxy": "ALL_PROXY",
    "trusted-host": "UV_INSECURE_HOST",
}
COMMAS = ("UV_FIND_LINKS",)  # uv parts the others at spaces


def settings(lines: Iterable[str]) -> dict[str, str]:
    """Variables for uv from the lines of `pip config list`; of a setting in several places the last counts, as for pip.

    Args:
        lines: such as `global.index-url='https://...'`; those of the environment begin with `:env:`.
    """
    found: dict[str, str] = {}
    for line in sorted(lines, key=lambda line: line.startswith(":env:")):
        told = re.match(r"(?:\S+?|:env:)\.([a-z-]+)=(.*)$", line.strip())
        if told is None or told[1] not in NAMES:
            continue
        try:
            values = str(ast.literal_eval(told[2])).split()
        except (ValueError, SyntaxError):  # pip's own form of a string; anything else is not for us
            continue
        name = NAMES[told[1]]
        if values:
            found[name] = ("," if name in COMMAS else " ").join(values)
    if "UV_INDEX" in found:
        found["UV_INDEX_STRATEGY"] = "unsafe-best-match"  # the newest that fits, from whichever index, as pip does
    return found


if __name__ == "__main__":
    for variable, value in settings(sys.stdin).items():
        print(f"export {variable}={shlex.quote(value)}")
