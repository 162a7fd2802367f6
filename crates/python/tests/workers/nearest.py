import ratn

w = ratn.Worker()

@w.action(reads=["at(?)"])
def nearest(goal: ratn.Goal, start: ratn.Pose, within_m: float = 9.0) -> dict:
    """The object nearest to a pose."""
    best = min(goal.facts("at(?)"), key=lambda f: f.value.distance(start), default=None)
    goal.checkpoint()                      # raises ratn.Cancelled
    if best is None or best.value.distance(start) > within_m:
        raise ratn.Aborted("nothing so near")
    goal.progress("found")
    return {"object": best.key[0]}

w.run()
