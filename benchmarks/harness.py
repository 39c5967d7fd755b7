"""What all benchmarks share: the command line, rows that go on where they stopped, the table, the record.

    python benchmarks/harness.py list                 # every benchmark, its record and what this is about
    python benchmarks/harness.py stale                # records older than the code they are about, dirty or orphan ones
    python benchmarks/harness.py tables [--into PAGE] # tables of the records that are there

A script declares a `Benchmark` and ends with `run(BENCHMARK)`. Its `name`, `title`, `about`, `under` and `also` are
written as literals, since `list` and `stale` read them from the source: they need nothing that the scripts import.
"""

from __future__ import annotations

import argparse
import importlib
import io
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import record
from audit import audit, declarations, listed
from columns import Column, cell, markdown, replaced

Figures = dict[str, Any]


# ---------------------------------------------------------------------- the declaration


@dataclass(frozen=True)
class Setting:
    """An option of one script.

    Args:
        default: of it; with None the option may be absent, and `kind` says what it is.
        says: its help.
        kind: makes it from a word; the default's own type if not given.
        choices: that it is one of, or several of where the default is a tuple.
        picks: it picks rows, places or ranks: no figure of a row depends on it.
        is_given: it stands without a name, and has to.
    """

    default: Any = None
    says: str = ""
    kind: Callable[[str], Any] | None = None
    choices: tuple[str, ...] = ()
    picks: bool = False
    is_given: bool = False


FOLDER = Setting(says="what `softtwin quickstart --output FOLDER` makes", kind=Path, picks=True, is_given=True)
RANKS = Setting(2, "that make data", picks=True)


class Given:
    """The settings of a run as attributes, and what its rows share.

    Args:
        settings: by name, with underscores.
        opened: closes what rows have opened.
    """

    def __init__(self, settings: Mapping[str, Any], opened: ExitStack) -> None:
        self.settings, self._opened, self._made = dict(settings), opened, dict[Any, Any]()

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["settings"][name]
        except KeyError:
            raise AttributeError(f"no setting {name}") from None

    def once(self, make: Callable[..., Any], *words: Any) -> Any:
        """What a function makes of some arguments, made once a run."""
        if (make, words) not in self._made:
            self._made[make, words] = make(*words)
        return self._made[make, words]

    def opened(self, make: Callable[..., Any], *words: Any) -> Any:
        """What a context manager yields, entered once a run and left at its end."""
        if (make, words) not in self._made:
            self._made[make, words] = self._opened.enter_context(make(*words))
        return self._made[make, words]


def _as_they_are(figures: Figures) -> Iterable[tuple[str, Figures]]:
    return ((name, row) for name, row in figures.items() if isinstance(row, dict))


@dataclass(frozen=True)
class Benchmark:
    """A benchmark.

    Args:
        name: of its record; `{mesh}` stands for what the setting of that name is.
        title: what it measures, in one line.
        about: folders and files that its figures are about, from the repository's root.
        work: figures of one row, by its name and what is given.
        rows: their names, or a function of what is given; one without a name where the figures are one row's.
        columns: of the printed table; none: the figures are printed.
        settings: options by name.
        seeds: that chance begins with; recorded.
        small: settings for a look in a minute, which is not recorded.
        under: entry of the figures that holds the rows; empty: the figures are the rows.
        finish: further figures, by those of all rows and what is given.
        lines: of the table, with their labels, by the rows; those of the record if not given.
        also: other names of its records, with * for anything.
        named: the record's name by the options, where it is one of the others.
        threads: of each library.
    """

    name: str
    title: str
    about: tuple[str, ...]
    work: Callable[[str, Given], Any]
    rows: Sequence[str] | Callable[[Given], Iterable[str]] = ("",)
    columns: tuple[Column, ...] = ()
    settings: Mapping[str, Setting] = field(default_factory=dict)
    seeds: tuple[int, ...] = ()
    small: Mapping[str, Any] = field(default_factory=dict)
    under: str = ""
    finish: Callable[[Figures, Given], Figures] | None = None
    lines: Callable[[Figures], Iterable[tuple[str, Figures]]] = _as_they_are
    also: tuple[str, ...] = ()
    named: Callable[[argparse.Namespace], str] | None = None
    threads: int = 1

    def __post_init__(self) -> None:
        if not self.about:
            raise ValueError(f"{self.name}: about: expected at least one folder or file, got none.")
        unknown = set(self.small) - set(self.settings)
        if unknown:
            raise ValueError(f"{self.name}: small: no settings {', '.join(sorted(unknown))}.")

    @property
    def script(self) -> Path:
        """The file that its work stands in."""
        return Path(sys.modules[self.work.__module__].__file__ or "")

    def rows_of(self, figures: Figures) -> Figures:
        """The rows among the figures of a record."""
        return figures.setdefault(self.under, {}) if self.under else figures


# ---------------------------------------------------------------------- a run


def run(
    benchmark: Benchmark,
    words: Sequence[str] | None = None,
    parts: Mapping[str, Callable[..., None]] | None = None,
) -> Figures:
    """Run a benchmark by the command line, or by these words; returns its figures.

    Args:
        benchmark: what to run.
        words: of the command line; the process's own if not given.
        parts: what this script does in processes of its own (`started`), by name.
    """
    words = list(sys.argv[1:] if words is None else words)
    if parts and words and words[0] in parts:
        parts[words[0]](*words[1:])
        return {}
    options = _parsed(benchmark, words)
    own = benchmark.name.format(**vars(options)) if benchmark.named is None else benchmark.named(options)
    name = options.name or own
    if options.table:
        print(table(benchmark, name, record.recorded(name)))
        return record.recorded(name)
    is_dry = options.dry or getattr(options, "small", False)
    try:
        begun = "" if is_dry else record.commit()
        if begun:
            record.check_clean()
        command = " ".join(["python", f"benchmarks/{benchmark.script.name}", *words])
        return _all_rows(benchmark, name, options, command, begun)
    except record.NotRecordedError as error:
        raise SystemExit(f"{name}: {error}") from None


def _parsed(benchmark: Benchmark, words: Sequence[str]) -> argparse.Namespace:
    told = sys.modules[benchmark.work.__module__].__doc__ or benchmark.title
    parser = argparse.ArgumentParser(description=told, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, setting in benchmark.settings.items():
        _add(parser, name, setting)
    parser.add_argument("--only", nargs="+", default=(), metavar="ROW", help="rows of this name, or that have it in it")
    parser.add_argument("--fresh", action="store_true", help="make rows again that are recorded")
    parser.add_argument("--dry", action="store_true", help="run, and record nothing")
    parser.add_argument("--table", action="store_true", help="print the recorded table, and run nothing")
    parser.add_argument("--name", default="", help="of the record, in place of its own")
    if benchmark.small:
        parser.add_argument("--small", action="store_true", help="a look in a minute; records nothing")
        if "--small" in words:
            parser.set_defaults(**benchmark.small)
    return parser.parse_args(words)


def _add(parser: argparse.ArgumentParser, name: str, setting: Setting) -> None:
    several = isinstance(setting.default, tuple)
    flag = name if setting.is_given else f"--{name.replace('_', '-')}"
    if isinstance(setting.default, bool):
        parser.add_argument(flag, action="store_true", help=setting.says)
        return
    first = setting.default[0] if several and setting.default else setting.default
    told: dict[str, Any] = {"help": setting.says, "type": setting.kind or (str if first is None else type(first))}
    told |= {"choices": setting.choices} if setting.choices else {}
    told |= {"nargs": "+"} if several else {}
    told |= {} if setting.is_given else {"default": setting.default}
    parser.add_argument(flag, **told)


def _all_rows(benchmark: Benchmark, name: str, options: argparse.Namespace, command: str, begun: str) -> Figures:
    from threadpoolctl import threadpool_limits

    known = record.read(name) if begun else {}
    figures, made = known.get("figures", {}), record.made_of(known, benchmark.under) if known else {}
    settings = {each: getattr(options, each) for each in benchmark.settings}
    kept = {each: value for each, value in settings.items() if not benchmark.settings[each].picks}
    with ExitStack() as opened, threadpool_limits(benchmark.threads):
        given = Given(settings, opened)
        wanted = _chosen(benchmark, given, options.only)
        for place, row in enumerate(wanted):
            label = f"[{place + 1}/{len(wanted)}] {row or name}"
            told = made.get(row, {}) if row in made or not row else made.get("", {})
            if begun and not options.fresh and _is_current(benchmark, figures, row, told, kept):
                print(f"{label}: recorded at {told['commit']}", flush=True)
                continue
            print(f"{label} ...", flush=True)
            clock = time.perf_counter()
            found = _as_json(benchmark.work(row, given))
            seconds = time.perf_counter() - clock
            print(f"{label}: {seconds:.1f} s; {_line(benchmark, row, found)}", flush=True)
            if not begun:
                figures = _entered(benchmark, figures, row, found, given)
                continue
            record.check_unchanged(begun, [*benchmark.about, "benchmarks"])
            with record.held():  # another process may be at other rows of the same record
                known = record.read(name)
                figures = _entered(benchmark, known.get("figures", {}), row, found, given)
                made = record.made_of(known, benchmark.under) if known else {}
                made[row] = _made(benchmark, begun, command, seconds, kept)
                made = record.made_of({**known, "figures": figures, "made": made}, benchmark.under)
                record.write(name, figures, made, command, begun)
    print(table(benchmark, name, figures))
    print(f"recorded: benchmarks/results/{name}.json" if begun else "nothing is recorded (--dry)")
    return figures


def _made(benchmark: Benchmark, begun: str, command: str, seconds: float, kept: Figures) -> Figures:
    """What a row is made from."""
    return {
        "commit": begun,
        "date": time.strftime("%Y-%m-%d"),
        "command": command,
        "seconds": round(seconds, 2),
        "settings": _as_json(kept),
        "seeds": list(benchmark.seeds),
        "on": record.processor(),
        "gpu": record.gpu(),
    }


def _chosen(benchmark: Benchmark, given: Given, only: Sequence[str]) -> list[str]:
    rows = list(benchmark.rows(given) if callable(benchmark.rows) else benchmark.rows)
    exact = [row for row in rows if row in only]
    chosen = exact if len(exact) == len(only) else [row for row in rows if any(word in row for word in only)]
    if only and not chosen:
        raise SystemExit(f"--only: expected one of {', '.join(map(repr, rows))}, got {', '.join(map(repr, only))}")
    return chosen if only else rows


def _is_current(benchmark: Benchmark, figures: Figures, row: str, told: Figures, kept: Figures) -> bool:
    """Whether a row is there, from the last commit of what it is about, and made by the same settings."""
    if not (row in benchmark.rows_of(figures) if row else figures):
        return False
    return record.holds(told.get("commit", ""), benchmark.about) and told.get("settings") == _as_json(kept)


def _with(benchmark: Benchmark, figures: Figures, row: str, found: Any) -> Figures:
    if not row:
        return dict(found)
    benchmark.rows_of(figures)[row] = found
    return figures


def _entered(benchmark: Benchmark, figures: Figures, row: str, found: Any, given: Given) -> Figures:
    """The figures of all rows with those of one more."""
    figures = _with(benchmark, figures, row, found)
    return figures if benchmark.finish is None else figures | _as_json(benchmark.finish(figures, given))


def _as_json(value: Any) -> Any:
    """As a record has it, so that a table printed at once and one of the record are the same."""
    return json.loads(json.dumps(value, default=record.plain))


def started(
    script: str, *words: str, ranks: int = 1, bind: str = "none", **how: Any
) -> subprocess.CompletedProcess[str]:
    """Run a part of a script in processes of its own: so many ranks of one thread each, bound to what MPI is told."""
    command = [sys.executable, script, *words]
    if ranks > 1:
        command = ["mpirun", "--oversubscribe", "--bind-to", bind, "-n", str(ranks), *command]
    return subprocess.run(command, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}, text=True, **{"check": True, **how})


# ---------------------------------------------------------------------- tables


def _line(benchmark: Benchmark, row: str, found: Figures) -> str:
    if not isinstance(found, dict):
        return str(found)
    lines = list(benchmark.lines({row: found} if row else found)) if benchmark.columns else []
    told = [
        f"{label} ".lstrip() + "; ".join(f"{c.head}: {cell(c, each)}" for c in benchmark.columns)
        for label, each in lines
    ]
    return " | ".join(told) or json.dumps(found)[:600]


def table(benchmark: Benchmark, name: str, figures: Figures) -> str:
    """The figures of a record as a table in Markdown."""
    if not benchmark.columns:
        return json.dumps(figures, indent=1)
    lines = [
        [label, *(cell(c, each) for c in benchmark.columns)]
        for label, each in benchmark.lines(benchmark.rows_of(figures))
    ]
    return markdown([name, *(c.head for c in benchmark.columns)], lines)


def tables() -> str:
    """The tables of all records whose scripts can be loaded here; others are named."""
    printed = []
    for declared in declarations():
        try:
            module = importlib.import_module(declared.script.removesuffix(".py"))
        except ImportError as error:
            print(f"{declared.script}: not loaded: {error}", file=sys.stderr)
            continue
        for benchmark in (each for each in vars(module).values() if isinstance(each, Benchmark)):
            if benchmark.name == declared.name and benchmark.columns:
                names = [path.stem for path in sorted(record.RESULTS.glob("*.json")) if declared.declares(path.stem)]
                printed += [table(benchmark, name, record.recorded(name)) for name in names]
    return "\n".join(printed)


def main(words: Sequence[str] | None = None) -> None:
    """`list`, `stale` or `tables`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["list", "stale", "tables"])
    parser.add_argument("--into", type=Path, help="a page whose tables of the same first heading are replaced")
    options = parser.parse_args(words)
    if options.what == "tables":
        with redirect_stdout(io.StringIO()):  # what scripts say while they are loaded
            printed = tables()
        if options.into is None:
            print(printed, end="")
            return
        options.into.write_text(replaced(options.into.read_text(), printed))
        return
    if options.what == "list":
        print(listed())
        return
    found = audit()
    print("\n".join(map(str, found)) or "every record is of the last commit of what it is about")


if __name__ == "__main__":
    from harness import main as run_as_module  # scripts import this file by its name: one module, not two

    run_as_module()
