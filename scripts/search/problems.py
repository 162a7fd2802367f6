"""MotionBenchMaker's problems as VAMP's sources ship them, for `--example search` and for vamp.cc:

    problems.py ARCHIVE ROBOT JOINT,JOINT,... OUT [MOST]

ARCHIVE is resources/ROBOT/problems.tar.bz2, JOINTs in VAMP's order. Writes OUT.json and OUT.txt, up to MOST problems of each class. In OUT.txt
a cylinder is what VAMP takes it for: a capsule, in the class `box` a box. Needs PyYAML and numpy, and `transformations.py` of VAMP's package on
PYTHONPATH.
"""

import json
import pathlib
import re
import sys
import tarfile

import numpy as np
import transformations as tf
import yaml

LOADER = getattr(yaml, "CLoader", yaml.SafeLoader)


def matrix(pose):
    return np.dot(tf.translation_matrix(pose["position"]), tf.quaternion_matrix(pose["orientation"]))


def things(scene, is_box_class):
    """Objects for the JSON file and lines for VAMP, in VAMP's order."""
    objects, lines = [], []
    for thing in scene["world"]["collision_objects"]:
        base = matrix(thing["pose"]) if "pose" in thing else tf.identity_matrix()
        shape = thing["primitives"][0]
        place = np.dot(base, matrix(thing["primitive_poses"][0]))
        at = [float(x) for x in tf.translation_from_matrix(place)]
        where = " ".join(map(repr, at + [float(x) for x in tf.euler_from_matrix(place)]))
        sizes = [float(x) for x in shape["dimensions"]]
        entry = {"name": thing["id"], "position": at, "type": shape["type"]}
        entry["quat_xyzw"] = [float(x) for x in tf.quaternion_from_matrix(place)]
        if shape["type"] == "box":
            entry["size"] = sizes
            lines.append((2, f"box {where} {sizes[0] / 2} {sizes[1] / 2} {sizes[2] / 2}"))
        elif shape["type"] == "cylinder":
            entry |= {"length": sizes[0], "radius": sizes[1]}
            as_box = f"box {where} {sizes[1]} {sizes[1]} {sizes[0] / 2}"
            lines.append((1, as_box if is_box_class else f"capsule {where} {sizes[1]} {sizes[0]}"))
        else:
            entry["radius"] = sizes[0]
            lines.append((0, f"sphere {where} {sizes[0]}"))
        objects.append(entry)
    return objects, [line for _, line in sorted(lines, key=lambda line: line[0])]


def main():
    archive, robot, joints, out = sys.argv[1:5]
    most = int(sys.argv[5]) if len(sys.argv) > 5 else sys.maxsize
    joints, files = joints.split(","), {}
    with tarfile.open(archive) as tar:
        for member in tar.getmembers():
            index = re.findall(r"\d+", pathlib.PurePath(member.name).name)
            if member.isfile() and int(index[0]) <= most:
                _, name, file = member.name.split("/")
                kind = "scene" if "scene" in file else "request"
                files[name.replace(f"_{robot}", ""), int(index[0]), kind] = yaml.load(tar.extractfile(member), LOADER)
    classes, text = {}, []
    for name, index in sorted({key[:2] for key in files}):
        objects, lines = things(files[name, index, "scene"], name == "box")
        request = files[name, index, "request"]
        state = request["start_state"]["joint_state"]
        start = [float(state["position"][state["name"].index(joint)]) for joint in joints]
        wanted = {c["joint_name"]: c["position"] for c in request["goal_constraints"][0]["joint_constraints"]}
        goal = [float(wanted[joint]) for joint in joints]
        classes.setdefault(name, []).append({"index": index, "objects": objects, "start": start, "goal": goal})
        text += [f"{name} {index} {len(lines)}", *lines, " ".join(map(repr, start)), " ".join(map(repr, goal))]
    document = {"robot": robot, "joints": joints, "problems": classes}
    pathlib.Path(f"{out}.json").write_text(json.dumps(document))
    pathlib.Path(f"{out}.txt").write_text("\n".join(text) + "\n")


main()
