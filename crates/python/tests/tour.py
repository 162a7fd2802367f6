import pathlib

import ratn

task = pathlib.Path(__file__).resolve().parents[3] / "examples" / "fetch_boxes.yaml"

with ratn.System(boxes=1, speed=20) as system:        # `ratn up` for as long as the block lasts
    run = system.run(task, boxes=1, mode="cdtn")      # parameters are keyword arguments
    for event in run:                                 # the lines of the event log, as they come
        if event.get("event") == "finished":
            print("finished", event["instance"], event["outcome"])
    print(run.result())
    longest = max(run.nodes(), key=lambda node: node["ended_s"] - node["began_s"])
    print("the longest was", longest["path"])

    with system.acquire("Camera", timeout_s=10) as lease:
        print(lease, [resource["id"] for resource in system.resources("Camera")])
    for fact in system.query("at(?)"):
        print(fact.key[0], fact.value.position)
