"""The training environment of a configuration."""

import msgspec

from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.training.config import Settings, TrainingError
from wbc_baselines.learned.training.environment import Environment
from wbc_baselines.learned.training.target_set import TargetPool, read_pool
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol


def training_protocol(settings: Settings) -> EvalProtocol:
    """The protocol with the physics step and the pushes of training.

    Raises:
        TrainingError: the control period would not be the protocol's.
    """
    protocol, _ = find_protocol(settings.protocol)
    physics = msgspec.structs.replace(
        protocol.physics, timestep=settings.timestep, decimation=settings.decimation
    )
    changed = msgspec.structs.replace(protocol, physics=physics)
    if settings.push_interval[1]:
        push = msgspec.structs.replace(protocol.push, interval=settings.push_interval)
        changed = msgspec.structs.replace(changed, push=push)
    if abs(changed.control_period - protocol.control_period) > 1e-9:
        raise TrainingError(
            f"--timestep {settings.timestep:g} s x --decimation {settings.decimation}: valid: a product of "
            f"{protocol.control_period:g} s, the control period of {protocol.name}"
        )
    return changed


def make_environment(settings: Settings, pool: TargetPool | None = None) -> Environment:
    """The environment of a run; the pool that ships, if none is given."""
    protocol = training_protocol(settings)
    if settings.backend == "warp":
        from wbc_baselines.learned.training.backends.warp import WarpBackend

        backend = WarpBackend(protocol, settings.envs)
    else:
        from wbc_baselines.learned.training.backends.cpu import CpuBackend

        backend = CpuBackend(protocol, settings.envs, settings.threads)
    if pool is None:
        pool = read_pool(find_protocol(settings.protocol)[0])
    reward = METHODS[settings.method].reward
    return Environment(protocol, backend, pool, reward, settings.seed, settings.severity(0))
