"""Validation cases: found, run, judged by figures written down before, and reported."""
