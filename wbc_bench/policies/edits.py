"""Single changes of a card, each of which undoes one mistake that people make when they describe a policy."""

from collections.abc import Iterator
from typing import NamedTuple

import msgspec

from wbc_bench.policies.card import PolicyCard
from wbc_bench.policies.terms import FRAMES, TERMS
from wbc_bench.robot import JOINT_NAMES, NUM_LEG_JOINTS, Robot

_HALF = NUM_LEG_JOINTS // 2
_LEFT, _RIGHT, _ARM = JOINT_NAMES[:_HALF], JOINT_NAMES[_HALF:NUM_LEG_JOINTS], JOINT_NAMES[NUM_LEG_JOINTS:]
_PAIRS = tuple(name for pair in zip(_LEFT, _RIGHT, strict=True) for name in pair)
ORDERS = {
    "left leg, right leg, arm": JOINT_NAMES,
    "left and right in turns, as Isaac Lab sorts them, then the arm": (*_PAIRS, *_ARM),
    "right leg, left leg, arm": (*_RIGHT, *_LEFT, *_ARM),
    "arm first, then left and right leg": (*_ARM, *_LEFT, *_RIGHT),
    "arm first, then left and right in turns": (*_ARM, *_PAIRS),
}


class Edit(NamedTuple):
    """A card with one change."""

    fault: str  # what the card as it stands has wrong, if this one is right
    remedy: str
    card: PolicyCard


def edits(card: PolicyCard, robot: Robot) -> Iterator[Edit]:
    """All single changes that make sense for a card, the most frequent mistakes first."""
    yield from _orders(card)
    yield from _histories(card)
    if card.action.kp is not None or card.action.kd is not None:
        own = _replace(card, action=_replace(card.action, kp=None, kd=None))
        yield Edit("gains", "leave out action.kp and action.kd: the variant's own gains", own)
    if any(_quaternions(term.term) for group in card.observation for term in group.terms):
        other = "xyzw" if card.quaternion == "wxyz" else "wxyz"
        yield Edit("quaternion order", f"quaternion = '{other}'", _replace(card, quaternion=other))
    yield from _frames(card)
    yield from _actions(card, robot)
    yield from _signs(card)


def _actions(card: PolicyCard, robot: Robot) -> Iterator[Edit]:
    names = card.action.joints or card.joints
    if card.action.type == "position":
        for offset in ("default", 0.0):
            if offset != card.action.offset:
                action = _replace(card.action, offset=offset)
                yield Edit("default posture", f"action.offset = {offset!r}", _replace(card, action=action))
        if card.default_posture:
            plain = _replace(card, default_posture={})
            yield Edit("default posture", "leave out default_posture: the variant's own", plain)
        own_scale = tuple(float(robot.action_scale[JOINT_NAMES.index(name)]) for name in names)
        for scale in (own_scale, 0.25, 0.5):
            if scale != card.action.scale:
                action = _replace(card.action, scale=scale)
                yield Edit("action scale", f"action.scale = {scale}", _replace(card, action=action))


def _orders(card: PolicyCard) -> Iterator[Edit]:
    for text, order in ORDERS.items():
        chosen = tuple(name for name in order if name in card.joints)
        if chosen == card.joints:
            continue

        def ordered(names: tuple[str, ...], order=order) -> tuple[str, ...]:
            return tuple(name for name in order if name in names)

        groups = tuple(
            _replace(group, terms=tuple(_replace(term, joints=ordered(term.joints)) for term in group.terms))
            for group in card.observation
        )
        action = _replace(card.action, joints=ordered(card.action.joints))
        yield Edit(
            "joint order",
            f"joints in the order: {text}",
            _replace(card, joints=chosen, observation=groups, action=action),
        )


def _histories(card: PolicyCard) -> Iterator[Edit]:
    for k, group in enumerate(card.observation):
        if max([group.history, *(term.history for term in group.terms)]) == 1:
            continue
        order = "newest_first" if group.history_order == "oldest_first" else "oldest_first"
        changed = _replace(group, history_order=order)
        remedy = f"history_order = '{order}' of observation '{group.name}'"
        yield Edit("history order", remedy, _with_group(card, k, changed))
        if not any(term.history for term in group.terms):
            layout = "frame" if group.history_layout == "term" else "term"
            changed = _replace(group, history_layout=layout)
            remedy = f"history_layout = '{layout}' of observation '{group.name}'"
            yield Edit("history order", remedy, _with_group(card, k, changed))


def _frames(card: PolicyCard) -> Iterator[Edit]:
    """All poses of a frame at once: nobody mixes them by mistake."""
    used = {t.frame for g in card.observation for t in g.terms if TERMS[t.term].kind == "pose"}
    for then in sorted(used):
        for now in FRAMES["pose"]:
            if now != then:
                yield Edit("frame", f"frame = '{now}' where it is '{then}'", _reframed(card, then, now))


def _reframed(card: PolicyCard, then: str, now: str) -> PolicyCard:
    groups = []
    for group in card.observation:
        terms = (
            _replace(t, frame=now) if TERMS[t.term].kind == "pose" and t.frame == then else t
            for t in group.terms
        )
        groups.append(_replace(group, terms=tuple(terms)))
    return _replace(card, observation=tuple(groups))


def _signs(card: PolicyCard) -> Iterator[Edit]:
    action = _replace(card.action, scale=_minus(card.action.scale))
    yield Edit("sign", "action.scale with the other sign", _replace(card, action=action))
    names = dict.fromkeys(term.term for group in card.observation for term in group.terms)
    for name in names:
        groups = tuple(
            _replace(
                group,
                terms=tuple(
                    _replace(term, scale=_minus(term.scale)) if term.term == name else term
                    for term in group.terms
                ),
            )
            for group in card.observation
        )
        yield Edit("sign", f"scale of {name} with the other sign", _replace(card, observation=groups))


def _minus(numbers):
    return tuple(-number for number in numbers) if isinstance(numbers, tuple) else -numbers


def _quaternions(term: str) -> bool:
    return "quat" in term or term in ("ee_pose", "ee_target")


def _with_group(card: PolicyCard, index: int, group) -> PolicyCard:
    groups = [*card.observation]
    groups[index] = group
    return _replace(card, observation=tuple(groups))


def _replace(struct, **changes):
    return msgspec.structs.replace(struct, **changes)
