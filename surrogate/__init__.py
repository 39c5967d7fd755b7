"""Learned forward models: architectures, training, validation, prediction (torch)."""
