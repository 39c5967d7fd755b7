"""What an iteration pays for its tangent, on three bodies, methods in turn.

Assembly: summed from the cells against DOLFINx's own, time and difference. Factorisation: `auto` against MUMPS.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Setting, run
from liver import POISSON_RATIO, YOUNG_MODULUS, liver

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.fem.discretisation import Discretisation
from softtwin.reference.fem.fenicsx import assemble_matrix, create_matrix
from softtwin.reference.fem.forms import DiscreteLoad, Forms
from softtwin.reference.solve.linear import LinearSolver


def seconds(call: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def compare(body: Body, repeats: int) -> dict[str, Any]:
    space = Discretisation(body, False, {"fixed": "xyz"})
    forms = Forms(space, NeoHookean(YOUNG_MODULUS, POISSON_RATIO))
    state = 1e-5 * body.size * np.random.default_rng(0).standard_normal(space.owned)
    state[space.fixed] = 0.0
    load = DiscreteLoad(*np.zeros((2, space.owned)), {})
    mine, theirs = forms.create_matrix(), create_matrix(forms.tangent_form)
    pairs = [
        (
            seconds(lambda: forms.tangent(state, load, mine)),
            seconds(lambda: assemble_matrix(theirs, forms.tangent_form, space.conditions)),
        )
        for _ in range(repeats)
    ]
    ours, dolfinx = np.median(pairs, axis=0)
    suited, mumps = LinearSolver(mine, space, "band"), LinearSolver(theirs, space, "mumps")
    factors = []
    for _ in range(repeats):
        mine.stateIncrease()
        theirs.stateIncrease()
        factors.append((seconds(suited.prepare), seconds(mumps.prepare)))
    a, b = mine.getValuesCSR()[2], theirs.getValuesCSR()[2]
    return {
        "cells": len(body.cells),
        "unknowns": space.size,
        "summed_ms": 1e3 * float(ours),
        "dolfinx_ms": 1e3 * float(dolfinx),
        "factored_ms": 1e3 * float(np.median(factors, axis=0)[0]),
        "mumps_ms": 1e3 * float(np.median(factors, axis=0)[1]),
        "largest_difference": float(np.abs(a - b).max() / np.abs(b).max()),
    }


BODIES = {"beam": beam, "liver": liver, "large beam": lambda: beam((39, 9, 9), (100.0, 25.0, 25.0))}
BENCHMARK = Benchmark(
    name="assembly",
    title="What an iteration pays for its tangent: assembly and factorisation against DOLFINx's and MUMPS's",
    about=("reference/fem", "reference/solve"),
    work=lambda row, given: compare(BODIES[row](), given.repeats),
    rows=tuple(BODIES),
    columns=(
        Column("unknowns", "", "{unknowns:,}"),
        Column("summed from the cells", "ms", "{summed_ms:.1f}"),
        Column("DOLFINx", "ms", "{dolfinx_ms:.1f}"),
        Column("factored", "ms", "{factored_ms:.1f}"),
        Column("MUMPS", "ms", "{mumps_ms:.1f}"),
        Column("largest difference", "", "{largest_difference:.0e}"),
    ),
    settings={"repeats": Setting(15, "of each, in turn")},
    seeds=(0,),
    small={"repeats": 2},
)


if __name__ == "__main__":
    run(BENCHMARK)
