"""Comparison of DSRC with its rivals on dsrc-sim-2: its plan, and how many trainings it needs."""
