"""wbc-bench: whole-body controllers of a legged manipulator, measured on identical episodes."""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

# Imported when they are first asked for: the command line must not wait for MuJoCo to print its help.
_EXPORTS = {
    "Controller": "wbc_bench.controller",
    "ControllerInfo": "wbc_bench.controller",
    "EvalProtocol": "wbc_bench.episodes.protocol",
    "JointCommand": "wbc_bench.controller",
    "Observation": "wbc_bench.controller",
    "Results": "wbc_bench.evaluation.evaluate",
    "Target": "wbc_bench.controller",
    "compare": "wbc_bench.evaluation.evaluate",
    "evaluate": "wbc_bench.evaluation.evaluate",
    "load_controller": "wbc_bench.registry",
    "load_protocol": "wbc_bench.episodes.protocol",
    "load_robot": "wbc_bench.robot",
    "per_episode": "wbc_bench.episode_function",
}

if TYPE_CHECKING:
    from wbc_bench.controller import Controller, ControllerInfo, JointCommand, Observation, Target
    from wbc_bench.episode_function import per_episode
    from wbc_bench.episodes.protocol import EvalProtocol, load_protocol
    from wbc_bench.evaluation.evaluate import Results, compare, evaluate
    from wbc_bench.registry import load_controller
    from wbc_bench.robot import load_robot

__all__ = [
    "Controller",
    "ControllerInfo",
    "EvalProtocol",
    "JointCommand",
    "Observation",
    "Results",
    "Target",
    "compare",
    "evaluate",
    "load_controller",
    "load_protocol",
    "load_robot",
    "per_episode",
]


def __getattr__(name: str):
    if name not in _EXPORTS:
        raise AttributeError(f"module 'wbc_bench' has no attribute '{name}', valid: {', '.join(__all__)}")
    return getattr(import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
