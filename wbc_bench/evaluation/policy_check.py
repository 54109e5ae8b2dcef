"""A policy's card on trial: it drives a few episodes, and so do cards that differ in one thing."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import Controller
from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import BenchError, ControllerError
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.outcomes import TERMINATED
from wbc_bench.policies.card import PolicyCard, read_card
from wbc_bench.policies.controller import CardController, from_card
from wbc_bench.policies.edits import Edit, edits
from wbc_bench.policies.normalizer import Normalizer, read_normalizers, symmetry_by_order
from wbc_bench.robot import Robot, load_robot

Array = NDArray[np.float64]

UNDISTURBED = {"paper": "nominal_v2", "limx_adapter": "nominal_v1"}  # protocol by variant
EPISODES = 3
HORIZON = 2.0  # [s]
CLEARLY = 0.1  # how much better a card must be to be named; choice
GOOD = 0.8  # score that is not searched for any longer


class Trial(NamedTuple):
    """How a card did; `score` is 1 at best."""

    upright: float  # share of the time that was stood, 0 to 1
    position_error: float  # [m] mean over the episodes, of the last step of each
    orientation_error: float  # [rad]

    @property
    def score(self) -> float:
        """Who stands and comes near the target is better; a fall counts most."""
        near = np.exp(-self.position_error / 0.2) * np.exp(-self.orientation_error / 0.5)
        return float(0.5 * self.upright + 0.5 * self.upright * near)


class Verdict(NamedTuple):
    """What a check found."""

    card: PolicyCard
    controller: CardController
    trial: Trial
    first: dict[str, Array]  # what each observation begins with, (width,)
    normalizers: dict[str, Normalizer]  # of the observations whose network subtracts a mean
    symmetry: dict[str, dict[str, float]]  # term -> order of joints -> asymmetry of its mean
    edit: Edit | None = None  # the change that makes it clearly better
    edited: Trial | None = None

    @property
    def good(self) -> bool:
        """Whether the card as it is needs no change."""
        return self.trial.score >= GOOD


def trial_episodes(variant: str) -> tuple[EvalProtocol, EpisodeManifest]:
    """A short part of the undisturbed protocol of a robot, with targets that the arm alone reaches.

    Raises: ControllerError, there is none for the variant.
    """
    if variant not in UNDISTURBED:
        raise ControllerError(f"robot '{variant}' of a policy card, valid: {', '.join(UNDISTURBED)}")
    protocol, path = find_protocol(UNDISTURBED[variant])
    rows, _ = read_manifest(protocol, manifest_path(path))
    chosen = np.flatnonzero(rows.stratum == "arm")[:EPISODES]
    episodes = msgspec.structs.replace(protocol.episodes, horizon=HORIZON)
    success = msgspec.structs.replace(protocol.success, window=min(protocol.success.window, HORIZON))
    return msgspec.structs.replace(protocol, episodes=episodes, success=success), rows.take(chosen)


def stand(controller: Controller, protocol: EvalProtocol, rows: EpisodeManifest) -> Trial:
    """Run the episodes of a trial. Raises: ControllerError, see `rollout`."""
    batch = rollout(controller, protocol, rows)
    count = np.arange(len(batch.steps))
    last = np.maximum(batch.steps - 1, 0)
    fallen = np.isin(batch.outcome, TERMINATED)
    upright = np.where(fallen, batch.steps / protocol.num_steps, 1.0)
    position, orientation = (
        np.nan_to_num(errors[count, last], nan=1.0)
        for errors in (batch.position_error, batch.orientation_error)
    )
    return Trial(float(upright.mean()), float(position.mean()), float(orientation.mean()))


def check_policy(
    path: Path, progress: Callable[[Edit], None] = lambda edit: None, search: bool = True
) -> Verdict:
    """Load a card, try it, and look for the one change that makes it clearly better.

    Raises: ControllerError, UnknownNameError: the card cannot be used at all.
    """
    card = read_card(path)
    protocol, rows = trial_episodes(card.robot or "paper")
    robot = load_robot(protocol.robot)
    controller = from_card(robot, path, card)
    begun, means = _begin(controller, protocol, rows), _normalizers(controller)
    first = stand(controller, protocol, rows)
    verdict = Verdict(card, controller, first, begun, means, _symmetry(controller, means, robot))
    best: tuple[Trial, Edit] | None = None
    if search and not verdict.good:
        for edit in edits(card, robot):
            progress(edit)
            try:
                found = stand(from_card(robot, path, edit.card), protocol, rows)
            except BenchError:  # the change does not fit this policy
                continue
            if best is None or found.score > best[0].score:
                best = found, edit
            if found.score >= GOOD:
                break
    if best is not None and best[0].score > first.score + CLEARLY:
        return verdict._replace(edit=best[1], edited=best[0])
    return verdict


def _begin(controller: CardController, protocol: EvalProtocol, rows: EpisodeManifest) -> dict[str, Array]:
    """The mean over the episodes of what the policy reads first; (width,) by observation."""
    next(ControlLoop(controller, protocol, rows).run())
    return {group.name: controller.values[group.name].mean(axis=0) for group in controller.groups}


def _normalizers(controller: CardController) -> dict[str, Normalizer]:
    """Observation -> what is subtracted from it, where an input of a network is that observation alone."""
    found = {}
    for network in controller.networks:
        read = read_normalizers(network.path, network.widths)
        for name, source in network.card.inputs.items():
            if isinstance(source, str) and name in read:
                found[source] = read[name]
    return found


def _symmetry(
    controller: CardController, normalizers: dict[str, Normalizer], robot: Robot
) -> dict[str, dict[str, float]]:
    found = {}
    for group in controller.groups:
        if group.name not in normalizers:
            continue
        labels, mean = group.labels(), normalizers[group.name].mean
        rows = [k for k, (term, _) in enumerate(labels) if term == "joint_pos_rel"]
        if rows and len(mean) == len(labels):
            names = tuple(labels[k][1] for k in rows)
            found[f"joint_pos_rel in '{group.name}'"] = symmetry_by_order(mean[rows], names, robot)
    return found
