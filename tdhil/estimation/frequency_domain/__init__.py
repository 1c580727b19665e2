"""Periodic excitation: samples to lines, lines to a model's likelihood, likelihood to values and intervals."""
