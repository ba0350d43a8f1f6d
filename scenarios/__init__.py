"""Scenario files: data, one folder per scenario."""
