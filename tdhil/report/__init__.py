"""Findings to terminal, JSON, HTML and PDF."""
