"""From a load to its equilibrium: starts, Newton's method, continuation, linear algebra (PETSc)."""
