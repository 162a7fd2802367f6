"""Reads labels with PP-OCR, a small model that `pip install rapidocr-onnxruntime` ships, while the arm moves."""

import numpy as np

import ratn
from ratn import fn
from ratn.actions import arm

LEFT = ratn.Joints([0.9, -1.2, 0, 0.9, 0, -0.6, 0])
RIGHT = ratn.Joints([-0.9, -1.2, 0, 0.9, 0, -0.6, 0])

_reader = None


@ratn.step(reads=[])
def photograph(text: str) -> dict:
    """A picture of a label, in the place of a camera; as PNG."""
    import cv2

    picture = np.full((96, 400, 3), 255, np.uint8)
    cv2.putText(picture, text, (30, 62), cv2.FONT_HERSHEY_DUPLEX, 1.5, (0, 0, 0), 2)
    return {"picture": cv2.imencode(".png", picture)[1].tobytes()}


@ratn.step(reads=[], outputs={"text": str, "sure": float})
def read(picture: bytes) -> dict:
    """What is written on a picture, and how sure that is."""
    global _reader
    import cv2
    from rapidocr_onnxruntime import RapidOCR

    _reader = _reader or RapidOCR()                      # the models are loaded once for each process of the worker
    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    lines, _ = _reader(image)
    if not lines:
        raise ratn.Aborted("nothing is written there")
    return {"text": " ".join(text for _, text, _ in lines), "sure": min(float(sure) for *_, sure in lines)}


@ratn.task
def labels(text: str = "SCREWS M4") -> dict:
    """The arm moves out of the picture's way and back; the model works meanwhile, and nobody waits for it."""
    away = arm.move_to(joints=LEFT, pia=True, effects=["posture(arm) = left"])
    label = photograph(text=text)
    said = read(picture=label.picture)
    back = arm.move_to(joints=RIGHT, pia=True, effects=["posture(arm) = right"])
    with ratn.when(said.sure > 0.5):
        arm.move_to(joints=LEFT, pia=True, effects=["posture(arm) = left"], name="sure")
    return {"text": said.text, "surely": fn.if_(said.sure > 0.5, "yes", "no")}


if __name__ == "__main__":
    labels.check()
    with ratn.System(boxes=1, speed=10) as system:
        run = system.run(labels)
        print(run.result())
        print(run.why("said"))
        print(run.report())
