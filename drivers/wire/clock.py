"""The station's time and its simulated world, seen from another process."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from drivers.errors import DeviceFault
from drivers.fault import Fault
from drivers.wire import messages, topics
from drivers.wire.codec import decode_reading
from drivers.wire.link import Link
from drivers.wire.remote import RemoteSensor
from drivers.wire.watch import Watch
from mechanics.readings import Array, TruthReading

_PIECE_NS = 250_000_000  # station time per request: a long sleep stays interruptible, and each reply comes in time


class RemoteClock:
    """The station's `Clock`. In lockstep one query advances the world; otherwise time passes by itself."""

    def __init__(self, link: Link, watch: Watch, lockstep: bool):
        self.lockstep = lockstep
        self._link, self._watch = link, watch

    def now_ns(self) -> int:
        """As `Clock.now_ns`."""
        return self._link.now_ns if self.lockstep else time.time_ns()

    def sleep(self, seconds: float) -> None:
        """As `Clock.sleep`. In lockstep nothing published meanwhile is missing afterwards: here and in the log."""
        if not 0.0 <= seconds < 1e6:
            raise ValueError(f"a sleep of {seconds} s; expected a finite time that is not negative")
        if not self.lockstep:
            if self._watch.wait(seconds):
                raise DeviceFault(topics.WORLD, "sleep", "the station has died", "Start the station again")
            return
        left = round(seconds * 1e9)
        while left > 0:
            piece = min(left, _PIECE_NS)
            left -= piece
            whole, rest = divmod(piece, messages.NANOSECONDS)
            payload = messages.encode(messages.message(messages.DURATION, sec=whole, nanosec=rest))
            reply = self._link.ask(topics.WORLD, "advance", payload, watch=self._watch)
            self._link.now_ns = reply.now_ns


class RemoteSimulation:
    """The station's `Simulation`."""

    def __init__(self, link: Link, watch: Watch, sensors: Sequence[RemoteSensor]):
        self._link, self._watch, self._sensors = link, watch, tuple(sensors)

    def reset(self, seed: int, scene: dict, world: dict | None = None, begin_ns: int = 0) -> None:
        """As `Simulation.reset`; ``world`` (a `drivers.config.WorldConfig` as a dict) replaces the present one's.

        In lockstep time starts at ``begin_ns``. Raises CommandRefused while another session commands the arm, and for a
        scene that cannot be.
        """
        self._forget()
        payload = messages.encode(
            messages.message(
                messages.RESET,
                seed=seed,
                scene=json.dumps(scene),
                world="" if world is None else json.dumps(world),
                session=self._link.bus.zid,
                begin_ns=begin_ns,
            )
        )
        reply = self._link.ask(topics.WORLD, "reset", payload, watch=self._watch)
        self._link.now_ns = reply.now_ns

    def restage(self, scene: dict, part: int = 0) -> None:
        """As `Simulation.restage`. Raises CommandRefused while another session commands the arm, too."""
        self._forget()
        self._tell("restage", json.dumps({"scene": scene, "part": part, "session": self._link.bus.zid}))

    def _forget(self) -> None:
        """What was received is of another epoch, and streams will count from 0."""
        for subscription in self._link.bus.subscriptions():
            subscription.rewind()
        for sensor in self._sensors:
            sensor.forget()

    def regrasp(self, trial: int) -> None:
        """As `Simulation.regrasp`. Raises DeviceFault while there is no scene, CommandRefused where it cannot be."""
        payload = messages.encode(messages.message(messages.INTEGER, data=trial))
        self._link.ask(topics.WORLD, "regrasp", payload, watch=self._watch)

    def rearrange(self, scene: dict) -> None:
        """As `Simulation.rearrange`."""
        self._tell("rearrange", json.dumps(scene))

    def clamp(self, body: str | None) -> None:
        """As `Simulation.clamp`."""
        self._tell("clamp", body or "")

    def show_board(self, board: dict | None, X_W_B: Array) -> None:
        """As `Simulation.show_board`."""
        self._tell("show_board", json.dumps({"board": board, "X_W_B": np.asarray(X_W_B, float).tolist()}))

    def inject(self, fault: Fault | dict) -> None:
        """As `Simulation.inject`. A crash takes the host with it before it could answer."""
        text = fault.model_dump_json() if isinstance(fault, Fault) else json.dumps(fault)
        try:
            self._tell("inject", text)
        except DeviceFault:
            if json.loads(text).get("kind") != "crash":
                raise

    def clear_faults(self) -> None:
        """As `Simulation.clear_faults`."""
        self._tell("clear_faults", "")

    def _tell(self, verb: str, text: str) -> None:
        payload = messages.encode(messages.message(messages.STRING, data=text))
        self._link.ask(topics.WORLD, verb, payload, watch=self._watch)

    def truth(self) -> TruthReading:
        """As `Simulation.truth`."""
        reply = self._link.ask(topics.WORLD, "truth", watch=self._watch)
        return cast("TruthReading", decode_reading(reply.type, reply.data.tobytes(), 0))

    def health(self) -> dict[str, Any]:
        """As `Simulation.health`."""
        return json.loads(self._link.ask(topics.WORLD, "health", watch=self._watch).text)

    def counts(self) -> dict[str, int]:
        """As `Simulation.counts`: messages put on the bus; a stream that nobody hears is not put there."""
        return json.loads(self._link.ask(topics.WORLD, "counts", watch=self._watch).text)
