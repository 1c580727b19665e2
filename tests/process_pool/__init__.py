"""Tests of the process pool."""
