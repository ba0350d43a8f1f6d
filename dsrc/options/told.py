"""Names of what helpers tell and of what defends against lies: what computes with them needs no command line."""

BOXES, CPM = "boxes", "cpm"
MESSAGES = (BOXES, CPM, "cpm-dynamics", "cpm-distance")
"""What helpers tell that detect alone: all boxes that they find, or ETSI's messages, see `dsrc.messages.cpm`."""
NO_DEFENCE = "none"
DEFENCES = ("agreement", "free-space", "motion", "trust")
"""Defences by name, in the order in which they act."""
SINGLE_DEFENCES = ("agreement", "free-space")
"""Defences that need no message but those of one instant."""
