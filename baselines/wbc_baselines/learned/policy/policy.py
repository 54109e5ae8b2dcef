"""A trained method as one function of observation, window and recurrent state."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from wbc_baselines.learned.policy.estimators import Estimator
from wbc_baselines.learned.policy.inputs import (
    COMMAND,
    HISTORY,
    HISTORY_FRAME,
    OBSERVATION,
    VELOCITY,
)
from wbc_baselines.learned.policy.networks import Actor


class Flow(NamedTuple):
    """Names and shapes of the inputs and outputs of a policy, without the batch axis in front.

    The names are those of exported ONNX files; `term` is the newest frame of the window.
    """

    inputs: dict[str, tuple[int, ...]]
    outputs: tuple[str, ...]  # `window` and `state` are the next step's inputs


class Policy(nn.Module):
    """Actor and estimator, deterministic: with the means of latent and action."""

    def __init__(self, actor: Actor, estimator: Estimator) -> None:
        super().__init__()
        self.actor, self.estimator = actor, estimator
        self.flow = flow_of(estimator)

    def forward(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        """Compute one control step of N robots; returns those of `flow`, and any `latent`."""
        parts, found = [values["observation"], values["command"]], {}
        if "privileged" in values:
            parts.append(values["privileged"])
        elif "window" in values:
            found["window"] = torch.cat([values["window"][:, 1:], values["term"][:, None]], dim=1)
            state = values.get("state", values["term"][:, :0])
            context, state = self.estimator.step(found["window"], state)
            parts.append(context)
            found["latent"] = context[:, VELOCITY:]
            if "state" in values:
                found["state"] = state
        return {"action": self.actor(torch.cat(parts, dim=-1))} | found


def flow_of(estimator: Estimator) -> Flow:
    """Return the inputs and outputs of a policy with this estimator."""
    inputs: dict[str, tuple[int, ...]] = {"observation": (OBSERVATION,), "command": (COMMAND,)}
    outputs = ["action"]
    if estimator.trainable:
        inputs |= {"term": (HISTORY_FRAME,), "window": (HISTORY, HISTORY_FRAME)}
        outputs.append("window")
        if estimator.state_dim:
            inputs["state"] = (estimator.state_dim,)
            outputs.append("state")
    elif estimator.context_dim:
        inputs["privileged"] = (estimator.context_dim,)
    return Flow(inputs, tuple(outputs))
