"""Sends targets to a robot of the bench over ZeroMQ: a slow horizontal circle in front of it.

Two terminals (extras `ik` and `live`):

    wbc-bench track --controller ik --source stream --duration 20 --out build/stream
    python examples/stream_client.py

The fields of a message, and what happens to a bad one, are in wbc_bench/sources/STREAM.md. Nothing of
`wbc_bench` is imported: any language with ZeroMQ and msgpack can do the same.
"""

import argparse
import math
import random
import time

import msgspec
import zmq

CENTRE = (0.40, 0.0, 1.15)  # [m] in the world: the origin is on the ground under the base at the start
RADIUS = 0.06  # [m]
PERIOD = 8.0  # [s] of one circle: 0.05 m/s, far below the 0.3 m/s to which the bench limits a target
INTERVAL = 0.01  # [s] between messages; after 0.25 s of silence the target stays where it is


def pose(t: float) -> tuple[list[float], list[float]]:
    """Position [m] and quaternion (scalar first) at time t [s]; the gripper points forward."""
    angle = 2.0 * math.pi * t / PERIOD
    x, y, z = CENTRE
    return [x + RADIUS * math.cos(angle), y + RADIUS * math.sin(angle), z], [1.0, 0.0, 0.0, 0.0]


def main() -> None:
    parser = argparse.ArgumentParser(description="Send a circle of targets.")
    parser.add_argument("--address", default="tcp://127.0.0.1:5601")
    parser.add_argument("--seconds", type=float, default=30.0)
    options = parser.parse_args()

    socket = zmq.Context.instance().socket(zmq.PUSH)
    socket.setsockopt(zmq.CONFLATE, 1)  # only the latest target matters; an old one would be refused as late
    socket.setsockopt(zmq.LINGER, 0)  # do not wait for a receiver at the end
    socket.connect(options.address)
    session = random.getrandbits(63)  # tells this client from the one before
    start = time.monotonic()
    sequence = 0
    while (t := time.monotonic() - start) < options.seconds:
        pos, quat_wxyz = pose(t)
        message = {
            "version": 1,
            "session": session,
            "sequence": sequence,
            "time": time.time(),
            "frame": "world",
            "pos": pos,
            "quat_wxyz": quat_wxyz,
        }
        socket.send(msgspec.msgpack.encode(message))
        sequence += 1
        time.sleep(INTERVAL)
    print(f"{sequence} targets sent to {options.address}")


if __name__ == "__main__":
    main()
