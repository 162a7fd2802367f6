"""Stubs of the actions of the built-in catalogue, written by `python -m ratn stubs`."""

from collections.abc import Mapping, Sequence
from typing import Any

from typing_extensions import Unpack

import ratn
from ratn import Annotations, Value

class _ArmFollow(ratn.State):
    end: Value
    tracking_max_rad: Value
    tracking_rms_rad: Value

class _ArmMoveTo(ratn.State):
    end: Value
    tracking_max_rad: Value
    tracking_rms_rad: Value

class _ArmWhere(ratn.State):
    joints: Value

class _Arm:
    def follow(
        self,
        *,
        trajectory: ratn.Trajectory | Value,
        arm: str | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _ArmFollow: ...
    def move_to(
        self,
        *,
        joints: ratn.Joints | Sequence[float] | Value,
        arm: str | Value = ...,
        speed: float | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _ArmMoveTo: ...
    def where(
        self,
        *,
        arm: str | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _ArmWhere: ...

arm: _Arm

class _BaseDrive(ratn.State):
    end: Value
    tracking_max_m: Value
    tracking_max_rad: Value
    tracking_rms_m: Value
    tracking_rms_rad: Value

class _BaseLocalise(ratn.State):
    pose: Value

class _Base:
    def drive(
        self,
        *,
        trajectory: ratn.Trajectory | Value,
        **annotations: Unpack[Annotations],
    ) -> _BaseDrive: ...
    def localise(
        self,
        **annotations: Unpack[Annotations],
    ) -> _BaseLocalise: ...

base: _Base

class _CameraCapture(ratn.State):
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
    ) -> _CameraCapture: ...

camera: _Camera

class _DetectorLocate(ratn.State):
    confidence: Value
    covariance: Value
    pose: Value
    size: Value

class _DetectorSegment(ratn.State):
    boxes: Value

class _Detector:
    def locate(
        self,
        *,
        object: Mapping[str, Any] | Value,
        classes: Sequence[Any] | Value = ...,
        frames: int | Value = ...,
        measures: Sequence[Any] | Value = ...,
        surface_m: float | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _DetectorLocate: ...
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
    ) -> _DetectorSegment: ...

detector: _Detector

class _GripperFeel(ratn.State):
    holding: Value
    width_m: Value

class _GripperGrasp(ratn.State):
    width_m: Value

class _GripperRelease(ratn.State):
    ...

class _Gripper:
    def feel(
        self,
        *,
        arm: str | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _GripperFeel: ...
    def grasp(
        self,
        *,
        object: str | Value,
        arm: str | Value = ...,
        expected: ratn.Pose | Value = ...,
        hand: str | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _GripperGrasp: ...
    def release(
        self,
        *,
        arm: str | Value = ...,
        width_m: float | Value = ...,
        **annotations: Unpack[Annotations],
    ) -> _GripperRelease: ...

gripper: _Gripper

class _PanTiltLookAt(ratn.State):
    pan: Value
    tilt: Value

class _PanTilt:
    def look_at(
        self,
        *,
        target: ratn.Pose | Value,
        **annotations: Unpack[Annotations],
    ) -> _PanTiltLookAt: ...

pan_tilt: _PanTilt

class _PathPlannerDrive(ratn.State):
    end: Value
    length_m: Value
    planning_s: Value
    trajectory: Value

class _PathPlannerPlan(ratn.State):
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
    ) -> _PathPlannerDrive: ...
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
    ) -> _PathPlannerPlan: ...

path_planner: _PathPlanner
