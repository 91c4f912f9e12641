"""An ATI Net F/T box: a six-axis force/torque sensor that speaks RDT over UDP (`drivers.real.rdt`).

What its counts mean is read from the box when it is reached, and compared with the station file. The box streams to
one client: another program that starts it takes the stream away.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from ipaddress import IPv4Address
from math import ceil
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator
from scipy.spatial.transform import Rotation

from drivers.config import ForceTorqueConfig, RealDevice
from drivers.errors import DeviceFault, DeviceTimeout, DriverError, NotConnected, ProtocolError
from drivers.interfaces import Description, ForceTorqueSensor, freshness
from drivers.real import netft_setup, rdt
from drivers.real.netft_setup import BoxSetup
from drivers.real.rdt import Command, Record, Verdict
from drivers.real.rdt_link import RdtLink
from drivers.real.tare import Tare
from drivers.registry import Driver
from drivers.scene import Vector3
from drivers.streaming import POLL, StreamingSensor
from mechanics.readings import Array, Stamp, Status, WrenchReading
from mechanics.yaml_input import Refusal

log = logging.getLogger(__name__)

NANO = 1e-9
#: how long datagrams wait for us while nobody takes the readings [s], and how many are taken then; when each arrived is
#: known all the same
LEISURE, HEAP = 0.01, 200
#: what a tare averages [s], and how many readings at least
TARE_SPAN, TARE_READINGS = 0.1, 10


class AtiNetFtConfig(RealDevice, ForceTorqueConfig, frozen=True):
    """An ATI Net F/T box. ``rate``, ``records`` and ``filter`` are what the box is set to, on its own web page."""

    driver: Literal["ati_netft"]
    model: str = Field(default="ATI Net F/T", min_length=1, description="the transducer, e.g. ATI Gamma SI-130-10")
    address: IPv4Address = Field(default=IPv4Address("192.168.1.1"), description="the box's IP address")
    port: int = Field(default=rdt.PORT, ge=1, le=65535, description="its UDP port")
    http_port: int = Field(default=80, ge=1, le=65535, description="the TCP port of its web page")
    local_port: int = Field(default=0, ge=0, le=65535, description="our own UDP port; 0: any that is free")
    timeout: float = Field(default=1.0, ge=0.05, le=10, description="how long it may be silent [s]")
    records: int = Field(default=1, ge=1, le=rdt.MOST_RECORDS, description="per datagram (its RDT buffer size)")
    filter: float | None = Field(
        default=None, ge=0, description="cut-off of its low-pass filter [Hz], 0: none; unset: not looked at"
    )
    latency: float = Field(default=0.0, ge=0, le=0.5, description="from a load to its record's arrival, as known [s]")
    rotation_deg: Vector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="how the transducer's axes lie in the sensor's frame: turned about its X, then Y, then Z [deg]",
    )
    reversed: bool = Field(default=False, description="the load hangs on the transducer's mounting side")

    @field_validator("address", mode="before")
    @classmethod
    def _written(cls, address: Any) -> Any:
        """Files have text, which strict validation takes for no address."""
        if not isinstance(address, str):
            return address
        try:
            return IPv4Address(address)
        except ValueError:
            raise Refusal(f"{address[:60]!r} is no IPv4 address", "one such as 192.168.1.1") from None

    @field_validator("address")
    @classmethod
    def _of_one_machine(cls, address: IPv4Address) -> IPv4Address:
        if address.is_unspecified or address.is_multicast or address == IPv4Address("255.255.255.255"):
            raise Refusal(f"{address} is no machine's", "the box's own address, such as 192.168.1.1")
        return address

    @field_validator("filter")
    @classmethod
    def _of_the_box(cls, cut_off: float | None) -> float | None:
        known = sorted(netft_setup.FILTERS.values())
        if cut_off is not None and cut_off not in known:
            raise Refusal(f"it has no filter of {cut_off:g} Hz", f"one of {', '.join(f'{hz:g}' for hz in known)}")
        return cut_off


@dataclass(frozen=True)
class RdtCounts:
    """What has come since connecting.

    ``readings`` were given out, ``faulty`` of them with a status other than OK. ``lost`` never came, ``late`` came
    after a newer one and was dropped (the device's `gaps` count both), ``duplicate`` came twice, ``stray`` had
    numbers of no stream, ``malformed`` had another length, ``alien`` came from somewhere else. ``restarts`` counts
    streams that began anew without being asked.
    """

    readings: int = 0
    faulty: int = 0
    lost: int = 0
    late: int = 0
    duplicate: int = 0
    stray: int = 0
    malformed: int = 0
    alien: int = 0
    restarts: int = 0


class AtiNetFt(StreamingSensor[WrenchReading], ForceTorqueSensor):
    """A Net F/T box as a sensor. Its frame embeds the plane as the simulated one's does: X right, Z up, Y away.

    The box reports what acts on the transducer's tool side, which is the sign of `WrenchReading`. Over a silence the
    box's numbers tell nothing; how many readings it lasted, and so how many were lost, is told by the clock then.
    """

    def __init__(self, name: str, config: AtiNetFtConfig):
        super().__init__(name, buffer=max(4096, ceil(5 * config.rate)))
        self._config = config
        self.max_age = freshness(config.rate)
        self._peer = (str(config.address), config.port)
        self._place = f"{config.address}:{config.port}"
        # a slow stream is silent between its datagrams
        self._patience = max(config.timeout, 6 * config.records / config.rate)
        turn = Rotation.from_euler("xyz", config.rotation_deg, degrees=True).as_matrix()
        self._turn = np.kron(np.eye(2), -turn if config.reversed else turn)
        self._link: RdtLink | None = None
        self._box: BoxSetup | None = None
        self._tare_turn = threading.Lock()
        self._tare: Tare | None = None
        self._sequence = rdt.Sequence()
        self._heard = 0.0
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._box = None
        self._zero = np.zeros(6)
        self._tally = dict.fromkeys(vars(RdtCounts()), 0)
        self._word = 0
        self._logged = {0}
        self._last: Stamp | None = None

    def describe(self) -> Description:
        """``extra`` holds the mount, the sensor's pose in the ee (wrist) or in W (table), and the box's address."""
        config = self._config
        return Description(
            name=self.name,
            kind="force_torque",
            model=config.model,
            backend="real",
            serial=config.serial or "unknown",
            frame=self.name,
            rate=config.rate,
            extra={"mount": config.mount, "pose": list(config.pose), "address": str(config.address)},
        )

    # -- what it says of itself ------------------------------------------------------------------------------------

    @property
    def box(self) -> BoxSetup | None:
        """How the box is set up; None until it has been reached."""
        return self._box

    @property
    def condition(self) -> tuple[str, ...]:
        """What the box's newest status word says, in words; () where all is well."""
        return rdt.told(self._word)

    @property
    def counts(self) -> RdtCounts:
        """What has come since connecting, and what has not."""
        with self._arrived:
            return RdtCounts(**self._tally | {"lost": self._gaps - self._tally["late"]})

    @property
    def measured_rate(self) -> float | None:
        """Readings per second of late [Hz], by when they were measured; None before there are two."""
        with self._arrived:
            stamps = [reading.stamp for reading in self._readings]
        if len(stamps) < 2:
            return None
        return (len(stamps) - 1) / ((stamps[-1].capture_ns - stamps[0].capture_ns) * NANO)

    # -- StreamingSensor -------------------------------------------------------------------------------------------

    def _open(self, timeout: float) -> None:
        self._begin_anew()
        super()._open(timeout)

    def _begin(self, timeout: float) -> None:
        deadline = time.monotonic() + timeout
        self._take_setup(self._read_setup(deadline))
        self._bind()
        # more than this cannot be missing at once: by then it was silent for too long
        self._sequence = rdt.Sequence(dropout=100 + ceil(2 * self._patience * self._config.rate))
        start = Command.START if self._config.records == 1 else Command.START_BUFFERED
        given, begun, again = self._tally["readings"], time.monotonic(), 0.0
        self._heard = begun
        while self._tally["readings"] == given:
            now = time.monotonic()
            if now > min(deadline, begun + self._patience):
                raise self._silence("connect", now - begun)
            if self._closing.is_set():
                raise NotConnected(self.name, "connect", "it was closed meanwhile", "Open it again")
            asking = now >= again  # more than once: a request may be lost as well
            again = now + self._patience / 3 if asking else again
            self._receive(start if asking else None)
        if broken := rdt.faults(self._word) & ~rdt.SATURATED:
            words = ", ".join(rdt.told(broken))
            raise DeviceFault(self.name, "connect", f"the box at {self._place} reports: {words}", self._see_page())

    def _poll(self) -> None:
        if self._tare is not None or self._needed:
            self._receive()
        else:  # to be woken for each of a thousand a second costs more than to read them
            self._closing.wait(LEISURE)
            taken = 0
            while taken < HEAP and self._receive(wait=False):
                taken += 1
        silent = time.monotonic() - self._heard
        if silent > self._patience:
            raise self._silence("read", silent)

    def _end(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    # -- reaching the box ------------------------------------------------------------------------------------------

    def _read_setup(self, deadline: float) -> BoxSetup:
        config = self._config
        address, port = str(config.address), config.http_port
        asked = f"connect to http://{address}:{port}{netft_setup.PAGE}"
        look = f"Check `address` ({address}) and `http_port`, the box's power and its cable"
        begun = time.monotonic()
        try:
            document = netft_setup.fetch(address, port, min(deadline, begun + config.timeout), self._closing.is_set)
        except TimeoutError as error:
            got = f"no answer within {time.monotonic() - begun:.2g} s"
            raise DeviceTimeout(self.name, asked, got, look) from error
        except OSError as error:
            raise NotConnected(self.name, asked, error.strerror or str(error), look) from error
        except netft_setup.HttpError as error:
            raise ProtocolError(self.name, asked, str(error), f"{look}; is this a Net F/T box?") from error
        try:
            return netft_setup.parse(document)
        except netft_setup.SetupError as error:
            raise ProtocolError(self.name, asked, f"the setup is unusable: {error}", self._see_page()) from error

    def _take_setup(self, box: BoxSetup) -> None:
        config, wrong = self._config, []
        for key, here, there in (
            ("serial", config.serial or None, box.serial),
            ("records", config.records, box.records),
            ("filter", config.filter, box.filter),
        ):
            if here is not None and there is not None and here != there:
                wrong.append(f"`{key}` is {here} in the station file and {there or 'nothing'} at the box")
        if box.rate is not None and abs(box.rate / config.rate - 1) > 0.02:
            wrong.append(f"`rate` is {config.rate:g} Hz in the station file and {box.rate:g} Hz at the box")
        if box.rdt is False:
            wrong.append("RDT is switched off at the box")
        if wrong:
            remedy = f"Set it on the box's page http://{config.address}/, or correct the station file"
            raise NotConnected(self.name, "connect", "; ".join(wrong), remedy)
        if self._box is not None and (changed := box.differs(self._box)):
            got = f"while it was away, the box at {self._place} was set up otherwise: {', '.join(changed)}"
            raise DeviceFault(self.name, "read", got, "Close it, open it again, and tare it anew")
        self._box = box
        scale = np.repeat([box.force, box.torque], 3)
        self._from_counts: Array = self._turn * scale
        self._full_scale = box.full_scale

    def _bind(self) -> None:
        port = self._config.local_port
        try:
            self._link = RdtLink(self._peer, port, POLL)
        except OSError as error:
            asked = f"receive from {self._place} at local UDP port {port or '(any)'}"
            remedy = "Check the network, and that no other program has this `local_port`; 0 takes any that is free"
            raise NotConnected(self.name, asked, error.strerror or str(error), remedy) from error

    def _silence(self, asked: str, seconds: float) -> DriverError:
        odd = self._tally["malformed"]
        other = f"; {odd} datagrams of another length came: see `records`" if odd else ""
        return DeviceTimeout(
            self.name,
            asked,
            f"no reading from {self._place} for {seconds:.2g} s{other}",
            "Check the box's power and cable, and that no other program takes its stream",
        )

    def _see_page(self) -> str:
        return f"See the box's own page at http://{self._config.address}/; switch it off and on again"

    # -- receiving -------------------------------------------------------------------------------------------------

    def _receive(self, ask: Command | None = None, wait: bool = True) -> bool:
        """Take a datagram that comes within `POLL` (``wait``) or is here; whether one was. ``ask`` for it first."""
        assert self._link is not None
        try:
            if ask is not None:
                self._link.ask(ask)
            arrived = self._link.receive(wait)
        except OSError as error:
            got = error.strerror or str(error)
            raise NotConnected(self.name, f"receive from {self._place}", got, "Check the network") from error
        if arrived is None:
            return False
        self._accept(*arrived)
        return True

    def _accept(self, datagram: bytes, source: tuple[str, int], arrival_ns: int) -> None:
        if source != self._peer:
            self._tally["alien"] += 1
            return
        try:
            records = rdt.decode(datagram, self._config.records)
        except ValueError:
            self._tally["malformed"] += 1
            with self._arrived:
                self._corrupt += 1
            return
        last = len(records) - 1
        for i, record in enumerate(records):
            self._take(record, arrival_ns - round((self._config.latency + (last - i) / self._config.rate) / NANO))

    def _take(self, record: Record, capture_ns: int) -> None:
        verdict = self._sequence.take(record.rdt_sequence, record.ft_sequence)
        if verdict in _DROPPED:
            self._tally[_DROPPED[verdict]] += 1
            return
        if verdict is Verdict.UNCONFIRMED:
            return
        self._heard = time.monotonic()
        self._word = record.status
        if record.status not in self._logged:  # once per connection: it may come and go a thousand times a second
            self._logged.add(record.status)
            log.warning("%s: the box at %s reports: %s", self.name, self._place, ", ".join(self.condition))
        sequence, last = 0, self._last
        if last is not None:
            new_stream = verdict in (Verdict.FIRST, Verdict.RESTARTED)
            lasted = round((capture_ns - last.capture_ns) * NANO * self._config.rate)
            sequence = last.sequence + (max(1, lasted) if new_stream else self._sequence.step)
            capture_ns = max(capture_ns, last.capture_ns + 1)
        status = self._status(record, verdict)
        stamp = Stamp(capture_ns, max(time.time_ns(), capture_ns), sequence, self.name, status)
        wrench = self._from_counts @ np.array(record.counts, float)
        self._last = stamp
        self._tally["restarts"] += verdict is Verdict.RESTARTED
        self._tally["readings"] += 1
        self._tally["faulty"] += status is not Status.OK
        zero = self._gather(wrench, status, record.status)
        self._push(WrenchReading(stamp, wrench - zero))

    def _status(self, record: Record, verdict: Verdict) -> Status:
        broken = rdt.faults(record.status)
        if broken & ~rdt.SATURATED:
            return Status.INVALID
        if broken or any(abs(count) > most for count, most in zip(record.counts, self._full_scale, strict=False)):
            return Status.SATURATED
        return Status.STALE if verdict is Verdict.REPEATED else Status.OK

    # -- tare ------------------------------------------------------------------------------------------------------

    def tare(self) -> None:
        """As `ForceTorqueSensor.tare`: the mean of the readings of the next 0.1 s, ten at least, in this process.

        The box's own bias stays as it is: others may read it, and it is lost when the box is switched off. Raises
        DeviceFault where the sensor is saturated or faulty meanwhile, and what it is in trouble with.
        """
        self._need_connection("tare")
        self._raise_trouble()
        tare = Tare(max(TARE_READINGS, round(TARE_SPAN * self._config.rate)))
        patience = self._patience + 2 * tare.wanted / self._config.rate
        until = time.monotonic() + patience
        with self._tare_turn, self._arrived:
            self._tare = tare
            try:
                while not tare.done:
                    left = until - time.monotonic()
                    if left <= 0:
                        got = f"{len(tare.loads)} of {tare.wanted} readings within {patience:.2g} s"
                        raise DeviceTimeout(self.name, "tare", got, "Check `extrinsic status STATION`")
                    self._arrived.wait(left)
                    self._raise_trouble()
                    if not self.connected:
                        raise NotConnected(self.name, "tare", "the device was closed meanwhile", "Open it again")
            finally:
                self._tare = None
        if tare.refused:
            raise DeviceFault(self.name, "tare", tare.refused, f"Take the load away. {self._see_page()}")

    def _gather(self, wrench: Array, status: Status, word: int) -> Array:
        """The zero of a reading; with the last one that a tare has waited for, the tare is done."""
        with self._arrived:
            if self._tare is not None:
                said = "" if status is Status.OK else ", ".join(rdt.told(word)) or "beyond the calibrated range"
                if self._tare.take(wrench, status, said):
                    self._zero = self._tare.zero
            return self._zero


_DROPPED = {Verdict.DUPLICATE: "duplicate", Verdict.LATE: "late", Verdict.STRAY: "stray"}

DRIVER = Driver(AtiNetFtConfig, AtiNetFt)
