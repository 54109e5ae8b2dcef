"""A policy's card: how somebody else's policy reads observations, and what its actions mean."""

import math
from pathlib import Path
from typing import Literal

import msgspec

from wbc_bench.errors import ControllerError, UnknownNameError
from wbc_bench.policies.terms import FRAMES, TERMS, Numbers, Part, TermCard
from wbc_bench.readers import read_toml
from wbc_bench.robot import JOINT_NAMES


class GroupCard(Part, frozen=True):
    """A vector that goes into a network."""

    name: str
    terms: tuple[TermCard, ...]
    history: int = 1  # frames, the present one included
    history_order: Literal["oldest_first", "newest_first"] = "oldest_first"
    history_layout: Literal["term", "frame"] = (
        "term"  # all frames of a term, or all terms of a frame, together
    )
    history_start: Literal["repeat", "zeros"] = "repeat"  # what stands for frames before the first


class StateCard(Part, frozen=True):
    """What a network hands to itself: an output that is its input at the next step."""

    input: str
    output: str
    initial: str = ""  # a value whose first frame fills it; zeros when empty
    batch_axis: int = 0


class NetworkCard(Part, frozen=True):
    """One ONNX file."""

    file: str  # beside the card
    inputs: dict[str, str | tuple[str, ...]]  # of the graph, by the values that are joined for them
    outputs: dict[str, str]  # of the graph, by the names that their values get
    state: tuple[StateCard, ...] = ()


class ActionCard(Part, frozen=True):
    """What the numbers of the value `action` do: target = offset + scale * clipped and filtered action."""

    type: Literal["position", "torque"] = "position"
    joints: tuple[str, ...] = ()  # the card's when empty
    scale: Numbers = 1.0  # [rad] or [N m]
    offset: Literal["default"] | Numbers = "default"  # [rad] the default posture, or numbers
    clip: tuple[float, float] | None = None  # of the action
    filter: float = 1.0  # share of the newest action in what acts; 1 is no filter
    last_action: Literal["raw", "clipped"] = "clipped"  # what the term `last_action` shows
    kp: Numbers | None = None  # [N m/rad] the variant's when not given
    kd: Numbers | None = None  # [N m s/rad]
    others: str = "hold"  # who drives the other joints: `hold`, or the spec of a controller


class FollowerCard(Part, frozen=True):
    """How a target becomes the velocity commands of a walking policy, see `wbc_bench.policies.follower`."""

    gain: float = 1.0  # [1/s] velocity for each metre or radian that is left
    limits: tuple[float, float, float] = (0.5, 0.3, 0.6)  # [m/s], [m/s], [rad/s] largest of (vx, vy, wz)
    tolerance: tuple[float, float] = (0.03, 0.05)  # [m], [rad] errors that are left alone


class PolicyCard(Part, frozen=True):
    """A policy."""

    name: str  # of its rows in tables
    observation: tuple[GroupCard, ...]
    network: tuple[NetworkCard, ...]
    action: ActionCard = ActionCard()
    follower: FollowerCard | None = None
    source: str = ""
    robot: str = ""  # variant that it was made for; any when empty
    tcp: str = ""  # tool frame that it was made for; the robot's when empty
    control_period: float = 0.02  # [s]
    quaternion: Literal["wxyz", "xyzw"] = "wxyz"
    joints: tuple[str, ...] = JOINT_NAMES
    default_posture: dict[str, float] = msgspec.field(
        default_factory=dict
    )  # [rad] joints that are not named have the variant's


def read_card(path: Path) -> PolicyCard:
    """Read and check a card.

    Raises:
        ControllerError: It cannot be read, or a value is not valid; the path of the field is named.
        UnknownNameError: A term or a joint that does not exist.
    """
    card = read_toml(path, PolicyCard, "policy card", ControllerError)
    check_card(card, str(path))
    return card


def check_card(card: PolicyCard, where: str) -> None:
    """Check what the types of a card's fields cannot say. Raises: see `read_card`."""

    def refuse(field: str, value: object, valid: str) -> None:
        raise ControllerError(f"policy card {where}: {field} is {value}, valid: {valid}")

    def joints(names: tuple[str, ...], field: str) -> None:
        for name in names:
            if name not in JOINT_NAMES:
                raise UnknownNameError("joint", name, JOINT_NAMES, f"{field} of policy card {where}")
        if len(set(names)) < len(names):
            refuse(field, ", ".join(names), "each joint once")

    def finite(field: str, numbers: object) -> None:
        values = numbers if isinstance(numbers, tuple) else (numbers,)
        if not all(isinstance(value, float | int) and math.isfinite(value) for value in values):
            refuse(field, numbers, "finite numbers")

    if not card.name.strip():
        refuse("name", "empty", "a text")
    if not 0 < card.control_period <= 1:
        refuse("control_period", card.control_period, "above 0, at most 1 [s]")
    joints(card.joints, "joints")
    joints(tuple(card.default_posture), "default_posture")
    finite("default_posture", tuple(card.default_posture.values()))
    names = [group.name for group in card.observation]
    for group in card.observation:
        field = f"observation '{group.name}'"
        if names.count(group.name) > 1:
            refuse(field, "given twice", "each name once")
        if not group.terms:
            refuse(f"{field}.terms", "empty", "at least one term")
        if not 1 <= group.history <= 1000:
            refuse(f"{field}.history", group.history, "1 to 1000 frames")
        for term in group.terms:
            if term.term not in TERMS:
                raise UnknownNameError("term", term.term, TERMS, f"{field} of policy card {where}")
            place = f"{field}.{term.term}"
            joints(term.joints, f"{place}.joints")
            for part in ("scale", "offset", "value", "phases"):
                finite(f"{place}.{part}", getattr(term, part))
            if not 0 <= term.history <= 1000 or (term.history and group.history_layout == "frame"):
                refuse(f"{place}.history", term.history, "0 to 1000, and 0 where frames are kept together")
            if term.frame not in FRAMES[TERMS[term.term].kind]:
                refuse(f"{place}.frame", term.frame, ", ".join(FRAMES[TERMS[term.term].kind]))
    action = card.action
    joints(action.joints, "action.joints")
    for part in ("scale", "offset", "kp", "kd"):
        value = getattr(action, part)
        if value is not None and value != "default":
            finite(f"action.{part}", value)
    for part in ("kp", "kd"):
        value = getattr(action, part)
        if value is not None and min(value if isinstance(value, tuple) else (value,), default=0) < 0:
            refuse(f"action.{part}", value, "0 or more")
    if not 0 < action.filter <= 1:
        refuse("action.filter", action.filter, "above 0, at most 1")
    follower = card.follower
    if follower is not None:
        for part, values in (
            ("gain", (follower.gain,)),
            ("limits", follower.limits),
            ("tolerance", follower.tolerance),
        ):
            finite(f"follower.{part}", values)
            if min(values) < 0:
                refuse(f"follower.{part}", getattr(follower, part), "0 or more")
    terms = [term for group in card.observation for term in group.terms]
    follows = any(term.term == "velocity_commands" and not term.value for term in terms)
    if follows and follower is None:
        refuse("velocity_commands.value", "empty", "numbers, or a table [follower]")
    if follower is not None and not follows:
        refuse("follower", "given", "a term `velocity_commands` without `value`, which reads it")
    if not card.network:
        refuse("network", "empty", "at least one file")
    _check_flow(card, where)


def _check_flow(card: PolicyCard, where: str) -> None:
    """Raises: ControllerError, a network reads what is not written before, or `action` never is."""
    known = {group.name for group in card.observation}
    later = {value for network in card.network for value in network.outputs.values()}
    for network in card.network:
        initial = [state.initial for state in network.state if state.initial]
        for value in [*(one for names in network.inputs.values() for one in _listed(names)), *initial]:
            if value not in known:
                why = "is written by this network or a later one: a cycle" if value in later else "is missing"
                raise ControllerError(
                    f"policy card {where}: network '{network.file}' reads '{value}', which {why}; "
                    f"valid: {', '.join(sorted(known))}"
                )
        for value in network.outputs.values():
            if value in known:
                raise ControllerError(
                    f"policy card {where}: network '{network.file}' writes '{value}' again, valid: a new name"
                )
        known |= set(network.outputs.values())
    if "action" not in known:
        raise ControllerError(
            f"policy card {where}: no network writes 'action', valid: an output of the last one by that name"
        )


def _listed(names: str | tuple[str, ...]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else names
