"""A process that looks on at a station: every view of it, each reading decoded, as a live plot would.

It joins as a viewer. A line ``look`` on standard input makes it subscribe, ``rest`` makes it stop; at the input's end
it says how many messages came, as JSON, and ends.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable

from drivers.config import StationConfig
from drivers.wire import messages, topics
from drivers.wire.bus import Bus
from drivers.wire.codec import TYPES, decode_reading
from drivers.wire.station_bus import station_bus
from drivers.wire.streams import Sample

_READINGS = {*TYPES.values(), messages.COMPRESSED_IMAGE}


def look(bus: Bus, config: StationConfig, seen: Counter[str]) -> list[Callable[[], None]]:
    """Subscribe to every view of a station and count what comes in ``seen``; returns the ways to stop."""
    stops = []
    for topic, type_name in topics.streams(config).items():

        def take(sample: Sample, type_name: str = type_name) -> None:
            if type_name in _READINGS:
                decode_reading(type_name, sample.payload, sample.sequence, sample.status, sample.receive_ns)
            else:
                messages.decode(sample.payload, type_name)
            seen[sample.topic] += 1

        stops.append(bus.subscribe(topics.view(topic)).listen(take))
    return stops


def main() -> None:
    """Entry of the process: the first line of standard input is the station, as JSON."""
    config = StationConfig.model_validate_json(sys.stdin.readline())
    seen: Counter[str] = Counter()
    stops: list[Callable[[], None]] = []
    with station_bus(config, "viewer") as bus:
        _tell(ready=True)
        for line in sys.stdin:
            for stop in stops:
                stop()
            stops = look(bus, config, seen) if line.strip() == "look" else []
            _tell(looking=bool(stops))
    _tell(seen=dict(seen))


def _tell(**said: object) -> None:
    sys.stdout.write(json.dumps(said) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
