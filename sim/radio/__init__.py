"""Radio channel: delivery, latency and bytes of messages between agents.

An abstract model at 5.9 GHz, one link budget per message and one draw per packet:

1. A message is cut into packets of `packet_bytes`; each takes the air for 40 us of preamble and as many symbols of
   8 us as its bits and 22 bits of service and tail need at the data rate (IEEE 802.11p), or for whole ms (LTE).
2. The airtimes of all agents in carrier sense range add up to the channel load. A message waits for a random share of
   the others' packets; with reactive congestion control (ETSI TS 102 687) a sender skips instants when the load is
   high, and also when the packets of one instant do not fit before the next.
3. The mean received power follows 3GPP TR 37.885 for a free line of sight, one through vehicles, and one through
   buildings. Around it the power varies as there (3 or 4 dB; 4.5 dB more through vehicles). Half of that variance is
   shadowing, which changes over 10 m (urban) or 25 m (motorway) of travel, half is drawn for every packet.
   A packet is received when the power is above the noise by `snr_db`: on average with the probability
   Phi((P - PL - threshold) / sigma). The split into halves is assumed; the average does not depend on it.
4. Packets are also lost by collisions, in proportion to the load.
5. Packets are lost for any other reason at random (`packet_loss`), and in bursts in which a link is down: a chain of
   two states (Gilbert 1960; Elliott 1963), down for `burst_s` on average and for a share `burst_loss` of the time.

Every draw is a function of the seed, the link and the number of the instant, whatever the order of calls.
"""

from sim.radio.budget import (
    CPM_BYTES_PER_OBJECT,
    airtime_s,
    cpm_bytes,
    delivery_probability,
    lost_tiles,
    message_airtime_s,
    packet_count,
    path_loss_db,
)
from sim.radio.channel import LEAST_SHARE, MAX_AGE, Channel, Link, RadioSnapshot
from sim.radio.spec import (
    CHANGES,
    HEARING_M,
    IDEAL,
    PRESETS,
    ChannelSpec,
    Obstruction,
    Radio,
    changed_spec,
    get_channel,
)

__all__ = [
    "CHANGES",
    "Channel",
    "CPM_BYTES_PER_OBJECT",
    "ChannelSpec",
    "HEARING_M",
    "IDEAL",
    "LEAST_SHARE",
    "Link",
    "MAX_AGE",
    "Obstruction",
    "PRESETS",
    "Radio",
    "RadioSnapshot",
    "airtime_s",
    "changed_spec",
    "cpm_bytes",
    "delivery_probability",
    "get_channel",
    "lost_tiles",
    "message_airtime_s",
    "packet_count",
    "path_loss_db",
]
