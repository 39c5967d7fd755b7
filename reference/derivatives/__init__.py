"""What an equilibrium changes with: adjoints, the reference as a forward model and as a torch layer."""
