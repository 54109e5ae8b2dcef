"""Made-up records for the tests of tables, figures and the report; nothing here is a result."""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import numpy as np
import pandas as pd

from wbc_bench.outcomes import SuccessRule
from wbc_bench.results.analysis import Evaluated, collect

STRATA = ("arm", "posture", "step")


@dataclass(frozen=True)
class FakeRun:
    record: SimpleNamespace
    frame: pd.DataFrame

    def episodes(self) -> pd.DataFrame:
        return self.frame


@dataclass(frozen=True)
class FakeStore:
    all_runs: list[FakeRun]

    def runs(self, protocol: str | None = None) -> list[FakeRun]:
        return [run for run in self.all_runs if protocol in (None, run.record.protocol)]


def methods_in(store: FakeStore, protocol: str = "ablation_v1") -> dict[str, Evaluated]:
    """What the tables and figures of a protocol are made of."""
    return collect(store.runs(protocol))


def record(controller: str, replicate: int, frame: pd.DataFrame, **changes) -> SimpleNamespace:
    outcome = frame["outcome"].value_counts().to_dict()
    values = {
        **{"protocol": "ablation_v1", "protocol_digest": "d" * 64, "manifest_sha256": "a" * 64},
        **{
            "controller": controller,
            "controller_name": controller,
            "signals": ["proprioception", "ee_pose"],
            "commands": [],
        },
        **{"controller_sha256": None, "resolved_controller": None},
        **{"source": "test", "replicate": replicate, "requested": len(frame), "completed": len(frame)},
        **{
            "checkpoint_sha256": None,
            "controller_sha256": None,
            "resolved_controller": None,
            "outcomes": outcome,
            "git_commit": "c" * 40,
            "git_dirty": False,
        },
        **{
            "versions": {"mujoco": "4.0.1"},
            "machine": {"cpu": "<made up>"},
            "wall_time_s": 1.5,
            "workers": 2,
        },
        "created": "2026-01-01T00:00:00Z",
        "rule": SuccessRule(),
    }
    return SimpleNamespace(**(values | changes))


def episodes(replicate: int, count: int, skill: float, seed: int) -> pd.DataFrame:
    """`count` episodes of a method whose success falls off from arm to step; skill in 0..1."""
    shared = np.random.default_rng([replicate, 99])  # the same episodes for every method
    rng = np.random.default_rng([replicate, seed])
    stratum = shared.integers(0, 3, count)
    chance = skill * np.array([1.0, 0.85, 0.25])[stratum]
    good = shared.random(count) < chance
    failures = ["missed", "drifted", "fell", "illegal_contact", "qp_infeasible", "invalid"]
    failure = rng.choice(failures, count, p=[0.4, 0.2, 0.25, 0.08, 0.05, 0.02])
    outcome = np.where(good, "success", failure)
    scale = np.where(good, 1.0, np.where(outcome == "fell", 30.0, 8.0))
    return frame_of(
        replicate,
        outcome,
        stratum=np.array(STRATA)[stratum],
        position_error=np.minimum(scale * 0.015 * rng.lognormal(0.0, 0.4, count), 2.0),
        orientation_error=np.minimum(scale * 0.03 * rng.lognormal(0.0, 0.4, count), 3.1),
        action_variation=0.05 + 0.01 * rng.random(count),
        ee_speed_rms=0.02 * scale * rng.lognormal(0.0, 0.3, count),
    )


def frame_of(replicate: int, outcome: np.ndarray, **columns) -> pd.DataFrame:
    count = len(outcome)
    frame = pd.DataFrame(
        {
            **{"replicate": replicate, "episode": np.arange(count), "stratum": "arm", "condition": ""},
            **{
                "orientation": "",
                "height": 1.0,
                "target_x": 0.5,
                "target_y": 0.0,
                "outcome": outcome,
                "steps": 500,
            },
            **{
                "success": (outcome == "success").astype(float),
                "position_error": 0.1,
                "orientation_error": 0.1,
            },
            **{"action_variation": 0.1, "ee_speed_rms": 0.01, "ee_sparc": -2.0, "duration": 10.0},
            "infeasible_steps": 0.0,
        }
    )
    return frame.assign(**columns)


def reach_episodes(seed: int) -> pd.DataFrame:
    """Heights 0..2 m every 5 cm, 20 episodes each; reached 5..185 cm nominal, 5..125 cm randomised."""
    rng = np.random.default_rng(seed)
    frames = []
    for condition, top in (("nominal", 1.85), ("randomised", 1.25)):
        for orientation in ("free", "horizontal"):
            for height in np.arange(0.0, 2.01, 0.05):
                near = 0.05 - 1e-6 <= height <= top + 1e-6
                error = np.full(20, 0.012 + 0.02 * (condition == "randomised")) if near else np.full(20, 0.3)
                outcome = np.where(rng.random(20) < (0.95 if near else 0.0), "success", "missed")
                outcome = np.where(rng.random(20) < (0.03 if near else 0.3), "fell", outcome)
                sway = 0.01 + 0.05 * np.exp(-abs(height - top) / 0.1) + 0.01 * (condition == "randomised")
                frame = frame_of(
                    *(0, outcome),
                    condition=condition,
                    orientation=orientation,
                    height=height,
                    stratum="beyond" if height > 1.9 or height < 0.02 else "posture",
                    position_error=error * rng.lognormal(0.0, 0.25, 20),
                    ee_speed_rms=sway * rng.lognormal(0.0, 0.3, 20),
                    ee_sparc=-1.5 - 20.0 * sway * rng.random(20),
                )
                frames.append(frame)
    frame = pd.concat(frames, ignore_index=True)
    return frame.assign(episode=np.arange(len(frame)))


@cache
def study_store(count: int = 120, replicates: int = 3) -> FakeStore:
    runs = []
    for seed, (controller, skill) in enumerate(
        {"hold": 0.02, "ik": 0.9, "ik:kinematic": 0.5, "ik:osqp": 0.9}.items()
    ):
        for replicate in range(replicates):
            frame = episodes(replicate, count, skill, seed)
            runs.append(FakeRun(record(controller, replicate, frame), frame))
    return FakeStore(runs)


@cache
def reach_store() -> FakeStore:
    frame = reach_episodes(0)
    changes = {"protocol": "reach_v1", "protocol_digest": "e" * 64, "manifest_sha256": "b" * 64}
    return FakeStore([FakeRun(record("ik", 0, frame, **changes), frame)])
