"""Tests of one run, from the request to a closed log."""
