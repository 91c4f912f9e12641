"""A simulated station hosted by a thread of the process that uses it: no start of another process, no imports anew.

For a process that runs one station after the other and may die with it, as a campaign's worker. Everything else goes
over the bus as with `drivers.hosting.HostProcess`: same messages, same order, same figures.
"""

from __future__ import annotations

import logging
import os
import threading
import traceback
from typing import Self

from drivers import hosting
from drivers.config import StationConfig
from drivers.errors import DriverError, NotConnected
from drivers.sim.host import Host
from drivers.wire.bus import Bus
from drivers.wire.station_bus import station_bus

log = logging.getLogger(__name__)

_stuck: list[threading.Thread] = []


def stuck() -> bool:
    """Whether a host of this process did not end when it was closed, and still takes its processor."""
    _stuck[:] = [thread for thread in _stuck if thread.is_alive()]
    return bool(_stuck)


class Crash(BaseException):
    """The fault ``crash``: it ends the thread that owns the world, whatever that is in the midst of."""


def _crash() -> None:
    raise Crash("the simulated world has crashed")


class HostThread(hosting.StationHost):
    """The simulated station in a thread of this process; started by `__enter__`, ended and joined by `close`.

    It listens at the station's endpoint as ever; who is in this process shares its session, and hears what it publishes
    in the thread that owns the world. When the thread fails, its devices vanish from the bus, as those of a process
    that has died; `last_words` tells why. It installs no signal handlers. A thread cannot be killed: one that does not
    end is cut off from the bus and left behind (`stuck`); its process should not start another.
    """

    def __init__(self, config: StationConfig):
        self._config = config
        self._settled = threading.Event()  # serving, or failed
        self._closing = self._killed = False
        self._bus: Bus | None = None
        self._host: Host | None = None
        self._thread: threading.Thread | None = None
        self._failure: DriverError | None = None
        self._said = ""

    @property
    def pid(self) -> int:
        """This process's id. Raises NotConnected when the host is not running."""
        if self._thread is None:
            raise NotConnected(self._config.name, "name its host's process", "there is none", "")
        return os.getpid()

    @property
    def bus(self) -> Bus | None:
        """Its session; None while it is not running."""
        return self._bus

    def __enter__(self) -> Self:
        config, asked = self._config, "start its simulated host"
        remedy = "Run `extrinsic serve STATION` to see what it says"
        try:
            self._bus = station_bus(config, "device", at_once=True)
            self._thread = threading.Thread(
                target=self._serve, args=(self._bus,), name=f"host {config.name}", daemon=True
            )
            self._thread.start()
            if not self._settled.wait(hosting.HOST_READY):
                raise NotConnected(config.name, asked, f"not ready within {hosting.HOST_READY:g} s", remedy)
            if self._failure is not None:
                raise NotConnected(config.name, asked, "it failed", remedy, children=(self._failure,))
        except BaseException:
            self.close()
            raise
        return self

    def _serve(self, bus: Bus) -> None:
        try:
            self._host = host = Host(self._config, bus, _crash)
            if not self._closing:  # set before `close` looks for the host
                host.run(self._settled.set, self._note)
        except BaseException as error:
            self._note(error)
        finally:
            self._host = None
            self._settled.set()

    def _note(self, error: BaseException) -> None:
        """Keep what is to be said of the first failure, and none of what its frames hold."""
        if self._failure is not None or self._killed:  # whoever takes its bus away knows why it fails
            return
        self._said = "".join(traceback.format_exception(error)).rstrip()
        known = isinstance(error, DriverError)
        self._failure = NotConnected(
            error.device if known else "world",
            error.asked if known else "serve",
            error.got if known else str(error) or type(error).__name__,
            error.remedy if known else "",
        )
        if isinstance(error, Crash):  # somebody wanted it
            log.warning("host: %s", error)
        else:
            log.error("host: %s", self._said)

    def kill(self) -> None:
        """Take it off the bus at once; its thread ends with the step that it is in."""
        self._closing = self._killed = True
        self._stop()
        if self._bus is not None:
            self._bus.close()

    def last_words(self) -> str:
        """Why it failed; empty for one that did not."""
        return self._said

    def close(self) -> None:
        """Ask the host to end, join its thread and close its session; idempotent."""
        thread, self._thread = self._thread, None
        self._closing = True
        if thread is not None:
            self._stop()
            thread.join(hosting.HOST_STOP)
            if thread.is_alive():
                self._said = f"the simulated host did not end within {hosting.HOST_STOP:g} s and was left behind"
                log.error(self._said)
                _stuck.append(thread)
                self._killed = True
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.close()

    def _stop(self) -> None:
        host = self._host
        if host is not None:
            host.stop()
