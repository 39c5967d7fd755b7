"""Finite elements: numbering, forms and their assembly (DOLFINx)."""
