"""A trained method as one function of observation, window and recurrent state."""

import torch
from torch import Tensor, nn

from wbc_baselines.learned.policy.architecture import Sizes, flow_of
from wbc_baselines.learned.policy.estimators import Estimator
from wbc_baselines.learned.policy.inputs import VELOCITY
from wbc_baselines.learned.policy.networks import Actor


class Policy(nn.Module):
    """Actor and estimator, deterministic: with the means of latent and action."""

    def __init__(self, actor: Actor, estimator: Estimator) -> None:
        super().__init__()
        self.actor, self.estimator = actor, estimator
        self.flow = flow_of(Sizes(estimator.context_dim, estimator.state_dim, estimator.latent_dim))

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
