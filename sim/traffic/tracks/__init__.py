"""Tracks that others recorded: CSV, plain arrays and CommonRoad XML, as a traffic log."""
