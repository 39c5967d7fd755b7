"""uv is told what pip is told: a mirror, an index of CPU builds or a folder of wheels counts for both."""

from __future__ import annotations

import importlib.util
from pathlib import Path

FILE = Path(__file__).resolve().parents[2] / "ci" / "uv_settings.py"
SPEC = importlib.util.spec_from_file_location("uv_settings", FILE)
assert SPEC is not None and SPEC.loader is not None
uv_settings = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(uv_settings)


def test_each_setting_has_its_variable() -> None:
    told = [
        "global.index-url='https://mirror.example/simple'",
        "global.extra-index-url='https://cpu.example/whl https://other.example/simple'",
        "global.find-links='/wheels /more'",
        "global.constraint='/etc/pins.txt'",
        "global.cert='/etc/ca.pem'",
    ]
    assert uv_settings.settings(told) == {
        "UV_DEFAULT_INDEX": "https://mirror.example/simple",
        "UV_INDEX": "https://cpu.example/whl https://other.example/simple",
        "UV_FIND_LINKS": "/wheels,/more",
        "UV_CONSTRAINT": "/etc/pins.txt",
        "SSL_CERT_FILE": "/etc/ca.pem",
        "UV_INDEX_STRATEGY": "unsafe-best-match",
    }


def test_the_environment_comes_before_files() -> None:
    told = [":env:.find-links='/from/environment'", "global.find-links='/from/file'"]
    assert uv_settings.settings(told) == {"UV_FIND_LINKS": "/from/environment"}


def test_lines_over_several_rows_are_joined_and_others_are_left() -> None:
    told = ["global.find-links='\\n/a\\n/b'", "global.no-cache-dir='true'", "", "nonsense"]
    assert uv_settings.settings(told) == {"UV_FIND_LINKS": "/a,/b"}
