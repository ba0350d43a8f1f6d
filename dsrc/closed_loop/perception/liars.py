"""Liars: helpers whose messages hold objects that do not exist.

A liar gives the returns that its LiDAR would measure if the object stood there, cast in the scene with everything else,
the strongest fabrication of Zhang et al., *On Data Fabrication in Collaborative Vehicular Perception: Attacks and
Countermeasures*, USENIX Security 2024. It speaks before anything else acts on its sweep: corruption, channel and fusion
treat a lie like the truth.
"""

from collections.abc import Iterable, Mapping

from sim.traffic.base import Actors


def false_actors(claims: Mapping[str, Actors], now: Actors, agents: Iterable[int]) -> dict[int, Actors]:
    """Return the false actors of the agents that claim some, by their ids.

    A claim of somebody who is no agent reaches nobody.

    Args:
        claims: by the name of the helper; `roadside` is the first roadside unit, `roadside 2` the second.
        agents: ids of those who send messages.
    """
    senders = set(agents)
    ids = dict(zip(now.name, now.boxes.object_id.tolist(), strict=True))
    found = {}
    for name, claimed in claims.items():
        room, _, number = name.partition(" ")
        sender = ids.get(name) if room != "roadside" else -int(number or 1)
        if sender in senders and len(claimed):
            found[sender] = claimed
    return found
