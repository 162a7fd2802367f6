"""What others wait for."""

import ratn

w = ratn.Worker("lingerer", kind="Lingerer")


@w.action(computes=True, reads=[])
def linger(goal: ratn.Goal, seconds: float) -> dict:
    goal.sleep(seconds)
    return {}


w.run()
