"""Construction of the training environment from a configuration."""

import msgspec

from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.training.config import TrainConfig, TrainingError
from wbc_baselines.learned.training.environment import Environment
from wbc_baselines.learned.training.target_set import TargetSet, read_target_set
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import missing_extra


def training_protocol(config: TrainConfig) -> EvalProtocol:
    """Return the protocol of a configuration with the physics step and the pushes of training.

    Args:
        config: Configuration of the run.

    Returns:
        The changed protocol.

    Raises:
        TrainingError: The control period would differ from the protocol's, or its ground is not level.
    """
    protocol, _ = find_protocol(config.protocol)
    spread = protocol.randomization
    if spread.slope or spread.step_height:
        raise TrainingError(
            f"--protocol {config.protocol}: its ground has slopes of up to {spread.slope:g} rad and bumps of "
            f"up to {spread.step_height:g} m, valid for training: level ground"
        )
    physics = msgspec.structs.replace(
        protocol.physics, timestep=config.timestep, decimation=config.decimation
    )
    changed = msgspec.structs.replace(protocol, physics=physics)
    if config.push_interval[1]:
        push = msgspec.structs.replace(protocol.push, interval=config.push_interval)
        changed = msgspec.structs.replace(changed, push=push)
    if abs(changed.control_period - protocol.control_period) > 1e-9:
        raise TrainingError(
            f"--timestep {config.timestep:g} s x --decimation {config.decimation}: valid: a product of "
            f"{protocol.control_period:g} s, the control period of {protocol.name}"
        )
    return changed


def make_environment(config: TrainConfig, target_set: TargetSet | None = None) -> Environment:
    """Build the environment of a run.

    Args:
        config: Configuration of the run.
        target_set: Targets that episodes pick from; None for the set that ships with the package.

    Returns:
        The environment, with its first episodes begun.

    Raises:
        TrainingError: The physics step does not fit the protocol, or the backend is not available.
        ManifestError: The target set is missing or was generated for another protocol.
    """
    protocol = training_protocol(config)
    if config.backend == "warp":
        try:
            from wbc_baselines.learned.training.backends.warp import WarpBackend
        except ImportError as error:
            raise TrainingError(missing_extra("--backend warp", "warp", error)) from error

        backend = WarpBackend(protocol, config.num_envs)
    else:
        from wbc_baselines.learned.training.backends.cpu import CpuBackend

        backend = CpuBackend(protocol, config.num_envs, config.threads)
    if target_set is None:
        target_set = read_target_set(find_protocol(config.protocol)[0], requested=config.protocol)
    reward = METHODS[config.method].reward
    scale = config.disturbance_scale(0)
    return Environment(protocol, backend, target_set, reward, config.seed, scale, config.undisturbed)
