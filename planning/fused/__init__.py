"""The contact trajectory problem compiled: programs, geometry, losses and their derivatives in one loop over steps.

    sources      how kernels are compiled and cached     program      one contact program, solved exactly
    layout       where things lie in the shared arrays   geometry     variables → program, and its derivatives
    pack         a Problem as flat arrays                residuals    the losses of a step
    batch        many programs                           trajectory   the loss of a trajectory, Adam
    objective    `FusedObjective`                        adjoint      the gradient of a step, backwards

The first use after an installation compiles the kernels; `warm` does it ahead. Nothing is compiled at import.
"""

from __future__ import annotations


def warm() -> None:
    """Compile everything, or load it from the disk's cache."""
    import numpy as np

    from mechanics.friction import Mode
    from planning.fused.objective import FusedObjective
    from planning.problem import Body, Form, ObjectContact, Problem, Touch
    from planning.program import STICK, ContactProgram
    from planning.qp_fused import solve

    corner = np.array([0.0, -0.02])
    contact = ObjectContact(
        name="corner",
        touch=Touch.CORNER_ON_FACE,
        p_go=corner,
        p_eo=np.zeros(2),
        normal=np.array([0.0, 1.0]),
        modes=(Mode.STICK,),
        mu=0.5,
        wish=np.array([[1.0, 0.0]]),
    )
    problem = Problem(
        skill="warm",
        form=Form.CLOSED,
        eo=np.zeros((1, 3)),
        eo_body=None,
        go_body=Body(np.array([corner, [0.02, 0.01], [-0.02, 0.01]]), 0.1, 0.01),
        grasp=np.zeros(3),
        stiffness=np.eye(3),
        contacts=(contact,),
        ground=(),
        angle=np.zeros(1),
        travel=np.zeros(1),
        free=np.array([[True, False, True, True, False]]),
        angle_limits=np.array([[-0.5, 0.5]]),
    )
    FusedObjective(problem).gradient(problem.start)
    one = np.ones((1, 1, 2))
    solve(ContactProgram(("corner",), np.full((1, 1), STICK), one, 0.5 * one[..., 0], one, (False,)))
