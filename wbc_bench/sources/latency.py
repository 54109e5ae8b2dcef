"""How old a streamed target is when it is used: `wbc-bench bench stream`."""

import multiprocessing
import time

import numpy as np
import pandas as pd

from wbc_bench.sources.interface import Seen, StampedTarget
from wbc_bench.sources.message import encode
from wbc_bench.sources.stream import StreamSource

LOCAL = "tcp://127.0.0.1:*"  # any free port
SECONDS = 10.0  # [s] a row
PERIOD = 0.02  # [s] of control
CASES = (  # name, sent [Hz], used every [s]; no multiple of the control rate, or the phase would be luck
    ("control loop, 50 Hz", 260.0, PERIOD),
    ("control loop, 50 Hz, from a headset", 90.0, PERIOD),
    ("transport alone", 260.0, 0.0),
)
SEEN = Seen(np.zeros(3), np.eye(3), np.zeros(3), np.eye(3), np.zeros(3))


def stream_latency(seconds: float = SECONDS) -> pd.DataFrame:
    """Time [s] from sending in one process to use in another, over loopback; one row a case.

    A control loop uses the latest target at its own instants, so that a target waits up to a sending period;
    the transport alone is what remains when it is asked for without pause.
    """
    return pd.DataFrame([_row(name, rate, period, seconds) for name, rate, period in CASES])


def _row(name: str, rate: float, period: float, seconds: float) -> dict[str, object]:
    source = StreamSource(LOCAL)
    client = multiprocessing.get_context("spawn").Process(
        target=_send, args=(source.address, rate), daemon=True
    )
    client.start()
    try:
        ages, refused = _ages(source, period, seconds)
    finally:
        client.kill()
        client.join()
        source.close()
    return {
        "case": name,
        "sent (Hz)": rate,
        "uses": len(ages),
        "refused": refused,
        "median (ms)": 1e3 * float(np.median(ages)),
        "P99 (ms)": 1e3 * float(np.quantile(ages, 0.99)),
        "largest (ms)": 1e3 * float(ages.max()),
    }


def _ages(source: StreamSource, period: float, seconds: float) -> tuple[np.ndarray, int]:
    """Age [s] of every newly arrived target at its first use, and the messages refused meanwhile."""
    source.reset(SEEN)
    while source.counters["accepted"] == 0:  # the client's interpreter starts
        source.target(0.0, SEEN)
    before = _refused(source)  # what queued up until the sockets had found each other is late
    ages, start, step = [], time.monotonic(), 0
    while time.monotonic() < start + seconds:
        step += 1
        time.sleep(max(0.0, start + step * period - time.monotonic()))
        source.target(step * period, SEEN)
        if not np.isnan(source.filter.latency):
            ages.append(source.filter.latency)
    return np.array(ages), _refused(source) - before


def _refused(source: StreamSource) -> int:
    return sum(source.counters.values()) - source.counters["accepted"]


def _send(address: str, rate: float) -> None:
    import zmq

    socket = zmq.Context().socket(zmq.PUSH)
    socket.connect(address)
    start, sequence = time.monotonic(), 0
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    while True:
        target = StampedTarget(time.time(), "world", np.zeros(3), identity)
        socket.send(encode(target, session=1, sequence=sequence))
        sequence += 1
        time.sleep(max(0.0, start + sequence / rate - time.monotonic()))
