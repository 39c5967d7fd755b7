"""The page of results shows what the records hold."""

from __future__ import annotations

from pathlib import Path

import pytest

tables = pytest.importorskip("tables", reason="FEniCSx is absent")

PAGE = Path(__file__).resolve().parents[2] / "docs" / "results.md"


def test_every_table_of_the_results_is_what_its_record_says(capsys: pytest.CaptureFixture[str]) -> None:
    tables.print_all()
    printed = tables.tables_of(capsys.readouterr().out)
    shown = tables.tables_of(PAGE.read_text())
    common = printed.keys() & shown.keys()
    assert len(common) > 10
    assert {name: shown[name] for name in common} == {name: printed[name] for name in common}


def test_a_table_is_replaced_and_the_text_around_it_kept() -> None:
    page = "before\n\n| a | b |\n| --- | --- |\n\nbetween\n\n| c |\n| --- |\n| 1 |\n\nafter\n"
    printed = "\n| a | b |\n| --- | --- |\n| 1 | 2 |\n"
    wanted = "before\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n\nbetween\n\n| c |\n| --- |\n| 1 |\n\nafter\n"
    assert tables.replaced(page, printed) == wanted
