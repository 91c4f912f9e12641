"""A live station as a Rerun recording: what it says, as it says it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from drivers.config import StationConfig
from drivers.onlooker import Onlooker
from drivers.scene import Scene as Staged
from experiments.view.layout import layout
from experiments.view.scene import Bodies
from experiments.view.sheet import Sheet
from experiments.view.show import Show

if TYPE_CHECKING:
    import rerun as rr

_ROUND = 0.05  # as often as a view comes
_AGAIN = 2.0  # how often the station is asked what stands on its table


def follow(
    onlooker: Onlooker,
    recording: rr.RecordingStream,
    going: Callable[[], bool],
    tell: Callable[[str], None] = lambda _: None,
) -> int:
    """Show what comes until ``going`` says no, or the station has gone; returns how many messages came."""
    config = onlooker.config
    sheet = Sheet(recording, clock=config.world is None or config.world.clock != "lockstep")
    show = Show(sheet, Bodies({}, np.zeros(3)))
    show.sensors |= {name for name, device in config.devices.items() if device.kind == "force_torque"}
    show.arms |= {name for name, device in config.devices.items() if device.kind == "arm"}
    pictures = [name for name, device in config.devices.items() if device.kind in ("tactile", "tag_camera")]
    staged: Staged | None = None
    asked, heard = -_AGAIN, False
    recording.send_blueprint(layout(show, live=True, images=pictures))
    while going():
        if time.monotonic() - asked >= _AGAIN:
            now = onlooker.scene()
            asked = time.monotonic()
            if now is not None and now != staged:
                staged = now
                show.restage(bodies_of(now))
        for logged in onlooker.take(_ROUND):
            show.take(logged)
        sheet.flush()
        if not heard and show.counts:
            heard = True
            tell(f"{config.name} is on show")
        if onlooker.gone:
            tell(f"{config.name} has ended; what was seen of it stays on show")
            break
    return sum(show.counts.values())


def bodies_of(scene: Staged) -> Bodies:
    """The outlines of what stands on a simulated station's table."""
    bodies = {"go": scene.grasped, "eo": scene.extrinsic}
    outlines = {role: np.array(body.vertices) for role, body in bodies.items() if body is not None}
    return Bodies(outlines, np.array(scene.grasp))


def ready(config: StationConfig) -> str:
    """What is said when the looking begins."""
    lockstep = config.world is not None and config.world.clock == "lockstep"
    clock = "; in lockstep it moves while a run does" if lockstep else ""
    return f"looking on at {config.name}{clock}; Ctrl-C ends it"
