"""Ways from a cloud to where a solver ends, each a function: from rest, from the last frame, from a faster model."""
