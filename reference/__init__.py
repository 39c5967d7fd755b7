"""The reference: hyperelastic equilibria, eigenmodes, loads, adjoints, data sets (FEniCSx)."""
