"""Runs as the runner hands them to the report, made up from statics: no simulation, no solver."""

import base64
import math

import cv2
import numpy as np

K = np.diag([1.0, 1.0, 0.0448]) @ np.array(
    [[2208.96, -143.31, 399.86], [-143.31, 1875.92, -313.57], [399.86, -313.57, 1608.49]]
) @ np.diag([1.0, 1.0, 0.0448])  # fmt: skip
BOX = np.array([[-0.025, -0.07345], [0.025, -0.07345], [0.025, 0.07345], [-0.025, 0.07345]])
HBOX = np.array([[-0.06, -0.03], [0.06, -0.03], [0.06, 0.03], [-0.06, 0.03]])
GRASP = np.array([0.0, 0.045, 0.0])
WEIGHT = 0.1 * 9.81
RATE = 25.0


def rotation(angle):
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def compose(a, b):
    return np.array([*(a[:2] + rotation(a[2]) @ b[:2]), a[2] + b[2]])


def balance(angle, corner, force, loaded=1.0):
    """go, ee and wrench of a box held at ``angle`` with its lower left corner at ``corner`` under ``force`` [N]."""
    go = np.array([*(corner - rotation(angle) @ BOX[0]), angle])
    gocf = compose(go, GRASP)
    arm_c, arm_g = corner - gocf[:2], go[:2] - gocf[:2]
    f = -force - np.array([0.0, -WEIGHT])
    torque = -(arm_c[0] * force[1] - arm_c[1] * force[0]) + arm_g[0] * WEIGHT
    wrench = np.array([*f, torque])
    local = np.array([*(rotation(angle).T @ f), torque])
    return go, compose(gocf, loaded * np.linalg.solve(K, local)), wrench


def contact(name, point, force, mode):
    return {"name": name, "point": list(point), "normal": [0.0, 1.0], "force": list(force), "mode": mode}


def build_trial(controller="closed_loop", eo=False, steps=20, seed=0, error=1.0, offset=0.0, status="completed"):
    """A pivot from 10° to 35° under 4 N: ``error`` scales what is measured beside the plan."""
    rng = np.random.default_rng(seed)
    height = 0.06 if eo else 0.0
    corner, force = np.array([0.01, height]), np.array([0.35, 4.0])
    pose_eo = np.array([0.02, 0.03, 0.0])
    angles = np.radians(np.linspace(10.0, 35.0, steps))
    times = 5.0 + 0.6 * np.arange(steps)
    planned = {"ee": [], "go": [], "eo": [] if eo else None, "wrench": []}
    contacts = []
    for angle in angles:
        go, ee, wrench = balance(angle, corner, force)
        for key, value in (("ee", ee), ("go", go), ("wrench", wrench)):
            planned[key].append(value.tolist())
        here = [contact("corner", corner, force, "stick")]
        if eo:
            planned["eo"].append(pose_eo.tolist())
            here += [contact(f"ground {i}", (x, 0.0), (0.2, 3.0), "slip+") for i, x in enumerate((-0.04, 0.08))]
        contacts.append(here)

    def disturbed(scale, bias):
        out = {}
        for key, rows in planned.items():
            if rows is None:
                out[key] = None
                continue
            sigma = np.array([0.06, 0.09, 18e-3] if key == "wrench" else [8e-5, 1e-4, 1e-3])
            noise = rng.normal(size=(steps, 3)) * sigma * scale
            drift = np.array([3.5, -2.0, 0.9]) * sigma * bias
            out[key] = (np.array(rows) + noise + drift).tolist()
        return out

    truth = disturbed(0.4 * error, error)
    measured = disturbed(error, error)

    t, phase, frames = [], [], {"ee": [], "go": [], "eo": [] if eo else None, "wrench": [], "contacts": []}
    end = times[-1] + 4.0
    for instant in np.arange(0.0, end, 1 / RATE):
        angle = np.interp(instant, times, angles)
        lift = 0.03 * max(0.0, 1 - instant / 2.5) + 0.05 * max(0.0, (instant - times[-1] - 2.0) / 2.0)
        load = float(np.clip(min((instant - 2.6) / 2.0, (times[-1] + 1.8 - instant) / 1.5), 0.0, 1.0))
        begins = {
            "approach": 0.0,
            "preload": 2.6,
            "trajectory": 4.8,
            "unload": times[-1] + 0.3,
            "retreat": times[-1] + 2,
        }
        name = [label for label, begin in begins.items() if begin <= instant][-1]
        go, ee, wrench = balance(angle, corner + np.array([0.0, lift]), load * force)
        sway = 3e-4 * error * math.sin(3 * instant) * np.array([1.0, 0.0, 2.0])
        frames["go"].append((go + sway).tolist())
        frames["ee"].append((ee + sway).tolist())
        frames["wrench"].append(wrench.tolist())
        touching = load > 0
        here = [contact("", corner, load * force, "stick")] if touching else []
        if eo:
            frames["eo"].append((pose_eo + np.array([offset * load, 0.0, 0.0])).tolist())
            here += [contact("", (x, 0.0), (0.2 * load, 2.4 + 0.6 * load), "slip+") for x in (-0.04, 0.08)]
        frames["contacts"].append(here)
        t.append(float(instant))
        phase.append(name)

    skill = "relative_pivoting" if eo else "grasped_pivoting"
    return {
        "name": f"{skill}-{controller}",
        "skill": skill,
        "controller": controller,
        "status": status,
        "reason": "" if status == "completed" else "no waypoint settled within 3.0 s at waypoint 14",
        "waypoints": {
            "t": times.tolist(),
            "planned": planned,
            "measured": measured,
            "truth": truth,
            "contacts": contacts,
        },
        "playback": {"t": t, **frames, "source": "truth", "phase": phase},
    }


def errors(trial, source):
    """M of results.json for a made-up trial, by the definition of design §6."""
    planned, found = trial["waypoints"]["planned"], trial["waypoints"][source]
    d = {
        key: np.array(found[key]) - np.array(planned[key]) for key in ("go", "eo", "wrench") if planned[key] is not None
    }
    rho = 0.0448
    own = d["eo"] if "eo" in d else d["go"]

    def stat(values):
        return {"mean": float(np.mean(values)), "std": float(np.std(values))}

    def norm(rows, factor):
        return stat(np.linalg.norm(rows * factor, axis=1))

    pose_mm = 1e3 * np.array([1, 1, rho])
    out = {"go_pose_mm": norm(d["go"], pose_mm), "wrench_N": norm(d["wrench"], np.array([1, 1, 1 / rho]))}
    if "eo" in d:
        out["eo_pose_mm"] = norm(d["eo"], pose_mm)
    for key, column, rows, factor in (
        ("fx_N", 0, d["wrench"], 1), ("fy_N", 1, d["wrench"], 1), ("tau_Nmm", 2, d["wrench"], 1e3),
        ("x_mm", 0, own, 1e3), ("y_mm", 1, own, 1e3), ("theta_deg", 2, own, 180 / math.pi),
    ):  # fmt: skip
        out[key] = stat(np.abs(rows[:, column] * factor))
    return out


def origin(run="calibrate-20251120T080000", **objects):
    return {"made": "2025-11-20T08:15:00Z", "station": "sim", "world": None, "devices": {"wrist_ft": "sim"},
            "objects": objects, "run": run, "revision": "25914cc0a7d2"}  # fmt: skip


def friction_entry(mu=0.33, interval=(0.32, 0.34), pair="go-ground", **objects):
    """A friction calibration as results.json has it."""
    made = origin(**(objects or {"go": "tall_box d065ea75"}))
    return {"file": f"calibrations/lab-1/friction-{pair}.yaml", "kind": "friction", "origin": made, "pair": pair,
            "mu": mu, "interval": list(interval), "samples": 400}  # fmt: skip


def elasticity_entry():
    """An elasticity calibration of soft_bubble on tall_box as results.json has it; K is the paper's."""
    deviation = np.array([[9.4, 6.2, 0.31], [6.2, 8.8, 0.28], [0.31, 0.28, 0.021]])
    return {
        "file": "calibrations/lab-1/elasticity-soft_bubble-tall_box.yaml", "kind": "elasticity",
        "origin": origin(go="tall_box d065ea75"), "sensor": "soft_bubble", "stiffness": K.tolist(),
        "deviation": deviation.tolist(), "amplitude": 0.002, "initial": (0.96 * K).tolist(), "stiffening": 20.0,
        "hysteresis": 0.12, "yield_length": 0.0006, "creep": 0.0, "creep_time": 0.0, "offset": [1e-4, -2e-4, 0.004],
        "residual": [0.08, 0.07, 0.003], "chi2": 1.04, "method": "errors_in_variables", "samples": 200,
    }  # fmt: skip


def elasticity_samples(count=200, seed=0, noise=0.1):
    """Columns of samples that follow w = K x but for ``noise`` [N, N, 0.1 N·m], half along the axes, half at random."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (count, 3)) * [0.003, 0.003, 0.06]
    for axis in range(3):
        x[axis * count // 6 : (axis + 1) * count // 6, np.arange(3) != axis] = 0
    fit = x @ K
    w = fit + noise * rng.normal(size=(count, 3)) * [1, 1, 0.1]
    names = ("x", "y", "theta", "fx", "fy", "tau", "fx_fit", "fy_fit", "tau_fit")
    return {"time": np.arange(count) * 0.5, **dict(zip(names, np.concatenate([x, w, fit], axis=1).T, strict=True))}


def friction_samples(mu=0.33, count=400, seed=0):
    """Columns of forces that fill a cone of ``mu``, half of them on its edges."""
    rng = np.random.default_rng(seed)
    f_n = rng.uniform(1, 6, count)
    share = np.where(rng.random(count) < 0.5, np.sign(rng.normal(size=count)), rng.uniform(-1, 1, count))
    return {"f_n": f_n + 0.02 * rng.normal(size=count), "f_t": mu * f_n * share + 0.02 * rng.normal(size=count)}


def build_calibrated():
    """A run that did nothing but calibrate, each kind once and friction for three pairs."""
    go, eo = "tall_box d065ea75", "hbox 11aa22bb"
    lens = [[1400.5, 0.0, 640.0], [0.0, 1401.0, 512.0], [0.0, 0.0, 1.0]]
    known = {
        "force_torque": {"kind": "force_torque", "origin": origin(), "device": "wrist_ft", "tool_mass": 1.2034,
                         "tool_centre": [0.0012, 0.0641], "deviation": [0.0021, 0.0003, 0.0004], "residual": 0.031,
                         "samples": 9},
        "camera": {"kind": "camera", "origin": origin(), "device": "camera", "focal_deviation": 1.3,
                   "camera": {"width": 1280, "height": 1024, "K": lens, "distortion": [0.0] * 5,
                              "X_WC": np.eye(4).tolist()}, "residual_px": 0.21, "views": 24},
        "tag-tall_box-3": {"kind": "tag", "origin": origin(go=go), "id": 3, "pose": [0.0004, 0.0201, 0.0087266],
                         "deviation": [0.00011, 0.00012, 0.0017453]},
        "clock": {"kind": "clock", "origin": origin(), "delays": {"wrist": {"delay": 0.00213, "deviation": 0.00054},
                                                                  "camera": {"delay": 0.0121, "deviation": 0.0011}}},
    }  # fmt: skip
    for name, entry in known.items():
        entry["file"] = f"calibrations/lab-1/{name}.yaml"
    known["elasticity-soft_bubble-tall_box"] = elasticity_entry()
    known["friction-tall_box-ground"] = friction_entry()
    known["friction-tall_box-hbox"] = friction_entry(0.52, (0.49, 0.55), "go-eo", go=go, eo=eo)
    known["friction-hbox-ground"] = friction_entry(0.21, (0.205, 0.215), "eo-ground", eo=eo)
    samples = {name: friction_samples(entry["mu"], seed=7) for name, entry in known.items() if "mu" in entry}
    run = build_run([])
    run["title"] = run["results"]["experiment"] = "calibrate"
    run["results"]["calibration"] = known
    run["calibration"] = {
        "made": list(known), "samples": {"elasticity-soft_bubble-tall_box": elasticity_samples(), **samples},
        "nominal": [], "only": True,
    }  # fmt: skip
    return run


def build_pictures(times, device="finger_left", kind="deformation", size=(16, 12), every=1):
    """One device's pictures: evenly grey, of waypoint k by 10 k + 50, which says k mm."""
    shots = []
    for step in range(0, len(times), every):
        grey = np.full(size[::-1], 50 + 10 * step, np.uint8)
        _, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 95])
        shots.append([times[step] - 0.1, step, base64.b64encode(data.tobytes()).decode()])
    against = "the untouched finger" if kind == "deformation" else ""
    return {"device": device, "kind": kind, "against": against, "reach": 0.999 * (len(times) - 1), "width": size[0],
            "height": size[1], "shots": shots}  # fmt: skip


def stream(device, kind, name, messages, **known):
    """A stream of a device as `experiments.report.device_health.told` gives it; ``known`` is what is not well."""
    well = {"declared": None, "rate": None, "silence": None, "age": None, "lost": 0, "gaps": 0, "gap": None,
            "conditions": [], "on_request": False}  # fmt: skip
    return {"device": device, "stream": name, "kind": kind, "messages": messages, **well, **known}


def build_health():
    """A wrist sensor that lost 3 readings and was saturated, a camera that is asked, a gripper that never spoke."""
    worst = {"silence": {"value": 0.0123, "t": 7.25}, "age": {"value": 0.0031, "t": 9.5},
             "gap": {"value": 2, "t": 7.25}}  # fmt: skip
    saturated = [{"says": "it is saturated", "count": 12, "t": 20.5}]
    return {
        "streams": [
            stream("arm", "arm", "pose", 4160, declared=100.0, rate=100.0, silence={"value": 0.02, "t": 1.0}),
            stream("camera", "tag_camera", "detections", 416, on_request=True),
            stream("wrist", "force_torque", "wrench", 41600, declared=1000.0, rate=999.9, lost=3, gaps=2,
                   conditions=saturated, **worst),
        ],
        "silent": [{"device": "gripper", "kind": "gripper"}],
        "gates": [{"device": "arm", "accepted": 2000, "refused": {"speed": 2},
                   "troubles": [[12.5, "0.3 m/s is more than 0.25 m/s"]]}],
    }  # fmt: skip


def build_plans(queries=100):
    """What the file of the plan `pivot` says: a loss that falls from 10 to 0.01 in ``queries``."""
    curve = np.geomspace(10.0, 0.01, queries // 10).tolist()
    told = {"curve": curve, "curve_queries": list(range(10, queries + 1, 10)), "ended": "iterations",
            "optimising_s": 0.25, "terms": {"cone": 0.007, "smooth": 0.003}, "shortfalls": []}  # fmt: skip
    return {"pivot": told}


def build_run(trials, status="completed", eo=False):
    rows = [
        {
            **{key: trial[key] for key in ("name", "skill", "controller", "status", "reason")},
            "planner": "gradient", "grasped_object": "tall_box", "extrinsic_object": "hbox" if eo else None,
            "sensor": "soft_bubble", "trial": index,
            "measured": errors(trial, "measured"), "truth": errors(trial, "truth"),
        }
        for index, trial in enumerate(trials)
    ]  # fmt: skip
    return {
        "results": {
            "schema": 1, "status": status, "experiment": "grasped_pivoting", "station": "sim", "seed": 7,
            "profile": "ideal",
            "provenance": {
                "git": {"commit": "25914cc0a7d2f3b1c9e8", "dirty": False},
                "versions": {"extrinsic": "0.1.0", "mujoco": "4.0.0", "numpy": "2.4.6", "python": "3.11.9"},
                "host": {"name": "bench-2", "cpu": "2 cores"},
            },
            "calibration": {"friction-tall_box-ground": friction_entry()},
            "plans": [{"name": "pivot", "skill": trials[0]["skill"], "planner": "gradient", "steps": 20, "queries": 100,
                       "time_s": 7.19, "loss": 0.00231, "status": "optimal"}] if trials else [],
            "trials": rows, "tables": [],
        },
        "title": "Grasped pivoting, 10° to 35° under 4 N",
        "created": "2025-11-22T01:40:00Z",
        "objects": {
            "go": {"name": "tall_box", "vertices": BOX.tolist()},
            "eo": {"name": "hbox", "vertices": HBOX.tolist()} if eo else None,
        },
        "grasp": GRASP.tolist(),
        "trials": trials,
        "log": {"file": "log.mcap", "bytes": 4_812_345, "lost": 0, "seconds": 41.6,
                "messages": {"sim/arm/pose": 4160, "sim/wrist/wrench": 41600, "sim/camera/detections": 416}},
        "events": [
            {"t": 0.0, "level": "info", "text": "run started"},
            {"t": 12.4, "level": "warning", "text": "closed_loop: correction reached its limit of 4 mm"},
            {"t": 41.6, "level": "info", "text": "run completed"},
        ],
        "paper": None,
        "health": build_health(),
        "plans": build_plans() if trials else {},
    }  # fmt: skip
