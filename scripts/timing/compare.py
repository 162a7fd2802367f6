"""Holds trajectories (examples/timings.rs, a case per line) against toppra and ruckig; see scripts/bench-timing."""

import importlib.metadata
import json
import logging
import statistics
import sys

import numpy as np
import ruckig
import toppra
import toppra.algorithm
import toppra.constraint

logging.getLogger("toppra").setLevel(logging.ERROR)
SAMPLES = 100


def used(case):
    """The greatest share of each limit, and the greatest step of acceleration between two cubics over its limit."""
    times = np.array([k[0] for k in case["knots"]])
    q = np.array([k[1] for k in case["knots"]])
    v = np.array([k[2] for k in case["knots"]])
    h = np.diff(times)[:, None]
    mean = np.diff(q, axis=0) / h
    a = (6 * mean - 4 * v[:-1] - 2 * v[1:]) / h
    j = 6 * (v[:-1] + v[1:] - 2 * mean) / h**2
    velocities, accelerations = np.array(case["velocities"]), np.array(case["accelerations"])
    share = np.linspace(0, 1, SAMPLES + 1)[:, None, None] * h
    shares = {
        "velocity": np.max(np.abs(v[:-1] + share * (a + share * j / 2)) / velocities),
        "acceleration": np.max(np.abs(a + share * j) / accelerations),
    }
    if case["jerks"][0] is not None:
        shares["jerk"] = np.max(np.abs(j) / np.array(case["jerks"]))
        ends = a + h * j
        steps = np.vstack([a[:1], a[1:] - ends[:-1], ends[-1:]])
        shares["step"] = np.max(np.abs(steps) / accelerations)
    return {name: float(value) for name, value in shares.items()}


def by_toppra(case):
    """The time toppra takes along the path through the knots."""
    q = np.array([k[1] for k in case["knots"]])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(along) > 1e-9])
    path = toppra.SplineInterpolator(along[keep], q[keep])
    velocities, accelerations = np.array(case["velocities"]), np.array(case["accelerations"])
    constraints = [
        toppra.constraint.JointVelocityConstraint(np.stack([-velocities, velocities], axis=1)),
        toppra.constraint.JointAccelerationConstraint(
            np.stack([-accelerations, accelerations], axis=1),
            discretization_scheme=toppra.constraint.DiscretizationType.Interpolation,
        ),
    ]
    # So dense that toppra keeps the limits between the points, too: with 1,501 it took 3 % less time on one path, and broke them.
    grid = np.linspace(along[0], along[-1], 6001)
    algorithm = toppra.algorithm.TOPPRA(constraints, path, gridpoints=grid, parametrizer="ParametrizeConstAccel")
    trajectory = algorithm.compute_trajectory(0, 0)
    return None if trajectory is None else float(trajectory.duration)


def by_ruckig(case):
    """The time ruckig takes along the straight line, within what the joints leave along it."""
    first, last = np.array(case["knots"][0][1]), np.array(case["knots"][-1][1])
    way = np.linalg.norm(last - first)
    direction = np.abs(last - first) / way

    def along(limits):
        return float(np.min(np.array(limits) / np.maximum(direction, 1e-12)))

    otg = ruckig.Ruckig(1)
    request, trajectory = ruckig.InputParameter(1), ruckig.Trajectory(1)
    request.current_position, request.target_position = [0.0], [float(way)]
    request.current_velocity = request.current_acceleration = [0.0]
    request.target_velocity = request.target_acceleration = [0.0]
    request.max_velocity = [along(case["velocities"])]
    request.max_acceleration = [along(case["accelerations"])]
    request.max_jerk = [along(case["jerks"])]
    result = otg.calculate(request, trajectory)
    return trajectory.duration if result in (ruckig.Result.Finished, ruckig.Result.Working) else None


def summary(cases, reference):
    ours = [case["knots"][-1][0] for case in cases]
    shares = [used(case) for case in cases]
    out = {
        "cases": len(cases),
        "mean_s": statistics.mean(ours),
        "made_in_us": statistics.median(case["made_in_us"] for case in cases),
        "greatest_share": {name: max(share[name] for share in shares) for name in shares[0]},
    }
    if reference:
        theirs = [reference(case) for case in cases]
        ratios = [a / b for a, b in zip(ours, theirs) if b is not None]
        out["compared"] = len(ratios)
        out["ratio"] = {"mean": statistics.mean(ratios), "least": min(ratios), "greatest": max(ratios)}
    return out


def main():
    cases = [json.loads(line) for line in sys.stdin]
    kinds = [("path", by_toppra, "toppra"), ("straight, jerk limited", by_ruckig, "ruckig"), ("path, jerk limited", None, None)]
    report = {name: importlib.metadata.version(name) for name in ("toppra", "ruckig")}
    for kind, reference, name in kinds:
        of_kind = [case for case in cases if case["kind"] == kind]
        report[kind] = {"beside": name, **summary(of_kind, reference)}
    json.dump(report, sys.stdout, indent=2)
    print()


main()
