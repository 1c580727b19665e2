"""Tests of many logs."""
