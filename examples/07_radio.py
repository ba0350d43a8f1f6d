"""What a radio costs: the same left turn with helpers, whose messages come late or not at all.

Usage:
    python examples/07_radio.py --scenario ima_queue
"""

import argparse

from msgspec.structs import replace

import dsrc
from sim.radio import get_channel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="lta_truck")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--duration-s", type=float, default=20.0)
    options = parser.parse_args()
    settings = dsrc.LoopSettings(detect_every_s=0.2, duration_s=options.duration_s)
    radios = {"ideal": {}, "all lost": {"packet_loss": 1.0}, "0.2 s late": {"delay_s": 0.2}}
    for name, changed in radios.items():
        perception = dsrc.open_perception("team", channel=replace(get_channel("ideal"), **changed), interval_s=0.2)
        loop = dsrc.ClosedLoop(options.scenario, perception, settings=settings)
        outcome = loop.run(options.seed)
        found = dsrc.episode_metrics(loop.log(perception="team"))
        print(f"{name:10s} {outcome.value}, hardest brake {found.hardest_brake_mps2:.1f} m/s²", flush=True)


if __name__ == "__main__":
    main()
