"""The architectures by name: a new one is a file of its own, and a word here."""

from __future__ import annotations

from .architecture import Architecture
from .galerkin import Galerkin
from .mlp import Perceptron
from .reduced import Reduced
from .transolver import Transolver
from .umesh import UMesh

ARCHITECTURES: dict[str, type[Architecture]] = {
    kind.name: kind for kind in (Reduced, Galerkin, Perceptron, UMesh, Transolver)
}
TRAINED = tuple(name for name, kind in ARCHITECTURES.items() if hasattr(kind, "objective"))
"""Names of those whose weights are found step by step; others are made at once."""
