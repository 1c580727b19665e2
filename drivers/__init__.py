"""Talks to drives; knows nothing of tests, logs or estimation."""
