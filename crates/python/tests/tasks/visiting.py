import ratn
from ratn import fn
from ratn.actions import arm, detector, pan_tilt, path_planner

HOME = ratn.Joints([0.9, -1.2, 0, 0.9, 0, -0.6, 0])
TABLE = ratn.Pose(0.8, 0, 0.7)


@ratn.step(reads=["at(?)"])
def nearest(goal: ratn.Goal, start: ratn.Pose) -> dict:
    """The object nearest to a pose."""
    best = min(goal.facts("at(?)"), key=lambda fact: fact.value.distance(start), default=None)
    if best is None:
        raise ratn.Aborted("there is nothing")
    return {"object": best.key[0], "pose": best.value}


@ratn.task
def visiting(most: int = 2, start: ratn.Pose = TABLE) -> dict:
    """Looks for boxes, moves above each, and looks at the one nearest to a pose."""
    tuck = arm.move_to(joints=HOME, pia=True, effects=["posture(arm) = home"])
    with ratn.retry(2, backoff=0.5):                             # of one action: that is tried again
        aim = pan_tilt.look_at(target=TABLE, pia=True, effects=["pan_tilt_at(pan_tilt) = table"])
    look = detector.segment(
        region={"pose": TABLE, "size": [0.6, 1.2]},
        senses=["pan_tilt_at(pan_tilt)", "posture(arm)"],
        effects=[{"for": "b in boxes", "do": ["at($b.id) = $b.pose", "shape($b.id) = {type: box, size: $b.size}"]}],
        resources=["Detector", "Camera"],
    )
    with ratn.when(fn.len(look.boxes) > 0):
        for box in ratn.each(fn.take(look.boxes, most)):
            above = {"pose": box.pose @ ratn.Pose(0, 0, 0.15), "size": box.size}
            there = path_planner.plan(start=HOME, goal=fn.grasp_pose(above), computes=True, reads=["scene"])
            go = arm.follow(trajectory=there.trajectory, pia=True, effects=["posture(arm) = at_work"])
            back = path_planner.plan(start=there.end, goal=HOME, computes=True, reads=["scene"])
            home = arm.follow(trajectory=back.trajectory, pia=True, effects=[f"visited({box.id})", "posture(arm) = home"])
        found = nearest(start=start)
        pan_tilt.look_at(target=found.pose, pia=True, effects=["pan_tilt_at(pan_tilt) = object"], name="show")
    return {"seen": fn.len(look.boxes)}


if __name__ == "__main__":
    visiting.check()                                             # raises ratn.InvalidTask, with the lines of this file
    with ratn.System(boxes=2, speed=20) as system:
        run = system.run(visiting, most=1)
        print(run.result())
        print(run.why("go"))                                     # what waited for what
        run.gantt().save("visiting.svg")
