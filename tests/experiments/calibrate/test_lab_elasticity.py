"""In the `lab` profile the paper's protocol of 200 samples finds the elasticity that the plant was drawn with."""

import numpy as np
import pytest
from rich.console import Console

from drivers.sim.mismatch import Lab, load_profile
from experiments.calibrate.samples import load_samples
from mechanics.catalogue import load_sensor

#: a sensor, its station and laboratories nobody chose
LABS = [
    ("soft_bubble", "sim", 31),
    *(("gelslim", "sim_gelslim", seed) for seed in (33, 34, 35, 36)),
]
#: the stages that the elasticity needs
STAGES = "[{stage: calibrate_force_torque}, {stage: calibrate_elasticity}]"
#: what the issue of the state estimate allows
WITHIN = 0.03


def size(K, x):
    """The length [m] of displacements (n, 3): of the translation that stores the same energy."""
    return np.sqrt(np.einsum("ni,ij,nj->n", x, K, x) * 2 / (K[0, 0] + K[1, 1]))


@pytest.mark.slow
@pytest.mark.parametrize(("sensor", "station", "seed"), LABS)
def test_two_hundred_samples_in_the_lab_find_the_plants_stiffness(command, sensor, station, seed, capsys):
    sets = (f"seed={seed}", "world.profile=lab", f"sensor={sensor}", f"stages={STAGES}")
    process = command.start_run("calibrate", "--station", station, *(w for key in sets for w in ("--set", key)))
    run = command.finish(process, timeout=1500)
    assert run.code == 0, run.err
    name = f"elasticity-{sensor}-tall_box"
    found = run.results["calibration"][name]
    profile = load_profile("lab")
    K = Lab(profile, seed).stiffness(load_sensor(sensor).stiffness)
    stiffening = profile.membrane.stiffening

    secant = K * (1 + stiffening * found["amplitude"])
    diagonal = np.abs(np.diag(np.array(found["stiffness"])) / np.diag(secant) - 1)

    samples = load_samples(run.folder / "calibration" / f"{name}.csv")
    x = np.stack([samples[axis] for axis in ("x", "y", "theta")], axis=1)
    true = (1 + stiffening * size(K, x))[:, None] * (x @ K)
    K_fit = np.array(found["initial"])
    fit = (1 + found["stiffening"] * size(K_fit, x))[:, None] * (x @ K_fit)
    # force and torque on one scale: as the energy that the plant stores under them
    inverse = np.linalg.inv(K)
    off, all_of_it = (np.einsum("ni,ij,nj->n", w, inverse, w) for w in (fit - true, true))
    wrenches = np.sqrt(off.sum() / all_of_it.sum())
    nineteen_of_twenty = np.quantile(np.sqrt(off / all_of_it), 0.95)
    with capsys.disabled():
        shown = " ".join(f"{100 * share:.2f}" for share in (*diagonal, wrenches, nineteen_of_twenty))
        Console().print(f"\n{sensor}, laboratory {seed}: diagonal (3), wrenches rms and 95 %: {shown} %")
    assert len(x) == 2 * 200  # each hold is read at its beginning and at its end
    assert (diagonal <= WITHIN).all()
    assert wrenches <= WITHIN
