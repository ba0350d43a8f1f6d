"""What an episode is driven in: a corruption, a channel and faults, each said once.

A fault that is there all the time may have an older spelling: `loss:0.3` is the channel `ideal,loss=0.3`, `fog:3` the
corruption of that name. Episodes have the older one, so that both are one episode.
"""

from typing import NamedTuple

from dsrc.faults.fault import Faults
from dsrc.faults.kinds import Severity
from sensors.corruptions import Condition
from sim.radio import Radio


class Disturbance(NamedTuple):
    """What an episode is driven in.

    Attributes:
        condition: of the sweeps, all the time.
        channel: name of the radio channel, with what is changed of it all the time.
        faults: what neither of them says.
    """

    condition: Condition
    channel: str
    faults: Faults = ()


def settled(faults: Faults, channel: str) -> Disturbance:
    """Return the disturbance of faults: what condition and channel can say, they say.

    A corruption with another fault beside it stays a fault: each acts on what those before it left.
    """
    radio, left = Radio.parse(channel), []
    for fault in faults:
        if fault.radio and fault.always and fault.agents == "helpers":
            radio = radio.changed(**fault.radio)
        else:
            left.append(fault)
    if len(left) == 1 and left[0].always and isinstance(left[0].settings, Severity):
        return Disturbance(left[0].condition, radio.label)
    return Disturbance(Condition(), radio.label, tuple(left))
