"""What devices share that speak by themselves: a thread that reads them, and what happens when they fall silent."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from drivers.errors import DeviceFault, DeviceTimeout, DriverError
from drivers.interfaces import ImagingSensor, R, Sensor

#: how long a poll may wait for input: as long as closing may have to wait for it [s]
POLL = 0.2
#: between two attempts to reach a device that has gone [s]
RETRY = 0.5
_JOIN = 5.0


class StreamingSensor(Sensor[R]):
    """A sensor that is read by a thread of its own while it is open, and sought again after it has gone.

    A backend has `_begin` (reach the device), `_poll` (take what has come) and `_end` (let go); they are never called
    at the same time. Where `_begin` or `_poll` raises a DriverError, the sensor is in trouble: `latest` and `since`
    raise it, until `_begin` has succeeded again. Sequence numbers go on meanwhile: a backend says with them what is
    missing.
    """

    def __init__(self, name: str, buffer: int = 4096):
        super().__init__(name, buffer)
        self._closing = threading.Event()
        self._reader: threading.Thread | None = None
        self._trouble: DriverError | None = None
        #: how often the device was reached again after it had gone
        self.reconnections = 0
        #: whether anybody takes its readings; of frames that nobody takes a camera makes none
        self.wanted: Callable[[], bool] = lambda: True
        self._asks = 0  # of those who wait for a reading themselves

    # -- a backend's own -------------------------------------------------------------------------------------------

    @abstractmethod
    def _begin(self, timeout: float) -> None:
        """Reach the device. Raises NotConnected, DeviceTimeout, ProtocolError, DeviceFault within ``timeout`` [s]."""

    @abstractmethod
    def _poll(self) -> None:
        """Wait for `POLL` at most, and `_push` what has come. Raises DriverError when the device has gone."""

    @abstractmethod
    def _end(self) -> None:
        """Let go of the device, however it is; idempotent."""

    # -- Device ----------------------------------------------------------------------------------------------------

    def _open(self, timeout: float) -> None:
        self._forget()
        self._trouble = None
        self._closing.clear()
        try:
            self._begin(timeout)
        except BaseException:
            self._end()
            raise
        self._reader = threading.Thread(target=self._read, args=(timeout,), name=f"{self.name} reader", daemon=True)
        self._reader.start()

    def _shut(self) -> None:
        self._closing.set()
        reader, self._reader = self._reader, None
        if reader is not None and reader is not threading.current_thread():
            reader.join(timeout=_JOIN)
        self._end()

    def _read(self, timeout: float) -> None:
        there = True
        while not self._closing.is_set():
            try:
                if not there:
                    self._begin(timeout)
                    there = True
                    self.reconnections += 1
                    self._in_trouble(None)
                self._poll()
            except DriverError as error:
                there = False
                self._gone(error)
            except Exception as error:  # a defect is told, like a device's; the thread lives on
                there = False
                what = f"{type(error).__name__}: {error}"
                self._gone(DeviceFault(self.name, "read", what, "This is a defect; report it"))

    def _gone(self, error: DriverError) -> None:
        self._in_trouble(error)
        with suppress(DriverError):
            self._end()
        self._closing.wait(RETRY)

    def _in_trouble(self, error: DriverError | None) -> None:
        with self._arrived:
            self._trouble = error
            self._arrived.notify_all()

    # -- Sensor ----------------------------------------------------------------------------------------------------

    @property
    def trouble(self) -> DriverError | None:
        """Why nothing comes at present; None while the device is there."""
        return self._trouble

    def latest(self, timeout: float = 1.0) -> R:
        """As `Sensor.latest`; raises what the device is in trouble with as soon as it is known."""
        try:
            return super().latest(timeout)
        except DeviceTimeout:
            self._raise_trouble()
            raise

    def since(self, capture_ns: int) -> list[R]:
        """As `Sensor.since`; raises what the device is in trouble with."""
        readings = super().since(capture_ns)
        self._raise_trouble()
        return readings

    @property
    def _needed(self) -> bool:
        """Whether a reading has to be made of what has come."""
        return self._asks > 0 or self.wanted()

    @contextmanager
    def _asking(self) -> Iterator[None]:
        """Readings are needed meanwhile, whoever takes the stream."""
        with self._arrived:
            self._asks += 1
        try:
            yield
        finally:
            with self._arrived:
                self._asks -= 1

    def _pass_by(self, sequence: int) -> None:
        """What nobody needed has gone by, and is not lost."""
        with self._arrived:
            self._last_sequence = sequence

    def _raise_trouble(self) -> None:
        trouble = self._trouble
        if trouble is not None:
            raise trouble

    def _station_ns(self) -> int:
        return time.time_ns()

    def _await(self, newest, timeout, check=lambda: None) -> None:
        self._raise_trouble()
        super()._await(newest, timeout, lambda: (check(), self._raise_trouble()))


class StreamingImager(StreamingSensor[R], ImagingSensor[R]):
    """A streaming sensor whose readings are frames, or of frames."""

    def capture(self, timeout: float = 2.0) -> R:
        """A reading of a frame exposed at or after this call, by its capture time.

        Raises DeviceTimeout, and what the device is in trouble with.
        """
        self._need_connection("capture")
        asked, deadline = time.time_ns(), time.monotonic() + timeout
        with self._asking(), self._arrived:
            while not (self._readings and self._readings[-1].stamp.capture_ns >= asked):
                self._raise_trouble()
                self._need_connection("capture")
                left = deadline - time.monotonic()
                if left <= 0:
                    raise DeviceTimeout(
                        self.name, "capture", f"no frame within {timeout:g} s", "Check `extrinsic status STATION`"
                    )
                self._arrived.wait(left)
            return self._readings[-1]
