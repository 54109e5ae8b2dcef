"""A policy in a process of its own, which imports nothing of this project.

    python examples/remote_policy.py 5605
    wbc-bench eval --controller remote:tcp://127.0.0.1:5605 --protocol smoke_v1 --out build/remote

It holds the default posture and turns the arm towards the target. The messages: docs/remote.md.
"""

import sys

import msgspec
import numpy as np
import zmq


def array(packed):
    return np.frombuffer(packed["data"], packed["dtype"]).reshape(packed["shape"])


def serve(socket):
    """Answers until the context of the socket ends."""
    default_q = np.zeros(14)
    while True:
        asked, answer = msgspec.msgpack.decode(socket.recv()), {}
        if asked["type"] == "hello":
            default_q = np.array(asked["default_q"])
            answer = {"name": "remote_lean", "signals": ["ee_pose"], "control_period": 0.02, "digest": "1"}
        elif asked["type"] == "act":
            target = array(asked["target"]["pos_b"])
            q = np.tile(default_q, (len(target), 1))
            q[:, 8] += np.arctan2(target[:, 1], target[:, 0]) + 0.1 * array(asked["ee_pose"]["pos_b"])[:, 0]
            answer = {"q": {"dtype": "<f8", "shape": q.shape, "data": q.tobytes()}}
        socket.send(msgspec.msgpack.encode(answer))


if __name__ == "__main__":
    replies = zmq.Context().socket(zmq.REP)
    replies.bind(f"tcp://127.0.0.1:{sys.argv[1]}")
    serve(replies)
