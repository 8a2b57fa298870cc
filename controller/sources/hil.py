"""Where positions come from: the emulator's HIL messages, as `PositionSample`.

The only fields that reach a law are those of ATT_POS_MOCAP; of HIL_SENSOR the time is read, which makes it the tick.
HIL_GPS, HIL_STATE_QUATERNION and ODOMETRY are not looked at.
"""

from __future__ import annotations

from protocol.messages import VEHICLE, PositionSample
from protocol.wire import mapping
from protocol.wire.codec import Frame


class HilTelemetry:
    """Joins the pose and the tick of one time into a sample.

    counters   unknown_sender     frames of these messages from somebody else than the emulator
               bad_pose           poses with NaN, or a quaternion that is not unit
               tick_without_pose  ticks whose pose was lost: no sample
               backwards          ticks older than the newest one
    """

    def __init__(self, emulator_component: int) -> None:
        self._sender = (VEHICLE[0], emulator_component)
        self._pose: PositionSample | None = None
        self._newest_ns = -1
        self.counters = {"unknown_sender": 0, "bad_pose": 0, "tick_without_pose": 0, "backwards": 0}

    def taken(self, t_ns: int) -> None:
        """Take note of the sample of time t_ns, read elsewhere."""
        self._newest_ns = t_ns

    def is_telemetry(self, frame: Frame) -> bool:
        """Whether a frame is one of the two messages read here."""
        return frame.message_id in (mapping.POSE.message_id, mapping.TICK.message_id)

    def take(self, frame: Frame) -> PositionSample | None:
        """Take one frame; the sample where the frame completes one (again, where the tick was sent again)."""
        if (frame.system, frame.component) != self._sender:
            self.counters["unknown_sender"] += 1
            return None
        if frame.message_id == mapping.POSE.message_id:
            self._pose = mapping.decode_pose(frame.payload)
            if self._pose is None:
                self.counters["bad_pose"] += 1
            return None
        if mapping.tick_sensor_id(frame.payload) != 0:
            return None
        t_ns = mapping.decode_tick_time_ns(frame.payload)
        if t_ns < self._newest_ns:
            self.counters["backwards"] += 1
            return None
        sample = self._pose
        if sample is None or sample.t_ns != t_ns:
            self.counters["tick_without_pose"] += 1
            return None
        self._newest_ns = t_ns
        return sample
