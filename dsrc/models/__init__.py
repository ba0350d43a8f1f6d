"""Detectors: settings, layers, fusion of agents, checkpoint files."""

from dsrc.models import fusion as fusion  # hands its table to the settings, which any module here may make
