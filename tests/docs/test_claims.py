"""Figures are those of the archived results; each credibility factor has evidence or says that it has none."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
RESULTS = (DOCS / "archive" / "results-2026.md").read_text()
CREDIBILITY = (DOCS / "credibility.md").read_text()

# ASME V&V 40-2018: verification of code and calculation, validation of model, comparator and assessment, applicability.
FACTORS = [
    "Software quality assurance",
    "Numerical code verification",
    "Discretisation error",
    "Numerical solver error",
    "Use error",
    "Model form",
    "Model inputs",
    "Test samples",
    "Test conditions",
    "Equivalency of input parameters",
    "Output comparison",
    "Relevance of the quantities of interest",
    "Relevance of the validation activities to the context of use",
]


def factors() -> dict[str, str]:
    """Text of each numbered section by its heading."""
    parts = re.split(r"^### (\d+\. .+)$", CREDIBILITY, flags=re.M)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def test_all_thirteen_factors_are_there_in_their_order() -> None:
    assert list(factors()) == [f"{number}. {name}" for number, name in enumerate(FACTORS, start=1)]


@pytest.mark.parametrize("name", list(factors()))
def test_each_factor_has_evidence_or_says_that_it_has_none(name: str) -> None:
    text = factors()[name]
    evidence = re.findall(r"\]\([\w.#/-]+\.md[^)]*\)|`tests/[\w/.]+`", text)
    assert evidence or "**Not done**" in text or "Net forces are compared" in text


def test_the_page_claims_no_conformity_and_no_living_liver() -> None:
    assert "no claim of conformity" in CREDIBILITY and "no validation against a living liver" in CREDIBILITY
    assert "no frame is accepted" in CREDIBILITY  # of the lungs, the one comparison with living organs
    assert CREDIBILITY.count("**Not done**") >= 8


def test_coverage_is_quoted_as_the_results_have_it() -> None:
    table = (DOCS / "method" / "posterior.md").read_text().partition("## How often the truth kept the margins")[2]
    rows = re.findall(r"^\| ([^|]+) \| (\d+) \| (\d+) \| (\d+) \|", table, flags=re.M)
    assert len(rows) >= 9
    assert [row for row in rows if " / ".join(row[1:]) not in RESULTS] == []


def test_the_guide_quotes_coverage_that_the_method_page_has() -> None:
    guide = (DOCS / "registration.md").read_text()
    shares = re.findall(r"h[eo]ld (\d+) %\s+of the\s+nodes(?: without the ensemble and (\d+) % with it)?", guide)
    rows = (DOCS / "method" / "posterior.md").read_text().partition("## How often the truth kept the margins")[2]
    assert sorted(share for found in shares for share in found if share) == ["69", "73", "92"]
    assert all(f"| {share} |" in rows for share in ("69", "73", "92"))


@pytest.mark.parametrize("page", ["credibility.md"])
def test_figures_with_decimals_stand_in_the_results(page: str) -> None:
    """Millimetres and per cent with a decimal point, as the pages quote them; what a reader chooses is in code."""
    text = re.sub(r"```.*?```|`[^`]*`", "", (DOCS / page).read_text(), flags=re.S)
    quoted = set(re.findall(r"(?<![\d.])(\d+\.\d+)(?= mm| %| \(asked| where)", text))
    assert len(quoted) >= 2
    assert [figure for figure in sorted(quoted) if figure not in RESULTS] == []


def test_verification_quotes_figures_of_the_tables_that_its_script_writes() -> None:
    """Numbers with a decimal point or an exponent, of the tables' cells."""
    page, tables = ((DOCS / name).read_text() for name in ("verification.md", "archive/verification.md"))
    cells = [cell for line in page.splitlines() if line.startswith("|") for cell in line.split("|")]
    quoted = {figure for cell in cells for figure in re.findall(r"\d+\.\d+(?:e-\d+)?", cell)}
    assert len(quoted) >= 60
    assert sorted(figure for figure in quoted if figure not in tables) == []


def test_verification_names_the_widest_of_the_orders() -> None:
    """The ranges of the summary are those of the archive's table of manufactured solutions."""
    tables = (DOCS / "archive" / "verification.md").read_text()
    rows = [row.split("|") for row in tables.split("## Manufactured solutions")[1].split("\n## ")[0].splitlines()]
    rows = [row for row in rows if len(row) == 7 and "e-" in row[3]]
    assert len(rows) == 56
    summary = (DOCS / "verification.md").read_text()
    for name, of in {
        "linear": [row for row in rows if "incompressible" not in row[1] and row[1].rstrip()[-1] not in "0679"],
        "quadratic": [row for row in rows if "incompressible" not in row[1] and row[1].rstrip()[-1] in "0679"],
        "mixed": [row for row in rows if "incompressible" in row[1]],
    }.items():
        orders = [sorted(float(row[place].split(";")[1]) for row in of) for place in (3, 4)]
        found = "; ".join(f"{each[0]:.2f} to {each[-1]:.2f}" for each in orders)
        assert re.search(rf"^\| manufactured solutions, {name} elements \|.*\| {found}", summary, flags=re.M), found
