"""Detectors of others: classes, ONNX files, processes. `open.py` opens any detector from its text."""
