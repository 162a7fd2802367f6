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
    """The time toppra takes along the path through the knots, with a stop where all joints stand."""
    stands = [0, *stops(case), len(case["knots"]) - 1]
    times = [along_knots(case, case["knots"][first : last + 1]) for first, last in zip(stands, stands[1:])]
    return None if None in times else sum(times)


def along_knots(case, knots):
    q = np.array([k[1] for k in knots])
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
    """The time ruckig takes along the straight motions from posture to posture, within what the joints leave along each."""
    path = np.array(case["path"])
    times = [along_line(case, first, last) for first, last in zip(path, path[1:])]
    return None if None in times else sum(times)


def along_line(case, first, last):
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


def stops(case):
    """The knots between the first and the last at which all joints stand."""
    v = np.abs(np.array([k[2] for k in case["knots"]]))
    return [1 + int(i) for i in np.flatnonzero(np.max(v[1:-1], axis=1) < 1e-12)]


def duration(case):
    return case["knots"][-1][0]


def summary(cases, reference):
    shares = [used(case) for case in cases]
    out = {
        "cases": len(cases),
        "mean_s": statistics.mean(duration(case) for case in cases),
        "made_in_us": statistics.median(case["made_in_us"] for case in cases),
        "knots": max(len(case["knots"]) for case in cases),
        "greatest_share": {name: max(share[name] for share in shares) for name in shares[0]},
    }
    if reference:
        theirs = [reference(case) for case in cases]
        out.update(ratios([(duration(case), b) for case, b in zip(cases, theirs) if b is not None]))
    return out


def ratios(pairs):
    ratios = [a / b for a, b in pairs]
    values = {"mean": statistics.mean, "median": statistics.median, "least": min, "greatest": max}
    return {"compared": len(ratios), "ratio": {name: value(ratios) for name, value in values.items()}}


def beside_unlimited(limited, unlimited):
    """The same paths with and without a limit of jerk, by the time without."""
    pairs = list(zip(limited, unlimited))
    out = {"more_stops": sum(len(stops(a)) > len(stops(b)) for a, b in pairs)}
    for name, low, high in [("below 1 s", 0, 1), ("1 to 10 s", 1, 10), ("longer", 10, np.inf)]:
        some = [(duration(a), duration(b)) for a, b in pairs if low <= duration(b) < high]
        if some:
            out[name] = ratios(some)
    return out


def main():
    cases = [json.loads(line) for line in sys.stdin]
    by_kind = {}
    for case in cases:
        by_kind.setdefault(case["kind"], []).append(case)
    peers = {"path": by_toppra, "curve": by_toppra, "straight, jerk limited": by_ruckig, "corners, jerk limited": by_ruckig}
    names = {by_toppra: "toppra", by_ruckig: "ruckig"}
    report = {name: importlib.metadata.version(name) for name in ("toppra", "ruckig")}
    for kind, cases in by_kind.items():
        peer = peers.get(kind)
        report[kind] = {"beside": names.get(peer), **summary(cases, peer)}
        unlimited = by_kind.get(kind.removesuffix(", jerk limited"))
        if peer is None and unlimited:
            report[kind]["beside_no_limit_of_jerk"] = beside_unlimited(cases, unlimited)
    json.dump(report, sys.stdout, indent=2)
    print()


main()
