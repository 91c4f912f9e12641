"""Owns the simulated world and serves its devices on the bus, mostly as a process of its own.

One thread owns the world: there the main thread. Handlers of the bus only put work into its inbox; in lockstep the
world advances when it is asked to, in real time it is paced by absolute deadlines with work done between the steps.

As a process of its own it is told what to serve and ends as `drivers.hosted` has it: arm held, session closed.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np
from pydantic import ValidationError

from drivers import hosted
from drivers.config import StationConfig, WorldConfig
from drivers.errors import CommandRefused
from drivers.interfaces import Arm, ForceTorqueSensor, ImagingSensor
from drivers.scene import Scene
from drivers.sim.faults import Faulty
from drivers.sim.world import World
from drivers.wire import messages, topics
from drivers.wire.arm_server import ArmServer
from drivers.wire.bus import Bus
from drivers.wire.codec import encode_reading
from drivers.wire.server import Answer, Desk, DeviceServer, Work
from drivers.wire.station_bus import station_bus, warn_unheard
from drivers.wire.streams import ViewRates

PROTOCOL = 2
TRUTH_PERIOD_NS = 20_000_000
"""Truth is published at 50 Hz of station time; in lockstep urgent work also waits no longer than this."""
_PIECE, _LEISURE = 0.002, 0.02  # how much real time is simulated at once, and while nobody takes any stream [s]
_IDLE = 0.5
_LAG = 0.05  # a world that is this late gives up the lost time, well before its readings count as old [s]

log = logging.getLogger(__name__)


class Inbox:
    """Work for the owner of the world; urgent work overtakes. `put` and `wake` are safe in signal handlers."""

    def __init__(self) -> None:
        self._urgent: deque[Work] = deque()
        self._queue: queue.SimpleQueue[Work | None] = queue.SimpleQueue()
        self._owner = 0

    def put(self, work: Work, urgent: bool) -> None:
        """Leave work for the owner, who does what is urgent at once where it comes from the owner itself."""
        if urgent and threading.get_ident() == self._owner:
            work()
        elif urgent:
            self._urgent.append(work)
            self._queue.put(None)
        else:
            self._queue.put(work)

    def wake(self) -> None:
        """Make `serve` return early."""
        self._queue.put(None)

    def serve_urgent(self) -> None:
        """Do the urgent work."""
        while self._urgent:
            self._urgent.popleft()()

    def serve(self, timeout: float) -> None:
        """Wait for work and do one piece of it; who calls this is the owner."""
        self._owner = threading.get_ident()
        self.serve_urgent()
        try:
            work = self._queue.get(timeout=timeout) if timeout > 0 else self._queue.get_nowait()
        except queue.Empty:
            return
        self.serve_urgent()
        if work is not None:
            work()


def _die() -> None:
    """End this process as a crash does: no farewell to anybody."""
    os.kill(os.getpid(), signal.SIGKILL)


class Host:
    """The world on a bus. `run` blocks in the calling thread, which owns the world, until `stop`.

    ``crash`` is what a fault of this name does to it.
    """

    def __init__(self, config: StationConfig, bus: Bus, crash: Callable[[], None] = _die):
        self.config, self.bus = config, bus
        self.world = World(config)
        self.inbox = Inbox()
        self.skipped_ns = 0
        self.desk = Desk(
            bus,
            config.name,
            run=self.inbox.put,
            now_ns=self._now_ns,
            shift_ns=lambda: self.skipped_ns,
            lockstep=self.world.lockstep,
            lease=config.lease,
            views=ViewRates(config.bus.view_rate, config.bus.image_view_rate),
        )
        self._stopping = False
        self._staged = False
        self._anchor = 0.0  # monotonic instant at which the world should have been at step 0
        self._origin_ns = 0
        self._truths = self._next_truth_ns = 0
        self._servers: dict[str, DeviceServer] = {}
        self._due: dict[str, float] = {}  # when a camera takes its next frame in real time [s]
        self.world.faults.on_crash = crash
        #: a world in real time that is later than this gives up the lost time [s]
        self.longest_lag = _LAG

    def _now_ns(self) -> int:
        return self.world.now_ns() + self.skipped_ns

    def stop(self) -> None:
        """End `run`; safe in a signal handler and from any thread."""
        self._stopping = True
        self.inbox.wake()

    def run(
        self, ready: Callable[[], None] = lambda: None, failed: Callable[[BaseException], None] = lambda _: None
    ) -> None:
        """Serve until `stop`; ``ready`` is called once every device is on the bus.

        What ends it otherwise is raised, and given to ``failed`` before the devices vanish from the bus.
        """
        with ExitStack() as stack:
            self._begin(stack)
            self._truth_stream = self.desk.publisher(topics.WORLD, "truth", messages.TRUTH)
            stack.callback(self._truth_stream.close)
            for verb, work in (
                ("reset", self._reset),
                ("advance", self._advance),
                ("restage", self._restage),
                ("regrasp", self._regrasp),
                ("rearrange", self._rearrange),
                ("clamp", self._clamp),
                ("truth", self._truth),
                ("show_board", self._show_board),
                ("inject", self._inject),
                ("clear_faults", self._clear_faults),
                ("health", lambda _: Answer(json.dumps(self.world.health()))),
                ("counts", lambda _: Answer(json.dumps(self.desk.counts()))),
            ):
                stack.callback(self.desk.serve(topics.WORLD, verb, work))
            stack.callback(self.desk.serve(topics.WORLD, "describe", self._describe, direct=True))
            stack.callback(self.bus.token(topics.alive(self.config.name, topics.WORLD)))
            ready()
            try:
                while not self._stopping:
                    wait = _IDLE if self.world.lockstep or not self._staged else self._pace()
                    self.inbox.serve(wait)
            except BaseException as error:
                failed(error)
                raise

    def _begin(self, stack: ExitStack) -> None:
        """Put the devices to work; ``stack`` ends it."""
        stack.callback(self._withdraw)
        self._attend()

    def _attend(self) -> None:
        """Serve the devices that are there, and no others: a device that has gone takes its server with it."""
        for name, device in self.world.devices.items():
            gone, server = isinstance(device, Faulty) and device.line.gone, self._servers.get(name)
            if server is None and not gone:
                server = self._arm_server(device) if isinstance(device, Arm) else DeviceServer(self.desk, device)
                self._servers[name] = server
                server.open()
            elif server is not None and gone:
                del self._servers[name]
                server.close()

    def _arm_server(self, arm: Arm) -> ArmServer:
        config = self.config.devices
        known = config[arm.name]
        sensors: dict[str, ForceTorqueSensor | float] = {
            name: device
            for name, device in self.world.devices.items()
            if isinstance(device, ForceTorqueSensor) and getattr(config[name], "mount", "") == "wrist"
        }
        return ArmServer(self.desk, arm, getattr(known, "limits", None), sensors)

    def _withdraw(self) -> None:
        while self._servers:
            self._servers.popitem()[1].close()

    def _pace(self) -> float:
        """Bring the world up to the present; returns how long to wait for the next piece [s]."""
        simulated = (self.world.now_ns() - self._origin_ns) * 1e-9
        behind = time.monotonic() - self._anchor - simulated
        piece = _PIECE if self._heard() else _LEISURE
        if behind > self.longest_lag:
            self._anchor += behind
            self.skipped_ns += int(behind * 1e9)
            log.warning("%s: the world was %.0f ms late and gave up the lost time", self.config.name, behind * 1e3)
            behind = piece = _PIECE  # the sensors speak before anybody hears that so much time has passed
        if behind < piece:
            return piece - behind
        with self.desk.together():
            self._step(int(piece * 1e9))
        self._capture(simulated)
        return 0.0

    def _heard(self) -> bool:
        """Whether anybody takes a stream."""
        return any(stream.heard() for stream in self.desk.publishers)

    def _capture(self, now: float) -> None:
        """Have the camera take its frame whose frame is due longest: one at a time, for commands wait meanwhile."""
        cameras = [name for name, server in self._servers.items() if isinstance(server.device, ImagingSensor)]
        name = min(cameras, key=lambda camera: self._due.get(camera, 0.0), default=None)
        if name is None or (due := self._due.get(name, 0.0)) > now:
            return
        period = 1.0 / self.config.devices[name].rate
        self._due[name] = due + period if due + period > now else now + period  # what was missed is not made up for
        self._servers[name].capture_if_wanted()

    def _step(self, span_ns: int) -> None:
        """Advance by ``span_ns``, with the truth at its instants and urgent work no longer than its period away."""
        while span_ns > 0:
            piece = min(span_ns, max(self._next_truth_ns - (self.world.now_ns() - self._origin_ns), 1))
            self.world.advance(piece * 1e-9)
            span_ns -= piece
            self._attend()
            self._publish_truth()
            self.inbox.serve_urgent()

    def _publish_truth(self) -> None:
        if self.world.now_ns() - self._origin_ns < self._next_truth_ns:
            return
        self._next_truth_ns += TRUTH_PERIOD_NS
        if self._truth_stream.matched:
            truth = self.world.truth()
            payload = encode_reading(truth, self.skipped_ns)
            self._truth_stream.put(payload, self._truths, truth.stamp.capture_ns + self.skipped_ns)
        self._truths += 1

    def _describe(self, _: bytes) -> Answer:
        scene = self.world.staged()
        return Answer(
            json.dumps(
                {
                    "protocol": PROTOCOL,
                    "station": self.config.name,
                    "pid": os.getpid(),
                    "lockstep": self.world.lockstep,
                    "config": self.config.model_dump(mode="json"),
                    "scene": None if scene is None else scene.model_dump(mode="json"),
                }
            )
        )

    def _reset(self, payload: bytes) -> None:
        asked = messages.decode(payload, messages.RESET)
        self._refuse_foreign("reset", asked.session)
        self.desk.restart()
        try:
            scene = Scene.model_validate_json(asked.scene)
            world = WorldConfig.model_validate_json(asked.world) if asked.world else None
            self.world.reset(asked.seed, self._begun_with(scene), world, asked.begin_ns)
        except (ValidationError, ValueError) as error:
            raise CommandRefused(topics.WORLD, "reset", str(error), "Correct the scene") from error
        self.skipped_ns = 0
        self._origin_ns, self._anchor = self.world.now_ns(), time.monotonic()
        if not self.world.lockstep:  # what the reset itself has taken is not to make every reading old
            self.skipped_ns = time.time_ns() - self._origin_ns
        self._truths, self._staged = 0, True
        self._staged_anew()

    def _begun_with(self, scene: Scene) -> Scene:
        """The scene that the world begins with, where one was asked for."""
        return scene

    def _restage(self, payload: bytes) -> None:
        try:
            asked = json.loads(messages.decode(payload, messages.STRING).data)
            scene, part, session = asked["scene"], int(asked["part"]), str(asked["session"])
        except (ValueError, KeyError, TypeError) as error:
            remedy = "Send JSON with scene, part and session"
            raise CommandRefused(topics.WORLD, "restage", repr(error), remedy) from error
        self._refuse_foreign("restage", session)
        try:
            scene = self._begun_with(Scene.model_validate(scene))
        except ValidationError as error:
            raise CommandRefused(topics.WORLD, "restage", str(error), "Correct the scene") from error
        self.world.restage(scene, part)
        self._staged_anew()

    def _refuse_foreign(self, verb: str, session: str) -> None:
        for server in self._servers.values():
            other = server.foreign_commander(session) if isinstance(server, ArmServer) else None
            if other is not None:
                raise CommandRefused(
                    topics.WORLD, verb, f"{other} commands {server.device.name}", "Wait until its run has ended"
                )

    def _staged_anew(self) -> None:
        """Truth and frames are due from this instant on, and the gates begin where the arm now is."""
        self._next_truth_ns = self.world.now_ns() - self._origin_ns
        self._due.clear()
        self._attend()
        for server in self._servers.values():
            if isinstance(server, ArmServer):
                server.restart(np.array(self.world.scene.start))
        self._publish_truth()

    def _advance(self, payload: bytes) -> None:
        span_ns = messages.stamp_ns(messages.decode(payload, messages.DURATION))
        if not self.world.lockstep:
            raise CommandRefused(topics.WORLD, "advance", "the clock is real time", "Wait instead")
        if span_ns < 0:
            raise CommandRefused(topics.WORLD, "advance", "time does not run backwards", "Ask for a positive time")
        self.world.plant("world", "advance")
        with self.desk.together():
            self._step(span_ns)

    def _regrasp(self, payload: bytes) -> None:
        self.world.regrasp(messages.decode(payload, messages.INTEGER).data)

    def _rearrange(self, payload: bytes) -> None:
        try:
            scene = json.loads(messages.decode(payload, messages.STRING).data)
        except ValueError as error:
            raise CommandRefused(topics.WORLD, "rearrange", str(error), "Send a scene as JSON") from error
        self.world.rearrange(scene)

    def _clamp(self, payload: bytes) -> None:
        self.world.clamp(messages.decode(payload, messages.STRING).data or None)

    def _show_board(self, payload: bytes) -> None:
        try:
            shown = json.loads(messages.decode(payload, messages.STRING).data)
            board, X_W_B = shown["board"], shown["X_W_B"]
        except (ValueError, KeyError, TypeError) as error:
            remedy = "Send JSON with board and X_W_B"
            raise CommandRefused(topics.WORLD, "show a board", repr(error), remedy) from error
        self.world.show_board(board, X_W_B)

    def _inject(self, payload: bytes) -> None:
        try:
            fault = json.loads(messages.decode(payload, messages.STRING).data)
        except ValueError as error:
            raise CommandRefused(topics.WORLD, "inject a fault", str(error), "Send JSON") from error
        self.world.inject(fault)
        self._attend()

    def _clear_faults(self, _: bytes) -> None:
        self.world.clear_faults()
        self._attend()

    def _truth(self, _: bytes) -> Answer:
        return Answer(type=messages.TRUTH, data=encode_reading(self.world.truth(), self.skipped_ns))


def serve(
    config: StationConfig,
    ready: Callable[[Host], None] = lambda _: None,
    make: Callable[[StationConfig, Bus], Host] = Host,
    *,
    routing: bool = False,
) -> int:
    """Serve a simulated station in this process until SIGTERM or SIGINT; returns 0. ``make`` makes its host.

    With ``routing`` other processes of this machine may serve devices of the station, too.

    Raises NotConnected, ValueError, and InputError where it would listen to strangers.
    """
    with station_bus(config, "device", routing=routing) as bus:
        host = make(config, bus)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: host.stop())

        def serving() -> None:
            warn_unheard(config, [*config.devices, topics.WORLD])
            ready(host)

        host.run(serving)
    return 0


if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    sys.exit(hosted.main(serve))
