"""Puts a device of this process on the bus: its readings as streams, its commands as queries with a typed reply."""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Self

import numpy as np

from drivers.errors import (
    CommandRefused,
    DeviceFault,
    DeviceTimeout,
    DriverError,
    NotConnected,
    ProtocolError,
    SimulationDiverged,
)
from drivers.interfaces import Device, ForceTorqueSensor, Gripper, ImagingSensor, Sensor, TactileSensor, TagCamera
from drivers.streaming import StreamingSensor
from drivers.wire import messages, topics
from drivers.wire.bus import Bus, Query
from drivers.wire.codec import Reading, encode_compressed, encode_reading
from drivers.wire.lease import TIME_TO_LIVE
from drivers.wire.streams import Outbox, Publisher, ViewRates
from mechanics.readings import ImageReading, Stamp

log = logging.getLogger(__name__)

_RUINS = b"\xff\xff\xff\xff\xff\xff\xff"
"""Bytes that no type decodes: stands for a damaged message of the device, whose own bytes the bus does not carry."""

_VIEWS = ViewRates()

OUTCOMES: tuple[tuple[int, type[DriverError]], ...] = (
    (1, CommandRefused),
    (6, SimulationDiverged),
    (2, DeviceFault),
    (3, DeviceTimeout),
    (4, NotConnected),
    (5, ProtocolError),
)
"""Reply.outcome of each error, the particular before the general; 0 is success."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What a verb returns: JSON ``text``, or a reading as ``data`` of message type ``type``."""

    text: str = ""
    type: str = ""
    data: bytes = b""


Work = Callable[[], None]
Run = Callable[[Work, bool], None]
Verb = Callable[[bytes], Answer | None]


class Lane:
    """The default way to run work: at once, in the thread that brings it, one piece at a time.

    Urgent work (stop, hold) does not wait for its turn.
    """

    def __init__(self) -> None:
        self._turn = threading.Lock()

    def __call__(self, work: Work, urgent: bool) -> None:
        """Run ``work`` and return when it is done."""
        if urgent:
            work()
        else:
            with self._turn:
                work()


class Desk:
    """What the servers of one process share: the bus, the thread that owns the devices, the clock, the streams.

    ``run(work, urgent)`` has ``work`` executed by the owner of the devices. ``now_ns()`` is the station's time, and
    ``steady_ns()`` that of a clock that nobody sets, for silences; by default the same. ``shift_ns()`` is added to
    every capture time. In ``lockstep`` time stands still while nobody asks for more. ``lease`` [s] is how long a
    commander may be silent before it loses its arm. ``views`` are the rates of what viewers get.
    """

    def __init__(
        self,
        bus: Bus,
        station: str,
        *,
        run: Run | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        steady_ns: Callable[[], int] | None = None,
        shift_ns: Callable[[], int] = lambda: 0,
        lockstep: bool = False,
        lease: float = TIME_TO_LIVE,
        views: ViewRates = _VIEWS,
    ):
        self.bus, self.station, self.now_ns, self.shift_ns = bus, station, now_ns, shift_ns
        self.steady_ns = steady_ns or now_ns
        self.run: Run = run or Lane()
        self.lockstep, self.lease, self.views = lockstep, lease, views
        self.publishers: list[Publisher] = []
        self._outbox = Outbox()

    def publisher(self, device: str, stream: str, type_name: str) -> Publisher:
        """Announce a stream and its view. All of a stream arrives; viewers take the view, and hold up nobody."""
        pictures = type_name in (messages.IMAGE, messages.COMPRESSED_IMAGE)
        view_rate = self.views.images if pictures else self.views.readings
        publisher = self.bus.publisher(topics.key(self.station, device, stream), type_name, view_rate)
        publisher.outbox = self._outbox
        for old in [known for known in self.publishers if known.topic == publisher.topic]:
            # a device that comes back goes on with its stream
            publisher.count, publisher.newest = old.count, old.newest
            self.publishers.remove(old)
        self.publishers.append(publisher)
        return publisher

    def serve(
        self, device: str, verb: str, work: Verb, *, urgent: bool = False, direct: bool = False
    ) -> Callable[[], None]:
        """Answer a verb by ``work``, in the owner's thread, or in the bus's (``direct``); returns the way to stop."""

        def handle(query: Query) -> None:
            def answer() -> None:
                query.reply(self._reply(device, verb, lambda: work(query.payload), [] if direct else self.publishers))

            if direct:
                answer()
            else:
                self.run(answer, urgent)

        return self.bus.serve(topics.key(self.station, device, verb), handle)

    @contextlib.contextmanager
    def together(self) -> Iterator[None]:
        """What the owner's thread publishes meanwhile leaves at the end of it, or before the next reply."""
        self._outbox.open = True
        try:
            yield
        finally:
            self._outbox.open = False
            self._outbox.send()

    def counts(self) -> dict[str, int]:
        """Messages published per topic since `restart`."""
        return {publisher.topic: publisher.count for publisher in self.publishers}

    def restart(self) -> None:
        """Count anew."""
        for publisher in self.publishers:
            publisher.count = 0

    def _reply(self, device: str, verb: str, work: Callable[[], Answer | None], streams: list[Publisher]) -> bytes:
        """Run a verb; whatever happens, there is a reply, for an empty one looks like death."""
        counts = [publisher.count for publisher in streams]
        outcome, error, done = 0, DriverError("", "", "", ""), Answer()
        try:
            done = work() or Answer()
        except DriverError as problem:
            error = problem
            outcome = next(number for number, kind in OUTCOMES if isinstance(problem, kind))
        except Exception as problem:
            log.exception("%s: %s failed", device, verb)
            error = DeviceFault(device, verb, f"{type(problem).__name__}: {problem}", "This is a defect; report it")
            outcome = 2
        if streams and self._outbox.open:  # urgent work, in the midst of something longer
            self._outbox.send()
        published = [
            messages.message("extrinsic_msgs/msg/Progress", topic=publisher.topic, sequence=publisher.newest)
            for publisher, before in zip(streams, counts, strict=False)
            if publisher.count > before
        ]
        return messages.encode(
            messages.message(
                messages.REPLY,
                outcome=outcome,
                device=error.device,
                asked=error.asked,
                got=error.reason if isinstance(error, CommandRefused) else error.got,
                remedy=error.remedy,
                recoverable=isinstance(error, DeviceFault) and error.recoverable,
                now_ns=self.now_ns(),
                text=done.text,
                type=done.type,
                data=np.frombuffer(done.data, np.uint8),
                published=published,
            )
        )


class DeviceServer:
    """A device on the bus: a context manager that opens the device and closes it again."""

    def __init__(self, desk: Desk, device: Device):
        self.desk, self.device = desk, device
        self._stops: list[Callable[[], None]] = []
        self._streams: dict[str, Publisher] = {}
        self._withdraw: Callable[[], None] = lambda: None

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def open(self) -> None:
        """Connect the device, announce its streams, answer its verbs; then say that it is alive."""
        device, description = self.device, self.device.describe()
        device.connect()
        for stream, type_name in topics.streams_of(description.kind, description.extra.get("sensor", "")).items():
            self._streams[stream] = self.desk.publisher(device.name, stream, type_name)
        if isinstance(device, Sensor):
            self._stops.append(device.listen(self._publish, self._publish_ruins))
        if isinstance(device, StreamingSensor):
            device.wanted = lambda: self._taken() or device.heard_beside(self._publish)
        self._serve("describe", lambda _: Answer(json.dumps(asdict(self.device.describe()))), direct=True)
        self._verbs()
        self._withdraw = self.desk.bus.token(topics.alive(self.desk.station, device.name))

    def close(self) -> None:
        """Withdraw from the bus and close the device, which holds an arm; idempotent."""
        stops, self._stops = self._stops, []
        for stop in reversed(stops):
            stop()
        self._withdraw()
        self._withdraw = lambda: None
        self.device.close()  # before its streams: a device with a thread of its own looks who takes them
        if isinstance(self.device, StreamingSensor):
            self.device.wanted = lambda: True
        for publisher in self._streams.values():
            publisher.close()
        self._streams = {}

    def _serve(self, verb: str, work: Verb, *, urgent: bool = False, direct: bool = False) -> None:
        self._stops.append(self.desk.serve(self.device.name, verb, work, urgent=urgent, direct=direct))

    def _verbs(self) -> None:
        device = self.device
        if isinstance(device, Sensor):
            self._serve("health", lambda _: self._health(device), direct=True)
        if isinstance(device, ForceTorqueSensor):
            self._serve("tare", lambda _: device.tare())
        if isinstance(device, Gripper):
            self._serve("grasp", lambda payload: device.grasp(messages.decode(payload, messages.FLOAT).data))
            self._serve("release", lambda _: device.release())
        if isinstance(device, ImagingSensor):
            self._serve("capture", lambda _: Answer(json.dumps(self.capture())))
        if isinstance(device, TagCamera):
            self._serve("image", lambda _: _picture(device.image()))
        if isinstance(device, TactileSensor):
            self._serve("reference", lambda _: self._reference(device))

    def _health(self, device: Sensor) -> Answer:
        """What a view cannot tell: what was lost before it came here, or could not be read, since the device opened."""
        return Answer(json.dumps({"gaps": device.gaps, "corrupt": device.corrupt}))

    def capture_if_wanted(self) -> None:
        """Take a frame if somebody listens: the stream of a camera that has no thread of its own.

        A frame that does not come is missing from the stream, where its readers notice.
        """
        if self._taken():
            with contextlib.suppress(DriverError):
                self.capture()

    def _taken(self) -> bool:
        """Whether anybody takes the device's readings now."""
        return any(publisher.matched for stream, publisher in self._streams.items() if stream != "reference")

    def capture(self) -> int:
        """Take a frame; its reading and its picture go out as streams. Returns its sequence number."""
        device = self.device
        assert isinstance(device, ImagingSensor)
        reading = device.capture()
        if not isinstance(device, StreamingSensor):
            self._put_picture_of(device)
        return reading.stamp.sequence

    def _publish(self, reading: Reading) -> None:
        if isinstance(reading, ImageReading):
            self._put_picture(reading)
            return
        if isinstance(self.device, StreamingSensor):  # a camera that sends by itself
            self._put_picture_of(self.device)
        publisher = next(iter(self._streams.values()), None)
        if publisher is not None and publisher.matched:
            shift, stamp = self.desk.shift_ns(), reading.stamp
            publisher.put(encode_reading(reading, shift), stamp.sequence, stamp.capture_ns + shift, int(stamp.status))

    def _publish_ruins(self, stamp: Stamp) -> None:
        """A message of the device that could not be read arrives at the other end as what it is."""
        publisher = next(iter(self._streams.values()), None)
        if publisher is not None and publisher.matched:
            publisher.put(_RUINS, stamp.sequence, stamp.capture_ns + self.desk.shift_ns(), int(stamp.status))

    def _put_picture_of(self, device: Device) -> None:
        """The picture behind a tag camera's newest reading."""
        if isinstance(device, TagCamera) and self._streams["image"].matched:
            picture = device.image()
            if picture is not None:
                self._put_picture(picture)

    def _put_picture(self, picture: ImageReading) -> None:
        publisher = self._streams["image"]
        if publisher.matched:
            shift, stamp = self.desk.shift_ns(), picture.stamp
            encode = encode_reading if publisher.type_name == messages.IMAGE else encode_compressed
            publisher.put(encode(picture, shift), stamp.sequence, stamp.capture_ns + shift, int(stamp.status))

    def _reference(self, device: TactileSensor) -> Answer:
        """The picture of the untouched finger: for who asks, and as a stream, so that the log has it."""
        picture, now_ns = device.reference(), self.desk.now_ns()
        encoding = "bgr8" if picture.ndim == 3 else "16UC1" if picture.dtype == np.uint16 else "mono8"
        stamp = Stamp(now_ns, now_ns, 0, device.describe().frame)
        data = encode_reading(ImageReading(stamp, picture, encoding))
        stream = self._streams["reference"]
        if stream.matched:
            stream.put(data, stream.newest + 1, now_ns)
        return Answer(type=messages.IMAGE, data=data)


def _picture(picture: ImageReading | None) -> Answer | None:
    return None if picture is None else Answer(type=messages.IMAGE, data=encode_reading(picture))
