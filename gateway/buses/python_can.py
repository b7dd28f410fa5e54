"""Frames <-> messages of python-can."""

from __future__ import annotations

import can

from protocols.frames import CanFrame


def frame_of(message: can.Message) -> CanFrame:
    """Return a message as a frame; a remote frame carries no data, but the length that it asks for."""
    return CanFrame(
        message.arbitration_id,
        b"" if message.is_remote_frame else bytes(message.data),
        message.is_extended_id,
        message.is_remote_frame,
        message.is_fd,
        message.bitrate_switch,
        min(message.dlc, 8) if message.is_remote_frame else 0,
    )


def message_of(frame: CanFrame) -> can.Message:
    """Return a frame as a message."""
    return can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        dlc=frame.requested if frame.remote else None,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        is_fd=frame.fd,
        bitrate_switch=frame.brs,
    )
