"""Devices that play back a log: `replayed` by a station file, `Recording` for who re-runs what was recorded."""

from drivers.replay.devices import REPLAYS
from drivers.replay.recording import PlayedDevices, Recording, replayed
from drivers.replay.sensor import ReplaySensor

__all__ = ["REPLAYS", "PlayedDevices", "Recording", "ReplaySensor", "replayed"]
