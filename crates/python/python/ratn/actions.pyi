"""Stubs of the actions of the built-in catalogue, written by `python -m ratn stubs`."""

from collections.abc import Mapping, Sequence
from typing import Any

from typing_extensions import Unpack

import ratn
from ratn import Annotations, Value

class _Arm_Follow(ratn.State):
    end: Value
    tracking_max_rad: Value
    tracking_rms_rad: Value

class _Arm_MoveTo(ratn.State):
    end: Value
    tracking_max_rad: Value
    tracking_rms_rad: Value

class _Arm_Where(ratn.State):
    joints: Value

class _Arm:
    def follow(
        self,
        *,
        trajectory: ratn.Trajectory | Value,
        arm: str | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _Arm_Follow: ...
    def move_to(
        self,
        *,
        joints: ratn.Joints | Sequence[float] | Value,
        arm: str | Value = ...,
        speed: float | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _Arm_MoveTo: ...
    def where(
        self,
        *,
        arm: str | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _Arm_Where: ...

arm: _Arm

class _Base_Drive(ratn.State):
    end: Value
    tracking_max_m: Value
    tracking_max_rad: Value
    tracking_rms_m: Value
    tracking_rms_rad: Value

class _Base_Localise(ratn.State):
    pose: Value

class _Base:
    def drive(
        self,
        *,
        trajectory: ratn.Trajectory | Value,
        **annotations: Unpack[Annotations],
    ) -> _Base_Drive: ...
    def localise(
        self,
        **annotations: Unpack[Annotations],
    ) -> _Base_Localise: ...

base: _Base

class _Camera_Capture(ratn.State):
    camera: Value
    camera_covariance: Value
    cx: Value
    cy: Value
    fx: Value
    fy: Value
    height: Value
    image: Value
    robot: Value
    width: Value

class _Camera:
    def capture(
        self,
        *,
        frames: int | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _Camera_Capture: ...

camera: _Camera

class _Detector_Confirm(ratn.State):
    confidence: Value
    covariance: Value
    pose: Value
    size: Value

class _Detector_Locate(ratn.State):
    confidence: Value
    covariance: Value
    pose: Value
    size: Value

class _Detector_Segment(ratn.State):
    boxes: Value

class _Detector:
    def confirm(
        self,
        *,
        object: Mapping[str, Any] | Value,
        classes: Sequence[Any] | Value = ...,
        frames: int | Value = ...,
        measures: Sequence[Any] | Value = ...,
        surface_m: float | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _Detector_Confirm: ...
    def locate(
        self,
        *,
        object: Mapping[str, Any] | Value,
        classes: Sequence[Any] | Value = ...,
        frames: int | Value = ...,
        measures: Sequence[Any] | Value = ...,
        surface_m: float | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _Detector_Locate: ...
    def segment(
        self,
        *,
        region: Mapping[str, Any] | Value,
        classes: Sequence[Any] | Value = ...,
        first: int | Value = ...,
        frames: int | Value = ...,
        measures: Sequence[Any] | Value = ...,
        surface_m: float | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _Detector_Segment: ...

detector: _Detector

class _Gripper_Feel(ratn.State):
    holding: Value
    width_m: Value

class _Gripper_Grasp(ratn.State):
    width_m: Value

class _Gripper_Release(ratn.State):
    ...

class _Gripper:
    def feel(
        self,
        *,
        arm: str | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _Gripper_Feel: ...
    def grasp(
        self,
        *,
        object: str | Value,
        arm: str | Value = ...,
        expected: ratn.Pose | Value = ...,
        hand: str | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _Gripper_Grasp: ...
    def release(
        self,
        *,
        arm: str | Value = ...,
        width_m: float | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _Gripper_Release: ...

gripper: _Gripper

class _PanTilt_LookAt(ratn.State):
    pan: Value
    tilt: Value

class _PanTilt:
    def look_at(
        self,
        *,
        target: ratn.Pose | Value,
        **annotations: Unpack[Annotations],
    ) -> _PanTilt_LookAt: ...

pan_tilt: _PanTilt

class _PathPlanner_Drive(ratn.State):
    end: Value
    length_m: Value
    planning_s: Value
    trajectory: Value

class _PathPlanner_Plan(ratn.State):
    end: Value
    end_pose: Value
    first_length_rad: Value
    first_path_s: Value
    iterations: Value
    length_rad: Value
    planning_s: Value
    trajectory: Value

class _PathPlanner:
    def drive(
        self,
        *,
        arm: ratn.Joints | Sequence[float] | Value,
        goal: object,
        cloud: bytes | Value = ...,
        cloud_known_within_m: float | Value = ...,
        cloud_radius_m: float | Value = ...,
        heading_tolerance_rad: float | Value = ...,
        other_arms: Mapping[str, Any] | Value = ...,
        pan: float | Value = ...,
        position_tolerance_m: float | Value = ...,
        speed: float | Value = ...,
        start: ratn.Pose | Value = ...,
        tilt: float | Value = ...,
        width_m: float | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _PathPlanner_Drive: ...
    def plan(
        self,
        *,
        goal: object,
        start: ratn.Joints | Sequence[float] | Value,
        acceleration_scale: object = ...,
        approach_direction: Sequence[Any] | Value = ...,
        approach_frame: str | Value = ...,
        approach_m: float | Value = ...,
        arm: str | Value = ...,
        blend_m: float | Value = ...,
        budget_s: float | Value = ...,
        cloud: bytes | Value = ...,
        cloud_known_within_m: float | Value = ...,
        cloud_radius_m: float | Value = ...,
        depart_direction: Sequence[Any] | Value = ...,
        depart_frame: str | Value = ...,
        depart_m: float | Value = ...,
        inside: Mapping[str, Any] | Value = ...,
        jerk_scale: object = ...,
        keep_axis: Sequence[Any] | Value = ...,
        keep_direction: Sequence[Any] | Value = ...,
        keep_out: Sequence[Any] | Value = ...,
        keep_rad: float | Value = ...,
        other_arms: Mapping[str, Any] | Value = ...,
        pan: float | Value = ...,
        reaches_into: Sequence[Any] | Value = ...,
        speed: float | Value = ...,
        straight: bool | Value = ...,
        tilt: float | Value = ...,
        tool_speed_m_s: float | Value = ...,
        tool_turning_rad_s: float | Value = ...,
        upright_rad: float | Value = ...,
        velocity_scale: object = ...,
        way_points: Sequence[Any] | Value = ...,
        width_m: float | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _PathPlanner_Plan: ...

path_planner: _PathPlanner
