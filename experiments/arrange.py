"""Before a trial: the arm out of the way, the extrinsic object where the plan finds it, the go in the fingers anew."""

from __future__ import annotations

import numpy as np

from control.approach import resting_eo
from control.motion import Mover
from control.observe import Observer
from drivers.station import Devices
from experiments import setup
from experiments.context import RunContext
from planning.plan import Plan


def arrange(context: RunContext, devices: Devices, observer: Observer, plan: Plan, trial: int) -> None:
    """Put the scene into the state that ``trial`` of ``plan`` begins with.

    The simulated world does it by itself; a person is asked by the trial, which looks at the tags. Raises DriverError.
    """
    eo, simulation = resting_eo(plan), devices.simulation
    if eo is not None:
        pose = (float(eo[0]), float(eo[1]), float(eo[2]))
        scene = setup.scene(context.resolved, pose)
        _lift(context, devices, observer, scene.start[1])
        if simulation is not None:
            _tell_health(context, devices)
            simulation.rearrange(scene.model_dump())
    if simulation is not None:
        simulation.regrasp(trial)


def hold(devices: Devices, plan: Plan, phase: str) -> None:
    """Let the simulated world hold a tilted extrinsic object until the go does, as a person's hand would."""
    if not plan.supported or devices.simulation is None:
        return
    if phase == "approach":
        devices.simulation.clamp("eo")
    elif phase == "trajectory":
        devices.simulation.clamp(None)


def _lift(context: RunContext, devices: Devices, observer: Observer, height: float) -> None:
    """Raise the end-effector, straight up, to where the go hangs clear of the extrinsic object; it hangs upright."""
    settings, here = context.settings, observer.arm_pose()
    mover = Mover(
        devices.arm, devices.clock, settings.control_rate, here, settings.approach_speed, context.check_interrupt
    )
    for goal in ([here[0], max(here[1], height), here[2]], [here[0], max(here[1], height), 0.0]):
        if np.abs(np.asarray(goal) - mover.pose).max() > 1e-6:
            mover.travel(np.asarray(goal, float))
    mover.rest(settings.window)


def _tell_health(context: RunContext, devices: Devices) -> None:
    """What was not well with the plant until now: a rearranged world counts anew."""
    assert devices.simulation is not None
    for flag in devices.simulation.health()["flags"]:
        context.event("warning", f"the simulated plant: {flag}")
