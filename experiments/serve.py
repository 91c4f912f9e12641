"""`extrinsic serve` and `extrinsic emulate`: a station's devices on the bus, by whatever makes them."""

from __future__ import annotations

from drivers.config import StationConfig
from experiments.terminal import terminal
from mechanics.yaml_input import InputError, Problem


def serve(config: StationConfig, *, insecure: bool = False) -> int:
    """Serve a station until SIGTERM or SIGINT: simulated, of real devices, or an emulated lab. Returns the exit code.

    ``insecure`` lets it listen without keys where other machines can reach it. Raises NotConnected, and InputError
    where it would let strangers in.
    """
    if insecure:
        config = config.model_copy(update={"bus": config.bus.model_copy(update={"insecure": True})})
    what = f"serving {', '.join(config.devices)} at {config.bus.endpoint}; Ctrl-C ends it"

    def ready(*_: object) -> None:
        terminal(stderr=True).print(what, highlight=False, soft_wrap=True)

    if config.simulated:
        from drivers.sim import host

        return host.serve(config, ready)
    if config.world is not None:
        from drivers.emulators import lab

        return lab.serve(config, ready)
    from drivers import device_host

    return device_host.serve(config, ready)


def emulate(config: StationConfig) -> int:
    """As `serve`, of an emulated lab. Raises InputError for a station that is none."""
    if config.world is None or config.simulated:
        wrong = f"station {config.name!r} is {'simulated' if config.simulated else 'real'}: there is nothing to emulate"
        raise InputError(
            [Problem("station", None, "", wrong, "backend: real beside a world, as emulated_lab has them")]
        )
    return serve(config)
