"""Sections of docs/archive/verification.md from other benchmarks' records: other codes, the real liver, hard loads."""

from __future__ import annotations

from typing import Any

from columns import markdown
from record import recorded

PEERS = ("felupe", "scikit-fem", "torch-fem")


def recorded_pages() -> list[str]:
    """A section for each record that is there; one that is absent is named."""
    pages = {"peers": _peers, "liver_truth": _liver, "beam_hard": _hard}
    return [page(recorded(name)) if recorded(name) else f"## {name}\n\nNot run.\n" for name, page in pages.items()]


def _peers(found: dict[str, Any]) -> str:
    rows = [[name, *(f"{case[peer]['largest_difference_m']:.1e}" for peer in PEERS)] for name, case in found.items()]
    return f"""## Independent codes

`python benchmarks/peers.py`: the same mesh, law, nodal forces and tolerance (1e-8 of the forces) in codes that share
no line with DOLFINx, in one run. Largest difference of a displacement, metres (the largest displacements are 0.19,
0.053 and 0.12 m).

{markdown(["problem", *PEERS], rows)}"""


def _liver(found: dict[str, Any]) -> str:
    rows = [
        [
            name,
            f"{row['largest_imbalance_N']:.1e}",
            ", ".join(f"{row['largest_error_m'][f'{name} {frame}']:.1e}" for frame in (0, 25, 49)),
            f"{row['lone_movement_mm'][0]:.2f}",
            f"{row['attachments']['largest_gap_mm']:.2f} at node {row['attachments']['at_node']}",
            f"{row['attachments']['energy_listed_J']:.6f}, {row['attachments']['energy_facets_J']:.6f}",
        ]
        for name, row in found.items()
    ]
    head = [
        "sequence",
        "largest force left on a free node, N (50 frames)",
        "found from rest: largest error, m (frames 0, 25, 49)",
        "node 756 moves, mm (frame 0)",
        "with it fixed: largest gap, mm",
        "energies with it fixed and free, J",
    ]
    return f"""## The real liver

`python benchmarks/liver_truth.py`: the stored states of Mestdagh and Cotin's liver (MICCAI 2022) are equilibria of its
stored forces, and a solve from rest finds them. They had seemed not to be unique: a solve with all 106 listed nodes
fixed ends elsewhere. That is another attachment, not another equilibrium: node 756 is listed as fixed, but no boundary
triangle whose nodes are all listed holds it, and the stored states move it. With it fixed the body is stiffer, its
energy higher, and the gap to the stored state largest at that node; from rest and from the stored state one finds the
same.

{markdown(head, rows)}"""


def _hard(found: dict[str, dict[str, Any]]) -> str:
    rows = [
        [
            name,
            f"{row['converged']} of {row['loads']}",
            f"{row['mean_iterations']:.1f}" if row["converged"] else "-",
            f"{row['median_ms']:.0f}" if row["converged"] else "-",
        ]
        for name, row in found.items()
    ]
    return f"""## Hard loads

`python benchmarks/beam_hard.py`: random bending and torsion of the thesis's beam (304 hexahedra, E = 4500 Pa, nu =
0.49; Odot 2023, section 7.2.1: 20 % without a line search, 100 % with it or in load steps).

{markdown(["way", "converged", "mean iterations", "median ms"], rows)}"""
