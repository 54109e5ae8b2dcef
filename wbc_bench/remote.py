"""A policy in another process, `remote:tcp://127.0.0.1:PORT`; the messages are on the page docs/remote.md.

The simulation waits for every answer, so that results are those of the same code in this process.
"""

import uuid
import warnings
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import COMMAND_PARTS, Controller, ControllerInfo, JointCommand, Observation, Target
from wbc_bench.errors import ControllerError, missing_extra
from wbc_bench.robot import JOINT_NAMES, NUM_JOINTS, Robot

VERSION = 1
HELLO_TIMEOUT = 5.0  # [s] for the first answer
TIMEOUT = 1.0  # [s] for every further one
LARGEST = 16 << 20  # [B] of an answer
DTYPES = ("<f8", "<f4", "|b1")


class Info(msgspec.Struct, forbid_unknown_fields=True):
    """The answer to `hello`."""

    name: str
    signals: list[str]
    control_period: float
    commands: list[str] = []
    digest: str = ""


class PackedArray(msgspec.Struct, forbid_unknown_fields=True):
    """An array on the wire, row by row."""

    dtype: str
    shape: list[int]
    data: bytes


class Command(msgspec.Struct, forbid_unknown_fields=True):
    """The answer to `act`: the fields of a `JointCommand`."""

    q: PackedArray
    infeasible: PackedArray | None = None
    kp: PackedArray | None = None
    kd: PackedArray | None = None
    qd: PackedArray | None = None
    torque: PackedArray | None = None
    action: PackedArray | None = None


class RemoteController:
    """Asks a policy that listens at an address. One that does not answer in time gets no further question."""

    def __init__(self, robot: Robot, address: str, timeout: float = TIMEOUT) -> None:
        """Raises: ControllerError, nobody answers, or the answer is not one."""
        try:
            import zmq
        except ImportError as error:
            raise ControllerError(missing_extra("a remote policy", "live", error)) from error
        self._address, self._timeout, self._zmq = address, timeout, zmq
        self._session, self._silent = uuid.uuid4().hex, False
        self._socket = zmq.Context.instance().socket(zmq.REQ)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LARGEST)
        try:
            self._socket.connect(address)
        except zmq.ZMQError as error:
            raise ControllerError(f"remote policy at '{address}': {error}, valid: tcp://HOST:PORT") from error
        facts = {
            name: getattr(robot, name).tolist()
            for name in ("default_q", "action_scale", "kp", "kd", "effort")
        }
        hello = {"version": VERSION, "variant": robot.config.variant, "joints": JOINT_NAMES, **facts}
        info = self._ask("hello", hello, Info, HELLO_TIMEOUT)
        if info is None:
            raise ControllerError(f"remote policy at '{address}': no answer within {HELLO_TIMEOUT:g} s")
        self.info = ControllerInfo(
            info.name,
            frozenset(info.signals),  # pyright: ignore[reportArgumentType]  (checked where it is loaded)
            info.control_period,
            f"remote policy at {address}",
            commands=frozenset(info.commands),  # pyright: ignore[reportArgumentType]
        )
        self._digest = info.digest

    def digest(self) -> str:
        """What the policy says of its own version; its code is not here."""
        return self._digest

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Tell it which episodes start."""
        self._ask("reset", {"episodes": episodes.tolist(), **_seen(obs, target)}, dict, self._timeout)

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """Its commands of one control step; NaN, which ends the episodes as `invalid`, once it is silent."""
        found = self._ask("act", _seen(obs, target), Command, self._timeout)
        if found is None:
            return JointCommand(np.full((len(obs.active), NUM_JOINTS), np.nan), None, **self._nothing(obs))
        parts = {
            name: self._array(name, getattr(found, name))
            for name in ("q", "infeasible", *COMMAND_PARTS)
            if getattr(found, name) is not None
        }
        return JointCommand(**parts)

    def _nothing(self, obs: Observation) -> dict[str, NDArray[np.float64]]:
        return {"action": np.full((len(obs.active), 1), np.nan)} if "action" in self.info.commands else {}

    def _ask(self, kind: str, content: dict[str, Any], answer: type, timeout: float) -> Any:
        """One question and its answer; None from a policy that is silent.

        Raises: ControllerError, the answer is not of its kind.
        """
        if self._silent:
            return None
        self._socket.send(msgspec.msgpack.encode({"type": kind, "session": self._session, **content}))
        if not self._socket.poll(1000 * timeout):  # [ms]
            self._silent = True
            self._socket.close()
            if kind != "hello":
                warnings.warn(
                    f"remote policy at '{self._address}' did not answer `{kind}` within {timeout:g} s: its "
                    "episodes end as invalid",
                    stacklevel=2,
                )
            return None
        try:
            return msgspec.msgpack.decode(self._socket.recv(), type=answer)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            raise ControllerError(
                f"remote policy at '{self._address}' answered `{kind}` with something else: {error}"
            ) from error

    def _array(self, name: str, packed: PackedArray) -> NDArray:
        what = f"remote policy at '{self._address}': `{name}`"
        if packed.dtype not in DTYPES:
            raise ControllerError(f"{what} of type '{packed.dtype}', valid: {', '.join(DTYPES)}")
        size, width = float(np.prod(packed.shape, dtype=float)), np.dtype(packed.dtype).itemsize
        if any(one < 0 for one in packed.shape) or size * width != len(packed.data):
            numbers = len(packed.data) / width
            raise ControllerError(f"{what} has {numbers:g} numbers, its shape says {packed.shape}")
        array = np.frombuffer(packed.data, np.dtype(packed.dtype))
        return array.reshape(packed.shape)


def _seen(obs: Observation, target: Target) -> dict[str, Any]:
    """Observation and target as they travel; signals that are not declared are left out."""
    signals = {
        name: {field: _packed(value) for field, value in part._asdict().items()}
        for name, part in obs._asdict().items()
        if isinstance(part, tuple)
    }
    targets = {field: _packed(value) for field, value in target._asdict().items()}
    return {"time": obs.time, "active": _packed(obs.active), **signals, "target": targets}


def _packed(array: NDArray) -> dict[str, Any]:
    array = np.ascontiguousarray(array)
    return {"dtype": array.dtype.str, "shape": array.shape, "data": array.tobytes()}


class Remote:
    """The entry point of policies in other processes."""

    def __call__(self, robot: Robot, variant: str = "") -> Controller:
        """The controller of `remote:ADDRESS` or `remote:ADDRESS?timeout=SECONDS`. Raises: ControllerError."""
        address, _, query = variant.partition("?")
        key, _, value = query.partition("=")
        try:
            timeout = float(value) if query else TIMEOUT
        except ValueError:
            timeout = float("nan")
        if "://" not in address or (query and key != "timeout") or not 0 < timeout < 3600:
            raise ControllerError(
                f"controller 'remote:{variant}', valid: remote:tcp://127.0.0.1:PORT or "
                "...:PORT?timeout=SECONDS"
            )
        return RemoteController(robot, address, timeout)

    def variants(self) -> list[tuple[str, str]]:
        """Return the form of a variant, with its description."""
        return [("tcp://HOST:PORT", "A policy in another process, asked at every control step.")]


make = Remote()
