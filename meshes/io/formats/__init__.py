"""Formats of mesh files, one module each: what stands in a file, in its own numbers."""
