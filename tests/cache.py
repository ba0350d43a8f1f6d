"""What a process remembers of the cache folder."""

from dsrc.closed_loop import kept
from sensors.recording import encounter_check


def forget() -> None:
    """Forget proofs and worlds, as a new process knows none."""
    kept._scene.cache_clear()
    encounter_check._found.cache_clear()
    encounter_check._first_proven_draw.cache_clear()
