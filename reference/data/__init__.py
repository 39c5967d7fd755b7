"""What is given and what is found: loads, materials, equilibria, data sets. No FEniCSx: the fast path imports it."""
