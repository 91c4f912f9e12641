"""Before a trial: the arm out of the way, the extrinsic object where the plan finds it, the go in the fingers anew."""

from __future__ import annotations

import numpy as np

from control.approach import resting_eo
from control.motion import Mover
from drivers.station import Devices
from experiments import setup
from experiments.context import RunContext
from planning.plan import Plan


def arrange(context: RunContext, devices: Devices, plan: Plan, trial: int) -> None:
    """Put the scene into the state that ``trial`` of ``plan`` begins with.

    The simulated world does it by itself, and holds until `let_go` an extrinsic object that would not stand so; a
    person is asked by the trial, which looks at the tags. Raises DriverError.
    """
    eo = resting_eo(plan)
    scene = setup.scene(context.resolved, None if eo is None else (float(eo[0]), float(eo[1]), float(eo[2])))
    if devices.simulation is not None:
        context.begin(scene, trial=trial, held="eo" if plan.supported else None)
    elif eo is not None:
        _lift(context, devices, scene.start[1])


def let_go(devices: Devices, plan: Plan) -> None:
    """Let the simulated world's hand off a tilted extrinsic object: from now on the go holds it."""
    if plan.supported and devices.simulation is not None:
        devices.simulation.clamp(None)


def _lift(context: RunContext, devices: Devices, height: float) -> None:
    """Raise the end-effector, straight up, to where the go hangs clear of the extrinsic object; it hangs upright."""
    settings = context.settings
    here = setup.observer(context.resolved, devices, settings, context.believed).arm_pose()
    mover = Mover.of(devices.arm, devices.clock, here, settings, context.heed, context.event)
    for goal in ([here[0], max(here[1], height), here[2]], [here[0], max(here[1], height), 0.0]):
        if np.abs(np.asarray(goal) - mover.pose).max() > 1e-6:
            mover.travel(np.asarray(goal, float))
    mover.rest(settings.window)
