"""Perception as a model: errors of a detector, fitted from recorded percepts with truth and drawn again in the loop."""
